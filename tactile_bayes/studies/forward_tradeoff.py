"""Cost and error of each forward model and setting for one lump, measured on this machine.

The same lump is mapped by the empirical model, by the plane-strain one at several cells, and by the solid one at
several meshes, ranks and rims. Each model's finest setting is the reference of its others.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from tactile_bayes.errors import BadDataError
from tactile_bayes.forward.body import THICKNESS_MM, Body
from tactile_bayes.forward.plane.empirical import fit_empirical
from tactile_bayes.forward.plane.line import build_line, head_positions, press, press_layers
from tactile_bayes.forward.plane.study import HARD_RATIO, Fit, Geometry, StudyRow, StudySettings, run_geometry
from tactile_bayes.forward.scene import Scene
from tactile_bayes.forward.solid.study import RasterFitter, SolidSettings, raster_frames, run_solid_geometry
from tactile_bayes.forward.tissue import SceneBody, fat_thickness
from tactile_bayes.geometry import FloatArray
from tactile_bayes.presets import HEAD_PITCH_MM, SHOULDERS_INSIDE

EMPIRICAL, PLANE, SOLID = "empirical", "plane-strain", "solid"
# Fineness of the mesh and cell of the contact in mm, the finest last.
_PLANE = ((1, 0.5), (1, 0.25), (2, 0.5), (2, 0.25), (3, 0.25), (4, 0.125))
_RANKS = (1e-3, 1e-4)
_FINENESSES = (1, 2, 3)
_REACHES_MM = (110.0,)
# What Eq 6 is learned from where no calibration is given.
_TAUGHT_MM = (10.0, 15.0, 20.0, 25.0)
_TAUGHT_DEPTHS = (0.8, 1.0, 1.2)

Clock = Callable[[], float]
"""Seconds of CPU."""


@dataclass(frozen=True, slots=True)
class LumpCase:
    """The lump of a comparison.

    Parameters
    ----------
    d_mm, depth_ratio, stiffness_ratio, seat
        As in `study.Geometry`.
    plane, solid
        The default settings of both models for its body and head. All maps are as they are and fitted with a level of
        1, as those in two dimensions are.
    """

    d_mm: float
    depth_ratio: float
    stiffness_ratio: float
    seat: float
    plane: StudySettings
    solid: SolidSettings

    @property
    def body(self) -> Body:
        """Geometry and tissues of the body."""
        return self.plane.body(self.d_mm, self.depth_ratio, seat=self.seat)

    @property
    def heads(self) -> dict[str, str]:
        """Place of the shoulders of each model's head, one of `presets.HEADS`."""
        return {PLANE: self.plane.head.shoulders, SOLID: self.solid.head.shoulders}


@dataclass(frozen=True, slots=True)
class Setting:
    """One way to compute the map.

    Parameters
    ----------
    model
        ``"empirical"``, ``"plane-strain"`` or ``"solid"``.
    label
        For people.
    settings
        Of the model; the empirical one is fitted to plane-strain frames of these.
    kind
        ``"mesh"`` where only the elements differ from the default, ``"default"``, ``"reference"`` for the finest mesh,
        else what differs.
    """

    model: str
    label: str
    settings: StudySettings | SolidSettings
    kind: str


@dataclass(frozen=True, slots=True)
class Measured:
    """Cost and map of one setting.

    Parameters
    ----------
    setting
        What was measured.
    element_mm
        Mean length of an element on the lump's surface.
    lump_s
        CPU for a lump: mesh, factorisation, condensing, the head on the body.
    map_s
        CPU for another stiffness of it: its frames and their map.
    amplitude, sigma_x_mm, sigma_y_mm
        The map's Gaussian; no `sigma_y_mm` in two dimensions.
    """

    setting: Setting
    element_mm: float
    lump_s: float
    map_s: float
    amplitude: float
    sigma_x_mm: float
    sigma_y_mm: float | None

    @property
    def seconds(self) -> float:
        """CPU seconds for one map from scratch."""
        return self.lump_s + self.map_s


