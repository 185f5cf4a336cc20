r"""Kernel, spreads and weights of the Gaussian process over a population's maps, see `size.fat_process`.

Given the kernel and the spread of B, the coefficients have a normal posterior in closed form, and with them each body's
size as the others predict it. Kernel and spreads are those by which bodies left out are most probable, with weak
priors (Rasmussen & Williams 2006, sec. 5.4.2), so that intervals hold on bodies never seen. By the evidence they held
too seldom; by a lower bound of it (Titsias 2009, eq. 9) the kernel's lengths were too long. The spread between exams
comes from how the exams of one body differ, as in `regression`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from tactile_bayes.geometry import FloatArray
from tactile_bayes.size.fat_process import LINEAR_POWERS, SPREAD, Kernel, PlaceTable
from tactile_bayes.size.learn.fat_depth import LEAST_BODIES, FatTable
from tactile_bayes.size.learn.regression import BodyRegression, ExamSpread, PopulationTable
from tactile_bayes.size.polynomials import monomials

POINTS: Final = 200
"""Points of the kernel; with fewer bodies a quarter of their number."""
BODIES_PER_POINT: Final = 4
SEED: Final = 1
"""Of the bodies that are the points."""
MAP_FACTORS: Final = np.geomspace(0.1, 6.0, 42)
"""By which the variance of maps may count, in steps of a tenth: figures by place move against a bump's noise."""
_LINEAR_SD = 10.0
_LENGTH, _SCALE, _BODY_SD = (np.log(2.0), 1.0), (np.log(0.3), 1.0), (np.log(0.1), 1.0)
"""Centre and width of the normal priors on the logs of lengths, scale and SD(B) at the centre."""
_SLOPE_SD = 0.3
"""Width of the prior on the other coefficients of ln SD(B)."""
_START_LENGTHS = (2.0, 0.7)
"""There are modes where what is smooth is taken for scatter, and the other way round."""
_STEP = 1e-4
_MOST_ITERATIONS = 200
_DIFFERENCE = 1e-4
"""Step of the gradient: below it the rounding of the solutions shows."""


@dataclass(frozen=True, slots=True, eq=False)
class ProcessRows:
    """Maps of a table as the process takes them.

    Parameters
    ----------
    data
        The regression on the linear part.
    x : (n, k) array
        Inputs of the kernel: u, v and the standardised profile, and the figures by place where these are known.
    spread : (b, s) array
        `SPREAD` of each body's mean.
    """

    data: BodyRegression
    x: FloatArray
    spread: FloatArray

    @classmethod
    def of(cls, table: FatTable, places: PlaceTable | None = None) -> ProcessRows:
        """The rows of a table whose maps all have a profile, and figures by place where `places` is given."""
        maps, depth, (u, v, w) = table.maps, table.depth, table.values
        assert maps.profile is not None
        x = np.column_stack([u, v, (maps.profile - depth.centre) / depth.scale])
        if places is not None and maps.by_place is not None:
            x = np.column_stack([x, places.standardised(maps.by_place)])
        nothing, linear = np.zeros((2, len(u))), monomials((u, v, w), LINEAR_POWERS)
        data = BodyRegression.linear(maps, linear, u=u, constant=nothing[0], slope=nothing)
        spread = monomials([data.mean(one) for one in (u, v, w)], SPREAD)
        return cls(data, x, spread)

    def mean(self, values: FloatArray) -> FloatArray:
        """(b, k) means of (n, k) values over each body's exams."""
        return np.stack([self.data.mean(column) for column in values.T], axis=1)


