"""The job of map building, done with numpy.bincount and with boost-histogram, each as fast as we could make it.

The job: counts to kPa, each frame over its mean, taxels onto the plane, then count, sum and sum of squares a cell.
No gate, no check for saturation, no exactness: what a careful user of either library would write.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from tactile_bayes.geometry import FloatArray
from tactile_bayes.scans import CountArray


@dataclass(frozen=True, slots=True, eq=False)
class Job:
    """Everything a peer needs, prepared beforehand.

    Parameters
    ----------
    counts : (n, k) uint16 array
    gain, offset : (k,) arrays
    turn : (n, 2, 3), shift : (n, 2), taxels : (3, k) arrays
        Cells from the lattice's first: ``uv = turn @ taxels + shift``.
    shape
        Rows and columns of cells.
    """

    counts: CountArray
    gain: FloatArray
    offset: FloatArray
    turn: FloatArray
    shift: FloatArray
    taxels: FloatArray
    shape: tuple[int, int]

    def chunks(
        self, frames: int, index: type[np.signedinteger[Any]]
    ) -> Iterator[tuple[np.ndarray[Any, Any], FloatArray]]:
        """Flat cell indices and normalised values, chunk by chunk, in place wherever numpy allows it."""
        for start in range(0, len(self.counts), frames):
            part = slice(start, start + frames)
            value = self.counts[part] * self.gain
            value += self.offset
            value /= value.mean(axis=1, keepdims=True)
            u = self.turn[part, 0] @ self.taxels
            u += self.shift[part, 0, None]
            v = self.turn[part, 1] @ self.taxels
            v += self.shift[part, 1, None]
            cell = v.astype(index)
            cell *= self.shape[1]
            cell += u.astype(index)
            yield cell.ravel(), value.ravel()


def bincount(job: Job, *, frames: int) -> FloatArray:
    """Three calls of numpy.bincount a chunk; (3, cells)."""
    cells = job.shape[0] * job.shape[1]
    sums = np.zeros((3, cells))
    for cell, value in job.chunks(frames, np.int64):
        sums[0] += np.bincount(cell, minlength=cells)
        sums[1] += np.bincount(cell, value, cells)
        np.multiply(value, value, out=value)
        sums[2] += np.bincount(cell, value, cells)
    return sums


def boost_mean(job: Job, *, frames: int) -> Any:
    """One fill of a Mean storage a chunk: count, mean and sum of squared deviations together."""
    import boost_histogram as bh

    axis = bh.axis.Integer(0, job.shape[0] * job.shape[1], underflow=False, overflow=False)
    histogram = bh.Histogram(axis, storage=bh.storage.Mean())
    for cell, value in job.chunks(frames, np.int32):
        histogram.fill(cell, sample=value)
    return histogram


def boost_weight(job: Job, *, frames: int) -> Any:
    """Two fills a chunk: count, and a Weight storage that keeps the sum and the sum of squares."""
    import boost_histogram as bh

    axis = bh.axis.Integer(0, job.shape[0] * job.shape[1], underflow=False, overflow=False)
    count, weight = bh.Histogram(axis, storage=bh.storage.Int64()), bh.Histogram(axis, storage=bh.storage.Weight())
    for cell, value in job.chunks(frames, np.int32):
        count.fill(cell)
        weight.fill(cell, weight=value)
    return count, weight


# Tuned: the fastest of these is taken for each peer, in the same run.
BINCOUNT_FRAMES = (64, 128, 256, 512)
BOOST: dict[str, Callable[..., Any]] = {"Mean": boost_mean, "Int64 + Weight": boost_weight}
BOOST_FRAMES = (128, 256, 512)
