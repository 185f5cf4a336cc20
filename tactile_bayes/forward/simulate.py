"""Simulation of a scan with known truth, by one of four forward models; the solid one stands in `solid`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np

from tactile_bayes.declarations import Record, as_dict, replace
from tactile_bayes.errors import BadDataError
from tactile_bayes.forward import plane
from tactile_bayes.forward.contact import Head
from tactile_bayes.forward.mesh import REACH_MM
from tactile_bayes.forward.scene import (
    Scene,
    SimulatedScan,
    frame_times,
    head_positions,
    level_kpa,
    normalised_pressure,
    record,
    tissue_truth,
)
from tactile_bayes.forward.solid import frames_at_poses, simulate_solid
from tactile_bayes.forward.tissue import MOST_SEAT, Body, Layers, SceneBody, SolidLump, fat_thickness
from tactile_bayes.geometry import FloatArray
from tactile_bayes.presets import SHOULDERS_INSIDE

Progress = Callable[[int, int], None]
FIDELITIES: Final = ("empirical-gaussian", "empirical", "plane-strain", "solid")
"""A bump's own formula; and for lumps of tissue Eqs 1 to 4, a body in two dimensions, and one in three."""


def simulate(
    scene: Scene,
    *,
    rng: np.random.Generator,
    fidelity: str | None = None,
    head: str | None = None,
    progress: Progress | None = None,
) -> SimulatedScan:
    """Make a scan from a scene: frames at ``k / frame_rate_hz``; poses at ``k / pose_rate_hz``, stamped late by the
    latency.

    The scene's own seed is not used; `rng` is split into independent streams, so that a longer scan of the same seed
    keeps its gains and calibration. `fidelity` is one of `FIDELITIES`, by default the one the scene is written for.
    `head`, one of `presets.HEADS`, says where the shoulders of the scene's head lie: by default as the scene gives them
    in three dimensions, and inside the array in two. `progress` is called with frames done and frames in all; the bumps
    alone are too quick to call it.
    """
    chosen, scene = _prepared(scene, fidelity, head)
    if chosen == "solid":
        return simulate_solid(scene, rng=rng, progress=progress)
    if chosen in ("plane-strain", "empirical"):
        return simulate_plane(scene, rng=rng, fidelity=chosen, shoulders=head or SHOULDERS_INSIDE, progress=progress)
    if head is not None:
        raise BadDataError(
            "--head is given for the empirical-gaussian model, whose bumps do not depend on the head's shoulders",
            way_out="leave --head out, or choose another --fidelity",
        )

    def felt(time_s: FloatArray) -> FloatArray:
        poses, level = head_positions(scene, time_s), level_kpa(scene.background, time_s)
        return _gaussian_frames(scene, *poses, level, share_load=scene.background.load_sharing)

    lumps, background = [as_dict(lump) for lump in scene.lumps], as_dict(scene.background)
    return record(scene, felt=felt, truth={"model": "gaussian", "lumps": lumps, "background": background}, rng=rng)


def _prepared(scene: Scene, fidelity: str | None, head: str | None) -> tuple[str, Scene]:
    """The model of a scene, which must give what the model needs, and the scene with the shoulders of its head placed.

    In two dimensions shoulders inside the array are the section's default, and the scan has the scene's own head.
    """
    chosen = scene.fidelity if fidelity is None else fidelity
    if chosen not in FIDELITIES:
        raise BadDataError(f"fidelity is {chosen!r}", way_out=f"choose {', '.join(FIDELITIES)}")
    if chosen == "empirical-gaussian":
        if scene.solid_lumps or scene.ribs:
            raise BadDataError(
                "lump[0] gives depth_ratio and no amplitude" if scene.solid_lumps else "rib[0] is of tissue",
                way_out="use --fidelity solid, or describe the bump with amplitude, sigma_x_mm and sigma_y_mm",
            )
        return chosen, scene
    if scene.lumps:
        raise BadDataError(
            "lump[0] gives no depth_ratio",
            way_out=f"the {chosen} model needs d_mm and depth_ratio; or use --fidelity empirical-gaussian",
        )
    if head is not None and (chosen == "solid" or head != SHOULDERS_INSIDE):
        scene = replace(scene, head=scene.head.with_shoulders(head))
    return chosen, scene


