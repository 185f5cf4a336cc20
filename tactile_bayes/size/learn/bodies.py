r"""Learning of a size calibration from maps of a population of bodies, see `size.bodies`.

The regression is that of `regression`, of ln d on Eq 6 where that is linear in ln d's terms: about its own mode Eq 6 is
replaced by its tangent, :math:`g(\theta) \approx g(\theta_0) + J(\theta - \theta_0)`, until the mode stays where the
tangent touches.

Bodies that took no part are sized by the mean of their exams. Where lumps come from another simulator, or are phantoms,
their errors :math:`e_j \sim N(0, s_j^2 + \tau^2)`, with :math:`s_j^2` what the calibration states: tau is `other_sd`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from scipy.optimize import least_squares
from scipy.special import ndtri

from tactile_bayes.declarations import Record, replace
from tactile_bayes.errors import NotConvergedError
from tactile_bayes.geometry import FloatArray
from tactile_bayes.presets import HELD
from tactile_bayes.size.bodies import CUBIC, QUADRATIC, BodyCalibration, Centre, Spread, known_body
from tactile_bayes.size.eq6 import BY_DEPTH, MU, PLAIN, Eq6Law, F, Powers, eq6_log_size, eq6_terms
from tactile_bayes.size.fat import FatDepth, profile_terms
from tactile_bayes.size.learn.regression import (
    BodiesLeft,
    BodyRegression,
    ExamSpread,
    FittedResidual,
    PopulationTable,
    body_spread,
    check_population,
    domain_of,
    error_figures,
    fit_residual,
    hidden_terms,
    learn_round,
    leverages,
    map_variance,
)
from tactile_bayes.size.terms import LOGGED, Recipe, monomials, powers

LEAST_BODIES: Final = 80
"""With a head profile: with fewer bodies Eq 6 without the fat's depth is all that a table supports."""
INSIDE: Final = 0.99
"""Share of the table's maps that count as inside it: its largest leverage is an outlier's, ten times what is left."""
_MOST_TANGENTS, _CLOSE, _STEP, _MAP_STEP = 50, 1e-7, 1e-4, 1e-3
_OTHER_SDS = np.linspace(0.0, 0.3, 301)
"""Grid of tau."""


def learn_population(
    table: PopulationTable, *, recipe: Recipe, source: str = "", residual: bool = True
) -> BodyCalibration:
    """Learn the calibration: Eq 6, by the depth of the fat where maps have a head profile, and what it leaves.

    Without `residual`, and from a table without profiles, it is Eq 6 alone. `BadDataError` when bodies are too few or
    do not vary, `NotConvergedError` when the posterior has no mode.
    """
    check_population(table)
    rows = TableRows.of(table)
    maps = rows.maps
    eq6 = fit_eq6(maps, rows.eq6)
    left = eq6.data.mean_log_d - eq6.data.mean_terms @ eq6.mean
    left = left / (1.0 - leverages(eq6.data.mean_terms)[1])  # each body left out of the fit
    size, slope = eq6.rows.log_size(eq6.mean), eq6.rows.map_slopes(eq6.mean)
    exam, noise = _exams(maps, eq6, size, slope)
    fitted = None
    if residual and rows.depth is not None:
        fitted = fit_residual(BodiesLeft(rows.of_bodies(eq6.data), rows.spread_terms(eq6.data), left, noise))
        steps = np.eye(3)[:2] * _STEP  # along u and v
        slopes = [(fitted.at(rows.values + h) - fitted.at(rows.values - h)) / (2 * _STEP) for h in steps]
        size, slope = size + fitted.at(rows.values), slope + np.stack(slopes)
        exam, noise = _exams(maps, eq6, size, slope)
        left, noise = left - fitted.predicted, noise + fitted.variance
    return _calibration(rows, eq6, fitted, exam, left=left, noise=noise, recipe=recipe, source=source)


