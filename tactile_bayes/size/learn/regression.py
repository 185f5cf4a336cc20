"""Regression of sizes on maps, and the Gaussian process of its residuals."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import compress
from typing import Any, Final, TypeVar, cast

import numpy as np
from scipy.optimize import minimize

from tactile_bayes.declarations import Record, field, replace
from tactile_bayes.errors import BadDataError
from tactile_bayes.geometry import BoolArray, FloatArray, IndexArray
from tactile_bayes.inference.modes import mode_and_covariance
from tactile_bayes.size.terms import INVERTED, HiddenTerms, Kernel, Residual, RoundLumps

# --- Regression of ln d on features of a population's maps, with repeated exams per body.
#
# For the means over the exams of body j, with what the maps themselves leave open (m, from their posteriors) known,
#
# .. math:: \ln d_j = \bar x_j^T\beta + B_j + \bar E_j, \quad B_j \sim N(0, s_j^2),\;
#           \bar E_j \sim N(0, (t^2 + \bar m_j) / n_j).
#
# t comes from how the exams of one body differ in :math:`x^T\beta`. That difference says nothing of beta: a body
# has one diameter, so within it a regression of d on the map has slope 0 (errors in variables). Coefficients,
# spread between bodies and spread between exams are so told apart, and a patient's map adds its own m and nothing
# twice.

T = TypeVar("T")
LEAST_BODIES = 20
EXPLAINED: Final = 0.75
"""Share of the table's bodies, by SD(B), of which known properties tell as much as they do of all, in that SD."""
_ROUND_START = (np.log(0.01), np.log(2.0))  #: ln s and ln kappa where the search for the spread of balls' maps begins.
_ROUND_PRIOR_SD = 1.5  #: Prior SD of either about these: with a dozen bodies they stay near.
# Centre and width of the priors on ln(sd between bodies), its slope with ln a, ln(sd between exams).
_PRIOR = np.array([[np.log(0.1), 1.0], [0.0, 0.3], [np.log(0.03), 1.0]])


class PopulationTable(Record, eq=False):
    """Maps of known lumps, one per row: true diameter; ln a, p and q of the map."""

    body: np.ndarray[tuple[int], np.dtype[np.generic]]  #: (n,) of int or str: rows of one name are exams of one body.
    d_mm: FloatArray
    log_amplitude: FloatArray
    log_width: FloatArray
    half_log_ratio: FloatArray
    covariance: FloatArray  #: (n, 3, 3) posterior covariance of the latter three.
    unknowns: Mapping[str, FloatArray] = field(default_factory=dict)
    """(n,) arrays of what was varied and no map shows, by name; logarithms of those in `LOGGED`."""
    profile: FloatArray | None = None
    """(n, 3) `presets.HEAD_PROFILE` of each map, NaN for a map without; None where no map has it."""
    log_fat: FloatArray | None = None  #: (n,) ln of the depth of the fat-gland boundary in mm; None with `profile`.

    def __len__(self) -> int:
        return len(self.d_mm)


def rows_of(columns: T, keep: BoolArray) -> T:
    """A copy of a table, whose fields are columns or tables or None, with the rows where `keep` is true."""
    if columns is None:
        return columns
    value: Any = columns
    if isinstance(value, np.ndarray):
        return cast("T", value[keep])
    if isinstance(value, tuple):
        return cast("T", tuple(compress(value, keep)))
    if isinstance(value, dict):
        return cast("T", {name: rows_of(one, keep) for name, one in value.items()})
    return cast("T", replace(value, **{name: rows_of(getattr(value, name), keep) for name in value.__struct_fields__}))


