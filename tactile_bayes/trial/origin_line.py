"""The paper's line through zero, with three figures that are all called r squared.

The paper names no convention for r squared; its printed 0.14 can only be the centred or Pearson's (shared reading of
Fig. 10), so the centred one leads. The regression is of sizes y on ex-vivo sizes e.
"""

from __future__ import annotations

import numpy as np

from tactile_bayes.trial.accuracy import some
from tactile_bayes.trial.figures import Figure, figure
from tactile_bayes.trial.jackknife import UndefinedError
from tactile_bayes.trial.lines import all_equal
from tactile_bayes.trial.misses import by_square, figure_with_misses
from tactile_bayes.trial.readings import FloatArray, ModalitySizes
from tactile_bayes.trial.sums import SumStatistic, columns, ratio


def figures(sizes: ModalitySizes, *, confidence: float) -> dict[str, Figure]:
    """Slope and r squared with missed masses at size 0 (the paper's convention), then over detected masses only."""
    result: dict[str, Figure] = {}
    for suffix, subset in (("", sizes), ("_detected", sizes.only_detected())):
        result[f"slope_through_origin{suffix}"] = figure_with_misses(
            slope, subset, scale="linear", confidence=confidence, weight=by_square, missed=lambda _: 0.0
        )
        result[f"r2_centred{suffix}"] = figure(r2_centred, subset)
        result[f"r2_uncentred{suffix}"] = figure(r2_uncentred, subset)
        result[f"r2_pearson{suffix}"] = figure(r2_pearson, subset)
        result[f"pearson_r{suffix}"] = figure(pearson_r, subset)
    return result


def _terms(sizes: ModalitySizes) -> FloatArray:
    """Products of sizes, then of sizes about their means: e e, e y, y y, 1, e', y', e'e', e'y', y'y'."""
    e, y = _scaled(sizes)
    de, dy = e - e.mean(), y - y.mean()
    return columns(e * e, e * y, y * y, 1.0, de, dy, de * de, de * dy, dy * dy)


def _terms_of_varied_sizes(sizes: ModalitySizes) -> FloatArray:
    _need_spread(sizes.size_mm, f"all {len(sizes.size_mm)} sizes are equal")
    return _terms(sizes)


def _terms_of_varied_pairs(sizes: ModalitySizes) -> FloatArray:
    terms = _terms_of_varied_sizes(sizes)
    _need_spread(sizes.ex_vivo_mm, f"all {len(sizes.ex_vivo_mm)} ex-vivo sizes are equal")
    return terms


def _slope(sums: FloatArray) -> FloatArray:
    return ratio(sums[..., 1], sums[..., 0])


def _sse(sums: FloatArray) -> FloatArray:
    """Sum of squares about the line through zero."""
    return np.maximum(sums[..., 2] - _slope(sums) * sums[..., 1], 0.0)


def _sst(sums: FloatArray) -> FloatArray:
    return sums[..., 8] - sums[..., 5] ** 2 / sums[..., 3]


def _pearson(sums: FloatArray) -> FloatArray:
    n = sums[..., 3]
    product = sums[..., 7] - sums[..., 4] * sums[..., 5] / n
    return np.clip(ratio(product, np.sqrt((sums[..., 6] - sums[..., 4] ** 2 / n) * _sst(sums))), -1.0, 1.0)


# Least-squares slope of sizes on ex-vivo sizes without an intercept: sum e y / sum e^2.
slope = SumStatistic(_terms, _slope)

# Share of the variance about the mean that the line through zero explains, 1 - SSE0 / SST; below 0 when the mean of
# the sizes would do better. Kvalseth (1985), Am. Stat. 39, 279, recommends it.
r2_centred = SumStatistic(_terms_of_varied_sizes, lambda sums: 1 - ratio(_sse(sums), _sst(sums)))

# Share of the sum of squares about zero that the line explains, 1 - SSE0 / sum y^2: what R prints for
# lm(y ~ 0 + x). It flatters: any line through a cloud far from zero explains most of it.
r2_uncentred = SumStatistic(_terms, lambda sums: 1 - ratio(_sse(sums), sums[..., 2]), "no mass was detected")

# Correlation coefficient; its sign says what the squares hide.
pearson_r = SumStatistic(_terms_of_varied_pairs, _pearson)

# Squared correlation coefficient; blind to scale and offset.
r2_pearson = SumStatistic(_terms_of_varied_pairs, lambda sums: _pearson(sums) ** 2)


def _scaled(sizes: ModalitySizes) -> tuple[FloatArray, FloatArray]:
    """Sizes over the largest ex-vivo size, so that squares neither overflow nor vanish."""
    unit = some(sizes.ex_vivo_mm).max()
    return sizes.ex_vivo_mm / unit, sizes.size_mm / unit


def _need_spread(values: FloatArray, reason: str) -> None:
    some(values)
    if all_equal(values):
        raise UndefinedError("one mass has no spread" if len(values) == 1 else reason)
