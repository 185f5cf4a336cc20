"""Learning of a size calibration from maps of a population of bodies, see `size.body_calibration`."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy.special import ndtri

from tactile_bayes.geometry import FloatArray
from tactile_bayes.presets import HELD
from tactile_bayes.size.body_calibration import FEATURES, QUADRATIC, BodyCalibration, block_diagonal
from tactile_bayes.size.eq6 import Recipe
from tactile_bayes.size.eq6_terms import BY_DEPTH, PLAIN
from tactile_bayes.size.fat_depth import FatDepth, profile_terms
from tactile_bayes.size.hidden import HiddenTerms, RoundLumps
from tactile_bayes.size.learn.eq6_fit import Eq6Fit, Eq6Rows, fit_eq6
from tactile_bayes.size.learn.hidden import hidden_terms
from tactile_bayes.size.learn.regression import (
    BodyRegression,
    ExamSpread,
    PopulationTable,
    check_population,
    domain_of,
    error_figures,
    leverages,
)
from tactile_bayes.size.learn.residual import BodiesLeft, FittedResidual, body_spread, fit_residual
from tactile_bayes.size.learn.round_lumps import learn_round
from tactile_bayes.size.polynomials import monomials, powers

LEAST_BODIES: Final = 80
"""With a head profile: with fewer bodies Eq 6 without the fat's depth is all that a table supports."""
INSIDE: Final = 0.99
"""Share of the table's maps that count as inside it: its largest leverage is an outlier's, ten times what is left."""
_STEP = 1e-4


def learn_population(
    table: PopulationTable, *, recipe: Recipe, source: str = "", residual: bool = True
) -> BodyCalibration:
    """Learn the calibration: Eq 6, by the depth of the fat where maps have a head profile, and what it leaves.

    Parameters
    ----------
    residual
        False for Eq 6 alone. A table without profiles has no other.

    Raises
    ------
    BadDataError
        When bodies are too few or do not vary.
    NotConvergedError
        When the posterior has no mode.
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
        size, slope = size + fitted.at(rows.values), slope + _residual_slopes(fitted, rows.values)
        exam, noise = _exams(maps, eq6, size, slope)
        left, noise = left - fitted.predicted, noise + fitted.variance
    return _calibration(rows, Learned(eq6, fitted, exam, left, noise), recipe=recipe, source=source)


@dataclass(frozen=True, slots=True, eq=False)
class TableRows:
    """Maps of a table, with the depth of fat where they tell it.

    Parameters
    ----------
    maps
        Those with a profile of the head; all where too few bodies have one.
    depth
        From profile to depth of fat, learned from them; None where too few have one.
    centre
        alpha_0, p_0 and w_0: rounded means.
    values : (n, 3) array
        u, v and w; w is 0 without a depth.
    """

    maps: PopulationTable
    depth: FatDepth | None
    centre: tuple[float, float, float]
    values: FloatArray

    @classmethod
    def of(cls, table: PopulationTable) -> TableRows:
        """The rows with a profile, or all where too few bodies have one."""
        known = None
        if table.profile is not None and table.log_fat is not None:
            known = table.rows(np.isfinite(table.profile.sum(axis=1)))
            known = known if len(np.unique(known.body)) >= LEAST_BODIES else None
        if known is None or known.profile is None or known.log_fat is None:
            centre = _rounded_mean(table.log_amplitude), _rounded_mean(table.log_width), 0.0
            values = [table.log_amplitude - centre[0], table.log_width - centre[1], np.zeros(len(table))]
            return cls(table, None, centre, np.column_stack(values))
        depth = learn_depth(known.profile, known.log_fat)
        log_depth = depth.log_depth(known.profile)
        centre = _rounded_mean(known.log_amplitude), _rounded_mean(known.log_width), _rounded_mean(log_depth)
        u, v, w = known.log_amplitude - centre[0], known.log_width - centre[1], log_depth - centre[2]
        return cls(known, _with_expected(depth, u, v, w), centre, np.column_stack([u, v, w]))

    @property
    def eq6(self) -> Eq6Rows:
        """As Eq 6 takes them."""
        u, v, w = self.values.T
        return Eq6Rows(u, v, w, PLAIN if self.depth is None else BY_DEPTH)

    @property
    def feature_powers(self) -> tuple[tuple[int, int, int], ...]:
        """Of the features of a map, see `BodyCalibration`."""
        return QUADRATIC[:6] if self.depth is None else FEATURES

    @property
    def spread_powers(self) -> tuple[tuple[int, int, int], ...]:
        """The same of ln SD(B)."""
        return QUADRATIC[:6] if self.depth is None else QUADRATIC

    def of_bodies(self, data: BodyRegression) -> FloatArray:
        """(b, 3) means of u, v and w over each body's exams."""
        return np.stack([data.mean(column) for column in self.values.T], axis=1)

    def spread_terms(self, data: BodyRegression) -> FloatArray:
        """(b, s) terms of ln SD(B) at these."""
        return monomials(list(self.of_bodies(data).T), self.spread_powers)


