"""Trade-offs of a map and of the forward model."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
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
    Choice,
    Estimator,
    Interval,
    Ladder,
    Reference,
    SizeAnswer,
    Work,
    climbed,
    no_number,
    reference_of,
)
from tactile_bayes.studies.paper_solid import SolidSettings

# --- Cost and error of each forward model and setting for one lump, measured on this machine.
#
# The same lump is mapped by the plane-strain model at several cells, with Eqs 1 to 4 beside it, and by the solid one at
# several meshes, ranks and rims. Each model's finest setting is the reference of its others.

PLANE, SOLID = "plane-strain", "solid"
AMPLITUDE, ELEMENT = "amplitude", "element_mm"
# Fineness of the mesh and cell of the contact in mm, the finest last.
_PLANE = ((1, 0.5), (1, 0.25), (2, 0.5), (2, 0.25), (3, 0.25), (4, 0.125))
_RANKS = (1e-3, 1e-4)
_FINENESSES = (1, 2, 3)
_REACH_MM = 110.0
# What Eq 6 is learned from where no calibration is given.
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
    """`plane`, `solid`: The default settings of both models for its body and head. All maps are as they are and fitted
    with a level of 1, as those in two dimensions are."""

    @property
    def body(self) -> Body:
        """Geometry and tissues of the body."""
        return self.plane.body(self.d_mm, self.depth_ratio, seat=self.seat)

    def of(self, model: str) -> paper.StudySettings | SolidSettings:
        """The default settings of a model, `PLANE` or `SOLID`."""
        return self.solid if model == SOLID else self.plane


class Computed(Record):
    """One way to compute the map."""

    settings: paper.StudySettings | SolidSettings
    empirical: bool = False  #: By Eqs 1 to 4, fitted to plane-strain frames of these settings.


def case_of(scene: Scene, *, head: str | None = None) -> LumpCase:
    """Lump of a scene, with both models' settings for its body and head.

    `head`, one of `presets.HEADS`, says where the shoulders of the scene's head lie, in both models; without it, inside
    the array in two dimensions, and as the scene gives them in three. A scene without exactly one lump, a ball of
    tissue, or with a rib, is at fault.
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
    _ = case.body  # refuses what neither model can do
    return case


def forward_settings(case: LumpCase, model: str) -> tuple[list[Choice[Computed]], Choice[Computed]]:
    """All settings of a model to compare, the cheap ones first, and the finest, which is their reference."""
    if model == SOLID:
        return _solid_settings(case.solid)
    found = []
    for fineness, cell in _PLANE:
        chosen = replace(case.plane, fineness=fineness, cell_mm=cell)
        words = f"fineness {fineness}, cell {cell:g} mm"
        found.append(Choice("mesh and contact", words, Computed(chosen), default=chosen == case.plane))
    empirical = Choice("another model", "Eqs 1 to 4", Computed(case.plane, empirical=True), usable=False)
    return [*found[:-1], empirical], found[-1]


def _solid_settings(solid: SolidSettings) -> tuple[list[Choice[Computed]], Choice[Computed]]:
    finer = [replace(solid, fineness=fineness) for fineness in _FINENESSES]
    found = [Choice("mesh", f"fineness {one.fineness}", Computed(one), default=one == solid) for one in finer]
    edge = "shoulders" if solid.head.shoulders == SHOULDERS_INSIDE else "rim"
    bare = replace(solid.head, shoulder_mm=0.0, rim_mm=0.0)
    others = [("rank", f"rank tolerance {rank:g}", replace(solid, rank_tolerance=rank)) for rank in _RANKS]
    others.append(("reach", f"mesh ends at {_REACH_MM:g} mm", replace(solid, mesh_reach_mm=_REACH_MM)))
    others.append(("head", f"head without {edge}", replace(solid, head=bare)))
    choices = [Choice(axis, label, Computed(how), usable=False) for axis, label, how in others]
    return [*found[:-1], *choices], found[-1]