class BodyRegression(Record, eq=False):
    """Data of the likelihood: maps as rows, and their means over each body's exams."""

    terms: FloatArray  #: (n, k) in which ln d is linear.
    constant: FloatArray  #: (n,) that ln d has beside the terms.
    map_variance: FloatArray  #: (n,) of the predicted ln d by the map's own posterior.
    group: IndexArray  #: (n,) number of the body.
    exams: FloatArray
    mean_terms: FloatArray
    mean_log_d: FloatArray  #: Mean of ln d less the constant, over each body's exams.
    mean_u: FloatArray  #: Mean of the centred ln a.

    @classmethod
    def linear(
        cls, table: PopulationTable, terms: FloatArray, *, u: FloatArray, constant: FloatArray, slope: FloatArray
    ) -> BodyRegression:
        """The regression of a table on (n, k) terms; `slope` has the (2, n) derivatives of ln d by ln a and p.

        The spread between bodies changes with u, the centred ln a.
        """
        group = np.asarray(np.unique(table.body, return_inverse=True)[1])
        exams = np.bincount(group).astype(np.float64)
        mean_terms = np.stack([np.bincount(group, column) / exams for column in terms.T], axis=1)
        left, mean_u = (np.bincount(group, one) / exams for one in (np.log(table.d_mm) - constant, u))
        return cls(terms, constant, map_variance(table, slope), group, exams, mean_terms, left, mean_u)

    def mean(self, values: FloatArray) -> FloatArray:
        """(groups,) means of (n,) values over each body's exams."""
        return np.asarray(np.bincount(self.group, values) / self.exams)

    def least_squares(self) -> FloatArray:
        """(k,) ordinary least-squares coefficients from the bodies' means."""
        return np.asarray(np.linalg.lstsq(self.mean_terms, self.mean_log_d, rcond=None)[0])

    def exam_spread(self, size: FloatArray) -> tuple[float, float]:
        """Mean and variance of ln t, the spread of sizes between exams of a body beyond their maps' own noise.

        `size` is (n,) ln d by each map. Squares of a body's exams about their mean are :math:`(t^2 + m) \\chi^2`, m the
        mean variance of its maps; t is on a grid. Without bodies examined twice, the prior.
        """
        square = np.bincount(self.group, (size - self.mean(size)[self.group]) ** 2)
        freedom, noise = self.exams - 1.0, self.mean(self.map_variance)
        centre, width = _PRIOR[2]
        log_t = centre + width * np.linspace(-4.0, 4.0, 401)
        variance = np.exp(2.0 * log_t)[:, None] + noise
        log_p = -0.5 * np.sum(freedom * np.log(variance) + square / variance, axis=1)
        log_p -= 0.5 * ((log_t - centre) / width) ** 2
        p = np.exp(log_p - log_p.max())
        mean = float(p @ log_t / p.sum())
        return mean, float(p @ (log_t - mean) ** 2 / p.sum())

    def log_density(self, theta: FloatArray) -> FloatArray:
        """(m,) log posterior of (m, k + 2) coefficients, ln(sd between bodies) and its slope."""
        exam = np.exp(self.exam_spread(self.terms @ self.least_squares() + self.constant)[0]) ** 2
        residual = self.mean_log_d - theta[:, :-2] @ self.mean_terms.T
        variance = np.exp(2 * (theta[:, -2:-1] + theta[:, -1:] * self.mean_u))
        variance = variance + (exam + self.mean(self.map_variance)) / self.exams
        total = -0.5 * np.sum(np.log(variance) + residual**2 / variance, axis=1)
        prior = -0.5 * np.sum(((theta[:, -2:] - _PRIOR[:2, 0]) / _PRIOR[:2, 1]) ** 2, axis=1)
        return np.asarray(total + prior)

    def posterior(self) -> tuple[FloatArray, FloatArray]:
        """Mean and covariance of the k coefficients, as normal, with a spread of bodies that changes with ln a.

        `NotConvergedError` when there is no mode.
        """
        b = self.least_squares()
        left = float(np.var(self.mean_log_d - self.mean_terms @ b))
        errors = np.sqrt(left * np.diag(np.linalg.inv(self.mean_terms.T @ self.mean_terms)))
        start, scale = np.append(b, _PRIOR[:2, 0]), np.append(errors, [0.1, 0.05])
        mode, covariance, _ = mode_and_covariance(self.log_density, start, scale=scale)
        return mode[:-2], covariance[:-2, :-2]