@dataclass(frozen=True, slots=True, eq=False)
class Learned:
    """What was learned of a table's bodies.

    Parameters
    ----------
    eq6, residual, exam
        The fits and the spread between exams; `residual` None for Eq 6 alone.
    left, noise : (b,) arrays
        ln d less what the other bodies lead one to expect of it, and its variance without that of B.
    """

    eq6: Eq6Fit
    residual: FittedResidual | None
    exam: ExamSpread
    left: FloatArray
    noise: FloatArray


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


def _with_expected(depth: FatDepth, u: FloatArray, v: FloatArray, w: FloatArray) -> FatDepth:
    """With what amplitude and width lead one to expect of w."""
    x = monomials((u, v), powers(2))
    expected = np.linalg.lstsq(x, w, rcond=None)[0]
    return replace(depth, expected=np.asarray(expected), expected_sd=float(np.std(w - x @ expected)))


def _rounded_mean(values: FloatArray) -> float:
    return round(float(values.mean()), 3)


def _exams(maps: PopulationTable, eq6: Eq6Fit, size: FloatArray, slope: FloatArray) -> tuple[ExamSpread, FloatArray]:
    """Spread between exams, and (b,) variance of each body's ln d by its exams and the coefficients of Eq 6."""
    data = BodyRegression.linear(maps, eq6.data.terms, u=eq6.rows.u, constant=eq6.data.constant, slope=slope)
    exam = data.exam_spread(size)
    coefficients = np.sum(data.mean_terms @ eq6.covariance * data.mean_terms, axis=1)
    return exam, (exam.sd**2 + data.mean(data.map_variance)) / data.exams + coefficients


def _residual_slopes(fitted: FittedResidual, values: FloatArray) -> FloatArray:
    """(2, n) derivatives of the residual by u and v at (n, 3) values."""
    step = np.eye(values.shape[1]) * _STEP
    return np.stack([(fitted.at(values + one) - fitted.at(values - one)) / (2 * _STEP) for one in step[:2]])


def _calibration(rows: TableRows, learned: Learned, *, recipe: Recipe, source: str) -> BodyCalibration:
    eq6, fitted, exam, maps = learned.eq6, learned.residual, learned.exam, rows.maps
    data, features = eq6.data, monomials(list(rows.values.T), rows.feature_powers)
    spread, of_spread = body_spread(rows.spread_terms(data), learned.left, learned.noise)
    body_sd = np.exp(rows.spread_terms(data) @ spread)
    variance = body_sd**2 + learned.noise
    weights = [] if fitted is None else [fitted.mean]
    inverse, leverage = leverages(features)
    blocks = [eq6.covariance, *([] if fitted is None else [fitted.covariance]), of_spread, np.array([[exam.variance]])]
    held = float(np.mean(np.abs(learned.left) <= ndtri(0.5 + HELD / 2) * np.sqrt(variance)))
    spreads = {"body_sd": float(np.median(body_sd)), "exam_sd": exam.sd}
    found = BodyCalibration(
        centre=rows.centre,
        mean=np.concatenate([eq6.mean, *weights, spread, [exam.log_sd]]),
        covariance=block_diagonal(blocks),
        round_lumps=RoundLumps(*learn_round(maps, monomials(list(rows.values.T), rows.spread_powers))),
        information_inverse=inverse,
        most_leverage=float(np.quantile(leverage, INSIDE)),
        domain=domain_of(maps),
        recipe=recipe,
        depth=rows.depth,
        residual=None if fitted is None else fitted.residual,
        log_amplitude_one_deep=_log_amplitude_one_deep(maps),
        hidden=hidden_terms(maps, data, body=learned.left, body_sd=body_sd, features=features),
        fit=error_figures(maps, data, spreads, -learned.left, held),
        source=source,
    )
    return found if rows.depth is None else replace(found, hidden_any=_hidden_at_any_depth(found, maps, data))


def _hidden_at_any_depth(
    calibration: BodyCalibration, maps: PopulationTable, data: BodyRegression
) -> HiddenTerms | None:
    """What B is made of where the depth of the fat is not known."""
    at, a, p = calibration.at_fat([None]), maps.log_amplitude, maps.log_width
    body = data.mean(np.log(maps.d_mm) - at.log_size(a, p))
    body_sd = at.body_sd(data.mean(a), data.mean(p), np.zeros(data.groups))
    return hidden_terms(maps, data, body=body, body_sd=body_sd, features=at.features(a, p))


def _log_amplitude_one_deep(table: PopulationTable) -> float:
    """ln a of lumps one diameter deep, by a quadratic in ln(h/d); 0, so that e is 1, where depths are not known."""
    if "depth_mm" not in table.unknowns:
        return 0.0
    log_ratio = table.unknowns["depth_mm"] - np.log(table.d_mm)
    design = np.stack([np.ones_like(log_ratio), log_ratio, log_ratio**2], axis=1)
    return float(np.linalg.lstsq(design, table.log_amplitude, rcond=None)[0][0])
