"""Three-dimensional scans of lumps of tissue in a layered body, solved frame by frame."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import numpy as np

from tactile_bayes.forward.axisymmetric import CondensedLump, Tissue, condense_lump
from tactile_bayes.forward.body import HeadFace, head_face
from tactile_bayes.forward.instrument import SimulatedScan, frame_times, head_positions, level_kpa, record
from tactile_bayes.forward.layers import LayeredBody
from tactile_bayes.forward.mesh import LumpGeometry
from tactile_bayes.forward.scene import Head, Scene, refuse_bumps, tissue_truth
from tactile_bayes.forward.solid import PlacedLump, SolidHead, skin_perturbation, solid_head
from tactile_bayes.forward.tissue import SceneBody, SolidLump, fat_thickness
from tactile_bayes.geometry import FloatArray

Progress = Callable[[int, int], None]


def simulate_solid(scene: Scene, *, rng: np.random.Generator, progress: Progress | None = None) -> SimulatedScan:
    """Make a scan of a scene that gives tissue.

    Parameters
    ----------
    scene
        Its Gaussian lumps must be none; without a body it takes the default one. Ribs are rows of balls.
    rng
        Used by the instrument alone: the tissue has no chance in it.
    progress
        Called with frames done and frames in all.

    Notes
    -----
    The mean over the taxels follows the scene's background, as an examiner holds it by the tone; where the head sinks
    less, over a lump, its pose says so. Tilts are the scene's. Each frame is at rest: nothing slides, creeps or lags.
    """
    refuse_bumps(scene, "solid")
    time = frame_times(scene)
    pressure, depth = solid_frames(scene, time, progress=progress)
    return record(
        scene,
        felt=lambda at: pressure[np.searchsorted(time, at)],
        depth=lambda at: np.interp(at, time, depth),
        truth={"model": "solid", "head": scene.head.shoulders, **tissue_truth(scene)},
        rng=rng,
    )


def solid_frames(
    scene: Scene, time_s: FloatArray, *, progress: Progress | None = None
) -> tuple[FloatArray, FloatArray]:
    """Pressures on the head at (n,) times, without noise.

    Returns
    -------
    pressure_kpa : (n, rows, columns) array
    depth_mm : (n,) array
        z of the head's apex in the scene's `plane`.
    """
    rotation, origin = head_positions(scene, time_s)
    level = level_kpa(scene.background, time_s)
    return frames_at_poses(scene, rotation, origin, mean_kpa=level, progress=progress)


def frames_at_poses(
    scene: Scene,
    rotation: FloatArray,
    origin_mm: FloatArray,
    *,
    mean_kpa: FloatArray,
    progress: Progress | None = None,
) -> tuple[FloatArray, FloatArray]:
    """What the scene's head feels at given poses and levels, without noise; returns as `solid_frames`.

    Parameters
    ----------
    rotation : (n, 3, 3) array
        From `scanhead` to the scene's `plane`.
    origin_mm : (n, 3) array
        Of the head's face; its depth is not used, the level decides it.
    mean_kpa : (n,) array
        Mean over the taxels.
    """
    body = scene.body or SceneBody()
    head, lumps = _head(scene.head, body, fat_thickness(body, scene.solid_lumps)), _placed(scene)
    count = len(mean_kpa)
    pressure = np.empty((count, scene.head.rows, scene.head.columns))
    depth, touching = np.empty(count), None
    for i in range(count):
        frame = head.frame(
            lumps,
            rotation=rotation[i],
            x_mm=float(origin_mm[i, 0]),
            y_mm=float(origin_mm[i, 1]),
            mean_kpa=float(mean_kpa[i]),
            touching=touching,
        )
        pressure[i], depth[i], touching = frame.pressure_kpa, frame.depth_mm, frame.contact.touching
        if progress is not None:
            progress(i + 1, count)
    return pressure, depth


def face_of(head: Head) -> HeadFace:
    """Face of the head that can touch the skin; shoulders inside the array leave no room for a rim."""
    rim = 0.0 if head.shoulder_mm > 0 else head.rim_mm
    return head_face(head.surface_mm(), pitch_mm=head.pitch_mm, radius_mm=head.radius_mm, rim_mm=rim)


def layers_of(body: SceneBody, fat_mm: float) -> LayeredBody:
    """The layered body without lumps."""
    return LayeredBody((body.fat_kpa, body.fat_kpa * body.gland_ratio), (fat_mm, body.thickness_mm - fat_mm), body.nu)


def condensed_lump(lump: SolidLump, body: SceneBody, fat_mm: float) -> CondensedLump:
    """Condense the body around a lump; the lump's stiffness and place do not matter here."""
    geometry = LumpGeometry(lump.d_mm / 2, lump.vertical_mm / 2, lump.depth_mm, fat_mm, body.thickness_mm)
    return _condensed(geometry, Tissue(body.fat_kpa, body.gland_ratio, body.nu))


# Exams of one body, and lumps of one size and depth in it, share these; a scene has few.
_BODIES_KEPT = 8


@lru_cache(maxsize=_BODIES_KEPT)
def _condensed(geometry: LumpGeometry, tissue: Tissue) -> CondensedLump:
    return condense_lump(geometry, tissue)


@lru_cache(maxsize=_BODIES_KEPT)
def _head(head: Head, body: SceneBody, fat_mm: float) -> SolidHead:
    return solid_head(face_of(head), layers_of(body, fat_mm))


def _placed(scene: Scene) -> list[PlacedLump]:
    """The scene's lumps with their places."""
    body = scene.body or SceneBody()
    fat = fat_thickness(body, scene.solid_lumps)
    placed = []
    for lump in scene.stiff_balls:
        around = condensed_lump(lump, body, fat)
        change = skin_perturbation(around, lump.stiffness_ratio * body.fat_kpa, square_mm=scene.head.pitch_mm)
        placed.append(PlacedLump(change, lump.x_mm, lump.y_mm))
    return placed
