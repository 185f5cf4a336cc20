"""Trade-offs of the forward model and of the map, with point estimates of size."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cache
from typing import Any, cast

import numpy as np
from scipy.special import ndtri

from tactile_bayes.declarations import Record, as_dict, field, replace
from tactile_bayes.errors import BadDataError
from tactile_bayes.forward.mesh import body_mesh, lump_mesh
from tactile_bayes.forward.plane import TactileLine, build_line, head_positions
from tactile_bayes.forward.scene import Scene
from tactile_bayes.forward.tissue import Body
from tactile_bayes.mapping.build import build_map
from tactile_bayes.mapping.map import TactileMap
from tactile_bayes.mapping.select import first_seconds
from tactile_bayes.posterior.draw import SamplerSettings
from tactile_bayes.presets import CELL_MM, DEFAULT_NORMALISE, NORMALISE, SHOULDERS_INSIDE, THICKNESS_MM
from tactile_bayes.scans import Scan
from tactile_bayes.size.bodies import BodyCalibration, mean_width_mm
from tactile_bayes.size.pooling import Calibration
from tactile_bayes.studies import paper
from tactile_bayes.studies.estimate_tradeoff import (
    SIZE,
    WIDTHS,
    IntervalWithError,
    MapEstimator,
    Reference,
    Setting,
    SizeAnswer,
    StudyRun,
    Tradeoff,
    answer_without_number,
    make_reference,
    run_tradeoff,
)
from tactile_bayes.studies.paper_solid import SolidSettings

# --- Cost and error of each forward model and setting for one lump, measured on this machine.
#
# The same lump is mapped by the plane-strain model with several contact cells, by Eqs 1 to 4, and by the solid model
# with several meshes, ranks and rims. Each model's finest setting is the reference of its others.

PLANE, SOLID = "plane-strain", "solid"
AMPLITUDE, ELEMENT = "amplitude", "element_mm"
# Fineness of the mesh and cell of the contact in mm, the finest last.
_PLANE = ((1, 0.5), (1, 0.25), (2, 0.5), (2, 0.25), (3, 0.25), (4, 0.125))
_RANKS = (1e-3, 1e-4)
_FINENESSES = (1, 2, 3)
_REACH_MM = 110.0
# Lumps that Eq 6 is learned from where no calibration is given.
_TAUGHT_MM = (10.0, 15.0, 20.0, 25.0)
_TAUGHT_DEPTHS = (0.8, 1.0, 1.2)


class LumpCase(Record):
    """The lump of a comparison."""

    d_mm: float
    depth_ratio: float
    stiffness_ratio: float
    seat: float  #: These as in `paper.Geometry`.
    plane: paper.StudySettings
    solid: SolidSettings
    """`plane`, `solid`: The default settings of both models for its body and head. No map is divided by the head's own
    response, and all are fitted with a level of 1."""

    @property
    def body(self) -> Body:
        """Geometry and tissues of the body."""
        return self.plane.body(self.d_mm, self.depth_ratio, seat=self.seat)

    def settings(self, model: str) -> paper.StudySettings | SolidSettings:
        """The default settings of a model, `PLANE` or `SOLID`."""
        return self.solid if model == SOLID else self.plane


class MapComputation(Record):
    """Settings by which a map is computed."""

    settings: paper.StudySettings | SolidSettings
    empirical: bool = False  #: True for Eqs 1 to 4, fitted to plane-strain frames of these settings.


def lump_case(scene: Scene, *, head: str | None = None) -> LumpCase:
    """Lump of a scene, with both models' settings for its body and head.

    `head`, one of `presets.HEADS`, is where the shoulders of the scene's head lie in both models; without it, inside
    the array in two dimensions and as in the scene in three. The scene must have exactly one lump, a ball of tissue,
    and no rib.
    """
    if scene.lumps or scene.ribs or len(scene.solid_lumps) != 1:
        many = "bumps" if scene.lumps else "a rib" if scene.ribs else f"{len(scene.solid_lumps)} lumps"
        raise BadDataError(f"the scene has {many}", way_out="give one lump of tissue: d_mm, depth_ratio")
    (lump,), tissue = scene.solid_lumps, as_dict(scene.layers) | {"mean_kpa": scene.background.mean_kpa}
    if lump.vertical_mm != lump.d_mm:
        raise BadDataError(f"lump[0].height_mm is {lump.vertical_mm:g}", way_out="leave it out: both models are round")
    seat = (tissue.pop("fat_mm") - lump.depth_mm) / (lump.d_mm / 2)
    section = scene.head.section(head or SHOULDERS_INSIDE)
    array = scene.head if head is None else scene.head.with_shoulders(head)
    case = LumpCase(
        lump.d_mm,
        lump.depth_ratio,
        lump.stiffness_ratio,
        round(seat, 9) + 0.0,
        paper.StudySettings(head=section, **tissue),
        SolidSettings(head=array, **tissue, background="fixed", flat_field=False),
    )
    _ = case.body  # refuses a body that neither model can compute
    return case


def forward_settings(case: LumpCase, model: str) -> tuple[list[Setting[MapComputation]], Setting[MapComputation]]:
    """The settings of a model to compare, the cheapest first, and the finest, which is their reference."""
    if model == SOLID:
        return _solid_settings(case.solid)
    choices = []
    for fineness, cell in _PLANE:
        chosen = replace(case.plane, fineness=fineness, cell_mm=cell)
        label = f"fineness {fineness}, cell {cell:g} mm"
        choices.append(Setting("mesh and contact", label, MapComputation(chosen), default=chosen == case.plane))
    empirical = Setting("another model", "Eqs 1 to 4", MapComputation(case.plane, empirical=True), usable=False)
    return [*choices[:-1], empirical], choices[-1]


def _solid_settings(solid: SolidSettings) -> tuple[list[Setting[MapComputation]], Setting[MapComputation]]:
    finer = [replace(solid, fineness=fineness) for fineness in _FINENESSES]
    meshes = [
        Setting("mesh", f"fineness {settings.fineness}", MapComputation(settings), default=settings == solid)
        for settings in finer
    ]
    edge = "shoulders" if solid.head.shoulders == SHOULDERS_INSIDE else "rim"
    bare = replace(solid.head, shoulder_mm=0.0, rim_mm=0.0)
    variants = [("rank", f"rank tolerance {rank:g}", replace(solid, rank_tolerance=rank)) for rank in _RANKS]
    variants.append(("reach", f"mesh ends at {_REACH_MM:g} mm", replace(solid, mesh_reach_mm=_REACH_MM)))
    variants.append(("head", f"head without {edge}", replace(solid, head=bare)))
    choices = [Setting(axis, label, MapComputation(settings), usable=False) for axis, label, settings in variants]
    return [*meshes[:-1], *choices], meshes[-1]


def measure_forward(case: LumpCase, model: str, rule: SizeRule, *, share: float, work: StudyRun) -> Tradeoff:
    """Compute the lump's map at every setting of a model; the tolerance is a `share` of the reference's size."""
    element_mm = cache(lambda settings: _element_mm(case.body, settings))  # a mesh for each setting, not for each run

    def run(computation: MapComputation, _number: int) -> tuple[dict[str, float], SizeAnswer]:
        begun, settings = work.clock(), cast("paper.CaseSettings", computation.settings)
        maps = _empirical(case) if computation.empirical else settings.maps(case.body)
        middle = work.clock()
        fit = settings.fitted(maps(case.stiffness_ratio))
        seconds = {"lump": middle - begun, "map": work.clock() - middle}
        return seconds, _exact_answer(fit, element_mm(computation.settings), rule)

    choices, finest = forward_settings(case, model)

    def reference() -> Reference:
        seconds, answer = run(finest.options, 0)
        return make_reference(f"{model}, {finest.label}", answer, sum(seconds.values()))

    tradeoff = run_tradeoff(choices, run, reference, work)
    answer = tradeoff.reference.answer
    assert answer is not None
    assert answer.reported is not None  # a width at least
    left = f"{100 * rule.scatter:.0f} % (SD of ln d): that is the interval, for these maps have no errors"
    notes = [f"Sizes by {rule.source}, which itself leaves {left}."]
    if outside := rule.outside(*amplitude_and_widths(answer)):
        notes.append(f"The map is none of the calibration's: {', '.join(outside)}.")
    size = answer.quantities.get(SIZE)
    if size is not None and not size.low <= case.d_mm <= size.high:
        notes.append(
            f"The lump of {case.d_mm:g} mm lies outside that interval, as its body is not the calibration's average: "
            "compare settings with each other, not sizes with the lump."
        )
    return replace(tradeoff, tolerance_mm=float(f"{share * answer.reported.median:.3g}"), notes=tuple(notes))


def _element_mm(body: Body, settings: paper.StudySettings | SolidSettings) -> float:
    """Mean length of an element on the lump's surface: half the circumference over its elements."""
    if isinstance(settings, SolidSettings):
        mesh = lump_mesh(settings.geometry(body), settings.mesh_size)
    else:
        mesh = body_mesh(body, fineness=settings.fineness, layered=False)
    return float(np.pi * body.radius_mm / ((len(mesh.rim) - 1) / 2))