def measure_forward(case: LumpCase, model: str, rule: SizeRule, *, share: float, work: Work) -> Ladder:
    """Compute the lump's map at every setting of a model.

    The ladder's tolerance is a `share` of the reference's size.
    """

    def run(how: Computed, _number: int) -> tuple[dict[str, float], SizeAnswer]:
        begun, settings = work.clock(), cast("paper.CaseSettings", how.settings)
        maps = _empirical(case) if how.empirical else settings.maps(case.body)
        middle = work.clock()
        found = settings.fitted(maps(case.stiffness_ratio))
        seconds = {"lump": middle - begun, "map": work.clock() - middle}
        return seconds, _exact_answer(found, _element_mm(case.body, how.settings), rule)

    choices, finest = forward_settings(case, model)

    def reference() -> Reference:
        seconds, answer = run(finest.how, 0)
        return reference_of(f"{model}, {finest.label}", answer, sum(seconds.values()))

    ladder = climbed(choices, run, reference, work)
    answer = ladder.reference.answer
    assert answer is not None
    assert answer.reported is not None  # a width at least
    left = f"leaves {100 * rule.scatter:.0f} % (SD of ln d): that is the interval, for these maps have no errors"
    notes = [f"Sizes by {rule.source}, which itself {left}."]
    if outside := rule.outside(*numbers_of(answer)):
        notes.append(f"The map is none of the calibration's: {', '.join(outside)}.")
    return replace(ladder, tolerance_mm=float(f"{share * answer.reported.median:.3g}"), notes=tuple(notes))


def _element_mm(body: Body, settings: paper.StudySettings | SolidSettings) -> float:
    """Mean length of an element on the lump's surface: half the circumference over its elements."""
    if isinstance(settings, SolidSettings):
        mesh = lump_mesh(settings.geometry(body), settings.mesh_size)
    else:
        mesh = body_mesh(body, fineness=settings.fineness, layered=False)
    return float(np.pi * body.radius_mm / ((len(mesh.rim) - 1) / 2))


def _exact_answer(fitted: paper.MapFit, element_mm: float, rule: SizeRule) -> SizeAnswer:
    """A map without errors; the interval of its size is what the calibration leaves."""
    exact = {AMPLITUDE: fitted.amplitude, **dict(zip(WIDTHS, fitted.widths_mm, strict=True)), ELEMENT: element_mm}
    found = {name: Interval(value, value, value, 0.0) for name, value in exact.items() if value is not None}
    size = rule.size_mm(fitted.amplitude, *fitted.widths_mm)
    if np.isfinite(size):
        low, high = (size * float(np.exp(z * np.nan_to_num(rule.scatter))) for z in ndtri([0.025, 0.975]))
        found[SIZE] = Interval(size, low, high, 0.0)
    return SizeAnswer("", None, "", found, {})


def numbers_of(answer: SizeAnswer) -> tuple[float, float, float | None]:
    """Amplitude and both widths of a map without errors."""
    amplitude, across = (answer.quantities[name].median for name in (AMPLITUDE, WIDTHS[0]))
    along = answer.quantities.get(WIDTHS[1])
    return amplitude, across, None if along is None else along.median


def dimensions_note(case: LumpCase, plane: Ladder, solid: Ladder, rules: Mapping[str, SizeRule]) -> str:
    """What two dimensions themselves get wrong of a ball, however fine they are."""
    cylinder, ball = plane.reference.answer, solid.reference.answer
    assert cylinder is not None
    assert ball is not None
    same = rules[PLANE].source == rules[SOLID].source
    read, whose = (
        (cylinder, "a cylinder's map read by the same") if same else (ball, "a ball's map read by the cylinder's")
    )
    (a, sigma, _), (ball_a, ball_sigma, _) = numbers_of(cylinder), numbers_of(ball)
    return (
        f"Two dimensions: a cylinder shows {100 * (a / ball_a - 1):+.1f} % in amplitude and "
        f"{100 * (sigma / ball_sigma - 1):+.1f} % in width against a ball; {whose} calibration gives "
        f"{rules[PLANE].size_mm(*numbers_of(read)):.1f} mm for {case.d_mm:g}: no mesh mends that."
    )


