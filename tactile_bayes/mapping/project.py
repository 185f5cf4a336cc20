"""From a frame's pose to the cell that each of its taxels falls in."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from tactile_bayes.geometry import FloatArray, apply, inverse
from tactile_bayes.mapping.cells import refuse_vast
from tactile_bayes.mapping.poses import FramePoses
from tactile_bayes.scan import HeadGeometry

IntArray = NDArray[np.int64]

# Directions (in cells a mm), taxels (mm about their middle) and shifts (in cells) are rounded to these steps, 2e-5 mm
# at the most on the plane. Their products and sums then fit float64 exactly up to 2^15 cells, so that a matrix product
# of any width, a loop and a compiled loop put every reading into the same cell.
_TURN_STEP = 2.0**-22
_TAXEL_STEP_MM = 2.0**-15
_SHIFT_STEP = 2.0**-30
_MOST_CELLS = 2**15


@dataclass(frozen=True, slots=True, eq=False)
class Projection:
    """Frames' taxels on the lattice of cells: ``uv = turn @ taxel + shift``, frame by frame; the cell is floor(uv).

    The face of the head is curved, so its true surface is used: two rows of each frame's rotation against three
    coordinates of each taxel.

    Parameters
    ----------
    taxels_mm : (3, k) array
        Taxel centres in the tracker's axes, about their middle.
    turn : (n, 2, 3) array
        First two rows of the rotation from the tracker to the plane, in cells a mm.
    shift : (n, 2) array
        Where the taxels' middle lies on the lattice, in cells; half a cell is added, so that cell k is centred on k.
    cell_mm
        Side of a cell.
    extent_mm : (3,) array
        How far the taxels reach from their middle along each axis; found from them when it is not given.
    """

    taxels_mm: FloatArray
    turn: FloatArray
    shift: FloatArray
    cell_mm: float
    extent_mm: FloatArray = field(default_factory=lambda: np.zeros(3))

    def __post_init__(self) -> None:
        if not self.extent_mm.any():
            object.__setattr__(self, "extent_mm", np.abs(self.taxels_mm).max(axis=1, initial=0.0))

    def __len__(self) -> int:
        return len(self.turn)

    def part(self, frames: slice | NDArray[np.intp] | NDArray[np.bool_]) -> Projection:
        """Some of the frames."""
        return Projection(self.taxels_mm, self.turn[frames], self.shift[frames], self.cell_mm, self.extent_mm)

    def block(self) -> tuple[tuple[int, int], tuple[int, int]]:
        """First row and column, and shape, of a block of the lattice that holds every reading.

        Raises
        ------
        BadDataError
            When the block would be so wide that cells could not be told exactly.
        """
        reach = np.abs(self.turn) @ self.extent_mm
        left, top = np.floor((self.shift - reach).min(axis=0)).tolist()
        right, bottom = np.floor((self.shift + reach).max(axis=0)).tolist()
        columns, rows = right - left + 1, bottom - top + 1
        if max(abs(left), abs(top), columns, rows) > _MOST_CELLS:
            refuse_vast(int(rows + abs(top)), int(columns + abs(left)), self.cell_mm, most=_MOST_CELLS)
        return (int(top), int(left)), (int(rows), int(columns))

    def flat(self, first: tuple[int, int], shape: tuple[int, int]) -> IntArray:
        """(n, k) indices of the readings' cells in a block given by its first row and column and its shape."""
        row = self._coordinate(1, first[0]).astype(np.int64)  # not negative inside the block: cutting off is floor
        row *= shape[1]
        row += self._coordinate(0, first[1]).astype(np.int64)
        return row

    def _coordinate(self, axis: int, first: int) -> FloatArray:
        position: FloatArray = self.turn[:, axis] @ self.taxels_mm
        position += (self.shift[:, axis] - first)[:, None]
        return position


class Projector:
    """What of a projection does not change from frame to frame.

    Parameters
    ----------
    taxels : (rows, columns) bool array
        Taxels to project, in row order.
    """

    def __init__(
        self, head: HeadGeometry, *, plane_from_base: FloatArray, taxels: NDArray[np.bool_], cell_mm: float
    ) -> None:
        self._rows = np.ascontiguousarray(plane_from_base[:2, :3])
        self._origin_mm = inverse(plane_from_base)[:3, 3]
        self._cell_mm = cell_mm
        tracker_from_head = inverse(head.scanhead_from_tracker)
        self._middle = apply(tracker_from_head, head.surface_mm.reshape(-1, 3).mean(axis=0))
        centres = apply(tracker_from_head, head.surface_mm[taxels]) - self._middle
        self._taxels = np.ascontiguousarray(_rounded(centres, _TAXEL_STEP_MM).T)
        self._extent = np.abs(self._taxels).max(axis=1, initial=0.0)

    def at(self, poses: FramePoses) -> Projection:
        """Projection of the frames at `poses` onto the cells of the plane."""
        # Term by term and not by matrix products: the bits of a frame do not hang on how many others there are.
        rows, rotation, middle = self._rows, poses.rotation[:, None], self._middle
        turn = rows[:, 0, None] * rotation[:, :, 0]
        turn += rows[:, 1, None] * rotation[:, :, 1]
        turn += rows[:, 2, None] * rotation[:, :, 2]
        offset = (poses.position_mm - self._origin_mm)[:, :, None]  # first of all: bases may lie far away
        shift = rows[:, 0] * offset[:, 0] + rows[:, 1] * offset[:, 1] + rows[:, 2] * offset[:, 2]
        shift += turn[:, :, 0] * middle[0] + turn[:, :, 1] * middle[1] + turn[:, :, 2] * middle[2]
        return Projection(
            self._taxels,
            _rounded(turn / self._cell_mm, _TURN_STEP),
            _rounded(shift / self._cell_mm + 0.5, _SHIFT_STEP),
            self._cell_mm,
            self._extent,
        )


def _rounded(values: FloatArray, step: float) -> FloatArray:
    whole: FloatArray = np.rint(values * (1.0 / step)) * step
    return whole


def yaw_deg(head: HeadGeometry, rotation: FloatArray, *, plane_from_base: FloatArray) -> FloatArray:
    """(n,) angle of the head's x axis on the plane from the plane's x axis, degrees."""
    axis = inverse(head.scanhead_from_tracker)[:3, 0]
    on_plane = (rotation * axis).sum(axis=2) @ plane_from_base[:2, :3].T
    yaw: FloatArray = np.degrees(np.arctan2(on_plane[:, 1], on_plane[:, 0]))
    return yaw