def leverages(features: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(c, c) inverse of X^T X for (n, c) features, and the (n,) leverages of the rows."""
    inverse = np.asarray(np.linalg.inv(features.T @ features), dtype=np.float64)
    return inverse, np.asarray(np.einsum("ni,ij,nj->n", features, inverse, features))


def map_variance(table: PopulationTable, slope: FloatArray) -> FloatArray:
    """(n,) variance of ln d by the maps' own posteriors, for (2, n) slopes by ln a and p."""
    return np.asarray(np.einsum("in,nij,jn->n", slope, table.covariance[:, :2, :2], slope))


def check_population(table: PopulationTable) -> None:
    """Refuse bodies that are too few, do not vary or hold a number that is not finite."""
    bodies = len(np.unique(table.body))
    if bodies < LEAST_BODIES:
        raise BadDataError(f"{bodies} bodies with a map", way_out=f"a calibration needs at least {LEAST_BODIES}")
    for name, values in (("d_mm", table.d_mm), ("amplitude", table.log_amplitude), ("width", table.log_width)):
        if np.ptp(values) <= 0:
            raise BadDataError(f"all rows have one {name}", way_out="a calibration needs lumps that differ")
    finite = [table.d_mm, table.log_amplitude, table.log_width, table.half_log_ratio, table.covariance]
    if not all(np.isfinite(values).all() for values in finite):
        raise BadDataError("a row holds a number that is not finite", way_out="leave it out")


def value_ranges(values: Mapping[str, FloatArray]) -> dict[str, tuple[float, float]]:
    """Minimum and maximum of each array, by name."""
    return {name: (float(v.min()), float(v.max())) for name, v in values.items()}


def hidden_terms(
    table: PopulationTable, data: BodyRegression, *, body: FloatArray, body_sd: FloatArray, features: FloatArray
) -> HiddenTerms | None:
    """Second moments of the varied properties about their regression on the map's features, and with B.

    `body` and `body_sd` are (groups,): B of each body, which took no part in the fit that says so, and SD(B) at its
    place. Bodies count by their B in that SD: faint and deep lumps, of which B is large, would decide alone otherwise.
    """
    if not table.unknowns:
        return None
    design = np.stack([data.mean(column) for column in features.T], axis=1)
    inverted = tuple(name for name in INVERTED if name in table.unknowns)
    entered = [np.exp(-values) if name in inverted else values for name, values in table.unknowns.items()]
    varied = np.stack([data.mean(values) for values in entered], axis=1)
    coefficients = np.linalg.lstsq(design, varied, rcond=None)[0]
    rest = varied - design @ coefficients
    most_sd = float(np.quantile(body_sd, EXPLAINED))
    weight = np.minimum(1.0, most_sd / body_sd)
    freedom = max(len(design) - design.shape[1], 1)
    return HiddenTerms(
        names=tuple(table.unknowns),
        expected=np.asarray(coefficients.T),
        covariance=np.asarray(rest.T @ rest / freedom),
        with_body=np.asarray(rest.T @ (weight * body / body_sd) / (freedom * np.mean(weight**2))),
        body_variance=1.0,
        inverted=inverted,
        most_sd=most_sd,
    )


def learn_round_lumps(table: PopulationTable, terms: FloatArray) -> RoundLumps:
    r"""Elongation of balls' maps, by maximum likelihood: :math:`q_i \sim N(q_0(x_i), s^2 + \kappa V_i)`.

    :math:`q_0` is linear in (n, c) terms, V the variance of a map's posterior. Deep and faint lumps have a V a hundred
    times that of clear ones, so least squares without it fit :math:`q_0` to the faintest maps and take their noise for
    all.
    """
    q, variance = table.half_log_ratio, table.covariance[:, 2, 2]

    def spread_at(values: FloatArray) -> FloatArray:
        return np.asarray(np.exp(values[0]) ** 2 + np.exp(values[1]) * variance)

    def misfit(values: FloatArray) -> float:
        total = spread_at(values)
        left = q - terms @ _weighted(terms, q, total)
        prior = np.sum(((values - _ROUND_START) / _ROUND_PRIOR_SD) ** 2)
        return float(0.5 * (np.sum(left**2 / total + np.log(total)) + prior))

    mode = np.asarray(minimize(misfit, _ROUND_START, method="Nelder-Mead").x)
    body_sd, map_factor = (float(one) for one in np.exp(mode))
    return RoundLumps(_weighted(terms, q, spread_at(mode)), body_sd, 0.0, map_factor)


def _weighted(terms: FloatArray, values: FloatArray, variance: FloatArray) -> FloatArray:
    """(c,) coefficients by weighted least squares."""
    root = 1.0 / np.sqrt(variance)
    return np.asarray(np.linalg.lstsq(terms * root[:, None], values * root, rcond=None)[0])


# --- Learning of the residual of Eq 6 over a population, see `size.terms`, and of the spread between bodies.
#
# Given the kernel and the spread of B, the weights have a normal posterior in closed form, and with them each
# body's size as the others predict it. Kernel and spread are those by which bodies left out are most probable, with
# weak priors (Rasmussen & Williams 2006, sec. 5.4.2), so that intervals hold on bodies never seen.

POINTS: Final = 100  #: Points of the kernel; with fewer bodies a quarter of their number.
BODIES_PER_POINT: Final = 4
SEED: Final = 1  #: Seed of the choice of bodies that are the points.
_LENGTH, _SCALE, _BODY_SD = (np.log(2.0), 1.0), (np.log(0.3), 1.0), (np.log(0.1), 1.0)
"""Centre and width of the normal priors on the logs of lengths, scale and SD(B) at the centre."""
_SLOPE_SD = 0.3  #: Width of the prior on the other coefficients of ln SD(B).
_START_LENGTHS = (2.0, 0.7)  #: There are modes where what is smooth is taken for scatter, and the other way round.
_MOST_ITERATIONS = 200
_DIFFERENCE = 1e-4  #: Step of the gradient: below it the rounding of the solutions shows.


class BodyResiduals(Record, eq=False):
    """Residuals of b bodies under Eq 6."""

    x: FloatArray  #: (b, 3) means of u, v and w over each body's exams: they differ little.
    features: FloatArray  #: (b, s) of ln SD(B).
    left: FloatArray  #: (b,) ln d less Eq 6's, each body left out of its fit.
    noise: FloatArray  #: (b,) variance of `left` by the body's exams and by the error of Eq 6's coefficients.


class FittedResidual(Record, eq=False):
    """The residual given its kernel and the spread of B: (m,), (m, m) moments of its weights.

    `predicted` and `variance` are (b,): leave-one-out prediction of each body's residual, and its variance by the
    weights.
    """

    kernel: Kernel
    mean: FloatArray
    covariance: FloatArray
    predicted: FloatArray
    variance: FloatArray

    def at(self, x: FloatArray) -> FloatArray:
        """(n,) the residual at (n, 3) values."""
        return np.asarray(self.kernel.functions(x) @ self.mean)

    @property
    def residual(self) -> Residual:
        """The residual as a part of a calibration."""
        factor = np.linalg.cholesky(self.covariance).tolist()
        rows = tuple(tuple(row[: i + 1]) for i, row in enumerate(factor))
        return Residual(self.kernel.points, self.kernel.lengths, self.kernel.scale, self.mean, rows)


def fit_residual(bodies: BodyResiduals) -> FittedResidual:
    """Fit kernel and spread with half of the points, then with all, from the better of two starts."""
    count = max(min(POINTS, len(bodies.left) // BODIES_PER_POINT), 1)
    k, slopes = bodies.x.shape[1], np.zeros(bodies.features.shape[1] - 1)
    starts = [np.array([*[np.log(length)] * k, _SCALE[0], _BODY_SD[0], *slopes]) for length in _START_LENGTHS]
    for points_now in (max(count // 2, 1), count):
        # drawn at random they lie as the bodies do, most where most sizes are asked for; pivots of the kernel's
        # incomplete Cholesky factor lie at the table's ends first, and left bodies out with larger errors (0122)
        chosen = np.random.default_rng(SEED).choice(len(bodies.x), points_now, replace=False)
        points = bodies.x[chosen]
        fits = [_mode_near(bodies, start, points) for start in starts]
        theta, _ = min(fits, key=lambda one: one[1])
        starts = [theta]
    return weights_posterior(bodies, points, theta)


def weights_posterior(bodies: BodyResiduals, points: FloatArray, theta: FloatArray) -> FittedResidual:
    """Posterior of the weights given kernel and spread, and each body's leave-one-out prediction.

    `theta` holds the logs of the lengths and of the scale, and the coefficients of ln SD(B).
    """
    k = bodies.x.shape[1]
    kernel = Kernel(points, np.exp(theta[:k]), float(np.exp(theta[k])))
    terms = kernel.functions(bodies.x)
    total = np.exp(2.0 * bodies.features @ theta[k + 1 :]) + bodies.noise
    scaled = terms / np.sqrt(total)[:, None]
    inverse = np.linalg.inv(np.linalg.cholesky(scaled.T @ scaled + np.eye(len(points))))
    covariance = inverse.T @ inverse
    mean = covariance @ (scaled.T @ (bodies.left / np.sqrt(total)))
    weight = np.sum(scaled @ covariance * scaled, axis=1)
    off = (bodies.left - terms @ mean) / (1.0 - weight)
    return FittedResidual(kernel, mean, covariance, bodies.left - off, total * weight / (1.0 - weight))


def body_spread(features: FloatArray, error: FloatArray, noise: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(s,) coefficients of ln SD(B) that maximise the density of held-out bodies, and their (s, s) covariance.

    `error` and `noise` are (b,): leave-one-out error of each body, and its variance without B's.
    """

    def density(spreads: FloatArray) -> FloatArray:
        return np.array([_log_density(features, error, noise, spread) + _spread_prior(spread) for spread in spreads])

    start = np.zeros(features.shape[1])
    start[0] = _BODY_SD[0]
    mode, covariance, _ = mode_and_covariance(density, start, scale=np.full(len(start), 0.05))
    return np.asarray(mode), np.asarray(covariance)


def _log_density(features: FloatArray, error: FloatArray, noise: FloatArray, log_spread: FloatArray) -> float:
    variance = np.exp(2.0 * features @ log_spread) + noise
    return float(-0.5 * np.sum(np.log(variance) + error**2 / variance))


def _mode_near(bodies: BodyResiduals, start: FloatArray, points: FloatArray) -> tuple[FloatArray, float]:
    """Logs of kernel and spread at the mode near a start, and the negative log density there."""
    k = bodies.x.shape[1]

    def cost(theta: FloatArray) -> float:
        fitted, spread = weights_posterior(bodies, points, theta), theta[k + 1 :]
        error, noise = bodies.left - fitted.predicted, bodies.noise + fitted.variance
        of_kernel = np.sum(((theta[:k] - _LENGTH[0]) / _LENGTH[1]) ** 2) + ((theta[k] - _SCALE[0]) / _SCALE[1]) ** 2
        prior = -0.5 * float(of_kernel) + _spread_prior(spread)
        return -_log_density(bodies.features, error, noise, spread) - prior

    bounds = [(-2.0, 4.0)] * k + [(-4.0, 2.0)] + [(-5.0, 1.0)]
    bounds += [(-1.5, 1.5)] * (len(start) - len(bounds))
    mode = minimize(
        cost, start, method="L-BFGS-B", bounds=bounds, options={"maxiter": _MOST_ITERATIONS, "eps": _DIFFERENCE}
    )
    return np.asarray(mode.x, dtype=np.float64), float(mode.fun)


def _spread_prior(log_spread: FloatArray) -> float:
    at_centre = ((log_spread[0] - _BODY_SD[0]) / _BODY_SD[1]) ** 2
    return float(-0.5 * (at_centre + np.sum((log_spread[1:] / _SLOPE_SD) ** 2)))