def case_of(scene: Scene, *, head: str | None = None) -> LumpCase:
    """Lump of a scene, with both models' settings for its body and head.

    Parameters
    ----------
    head
        One of `presets.HEADS`: where the shoulders of the scene's head lie, in both models. None: inside the array in
        two dimensions, and as the scene gives them in three.

    Raises
    ------
    BadDataError
        When it has not exactly one lump, a ball of tissue and no rib.
    """
    if scene.lumps or scene.ribs or len(scene.solid_lumps) != 1:
        many = "bumps" if scene.lumps else "a rib" if scene.ribs else f"{len(scene.solid_lumps)} lumps"
        raise BadDataError(f"the scene has {many}", way_out="give one lump of tissue: d_mm, depth_ratio")
    (lump,), body = scene.solid_lumps, scene.body or SceneBody()
    if lump.vertical_mm != lump.d_mm:
        raise BadDataError(f"lump[0].height_mm is {lump.vertical_mm:g}", way_out="leave it out: both models are round")
    seat = (fat_thickness(body, [lump]) - lump.depth_mm) / (lump.d_mm / 2)
    tissue = (scene.background.mean_kpa, body.nu, body.fat_kpa, body.gland_ratio, body.thickness_mm)
    section = scene.head.section(head or SHOULDERS_INSIDE)
    array = scene.head if head is None else scene.head.with_shoulders(head)
    case = LumpCase(
        lump.d_mm,
        lump.depth_ratio,
        lump.stiffness_ratio,
        round(seat, 9) + 0.0,
        StudySettings(section, *tissue),
        SolidSettings(array, *tissue, background="fixed", flat_field=False),
    )
    _ = case.body  # refuses what neither model can do
    return case


def settings_of(case: LumpCase) -> list[Setting]:
    """All settings to compare: within a model the cheap ones first, its reference last."""
    found = [Setting(EMPIRICAL, "Eqs 1 to 4", case.plane, "default")]
    for fineness, cell in _PLANE:
        chosen = replace(case.plane, fineness=fineness, cell_mm=cell)
        kind = _kind(chosen == case.plane, cell == case.plane.cell_mm, (fineness, cell) == _PLANE[-1], "contact cell")
        found.append(Setting(PLANE, f"fineness {fineness}, cell {cell:g} mm", chosen, kind))
    for fineness in _FINENESSES:
        chosen_solid = replace(case.solid, fineness=fineness)
        kind = _kind(chosen_solid == case.solid, True, fineness == _FINENESSES[-1], "")
        found.append(Setting(SOLID, f"fineness {fineness}", chosen_solid, kind))
    for rank in _RANKS:
        found.append(Setting(SOLID, f"rank tolerance {rank:g}", replace(case.solid, rank_tolerance=rank), "rank"))
    for reach in _REACHES_MM:
        found.append(Setting(SOLID, f"mesh ends at {reach:g} mm", replace(case.solid, mesh_reach_mm=reach), "reach"))
    edge = "shoulders" if case.solid.head.shoulders == SHOULDERS_INSIDE else "rim"
    bare = replace(case.solid, head=replace(case.solid.head, shoulder_mm=0.0, rim_mm=0.0))
    found.append(Setting(SOLID, f"head without its {edge}", bare, "rim"))
    return [setting for setting in found if setting.kind != "reference"] + [
        setting for setting in found if setting.kind == "reference"
    ]


def _kind(default: bool, mesh_only: bool, reference: bool, other: str) -> str:
    if reference:
        return "reference"
    return "default" if default else "mesh" if mesh_only else other


def measure(
    case: LumpCase, setting: Setting, *, fit: Fit, raster_fit: RasterFitter, clock: Clock, runs: int = 1
) -> Measured:
    """Compute the map by one setting and measure the time.

    Parameters
    ----------
    fit, raster_fit
        Of Eq 5 to a line, and of Eq 7 to a raster.
    clock
        Called before and after each part.
    runs
        The least of this many is kept.
    """
    work = {EMPIRICAL: _empirical, PLANE: _plane, SOLID: _solid}[setting.model]
    times = []
    for _ in range(runs):
        begun = clock()
        prepared = work(case, setting)
        middle = clock()
        found = prepared(fit, raster_fit)
        times.append((middle - begun, clock() - middle))
    lump, one_map = np.min(times, axis=0)
    return Measured(setting, _element_mm(case, setting), float(lump), float(one_map), *found)


