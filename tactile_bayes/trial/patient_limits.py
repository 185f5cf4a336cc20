"""Limits of agreement with intervals over patients, for differences of any distribution and any masses per patient.

The exact and the approximate intervals that other programs print take the masses as independent and the differences as
normal; they are in `bland_altman` and stand beside these in the JSON report.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from tactile_bayes.trial.bootstrap import method_of
from tactile_bayes.trial.figures import Figure, Sample, figure
from tactile_bayes.trial.jackknife import Scale, UndefinedError, interval_from_values, kurtosis_freedom, on_scale
from tactile_bayes.trial.lines import centred
from tactile_bayes.trial.readings import FloatArray, ModalitySizes
from tactile_bayes.trial.sums import SumStatistic, columns, ratio

# 95 % of a normal distribution lie within so many SDs.
_SHARE = 1.959963984540054
_ONE = "one mass has no spread"
Ends = tuple[float, float]


def figures(found: ModalitySizes, *, confidence: float) -> dict[str, Figure]:
    """Lower and upper limit in mm and as the logarithm of the ratio, for single readings of detected masses."""
    made: dict[str, Figure] = {}
    for unit, terms in (("mm", _mm_terms), ("log_ratio", _log_terms)):
        for side, sign in (("low", -1), ("high", 1)):
            made[f"limit_{side}_{unit}"] = _limit(terms, sign, found, confidence=confidence)
    return made


def _limit(
    terms: Callable[[ModalitySizes], FloatArray], sign: int, found: ModalitySizes, *, confidence: float
) -> Figure:
    plain = figure(SumStatistic(terms, partial(_end, sign), _ONE), found, scale="linear", confidence=confidence)
    if method_of(confidence) != "corrected" or plain.interval is None:
        return plain
    try:
        return replace(plain, interval=_recovered(terms, sign, found, confidence=confidence))
    except UndefinedError as undefined:
        return replace(plain, interval=None, interval_reason=str(undefined))


def _recovered(
    terms: Callable[[ModalitySizes], FloatArray], sign: int, found: ModalitySizes, *, confidence: float
) -> Ends:
    """Interval of a limit from those of the mean and, on the log scale, of the SD (Zou 2013, see `bland_altman`)."""
    mean, around = _jackknifed(SumStatistic(terms, _mean, _ONE), found, scale="linear", confidence=confidence)
    sd, about = _jackknifed(SumStatistic(terms, _sd, _ONE), found, scale="log", confidence=confidence)
    limit = mean + sign * _SHARE * sd
    inner, outer = _SHARE * (sd - about[0]), _SHARE * (about[1] - sd)
    below, above = (inner, outer) if sign > 0 else (outer, inner)
    return limit - math.hypot(mean - around[0], below), limit + math.hypot(around[1] - mean, above)


def _jackknifed(
    statistic: SumStatistic, found: ModalitySizes, *, scale: Scale, confidence: float
) -> tuple[float, Ends]:
    """Value with its jackknife interval, and the degrees of freedom of its leave-one-out values."""
    sample = Sample(statistic, found)
    value, left = sample.value(), sample.left_out()
    freedom = kurtosis_freedom(np.asarray(on_scale(left, scale)))
    return value, interval_from_values(value, left, scale=scale, confidence=float(confidence), freedom=freedom)


def _mm_terms(sizes: ModalitySizes) -> FloatArray:
    return _terms(sizes.size_mm - sizes.ex_vivo_mm, sizes.replicates_mm)


def _log_terms(sizes: ModalitySizes) -> FloatArray:
    logs = tuple(np.log(group) for group in sizes.replicates_mm)
    if not any(len(group) > 1 for group in logs):
        return _terms(np.log(sizes.size_mm / sizes.ex_vivo_mm), logs)
    return _terms(np.array([group.mean() for group in logs]) - np.log(sizes.ex_vivo_mm), logs)


def _terms(differences: FloatArray, replicates: tuple[FloatArray, ...]) -> FloatArray:
    """1, d, d', d'd', 1/m, squares about the mass's mean and their degrees of freedom; ' about the mean of all d."""
    if len(differences) == 0:
        raise UndefinedError("no mass was detected")
    off = centred(differences, differences.mean())
    number = np.array([max(len(group), 1) for group in replicates], dtype=np.float64)
    squares = np.array([float(np.sum((group - group.mean()) ** 2)) if len(group) > 1 else 0.0 for group in replicates])
    return columns(1.0, differences, off, off * off, 1 / number, squares, number - 1)


def _mean(sums: FloatArray) -> FloatArray:
    return ratio(sums[..., 1], sums[..., 0])


def _sd(sums: FloatArray) -> FloatArray:
    """SD of one difference: that of the masses' means, plus the part that averaging over replicates removed."""
    n, _, first, second, inverse, squares, freedom = np.moveaxis(sums, -1, 0)
    between = ratio(second - first**2 / n, n - 1)
    within = np.where(freedom > 0.5, ratio(squares, freedom), 0.0)
    return np.asarray(np.sqrt(np.maximum(between + (1 - inverse / n) * within, 0.0)))


def _end(sign: int, sums: FloatArray) -> FloatArray:
    return np.asarray(_mean(sums) + sign * _SHARE * _sd(sums))
