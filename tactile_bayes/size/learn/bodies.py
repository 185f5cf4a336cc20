r"""Learning of a size calibration from maps of a population of bodies, see `size.bodies`.

The regression is that of `regression`, of ln d on Eq 6 where that is linear in ln d's terms: about its own mode Eq 6 is
replaced by its tangent, :math:`g(\theta) \approx g(\theta_0) + J(\theta - \theta_0)`, until the mode stays where the
tangent touches.

Held-out bodies are sized by the mean of their exams. Where lumps come from another simulator, or are phantoms,
their errors :math:`e_j \sim N(0, s_j^2 + \tau^2)`, with :math:`s_j^2` what the calibration states: tau is `other_sd`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from scipy.special import ndtri

from tactile_bayes.declarations import Record, replace
from tactile_bayes.errors import NotConvergedError
from tactile_bayes.geometry import FloatArray
from tactile_bayes.presets import HELD_OUT_PROBABILITY
from tactile_bayes.size.bodies import CUBIC, QUADRATIC, BodyCalibration, Centre, Spread, known_body
from tactile_bayes.size.eq6 import BY_DEPTH, MU, PLAIN, Eq6Law, F, Powers, eq6_log_size, eq6_terms
from tactile_bayes.size.learn import regression
from tactile_bayes.size.terms import LOGGED, FatDepth, Recipe, monomials, powers, profile_terms

LEAST_BODIES: Final = 80
"""With a head profile: with fewer bodies Eq 6 without the fat's depth is all that a table supports."""
INSIDE: Final = 0.99
"""Share of the table's maps that count as inside it: its largest leverage is an outlier's, ten times what is left."""
_MOST_TANGENTS, _CLOSE, _STEP, _MAP_STEP = 50, 1e-7, 1e-4, 1e-3
_OTHER_SDS = np.linspace(0.0, 0.3, 301)  #: Grid of tau.


def learn_population(
    table: regression.PopulationTable, *, recipe: Recipe, source: str = "", residual: bool = True
) -> BodyCalibration:
    """Learn the calibration: Eq 6, by the depth of the fat where maps have a head profile, and its residual.

    Without `residual`, and from a table without profiles, it is Eq 6 alone. `BadDataError` when bodies are too few or
    do not vary, `NotConvergedError` when the posterior has no mode.
    """
    regression.check_population(table)
    rows = TableRows.of(table)
    eq6 = fit_eq6(rows)
    left = eq6.data.mean_log_d - eq6.data.mean_terms @ eq6.mean
    left = left / (1.0 - regression.leverages(eq6.data.mean_terms)[1])  # each body left out of the fit
    size, slope = rows.log_size(eq6.mean), rows.map_slopes(eq6.mean)
    exam, noise = _exams(rows, eq6, size, slope)
    fitted = None
    if residual and rows.depth is not None:
        residuals = regression.BodyResiduals(rows.of_bodies(eq6.data), rows.spread_terms(eq6.data), left, noise)
        fitted = regression.fit_residual(residuals)
        steps = np.eye(3)[:2] * _STEP  # along u and v
        slopes = [(fitted.at(rows.values + h) - fitted.at(rows.values - h)) / (2 * _STEP) for h in steps]
        size, slope = size + fitted.at(rows.values), slope + np.stack(slopes)
        exam, noise = _exams(rows, eq6, size, slope)
        left, noise = left - fitted.predicted, noise + fitted.variance
    return _calibration(rows, eq6, fitted, exam, left=left, noise=noise, recipe=recipe, source=source)


