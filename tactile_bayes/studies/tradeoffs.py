"""Trade-offs of a map and of the forward model."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

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
from tactile_bayes.size.terms import outside_domain
from tactile_bayes.studies import paper
from tactile_bayes.studies.estimate_tradeoff import (
    Choice,
    Clock,
    Estimator,
    Ladder,
    Reference,
    SizeAnswer,
    Work,
    climbed,
    default_run,
)
from tactile_bayes.studies.paper_solid import SolidSettings

# --- Cost and error of each forward model and setting for one lump, measured on this machine.
#
# The same lump is mapped by the empirical model, by the plane-strain one at several cells, and by the solid one at
# several meshes, ranks and rims. Each model's finest setting is the reference of its others.

EMPIRICAL, PLANE, SOLID = "empirical", "plane-strain", "solid"
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

    @property
    def heads(self) -> dict[str, str]:
        """Place of the shoulders of each model's head, one of `presets.HEADS`."""
        return {PLANE: self.plane.head.shoulders, SOLID: self.solid.head.shoulders}


class Setting(Record):
    """One way to compute the map."""

    model: str
    """``"empirical"``, ``"plane-strain"`` or ``"solid"``."""
    label: str  #: For people.
    settings: paper.StudySettings | SolidSettings
    """Of the model; the empirical one is fitted to plane-strain frames of these."""
    kind: str
    """``"mesh"`` where only the elements differ from the default, ``"default"``, ``"reference"`` for the finest mesh,
    else what differs."""


class Measured(Record):
    """Cost and map of one setting."""

    setting: Setting  #: What was measured.
    element_mm: float  #: Mean length of an element on the lump's surface.
    lump_s: float  #: CPU for a lump: mesh, factorisation, condensing, the head on the body.
    map_s: float  #: CPU for another stiffness of it: its frames and their map.
    amplitude: float
    sigma_x_mm: float
    sigma_y_mm: float | None
    """`amplitude`, `sigma_x_mm`, `sigma_y_mm`: The map's Gaussian; no `sigma_y_mm` in two dimensions."""

    @property
    def seconds(self) -> float:
        """CPU seconds for one map from scratch."""
        return self.lump_s + self.map_s


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


def forward_settings(case: LumpCase) -> list[Setting]:
    """All settings to compare: within a model the cheap ones first, its reference last."""
    plane, solid = case.plane, case.solid
    found = [Setting(EMPIRICAL, "Eqs 1 to 4", plane, "default")]
    for fineness, cell in _PLANE[:-1]:
        chosen = replace(plane, fineness=fineness, cell_mm=cell)
        kind = "default" if chosen == plane else "mesh" if cell == plane.cell_mm else "contact cell"
        found.append(Setting(PLANE, f"fineness {fineness}, cell {cell:g} mm", chosen, kind))
    for fineness in _FINENESSES[:-1]:
        finer = replace(solid, fineness=fineness)
        found.append(Setting(SOLID, f"fineness {fineness}", finer, "default" if finer == solid else "mesh"))
    for rank in _RANKS:
        found.append(Setting(SOLID, f"rank tolerance {rank:g}", replace(solid, rank_tolerance=rank), "rank"))
    edge = "shoulders" if solid.head.shoulders == SHOULDERS_INSIDE else "rim"
    bare = replace(solid, head=replace(solid.head, shoulder_mm=0.0, rim_mm=0.0))
    (fineness, cell), finest = _PLANE[-1], _FINENESSES[-1]
    reference = replace(plane, fineness=fineness, cell_mm=cell)
    return [
        *found,
        Setting(SOLID, f"mesh ends at {_REACH_MM:g} mm", replace(solid, mesh_reach_mm=_REACH_MM), "reach"),
        Setting(SOLID, f"head without its {edge}", bare, "rim"),
        Setting(PLANE, f"fineness {fineness}, cell {cell:g} mm", reference, "reference"),
        Setting(SOLID, f"fineness {finest}", replace(solid, fineness=finest), "reference"),
    ]


def measure_forward(case: LumpCase, setting: Setting, *, clock: Clock, runs: int = 1) -> Measured:
    """Compute the map by one setting and measure the time, of so many `runs` the least.

    `clock` is called before and after each part.
    """
    times: list[tuple[float, float]] = []
    settings: paper.CaseSettings = setting.settings
    for _ in range(runs):
        begun = clock()
        maps = _empirical(case) if setting.model == EMPIRICAL else settings.maps(case.body)
        middle = clock()
        found = settings.fitted(maps(case.stiffness_ratio))
        times.append((middle - begun, clock() - middle))
    lump, one_map = np.min(times, axis=0)
    if isinstance(settings, SolidSettings):
        mesh = lump_mesh(settings.geometry(case.body), settings.mesh_size)
    else:
        mesh = body_mesh(case.body, fineness=settings.fineness, layered=False)
    element = float(np.pi * case.body.radius_mm / ((len(mesh.rim) - 1) / 2))  # half the circumference over its elements
    return Measured(setting, element, float(lump), float(one_map), found.amplitude, *found.widths_mm)


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
    settings = replace(case.solid if model == SOLID else case.plane, thickness_mm=thickness)
    rows: list[paper.StudyRow] = []
    for number, geometry in enumerate(geometries, start=1):
        rows += settings.rows(geometry)
        progress(number, len(geometries))
    return rows


