r"""Errors of a calibration on bodies that it was not learned from, and what they tell of bodies of another origin.

Each body is sized by the mean of its exams. Where lumps come from another simulator, or are phantoms, their errors
:math:`e_j \sim N(0, s_j^2 + \tau^2)`, with :math:`s_j^2` what the calibration states: tau is `other_sd`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from tactile_bayes.geometry import FloatArray
from tactile_bayes.size.body_calibration import BodyCalibration
from tactile_bayes.size.hidden import LOGGED
from tactile_bayes.size.learn.regression import PopulationTable
from tactile_bayes.size.supposed import known_body

_STEP = 1e-3
_GRID = np.linspace(0.0, 0.3, 301)
"""Of tau."""


@dataclass(frozen=True, slots=True)
class Sized:
    """Bodies that took no part: (b,) ln of sized over true size, and the variance stated."""

    error: FloatArray
    variance: FloatArray


def sized(calibration: BodyCalibration, table: PopulationTable, *, known: Sequence[str] = ()) -> Sized:
    """The bodies of a table, each by all its exams.

    Parameters
    ----------
    known
        Properties of which the true value is told.
    """
    bodies = np.unique(table.body)
    found = np.array([size_error(calibration, table.rows(table.body == one), known=known) for one in bodies])
    return Sized(*found.T)


def size_error(
    calibration: BodyCalibration, exams: PopulationTable, *, known: Sequence[str] = ()
) -> tuple[float, float]:
    """Log error of one body by the mean of its exams, and the variance that the calibration states."""
    at = calibration.at_fat(_known(exams.profile, len(exams)))
    a, p = exams.log_amplitude, exams.log_width
    noise = _map_variance(at, exams)
    terms = at.terms(a, p).mean(axis=0, keepdims=True)
    middle = a.mean(keepdims=True), p.mean(keepdims=True)
    told = {name: float(exams.unknowns[name][0]) for name in known}
    told = {name: float(np.exp(value)) if name in LOGGED else value for name, value in told.items()}
    left = known_body(at, told, *middle, at.own_sd(at.body_sd(*middle, np.zeros(1))))
    exam = (noise.mean() + np.exp(2 * at.mean[-1])) / len(exams)
    variance = left.variance[0] + at.other_sd**2 + at.coefficient_variance(terms)[0] + exam
    size = at.log_size(a, p).mean() + left.expected[0]
    return float(size - np.log(exams.d_mm[0])), float(variance)


def learn_other_sd(calibration: BodyCalibration, table: PopulationTable, *, source: str) -> BodyCalibration:
    """The calibration with `other_sd` from lumps of another origin: the most probable tau, even a priori.

    Its fit tells ``other_masses``, ``other_sd_most``, below which tau lies with 95 % probability, and the errors.

    Parameters
    ----------
    source
        In words: what the table was made of.
    """
    found = sized(replace(calibration, other_sd=0.0), table)
    variance = found.variance + _GRID[:, None] ** 2
    log = -0.5 * np.sum(np.log(variance) + found.error**2 / variance, axis=1)
    density = np.exp(log - log.max())
    other_sd = float(_GRID[log.argmax()])
    off = np.expm1(found.error)
    fit = {
        "other_masses": float(len(found.error)),
        "other_sd_most": float(_GRID[np.searchsorted(np.cumsum(density / density.sum()), 0.95)]),
        "other_mae_percent": float(100 * np.abs(off).mean()),
        "other_bias_percent": float(100 * off.mean()),
        "other_standard_sd": float(np.sqrt(np.mean(found.error**2 / (found.variance + other_sd**2)))),
    }
    return replace(calibration, other_sd=other_sd, other_source=source, fit={**calibration.fit, **fit})


def _map_variance(at: BodyCalibration, exams: PopulationTable) -> FloatArray:
    """(n,) variance of ln d by each map's own posterior."""
    a, p = exams.log_amplitude, exams.log_width
    by_a = (at.log_size(a + _STEP, p) - at.log_size(a - _STEP, p)) / (2 * _STEP)
    slope = np.stack([by_a, at.width_slope(a, p)])
    return np.asarray(np.einsum("in,nij,jn->n", slope, exams.covariance[:, :2, :2], slope))


def _known(figures: FloatArray | None, number: int) -> Sequence[tuple[float, ...] | None]:
    """Figures of each exam; None where it has none."""
    if figures is None:
        return [None] * number
    return [tuple(one) if np.isfinite(one).all() else None for one in figures]
