"""Tracker position error from frame to frame, estimated from the poses; it blurs the map.

A bump of width sigma is mapped with sigma^2 + s^2, s the SD of a frame's place along that axis. Only errors that
neighbouring poses do not share can be told from the head's motion, and only those are in the figures.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tactile_bayes.geometry import FloatArray, Plane, apply, inverse, rotation_from_quaternion
from tactile_bayes.mapping.frames import SelectedFrames
from tactile_bayes.mapping.poses import distinct_poses
from tactile_bayes.presets import POSE_NOISE

LEAST_POSES = 50
MOST_MM = 1.5
"""Poses further than this from the path through their neighbours are no tracker's noise: the head itself jumps."""
KEPT = 0.9
"""Share of the departures that count, the smallest: at turning points the head itself leaves the path."""
# A normal distribution's mean square within its inner nine tenths, over its variance: 1 - 2 c phi(c) / 0.9.
_INNER_SQUARE = 0.6230155


def pose_noise_figures(selections: Sequence[SelectedFrames], plane: Plane, *, cell_mm: float) -> dict[str, float]:
    """The figures `POSE_NOISE` of the frames used; empty where the tracker gave too few poses.

    The noise is what a pose departs by from the cubic through the two poses before and the two after it.
    """
    found = [one for part in selections if (one := _Places.of(part, plane)) is not None]
    if not found:
        return {}
    frames = np.array([one.frames for one in found])
    variance = np.average([one.variance for one in found], axis=0, weights=frames)
    if variance.max() > MOST_MM**2:
        return {}
    head = selections[0].scan.head
    sides = [taxels * head.pitch_mm for taxels in head.shape]
    independent = sum(one.independent for one in found) / float(frames.sum())
    figures = [*np.sqrt(variance), *sides, (head.pitch_mm / cell_mm) ** 2 * independent]
    return {name: float(f"{value:.4g}") for name, value in zip(POSE_NOISE, figures, strict=True)}


@dataclass(frozen=True, slots=True, eq=False)
class _Places:
    """Position errors of a scan's used frames.

    Parameters
    ----------
    variance : (2,) array
        Of a frame's place along the plane's axes, mm^2.
    frames
        Used ones.
    independent
        Frames with errors of their own whose mean would be known as well: those between two poses share theirs.
    """

    variance: FloatArray
    frames: int
    independent: float

    @classmethod
    def of(cls, part: SelectedFrames, plane: Plane) -> _Places | None:
        """Estimate for one scan; None where it has too few poses."""
        frames_s = part.scan.frames.time_s[part.used]
        poses = distinct_poses(part.scan.poses)
        if len(poses) < LEAST_POSES or not len(frames_s):
            return None
        lever = inverse(part.scan.head.scanhead_from_tracker)[:3, 3]
        apex = poses.position_mm + rotation_from_quaternion(poses.quaternion_wxyz) @ lever
        departure, weight = _departures(poses.time_s, apply(plane.plane_from_base, apex)[:, :2])
        square = np.sort(departure**2 / weight[:, None], axis=0)
        noise = square[: int(KEPT * len(square))].mean(axis=0) / _INNER_SQUARE
        factor, independent = _interpolation(frames_s, poses.time_s)
        return cls(noise * factor, len(frames_s), independent)


def _departures(time_s: FloatArray, place_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(n - 4, 2) distances of positions from a cubic through their neighbours, and their variance over a position's."""
    n = len(time_s) - 4
    near = [time_s[k : k + n] - time_s[2 : 2 + n] for k in (0, 1, 3, 4)]
    departure, variance = place_mm[2 : 2 + n].copy(), np.ones(n)
    for i, k in enumerate((0, 1, 3, 4)):
        share = np.ones(n)
        for j, other in enumerate(near):
            if j != i:
                share *= other / (other - near[i])
        departure -= share[:, None] * place_mm[k : k + n]
        variance += share**2
    return departure, variance


def _interpolation(frames_s: FloatArray, poses_s: FloatArray) -> tuple[float, float]:
    """Mean variance of linear interpolation between independent poses at the frames' times, over a pose's.

    And how many independent frames of that variance have a mean of the same variance as these have.
    """
    place = np.interp(frames_s, poses_s, np.arange(len(poses_s)))
    before = np.minimum(place.astype(np.int64), len(poses_s) - 2)
    share = place - before
    factor = float(np.mean(share**2 + (1.0 - share) ** 2))
    taken = np.bincount(before, 1.0 - share, len(poses_s)) + np.bincount(before + 1, share, len(poses_s))
    return factor, float(len(frames_s) ** 2 * factor / np.sum(taken**2))