def _exact_answer(fitted: paper.MapFit, element_mm: float, rule: SizeRule) -> SizeAnswer:
    """Answer of a map without errors; the interval of its size is the calibration's scatter."""
    exact = {AMPLITUDE: fitted.amplitude, **dict(zip(WIDTHS, fitted.widths_mm, strict=True)), ELEMENT: element_mm}
    known = {name: value for name, value in exact.items() if value is not None}
    quantities = {name: IntervalWithError(value, value, value, 0.0) for name, value in known.items()}
    size = rule.size_mm(fitted.amplitude, *fitted.widths_mm)
    if np.isfinite(size):
        low, high = (size * float(np.exp(z * np.nan_to_num(rule.scatter))) for z in ndtri([0.025, 0.975]))
        quantities[SIZE] = IntervalWithError(size, low, high, 0.0)
    return SizeAnswer("", None, "", quantities, {})


def amplitude_and_widths(answer: SizeAnswer) -> tuple[float, float, float | None]:
    """Amplitude and both widths of a map without errors."""
    amplitude, across = (answer.quantities[name].median for name in (AMPLITUDE, WIDTHS[0]))
    along = answer.quantities.get(WIDTHS[1])
    return amplitude, across, None if along is None else along.median


def dimensions_note(case: LumpCase, plane: Tradeoff, solid: Tradeoff, rules: Mapping[str, SizeRule]) -> str:
    """Sentence on the error of two dimensions for a ball, which no mesh reduces."""
    cylinder, ball = plane.reference.answer, solid.reference.answer
    assert cylinder is not None
    assert ball is not None
    same = rules[PLANE].source == rules[SOLID].source
    read, whose = (
        (cylinder, "a cylinder's map read by the same") if same else (ball, "a ball's map read by the cylinder's")
    )
    (a, sigma, _), (ball_a, ball_sigma, _) = amplitude_and_widths(cylinder), amplitude_and_widths(ball)
    return (
        f"Two dimensions: a cylinder shows {100 * (a / ball_a - 1):+.1f} % in amplitude and "
        f"{100 * (sigma / ball_sigma - 1):+.1f} % in width against a ball; {whose} calibration gives "
        f"{rules[PLANE].size_mm(*amplitude_and_widths(read)):.1f} mm for {case.d_mm:g}: no mesh mends that."
    )