class TableRows(Record, eq=False):
    """Maps of a table with (n, 3) u, v and w, and the depth of fat where enough bodies have a profile of the head.

    Without it, `depth` is None and w 0.
    """

    maps: regression.PopulationTable
    depth: FatDepth | None
    centre: Centre
    values: FloatArray
    eq6_powers: Powers = PLAIN  #: Those of `Eq6Law`.
    feature_powers: Powers = QUADRATIC[:6]  #: Of the features of a map, see `BodyLaw`.
    spread_powers: Powers = QUADRATIC[:6]  #: Of the terms of ln SD(B).

    @classmethod
    def of(cls, table: regression.PopulationTable) -> TableRows:
        """The rows with a profile, or all where too few bodies have one."""
        maps, depth, log_depth = table, None, np.zeros(len(table))
        if table.profile is not None and table.log_fat is not None:
            known = np.isfinite(table.profile.sum(axis=1))
            if len(np.unique(table.body[known])) >= LEAST_BODIES:
                maps, depth = regression.rows_of(table, known), learn_depth(table.profile[known], table.log_fat[known])
                log_depth = depth.log_depth(table.profile[known])
        rows = np.column_stack([maps.log_amplitude, maps.log_width, log_depth])
        centre = [round(float(column.mean()), 3) for column in rows.T]
        values = rows - centre
        if depth is None:
            return cls(maps, None, Centre(*centre), values)
        x = monomials(list(values.T[:2]), powers(2))  # E[w | amplitude, width]
        expected = np.asarray(np.linalg.lstsq(x, values[:, 2], rcond=None)[0])
        depth = replace(depth, expected=expected, expected_sd=float(np.std(values[:, 2] - x @ expected)))
        return cls(maps, depth, Centre(*centre), values, BY_DEPTH, CUBIC, QUADRATIC)

    def of_bodies(self, data: regression.BodyRegression) -> FloatArray:
        """(b, 3) means of u, v and w over each body's exams."""
        return np.stack([data.mean(column) for column in self.values.T], axis=1)

    def spread_terms(self, data: regression.BodyRegression) -> FloatArray:
        """(b, s) terms of ln SD(B) at these."""
        return monomials(list(self.of_bodies(data).T), self.spread_powers)

    def log_size(self, theta: FloatArray, *, du: float = 0.0, dv: float = 0.0) -> FloatArray:
        """(n,) ln d of the maps by Eq 6, at u + `du` and v + `dv`."""
        u, v, w = self.values.T
        return eq6_log_size(u + du, v + dv, w, theta, self.eq6_powers)

    def map_slopes(self, theta: FloatArray) -> FloatArray:
        """(2, n) derivatives of ln d by ln a and p, by central differences."""
        by_u = self.log_size(theta, du=_STEP) - self.log_size(theta, du=-_STEP)
        by_v = self.log_size(theta, dv=_STEP) - self.log_size(theta, dv=-_STEP)
        return np.stack([by_u, by_v]) / (2 * _STEP)

    def tangent(self, theta: FloatArray) -> regression.BodyRegression:
        """The regression of ln d on the tangent of Eq 6 at these coefficients."""
        u, v, w = self.values.T
        terms = eq6_terms(u, v, w, theta, self.eq6_powers)
        constant = self.log_size(theta) - terms @ theta
        return regression.BodyRegression.linear(self.maps, terms, u=u, constant=constant, slope=self.map_slopes(theta))