def felt_at_poses(
    scene: Scene,
    rotation: FloatArray,
    origin_mm: FloatArray,
    *,
    mean_kpa: FloatArray,
    fidelity: str | None = None,
    head: str | None = None,
    progress: Progress | None = None,
) -> FloatArray:
    """Pressure in kPa, (n, rows, columns), that a model's head feels at given poses and mean pressures, without any
    noise.

    Tissue and head of the scene are used; strokes, noise and tracker are not. Rotations (n, 3, 3) and origins (n, 3) of
    the head's face lead from `scanhead` to the scene's `plane`; the rest is as in `simulate`. In two dimensions tilts
    are not followed and depths not used, and a pose beyond the skin that can be solved for is an error.
    """
    chosen, scene = _prepared(scene, fidelity, head)
    if chosen == "empirical-gaussian":
        return _gaussian_frames(scene, rotation, origin_mm, mean_kpa, share_load=True)
    if chosen == "solid":
        return frames_at_poses(scene, rotation, origin_mm, mean_kpa=mean_kpa, progress=progress)[0]
    section = plane_section(scene, chosen, shoulders=head or SHOULDERS_INSIDE)
    place = _column_places(scene, rotation, origin_mm) - section.x_mm
    reach, most = float(np.abs(place).max()) + section.half_face_mm + 1.0, section.most_reach_mm
    if reach > most:
        raise BadDataError(
            f"the head gets {reach:.4g} mm from the lump", way_out=f"the {chosen} model reaches {most:g} mm"
        )
    sections = section.sections(chosen, reach_mm=reach)
    return plane_frames(scene, rotation, origin_mm, mean_kpa, sections, lump_x_mm=section.x_mm, progress=progress)


def _gaussian_frames(
    scene: Scene, rotation: FloatArray, origin_mm: FloatArray, level: FloatArray, *, share_load: bool
) -> FloatArray:
    """(n, rows, columns) kPa of bumps; with `share_load` the frame's mean is the level, without it the background."""
    surface = scene.head.surface_mm()
    # Only x and y of the plane are needed: the first two rows of each pose.
    xy = np.einsum("nij,rcj->nirc", rotation[:, :2], surface) + origin_mm[:, :2, None, None]
    shape = normalised_pressure(scene.lumps, xy[:, 0], xy[:, 1])
    if share_load:
        shape /= shape.mean(axis=(1, 2), keepdims=True)
    return np.asarray(level[:, None, None] * shape)


# --- Scans in two dimensions of one lump of tissue: a cylinder along y under the head, solved or by Eqs 1 to 4.
#
# Nothing changes along y. Each column of taxels feels what a head of the same section feels at that column's place
# across the lump: its profile is repeated along the head. The head stays level in this: tilts are in the poses, not in
# the pressures, and how deep the head sinks is not followed.

Sections = Callable[[FloatArray, FloatArray], FloatArray]
"""Profiles (m, rows) in kPa of a head at (m,) places from the lump's axis, with (m,) mean pressures in kPa."""

# Contact cells per taxel, and how far apart the places of neighbouring sections of one head may be.
_CELLS_A_TAXEL = 6
_APART_MM = 0.25
_FRAMES_AT_ONCE = 100
_SHAPE = "a cylinder along y: each frame's profile across the head is repeated along it"


def simulate_plane(
    scene: Scene,
    *,
    rng: np.random.Generator,
    fidelity: str,
    shoulders: str = SHOULDERS_INSIDE,
    progress: Progress | None = None,
) -> SimulatedScan:
    """Make a scan in two dimensions of a scene that gives tissue: at most one lump, whose section is a circle, and no
    rib.

    ``fidelity="plane-strain"`` solves the head's contact at each place and force; ``"empirical"`` takes Eqs 1 to 4 as
    printed, fitted to two frames of the plane-strain model at the nominal pressure, and scaled with the pressure.
    `shoulders` is one of `presets.HEADS`. `rng` is the instrument's alone; `progress` is called with frames done and
    frames in all.
    """
    section, time = plane_section(scene, fidelity, shoulders=shoulders), frame_times(scene)
    half_mm, most = section.half_face_mm, section.most_reach_mm
    stroke = scene.strokes.half_length_mm + scene.strokes.wander_mm + scene.head.columns * scene.head.pitch_mm / 2
    reach = stroke + abs(section.x_mm) + half_mm + 1.0
    if reach > most:
        raise BadDataError(
            f"the head gets {reach:.4g} mm from the lump (strokes.half_length_mm {scene.strokes.half_length_mm:g}, "
            f"a head {2 * half_mm:g} mm wide)",
            way_out=f"the mesh reaches {most:g} mm: shorten the strokes or narrow the head",
        )
    level, sections = level_kpa(scene.background, time), section.sections(fidelity, reach_mm=reach)
    pressure = plane_frames(
        scene, *head_positions(scene, time), level, sections, lump_x_mm=section.x_mm, progress=progress
    )
    truth = {"model": fidelity, "shape": _SHAPE, "head": shoulders, **tissue_truth(scene)}
    return record(scene, felt=lambda at: pressure[np.searchsorted(time, at)], truth=truth, rng=rng)


