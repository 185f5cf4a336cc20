"""Exact factors k such that mean + k SD of a normal sample bounds its percentiles with a stated confidence."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache

import numpy as np

from tactile_bayes.trial.readings import FloatArray

_NODES = 400


@cache
def percentile_factor(n: int, *, percentile: float, confidence: float) -> float:
    r"""k with :math:`P(\mu + z_p \sigma \le \bar x + k s) =` `confidence` for a sample of n.

    A quantile of the noncentral t distribution over root n: the one-sided tolerance factor (Odeh & Owen 1980).
    Carkeet (2015), Optom. Vis. Sci. 92, e71, uses it for limits of agreement taken one at a time.
    """
    from scipy.special import ndtr, ndtri

    z = float(ndtri(percentile))
    chi, weight = _chi_nodes(n - 1)

    def reached(k: float) -> float:
        return float(weight @ ndtr(math.sqrt(n) * (k * chi - z)))

    return _root(reached, confidence)


@cache
def content_factor(n: int, *, content: float, confidence: float) -> float:
    r"""k such that mean +- k SD of a sample of n holds at least `content` of the population with this confidence.

    Two-sided tolerance factor of Wald & Wolfowitz (1946), exact as in Odeh & Owen (1980); Carkeet (2015) uses it for
    the two limits of agreement taken as a pair.
    """
    from scipy.special import gammaincc, ndtri

    at, normal = np.polynomial.legendre.leggauss(_NODES)
    reach = min(9.0, float(ndtri(1 - 1e-17)))
    off = (at + 1) / 2 * reach
    weight = normal / 2 * reach * 2 * np.exp(-(off**2) / 2) / math.sqrt(2 * math.pi)
    radius = _radius(off / math.sqrt(n), content)
    freedom = n - 1

    def reached(k: float) -> float:
        if k <= 0:
            return 0.0
        return float(weight @ gammaincc(freedom / 2, freedom * (radius / k) ** 2 / 2))

    return _root(reached, confidence)


def _radius(shift: FloatArray, content: float) -> FloatArray:
    """Solve Phi(shift + r) - Phi(shift - r) = content for r."""
    from scipy.special import ndtr, ndtri

    low, high = np.zeros_like(shift), np.abs(shift) + float(ndtri(0.5 + 0.5 * content)) + 1e-9
    for _ in range(80):
        middle = (low + high) / 2
        short = ndtr(shift + middle) - ndtr(shift - middle) < content
        low, high = np.where(short, middle, low), np.where(short, high, middle)
    return (low + high) / 2


def _chi_nodes(freedom: int) -> tuple[FloatArray, FloatArray]:
    """Values of s / sigma and their probabilities: Gauss-Legendre in the logarithm of s^2 / sigma^2."""
    from scipy.special import gammaincinv, gammaln

    half = freedom / 2
    low = max(float(gammaincinv(half, 1e-18)), 1e-300) / half
    high = float(half + 12 * math.sqrt(half) + 80) / half
    at, normal = np.polynomial.legendre.leggauss(_NODES)
    a, b = math.log(low), math.log(high)
    log_v = a + (at + 1) / 2 * (b - a)
    v = np.exp(log_v)
    weight = normal / 2 * (b - a) * np.exp(half * (log_v - v) + half * math.log(half) - float(gammaln(half)))
    return np.sqrt(v), weight / weight.sum()


def _root(function: Callable[[float], float], target: float) -> float:
    """Solve an increasing function for a target by bisection, to 1e-12 of its size."""
    low, high = -1.0, 1.0
    while function(high) < target and high < 1e12:
        low, high = high, 4 * high
    while function(low) > target and low > -1e12:
        low, high = 4 * low, low
    for _ in range(200):
        middle = (low + high) / 2
        if middle in (low, high) or high - low < 1e-13 * max(1.0, abs(middle)):
            break
        low, high = (middle, high) if function(middle) < target else (low, middle)
    return (low + high) / 2
