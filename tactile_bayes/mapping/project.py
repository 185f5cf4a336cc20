"""From a frame's pose to where each of its taxels lies on the plane."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tactile_bayes.geometry import FloatArray, apply, inverse
from tactile_bayes.mapping.poses import FramePoses
from tactile_bayes.scan import HeadGeometry


@dataclass(frozen=True, slots=True, eq=False)
class Projection:
    """Frames' taxels on the plane: ``xy = turn @ taxel + shift``, frame by frame.

    The face of the head is curved, so its true surface is used: two rows of each frame's rotation against three
    coordinates of each taxel. Products are added term by term rather than by a matrix product, whose rounding depends
    on how many frames it is given at once.

    Parameters
    ----------
    taxels_mm : (k, 3) array
        Taxel centres in the tracker's frame.
    turn : (n, 2, 3) array
        First two rows of the rotation from the tracker to the plane.
    shift_mm : (n, 2) array
        Where the tracker lies on the plane.
    """

    taxels_mm: FloatArray
    turn: FloatArray
    shift_mm: FloatArray

    def xy(self, frames: slice | NDArray[np.intp]) -> tuple[FloatArray, FloatArray]:
        """x and y in mm, each (frames, k), of the given frames' taxels."""
        turn, shift = self.turn[frames], self.shift_mm[frames]
        x, y = (self._coordinate(turn[:, axis], shift[:, axis]) for axis in (0, 1))
        return x, y

    def _coordinate(self, turn: FloatArray, shift: FloatArray) -> FloatArray:
        position = turn[:, 0, None] * self.taxels_mm[:, 0]
        position += turn[:, 1, None] * self.taxels_mm[:, 1]
        position += turn[:, 2, None] * self.taxels_mm[:, 2]
        position += shift[:, None]
        return position


def project(
    head: HeadGeometry, poses: FramePoses, *, plane_from_base: FloatArray, taxels: NDArray[np.bool_]
) -> Projection:
    """Projection of the chosen taxels of all frames onto the plane.

    Parameters
    ----------
    taxels : (rows, columns) bool array
        Taxels to project, in row order.
    """
    rows = plane_from_base[:2, :3]
    origin_mm = inverse(plane_from_base)[:3, 3]  # subtracted first: bases may lie far away
    offset = poses.position_mm - origin_mm
    turn = (rows[None, :, :, None] * poses.rotation[:, None, :, :]).sum(axis=2)
    shift = (rows[None, :, :] * offset[:, None, :]).sum(axis=2)
    centres = apply(inverse(head.scanhead_from_tracker), head.surface_mm[taxels])
    return Projection(centres, turn, shift)


def yaw_deg(head: HeadGeometry, rotation: FloatArray, *, plane_from_base: FloatArray) -> FloatArray:
    """(n,) angle of the head's x axis on the plane from the plane's x axis, degrees."""
    axis = inverse(head.scanhead_from_tracker)[:3, 0]
    on_plane = (rotation * axis).sum(axis=2) @ plane_from_base[:2, :3].T
    yaw: FloatArray = np.degrees(np.arctan2(on_plane[:, 1], on_plane[:, 0]))
    return yaw