def _empirical(case: LumpCase) -> Callable[[float], TactileLine]:
    """The map of Eqs 1 to 4, fitted to plane-strain frames."""
    settings = case.plane
    over = settings.over(settings.surface(case.body), case.stiffness_ratio)
    model = settings.empirical(case.d_mm, case.body.layers, over)
    return lambda _: build_line(model.frames(head_positions(settings.positions_mm), over.s_mm))


def training_rows(case: LumpCase, model: str, *, progress: Callable[[int, int], None]) -> list[paper.StudyRow]:
    """Rows of simulated hard lumps of several sizes and depths in the case's body, from which Eq 6 is learned."""
    geometries = [paper.Geometry(case.seat, d, h, (paper.HARD_RATIO,)) for d in _TAUGHT_MM for h in _TAUGHT_DEPTHS]
    deepest = max(d * (h + max(0.6, 0.5 * case.seat)) + 2.0 for d in _TAUGHT_MM for h in _TAUGHT_DEPTHS)
    thickness = max(case.solid.thickness_mm or THICKNESS_MM, deepest)
    settings = replace(case.settings(model), thickness_mm=thickness)
    rows: list[paper.StudyRow] = []
    for number, geometry in enumerate(geometries, start=1):
        rows += settings.rows(geometry)
        progress(number, len(geometries))
    return rows