def _empirical(case: LumpCase) -> Callable[[float], TactileLine]:
    """The map of Eqs 1 to 4, which are fitted to plane-strain frames."""
    settings = case.plane
    over = settings.over(settings.surface(case.body), case.stiffness_ratio)
    model = settings.empirical(case.d_mm, case.body.layers, over)
    return lambda _: build_line(model.frames(head_positions(settings.positions_mm), over.s_mm))


def teach(case: LumpCase, model: str, *, progress: Callable[[int, int], None]) -> list[paper.StudyRow]:
    """Simulate hard lumps of several sizes and depths in the case's body, to learn Eq 6 from."""
    geometries = [paper.Geometry(case.seat, d, h, (paper.HARD_RATIO,)) for d in _TAUGHT_MM for h in _TAUGHT_DEPTHS]
    deepest = max(d * (h + max(0.6, 0.5 * case.seat)) + 2.0 for d in _TAUGHT_MM for h in _TAUGHT_DEPTHS)
    thickness = max(case.solid.thickness_mm or THICKNESS_MM, deepest)
    settings = replace(case.of(model), thickness_mm=thickness)
    rows: list[paper.StudyRow] = []
    for number, geometry in enumerate(geometries, start=1):
        rows += settings.rows(geometry)
        progress(number, len(geometries))
    return rows


# --- Point estimates of size from one map's Gaussian, by either form of the size calibration.


class SizeRule(Record, eq=False):
    """Rule that converts amplitude and the widths across and along the head to a size.

    A map in two dimensions has one width, which stands for both.
    """

    largest: Callable[[float, float, float | None], float]  #: The largest diameter, mm, for an amplitude above 0.
    scatter: float  #: Standard deviation of ln d that it leaves: of what Eq 6 was learned from, or of bodies left out.
    source: str  #: In words.
    outside: Callable[[float, float, float | None], list[str]] = lambda *_: []
    """In what a map lies outside the table that a calibration was learned from, in words."""

    def size_mm(self, amplitude: float, across_mm: float, along_mm: float | None) -> float:
        """Size of a map; NaN where its amplitude allows none."""
        return self.largest(amplitude, across_mm, along_mm) if amplitude > 0 else float("nan")


def learned_rule(rows: Sequence[paper.StudyRow]) -> SizeRule:
    """Learn Eq 6 in two stages from a study's rows, for each axis of the head, and its scatter over the rows."""
    axes = ["x", "y"] if rows[0].sigma_y_mm is not None else ["x"]
    learned = [paper.learn_as_printed(rows, axis=axis) for axis in axes]

    def largest(amplitude: float, *widths_mm: float | None) -> float:
        sizes = [
            one.m * width / (one.e * amplitude**one.f) + one.b_mm
            for one, width in zip(learned, widths_mm, strict=False)
            if one is not None and width is not None
        ]
        return max(sizes, default=float("nan"))

    shown = [row for row in rows if row.detectable]
    left = [largest(row.amplitude, row.sigma_x_mm, row.sigma_y_mm) / row.d_mm for row in shown]
    scatter = float(np.sqrt(np.mean(np.log(np.maximum(left, 1e-3)) ** 2))) if shown else float("nan")
    kind = "balls" if len(axes) == 2 else "cylinders"
    return SizeRule(largest, scatter, f"Eq 6 in two stages from {len(shown)} hard {kind} of 10 to 25 mm in this body")


