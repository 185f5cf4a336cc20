r"""Learning of Eq 6 from maps of a population of bodies.

The regression is that of `regression`, of ln d on Eq 6 where that is linear in ln d's terms: about its own mode Eq 6 is
replaced by its tangent, :math:`g(\theta) \approx g(\theta_0) + J(\theta - \theta_0)`, until the mode stays where the
tangent touches. Coefficients, spread between bodies and spread between exams are so learned jointly.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tactile_bayes.errors import NotConvergedError
from tactile_bayes.geometry import FloatArray
from tactile_bayes.size.eq6 import Recipe
from tactile_bayes.size.hidden import RoundLumps
from tactile_bayes.size.learn.fat_depth import FatTable
from tactile_bayes.size.learn.hidden import hidden_terms
from tactile_bayes.size.learn.regression import (
    BodyRegression,
    PopulationTable,
    check_population,
    domain_of,
    figures,
    leverages,
)
from tactile_bayes.size.learn.round_lumps import learn_round
from tactile_bayes.size.polynomials import monomials, powers
from tactile_bayes.size.population_eq6 import (
    FAT_COEFFICIENTS,
    FAT_FEATURES,
    FEATURES,
    MU,
    PLAIN,
    F,
    FatEq6,
    PopulationEq6,
    eq6_parts,
    eq6_slopes,
)

_PLAIN = tuple((row, i, 0) for row, i in PLAIN)
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
    powers: tuple[tuple[int, int, int], ...]

    def tangent(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(n, k) slopes of ln d by the coefficients, and (n,) what the tangent has at zero coefficients."""
        stretched, size = eq6_parts(self.u, self.v, *self._coefficients(theta, self.v))
        slopes = eq6_slopes(self.u, stretched, size)
        terms = np.stack([slopes[:, row] * self.v**i * self.w**k for row, i, k in self.powers], axis=1)
        return terms, np.log(size) - terms @ theta

    def map_slopes(self, theta: FloatArray) -> FloatArray:
        """(2, n) derivatives of ln d by ln a and p, the second by central differences."""
        coefficients = self._coefficients(theta, self.v)
        stretched, size = eq6_parts(self.u, self.v, *coefficients)
        high, low = (eq6_parts(self.u, self.v + h, *self._coefficients(theta, self.v + h))[1] for h in (_STEP, -_STEP))
        return np.stack([-coefficients[F] * stretched / size, np.log(high / low) / (2 * _STEP)])

    def _coefficients(self, theta: FloatArray, v: FloatArray) -> FloatArray:
        """(3, n) mu, f and b of each map."""
        found = np.zeros((3, len(self.u)))
        for value, (row, i, k) in zip(theta, self.powers, strict=True):
            found[row] += value * v**i * self.w**k
        return found


def learn_population_eq6(table: PopulationTable, *, recipe: Recipe, source: str = "") -> PopulationEq6:
    """Learn the calibration; where the table has profiles of the head, also the one that knows the fat's depth.

    Parameters
    ----------
    table
        As for `learn_log_quadratic`.

    Raises
    ------
    BadDataError
        When bodies are too few or do not vary.
    NotConvergedError
        When the posterior has no mode.
    """
    check_population(table)
    centre = _centre(table)
    u, v = table.log_amplitude - centre[0], table.log_width - centre[1]
    data, mean, covariance = _posterior(table, Eq6Rows(u, v, np.zeros_like(u), _PLAIN))
    features = monomials((u, v), FEATURES)
    inverse, leverage = leverages(features)
    return PopulationEq6(
        centre=centre,
        mean=mean,
        covariance=covariance,
        round_lumps=RoundLumps(*learn_round(table, monomials((u, v), powers(2)))),
        information_inverse=inverse,
        most_leverage=float(leverage.max()),
        domain=domain_of(table),
        recipe=recipe,
        hidden=hidden_terms(table, data, **data.bodies_left_out(mean), features=features),
        fit=figures(table, data, mean),
        source=source,
        with_fat=learn_fat_eq6(table),
        log_amplitude_one_deep=_log_amplitude_one_deep(table),
    )


def learn_fat_eq6(table: PopulationTable) -> FatEq6 | None:
    """Eq 6 by the depth of fat, from the maps with a profile; None for too few bodies.

    Raises
    ------
    NotConvergedError
        When the posterior has no mode.
    """
    found = FatTable.of(table)
    if found is None:
        return None
    data, mean, covariance = _posterior(found.maps, Eq6Rows(*found.values, FAT_COEFFICIENTS))
    features = monomials(found.values, FAT_FEATURES)
    return FatEq6(
        **found.fields(features),
        mean=mean,
        covariance=covariance,
        hidden=hidden_terms(found.maps, data, **data.bodies_left_out(mean), features=features),
        fit=figures(found.maps, data, mean),
    )


def _posterior(table: PopulationTable, rows: Eq6Rows) -> tuple[BodyRegression, FloatArray, FloatArray]:
    """The regression on the tangent at the mode, and the posterior's mean and covariance."""
    theta = _least_squares(table, rows)
    for _ in range(_MOST_TANGENTS):
        data = _regression(table, rows, theta)
        mean, covariance = data.posterior()
        step = mean[:-3] - theta
        theta = mean[:-3]
        if np.abs(data.mean_terms @ step).max() < _CLOSE:
            return data, mean, covariance
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


def _centre(table: PopulationTable) -> tuple[float, float]:
    return round(float(table.log_amplitude.mean()), 3), round(float(table.log_width.mean()), 3)


def _log_amplitude_one_deep(table: PopulationTable) -> float:
    """ln a of lumps one diameter deep, by a quadratic in ln(h/d); 0, so that e is 1, where depths are not known."""
    if "depth_mm" not in table.unknowns:
        return 0.0
    log_ratio = table.unknowns["depth_mm"] - np.log(table.d_mm)
    design = np.stack([np.ones_like(log_ratio), log_ratio, log_ratio**2], axis=1)
    return float(np.linalg.lstsq(design, table.log_amplitude, rcond=None)[0][0])
