"""Projection of each frame's taxels onto the cells of a map."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import floor
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_bayes.geometry import FloatArray, apply, inverse
from tactile_bayes.mapping.cells import refuse_vast
from tactile_bayes.mapping.poses import FramePoses
from tactile_bayes.scan import HeadGeometry

IntArray = NDArray[np.int64]

# Directions (in cells per mm), taxels (mm about their middle) and shifts (in cells) are rounded to these steps, 2e-5 mm
# at the most on the plane. Their products and sums then fit float64 exactly up to 2^15 cells, so that a matrix product
# of any width, a loop and a compiled loop put every reading into the same cell.
_TURN_STEP = 2.0**-22
_TAXEL_STEP_MM = 2.0**-15
_SHIFT_STEP = 2.0**-30
_MATRIX_STEPS = np.array([_TURN_STEP, _TURN_STEP, _TURN_STEP, _SHIFT_STEP])[:, None]
# The same for a frame's eight numbers, with what is added to them.
_NUMBERS = 2 * (3 * ((_TURN_STEP, 0.0),) + ((_SHIFT_STEP, 0.5),))
_MOST_CELLS = 2**15
# Floats from here on are whole numbers.
_WHOLE = 2.0**52


@dataclass(frozen=True, slots=True, eq=False)
class ProjectedTaxels:
    """The taxels of a head to be projected.

    Parameters
    ----------
    place_mm : (3, k) array
        Their centres in the tracker's axes, about their middle.
    place_and_one : (4, k) array
        The same over a row of ones, with which a shift is one more term of a product.
    reach_mm : (4,) array
        How far they reach from their middle along each axis, and 0.
    """

    place_mm: FloatArray
    place_and_one: FloatArray = field(init=False)
    reach_mm: FloatArray = field(init=False)

    def __post_init__(self) -> None:
        ones = np.ones(self.place_mm.shape[1])
        object.__setattr__(self, "place_and_one", np.vstack([self.place_mm, ones]))
        object.__setattr__(self, "reach_mm", np.append(np.abs(self.place_mm).max(axis=1, initial=0.0), 0.0))


@dataclass(frozen=True, slots=True, eq=False)
class Projection:
    """Frames' taxels on the lattice of cells: ``uv = turn @ taxel + shift``, frame by frame; the cell is floor(uv).

    The face of the head is curved, so its true surface is used: two rows of each frame's rotation against three
    coordinates of each taxel.

    Parameters
    ----------
    taxels
        What is projected.
    matrix : (n, 2, 4) array
        First two rows of the rotation from the tracker to the plane, in cells a mm; and beside them where the taxels'
        middle lies on the lattice, in cells. Half a cell is added, so that cell k is centred on k.
    cell_mm
        Side of a cell.
    """

    taxels: ProjectedTaxels
    matrix: FloatArray
    cell_mm: float

    def __len__(self) -> int:
        return len(self.matrix)

    @property
    def turn(self) -> FloatArray:
        """(n, 2, 3) rotations, in cells per mm."""
        return self.matrix[:, :, :3]

    @property
    def shift(self) -> FloatArray:
        """(n, 2) shifts, in cells."""
        return self.matrix[:, :, 3]

    def part(self, frames: slice | NDArray[np.intp] | NDArray[np.bool_]) -> Projection:
        """A subset of the frames."""
        return Projection(self.taxels, self.matrix[frames], self.cell_mm)

    def moved(self, cells: FloatArray) -> Projection:
        """Shift each frame by (n, 2) cells, or all by (2,); whole multiples of the shifts' step."""
        matrix = self.matrix.copy()
        matrix[:, :, 3] += cells
        return Projection(self.taxels, matrix, self.cell_mm)

    def block(self) -> tuple[tuple[int, int], tuple[int, int]]:
        """First row and column, and shape, of the block of the lattice that contains every reading.

        Raises
        ------
        BadDataError
            When the block would be so wide that cells could not be told exactly.
        """
        left, top, right, bottom = self._ends_of_one() if len(self) == 1 else self._ends()
        columns, rows = right - left + 1, bottom - top + 1
        if max(abs(left), abs(top), columns, rows) > _MOST_CELLS:
            refuse_vast(int(rows + abs(top)), int(columns + abs(left)), self.cell_mm, most=_MOST_CELLS)
        return (int(top), int(left)), (int(rows), int(columns))

    def _ends(self) -> list[float]:
        """First column and row, and last column and row, that a reading can fall in."""
        # Of two dimensions, for which numpy has a fast product.
        reach = (np.abs(self.matrix).reshape(-1, 4) @ self.taxels.reach_mm).reshape(-1, 2)
        first = np.floor((self.shift - reach).min(axis=0)).tolist()
        return [*first, *np.floor((self.shift + reach).max(axis=0)).tolist()]

    def _ends_of_one(self) -> list[float]:
        """As `_ends` for one frame, with plain numbers: sums and products of whole steps are exact either way."""
        x, y, z, _ = self.taxels.reach_mm.tolist()
        shifts = [(abs(a) * x + abs(b) * y + abs(c) * z, shift) for a, b, c, shift in self.matrix[0].tolist()]
        return [*(floor(shift - reach) for reach, shift in shifts), *(floor(shift + reach) for reach, shift in shifts)]

    def flat(self, first: tuple[int, int], shape: tuple[int, int]) -> IntArray:
        """(n, k) indices of the readings' cells in a block given by its first row and column and its shape."""
        if len(self) == 1:
            matrix = self.matrix[0].copy()
            matrix[0, 3] -= first[1]
            matrix[1, 3] -= first[0]
            column, row = (matrix @ self.taxels.place_and_one).astype(np.int64)
            row *= shape[1]
            row += column
            return np.asarray(row[None])
        # Not negative inside the block: cutting off is floor. Blocks have at most 2^30 cells, so 32 bits hold an index.
        row = self._coordinate(1, first[0]).astype(np.int32)
        row *= np.int32(shape[1])
        row += self._coordinate(0, first[1]).astype(np.int32)
        return row.astype(np.int64)

    def _coordinate(self, axis: int, first: int) -> FloatArray:
        rows = self.matrix[:, axis].copy()
        rows[:, 3] -= first
        position: FloatArray = rows @ self.taxels.place_and_one
        return position


