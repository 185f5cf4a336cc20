"""Poses of the head at the frames' times, interpolated from the tracker's."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tactile_bayes.geometry import FloatArray, rotation_from_quaternion, unroll_quaternion_signs
from tactile_bayes.scan import TrackerPoses

MAX_POSE_GAP_MS = 50.0


@dataclass(frozen=True, slots=True, eq=False)
class FramePoses:
    """The pose of the tracker's sensor at each frame.

    Parameters
    ----------
    position_mm : (n, 3) array
        Tracker sensor in `base`.
    rotation : (n, 3, 3) array
        ``p_base = position + rotation @ p_tracker``.
    known : (n,) bool array
        False where the tracker said nothing close enough; position and rotation are then meaningless but finite.
    """

    position_mm: FloatArray
    rotation: FloatArray
    known: NDArray[np.bool_]

    def part(self, frames: slice | NDArray[np.bool_] | NDArray[np.intp]) -> FramePoses:
        """A subset of the frames."""
        return FramePoses(self.position_mm[frames], self.rotation[frames], self.known[frames])


def distinct_poses(poses: TrackerPoses) -> TrackerPoses:
    """Poses without repeats, with quaternion signs unrolled and times strictly rising.

    Trackers repeat their last sample when asked faster than they measure. A repeat is an old pose with a new time
    stamp: it would drag the head behind, so only the first of a run stays.
    """
    quaternion = unroll_quaternion_signs(poses.quaternion_wxyz)
    new = np.ones(len(poses), dtype=bool)
    new[1:] = (np.diff(poses.position_mm, axis=0) != 0).any(axis=1) | (np.diff(quaternion, axis=0) != 0).any(axis=1)
    new[1:] &= np.diff(poses.time_s) > 0
    return TrackerPoses(poses.time_s[new], poses.position_mm[new], quaternion[new])


def poses_at(
    poses: TrackerPoses, time_s: FloatArray, *, latency_ms: float = 0.0, max_gap_ms: float = MAX_POSE_GAP_MS
) -> FramePoses:
    """Interpolate the poses to the frames' times.

    Parameters
    ----------
    time_s : (n,) array
        Times of the frames on the poses' clock.
    latency_ms
        By how much a pose's stamp is late: the pose belongs to ``time_s - latency``.
    max_gap_ms
        Frames between two poses further apart than this are not known. Nor are frames before the first pose or
        after the last: a head is not extrapolated.

    Notes
    -----
    Positions are interpolated linearly, rotations by normalised linear interpolation of neighbouring quaternions,
    which departs from the great arc by less than (angle between poses)^3 / 60: nothing at tracker rates.
    """
    fresh = distinct_poses(poses)
    moments_s = fresh.time_s - latency_ms / 1000.0
    if len(fresh) == 0:
        nothing = np.zeros((len(time_s), 3))
        return FramePoses(nothing, np.broadcast_to(np.eye(3), (len(time_s), 3, 3)), np.zeros(len(time_s), dtype=bool))
    after = np.clip(np.searchsorted(moments_s, time_s, side="left"), 0, len(fresh) - 1)
    before = np.clip(after - 1, 0, None)
    exact = moments_s[after] == time_s
    inside = (time_s >= moments_s[0]) & (time_s <= moments_s[-1])
    near = moments_s[after] - moments_s[before] <= max_gap_ms / 1000.0 + 1e-9
    return FramePoses(
        _interpolated(time_s, moments_s, fresh.position_mm),
        rotation_from_quaternion(_interpolated(time_s, moments_s, fresh.quaternion_wxyz)),
        exact | (inside & near),
    )


def _interpolated(time_s: FloatArray, known_s: FloatArray, values: FloatArray) -> FloatArray:
    return np.stack([np.interp(time_s, known_s, column) for column in values.T], axis=1)
