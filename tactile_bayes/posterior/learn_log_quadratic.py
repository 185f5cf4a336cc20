r"""Learn the log-quadratic calibration from maps of a population of bodies, each examined one or more times.

For the means over the exams of body j, with what the maps themselves leave open (m, from their posteriors) known,

.. math:: \ln d_j = \bar x_j^T\beta + B_j + \bar E_j, \quad B_j \sim N(0, s_j^2),\;
          \bar E_j \sim N(0, (t^2 + \bar m_j) / n_j).

t comes from how the exams of one body differ in :math:`x^T\beta`. That difference says nothing of beta: a body has one
diameter, so within it a regression of d on the map has slope 0 (errors in variables). Coefficients, spread between
bodies and spread between exams are so told apart, and a patient's map adds its own m and nothing twice.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from scipy.special import ndtri

from tactile_bayes.errors import BadDataError
from tactile_bayes.geometry import FloatArray
from tactile_bayes.posterior.laplace import mode_and_covariance
from tactile_bayes.posterior.log_quadratic import HiddenTerms, LogQuadratic, RoundLumps, quadratic_terms
from tactile_bayes.posterior.size_calibration import Recipe

LEAST_BODIES = 20
HELD = 0.9
"""Probability of the intervals that are held against bodies left out."""
# Centre and width of the priors on ln(sd between bodies), its slope with ln a, ln(sd between exams).
_PRIOR = np.array([[np.log(0.1), 1.0], [0.0, 0.3], [np.log(0.03), 1.0]])


@dataclass(frozen=True, slots=True, eq=False)
class PopulationTable:
    """Maps of known lumps, one map a row.

    Parameters
    ----------
    body : (n,) array of int or str
        Rows of one name are exams of one body.
    d_mm, log_amplitude, log_width, half_log_ratio : (n,) arrays
        True diameter; ln a, p and q of the map.
    covariance : (n, 3, 3) array
        Posterior covariance of the latter three.
    unknowns
        (n,) arrays of what was varied and no map shows, by name; logarithms of those in `LOGGED`.
    """

    body: np.ndarray[tuple[int], np.dtype[np.generic]]
    d_mm: FloatArray
    log_amplitude: FloatArray
    log_width: FloatArray
    half_log_ratio: FloatArray
    covariance: FloatArray
    unknowns: Mapping[str, FloatArray] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.d_mm)

    def rows(self, keep: np.ndarray[tuple[int], np.dtype[np.bool_]]) -> PopulationTable:
        """The rows for which `keep` is true."""
        return PopulationTable(
            self.body[keep],
            self.d_mm[keep],
            self.log_amplitude[keep],
            self.log_width[keep],
            self.half_log_ratio[keep],
            self.covariance[keep],
            {name: values[keep] for name, values in self.unknowns.items()},
        )


def learn_log_quadratic(table: PopulationTable, *, recipe: Recipe, source: str = "") -> LogQuadratic:
    """Learn the calibration.

    Parameters
    ----------
    table
        At least twenty bodies; exams in pairs or more tell the spread between exams.

    Raises
    ------
    BadDataError
        When bodies are too few or do not vary.
    NotConvergedError
        When the posterior has no mode.
    """
    _check(table)
    centre = (round(float(table.log_amplitude.mean()), 3), round(float(table.log_width.mean()), 3))
    data = _Regression.of(table, centre)
    start = np.concatenate([data.least_squares(), _PRIOR[:, 0]])
    scale = np.concatenate([np.full(6, 0.02), [0.1, 0.05]])
    mode, covariance, _ = mode_and_covariance(data.log_density, start[:-1], scale=scale)
    log_exam_sd, its_variance = data.log_exam_sd(mode)
    mode = np.append(mode, log_exam_sd)
    covariance = np.pad(covariance, (0, 1))
    covariance[-1, -1] = its_variance
    inverse = np.asarray(np.linalg.inv(data.terms.T @ data.terms), dtype=np.float64)
    leverage = np.einsum("ni,ij,nj->n", data.terms, inverse, data.terms)
    return LogQuadratic(
        centre=centre,
        mean=mode,
        covariance=covariance,
        round_lumps=_round_lumps(table, data),
        information_inverse=inverse,
        most_leverage=float(leverage.max()),
        domain=_domain(table),
        recipe=recipe,
        hidden=_hidden(table, data, mode),
        fit=_figures(table, data, mode),
        source=source,
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Regression:
    """The table as the likelihood needs it: rows for maps, and their means over the exams of each body."""

    terms: FloatArray
    log_d: FloatArray
    map_variance: FloatArray
    group: np.ndarray[tuple[int], np.dtype[np.intp]]
    exams: FloatArray
    mean_terms: FloatArray
    mean_log_d: FloatArray

    @classmethod
    def of(cls, table: PopulationTable, centre: tuple[float, float]) -> _Regression:
        u, v = table.log_amplitude - centre[0], table.log_width - centre[1]
        terms, log_d = quadratic_terms(u, v), np.log(table.d_mm)
        group = np.asarray(np.unique(table.body, return_inverse=True)[1])
        exams = np.bincount(group).astype(np.float64)
        mean_terms = np.stack([np.bincount(group, column) / exams for column in terms.T], axis=1)
        b = np.linalg.lstsq(mean_terms, np.bincount(group, log_d) / exams, rcond=None)[0]
        slope = np.stack([b[1] + 2 * b[3] * u + b[4] * v, b[2] + b[4] * u + 2 * b[5] * v], axis=-1)
        variance = np.einsum("ni,nij,nj->n", slope, table.covariance[:, :2, :2], slope)
        return cls(terms, log_d, variance, group, exams, mean_terms, np.bincount(group, log_d) / exams)

    @property
    def groups(self) -> int:
        """Number of bodies."""
        return len(self.exams)

    def mean(self, values: FloatArray) -> FloatArray:
        """(groups,) means of (n,) values over the exams of each body."""
        return np.asarray(np.bincount(self.group, values) / self.exams)

    def least_squares(self) -> FloatArray:
        """(6,) coefficients by ordinary least squares of the bodies' means."""
        return np.asarray(np.linalg.lstsq(self.mean_terms, self.mean_log_d, rcond=None)[0])

    def log_exam_sd(self, coefficients: FloatArray) -> tuple[float, float]:
        """ln t and its variance: how sizes by the quadratic differ within a body beyond their maps' own noise.

        Without bodies examined twice, the prior.
        """
        freedom = len(self.group) - self.groups
        if freedom < 1:
            return float(_PRIOR[2, 0]), float(_PRIOR[2, 1] ** 2)
        size = self.terms @ coefficients[:6]
        within = float(np.sum((size - self.mean(size)[self.group]) ** 2) / freedom)
        repeated = self.exams[self.group] > 1
        beyond = max(within - float(self.map_variance[repeated].mean()), (0.1 * np.exp(_PRIOR[2, 0])) ** 2)
        return float(0.5 * np.log(beyond)), float(0.5 * (within / beyond) ** 2 / freedom)

    def log_density(self, theta: FloatArray) -> FloatArray:
        """(m,) log posterior of (m, 8) `PARAMETERS` but the last."""
        exam = np.exp(2 * self.log_exam_sd(self.least_squares())[0])
        residual = self.mean_log_d - theta[:, :6] @ self.mean_terms.T
        variance = np.exp(2 * (theta[:, 6:7] + theta[:, 7:8] * self.mean_terms[:, 1]))
        variance = variance + (exam + self.mean(self.map_variance)) / self.exams
        total = -0.5 * np.sum(np.log(variance) + residual**2 / variance, axis=1)
        prior = -0.5 * np.sum(((theta[:, 6:8] - _PRIOR[:2, 0]) / _PRIOR[:2, 1]) ** 2, axis=1)
        return np.asarray(total + prior)

    def body_residuals(self, mode: FloatArray) -> FloatArray:
        """(groups,) residual of each body's mean."""
        return np.asarray(self.mean_log_d - self.mean_terms @ mode[:6])


