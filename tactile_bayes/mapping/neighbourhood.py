"""Frames near the mass, to which the paper fits its plane."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tactile_bayes.errors import BadDataError
from tactile_bayes.geometry import FloatArray, Plane, apply, inverse
from tactile_bayes.mapping.accumulate import add_all
from tactile_bayes.mapping.frames import SelectedFrames
from tactile_bayes.mapping.plane import HeadMoments, head_moments
from tactile_bayes.mapping.poses import FramePoses
from tactile_bayes.mapping.smoothing import smooth
from tactile_bayes.mapping.source import sources_of
from tactile_bayes.mapping.tactile_map import FEW_READINGS

# The mass is looked for in cells of this side: its place matters to a few mm.
_CELL_MM = 2.0
_WIDER = 1.5


def find_mass(selections: Sequence[SelectedFrames], plane: Plane) -> FloatArray:
    """(2,) place of the highest point of the smoothed map on `plane`, mm."""
    sources = sources_of(list(selections), plane_from_base=plane.plane_from_base, cell_mm=_CELL_MM)
    levels = [source.selection.level_kpa[source.selection.used] for source in sources]
    sums = add_all(sources, levels, cell_mm=_CELL_MM).trimmed()
    count, total = smooth(sums.count), smooth(sums.total)
    mean = np.divide(total, count, out=np.full_like(total, -np.inf), where=count >= FEW_READINGS)
    row, column = np.unravel_index(int(mean.argmax()), mean.shape)
    return np.array([sums.x_mm()[column], sums.y_mm()[row]])


def local_plane(
    selections: Sequence[SelectedFrames], plane: Plane, *, radius_mm: float | None
) -> tuple[Plane, dict[str, float]]:
    """Best-fit plane of the frames near the mass.

    Parameters
    ----------
    radius_mm
        Frames whose array is centred within it of the mass are used; None takes half the diagonal of the array, within
        which an array reaches the mass, and widens it while those frames span no plane.

    Returns
    -------
    plane, figures
        ``plane_radius_mm`` and ``plane_frames``.

    Raises
    ------
    BadDataError
        When no frame lies within a given radius, or they span no plane.
    """
    mass = find_mass(selections, plane)
    radius = radius_mm or max(_half_diagonal(part) for part in selections)
    while True:
        try:
            return _plane_within(selections, plane, mass, radius)
        except BadDataError:
            if radius_mm is not None or radius > 500.0:
                raise
            radius *= _WIDER


def _half_diagonal(part: SelectedFrames) -> float:
    extent = np.ptp(part.scan.head.surface_mm[..., :2].reshape(-1, 2), axis=0)
    return float(np.hypot(*extent)) / 2


def _plane_within(
    selections: Sequence[SelectedFrames], plane: Plane, mass: FloatArray, radius: float
) -> tuple[Plane, dict[str, float]]:
    moments = HeadMoments.none()
    for part in selections:
        lever = inverse(part.scan.head.scanhead_from_tracker)
        middle = apply(lever, part.scan.head.surface_mm.reshape(-1, 3).mean(axis=0))
        centre = part.poses.position_mm + (part.poses.rotation * middle).sum(axis=2)
        distance = np.linalg.norm(apply(plane.plane_from_base, centre)[:, :2] - mass, axis=1)
        near = FramePoses(part.poses.position_mm, part.poses.rotation, part.used & (distance <= radius))
        moments = moments + head_moments(part.scan.head, near)
    if not moments.count:
        raise BadDataError(f"no frame lies within {radius:g} mm of the mass", way_out="give a larger --plane-radius-mm")
    return moments.plane(), {"plane_radius_mm": float(radius), "plane_frames": float(moments.count)}
