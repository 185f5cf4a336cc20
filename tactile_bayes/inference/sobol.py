"""Sobol points with random digital shifts, without the slow import of scipy.

The library's generator lies behind 0.9 s of imports; the points are the same (a test compares them).
"""

from __future__ import annotations

import numpy as np

from tactile_bayes.geometry import FloatArray

BITS = 30
# Degree, coefficients and initial numbers of the primitive polynomials of dimensions 2 to 8
# (Joe & Kuo 2008, SIAM Journal on Scientific Computing 30:2635, table new-joe-kuo-6).
_POLYNOMIALS = (
    (1, 0, (1,)),
    (2, 1, (1, 3)),
    (3, 1, (1, 3, 1)),
    (3, 2, (1, 1, 1)),
    (4, 1, (1, 1, 3, 3)),
    (4, 4, (1, 3, 5, 13)),
    (5, 2, (1, 1, 5, 5, 17)),
)
MOST_DIMENSIONS = len(_POLYNOMIALS) + 1


def sobol_integers(start: int, number: int, dimension: int) -> np.ndarray[tuple[int, ...], np.dtype[np.uint32]]:
    """Points `start` to ``start + number`` of the Sobol sequence as integers of `BITS` bits, (number, dimension).

    Raises
    ------
    ValueError
        For more dimensions than the table holds.
    """
    if dimension > MOST_DIMENSIONS:
        raise ValueError(f"{dimension} dimensions; the table holds {MOST_DIMENSIONS}")
    index = np.arange(start, start + number, dtype=np.uint32)
    gray = index ^ (index >> np.uint32(1))
    points = np.zeros((number, dimension), dtype=np.uint32)
    directions = np.stack([_directions(column) for column in range(dimension)])
    for bit in range(max(1, int(start + number).bit_length())):
        chosen = ((gray >> np.uint32(bit)) & np.uint32(1)).astype(bool)
        points[chosen] ^= directions[:, bit]
    return points


def shifted_sobol(start: int, number: int, *, shifts: np.ndarray[tuple[int, ...], np.dtype[np.uint32]]) -> FloatArray:
    """Uniform points in (0, 1): the sequence under one digital shift for each row of `shifts`.

    Parameters
    ----------
    shifts : (replicates, dimension) uint32 array of `BITS` bits

    Returns
    -------
    (replicates, number, dimension) array
    """
    points = sobol_integers(start, number, shifts.shape[1])
    return np.asarray(((points ^ shifts[:, None, :]) + 0.5) / 2.0**BITS)


def _directions(column: int) -> np.ndarray[tuple[int, ...], np.dtype[np.uint32]]:
    """Direction numbers of one dimension, from Bratley & Fox (1988)."""
    if column == 0:
        return np.array([1 << (BITS - 1 - k) for k in range(BITS)], dtype=np.uint32)
    degree, coefficients, initial = _POLYNOMIALS[column - 1]
    numbers = [m << (BITS - 1 - k) for k, m in enumerate(initial)]
    for k in range(degree, BITS):
        value = numbers[k - degree] ^ (numbers[k - degree] >> degree)
        for i in range(1, degree):
            if (coefficients >> (degree - 1 - i)) & 1:
                value ^= numbers[k - i]
        numbers.append(value)
    return np.array(numbers, dtype=np.uint32)
