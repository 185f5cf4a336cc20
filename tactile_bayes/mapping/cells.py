"""Sums of readings in square cells that are the same to the bit in any order and any parts."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from tactile_bayes.errors import BadDataError
from tactile_bayes.geometry import FloatArray

IntArray = NDArray[np.int64]

# Values are counted in steps of 2^-12 and clipped to +-64, so 2^16 squares of a call sum exactly in float64 (2^53).
VALUE_STEP = 2.0**-12
VALUE_LIMIT = 64.0
LIMIT_STEPS = VALUE_LIMIT / VALUE_STEP
READINGS_PER_CALL = 2**16
# Count and sum of a call travel as one number, count x 2^36 + sum: 2^16 sums of at most 2^18 steps stay below 2^34.
_PACK_BITS = 36
MAX_CELLS = 2**22
_GROWTH = 16


def _no_cells() -> IntArray:
    return np.zeros((0, 0), dtype=np.int64)


def cell_index(position_mm: FloatArray, cell_mm: float) -> IntArray:
    """Index of the nearest cell; cell k is centred on k x cell_mm, so maps of one cell size share a lattice."""
    index: IntArray = np.floor(position_mm / cell_mm + 0.5).astype(np.int64)
    return index


@dataclass(slots=True, eq=False)
class CellSums:
    """Count, sum and sum of squares of the readings in each cell, in whole steps.

    Parameters
    ----------
    cell_mm
        Side of a cell.
    first : (2,) tuple
        Row (y) and column (x) index of ``count[0, 0]`` on the lattice.
    count, total, square : (ny, nx) int64 arrays
        Readings, their sum in `VALUE_STEP` and the sum of their squares in `VALUE_STEP` squared.
    clipped
        Readings beyond `VALUE_LIMIT` that were added at the limit.
    negative
        Readings below 0, which noise about nothing gives. They are added as they are: cut off at 0, they would lift
        the mean.
    """

    cell_mm: float
    first: tuple[int, int] = (0, 0)
    count: IntArray = field(default_factory=_no_cells)
    total: IntArray = field(default_factory=_no_cells)
    square: IntArray = field(default_factory=_no_cells)
    clipped: int = 0
    negative: int = 0

    def add(self, x_mm: FloatArray, y_mm: FloatArray, value: FloatArray) -> None:
        """Add readings at positions on the plane; arrays of one shape, all finite, of at most `READINGS_PER_CALL`.

        Raises
        ------
        BadDataError
            When the readings lie so far apart that the map would have over `MAX_CELLS` cells.
        """
        if value.size > READINGS_PER_CALL:
            raise ValueError(f"{value.size} readings in one call; sums are exact up to {READINGS_PER_CALL}")
        if value.size:
            self.add_cells(cell_index(y_mm, self.cell_mm), cell_index(x_mm, self.cell_mm), value)

    def add_cells(self, row: IntArray, column: IntArray, value: FloatArray) -> None:
        """Add readings whose cells are known already."""
        first = (int(row.min()), int(column.min()))
        shape = (int(row.max()) - first[0] + 1, int(column.max()) - first[1] + 1)
        steps = np.rint(value * (1.0 / VALUE_STEP))
        self.add_steps(first, shape, (row - first[0]) * shape[1] + (column - first[1]), steps)

    def add_steps(
        self,
        first: tuple[int, int],
        shape: tuple[int, int],
        flat: IntArray,
        steps: FloatArray,
        *,
        bounded: bool = False,
    ) -> None:
        """Add at most `READINGS_PER_CALL` values in whole steps; overwrites `steps`.

        Parameters
        ----------
        first, shape
            Block of the lattice that holds all of them.
        flat : (...) int array
            Cell of each in the block, row by row.
        steps : (...) array
            Whole numbers; beyond `LIMIT_STEPS` either way they are clipped and counted.
        bounded
            Whether they are known to lie in 0 to `LIMIT_STEPS`.
        """
        self.make_room(first, shape)
        if not bounded:
            self._count_and_clip(steps)
        cells, weights, index = shape[0] * shape[1], steps.ravel(), flat.ravel()
        square = np.bincount(index, weights * weights, cells).astype(np.int64)
        if len(index) < cells:  # few readings are quicker counted than cells taken apart
            count, total = np.bincount(index, None, cells), np.bincount(index, weights, cells).astype(np.int64)
        else:
            weights += 2.0**_PACK_BITS
            packed = np.bincount(index, weights, cells).astype(np.int64)
            count = (packed + (1 << (_PACK_BITS - 1))) >> _PACK_BITS
            total = packed - (count << _PACK_BITS)
        self._add_inside(first, count.reshape(shape), total.reshape(shape), square.reshape(shape))

    def _count_and_clip(self, steps: FloatArray) -> None:
        lowest = float(steps.min())
        if lowest < 0:
            self.negative += int((steps < 0).sum())
        if max(float(steps.max()), -lowest) > LIMIT_STEPS:
            self.clipped += int((np.abs(steps) > LIMIT_STEPS).sum())
            np.clip(steps, -LIMIT_STEPS, LIMIT_STEPS, out=steps)

    def add_block(self, first: tuple[int, int], count: IntArray, total: IntArray, square: IntArray) -> None:
        """Add sums over a block of the lattice."""
        self.make_room(first, _shape(count))
        self._add_inside(first, count, total, square)

    def _add_inside(self, first: tuple[int, int], count: IntArray, total: IntArray, square: IntArray) -> None:
        """As `add_block`, for a block inside the arrays."""
        window = self.window(first, _shape(count))
        for sums, block in ((self.count, count), (self.total, total), (self.square, square)):
            part = sums[window]
            part += block

    def merge(self, other: CellSums) -> None:
        """Add all of another's sums."""
        if other.cell_mm != self.cell_mm:
            raise ValueError(f"cells of {other.cell_mm} mm cannot be merged into cells of {self.cell_mm} mm")
        self.clipped += other.clipped
        self.negative += other.negative
        if not other.count.size:
            return
        self.add_block(other.first, other.count, other.total, other.square)

    def trimmed(self) -> CellSums:
        """A copy without the empty rows and columns around the data."""
        held = self.count > 0
        rows, columns = np.flatnonzero(held.any(axis=1)), np.flatnonzero(held.any(axis=0))
        if not len(rows):
            return CellSums(self.cell_mm, clipped=self.clipped, negative=self.negative)
        window = (slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1))
        first = (self.first[0] + int(rows[0]), self.first[1] + int(columns[0]))
        parts = (self.count[window].copy(), self.total[window].copy(), self.square[window].copy())
        return CellSums(self.cell_mm, first, *parts, clipped=self.clipped, negative=self.negative)

    def mean(self) -> FloatArray:
        """(ny, nx) mean of each cell; NaN without readings."""
        return self._per_reading(self.total, VALUE_STEP)

    def variance(self, mean: FloatArray | None = None) -> FloatArray:
        """(ny, nx) variance of the readings about their cell's mean (divided by n); NaN without readings."""
        spread = self._per_reading(self.square, VALUE_STEP**2)
        spread -= np.square(self.mean() if mean is None else mean)
        return np.maximum(spread, 0.0, out=spread)

    def x_mm(self) -> FloatArray:
        """Centres of the columns."""
        return np.asarray((self.first[1] + np.arange(self.count.shape[1])) * self.cell_mm, dtype=np.float64)

    def y_mm(self) -> FloatArray:
        """Centres of the rows."""
        return np.asarray((self.first[0] + np.arange(self.count.shape[0])) * self.cell_mm, dtype=np.float64)

    def _per_reading(self, sums: IntArray, step: float) -> FloatArray:
        ratio = np.full(sums.shape, np.nan)
        np.divide(sums, self.count, out=ratio, where=self.count > 0)
        ratio *= step
        return ratio

    def window(self, first: tuple[int, int], shape: tuple[int, int]) -> tuple[slice, slice]:
        """Slices of a block of the lattice in the arrays."""
        top, left = first[0] - self.first[0], first[1] - self.first[1]
        return slice(top, top + shape[0]), slice(left, left + shape[1])

    def make_room(self, first: tuple[int, int], shape: tuple[int, int]) -> None:
        """Grow the arrays, with a margin, to contain a block of the lattice."""
        top, left, bottom, right = first[0], first[1], first[0] + shape[0], first[1] + shape[1]
        if self.count.size:
            held_bottom, held_right = self.first[0] + self.count.shape[0], self.first[1] + self.count.shape[1]
            if top >= self.first[0] and left >= self.first[1] and bottom <= held_bottom and right <= held_right:
                return
            top, left = min(top, self.first[0]), min(left, self.first[1])
            bottom, right = max(bottom, held_bottom), max(right, held_right)
        refuse_vast(bottom - top, right - left, self.cell_mm)
        roomy = CellSums(self.cell_mm, (top - _GROWTH, left - _GROWTH))
        new_shape = (bottom - top + 2 * _GROWTH, right - left + 2 * _GROWTH)
        window = roomy.window(self.first, _shape(self.count))
        for name in ("count", "total", "square"):
            array = np.zeros(new_shape, dtype=np.int64)
            if self.count.size:
                array[window] = getattr(self, name)
            setattr(self, name, array)
        self.first = roomy.first


def _shape(array: IntArray) -> tuple[int, int]:
    return (array.shape[0], array.shape[1])


def refuse_vast(rows: int, columns: int, cell_mm: float, *, most: int = MAX_CELLS) -> None:
    """Raise `BadDataError` for a map of more than `MAX_CELLS` cells, or more than `most` along one axis."""
    if rows * columns > MAX_CELLS or max(rows, columns) > most:
        raise BadDataError(
            f"the map would have {rows} x {columns} cells of {cell_mm:g} mm ({rows * columns} in all)",
            way_out=f"use larger cells (at most {MAX_CELLS} fit) or cut out poses far from the breast",
        )