# --- Point estimates of size from one map's Gaussian, by either form of the size calibration.


class SizeRule(Record, eq=False):
    """Rule that converts amplitude and the widths across and along the head to a size.

    A map in two dimensions has one width, which is used for both.
    """

    largest: Callable[[float, float, float | None], float]  #: The largest diameter, mm, for an amplitude above 0.
    scatter: float  #: Residual SD of ln d: over the rows that Eq 6 was learned from, or over held-out bodies.
    source: str  #: Where the rule comes from, in words.
    outside: Callable[[float, float, float | None], list[str]] = lambda *_: []
    """Properties of a map that lie outside the table that the calibration was learned from, in words."""

    def size_mm(self, amplitude: float, across_mm: float, along_mm: float | None) -> float:
        """Size of a map, mm; NaN for an amplitude of 0 or less."""
        return self.largest(amplitude, across_mm, along_mm) if amplitude > 0 else float("nan")


def learned_rule(rows: Sequence[paper.StudyRow]) -> SizeRule:
    """Learn Eq 6 in two stages from a study's rows, for each axis of the head, and its scatter over the rows."""
    axes = ["x", "y"] if rows[0].sigma_y_mm is not None else ["x"]
    learned = [paper.learn_as_printed(rows, axis=axis) for axis in axes]

    def largest(amplitude: float, *widths_mm: float | None) -> float:
        sizes = [
            law.m * width / (law.e * amplitude**law.f) + law.b_mm
            for law, width in zip(learned, widths_mm, strict=False)
            if law is not None and width is not None
        ]
        return max(sizes, default=float("nan"))

    detectable = [row for row in rows if row.detectable]
    ratios = [largest(row.amplitude, row.sigma_x_mm, row.sigma_y_mm) / row.d_mm for row in detectable]
    scatter = float(np.sqrt(np.mean(np.log(np.maximum(ratios, 1e-3)) ** 2))) if detectable else float("nan")
    kind = "balls" if len(axes) == 2 else "cylinders"
    source = f"Eq 6 in two stages from {len(detectable)} hard {kind} of 10 to 25 mm in this body"
    return SizeRule(largest, scatter, source)


def calibrated_rule(calibration: Calibration, *, name: str) -> SizeRule:
    """Point estimate of a calibration of either form, by its mean coefficients; `name` is for messages.

    Over a population it is the median of the draws of `pooled_size` for a round lump in an unknown body, on a map whose
    amplitude and widths are exact.
    """
    if isinstance(calibration, BodyCalibration):

        def by_bodies(amplitude: float, across: float, along: float | None) -> float:
            width = np.array(mean_width_mm(across, along))
            return float(np.exp(calibration.corrected_log_size(np.log(np.array(amplitude)), np.log(width))))

        scatter = calibration.fit.get("left_out_sd", float(np.exp(calibration.spread.mean[0])))
        form = "Eq 6" if calibration.residual is None else "Eq 6 and its residual"
        source = f"{form} of {name} at an average depth of fat (`estimate` reads it from the frames)"
        return SizeRule(by_bodies, float(scatter), source, calibration.outside)
    axes = calibration.x, calibration.y

    def by_axes(amplitude: float, across: float, along: float | None) -> float:
        widths = across, across if along is None else along
        sizes = [axis.size_mm(np.array([mm]), np.array([amplitude])) for axis, mm in zip(axes, widths, strict=True)]
        return float(np.max(sizes))

    def outside(amplitude: float, across: float, along: float | None) -> list[str]:
        texts = calibration.outside(amplitude, across, across if along is None else along)
        return texts[len(calibration.cautions) :]

    return SizeRule(by_axes, float(calibration.x.draws.mean(axis=0)[4]), f"Eq 6 of {name}", outside)


