"""Pareto-smoothed importance sampling (PSIS): smoothed weights, and the shape that shows if they can be trusted."""

from __future__ import annotations

import numpy as np

from tactile_bayes.geometry import FloatArray

TRUSTED_SHAPE = 0.7
"""Above this shape of the weights' tail, their mean converges too slowly to be of use (Vehtari et al. 2024)."""


def smooth_weights(log_weights: FloatArray) -> tuple[FloatArray, float]:
    """Smooth weights (PSIS): replace the upper tail by quantiles of a fitted Pareto tail, and normalise.

    Parameters
    ----------
    log_weights : (n,) array
        Unnormalised; -inf for draws without density.

    Returns
    -------
    weights : (n,) array
        Non-negative, sum 1.
    shape
        The tail's shape k; NaN when the tail is too short to fit, -inf when all its weights are equal.

    References
    ----------
    Vehtari, Simpson, Gelman, Yao & Gabry (2024), Journal of Machine Learning Research 25(72).
    """
    n = len(log_weights)
    weights = np.exp(log_weights - log_weights.max())
    tail = int(min(0.2 * n, 3.0 * np.sqrt(n)))
    if tail < 5 or not np.isfinite(log_weights.max()):
        return weights / weights.sum(), float("nan")
    order = np.argsort(weights, kind="stable")
    top = order[-tail:]
    cut = weights[order[-tail - 1]]
    excess = weights[top] - cut
    if not excess[-1] > 1e-12:
        return weights / weights.sum(), float("-inf")
    shape, scale = fit_generalised_pareto(excess)
    if np.isfinite(shape):
        probability = (np.arange(tail) + 0.5) / tail
        weights[top] = np.minimum(cut + _pareto_quantile(probability, shape, scale), 1.0)
    return weights / weights.sum(), shape


def fit_generalised_pareto(excess: FloatArray) -> tuple[float, float]:
    """Fit shape and scale of a generalised Pareto distribution to ascending positive excesses.

    Notes
    -----
    The posterior mean under a weak prior of Zhang & Stephens (2009), Technometrics 51:316, with the shape drawn towards
    0.5 by the weight of ten observations as in Vehtari et al. (2024), appendix C.
    """
    n = len(excess)
    positive = np.maximum(excess, 1e-300)
    grid = 30 + int(np.sqrt(n))
    quarter = positive[max(int(n / 4 + 0.5) - 1, 0)]
    index = np.arange(1, grid + 1)
    theta = 1.0 / positive[-1] + (1.0 - np.sqrt(grid / (index - 0.5))) / (3.0 * quarter)
    shapes = np.mean(np.log1p(-theta[:, None] * positive), axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        profile = n * (np.log(-theta / shapes) - shapes - 1.0)
    profile = np.where(np.isfinite(profile), profile, -np.inf)
    if not np.isfinite(profile.max()):
        return float("nan"), float("nan")
    weight = np.exp(profile - profile.max())
    best = float(weight @ theta / weight.sum())
    shape = float(np.mean(np.log1p(-best * positive)))
    scale = -shape / best
    return (n * shape + 10 * 0.5) / (n + 10), scale


def _pareto_quantile(probability: FloatArray, shape: float, scale: float) -> FloatArray:
    if abs(shape) < 1e-10:
        return np.asarray(-scale * np.log1p(-probability))
    return np.asarray(scale * np.expm1(-shape * np.log1p(-probability)) / shape)
