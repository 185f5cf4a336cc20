"""The best-fit plane of a scan's poses (paper step i)."""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce
from math import sqrt
from operator import add, mul
from typing import Any

import numpy as np

from tactile_bayes.declarations import Record
from tactile_bayes.errors import BadDataError
from tactile_bayes.geometry import (
    BoolArray,
    FloatArray,
    IndexArray,
    Plane,
    apply,
    fit_plane,
    inverse,
    rotation_from_quaternion,
    unroll_quaternion_signs,
)
from tactile_bayes.scans import HeadGeometry, TrackerPoses

# --- Poses of the head at the frames' times, interpolated from the tracker's.

MAX_POSE_GAP_MS = 50.0


class FramePoses(Record, eq=False):
    """The pose of the tracker's sensor at each frame."""

    position_mm: FloatArray  #: (n, 3) array: Tracker sensor in `base`.
    rotation: FloatArray  #: (n, 3, 3) array: ``p_base = position + rotation @ p_tracker``.
    known: BoolArray
    """(n,) bool array: False where the tracker said nothing close enough; position and rotation are then meaningless
    but finite."""

    def part(self, frames: slice | BoolArray | IndexArray) -> FramePoses:
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
    """Interpolate the poses to the (n,) times of the frames on the poses' clock.

    A pose stamped t was measured at ``t - latency``. Frames between two poses further apart than `max_gap_ms` have no
    pose; nor have frames before the first pose or after the last: a head is not extrapolated. Positions are
    interpolated linearly, rotations by normalised linear interpolation of neighbouring quaternions, which departs from
    the great arc by less than (angle between poses)^3 / 60: nothing at tracker rates.
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


# --- Best-fit plane of a motion from moments that add exactly, in any order and any parts (paper step i).

# Positions are counted in steps of 15 nm, directions and areas in steps of 2^-30 and 2^-24 mm^2: far below any
# tracker, and whole numbers add without rounding.
_POSITION_STEP = 2.0**-16
_SPREAD_STEP = 2.0**-24
_AXIS_STEP = 2.0**-30
_STEPS = np.repeat([_POSITION_STEP, _SPREAD_STEP, _AXIS_STEP], [3, 9, 6])[:, None]
_PER_STEP: tuple[float, ...] = tuple((1.0 / _STEPS)[:, 0].tolist())
# Steps from one place up to 2^26 (1 m), and 2^10 frames: squares stay below 2^62. Beyond 2^52 steps floats have gaps.
_FAR_STEPS = 2**26
_FRAMES_AT_ONCE = 2**10
_FARTHEST_STEPS = 2.0**52
# Fewer frames are quicker as plain numbers.
_FEW_FRAMES = 8
# Mean directions shorter than this (of 1) are no direction: the head was turned by over 90 degrees (SD).
_LEAST_RESULTANT = 0.3

# Python's integers, which never overflow.
Whole = tuple[int, ...]


class HeadMoments(Record, eq=False):
    """First two moments of all taxel centres over frames, in whole steps; add two with ``+``."""

    sums: Whole
    """28 whole numbers: Frames (1), and sums over them: of the mean taxel centre in `base` (3), of its outer products
    (9, row by row), of the covariance of the taxels about their mean (9), of the head's x axis and of its normal (6).
    """

    def __add__(self, other: HeadMoments) -> HeadMoments:
        return HeadMoments(_sum(self.sums, other.sums))

    @classmethod
    def none(cls) -> HeadMoments:
        """Moments of no frame."""
        return cls((0,) * 28)

    @property
    def count(self) -> int:
        """Number of frames."""
        return self.sums[0]

    def plane(self) -> Plane:
        """Best-fit plane of the taxel centres, see `tactile_bayes.geometry.fit_plane`.

        A head that was turned all round, so that its x axis has no mean direction, is a `BadDataError`.
        """
        n, x = self.count, self.sums[1:4]
        # In Python's integers up to the last division: positions far from the base lose nothing. Products are
        # symmetric.
        xx, xy, xz, _, yy, yz, _, _, zz = self.sums[4:13]
        pairs = ((xx, 0, 0), (xy, 0, 1), (xz, 0, 2), (yy, 1, 1), (yz, 1, 2), (zz, 2, 2))
        between = [(n * product - x[i] * x[j]) / (n * n) * _POSITION_STEP**2 for product, i, j in pairs]
        spread = [value / n * _SPREAD_STEP for value in self.sums[13:22]]
        covariance = [between[k] + value for k, value in zip((0, 1, 2, 1, 3, 4, 2, 4, 5), spread, strict=True)]
        axes = [value / n * _AXIS_STEP for value in self.sums[22:]]
        resultant = sqrt(sum(value * value for value in axes[:3]))
        if not resultant > _LEAST_RESULTANT:
            raise BadDataError(
                f"the head was turned in all directions (resultant of its x axis {resultant:.2f} of 1)",
                way_out="keep its direction while scanning, or map the parts of one direction separately",
            )
        return fit_plane(
            np.array([value / n * _POSITION_STEP for value in x]),
            np.array(covariance).reshape(3, 3),
            head_x=np.array(axes[:3]),
            head_z=np.array(axes[3:]),
        )


class MomentSums:
    """Moments of one head, added frame by frame.

    Every taxel counts, working or not: where the head was does not depend on what it read.
    """

    def __init__(self, head: HeadGeometry) -> None:
        tracker_from_head = inverse(head.scanhead_from_tracker)
        taxels = apply(tracker_from_head, head.surface_mm.reshape(-1, 3))
        middle = taxels.mean(axis=0)
        covariance = (taxels - middle).T @ (taxels - middle) / len(taxels)
        self._middle, self._across = middle.tolist(), covariance.T.tolist()
        self._axes = tracker_from_head[:3, [0, 2]].T.tolist()
        self._sums = HeadMoments.none()

    def add(self, poses: FramePoses) -> None:
        """Add the frames whose pose is known.

        A head so far from the tracker's base that steps would have gaps is a `BadDataError`.
        """
        rotation, position = poses.rotation, poses.position_mm
        if not poses.known.all():
            rotation, position = rotation[poses.known], position[poses.known]
        if len(rotation) == 1:
            self._sums += self._one(rotation[0].tolist(), position[0].tolist())
            return
        for start in range(0, len(rotation), _FRAMES_AT_ONCE):
            part = slice(start, start + _FRAMES_AT_ONCE)
            self._sums += self._of(rotation[part], position[part])

    def moments(self) -> HeadMoments:
        """Moments so far, about the tracker's base."""
        return self._sums

    def _of(self, rotation: FloatArray, position: FloatArray) -> HeadMoments:
        if len(rotation) < _FEW_FRAMES:
            return self._one_by_one(rotation, position)
        steps = np.array(self._values(rotation.transpose(1, 2, 0).copy(), position.T.copy()))
        steps *= 1.0 / _STEPS
        np.rint(steps, out=steps)
        _refuse_far(float(np.abs(steps[:3]).max()))
        whole = steps.astype(np.int64)
        reference = whole[:3, :1].copy()
        whole[:3] -= reference
        if np.abs(whole[:3]).max() >= _FAR_STEPS:
            return self._one_by_one(rotation, position)
        n, place, sums = len(rotation), reference[:, 0].tolist(), whole.sum(axis=1).tolist()
        first, product = sums[:3], (whole[:3] @ whole[:3].T).tolist()
        outer = (
            product[i][j] + first[i] * place[j] + place[i] * first[j] + n * place[i] * place[j]
            for i in range(3)
            for j in range(3)
        )
        return HeadMoments((n, *_sum(first, [n * x for x in place]), *outer, *sums[3:]))

    def _one_by_one(self, rotation: FloatArray, position: FloatArray) -> HeadMoments:
        return reduce(add, map(self._one, rotation.tolist(), position.tolist()))

    def _one(self, r: list[list[float]], p: list[float]) -> HeadMoments:
        values = self._values(r, p)
        _refuse_far(max(map(abs, values[:3])) / _POSITION_STEP)
        x, y, z, *others = map(round, map(mul, values, _PER_STEP))
        xy, xz, yz = x * y, x * z, y * z
        return HeadMoments((1, x, y, z, x * x, xy, xz, xy, y * y, yz, xz, yz, z * z, *others))

    def _values(self, r: Any, p: Any) -> list[Any]:
        """Mean taxel centre (3), covariance of the taxels (9) and axes (6) in `base`, from rotation `r` and position
        `p`.

        Of one frame as numbers, or of many as arrays. Term by term and not by matrix products: the bits of a frame do
        not depend on how many others there are.
        """
        m0, m1, m2 = self._middle
        centre = [x + (a * m0 + b * m1 + c * m2) for x, (a, b, c) in zip(p, r, strict=True)]
        turned = [[a * x + b * y + c * z for x, y, z in self._across] for a, b, c in r]
        spread = [x * a + y * b + z * c for x, y, z in turned for a, b, c in r]
        axes = [a * x + b * y + c * z for x, y, z in self._axes for a, b, c in r]
        return centre + spread + axes


def _refuse_far(steps: float) -> None:
    if not steps <= _FARTHEST_STEPS:
        raise BadDataError(
            f"the head was {steps * _POSITION_STEP:.3g} mm from the tracker's base",
            way_out="check the unit of the positions (mm)",
        )


def _sum(one: Sequence[int], other: Sequence[int]) -> Whole:
    return tuple(map(add, one, other))


def head_moments(head: HeadGeometry, poses: FramePoses) -> HeadMoments:
    """Moments of the taxel centres at the known ones of `poses`."""
    sums = MomentSums(head)
    sums.add(poses)
    return sums.moments()
