r"""Learn the log-quadratic calibration from maps of a population of bodies, each examined one or more times.

For map i of body j, with what the map itself leaves open (:math:`m_{ij}`, from its posterior) known,

.. math:: \ln d_j = x_{ij}^T\beta + B_j + E_{ij}, \quad B_j \sim N(0, s_j^2),\; E_{ij} \sim N(0, t^2 + m_{ij}).

So the coefficients, the spread between bodies and the spread between exams are told apart, and a patient's map adds
its own :math:`m` and nothing twice.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from tactile_bayes.errors import BadDataError
from tactile_bayes.geometry import FloatArray
from tactile_bayes.posterior.laplace import mode_and_covariance
from tactile_bayes.posterior.log_quadratic import HiddenTerms, LogQuadratic, RoundLumps, quadratic_terms
from tactile_bayes.posterior.size_calibration import Recipe

LEAST_BODIES = 20
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
    scale = np.concatenate([np.full(6, 0.02), [0.1, 0.05, 0.2]])
    mode, covariance, _ = mode_and_covariance(data.log_density, start, scale=scale)
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
    """The table as the likelihood needs it."""

    terms: FloatArray
    log_d: FloatArray
    u: FloatArray
    map_variance: FloatArray
    group: np.ndarray[tuple[int], np.dtype[np.intp]]
    groups: int

    @classmethod
    def of(cls, table: PopulationTable, centre: tuple[float, float]) -> _Regression:
        u, v = table.log_amplitude - centre[0], table.log_width - centre[1]
        names, group = np.unique(table.body, return_inverse=True)
        terms, log_d = quadratic_terms(u, v), np.log(table.d_mm)
        plain = cls(terms, log_d, u, np.zeros(len(u)), np.asarray(group), len(names))
        b = plain.least_squares()
        slope = np.stack([b[1] + 2 * b[3] * u + b[4] * v, b[2] + b[4] * u + 2 * b[5] * v], axis=-1)
        variance = np.einsum("ni,nij,nj->n", slope, table.covariance[:, :2, :2], slope)
        return cls(terms, log_d, u, variance, np.asarray(group), len(names))

    def least_squares(self) -> FloatArray:
        """(6,) coefficients by ordinary least squares."""
        return np.asarray(np.linalg.lstsq(self.terms, self.log_d, rcond=None)[0])

    def sums(self, values: FloatArray) -> FloatArray:
        """(m, groups) sums of (m, n) values over the exams of each body."""
        out = np.zeros((len(values), self.groups))
        np.add.at(out.T, self.group, values.T)
        return out

    def log_density(self, theta: FloatArray) -> FloatArray:
        """(m,) log posterior of (m, 9) `PARAMETERS`."""
        residual = self.log_d - theta[:, :6] @ self.terms.T
        exam = np.exp(2 * theta[:, 8:9]) + self.map_variance
        weight = 1.0 / exam
        s0, s1 = self.sums(weight), self.sums(weight * residual)
        exams = np.bincount(self.group, minlength=self.groups)
        mean_u = np.bincount(self.group, self.u, minlength=self.groups) / exams
        body = np.exp(2 * (theta[:, 6:7] + theta[:, 7:8] * mean_u))
        total = -0.5 * np.sum(np.log(exam) + weight * residual**2, axis=1)
        total += -0.5 * np.sum(np.log1p(body * s0) - body * s1**2 / (1.0 + body * s0), axis=1)
        prior = -0.5 * np.sum(((theta[:, 6:] - _PRIOR[:, 0]) / _PRIOR[:, 1]) ** 2, axis=1)
        return np.asarray(total + prior)

    def body_residuals(self, mode: FloatArray) -> FloatArray:
        """(groups,) mean residual of each body, its exams weighed by what they tell."""
        weight = 1.0 / (np.exp(2 * mode[8]) + self.map_variance)
        residual = self.log_d - self.terms @ mode[:6]
        return np.asarray(self.sums((weight * residual)[None])[0] / self.sums(weight[None])[0])


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
    exams = np.bincount(data.group, minlength=data.groups)
    mean = np.bincount(data.group, excess, minlength=data.groups) / exams
    freedom = len(excess) - data.groups
    map_variance = float(np.median(table.covariance[:, 2, 2]))
    within = float(np.sum((excess - mean[data.group]) ** 2) / freedom) if freedom > 0 else map_variance
    between = float(np.var(mean) - within / exams.mean())
    return RoundLumps(
        np.asarray(coefficients), float(np.sqrt(max(between, 0.0))), float(np.sqrt(max(within - map_variance, 0.0)))
    )


def _hidden(table: PopulationTable, data: _Regression, mode: FloatArray) -> HiddenTerms | None:
    """Joint second moments of B and of what was varied, each about what the map leads one to expect of it."""
    if not table.unknowns:
        return None
    exams = np.bincount(data.group, minlength=data.groups)

    def mean(values: FloatArray) -> FloatArray:
        return np.asarray(np.bincount(data.group, values, minlength=data.groups) / exams)

    design = np.stack([mean(column) for column in data.terms.T], axis=1)
    varied = np.stack([mean(values) for values in table.unknowns.values()], axis=1)
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
    error = left_out_errors(table, data.terms, data.group)
    per_body = np.array([error[data.group == g].mean() for g in range(data.groups)])
    return {
        "maps": float(len(table)),
        "bodies": float(data.groups),
        "body_sd": float(np.exp(mode[6])),
        "exam_sd": float(np.exp(mode[8])),
        "left_out_sd": float(per_body.std()),
        "left_out_mae_percent": float(100 * np.mean(np.abs(np.expm1(per_body)))),
        "left_out_bias_percent": float(100 * np.mean(np.expm1(per_body))),
    }


def left_out_errors(
    table: PopulationTable, terms: FloatArray, group: np.ndarray[tuple[int], np.dtype[np.intp]]
) -> FloatArray:
    """(n,) ln(predicted / true size) when the map's own body is left out of a least-squares fit of `terms`."""
    log_d, error = np.log(table.d_mm), np.empty(len(table))
    for g in range(int(group.max()) + 1):
        out = group == g
        coefficients = np.linalg.lstsq(terms[~out], log_d[~out], rcond=None)[0]
        error[out] = terms[out] @ coefficients - log_d[out]
    return error


def _domain(table: PopulationTable) -> dict[str, tuple[float, float]]:
    values = {"amplitude": np.exp(table.log_amplitude), "sigma_mm": np.exp(table.log_width), "d_mm": table.d_mm}
    return {name: (float(v.min()), float(v.max())) for name, v in values.items()}
