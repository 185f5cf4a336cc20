"""Points in many dimensions: Sobol, normal and paired ones."""

from __future__ import annotations

import numpy as np

from tactile_bayes.geometry import FloatArray
from tactile_bayes.inference.draws import Labels

# --- The normal distribution function and its inverse, without the slow import of scipy.


def normal_cdf(z: FloatArray) -> FloatArray:
    """Normal distribution function to 1e-7 (Abramowitz & Stegun 26.2.17)."""
    t = 1.0 / (1.0 + 0.2316419 * np.abs(z))
    tail = np.exp(-0.5 * z**2) / np.sqrt(2.0 * np.pi) * t * np.polyval(_B1, t)
    return np.asarray(np.where(z < 0, tail, 1.0 - tail))


def normal_quantile(probability: FloatArray) -> FloatArray:
    """Inverse of the normal distribution function to 1e-9 relative (Acklam's rational fits, one Halley step).

    The library's own costs 0.3 s to import, as much as the whole estimate.
    """
    p = np.clip(probability, 1e-300, 1.0 - 1e-16)
    tail = np.minimum(p, 1.0 - p)
    q = np.sqrt(-2.0 * np.log(tail))
    low = np.polyval(_C, q) / np.polyval(_D, q)
    centred = p - 0.5
    r = centred**2
    middle = np.polyval(_A, r) * centred / np.polyval(_B, r)
    return np.where(tail < 0.02425, np.where(p < 0.5, low, -low), middle)


_A = (
    -39.69683028665376,
    220.9460984245205,
    -275.9285104469687,
    138.3577518672690,
    -30.66479806614716,
    2.506628277459239,
)
_B = (-54.47609879822406, 161.5858368580409, -155.6989798598866, 66.80131188771972, -13.28068155288572, 1.0)
_C = (
    -7.784894002430293e-3,
    -0.3223964580411365,
    -2.400758277161838,
    -2.549732539343734,
    4.374664141464968,
    2.938163982698783,
)
_D = (7.784695709041462e-3, 0.3224671290700398, 2.445134137142996, 3.754408661907416, 1.0)
_B1 = (1.330274429, -1.821255978, 1.781477937, -0.356563782, 0.319381530)


# --- Sobol points with random digital shifts, without the slow import of scipy.
#
# The library's generator lies behind 0.9 s of imports; the points are the same (a test compares them).

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
    """(number, dimension) points of the Sobol sequence from `start` on, as integers of `BITS` bits.

    `ValueError` for more dimensions than the table holds.
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
    """(replicates, number, dimension) uniform points in (0, 1): the sequence under the digital shift of each row of
    `shifts`."""
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


# --- Evenly spread points and smoothed quantiles, for small Monte-Carlo errors of quantities not read from the map.

MOST_PAIRED = MOST_DIMENSIONS - 1
MERGED, LEAST_MERGED = 8, 512
"""Neighbouring normals of a mixture that are taken as one, where there are as many."""
_NODES = np.sinh(np.linspace(-3.0, 3.0, 81))
"""Where a mixture's distribution function is computed, in SDs from its mean; dense in the middle."""
LEAST_SD = 1e-2  #: Least SD of a component, as a share of the mixture's: a narrower one is widened to this.


def paired_points(key: FloatArray, replicates: Labels, dimension: int, rng: np.random.Generator) -> FloatArray:
    """(n, dimension) uniform points in (0, 1) for drawing further quantities, one point per draw.

    The (n,) `key` is what the result depends on most among the draws, such as their log size; every replicate gets a
    random shift of its own; `dimension` is at most `MOST_PAIRED`. Within a replicate the rank of the key and the point
    together are a Sobol set under a random digital shift, sorted by its first coordinate (L'Ecuyer, Lecot & Tuffin
    2008, Operations Research 56:958, sort their chains so). A sum over the draws then has the error of an integral of
    few dimensions, not that of as many random numbers.
    """
    counts = np.bincount(replicates)
    shifts = rng.integers(2**BITS, size=(len(counts), dimension + 1), dtype=np.uint32)
    points = shifted_sobol(0, int(counts.max()), shifts=shifts)
    paired = np.empty((len(key), dimension))
    for label, (count, one) in enumerate(zip(counts, points, strict=True)):
        members = np.flatnonzero(replicates == label)
        in_order = np.argsort(one[:count, 0])
        paired[members[np.argsort(key[members], kind="stable")]] = one[in_order, 1:]
    return paired


def stratified_quantiles(values: FloatArray, mean: FloatArray, sd: FloatArray, replicates: Labels) -> FloatArray:
    """Replace (n,) normal draws by evenly spaced quantiles of the mixture of the normals that they were drawn from.

    Each replicate is done by itself, so that they stay independent, and keeps the order of its values: what goes with a
    large draw still does. NaN stays. The mixture's distribution function is the mean of the normals', not of steps at
    the draws (Rao-Blackwell). It is inverted on a grid, as normal scores, in which it is nearly straight.
    """
    even = values.copy()
    for label in range(int(replicates.max(initial=-1)) + 1):
        members = np.flatnonzero((replicates == label) & np.isfinite(values))
        if len(members):
            members = members[np.argsort(values[members])]
            even[members] = _mixture_quantiles(mean[members], sd[members])
    return even


def _mixture_quantiles(mean: FloatArray, sd: FloatArray) -> FloatArray:
    """(n,) evenly spaced quantiles of a mixture of n normals, rising."""
    spread, n = float(np.var(mean)), len(mean)
    total = float(np.sqrt(np.mean(sd**2) + spread))
    if not total > 0:
        return mean
    mean, sd = _merged(mean, np.maximum(sd, LEAST_SD * total), by=mean if spread > np.mean(sd**2) else sd)
    at = float(mean.mean()) + total * _NODES
    score = normal_quantile(np.clip(normal_cdf((at[:, None] - mean) / sd).mean(axis=1), 1e-12, 1.0 - 1e-12))
    return np.interp(normal_quantile((np.arange(n) + 0.5) / n), score, at)


def _merged(mean: FloatArray, sd: FloatArray, *, by: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Merge each `MERGED` neighbours, in the order of `by`, into one normal of their mean and variance."""
    n = len(mean) // MERGED * MERGED
    if n < LEAST_MERGED:
        return mean, sd
    # the few left over are spread over the order, so that no end of it is lost
    order = np.argsort(by)[np.linspace(0, len(mean) - 1, n).round().astype(np.intp)].reshape(-1, MERGED)
    middle = mean[order].mean(axis=1)
    return middle, np.sqrt(np.mean(sd[order] ** 2, axis=1) + np.var(mean[order], axis=1))
