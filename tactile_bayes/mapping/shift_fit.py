r"""Shifts of readings' places found by linear regression on the map's gradient, with all else that varies taken off.

To first order a reading is

.. math:: p = m_s(u) + \nabla m(u) \cdot D \theta + q_f(s, t) + c_{st} + \epsilon

with u its supposed place, D theta by how much that is wrong (D is the velocity for a latency, 1 in one stroke for that
stroke's shift), and three nuisances: :math:`q_f` a quadratic over the head in each frame (its level, its tilt and how
deep it sinks), :math:`c_{st}` an offset of each block of taxels (the head's response), and a map :math:`m_s` of its own
for each pair of the head's rows s, because a row near the head's edge sees the lump lower than one in its middle. All
three are linear and leave the regression by projection (Frisch & Waugh 1933, Econometrica 1).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tactile_bayes.geometry import FloatArray
from tactile_bayes.mapping.coarse_frames import CoarseFrames, IndexArray
from tactile_bayes.mapping.smoothing import smooth

# Cells of the map, mm: as the averaged frames and taxels are. Slopes within a cell are followed.
CELL_MM = (2.0, 3.0)
_LEVELLING_ROUNDS, _GRADIENT_ROUNDS = 12, 2
_PROJECTION_ROUNDS, _PROJECTION_TOLERANCE = 40, 1e-4


@dataclass(frozen=True, slots=True, eq=False)
class ShiftFit:
    """Readings of one or several scans at supposed places, ready for a regression on shifts.

    Parameters
    ----------
    cells
        Where the readings lie.
    levelled : (n,) array
        Readings without what frames and taxels add to one common map.
    gradient : (n, 2) array
        Of the map at each reading, 1/mm along x and y.
    data : (n,) array
        Readings with the nuisances taken off.
    nuisance
        What is taken off.
    """

    cells: Cells
    levelled: FloatArray
    gradient: FloatArray
    data: FloatArray
    nuisance: Nuisance

    @classmethod
    def of(cls, parts: Sequence[CoarseFrames], places_mm: Sequence[FloatArray]) -> ShiftFit:
        """Find the map's gradient and take the nuisances off the readings."""
        cells = Cells.of(places_mm)
        nuisance = Nuisance.of(parts, cells.number)
        pressure = np.concatenate([part.pressure.reshape(-1) for part in parts])
        gradient = np.zeros((len(pressure), 2))
        for _ in range(_GRADIENT_ROUNDS):
            levelled = nuisance.levelled(pressure - np.einsum("ni,ni->n", gradient, cells.offset_mm), cells)
            gradient = cells.gradient(levelled)
        data = nuisance.without(pressure - np.einsum("ni,ni->n", gradient, cells.offset_mm))
        return cls(cells, levelled, gradient, data, nuisance)

    def of_some(self, keep: NDArray[np.bool_]) -> ShiftFit:
        """The same with the gradient of the map that some of the readings make."""
        return replace(self, gradient=self.cells.gradient(self.levelled, keep=keep))

    def frame_numbers(self) -> IndexArray:
        """(n,) averaged frame of each reading, counted through all scans."""
        return self.nuisance.frame

    def design(self, moves: Sequence[FloatArray]) -> FloatArray:
        """(n,) change of the readings when their places move by (m, k, 2), without the nuisances."""
        return self.nuisance.without(self._changes(moves))

    def raw_design(self, moves: Sequence[FloatArray]) -> FloatArray:
        """(n,) the same with the map and the taxels' offsets left in."""
        return self.nuisance.within_frames(self._changes(moves))

    def _changes(self, moves: Sequence[FloatArray]) -> FloatArray:
        moved = np.concatenate([one.reshape(-1, 2) for one in moves])
        return np.asarray(np.einsum("ni,ni->n", self.gradient, moved))


