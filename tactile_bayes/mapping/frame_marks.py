"""Reproducible random choice of frames by a hash of their levels, independent of order and portions.

A statistic that needs no more than some thousand frames is taken from those with the smallest marks. The choice depends
on the set of frames alone, and shards agree on it without knowing each other.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tactile_bayes.geometry import FloatArray

NO_LIMIT = np.uint64(2**64 - 1)
_ROUNDS = ((np.uint64(30), np.uint64(0xBF58476D1CE4E5B9)), (np.uint64(27), np.uint64(0x94D049BB133111EB)))
_LAST_SHIFT = np.uint64(31)


def frame_marks(level_kpa: FloatArray) -> NDArray[np.uint64]:
    """Hash of each frame's level.

    Parameters
    ----------
    level_kpa : (f,) array
        Exact means, the same to the bit whatever computes them (see `tactile_bayes.mapping.readout`).

    Returns
    -------
    (f,) uint64 array; equal levels have equal marks.

    Notes
    -----
    The mixing function of SplitMix64 (Steele, Lea & Flood 2014, Fast splittable pseudorandom number generators).
    """
    mark = np.ascontiguousarray(level_kpa).view(np.uint64)
    for shift, factor in _ROUNDS:
        mark = (mark ^ (mark >> shift)) * factor
    return mark ^ (mark >> _LAST_SHIFT)


def marks_limit(marks: NDArray[np.uint64], most: int) -> np.uint64:
    """Limit that at most `most` marks lie below; equal marks are chosen together or not at all.

    The limit of a set can be found from the marks under the limits of its parts and those limits, of which the least
    counts.
    """
    if len(marks) <= most:
        return NO_LIMIT
    return np.uint64(np.partition(marks, most)[most])