def learn_depth(profile: FloatArray, log_fat: FloatArray) -> FatDepth:
    """Fit ln F by least squares on the full quadratic of (n, 3) profiles."""
    centre, scale = profile.mean(axis=0), profile.std(axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    x = profile_terms((profile - centre) / scale)
    inverse = np.asarray(np.linalg.pinv(x.T @ x), dtype=np.float64)
    coefficients = inverse @ (x.T @ log_fat)
    fitted = x @ coefficients
    rest = log_fat - fitted
    return FatDepth(
        centre,
        scale,
        np.asarray(coefficients),
        inverse,
        float(np.einsum("ni,ij,nj->n", x, inverse, x).max()),
        float(np.sqrt(np.sum(rest**2) / max(len(rest) - x.shape[1], 1))),
        fat_mm=(float(np.exp(fitted.min())), float(np.exp(fitted.max()))),
        expected=np.zeros(len(powers(2))),
        expected_sd=0.0,
    )


def _exams(rows: TableRows, eq6: Eq6Fit, size: FloatArray, slope: FloatArray) -> tuple[tuple[float, float], FloatArray]:
    """Its `exam_spread`, and (b,) variance of each body's ln d by its exams and the coefficients of Eq 6."""
    data = replace(eq6.data, map_variance=regression.map_variance(rows.maps, slope))
    exam = data.exam_spread(size)
    coefficients = np.sum(data.mean_terms @ eq6.covariance * data.mean_terms, axis=1)
    return exam, (np.exp(exam[0]) ** 2 + data.mean(data.map_variance)) / data.exams + coefficients


def _calibration(
    rows: TableRows,
    eq6: Eq6Fit,
    fitted: regression.FittedResidual | None,
    exam: tuple[float, float],
    *,
    left: FloatArray,
    noise: FloatArray,
    recipe: Recipe,
    source: str,
) -> BodyCalibration:
    """The calibration, from the bodies' (b,) held-out residuals of ln d and their variance without B."""
    data, maps, features = eq6.data, rows.maps, monomials(list(rows.values.T), rows.feature_powers)
    spread, of_spread = regression.body_spread(rows.spread_terms(data), left, noise)
    body_sd = np.exp(rows.spread_terms(data) @ spread)
    inverse, leverage = regression.leverages(features)
    held = float(np.mean(np.abs(left) <= ndtri(0.5 + HELD_OUT_PROBABILITY / 2) * np.sqrt(body_sd**2 + noise)))
    ranged = {"amplitude": np.exp(maps.log_amplitude), "sigma_mm": np.exp(maps.log_width), "d_mm": maps.d_mm}
    off = np.expm1(-left)  # of sizes of bodies left out
    figures = {
        "maps": float(len(maps)),
        "bodies": float(len(data.exams)),
        "body_sd": float(np.median(body_sd)),
        "exam_sd": float(np.exp(exam[0])),
        "left_out_sd": float(left.std()),
        "left_out_mae_percent": float(100 * np.mean(np.abs(off))),
        "left_out_bias_percent": float(100 * np.mean(off)),
        "left_out_held_percent": 100 * held,
    }
    calibration = BodyCalibration(
        centre=rows.centre,
        eq6=Eq6Law(rows.eq6_powers, eq6.mean, eq6.covariance, _log_amplitude_one_deep(maps)),
        residual=None if fitted is None else fitted.residual,
        spread=Spread(rows.spread_powers, spread, of_spread, *exam, 0.0, ""),
        round_lumps=regression.learn_round_lumps(maps, monomials(list(rows.values.T), rows.spread_powers)),
        feature_powers=rows.feature_powers,
        information_inverse=inverse,
        most_leverage=float(np.quantile(leverage, INSIDE)),
        domain=regression.value_ranges(ranged),
        recipe=recipe,
        depth=rows.depth,
        hidden=regression.hidden_terms(maps, data, body=left, body_sd=body_sd, features=features),
        hidden_any=None,
        fit=figures,
        source=source,
        bodies={},
    )
    if rows.depth is None:
        return calibration
    at, a, p = calibration.at_fat([None]), maps.log_amplitude, maps.log_width
    body = data.mean(np.log(maps.d_mm) - at.log_size(a, p))
    body_sd = at.body_sd(data.mean(a), data.mean(p), np.zeros(len(data.exams)))
    hidden_any = regression.hidden_terms(maps, data, body=body, body_sd=body_sd, features=at.features(a, p))
    return replace(calibration, hidden_any=hidden_any)


def _log_amplitude_one_deep(table: regression.PopulationTable) -> float:
    """ln a of lumps one diameter deep, by a quadratic in ln(h/d); 0, so that e is 1, where depths are not known."""
    if "depth_mm" not in table.unknowns:
        return 0.0
    log_ratio = table.unknowns["depth_mm"] - np.log(table.d_mm)
    design = np.stack([np.ones_like(log_ratio), log_ratio, log_ratio**2], axis=1)
    return float(np.linalg.lstsq(design, table.log_amplitude, rcond=None)[0][0])


class Eq6Fit(Record, eq=False):
    """Posterior of Eq 6's k coefficients, taken as normal, and the regression on the tangent at its mean."""

    mean: FloatArray
    covariance: FloatArray
    data: regression.BodyRegression


def fit_eq6(rows: TableRows) -> Eq6Fit:
    """The regression on the tangent at the mode, and the posterior's mean and covariance."""
    theta = _least_squares(rows)
    for _ in range(_MOST_TANGENTS):
        data = rows.tangent(theta)
        mean, covariance = data.posterior()
        step = mean - theta
        theta = mean
        if np.abs(data.mean_terms @ step).max() < _CLOSE:
            return Eq6Fit(mean, covariance, data)
    raise NotConvergedError("the coefficients of Eq 6 have no mode in this table")


def _least_squares(rows: TableRows) -> FloatArray:
    """(k,) coefficients by least squares of the bodies' means: Gauss-Newton, steps halved while the misfit grows."""
    theta = np.zeros(len(rows.eq6_powers))
    theta[rows.eq6_powers.index((MU, 0, 0))] = np.log(rows.maps.d_mm).mean()
    theta[rows.eq6_powers.index((F, 0, 0))] = -0.3
    for _ in range(_MOST_TANGENTS):
        data = rows.tangent(theta)
        step = data.least_squares() - theta
        if np.abs(data.mean_terms @ step).max() < _CLOSE:
            return theta
        most = _misfit(data, theta) * (1.0 + 1e-12)
        while _misfit(rows.tangent(theta + step), theta + step) > most:
            step = step / 2.0
        theta = theta + step
    raise NotConvergedError("Eq 6 does not fit this table")


def _misfit(data: regression.BodyRegression, theta: FloatArray) -> float:
    """Sum of squares where the tangent touches; infinite where a row has no size."""
    total = float(np.sum((data.mean_log_d - data.mean_terms @ theta) ** 2))
    return total if np.isfinite(total) else float("inf")


class SizeErrors(Record):
    """Errors of held-out bodies: (b,) ln of estimated over true size, and the stated variance."""

    error: FloatArray
    variance: FloatArray


def size_errors(
    calibration: BodyCalibration, table: regression.PopulationTable, *, known: Sequence[str] = ()
) -> SizeErrors:
    """Errors of a table's bodies, each by all its exams, given the true values of the properties in `known`."""
    exams = (regression.rows_of(table, table.body == body) for body in np.unique(table.body))
    return SizeErrors(*np.array([size_error(calibration, one, known=known) for one in exams]).T)


def size_error(
    calibration: BodyCalibration, exams: regression.PopulationTable, *, known: Sequence[str] = ()
) -> tuple[float, float]:
    """Log error of one body by the mean of its exams, and its variance by the calibration."""
    profiles = [] if exams.profile is None else exams.profile[np.isfinite(exams.profile).all(axis=1)].tolist()
    calibrated = calibration.at_fat([tuple(one) for one in profiles])
    a, p = exams.log_amplitude, exams.log_width
    by_a = (calibrated.log_size(a + _MAP_STEP, p) - calibrated.log_size(a - _MAP_STEP, p)) / (2 * _MAP_STEP)
    noise = regression.map_variance(exams, np.stack([by_a, calibrated.width_slope(a, p)]))
    terms = calibrated.terms(a, p).mean(axis=0, keepdims=True)
    middle = a.mean(keepdims=True), p.mean(keepdims=True)
    values = {name: float(exams.unknowns[name][0]) for name in known}
    values = {name: float(np.exp(value)) if name in LOGGED else value for name, value in values.items()}
    table_sd = calibrated.table_sd(calibrated.body_sd(*middle, np.zeros(1)))
    expected, variance_left = known_body(calibrated, values, *middle, table_sd)
    exam = (noise.mean() + np.exp(2 * calibrated.spread.log_exam_sd)) / len(exams)
    variance = variance_left[0] + calibrated.other_sd**2 + calibrated.coefficient_variance(terms)[0] + exam
    size = calibrated.log_size(a, p).mean() + expected[0]
    return float(size - np.log(exams.d_mm[0])), float(variance)


def learn_other_sd(calibration: BodyCalibration, table: regression.PopulationTable, *, source: str) -> BodyCalibration:
    """The calibration with `other_sd` from lumps of another origin: the most probable tau, even a priori.

    Its `fit` holds ``other_masses``, ``other_sd_most``, below which tau lies with 95 % probability, and the errors.
    """
    others = size_errors(calibration.with_other_sd(0.0), table)
    variance = others.variance + _OTHER_SDS[:, None] ** 2
    log = -0.5 * np.sum(np.log(variance) + others.error**2 / variance, axis=1)
    density = np.exp(log - log.max())
    other_sd = float(_OTHER_SDS[log.argmax()])
    off = np.expm1(others.error)
    fit = {
        "other_masses": float(len(others.error)),
        "other_sd_most": float(_OTHER_SDS[np.searchsorted(np.cumsum(density / density.sum()), 0.95)]),
        "other_mae_percent": float(100 * np.abs(off).mean()),
        "other_bias_percent": float(100 * off.mean()),
        "other_standard_sd": float(np.sqrt(np.mean(others.error**2 / (others.variance + other_sd**2)))),
    }
    widened = calibration.with_other_sd(other_sd, other_source=source)
    return replace(widened, fit={**calibration.fit, **fit})
