"""The best-fit plane of a motion from moments that add exactly, in any order and any parts (paper step i)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_bayes.errors import BadDataError
from tactile_bayes.geometry import FloatArray, Plane, apply, fit_plane, inverse
from tactile_bayes.mapping.poses import FramePoses
from tactile_bayes.scan import HeadGeometry

# Positions are counted in steps of 15 nm, directions and areas in steps of 2^-30 and 2^-24 mm^2: far below any
# tracker, and whole numbers add without rounding.
_POSITION_STEP = 2.0**-16
_SPREAD_STEP = 2.0**-24
_AXIS_STEP = 2.0**-30
_CHUNK = 1024
# Steps from one place up to 2^26 (1 m), and 2^10 frames: squares stay below 2^62. Beyond 2^52 steps floats have gaps.
_FAR_STEPS = 2**26
_FRAMES_AT_ONCE = 2**10
_FARTHEST_STEPS = 2.0**52
_STEPS = np.array([_POSITION_STEP, _AXIS_STEP, _AXIS_STEP, _SPREAD_STEP, _SPREAD_STEP, _SPREAD_STEP])[:, None]
# Mean directions shorter than this (of 1) are no direction: the head was turned by over 90 degrees (SD).
_LEAST_RESULTANT = 0.3

# Arrays of Python's integers, which never overflow.
WholeArray = NDArray[Any]


@dataclass(frozen=True, slots=True, eq=False)
class HeadMoments:
    """First two moments of all taxel centres over frames, in whole steps; add two with ``+``.

    Parameters
    ----------
    count
        Frames.
    position : (3,) whole numbers
        Sum over frames of the mean taxel centre in `base`.
    product : (3, 3) whole numbers
        Sum of its outer products.
    spread : (3, 3) whole numbers
        Sum of the covariance of the taxels about their mean.
    axes : (2, 3) whole numbers
        Sums of the head's x axis and of its normal.
    """

    count: int
    position: WholeArray
    product: WholeArray
    spread: WholeArray
    axes: WholeArray

    def __add__(self, other: HeadMoments) -> HeadMoments:
        return HeadMoments(
            self.count + other.count,
            self.position + other.position,
            self.product + other.product,
            self.spread + other.spread,
            self.axes + other.axes,
        )

    @classmethod
    def none(cls) -> HeadMoments:
        """The moments of no frame."""
        return cls(0, _whole(np.zeros(3)), _whole(np.zeros((3, 3))), _whole(np.zeros((3, 3))), _whole(np.zeros((2, 3))))

    def plane(self) -> Plane:
        """Best-fit plane of the taxel centres.

        Raises
        ------
        BadDataError
            When the head was turned all round, so that its x axis has no mean direction; or see
            `tactile_bayes.geometry.fit_plane`.
        """
        n, position, product = self.count, self.position.tolist(), self.product.tolist()
        # In Python's integers up to the last division: positions far from the base lose nothing.
        between = [[(n * product[i][j] - position[i] * position[j]) / (n * n) for j in range(3)] for i in range(3)]
        spread = [[value / n for value in row] for row in self.spread.tolist()]
        head_x, head_z = np.array([[value / n for value in row] for row in self.axes.tolist()]) * _AXIS_STEP
        resultant = float(np.sqrt(head_x @ head_x))
        if not resultant > _LEAST_RESULTANT:
            raise BadDataError(
                f"the head was turned all round (resultant of its x axis {resultant:.2f} of 1)",
                way_out="keep its direction while scanning; map parts with one direction apart",
            )
        return fit_plane(
            np.array([value / n for value in position]) * _POSITION_STEP,
            np.array(between) * _POSITION_STEP**2 + np.array(spread) * _SPREAD_STEP,
            head_x=head_x,
            head_z=head_z,
        )


class MomentSums:
    """Moments of one head that grow frame by frame, in 64-bit numbers for as long as they cannot overflow.

    Parameters
    ----------
    head
        Every taxel counts, working or not: where the head was does not depend on what it read.
    """

    def __init__(self, head: HeadGeometry) -> None:
        tracker_from_head = inverse(head.scanhead_from_tracker)
        taxels = apply(tracker_from_head, head.surface_mm.reshape(-1, 3))
        middle = taxels.mean(axis=0)
        covariance = (taxels - middle).T @ (taxels - middle) / len(taxels)
        self._vectors = np.column_stack([middle, tracker_from_head[:3, [0, 2]], covariance])[:, :, None]
        self._whole = HeadMoments.none()
        self._begin(np.zeros((3, 1), dtype=np.int64))

    def _begin(self, reference: NDArray[np.int64]) -> None:
        """Count positions from the (3, 1) `reference` on."""
        self._reference, self._count = reference, 0
        # Sums of the position, of the two axes and of the spread, a column each.
        self._sums, self._product = np.zeros((3, 6), dtype=np.int64), np.zeros((3, 3), dtype=np.int64)

    def add(self, poses: FramePoses) -> None:
        """Add the frames of which the pose is known."""
        rotation, position = poses.rotation, poses.position_mm
        if not poses.known.all():
            rotation, position = rotation[poses.known], position[poses.known]
        for start in range(0, len(rotation), _CHUNK):
            self._add(rotation[start : start + _CHUNK], position[start : start + _CHUNK])

    def _add(self, rotation: FloatArray, position: FloatArray) -> None:
        # Term by term and not by matrix products: the bits of a frame do not hang on how many others there are.
        # Frames along the last axis, along which numpy is fast.
        r, vectors = np.ascontiguousarray(rotation.transpose(1, 2, 0)), self._vectors
        turned = r[:, 0, None] * vectors[0]
        turned += r[:, 1, None] * vectors[1]
        turned += r[:, 2, None] * vectors[2]
        values = turned.copy()
        values[:, 0] += position.T
        values[:, 3:] = turned[:, 3, None] * r[:, 0]
        values[:, 3:] += turned[:, 4, None] * r[:, 1]
        values[:, 3:] += turned[:, 5, None] * r[:, 2]
        values *= 1.0 / _STEPS
        np.rint(values, out=values)
        farthest = float(np.abs(values[:, 0]).max())
        if farthest > _FARTHEST_STEPS:
            raise BadDataError(
                f"the head was {farthest * _POSITION_STEP:.3g} mm from the tracker's base",
                way_out="check the unit of the positions (mm)",
            )
        self._add_steps(values.astype(np.int64), rotation, position)

    def _add_steps(self, steps: NDArray[np.int64], rotation: FloatArray, position: FloatArray) -> None:
        """Add (3, 6, n) whole steps of as many poses."""
        number = steps.shape[2]
        if not self._count:
            self._begin(steps[:, 0, :1].copy())
        if self._count + number > _FRAMES_AT_ONCE or self._far(steps):
            self._whole = self.moments()
            self._begin(steps[:, 0, :1].copy())
            if self._far(steps):
                self._add_apart(rotation, position)
                return
        steps[:, 0] -= self._reference
        self._count += number
        self._sums += steps.sum(axis=2)
        self._product += steps[:, 0] @ steps[:, 0].T

    def _far(self, steps: NDArray[np.int64]) -> bool:
        """Whether a position lies so far from the reference that squares could overflow."""
        return bool(np.abs(steps[:, 0] - self._reference).max() >= _FAR_STEPS)

    def _add_apart(self, rotation: FloatArray, position: FloatArray) -> None:
        """One by one: these lie too far apart to be counted from one place."""
        for one in range(len(rotation)):
            self._add(rotation[one : one + 1], position[one : one + 1])

    def moments(self) -> HeadMoments:
        """All so far, from the tracker's base."""
        n, place, product = self._count, self._reference[:, 0].tolist(), self._product.tolist()
        first, axes, spread = self._sums[:, 0].tolist(), self._sums[:, 1:3].T.tolist(), self._sums[:, 3:].tolist()
        position = [first[i] + n * place[i] for i in range(3)]
        outer = [
            [product[i][j] + first[i] * place[j] + place[i] * first[j] + n * place[i] * place[j] for j in range(3)]
            for i in range(3)
        ]
        now = HeadMoments(n, *(np.array(part, dtype=object) for part in (position, outer, spread, axes)))
        return self._whole + now if self._whole.count else now


def head_moments(head: HeadGeometry, poses: FramePoses) -> HeadMoments:
    """Moments of the taxel centres at the known ones of `poses`."""
    sums = MomentSums(head)
    sums.add(poses)
    return sums.moments()


def _whole(values: FloatArray) -> WholeArray:
    whole: WholeArray = np.rint(values).astype(np.int64).astype(object)
    return whole