@dataclass(frozen=True, slots=True, eq=False)
class Cells:
    """The cells of the map that readings fall in.

    Parameters
    ----------
    number : (n,) int array
        Cell of each reading, row by row of a block of `shape`.
    offset_mm : (n, 2) array
        From the cell's centre.
    shape
        Rows and columns.
    """

    number: IndexArray
    offset_mm: FloatArray
    shape: tuple[int, int]

    @classmethod
    def of(cls, places_mm: Sequence[FloatArray]) -> Cells:
        place = np.concatenate([one.reshape(-1, 2) for one in places_mm])
        index = np.floor(place / CELL_MM)
        offset = place - (index + 0.5) * CELL_MM
        whole = (index - index.min(axis=0)).astype(np.intp)
        columns, rows = (whole.max(axis=0) + 1).tolist()
        return cls(whole[:, 1] * columns + whole[:, 0], offset, (rows, columns))

    def means(self, values: FloatArray) -> FloatArray:
        """(cells,) mean of the values in each cell; 0 in an empty one."""
        size = self.shape[0] * self.shape[1]
        count = np.bincount(self.number, minlength=size)
        return np.asarray(np.bincount(self.number, values, size) / np.maximum(count, 1))

    def gradient(self, values: FloatArray, *, keep: NDArray[np.bool_] | None = None) -> FloatArray:
        """(n, 2) gradient at each reading of the values' map, smoothed once; 0 beside a cell without kept values."""
        size = self.shape[0] * self.shape[1]
        kept = np.ones(len(values)) if keep is None else keep.astype(np.float64)
        count = smooth(np.bincount(self.number, kept, size).reshape(self.shape), passes=1)
        total = smooth(np.bincount(self.number, kept * values, size).reshape(self.shape), passes=1)
        mean = np.divide(total, count, out=np.full_like(total, np.nan), where=count > 0)
        if min(self.shape) < 2:
            return np.zeros((len(self.number), 2))
        along_y, along_x = np.gradient(mean, CELL_MM[1], CELL_MM[0])
        slopes = np.stack([along_x.reshape(-1), along_y.reshape(-1)], axis=1)
        return np.asarray(np.nan_to_num(slopes)[self.number])


@dataclass(frozen=True, slots=True, eq=False)
class Nuisance:
    """What varies besides the map: in each frame, in each block of taxels, and from row to row of the head.

    Parameters
    ----------
    bases : (k, 6) arrays
        Of each scan.
    shapes
        Frames and blocks of taxels of each scan.
    frame, taxel, row_cell : (n,) int arrays
        Averaged frame, block of taxels, and cell of the map of the head's rows that each reading is of.
    """

    bases: tuple[FloatArray, ...]
    shapes: tuple[tuple[int, int], ...]
    frame: IndexArray
    taxel: IndexArray
    row_cell: IndexArray

    @classmethod
    def of(cls, parts: Sequence[CoarseFrames], cell: IndexArray) -> Nuisance:
        """Of some scans, whose readings lie in the given cells."""
        shapes = tuple((len(part.pressure), len(part.row)) for part in parts)
        frames = np.cumsum([0, *(m for m, _ in shapes)])
        taxels = np.cumsum([0, *(k for _, k in shapes)])
        frame = [np.repeat(np.arange(m) + start, k) for (m, k), start in zip(shapes, frames, strict=False)]
        taxel = [np.tile(np.arange(k) + start, m) for (m, k), start in zip(shapes, taxels, strict=False)]
        row = [np.tile(part.row, len(part.pressure)) for part in parts]
        row_cell = np.unique(np.concatenate(row) * (cell.max() + 1) + cell, return_inverse=True)[1]
        bases = tuple(part.basis for part in parts)
        return cls(bases, shapes, np.concatenate(frame), np.concatenate(taxel), row_cell)

    def within_frames(self, values: FloatArray) -> FloatArray:
        """(n,) values without their quadratic in each frame."""
        found, start = np.empty_like(values), 0
        for basis, (m, k) in zip(self.bases, self.shapes, strict=True):
            block = values[start : start + m * k].reshape(m, k)
            found[start : start + m * k] = (block - (block @ basis) @ basis.T).reshape(-1)
            start += m * k
        return found

    def levelled(self, values: FloatArray, cells: Cells) -> FloatArray:
        """(n,) values without what frames and taxels add to one common map, which stays in."""
        frames, taxels = np.zeros_like(values), np.zeros_like(values)
        for _ in range(_LEVELLING_ROUNDS):
            left = values - cells.means(values - frames - taxels)[cells.number]
            taxels = _group_means(left - frames, self.taxel)
            rest = left - taxels
            frames = rest - self.within_frames(rest)
        return np.asarray(values - taxels - (frames - frames.mean()))

    def without(self, values: FloatArray) -> FloatArray:
        """(n,) values projected off all three, by turns."""
        left, limit = values.copy(), _PROJECTION_TOLERANCE * float(values.std())
        for _ in range(_PROJECTION_ROUNDS):
            left = self.within_frames(left)
            left -= _group_means(left, self.taxel)
            step = _group_means(left, self.row_cell)
            left -= step
            if float(np.abs(step).max(initial=0.0)) <= limit:
                break
        return left


def _group_means(values: FloatArray, group: IndexArray) -> FloatArray:
    """(n,) mean of each value's group."""
    return np.asarray((np.bincount(group, values) / np.maximum(np.bincount(group), 1))[group])