def _check(table: PopulationTable) -> None:
    bodies = len(np.unique(table.body))
    if bodies < LEAST_BODIES:
        raise BadDataError(f"{bodies} bodies with a map", way_out=f"a quadratic needs at least {LEAST_BODIES}")
    for name, values in (("d_mm", table.d_mm), ("amplitude", table.log_amplitude), ("width", table.log_width)):
        if np.ptp(values) <= 0:
            raise BadDataError(f"all rows have one {name}", way_out="a calibration needs lumps that differ")
    finite = [table.d_mm, table.log_amplitude, table.log_width, table.half_log_ratio, table.covariance]
    if not all(np.isfinite(values).all() for values in finite):
        raise BadDataError("a row holds a number that is not finite", way_out="leave it out")


def _round_lumps(table: PopulationTable, data: _Regression) -> RoundLumps:
    """q0 by least squares over the balls, and the two spreads by analysis of variance."""
    design = data.terms[:, :3]
    coefficients = np.linalg.lstsq(design, table.half_log_ratio, rcond=None)[0]
    excess = table.half_log_ratio - design @ coefficients
    mean = data.mean(excess)
    freedom = len(excess) - data.groups
    map_variance = float(np.median(table.covariance[:, 2, 2]))
    within = float(np.sum((excess - mean[data.group]) ** 2) / freedom) if freedom > 0 else map_variance
    between = float(np.var(mean) - within * np.mean(1.0 / data.exams))
    return RoundLumps(
        np.asarray(coefficients), float(np.sqrt(max(between, 0.0))), float(np.sqrt(max(within - map_variance, 0.0)))
    )