class PlaneSection(Record, eq=False):
    """A scene's section across the lump."""

    head: Head  #: Section of the head: shoulders of the scene's `shoulder_mm`, or its `rim_mm` where that is 0.
    pitch_mm: float  #: Width of a taxel, of six of the contact's cells.
    layers: Layers  #: The body without the lump.
    lump: tuple[Body, float] | None  #: Below the skin, with its stiffness ratio; None for nothing.
    x_mm: float  #: Place of the lump's axis.
    mean_kpa: float  #: The nominal pressure.

    @property
    def cell_mm(self) -> float:
        """Width of the contact's cells."""
        return self.pitch_mm / _CELLS_A_TAXEL

    @property
    def half_face_mm(self) -> float:
        """Half the width of the face, in whole cells."""
        return 0.5 * self.cell_mm * len(self.head.sensing_cells(self.cell_mm))

    @property
    def most_reach_mm(self) -> float:
        """How far from the lump's axis the head's edges may get."""
        return REACH_MM + self.layers.thickness_mm

    def sections(self, fidelity: str, *, reach_mm: float) -> Sections:
        """Sections from the contact problem or Eqs 1 to 4, of a head whose edges get so far from the lump's axis.

        Without a lump the section is the same at every place.
        """
        if self.lump is None:
            return lambda _, mean_kpa: self._far(mean_kpa).pressure_kpa
        body, ratio = self.lump
        surface = plane.condense(body, reach_mm=reach_mm, cell_mm=self.cell_mm)
        if fidelity == "plane-strain":
            return lambda x_mm, mean_kpa: self._over(surface, ratio, x_mm, mean_kpa).pressure_kpa
        model, s = self.empirical_model(surface)

        def empirical(x_mm: FloatArray, mean_kpa: FloatArray) -> FloatArray:
            share = mean_kpa / self.mean_kpa
            return np.asarray(share[:, None] * model.surface_pressure(s[None, :], x_mm[:, None]))

        return empirical

    def empirical_model(self, surface: plane.SurfaceCompliance) -> tuple[plane.EmpiricalModel, FloatArray]:
        """Eqs 1 to 4 fitted to what taxels see far from and over the lump, and the taxels' places across the head."""
        assert self.lump is not None
        far, over = self._far(self.mean_kpa), self._over(surface, self.lump[1], np.zeros(1), self.mean_kpa)
        s, d, half = over.s_mm, surface.body.d_mm, self.head.half_width_mm
        return plane.fit_empirical(s, far.at(0.0), over.at(0.0), d_mm=d, half_width_mm=half), s

    def _far(self, mean_kpa: float | FloatArray) -> plane.LineFrames:
        far = plane.press_layers(self.layers, head=self.head, mean_kpa=mean_kpa, cell_mm=self.cell_mm)
        return far.as_taxels(self.pitch_mm)

    def _over(
        self, surface: plane.SurfaceCompliance, ratio: float, x_mm: FloatArray, mean_kpa: float | FloatArray
    ) -> plane.LineFrames:
        return plane.press(surface, ratio, x_mm, head=self.head, mean_kpa=mean_kpa).as_taxels(self.pitch_mm)


