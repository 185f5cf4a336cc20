"""How far sizes lie from excision: percent and mm errors, and the bias."""

from __future__ import annotations

import numpy as np

from tactile_bayes.trial.figures import Figure, figure
from tactile_bayes.trial.jackknife import UndefinedError
from tactile_bayes.trial.readings import FloatArray, ModalitySizes


def figures(sizes: ModalitySizes, *, confidence: float) -> dict[str, Figure]:
    """Accuracy of one modality: `mape_percent`, `mae_mm` (a mass not found counts as size 0), the same over detected
    masses only, and `bias_percent` (detected masses only: 0 has no logarithm)."""
    found = sizes.only_detected()
    bias = figure(geometric_ratio, found, scale="log", confidence=confidence)
    return {
        "mape_percent": figure(mape_percent, sizes, scale="log", confidence=confidence),
        "mape_detected_percent": figure(mape_percent, found, scale="log", confidence=confidence),
        "mae_mm": figure(mae_mm, sizes, scale="log", confidence=confidence),
        "mae_detected_mm": figure(mae_mm, found, scale="log", confidence=confidence),
        "bias_percent": bias.mapped(lambda ratio: 100 * (ratio - 1)),
    }


def mape_percent(sizes: ModalitySizes) -> float:
    r"""Mean absolute error in percent of the ex-vivo size; a mass not found has size 0, an error of 100 %.

    Notes
    -----
    .. math:: \frac{100}{n}\sum_i \frac{|y_i - e_i|}{e_i}

    Wellman & Howe (1999), section 4, call it "percent mean absolute error (MAE)".
    """
    return 100 * float(np.mean(np.abs(sizes.size_mm / some(sizes.ex_vivo_mm) - 1)))


def mae_mm(sizes: ModalitySizes) -> float:
    """Mean absolute error in mm."""
    return float(np.mean(np.abs(sizes.size_mm - some(sizes.ex_vivo_mm))))


def geometric_ratio(sizes: ModalitySizes) -> float:
    """Geometric mean of size over ex-vivo size; 1 without bias, and twofold up cancels twofold down."""
    return float(np.exp(np.mean(np.log(sizes.size_mm) - np.log(some(sizes.ex_vivo_mm)))))


def some(values: FloatArray) -> FloatArray:
    """The values, or `UndefinedError` when there are none."""
    if len(values) == 0:
        raise UndefinedError("no mass to average over")
    return values
