"""The line through zero that the paper draws, and the three figures that are all called r squared.

The paper names no convention for r squared; its printed 0.14 can only be the centred or Pearson's (shared reading of
Fig. 10), so the centred one leads. The regression is of sizes y on ex-vivo sizes e.
"""

from __future__ import annotations

import numpy as np

from tactile_bayes.trial.accuracy import some
from tactile_bayes.trial.figures import Figure, figure
from tactile_bayes.trial.jackknife import UndefinedError
from tactile_bayes.trial.readings import FloatArray, ModalitySizes

# Replicates averaged in floating point differ by this much, relatively, when they are equal.
_EQUAL = 1e-12


def figures(sizes: ModalitySizes, *, confidence: float) -> dict[str, Figure]:
    """Slope and r squared with masses not found at size 0 (the paper's convention), then over detected masses only."""
    result: dict[str, Figure] = {}
    for suffix, subset in (("", sizes), ("_detected", sizes.only_detected())):
        result[f"slope_through_origin{suffix}"] = figure(slope, subset, scale="linear", confidence=confidence)
        result[f"r2_centred{suffix}"] = figure(r2_centred, subset)
        result[f"r2_uncentred{suffix}"] = figure(r2_uncentred, subset)
        result[f"r2_pearson{suffix}"] = figure(r2_pearson, subset)
        result[f"pearson_r{suffix}"] = figure(pearson_r, subset)
    return result


def slope(sizes: ModalitySizes) -> float:
    r"""Least-squares slope of sizes on ex-vivo sizes without an intercept, :math:`\sum e y / \sum e^2`."""
    e, y = _scaled(sizes)
    return float(e @ y / (e @ e))


def r2_centred(sizes: ModalitySizes) -> float:
    r"""Share of the variance about the mean that the line through zero explains, :math:`1 - SSE_0/SST`.

    Below 0 when the mean of the sizes would do better. Kvalseth (1985), Am. Stat. 39, 279, recommends it.
    """
    e, y = _scaled(sizes)
    _need_spread(y, f"all {len(y)} sizes are equal")
    centred = y - y.mean()
    return 1 - _sse(e, y) / float(centred @ centred)


def r2_uncentred(sizes: ModalitySizes) -> float:
    r"""Share of the sum of squares about zero that the line explains, :math:`1 - SSE_0/\sum y^2`.

    What R prints for ``lm(y ~ 0 + x)``; it flatters: any line through a cloud far from zero explains most of it.
    """
    e, y = _scaled(sizes)
    if not np.any(y):
        raise UndefinedError("no mass was detected")
    return 1 - _sse(e, y) / float(y @ y)


def pearson_r(sizes: ModalitySizes) -> float:
    """Correlation coefficient; its sign says what the squares hide."""
    e, y = _scaled(sizes)
    _need_spread(y, f"all {len(y)} sizes are equal")
    _need_spread(e, f"all {len(e)} ex-vivo sizes are equal")
    e, y = e - e.mean(), y - y.mean()
    r = float(e @ y) / float(np.sqrt(e @ e) * np.sqrt(y @ y))
    return min(1.0, max(-1.0, r))


def r2_pearson(sizes: ModalitySizes) -> float:
    """Squared correlation coefficient; blind to scale and offset."""
    return pearson_r(sizes) ** 2


def _scaled(sizes: ModalitySizes) -> tuple[FloatArray, FloatArray]:
    """Ex-vivo sizes and sizes over the largest ex-vivo size, so that squares neither overflow nor vanish."""
    unit = some(sizes.ex_vivo_mm).max()
    return sizes.ex_vivo_mm / unit, sizes.size_mm / unit


def _sse(e: FloatArray, y: FloatArray) -> float:
    residual = y - float(e @ y / (e @ e)) * e
    return float(residual @ residual)


def _need_spread(values: FloatArray, reason: str) -> None:
    if np.ptp(values) <= _EQUAL * np.abs(values).max():
        raise UndefinedError("one mass has no spread" if len(values) == 1 else reason)
