r"""Learning of Eq 6 from maps of a population of bodies.

The regression is that of `regression`, of ln d on Eq 6 where that is linear in ln d's terms: about its own mode Eq 6 is
replaced by its tangent, :math:`g(\theta) \approx g(\theta_0) + J(\theta - \theta_0)`, until the mode stays where the
tangent touches.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tactile_bayes.errors import NotConvergedError
from tactile_bayes.geometry import FloatArray
from tactile_bayes.size.eq6_terms import MU, F, Powers, eq6_log_size, eq6_terms
from tactile_bayes.size.learn.regression import BodyRegression, PopulationTable

_MOST_TANGENTS, _CLOSE, _STEP = 50, 1e-7, 1e-4


@dataclass(frozen=True, slots=True, eq=False)
class Eq6Rows:
    """Maps of a table as Eq 6 takes them.

    Parameters
    ----------
    u, v, w : (n,) arrays
        Centred ln a, p and ln F; w is 0 where the depth of fat plays no part.
    powers
        Which of mu, f and b each coefficient belongs to, and its powers of v and w.
    """

    u: FloatArray
    v: FloatArray
    w: FloatArray
    powers: Powers

    def tangent(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(n, k) slopes of ln d by the coefficients, and (n,) what the tangent has at zero coefficients."""
        terms = eq6_terms(self.u, self.v, self.w, theta, self.powers)
        return terms, self.log_size(theta) - terms @ theta

    def log_size(self, theta: FloatArray, *, du: float = 0.0, dv: float = 0.0) -> FloatArray:
        """(n,) ln d of the maps, moved by `du` and `dv`."""
        return eq6_log_size(self.u + du, self.v + dv, self.w, theta, self.powers)

    def map_slopes(self, theta: FloatArray) -> FloatArray:
        """(2, n) derivatives of ln d by ln a and p, by central differences."""
        h = _STEP
        by_u = self.log_size(theta, du=h) - self.log_size(theta, du=-h)
        by_v = self.log_size(theta, dv=h) - self.log_size(theta, dv=-h)
        return np.stack([by_u, by_v]) / (2 * h)


@dataclass(frozen=True, slots=True, eq=False)
class Eq6Fit:
    """Posterior of Eq 6's coefficients, taken as normal, and what it leaves of the bodies.

    Parameters
    ----------
    rows
    mean, covariance : (k,), (k, k) arrays
    data
        The regression on the tangent at the mean.
    """

    rows: Eq6Rows
    mean: FloatArray
    covariance: FloatArray
    data: BodyRegression


def fit_eq6(table: PopulationTable, rows: Eq6Rows) -> Eq6Fit:
    """The regression on the tangent at the mode, and the posterior's mean and covariance.

    Raises
    ------
    NotConvergedError
        When the posterior has no mode.
    """
    theta = _least_squares(table, rows)
    for _ in range(_MOST_TANGENTS):
        data = _regression(table, rows, theta)
        mean, covariance = data.posterior()
        step = mean - theta
        theta = mean
        if np.abs(data.mean_terms @ step).max() < _CLOSE:
            return Eq6Fit(rows, mean, covariance, data)
    raise NotConvergedError("the coefficients of Eq 6 have no mode in this table")


def _least_squares(table: PopulationTable, rows: Eq6Rows) -> FloatArray:
    """(k,) coefficients by least squares of the bodies' means: Gauss-Newton steps, halved while they lead uphill."""
    theta = np.zeros(len(rows.powers))
    theta[rows.powers.index((MU, 0, 0))] = np.log(table.d_mm).mean()
    theta[rows.powers.index((F, 0, 0))] = -0.3
    data = _regression(table, rows, theta)
    for _ in range(_MOST_TANGENTS):
        step = data.least_squares() - theta
        if np.abs(data.mean_terms @ step).max() < _CLOSE:
            return theta
        theta, data = _downhill(table, rows, theta, step, _misfit(data, theta))
    raise NotConvergedError("Eq 6 does not fit this table")


def _downhill(
    table: PopulationTable, rows: Eq6Rows, theta: FloatArray, step: FloatArray, misfit: float
) -> tuple[FloatArray, BodyRegression]:
    for _ in range(_MOST_TANGENTS):
        data = _regression(table, rows, theta + step)
        if _misfit(data, theta + step) <= misfit * (1.0 + 1e-12):
            return theta + step, data
        step = step / 2.0
    raise NotConvergedError("Eq 6 does not fit this table")


def _misfit(data: BodyRegression, theta: FloatArray) -> float:
    """Sum of squares where the tangent touches; infinite where a row has no size."""
    total = float(np.sum((data.mean_log_d - data.mean_terms @ theta) ** 2))
    return total if np.isfinite(total) else float("inf")


def _regression(table: PopulationTable, rows: Eq6Rows, theta: FloatArray) -> BodyRegression:
    terms, constant = rows.tangent(theta)
    return BodyRegression.linear(table, terms, u=rows.u, constant=constant, slope=rows.map_slopes(theta))