def change(value: float | None, reference: float | None) -> float:
    """Relative difference; NaN where either is missing."""
    if value is None or reference is None:
        return float("nan")
    return value / reference - 1.0


# --- Point estimates of size from one map's Gaussian, by either form of the size calibration.

Sizes = Callable[[float, float, float | None], list[float]]
"""Diameters in mm from an amplitude and the widths across and along the head."""
Outside = Callable[[float, float, float | None], list[str]]
"""In what the same lie outside the table that a calibration was learned from, in words."""


class SizeRule(Record, eq=False):
    """Rule that converts amplitude and widths to a size."""

    sizes: Sizes  #: Diameters; the largest is the size.
    scatter: float  #: Standard deviation of ln d that it leaves: of what Eq 6 was learned from, or of bodies left out.
    source: str  #: In words.
    outside_of: Outside = lambda *_: []  #: What of a map is none of the calibration's.

    def size_mm(self, one: Measured) -> float:
        """Size of a measured map; NaN where its amplitude allows none."""
        if not one.amplitude > 0:
            return float("nan")
        return max(self.sizes(one.amplitude, one.sigma_x_mm, one.sigma_y_mm))

    def outside(self, one: Measured) -> list[str]:
        """Quantities of a measured map that lie outside the calibration's table, in words."""
        return self.outside_of(one.amplitude, one.sigma_x_mm, one.sigma_y_mm)


def learned_rule(rows: Sequence[paper.StudyRow]) -> SizeRule:
    """Learn Eq 6 in two stages from a study's rows, for each axis of the head, and its scatter over the rows."""
    axes = ["x", "y"] if rows[0].sigma_y_mm is not None else ["x"]
    learned = [paper.learn_as_printed(rows, axis=axis) for axis in axes]

    def sizes(amplitude: float, sigma_x_mm: float, sigma_y_mm: float | None) -> list[float]:
        widths = (sigma_x_mm, sigma_y_mm)
        return [
            one.m * width / (one.e * amplitude**one.f) + one.b_mm
            for one, width in zip(learned, widths, strict=False)
            if one is not None and width is not None
        ] or [float("nan")]

    shown = [row for row in rows if row.detectable]
    left = [max(sizes(row.amplitude, row.sigma_x_mm, row.sigma_y_mm)) / row.d_mm for row in shown]
    scatter = float(np.sqrt(np.mean(np.log(np.maximum(left, 1e-3)) ** 2))) if shown else float("nan")
    kind = "balls" if len(axes) == 2 else "cylinders"
    return SizeRule(sizes, scatter, f"Eq 6 in two stages from {len(shown)} hard {kind} of 10 to 25 mm in this body")


def calibrated_rule(calibration: Calibration, *, name: str) -> SizeRule:
    """The point estimate of a calibration of either form, with its mean coefficients; `name` is for people.

    Over a population it is the median of what `pooled_size` draws for a round lump in a body of which nothing is known,
    where the map says a and the widths exactly. A map in two dimensions has one width, which stands for both.
    """
    if isinstance(calibration, BodyCalibration):
        population = calibration

        def size(amplitude: float, sigma_x_mm: float, sigma_y_mm: float | None) -> list[float]:
            width = mean_width_mm(sigma_x_mm, sigma_y_mm)
            return [float(np.exp(population.corrected_log_size(np.log(np.array(amplitude)), np.log(np.array(width)))))]

        scatter = calibration.fit.get("left_out_sd", float(np.exp(calibration.spread.mean[0])))
        form = "Eq 6" if calibration.residual is None else "Eq 6 and its residual"
        return SizeRule(size, float(scatter), f"{form} of {name}", calibration.outside)
    axes = (calibration.x, calibration.y)

    def sizes(amplitude: float, *widths_mm: float | None) -> list[float]:
        a, given = np.array([amplitude]), zip(axes, widths_mm, strict=True)
        return [float(axis.size_mm(np.array([width]), a)[0]) for axis, width in given if width is not None]

    def outside(amplitude: float, *widths_mm: float | None) -> list[str]:
        given = [(axis, width) for axis, width in zip(axes, widths_mm, strict=True) if width is not None]
        return list(
            dict.fromkeys(one for axis, width in given for one in outside_domain(axis.domain, amplitude, width))
        )

    return SizeRule(sizes, float(calibration.x.draws.mean(axis=0)[4]), f"Eq 6 of {name}", outside)


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
            return {"map": clock() - begun, "estimate": 0.0}, SizeAnswer(str(error))
        return {"map": built_s, **seconds}, answer

    def reference() -> Reference:
        """A long run on the map with the finest cells, of all frames."""
        begun, finest = clock(), build_map(scan, cell_mm=FINEST_CELL_MM)
        calibration, options = inputs(finest)
        found = Estimator(finest, calibration, work).reference(options)
        ours = f"the map of all frames in cells of {FINEST_CELL_MM:g} mm"
        words = found.words.replace("the default's posterior", ours)
        return replace(found, words=words, cpu_s=clock() - begun)

    seconds, _ = default_run(settings[0].how, run)
    return climbed(settings, run, reference, default_s=seconds, work=work)