_Shown = tuple[float, float, float | None]
_Prepared = Callable[[Fit, RasterFitter], _Shown]


def _empirical(case: LumpCase, setting: Setting) -> _Prepared:
    settings = setting.settings
    assert isinstance(settings, StudySettings)
    head, mean, cell = settings.head, settings.mean_kpa, settings.cell_mm
    far = press_layers(case.body.layers, head=head, mean_kpa=mean, cell_mm=cell).as_taxels(HEAD_PITCH_MM)
    over = press(settings.surface(case.body), case.stiffness_ratio, np.zeros(1), head=head, mean_kpa=mean)
    seen = over.as_taxels(HEAD_PITCH_MM)
    model = fit_empirical(seen.s_mm, far.at(0.0), seen.at(0.0), d_mm=case.d_mm, half_width_mm=head.half_width_mm)

    def shown(fit: Fit, _: RasterFitter) -> _Shown:
        frames = model.frames(head_positions(settings.positions_mm), over.s_mm)
        found = fit(build_line(frames), settings.fit_radius_mm)
        return found.amplitude, found.sigma_mm, None

    return shown


def _plane(case: LumpCase, setting: Setting) -> _Prepared:
    settings = setting.settings
    assert isinstance(settings, StudySettings)
    surface = settings.surface(case.body)

    def shown(fit: Fit, _: RasterFitter) -> _Shown:
        found = fit(build_line(settings.frames(surface, case.stiffness_ratio)), settings.fit_radius_mm)
        return found.amplitude, found.sigma_mm, None

    return shown


def _solid(case: LumpCase, setting: Setting) -> _Prepared:
    settings = setting.settings
    assert isinstance(settings, SolidSettings)
    head, condensed = settings.on(case.body), settings.condensed(case.body)

    def shown(_: Fit, raster_fit: RasterFitter) -> _Shown:
        frames = raster_frames(head, settings.placed(condensed, case.stiffness_ratio), settings)
        found = raster_fit(frames, settings)
        return found.amplitude, found.sigma_x_mm, found.sigma_y_mm

    return shown


def _element_mm(case: LumpCase, setting: Setting) -> float:
    """Half the lump's circumference over the elements on it."""
    settings = setting.settings
    if isinstance(settings, SolidSettings):
        from tactile_bayes.forward.solid.mesh import lump_mesh

        nodes = len(lump_mesh(settings.geometry(case.body), settings.mesh_size).arc)
    else:
        from tactile_bayes.forward.plane.condense import rim_nodes

        nodes = rim_nodes(case.body, fineness=settings.fineness)
    return float(np.pi * case.body.radius_mm / ((nodes - 1) / 2))


def teach(
    case: LumpCase, model: str, *, fit: Fit, raster_fit: RasterFitter, progress: Callable[[int, int], None]
) -> list[StudyRow]:
    """Simulate hard lumps of several sizes and depths in the case's body, to learn Eq 6 from."""
    geometries = [Geometry(case.seat, d, h, (HARD_RATIO,)) for d in _TAUGHT_MM for h in _TAUGHT_DEPTHS]
    deepest = max(d * (h + max(0.6, 0.5 * case.seat)) + 2.0 for d in _TAUGHT_MM for h in _TAUGHT_DEPTHS)
    thickness = max(case.solid.thickness_mm or THICKNESS_MM, deepest)
    rows: list[StudyRow] = []
    for number, geometry in enumerate(geometries, start=1):
        if model == SOLID:
            rows += run_solid_geometry(geometry, settings=replace(case.solid, thickness_mm=thickness), fit=raster_fit)
        else:
            rows += run_geometry(geometry, settings=replace(case.plane, thickness_mm=thickness), fit=fit)
        progress(number, len(geometries))
    return rows


def change(value: float | None, reference: float | None) -> float:
    """Relative difference; NaN where either is missing."""
    if value is None or reference is None:
        return float("nan")
    return value / reference - 1.0


def cheapest(found: Sequence[Measured], errors: FloatArray, *, tolerance: float) -> Measured | None:
    """The cheapest of the settings whose error is at most `tolerance`."""
    good = [one for one, error in zip(found, errors, strict=True) if abs(error) <= tolerance]
    return min(good, key=lambda one: one.seconds, default=None)