# --- Cost of accuracy before the map: cells, frames, time of strokes and normalising, each up to the size.

FINEST_CELL_MM = 0.5
CELLS_MM = (FINEST_CELL_MM, 0.75, 1.5, 2.0, 3.0, 4.0)
EVERY = (2, 4, 8, 16, 32)
SHARES_OF_TIME = (0.75, 0.5, 0.25)
CELL, FRAMES, TIME, LEVEL = "cell size", "frames used", "time of strokes", "normalising"
Inputs = Callable[[TactileMap], tuple[Calibration | None, SamplerSettings]]


class MapBuild(Record):
    """Settings by which a map is built."""

    options: dict[str, Any] = field(default_factory=dict)  #: Options of `build_map`.
    duration_s: float | None = None  #: Use the first so many seconds only; None uses all.


def map_settings(scan: Scan) -> list[Setting[MapBuild]]:
    """Settings to measure, the default first."""
    time_s = scan.frames.time_s
    whole_s = float(time_s[-1] - time_s[0]) if len(time_s) else 0.0
    choices = [Setting(CELL, f"--cell-mm {CELL_MM:g}", MapBuild(), default=True)]
    choices += [Setting(CELL, f"--cell-mm {h:g}", MapBuild({"cell_mm": h}), 0.5 + 0.5 / h**2) for h in CELLS_MM]
    choices += [Setting(FRAMES, f"--every {n}", MapBuild({"every": n}), 0.5 + 0.5 / n) for n in EVERY]
    for s in (share * whole_s for share in SHARES_OF_TIME if whole_s > 0):
        choices.append(Setting(TIME, f"the first {s:.3g} s of {whole_s:.3g} s", MapBuild(duration_s=s), usable=False))
    for normalise in NORMALISE:
        if normalise != DEFAULT_NORMALISE:
            choices.append(Setting(LEVEL, f"--normalise {normalise}", MapBuild({"normalise": normalise}), usable=False))
    return choices


def measure_map(scan: Scan, *, inputs: Inputs, work: StudyRun) -> Tradeoff:
    """Build and estimate the map of a scan at every setting.

    `inputs` returns the calibration and the options that `estimate` chooses for a map. `BadDataError` if no map can be
    built by default.
    """
    clock, settings = work.clock, map_settings(scan)

    def run(choice: MapBuild, number: int) -> tuple[dict[str, float], SizeAnswer]:
        begun = clock()
        try:
            part = scan if choice.duration_s is None else first_seconds(scan, choice.duration_s)
            tactile_map = build_map(part, **choice.options)
            built_s = clock() - begun
            calibration, options = inputs(tactile_map)
            seconds, answer = MapEstimator(tactile_map, calibration, work).run(options, number)
        except BadDataError as error:
            if choice == settings[0].options:
                raise
            return {"map": clock() - begun, "estimate": 0.0}, answer_without_number(str(error))
        return {"map": built_s, **seconds}, answer

    def reference() -> Reference:
        """A long run on the map of all frames with the finest cells."""
        begun, finest = clock(), build_map(scan, cell_mm=FINEST_CELL_MM)
        calibration, options = inputs(finest)
        reference = MapEstimator(finest, calibration, work).reference(options)
        ours = f"the map of all frames in cells of {FINEST_CELL_MM:g} mm"
        words = reference.words.replace("the default's posterior", ours)
        return replace(reference, words=words, cpu_s=clock() - begun)

    return run_tradeoff(settings, run, reference, work)
