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
_CHUNK = 512
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
        n = self.count
        centroid = np.array(self.position / n, dtype=np.float64) * _POSITION_STEP
        between = (n * self.product - np.outer(self.position, self.position)) / (n * n)
        covariance = np.array(between, dtype=np.float64) * _POSITION_STEP**2
        covariance += np.array(self.spread / n, dtype=np.float64) * _SPREAD_STEP
        head_x, head_z = np.array(self.axes / n, dtype=np.float64) * _AXIS_STEP
        if not np.linalg.norm(head_x) > _LEAST_RESULTANT:
            raise BadDataError(
                f"the head was turned all round (resultant of its x axis {np.linalg.norm(head_x):.2f} of 1)",
                way_out="keep its direction while scanning; map parts with one direction apart",
            )
        return fit_plane(centroid, covariance, head_x=head_x, head_z=head_z)


def head_moments(head: HeadGeometry, poses: FramePoses) -> HeadMoments:
    """Moments of the taxel centres at the known ones of `poses`.

    Every taxel counts, working or not: where the head was does not depend on what it read.
    """
    position, rotation = poses.position_mm[poses.known], poses.rotation[poses.known]
    tracker_from_head = inverse(head.scanhead_from_tracker)
    taxels = apply(tracker_from_head, head.surface_mm.reshape(-1, 3))
    middle = taxels.mean(axis=0)
    covariance = (taxels - middle).T @ (taxels - middle) / len(taxels)
    centres = _whole((position + (rotation * middle).sum(axis=2)) / _POSITION_STEP)
    spread = np.einsum("fij,jk,flk->fil", rotation, covariance, rotation)
    axes = np.einsum("fij,jk->fki", rotation, tracker_from_head[:3, [0, 2]])
    moments = HeadMoments.none()
    for start in range(0, len(centres), _CHUNK):
        part = slice(start, start + _CHUNK)
        first, product = _position_moments(centres[part])
        moments = moments + HeadMoments(
            len(centres[part]), first, product, _sum(spread[part] / _SPREAD_STEP), _sum(axes[part] / _AXIS_STEP)
        )
    return moments


def _whole(values: FloatArray) -> WholeArray:
    whole: WholeArray = np.rint(values).astype(np.int64).astype(object)
    return whole


def _sum(values: FloatArray) -> WholeArray:
    total: WholeArray = np.rint(values).astype(np.int64).sum(axis=0).astype(object)
    return total


def _position_moments(centres: WholeArray) -> tuple[WholeArray, WholeArray]:
    """Sum and sum of outer products, exactly: about the first centre in int64 where that cannot overflow."""
    n, reference = len(centres), centres[0]
    offset = centres - reference
    if max(abs(offset.max()), abs(offset.min())) < 2**26:  # 1 m: 512 squares stay below 2^61
        offset = offset.astype(np.int64)
    first = offset.sum(axis=0).astype(object)
    product = (offset.T @ offset).astype(object)
    cross = np.outer(first, reference)
    return first + n * reference, product + cross + cross.T + n * np.outer(reference, reference)
