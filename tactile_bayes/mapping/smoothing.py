"""Binomial smoothing of sums in cells."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tactile_bayes.geometry import FloatArray


def smooth(values: NDArray[np.generic], *, passes: int = 4) -> FloatArray:
    """Binomial smoothing along both axes; four passes are two cells (SD 1.4) wide."""
    smooth = np.asarray(values, dtype=np.float64)
    for axis in (0, 1):
        for _ in range(passes):
            padded = np.pad(smooth, [(1, 1) if a == axis else (0, 0) for a in (0, 1)])
            low, middle, high = (np.take(padded, range(k, k + smooth.shape[axis]), axis=axis) for k in range(3))
            smooth = 0.25 * low + 0.5 * middle + 0.25 * high
    return smooth
