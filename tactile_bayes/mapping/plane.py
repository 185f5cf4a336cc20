"""The best-fit plane of a scan's poses (paper step i)."""

from __future__ import annotations

from math import sqrt
from operator import add

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

    def places_mm(self, point_mm: FloatArray) -> FloatArray:
        """(n, 3) places in `base` of a (3,) point that is given in the tracker's axes."""
        return np.asarray(self.position_mm + (self.rotation * point_mm).sum(axis=2))


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
# Steps from one place up to 2^26 (1 m), and 2^10 frames: squares stay below 2^62. Beyond 2^52 steps floats have gaps.
_FAR_STEPS = 2**26
_FRAMES_AT_ONCE = 2**10
_FARTHEST_STEPS = 2.0**52
# Mean directions shorter than this (of 1) are no direction: the head was turned by over 90 degrees (SD).
_LEAST_RESULTANT = 0.3


class HeadMoments(Record, eq=False):
    """First two moments of all taxel centres over frames, in whole steps; add two with ``+``."""

    sums: tuple[int, ...] = (0,) * 28
    """28 whole numbers, Python's, which never overflow: frames (1), and sums over them: of the mean taxel centre in
    `base` (3), of its outer products (9, row by row), of the covariance of the taxels about their mean (9), of the
    head's x axis and of its normal (6)."""

    def __add__(self, other: HeadMoments) -> HeadMoments:
        return HeadMoments(tuple(map(add, self.sums, other.sums)))

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


def head_moments(head: HeadGeometry, poses: FramePoses) -> HeadMoments:
    """Moments of the taxel centres at the known ones of `poses`.

    Every taxel counts, working or not: where the head was does not depend on what it read. A head so far from the
    tracker's base that steps would have gaps is a `BadDataError`.
    """
    taxels = apply(inverse(head.scanhead_from_tracker), head.surface_mm.reshape(-1, 3))
    moments = HeadMoments()
    for start in range(0, len(poses.known), _FRAMES_AT_ONCE):
        part = poses.part(slice(start, start + _FRAMES_AT_ONCE))
        if part.known.any():
            moments += _moments(head, taxels, part.part(part.known))
    return moments


def _moments(head: HeadGeometry, taxels: FloatArray, poses: FramePoses) -> HeadMoments:
    """Of at most `_FRAMES_AT_ONCE` frames."""
    values = _values(head, taxels, poses.rotation.transpose(1, 2, 0).copy(), poses.position_mm.T.copy())
    steps = np.array(values) * (1.0 / _STEPS)
    np.rint(steps, out=steps)
    farthest = float(np.abs(steps[:3]).max())
    if not farthest <= _FARTHEST_STEPS:
        raise BadDataError(
            f"the head was {farthest * _POSITION_STEP:.3g} mm from the tracker's base",
            way_out="check the unit of the positions (mm)",
        )
    whole = steps.astype(np.int64)
    reference = whole[:3, :1].copy()
    place = whole[:3] - reference
    if np.abs(place).max() >= _FAR_STEPS:
        place = place.astype(object)  # Python's integers, slow, and without an end
    n, at = len(poses.known), reference[:, 0].tolist()
    first, product = place.sum(axis=1).tolist(), (place @ place.T).tolist()
    outer = (
        product[i][j] + first[i] * at[j] + at[i] * first[j] + n * at[i] * at[j] for i in range(3) for j in range(3)
    )
    centre = (one + n * x for one, x in zip(first, at, strict=True))
    return HeadMoments((n, *centre, *outer, *whole[3:].sum(axis=1).tolist()))


def _values(head: HeadGeometry, taxels: FloatArray, r: FloatArray, p: FloatArray) -> list[FloatArray]:
    """Mean taxel centre (3), covariance of the taxels (9) and axes (6) in `base` at (3, 3, n) rotations `r` and (3, n)
    positions `p`.

    Term by term and not by matrix products: the bits of a frame do not depend on how many others there are.
    """
    middle = taxels.mean(axis=0)
    across = ((taxels - middle).T @ (taxels - middle) / len(taxels)).T.tolist()
    m0, m1, m2 = middle.tolist()
    centre = [x + (a * m0 + b * m1 + c * m2) for x, (a, b, c) in zip(p, r, strict=True)]
    turned = [[a * x + b * y + c * z for x, y, z in across] for a, b, c in r]
    spread = [x * a + y * b + z * c for x, y, z in turned for a, b, c in r]
    directions = inverse(head.scanhead_from_tracker)[:3, [0, 2]].T.tolist()
    axes = [a * x + b * y + c * z for x, y, z in directions for a, b, c in r]
    return centre + spread + axes