def _hidden(table: PopulationTable, data: _Regression, mode: FloatArray) -> HiddenTerms | None:
    """Joint second moments of B and of what was varied, each about what the map leads one to expect of it."""
    if not table.unknowns:
        return None
    design = data.mean_terms
    varied = np.stack([data.mean(values) for values in table.unknowns.values()], axis=1)
    both = np.concatenate([varied, data.body_residuals(mode)[:, None]], axis=1)
    coefficients = np.linalg.lstsq(design, both, rcond=None)[0]
    rest = both - design @ coefficients
    moments = np.asarray(rest.T @ rest / max(data.groups - int(design.shape[1]), 1), dtype=np.float64)
    return HiddenTerms(
        names=tuple(table.unknowns),
        expected=np.asarray(coefficients.T[:-1]),
        covariance=moments[:-1, :-1],
        with_body=moments[:-1, -1],
        body_variance=float(moments[-1, -1]),
    )


def _figures(table: PopulationTable, data: _Regression, mode: FloatArray) -> dict[str, float]:
    """Rows, spreads, and the errors of masses when each body is left out of the fit in turn."""
    error = left_out_errors(data.mean_terms, data.mean_log_d)
    return {
        "maps": float(len(table)),
        "bodies": float(data.groups),
        "body_sd": float(np.exp(mode[6])),
        "exam_sd": float(np.exp(mode[8])),
        "left_out_sd": float(error.std()),
        "left_out_mae_percent": float(100 * np.mean(np.abs(np.expm1(error)))),
        "left_out_bias_percent": float(100 * np.mean(np.expm1(error))),
        "left_out_held_percent": 100 * _held(data, mode, error),
    }


def _held(data: _Regression, mode: FloatArray, error: FloatArray) -> float:
    """Share of the bodies left out whose size lies in the interval of `HELD` by the spreads that were learned."""
    leverage = _leverage(data.mean_terms)
    spread = np.exp(2 * (mode[6] + mode[7] * data.mean_terms[:, 1]))
    spread = spread + (np.exp(2 * mode[8]) + data.mean(data.map_variance)) / data.exams
    return float(np.mean(np.abs(error) <= ndtri(0.5 + HELD / 2) * np.sqrt(spread / (1.0 - leverage))))


def left_out_errors(terms: FloatArray, log_d: FloatArray) -> FloatArray:
    """(n,) ln(predicted / true size) of each row when it is left out of the least-squares fit, in closed form."""
    inverse = np.linalg.inv(terms.T @ terms)
    residual = log_d - terms @ (inverse @ (terms.T @ log_d))
    return np.asarray(-residual / (1.0 - _leverage(terms)))


def _leverage(terms: FloatArray) -> FloatArray:
    """(n,) weight of each row in its own least-squares prediction."""
    return np.asarray(np.einsum("ni,ij,nj->n", terms, np.linalg.inv(terms.T @ terms), terms))


def _domain(table: PopulationTable) -> dict[str, tuple[float, float]]:
    values = {"amplitude": np.exp(table.log_amplitude), "sigma_mm": np.exp(table.log_width), "d_mm": table.d_mm}
    return {name: (float(v.min()), float(v.max())) for name, v in values.items()}