class Projector:
    """The constants of a projection, the same for all frames.

    Parameters
    ----------
    taxels : (rows, columns) bool array
        Taxels to project, in row order.
    """

    def __init__(
        self, head: HeadGeometry, *, plane_from_base: FloatArray, taxels: NDArray[np.bool_], cell_mm: float
    ) -> None:
        self._rows = plane_from_base[:2, :3].tolist()
        self._origin_mm = inverse(plane_from_base)[:3, 3]
        self._origin = self._origin_mm.tolist()
        self._cell_mm = cell_mm
        tracker_from_head = inverse(head.scanhead_from_tracker)
        middle = apply(tracker_from_head, head.surface_mm.reshape(-1, 3).mean(axis=0))
        centres = apply(tracker_from_head, head.surface_mm[taxels]) - middle
        self._middle = middle.tolist()
        steps = np.rint(centres * (1.0 / _TAXEL_STEP_MM)).T
        self._taxels = ProjectedTaxels(np.ascontiguousarray(steps * _TAXEL_STEP_MM))

    def at(self, poses: FramePoses) -> Projection:
        """Project the frames at `poses` onto the cells of the plane."""
        if len(poses.position_mm) == 1:
            return Projection(self._taxels, self._matrix_of_one(poses), self._cell_mm)
        offset = poses.position_mm - self._origin_mm  # first of all: bases may lie far away
        matrix = np.array(self._columns(poses.rotation.transpose(1, 2, 0).copy(), offset.T.copy())).reshape(2, 4, -1)
        matrix /= self._cell_mm
        matrix[:, 3] += 0.5
        matrix *= 1.0 / _MATRIX_STEPS
        np.rint(matrix, out=matrix)
        matrix *= _MATRIX_STEPS
        return Projection(self._taxels, np.ascontiguousarray(matrix.transpose(2, 0, 1)), self._cell_mm)

    def _matrix_of_one(self, poses: FramePoses) -> FloatArray:
        """(1, 2, 4) matrix of one frame with plain numbers, quicker for one and equal to the bit."""
        offset = [p - o for p, o in zip(poses.position_mm[0].tolist(), self._origin, strict=True)]
        found, cell_mm = [], self._cell_mm
        columns = self._columns(poses.rotation[0].tolist(), offset)
        for value, (step, half) in zip(columns, _NUMBERS, strict=True):
            steps = (value / cell_mm + half) / step
            found.append((round(steps) if -_WHOLE < steps < _WHOLE else steps) * step)
        return np.array(found).reshape(1, 2, 4)

    def _columns(self, r: Any, offset: Any) -> list[Any]:
        """The eight numbers of each frame's matrix, mm.

        Parameters
        ----------
        r, offset
            3 x 3 rotation and 3 coordinates of one frame as numbers, or of many as arrays. Term by term and not by
            matrix products: the bits of a frame do not hang on how many others there are.
        """
        (x, y, z), (m0, m1, m2), columns = offset, self._middle, []
        for a, b, c in self._rows:
            t0, t1, t2 = (a * r[0][j] + b * r[1][j] + c * r[2][j] for j in range(3))
            columns += [t0, t1, t2, a * x + b * y + c * z + (t0 * m0 + t1 * m1 + t2 * m2)]
        return columns


def yaw_deg(head: HeadGeometry, rotation: FloatArray, *, plane_from_base: FloatArray) -> FloatArray:
    """(n,) angle of the head's x axis on the plane from the plane's x axis, degrees."""
    axis = inverse(head.scanhead_from_tracker)[:3, 0]
    on_plane = (rotation * axis).sum(axis=2) @ plane_from_base[:2, :3].T
    yaw: FloatArray = np.degrees(np.arctan2(on_plane[:, 1], on_plane[:, 0]))
    return yaw
