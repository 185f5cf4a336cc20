"""Evenly spread points and smoothed quantiles, for small Monte-Carlo errors of quantities not read from the map."""

from __future__ import annotations

import numpy as np

from tactile_bayes.geometry import FloatArray
from tactile_bayes.inference.draws import Labels
from tactile_bayes.inference.normal import normal_cdf, normal_quantile
from tactile_bayes.inference.sobol import BITS, MOST_DIMENSIONS, shifted_sobol

MOST_PAIRED = MOST_DIMENSIONS - 1
MERGED, LEAST_MERGED = 8, 512
"""Neighbouring normals of a mixture that are taken as one, where there are as many."""
_NODES = np.sinh(np.linspace(-3.0, 3.0, 81))
"""Where a mixture's distribution function is computed, in SDs from its mean; dense in the middle."""
LEAST_SD = 1e-2
"""Of a component, as a share of the mixture's: a narrower one is widened to this."""


def paired_points(key: FloatArray, replicates: Labels, dimension: int, rng: np.random.Generator) -> FloatArray:
    """Uniform points in (0, 1) for drawing further quantities, one point per draw.

    Parameters
    ----------
    key : (n,) array
        What the result depends on most among the draws, such as their log size.
    replicates : (n,) array
        Label of the independent replicate of each draw; every replicate gets a random shift of its own.
    dimension
        Number of further quantities, at most `MOST_PAIRED`.

    Returns
    -------
    (n, dimension) array

    Notes
    -----
    Within a replicate the rank of the key and the point together are a Sobol set under a random digital shift, sorted
    by its first coordinate (L'Ecuyer, Lecot & Tuffin 2008, Operations Research 56:958, sort their chains so). A sum
    over the draws then has the error of an integral of few dimensions, not that of as many random numbers.
    """
    counts = np.bincount(replicates)
    shifts = rng.integers(2**BITS, size=(len(counts), dimension + 1), dtype=np.uint32)
    points = shifted_sobol(0, int(counts.max()), shifts=shifts)
    found = np.empty((len(key), dimension))
    for label, (count, one) in enumerate(zip(counts, points, strict=True)):
        members = np.flatnonzero(replicates == label)
        in_order = np.argsort(one[:count, 0])
        found[members[np.argsort(key[members], kind="stable")]] = one[in_order, 1:]
    return found


def evened(values: FloatArray, mean: FloatArray, sd: FloatArray, replicates: Labels) -> FloatArray:
    """Replace normal draws by evenly spaced quantiles of the mixture of their normals.

    Parameters
    ----------
    values, mean, sd : (n,) arrays
        Draws, and the means and standard deviations of the normals that they were drawn from; NaN stays.
    replicates : (n,) array
        Label of the independent replicate of each draw; each is evened by itself, so that they stay independent.

    Returns
    -------
    (n,) array
        In the order of `values` within each replicate: what goes with a large draw still does.

    Notes
    -----
    The mixture's distribution function is the mean of the normals', not of steps at the draws (Rao-Blackwell). It is
    inverted on a grid, as normal scores, in which it is nearly straight.
    """
    found = values.copy()
    for label in range(int(replicates.max(initial=-1)) + 1):
        members = np.flatnonzero((replicates == label) & np.isfinite(values))
        if len(members):
            members = members[np.argsort(values[members])]
            found[members] = _mixture_quantiles(mean[members], sd[members])
    return found


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
