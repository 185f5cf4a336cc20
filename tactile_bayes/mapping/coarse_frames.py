"""Frames averaged over 20 ms and over 2 x 2 taxels: all that finding shifts of a millimetre needs, in a tenth of it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tactile_bayes.geometry import FloatArray
from tactile_bayes.mapping.frames import SelectedFrames, chunks
from tactile_bayes.mapping.project import Projection, Projector
from tactile_bayes.mapping.readout import Readout

POOL_S = 0.02
POOL_TAXELS = 2
# Neighbouring frames share errors over less than this.
SHARED_S = 0.2
# A stroke is a run in one direction over at least this far.
LEAST_REACH_MM = 10.0
_CHUNK = 512

IndexArray = NDArray[np.intp]


def stretches(time_s: FloatArray) -> IndexArray:
    """(n,) which stretch of `POOL_S` each frame lies in, counting those that hold a frame; times rise.

    Not by the clock: of frames that come regularly, but less often, every so-many-th stretch might hold none.
    """
    return np.cumsum(np.diff(_slot(time_s), prepend=_slot(time_s[:1])) != 0)


def thinning(times_s: Iterable[FloatArray], *, most: int) -> int:
    """Of how many stretches one is averaged, so that scans with frames at these times give `most` at most, or so."""
    return max(1, -(-sum(int(stretches(one)[-1]) + 1 for one in times_s if len(one)) // most))


def every_stretch(time_s: FloatArray, every: int) -> IndexArray:
    """Indices of the frames in every so-many-th of the `stretches`, at least of one; the clock says in which first."""
    number = stretches(time_s)
    chosen = (_slot(time_s[:1]) + number) % every == 0
    return np.flatnonzero(chosen if chosen.any() else number == 0)


def _slot(time_s: FloatArray) -> FloatArray:
    return np.asarray(np.floor(time_s / POOL_S))


@dataclass(frozen=True, slots=True, eq=False)
class CoarseFrames:
    """Some frames of one scan, averaged.

    Parameters
    ----------
    pressure : (m, k) array
        Mean over a block of frames and a block of taxels, each frame over its own mean.
    frames : (n,) int array
        The scan's frames that were averaged.
    first : (m,) int array
        Where each block of frames begins among them.
    weight : (t, k) array
        Share of each good taxel in each block of taxels; columns add up to 1.
    row, block : (k,) int arrays
        Which rows of the head a block of taxels is of, and its number among all blocks of the head.
    basis : (k, 6) array
        Orthonormal: a level, two slopes and three curvatures over the head's blocks.
    """

    pressure: FloatArray
    frames: IndexArray
    first: IndexArray
    weight: FloatArray
    row: IndexArray
    block: IndexArray
    basis: FloatArray

    @classmethod
    def of(cls, selection: SelectedFrames, frames: IndexArray) -> CoarseFrames:
        """Average the given frames of a scan, in the order of time.

        Notes
        -----
        The few saturated readings count as their frame's mean.
        """
        good, scan = selection.good_taxels, selection.scan
        readout = Readout.of(scan.element_calibration, good)
        weight, row, block, basis = _taxel_blocks(good)
        first = np.flatnonzero(np.diff(stretches(scan.frames.time_s[frames]), prepend=-1))
        pooled = np.empty((len(frames), weight.shape[1]))
        for part in chunks(len(frames), _CHUNK):
            chosen = frames[part]
            pressure, valid = readout.pressure_kpa(readout.counts(scan.frames.counts[chosen]))
            pressure /= selection.level_kpa[chosen, None]
            pooled[part] = (pressure if valid is None else np.where(valid, pressure, 1.0)) @ weight
        return cls(block_means(pooled, first), frames, first, weight, row, block, basis)

    def blocks(self, time_s: FloatArray) -> IndexArray:
        """(m,) which stretch of `SHARED_S` each averaged frame lies in, from the times of the scan's frames."""
        return np.unique(np.floor(time_s[self.frames[self.first]] / SHARED_S), return_inverse=True)[1]

    def places_mm(self, projection: Projection) -> FloatArray:
        """(m, k, 2) mean places of the blocks on the plane, from the projection of `frames`."""
        matrix = block_means(projection.matrix.reshape(len(projection), -1), self.first).reshape(-1, 2, 4)
        taxels = projection.taxels.place_and_one @ self.weight
        return np.asarray(np.einsum("mij,jk->mki", matrix, taxels) * projection.cell_mm)


def projector_of(selection: SelectedFrames, *, plane_from_base: FloatArray, cell_mm: float) -> Projector:
    """The projector of a scan's good taxels."""
    good = selection.good_taxels
    return Projector(selection.scan.head, plane_from_base=plane_from_base, taxels=good, cell_mm=cell_mm)


def _taxel_blocks(good: NDArray[np.bool_]) -> tuple[FloatArray, IndexArray, IndexArray, FloatArray]:
    """Shares of the good taxels in blocks, each block's rows of the head, its number, and polynomials over them."""
    row, column = np.nonzero(good)
    number = row // POOL_TAXELS * good.shape[1] + column // POOL_TAXELS
    blocks, member = np.unique(number, return_inverse=True)
    weight = np.zeros((len(row), len(blocks)))
    weight[np.arange(len(row)), member] = 1.0 / np.bincount(member)[member]
    s, t = ((place - place.mean()) / len(good) @ weight for place in (row.astype(float), column.astype(float)))
    terms = [np.ones_like(s), s, t, s * s, s * t, t * t][: len(blocks)]
    return weight, blocks // good.shape[1], blocks, np.linalg.qr(np.stack(terms, axis=1))[0]


def block_means(values: FloatArray, first: IndexArray) -> FloatArray:
    """(m, k) means of the rows of (n, k) values from each `first` up to the next."""
    counts = np.diff(np.append(first, len(values)))
    means: FloatArray = np.add.reduceat(values, first, axis=0) / counts[:, None]
    return means


def stroke_starts(x_mm: FloatArray) -> list[int]:
    """Where runs in one direction begin, and the end of the last; what lies at a turn is part of the run before.

    Parameters
    ----------
    x_mm : (n,) array
        Place of the head along the strokes.
    """
    ends, start, far = [0], 0, 0
    for i in range(len(x_mm)):
        rising = x_mm[far] >= x_mm[start]
        if (x_mm[i] - x_mm[far]) * (1 if rising else -1) >= 0:
            far = i
        elif abs(x_mm[far] - x_mm[i]) >= LEAST_REACH_MM / 2 and abs(x_mm[far] - x_mm[start]) >= LEAST_REACH_MM:
            ends.append(far)
            start, far = far, i
        elif abs(x_mm[far] - x_mm[start]) < min(LEAST_REACH_MM, abs(x_mm[i] - x_mm[start])):
            far = i  # it set out the other way
    return [*ends, len(x_mm)]