def plane_section(scene: Scene, fidelity: str, *, shoulders: str = SHOULDERS_INSIDE) -> PlaneSection:
    """Prepare the section of a scene; a key that two dimensions cannot follow is an error."""
    many = "a rib" if scene.ribs else f"{len(scene.solid_lumps)} lumps" if len(scene.solid_lumps) > 1 else ""
    if many:
        raise BadDataError(
            f"the scene has {many}", way_out=f"the {fidelity} model has one lump and no rib; use --fidelity solid"
        )
    body = scene.body or SceneBody()
    fat = fat_thickness(body, scene.solid_lumps)
    layers = Layers(fat, body.thickness_mm, body.fat_kpa, body.gland_ratio, body.nu)
    lump = _cylinder(scene.solid_lumps[0], body, fat, fidelity) if scene.solid_lumps else None
    x_mm = scene.solid_lumps[0].x_mm if scene.solid_lumps else 0.0
    width = scene.head.rows * scene.head.pitch_mm
    if shoulders == SHOULDERS_INSIDE and scene.head.rim_mm > width / 2:
        raise BadDataError(
            f"head.rim_mm is {scene.head.rim_mm:g}",
            way_out=f"in two dimensions the rim is cut into the array: give at most {width / 2:g} mm",
        )
    head, level = scene.head.section(shoulders), scene.background.mean_kpa
    return PlaneSection(head, scene.head.pitch_mm, layers, lump, x_mm, level)


def _cylinder(lump: SolidLump, body: SceneBody, fat_mm: float, fidelity: str) -> tuple[Body, float]:
    """Body and stiffness ratio of the lump's section."""
    if lump.height_mm is not None and lump.height_mm != lump.d_mm:
        raise BadDataError(
            f"lump[0].height_mm is {lump.height_mm:g}",
            way_out=f"the {fidelity} model has a circle: leave it out, or use --fidelity solid",
        )
    seat = (fat_mm - lump.depth_mm) / (lump.d_mm / 2)
    if not -1e-9 <= seat <= MOST_SEAT + 1e-9:
        raise BadDataError(
            f"the gland lies {fat_mm:g} mm deep, which seats lump[0] at {seat:.3g}",
            way_out=f"the {fidelity} model has seats from 0 to {MOST_SEAT:g}; use --fidelity solid",
        )
    seat = float(np.clip(seat, 0.0, MOST_SEAT))
    try:
        section = Body(lump.d_mm, lump.depth_ratio, seat, body.thickness_mm, body.fat_kpa, body.gland_ratio, body.nu)
    except BadDataError as error:
        raise BadDataError(f"lump[0]: {error.what}", way_out=error.way_out) from None
    return section, lump.stiffness_ratio


def _column_places(scene: Scene, rotation: FloatArray, origin_mm: FloatArray) -> FloatArray:
    """(n, columns) place of each column of taxels across the scene's `plane`."""
    along = (np.arange(scene.head.columns) - (scene.head.columns - 1) / 2) * scene.head.pitch_mm
    return np.asarray(origin_mm[:, :1] + rotation[:, 0, 1, None] * along)


def plane_frames(
    scene: Scene,
    rotation: FloatArray,
    origin_mm: FloatArray,
    level_kpa: FloatArray,
    sections: Sections,
    *,
    lump_x_mm: float,
    progress: Progress | None = None,
) -> FloatArray:
    """(n, rows, columns) kPa that the taxels feel at (n,) poses and mean pressures, before any noise.

    A head turned about the normal has its columns at different places across the lump. Sections are computed no more
    than 0.25 mm apart and interpolated between.
    """
    place = _column_places(scene, rotation, origin_mm) - lump_x_mm
    pressure = np.zeros((len(level_kpa), scene.head.rows, scene.head.columns))
    pressed = np.flatnonzero(level_kpa > 0)
    for chunk in np.array_split(pressed, len(pressed) // _FRAMES_AT_ONCE or 1) if len(pressed) else ():
        ends = [(float(place[i].min()), float(place[i].max())) for i in chunk]
        across = [np.linspace(low, high, 1 + int(np.ceil((high - low) / _APART_MM - 1e-9))) for low, high in ends]
        many = [len(x) for x in across]
        profile = sections(np.concatenate(across), np.repeat(level_kpa[chunk], many))
        for i, x, mine in zip(chunk, across, np.split(profile, np.cumsum(many)[:-1]), strict=True):
            pressure[i] = [np.interp(place[i], x, taxel) for taxel in mine.T]
        if progress is not None:
            progress(int(chunk[-1]) + 1, len(level_kpa))
    return pressure
