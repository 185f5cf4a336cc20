"""Simulation of a scan with known truth, by one of four forward models."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np

from tactile_bayes.declarations import as_dict, replace
from tactile_bayes.errors import BadDataError
from tactile_bayes.forward.instrument import SimulatedScan, head_positions, level_kpa, record
from tactile_bayes.forward.plane_scan import frames_at_poses as plane_frames_at_poses
from tactile_bayes.forward.plane_scan import simulate_plane
from tactile_bayes.forward.scene import Scene, normalised_pressure, refuse_bumps
from tactile_bayes.forward.solid import frames_at_poses, simulate_solid
from tactile_bayes.geometry import FloatArray
from tactile_bayes.presets import SHOULDERS_INSIDE

FIDELITIES: Final = ("empirical-gaussian", "empirical", "plane-strain", "solid")
"""A bump's own formula; and for lumps of tissue Eqs 1 to 4, a body in two dimensions, and one in three."""


def simulate(
    scene: Scene,
    *,
    rng: np.random.Generator,
    fidelity: str | None = None,
    head: str | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> SimulatedScan:
    """Make a scan from a scene: frames at ``k / frame_rate_hz``; poses at ``k / pose_rate_hz``, stamped late by the
    latency.

    The scene's own seed is not used; `rng` is split into independent streams, so that a longer scan of the same seed
    keeps its gains and calibration. `fidelity` is one of `FIDELITIES`, by default the one the scene is written for.
    `head`, one of `presets.HEADS`, says where the shoulders of the scene's head lie: by default as the scene gives them
    in three dimensions, and inside the array in two. `progress` is called with frames done and frames in all; the bumps
    alone are too quick to call it.
    """
    chosen = scene.fidelity if fidelity is None else fidelity
    if chosen not in FIDELITIES:
        raise BadDataError(f"fidelity is {chosen!r}", way_out=f"choose {', '.join(FIDELITIES)}")
    if head is not None:
        if chosen == "empirical-gaussian":
            raise BadDataError(
                "--head is given for the empirical-gaussian model, whose bumps do not depend on the head's shoulders",
                way_out="leave --head out, or choose another --fidelity",
            )
        # In two dimensions that is the section's default, and the scan has the scene's own head.
        if chosen == "solid" or head != SHOULDERS_INSIDE:
            scene = replace(scene, head=scene.head.with_shoulders(head))
    if chosen == "solid":
        return simulate_solid(scene, rng=rng, progress=progress)
    if chosen in ("plane-strain", "empirical"):
        return simulate_plane(scene, rng=rng, fidelity=chosen, shoulders=head or SHOULDERS_INSIDE, progress=progress)
    if scene.solid_lumps or scene.ribs:
        raise _tissue_for_bumps(scene)
    return _simulate_gaussian(scene, rng=rng)


def _tissue_for_bumps(scene: Scene) -> BadDataError:
    named = "lump[0] gives depth_ratio and no amplitude" if scene.solid_lumps else "rib[0] is of tissue"
    return BadDataError(
        named, way_out="use --fidelity solid, or describe the bump with amplitude, sigma_x_mm and sigma_y_mm"
    )


def felt_at_poses(
    scene: Scene,
    rotation: FloatArray,
    origin_mm: FloatArray,
    *,
    mean_kpa: FloatArray,
    fidelity: str | None = None,
    head: str | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> FloatArray:
    """Pressure in kPa, (n, rows, columns), that a model's head feels at given poses and mean pressures, without any
    noise.

    Tissue and head of the scene are used; strokes, noise and tracker are not. Rotations (n, 3, 3) and origins (n, 3) of
    the head's face lead from `scanhead` to the scene's `plane`; the rest is as in `simulate`.
    """
    chosen = scene.fidelity if fidelity is None else fidelity
    if chosen not in FIDELITIES:
        raise BadDataError(f"fidelity is {chosen!r}", way_out=f"choose {', '.join(FIDELITIES)}")
    if chosen == "empirical-gaussian":
        if scene.solid_lumps or scene.ribs:
            raise _tissue_for_bumps(scene)
        return _gaussian_frames(scene, rotation, origin_mm, mean_kpa, share_load=True)
    refuse_bumps(scene, chosen)
    if head is not None and (chosen == "solid" or head != SHOULDERS_INSIDE):
        scene = replace(scene, head=scene.head.with_shoulders(head))
    if chosen == "solid":
        return frames_at_poses(scene, rotation, origin_mm, mean_kpa=mean_kpa, progress=progress)[0]
    return plane_frames_at_poses(
        scene,
        rotation,
        origin_mm,
        mean_kpa=mean_kpa,
        fidelity=chosen,
        shoulders=head or SHOULDERS_INSIDE,
        progress=progress,
    )


def _simulate_gaussian(scene: Scene, *, rng: np.random.Generator) -> SimulatedScan:
    truth = {
        "model": "gaussian",
        "lumps": [as_dict(lump) for lump in scene.lumps],
        "background": as_dict(scene.background),
    }
    return record(scene, felt=lambda time_s: _pressure(scene, time_s), truth=truth, rng=rng)


def _pressure(scene: Scene, time_s: FloatArray) -> FloatArray:
    """(n, rows, columns) kPa at (n,) times."""
    rotation, origin = head_positions(scene, time_s)
    level = level_kpa(scene.background, time_s)
    return _gaussian_frames(scene, rotation, origin, level, share_load=scene.background.load_sharing)


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