class TableRows(Record, eq=False):
    """Maps of a table with (n, 3) u, v and w, and the depth of fat where enough bodies have a profile of the head.

    Without it, `depth` is None and w 0.
    """

    maps: PopulationTable
    depth: FatDepth | None
    centre: Centre
    values: FloatArray

    @classmethod
    def of(cls, table: PopulationTable) -> TableRows:
        """The rows with a profile, or all where too few bodies have one."""
        known = None
        if table.profile is not None and table.log_fat is not None:
            known = table.rows(np.isfinite(table.profile.sum(axis=1)))
            known = known if len(np.unique(known.body)) >= LEAST_BODIES else None
        if known is None or known.profile is None or known.log_fat is None:
            centre = Centre(_rounded_mean(table.log_amplitude), _rounded_mean(table.log_width), 0.0)
            u, v = table.log_amplitude - centre.log_amplitude, table.log_width - centre.log_width
            return cls(table, None, centre, np.column_stack([u, v, np.zeros(len(table))]))
        depth = learn_depth(known.profile, known.log_fat)
        log_depth = depth.log_depth(known.profile)
        means = (_rounded_mean(one) for one in (known.log_amplitude, known.log_width, log_depth))
        centre = Centre(*means)
        u, v = known.log_amplitude - centre.log_amplitude, known.log_width - centre.log_width
        w = log_depth - centre.log_fat
        x = monomials((u, v), powers(2))  # what amplitude and width lead one to expect of w
        expected = np.asarray(np.linalg.lstsq(x, w, rcond=None)[0])
        depth = replace(depth, expected=expected, expected_sd=float(np.std(w - x @ expected)))
        return cls(known, depth, centre, np.column_stack([u, v, w]))

    @property
    def eq6(self) -> Eq6Rows:
        """As Eq 6 takes them."""
        u, v, w = self.values.T
        return Eq6Rows(u, v, w, PLAIN if self.depth is None else BY_DEPTH)

    @property
    def feature_powers(self) -> Powers:
        """Powers of the features of a map, see `BodyLaw`."""
        return QUADRATIC[:6] if self.depth is None else CUBIC

    @property
    def spread_powers(self) -> Powers:
        """The same of ln SD(B)."""
        return QUADRATIC[:6] if self.depth is None else QUADRATIC

    def of_bodies(self, data: BodyRegression) -> FloatArray:
        """(b, 3) means of u, v and w over each body's exams."""
        return np.stack([data.mean(column) for column in self.values.T], axis=1)

    def spread_terms(self, data: BodyRegression) -> FloatArray:
        """(b, s) terms of ln SD(B) at these."""
        return monomials(list(self.of_bodies(data).T), self.spread_powers)


