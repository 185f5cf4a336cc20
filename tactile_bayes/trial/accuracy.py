"""Accuracy against excision: percent and mm errors, and bias."""

from __future__ import annotations

from functools import partial

import numpy as np

from tactile_bayes.trial.figures import Figure, figure
from tactile_bayes.trial.jackknife import UndefinedError
from tactile_bayes.trial.misses import alike, by_size, figure_with_misses
from tactile_bayes.trial.readings import FloatArray, ModalitySizes
from tactile_bayes.trial.sums import SumStatistic, columns, ratio


def figures(sizes: ModalitySizes, *, confidence: float) -> dict[str, Figure]:
    """Accuracy of one modality: `mape_percent`, `mae_mm` (a mass not found counts as size 0), the same over detected
    masses only, weighted and median percent errors, and `bias_percent` (detected only: 0 has no logarithm)."""
    found = sizes.only_detected()
    bias = figure(geometric_ratio, found, scale="log", confidence=confidence)
    on_log = partial(figure_with_misses, scale="log", confidence=confidence)
    return {
        "mape_percent": mape_figure(sizes, confidence=confidence),
        "mape_detected_percent": figure(mape_percent, found, scale="log", confidence=confidence),
        "mae_mm": on_log(mae_mm, sizes, weight=alike, missed=lambda one: float(one.ex_vivo_mm.mean())),
        "mae_detected_mm": figure(mae_mm, found, scale="log", confidence=confidence),
        "weighted_mape_percent": on_log(weighted_mape_percent, sizes, weight=by_size, missed=lambda _: 100.0),
        "median_error_percent": figure(median_percent, sizes),
        "bias_percent": bias.mapped(lambda ratio: 100 * (ratio - 1)),
    }


def mape_figure(sizes: ModalitySizes, *, confidence: float) -> Figure:
    """Percent error with its interval; a mass not found counts as 100 %."""
    return figure_with_misses(
        mape_percent, sizes, scale="log", confidence=confidence, weight=alike, missed=lambda _: 100.0
    )


def _percent_errors(sizes: ModalitySizes) -> FloatArray:
    return columns(np.abs(sizes.size_mm / some(sizes.ex_vivo_mm) - 1), 1.0)


def _mm_errors(sizes: ModalitySizes) -> FloatArray:
    return columns(np.abs(sizes.size_mm - some(sizes.ex_vivo_mm)), 1.0, sizes.ex_vivo_mm)


def _log_ratios(sizes: ModalitySizes) -> FloatArray:
    return columns(np.log(sizes.size_mm) - np.log(some(sizes.ex_vivo_mm)), 1.0)


def _mean(sums: FloatArray) -> FloatArray:
    return ratio(sums[..., 0], sums[..., 1])


# Mean absolute error in percent of the ex-vivo size, each mass alike; a mass not found has size 0, an error of 100 %:
# 100/n sum |y - e| / e. Wellman & Howe (1999), section 3, call it "percent mean absolute error (MAE)".
mape_percent = SumStatistic(_percent_errors, lambda sums: 100 * _mean(sums), "no mass to average over")

# The same weighted by ex-vivo size: the sum of absolute errors over the sum of the sizes, in percent.
weighted_mape_percent = SumStatistic(
    _mm_errors, lambda sums: 100 * ratio(sums[..., 0], sums[..., 2]), "no mass to average over"
)

# Mean absolute error in mm.
mae_mm = SumStatistic(_mm_errors, _mean, "no mass to average over")

# Geometric mean of size over ex-vivo size; 1 without bias, and twofold up cancels twofold down.
geometric_ratio = SumStatistic(_log_ratios, lambda sums: np.exp(_mean(sums)), "no mass to average over")


def median_percent(sizes: ModalitySizes) -> float:
    """Median absolute error in percent of the ex-vivo size."""
    return 100 * float(np.median(np.abs(sizes.size_mm / some(sizes.ex_vivo_mm) - 1)))


def some(values: FloatArray) -> FloatArray:
    """Return the values; `UndefinedError` when there are none."""
    if len(values) == 0:
        raise UndefinedError("no mass to average over")
    return values