def calibrated_rule(calibration: Calibration, *, name: str) -> SizeRule:
    """The point estimate of a calibration of either form, with its mean coefficients; `name` is for people.

    Over a population it is the median of what `pooled_size` draws for a round lump in a body of which nothing is known,
    where the map says a and the widths exactly.
    """
    if isinstance(calibration, BodyCalibration):
        population = calibration

        def by_bodies(amplitude: float, across: float, along: float | None) -> float:
            width = np.array(mean_width_mm(across, along))
            return float(np.exp(population.corrected_log_size(np.log(np.array(amplitude)), np.log(width))))

        scatter = population.fit.get("left_out_sd", float(np.exp(population.spread.mean[0])))
        form = "Eq 6" if population.residual is None else "Eq 6 and its residual"
        source = f"{form} of {name} at an average depth of fat (`estimate` reads it from the frames)"
        return SizeRule(by_bodies, float(scatter), source, population.outside)
    axes = calibration.x, calibration.y

    def by_axes(amplitude: float, across: float, along: float | None) -> float:
        widths = across, across if along is None else along
        return max(
            float(axis.size_mm(np.array([mm]), np.array([amplitude]))[0]) for axis, mm in zip(axes, widths, strict=True)
        )

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


class Built(Record):
    """One way to build a map."""

    options: dict[str, Any] = field(default_factory=dict)  #: Of `build_map`.
    duration_s: float | None = None  #: Use the first so many seconds only; None uses all.


def map_settings(scan: Scan) -> list[Choice[Built]]:
    """Everything that is tried, the default first."""
    time_s = scan.frames.time_s
    whole_s = float(time_s[-1] - time_s[0]) if len(time_s) else 0.0
    found = [Choice(CELL, f"--cell-mm {CELL_MM:g}", Built(), default=True)]
    found += [Choice(CELL, f"--cell-mm {h:g}", Built({"cell_mm": h}), 0.5 + 0.5 / h**2) for h in CELLS_MM]
    found += [Choice(FRAMES, f"--every {n}", Built({"every": n}), 0.5 + 0.5 / n) for n in EVERY]
    for s in (share * whole_s for share in SHARES_OF_TIME if whole_s > 0):
        found.append(Choice(TIME, f"the first {s:.3g} s of {whole_s:.3g} s", Built(duration_s=s), usable=False))
    others = [way for way in NORMALISE if way != DEFAULT_NORMALISE]
    return [*found, *(Choice(LEVEL, f"--normalise {way}", Built({"normalise": way}), usable=False) for way in others)]


def measure_map(scan: Scan, *, inputs: Inputs, work: Work) -> Ladder:
    """Build and estimate the map of a scan at every setting.

    `inputs` leads from a map to the calibration and the options with which `estimate` takes it by itself. Where no map
    can be built by default, `BadDataError` says why.
    """
    clock, settings = work.clock, map_settings(scan)

    def run(one: Built, number: int) -> tuple[dict[str, float], SizeAnswer]:
        begun = clock()
        try:
            used = scan if one.duration_s is None else first_seconds(scan, one.duration_s)
            tactile_map = build_map(used, **one.options)
            built_s = clock() - begun
            calibration, options = inputs(tactile_map)
            seconds, answer = Estimator(tactile_map, calibration, work).run(options, number)
        except BadDataError as error:
            if one == settings[0].how:
                raise
            return {"map": clock() - begun, "estimate": 0.0}, no_number(str(error))
        return {"map": built_s, **seconds}, answer

    def reference() -> Reference:
        """A long run on the map with the finest cells, of all frames."""
        begun, finest = clock(), build_map(scan, cell_mm=FINEST_CELL_MM)
        calibration, options = inputs(finest)
        found = Estimator(finest, calibration, work).reference(options)
        ours = f"the map of all frames in cells of {FINEST_CELL_MM:g} mm"
        words = found.words.replace("the default's posterior", ours)
        return replace(found, words=words, cpu_s=clock() - begun)

    return climbed(settings, run, reference, work)