@dataclass(frozen=True, slots=True, eq=False)
class Fitted:
    """The process given its kernel and spreads.

    Parameters
    ----------
    kernel
    log_spread : (s,) array
        Coefficients of ln SD(B).
    mean, covariance : (k,), (k, k) arrays
        Of the linear coefficients and the weights.
    terms : (b, k) array
        Means of each body's terms.
    variance : (b,) array
        Of each body's mean ln d about the process.
    """

    kernel: Kernel
    log_spread: FloatArray
    mean: FloatArray
    covariance: FloatArray
    terms: FloatArray
    variance: FloatArray

    def left_out(self, log_d: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(b,) ln(predicted / true size) of each body held out, kernel and spreads kept, and the error's variance."""
        weight = np.sum(self.terms @ self.covariance * self.terms, axis=1) / self.variance
        residual = log_d - self.terms @ self.mean
        return -residual / (1.0 - weight), self.variance / (1.0 - weight)

    def left_out_density(self, log_d: FloatArray) -> float:
        """Log density of the (b,) bodies' sizes, each held out, without what no parameter changes."""
        error, variance = self.left_out(log_d)
        return float(-0.5 * np.sum(np.log(variance) + error**2 / variance))


def fit_process(table: PopulationTable, rows: ProcessRows) -> tuple[ProcessRows, Fitted, ExamSpread]:
    """Kernel and spreads with half of the points, then with all.

    Returns
    -------
    rows, fitted, exam
        The rows with what the maps' own variance counts, the fit, and the spread between exams.
    """
    count = max(min(POINTS, rows.data.groups // BODIES_PER_POINT), LEAST_BODIES // BODIES_PER_POINT)
    exam = rows.data.exam_spread(rows.data.least_squares())
    starts = [_start(rows, length) for length in _START_LENGTHS]
    for points_now in (count // 2, count):
        fits = [_best(rows, one, points_now, exam_sd=exam.sd) for one in starts]
        theta, points, _ = min(fits, key=lambda one: one[2])
        starts = [theta]
        fitted = given(rows, points, theta, exam_sd=exam.sd)
        variance = _map_variance(table, rows, fitted)
        whole = replace(rows.data, terms=all_terms(rows, fitted.kernel), map_variance=variance)
        exam = whole.exam_spread(fitted.mean, MAP_FACTORS)
        rows = replace(rows, data=replace(rows.data, map_variance=exam.map_factor * variance))
    fitted = given(rows, points, theta, exam_sd=exam.sd)
    return rows, _spread_by_left_out(rows, fitted, exam_sd=exam.sd), exam


def _spread_by_left_out(rows: ProcessRows, fitted: Fitted, *, exam_sd: float) -> Fitted:
    """The fit with the coefficients of ln SD(B) by which bodies left out are most probable, the kernel kept."""
    from scipy.optimize import minimize

    density = left_out_density(rows, fitted, exam_sd=exam_sd)

    def cost(log_spread: FloatArray) -> float:
        return -density(log_spread)

    found = minimize(cost, fitted.log_spread, method="L-BFGS-B", options={"eps": _DIFFERENCE})
    return _solved(rows, fitted.kernel, fitted.terms, np.asarray(found.x), exam_sd=exam_sd)


def left_out_density(rows: ProcessRows, fitted: Fitted, *, exam_sd: float) -> Callable[[FloatArray], float]:
    """Log density of all bodies, each left out, with the prior, by (s,) coefficients of ln SD(B)."""

    def density(log_spread: FloatArray) -> float:
        solved = _solved(rows, fitted.kernel, fitted.terms, log_spread, exam_sd=exam_sd)
        return solved.left_out_density(rows.data.mean_log_d) + _spread_prior(log_spread)

    return density


def drawn_points(x: FloatArray, count: int) -> FloatArray:
    """(m, k) of the (b, k) values, drawn at random: they lie as the bodies do, so most where most sizes are asked for.

    Notes
    -----
    Pivots of the kernel's incomplete Cholesky factor (Fine & Scheinberg 2001) lie at the table's ends first, and left
    bodies out with larger errors (record 0122).
    """
    return x[np.random.default_rng(SEED).choice(len(x), count, replace=False)]


def all_terms(rows: ProcessRows, kernel: Kernel) -> FloatArray:
    """(n, 4 + m) linear terms and functions of each map."""
    return np.concatenate([rows.data.terms[:, : len(LINEAR_POWERS)], kernel.functions(rows.x)], axis=1)


def given(rows: ProcessRows, points: FloatArray, theta: FloatArray, *, exam_sd: float) -> Fitted:
    """Posterior of the coefficients for one kernel and spread.

    Parameters
    ----------
    theta : (k + 1 + s,) array
        Logs of the k lengths and of the scale, coefficients of ln SD(B).
    """
    k = rows.x.shape[1]
    kernel = Kernel(points, np.exp(theta[:k]), float(np.exp(theta[k])))
    return _solved(rows, kernel, rows.mean(all_terms(rows, kernel)), theta[k + 1 :], exam_sd=exam_sd)


def _solved(rows: ProcessRows, kernel: Kernel, terms: FloatArray, log_spread: FloatArray, *, exam_sd: float) -> Fitted:
    """As `given`, for a kernel whose (b, k) terms are known."""
    data = rows.data
    variance = np.exp(2 * rows.spread @ log_spread) + (exam_sd**2 + data.mean(data.map_variance)) / data.exams
    prior = np.ones(terms.shape[1])
    prior[: len(LINEAR_POWERS)] = _LINEAR_SD**-2
    scaled = terms / np.sqrt(variance)[:, None]
    factor = np.linalg.cholesky(scaled.T @ scaled + np.diag(prior))
    inverse = np.linalg.inv(factor)
    covariance = inverse.T @ inverse
    left = data.mean_log_d / np.sqrt(variance)
    return Fitted(kernel, log_spread, covariance @ (scaled.T @ left), covariance, terms, variance)


def log_prior(theta: FloatArray, lengths: int) -> float:
    """Of the logs of lengths and scale and the coefficients of ln SD(B)."""
    of_lengths = np.sum(((theta[:lengths] - _LENGTH[0]) / _LENGTH[1]) ** 2)
    of_scale = ((theta[lengths] - _SCALE[0]) / _SCALE[1]) ** 2
    return float(-0.5 * (of_lengths + of_scale)) + _spread_prior(theta[lengths + 1 :])


def _spread_prior(log_spread: FloatArray) -> float:
    at_centre = ((log_spread[0] - _BODY_SD[0]) / _BODY_SD[1]) ** 2
    return float(-0.5 * (at_centre + np.sum((log_spread[1:] / _SLOPE_SD) ** 2)))


def _start(rows: ProcessRows, length: float) -> FloatArray:
    lengths, spread = np.full(rows.x.shape[1], np.log(length)), np.zeros(rows.spread.shape[1])
    spread[0] = _BODY_SD[0]
    return np.concatenate([lengths, [_SCALE[0]], spread])


def _of_means(rows: ProcessRows, *, exam_sd: float) -> ProcessRows:
    """The bodies' means as rows of one exam each, with its spread: exams of a body differ little."""
    data, count = rows.data, rows.data.groups
    means = replace(
        data,
        terms=data.mean_terms,
        constant=np.zeros(count),
        map_variance=(exam_sd**2 + data.mean(data.map_variance)) / data.exams,
        group=np.arange(count),
        exams=np.ones(count),
    )
    return replace(rows, data=means, x=rows.mean(rows.x))


def _best(rows: ProcessRows, start: FloatArray, count: int, *, exam_sd: float) -> tuple[FloatArray, FloatArray, float]:
    """Logs of kernel and spreads at the mode next to a start, the points, and the mode's negative log density."""
    from scipy.optimize import minimize

    points = drawn_points(rows.mean(rows.x), count)
    bodies, log_d = _of_means(rows, exam_sd=exam_sd), rows.data.mean_log_d

    def cost(theta: FloatArray) -> float:
        return -given(bodies, points, theta, exam_sd=0.0).left_out_density(log_d) - log_prior(theta, rows.x.shape[1])

    bounds = [(-2.0, 4.0)] * rows.x.shape[1] + [(-4.0, 2.0)] + [(-5.0, 1.0)]
    bounds += [(-1.5, 1.5)] * (len(start) - len(bounds))
    found = minimize(
        cost, start, method="L-BFGS-B", bounds=bounds, options={"maxiter": _MOST_ITERATIONS, "eps": _DIFFERENCE}
    )
    return np.asarray(found.x, dtype=np.float64), points, float(found.fun)


def _map_variance(table: PopulationTable, rows: ProcessRows, fitted: Fitted) -> FloatArray:
    """(n,) variance of the predicted ln d by the maps' own posteriors."""
    slopes = []
    for column, name in ((0, 1), (1, 2)):
        moved = rows.x.copy()
        moved[:, column] += _STEP
        change = (fitted.kernel.functions(moved) - fitted.kernel.functions(rows.x)) / _STEP
        slopes.append(fitted.mean[name] + change @ fitted.mean[len(LINEAR_POWERS) :])
    slope = np.stack(slopes)
    return np.asarray(np.einsum("in,nij,jn->n", slope, table.covariance[:, :2, :2], slope))