def learn_depth(profile: FloatArray, log_fat: FloatArray) -> FatDepth:
    """Fit ln F by least squares on the full quadratic of (n, 3) profiles."""
    centre, scale = profile.mean(axis=0), profile.std(axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    x = profile_terms((profile - centre) / scale)
    inverse = np.asarray(np.linalg.pinv(x.T @ x), dtype=np.float64)
    coefficients = inverse @ (x.T @ log_fat)
    told = x @ coefficients
    rest = log_fat - told
    return FatDepth(
        centre,
        scale,
        np.asarray(coefficients),
        inverse,
        float(np.einsum("ni,ij,nj->n", x, inverse, x).max()),
        float(np.sqrt(np.sum(rest**2) / max(len(rest) - x.shape[1], 1))),
        fat_mm=(float(np.exp(told.min())), float(np.exp(told.max()))),
        expected=np.zeros(len(powers(2))),
        expected_sd=0.0,
    )


def _rounded_mean(values: FloatArray) -> float:
    return round(float(values.mean()), 3)


def _exams(maps: PopulationTable, eq6: Eq6Fit, size: FloatArray, slope: FloatArray) -> tuple[ExamSpread, FloatArray]:
    """Spread between exams, and (b,) variance of each body's ln d by its exams and the coefficients of Eq 6."""
    data = BodyRegression.linear(maps, eq6.data.terms, u=eq6.rows.u, constant=eq6.data.constant, slope=slope)
    exam = data.exam_spread(size)
    coefficients = np.sum(data.mean_terms @ eq6.covariance * data.mean_terms, axis=1)
    return exam, (exam.sd**2 + data.mean(data.map_variance)) / data.exams + coefficients


def _calibration(
    rows: TableRows,
    eq6: Eq6Fit,
    fitted: FittedResidual | None,
    exam: ExamSpread,
    *,
    left: FloatArray,
    noise: FloatArray,
    recipe: Recipe,
    source: str,
) -> BodyCalibration:
    """The calibration by (b,) ln d less what the other bodies lead one to expect of it, and its variance without B."""
    data, maps, features = eq6.data, rows.maps, monomials(list(rows.values.T), rows.feature_powers)
    spread, of_spread = body_spread(rows.spread_terms(data), left, noise)
    body_sd = np.exp(rows.spread_terms(data) @ spread)
    inverse, leverage = leverages(features)
    held = float(np.mean(np.abs(left) <= ndtri(0.5 + HELD / 2) * np.sqrt(body_sd**2 + noise)))
    spreads = {"body_sd": float(np.median(body_sd)), "exam_sd": exam.sd}
    calibration = BodyCalibration(
        centre=rows.centre,
        eq6=Eq6Law(eq6.rows.powers, eq6.mean, eq6.covariance, _log_amplitude_one_deep(maps)),
        residual=None if fitted is None else fitted.residual,
        spread=Spread(rows.spread_powers, spread, of_spread, exam.log_sd, exam.variance, 0.0, ""),
        round_lumps=learn_round(maps, monomials(list(rows.values.T), rows.spread_powers)),
        feature_powers=rows.feature_powers,
        information_inverse=inverse,
        most_leverage=float(np.quantile(leverage, INSIDE)),
        domain=domain_of(maps),
        recipe=recipe,
        depth=rows.depth,
        hidden=hidden_terms(maps, data, body=left, body_sd=body_sd, features=features),
        hidden_any=None,
        fit=error_figures(maps, data, spreads, -left, held),
        source=source,
        bodies={},
    )
    if rows.depth is None:
        return calibration
    at, a, p = calibration.at_fat([None]), maps.log_amplitude, maps.log_width
    body = data.mean(np.log(maps.d_mm) - at.log_size(a, p))
    body_sd = at.body_sd(data.mean(a), data.mean(p), np.zeros(data.groups))
    hidden_any = hidden_terms(maps, data, body=body, body_sd=body_sd, features=at.features(a, p))
    return replace(calibration, hidden_any=hidden_any)


def _log_amplitude_one_deep(table: PopulationTable) -> float:
    """ln a of lumps one diameter deep, by a quadratic in ln(h/d); 0, so that e is 1, where depths are not known."""
    if "depth_mm" not in table.unknowns:
        return 0.0
    log_ratio = table.unknowns["depth_mm"] - np.log(table.d_mm)
    design = np.stack([np.ones_like(log_ratio), log_ratio, log_ratio**2], axis=1)
    return float(np.linalg.lstsq(design, table.log_amplitude, rcond=None)[0][0])


class Eq6Rows(Record, eq=False):
    """Maps of a table as Eq 6 takes them: (n,) u, v and w, which is 0 where the depth of fat plays no part."""

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


class Eq6Fit(Record, eq=False):
    """Posterior of Eq 6's k coefficients, taken as normal, and the regression on the tangent at its mean."""

    rows: Eq6Rows
    mean: FloatArray
    covariance: FloatArray
    data: BodyRegression


def fit_eq6(table: PopulationTable, rows: Eq6Rows) -> Eq6Fit:
    """The regression on the tangent at the mode, and the posterior's mean and covariance."""
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
    """(k,) coefficients by least squares of the bodies' means, for the tangents to begin at."""

    def left(theta: FloatArray) -> FloatArray:
        data = _regression(table, rows, theta)
        return data.mean_log_d - data.mean_terms @ theta

    start = np.zeros(len(rows.powers))
    start[rows.powers.index((MU, 0, 0))] = np.log(table.d_mm).mean()
    start[rows.powers.index((F, 0, 0))] = -0.3
    found = least_squares(left, start, x_scale="jac")
    if not found.success:
        raise NotConvergedError("Eq 6 does not fit this table")
    return np.asarray(found.x)


def _regression(table: PopulationTable, rows: Eq6Rows, theta: FloatArray) -> BodyRegression:
    terms, constant = rows.tangent(theta)
    return BodyRegression.linear(table, terms, u=rows.u, constant=constant, slope=rows.map_slopes(theta))


class Sized(Record):
    """Bodies that took no part: (b,) ln of sized over true size, and the variance stated."""

    error: FloatArray
    variance: FloatArray


def sized(calibration: BodyCalibration, table: PopulationTable, *, known: Sequence[str] = ()) -> Sized:
    """The bodies of a table, each by all its exams; of the properties in `known` the true value is told."""
    bodies = np.unique(table.body)
    errors = np.array([size_error(calibration, table.rows(table.body == one), known=known) for one in bodies])
    return Sized(*errors.T)


def size_error(
    calibration: BodyCalibration, exams: PopulationTable, *, known: Sequence[str] = ()
) -> tuple[float, float]:
    """Log error of one body by the mean of its exams, and the variance that the calibration states."""
    at = calibration.at_fat(_known(exams.profile, len(exams)))
    a, p = exams.log_amplitude, exams.log_width
    by_a = (at.log_size(a + _MAP_STEP, p) - at.log_size(a - _MAP_STEP, p)) / (2 * _MAP_STEP)
    noise = map_variance(exams, np.stack([by_a, at.width_slope(a, p)]))
    terms = at.terms(a, p).mean(axis=0, keepdims=True)
    middle = a.mean(keepdims=True), p.mean(keepdims=True)
    told = {name: float(exams.unknowns[name][0]) for name in known}
    told = {name: float(np.exp(value)) if name in LOGGED else value for name, value in told.items()}
    left = known_body(at, told, *middle, at.own_sd(at.body_sd(*middle, np.zeros(1))))
    exam = (noise.mean() + np.exp(2 * at.spread.log_exam_sd)) / len(exams)
    variance = left.variance[0] + at.other_sd**2 + at.coefficient_variance(terms)[0] + exam
    size = at.log_size(a, p).mean() + left.expected[0]
    return float(size - np.log(exams.d_mm[0])), float(variance)


def learn_other_sd(calibration: BodyCalibration, table: PopulationTable, *, source: str) -> BodyCalibration:
    """The calibration with `other_sd` from lumps of another origin: the most probable tau, even a priori.

    Its fit tells ``other_masses``, ``other_sd_most``, below which tau lies with 95 % probability, and the errors.
    """
    others = sized(calibration.with_other_sd(0.0), table)
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
    found_out = calibration.with_other_sd(other_sd, other_source=source)
    return replace(found_out, fit={**calibration.fit, **fit})


def _known(figures: FloatArray | None, number: int) -> Sequence[tuple[float, ...] | None]:
    """Figures of each exam; None where it has none."""
    if figures is None:
        return [None] * number
    return [tuple(one) if np.isfinite(one).all() else None for one in figures]
