r"""A size calibration in logarithms: ln d as a quadratic in ln a and the log of the map's mean width.

With :math:`u = \ln a - \alpha_0` and :math:`v = p - p_0`, where p is the log of the geometric mean of the two widths,

.. math::
    \ln d = \beta_0 + \beta_1 u + \beta_2 v + \beta_3 u^2 + \beta_4 u v + \beta_5 v^2 + B + E

B differs from body to body, :math:`N(0, s\,e^{g u})`: what a map does not show (seat, stiffness, moduli). E differs
from exam to exam of one body. A ball under the oblong head gives an oval map; its half log axis ratio is
:math:`q_0 = \gamma_0 + \gamma_1 u + \gamma_2 v`, and only what exceeds it says that a lump is not round.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from tactile_bayes.errors import BadDataError
from tactile_bayes.geometry import FloatArray
from tactile_bayes.posterior.size_calibration import Recipe

QUADRATIC = ("1", "u", "v", "u2", "uv", "v2")
PARAMETERS = (*QUADRATIC, "log_body_sd", "body_sd_slope", "log_exam_sd")
LOGGED = ("depth_mm", "stiffness_ratio", "fat_kpa", "gland_ratio")
"""Properties that enter by their logarithm."""
MOST_LEVERAGE = 1.0
"""A map is outside the table where its leverage exceeds this multiple of the table's largest."""


@dataclass(frozen=True, slots=True, eq=False)
class RoundLumps:
    """The oval that a ball's map is, and how far single maps stray from it.

    Parameters
    ----------
    coefficients : (3,) array
        Of 1, u and v in q0.
    body_sd, exam_sd
        Of the excess q - q0 between bodies, and between exams of one body.
    """

    coefficients: FloatArray
    body_sd: float
    exam_sd: float


@dataclass(frozen=True, slots=True, eq=False)
class HiddenTerms:
    """What goes into B: properties of a body that no map shows, jointly normal with it given the map.

    Parameters
    ----------
    names
        Of k properties; those in `LOGGED` enter by their logarithm.
    expected : (k, 6) array
        Coefficients of `QUADRATIC` in what a map leads one to expect of each.
    covariance : (k, k) array
        About that.
    with_body : (k,) array
        Covariance with B.
    body_variance
        Of B in the same table.
    """

    names: tuple[str, ...]
    expected: FloatArray
    covariance: FloatArray
    with_body: FloatArray
    body_variance: float

    def share(self, *names: str) -> float:
        """Share of B's variance that goes when these are known."""
        at = [self.names.index(name) for name in names]
        gain = np.linalg.solve(self.covariance[np.ix_(at, at)], self.with_body[at])
        return float(np.clip(gain @ self.with_body[at] / self.body_variance, 0.0, 1.0))

    def expected_body(self, known: Mapping[str, float], terms: FloatArray) -> FloatArray:
        """(...,) mean of B when some are known, for (..., 6) terms of the map."""
        at = [self.names.index(name) for name in known]
        gain = np.linalg.solve(self.covariance[np.ix_(at, at)], self.with_body[at])
        given = np.array([np.log(v) if name in LOGGED else v for name, v in known.items()])
        return np.asarray((given - terms @ self.expected[at].T) @ gain)


@dataclass(frozen=True, slots=True, eq=False)
class LogQuadratic:
    """The calibration; made by `learn_log_quadratic`.

    Parameters
    ----------
    centre
        alpha_0 and p_0.
    mean, covariance : (9,), (9, 9) arrays
        Posterior of `PARAMETERS`, taken as normal.
    round_lumps
        What a ball's map looks like.
    information_inverse : (6, 6) array
        Inverse of X^T X over the table: gives the leverage of a new map.
    most_leverage
        Largest in the table.
    domain
        Ranges of ``amplitude``, ``sigma_mm`` (geometric mean) and ``d_mm`` in the table.
    recipe
        How the table's maps were built and fitted.
    hidden
        What B is made of.
    fit
        Figures of the fit.
    source
        In words: what the table was made of.
    """

    centre: tuple[float, float]
    mean: FloatArray
    covariance: FloatArray
    round_lumps: RoundLumps
    information_inverse: FloatArray
    most_leverage: float
    domain: Mapping[str, tuple[float, float]]
    recipe: Recipe
    hidden: HiddenTerms | None = None
    fit: Mapping[str, float] = field(default_factory=dict)
    source: str = ""

    def __post_init__(self) -> None:
        k = len(PARAMETERS)
        if self.mean.shape != (k,) or self.covariance.shape != (k, k):
            raise BadDataError(
                f"mean and covariance have shapes {self.mean.shape} and {self.covariance.shape}",
                way_out=f"they must be ({k},) and ({k}, {k})",
            )
        if not (np.isfinite(self.mean).all() and np.isfinite(self.covariance).all()):
            raise BadDataError("a coefficient is not finite", way_out="learn the calibration anew")
        if np.linalg.eigvalsh(self.covariance)[0] < -1e-9 * np.trace(self.covariance):
            raise BadDataError("the covariance has a negative eigenvalue", way_out="learn the calibration anew")

    @property
    def unknowns(self) -> dict[str, float]:
        """Share of the variance between bodies that knowing each property alone would take away."""
        return {} if self.hidden is None else {name: self.hidden.share(name) for name in self.hidden.names}

    def terms(self, log_amplitude: FloatArray, log_width: FloatArray) -> FloatArray:
        """(..., 6) terms of the quadratic."""
        return quadratic_terms(log_amplitude - self.centre[0], log_width - self.centre[1])

    def log_size(self, log_amplitude: FloatArray, log_width: FloatArray, draws: FloatArray | None = None) -> FloatArray:
        """(...,) ln d without B and E, with the mean coefficients or with (..., 9) draws of them."""
        coefficients = self.mean if draws is None else draws
        return np.asarray(np.sum(self.terms(log_amplitude, log_width) * coefficients[..., :6], axis=-1))

    def width_slope(self, log_amplitude: FloatArray, log_width: FloatArray) -> FloatArray:
        """(...,) derivative of ln d by p: how much longer an axis is for a wider map."""
        b = self.mean
        return np.asarray(b[2] + b[4] * (log_amplitude - self.centre[0]) + 2.0 * b[5] * (log_width - self.centre[1]))

    def body_sd(self, log_amplitude: FloatArray, draws: FloatArray | None = None) -> FloatArray:
        """(...,) standard deviation of B."""
        p = self.mean if draws is None else draws
        return np.asarray(np.exp(p[..., 6] + p[..., 7] * (log_amplitude - self.centre[0])))

    def round_excess(self, log_amplitude: FloatArray, log_width: FloatArray) -> FloatArray:
        """(...,) q0, the half log axis ratio of a ball's map."""
        c = self.round_lumps.coefficients
        return np.asarray(c[0] + c[1] * (log_amplitude - self.centre[0]) + c[2] * (log_width - self.centre[1]))

    def draw(self, number: int, rng: np.random.Generator) -> FloatArray:
        """(number, 9) draws of `PARAMETERS`."""
        values, vectors = np.linalg.eigh(self.covariance)
        root = vectors * np.sqrt(np.clip(values, 0.0, None))
        return np.asarray(self.mean + rng.standard_normal((number, len(self.mean))) @ root.T)

    def outside(self, amplitude: float, sigma_mm: float) -> list[str]:
        """In what a map lies outside the table, in words; empty when it lies inside."""
        found = []
        for name, value, unit in (("amplitude", amplitude, ""), ("sigma_mm", sigma_mm, " mm")):
            low, high = self.domain[name]
            if not low <= value <= high:
                found.append(f"{name.removesuffix('_mm')} {value:.3g}{unit} (table: {low:.3g} to {high:.3g}{unit})")
        if not found and amplitude > 0 and sigma_mm > 0:
            x = self.terms(np.log(np.array(amplitude)), np.log(np.array(sigma_mm)))
            ratio = float(x @ self.information_inverse @ x) / self.most_leverage
            if ratio > MOST_LEVERAGE:
                found.append(
                    f"amplitude {amplitude:.3g} with sigma {sigma_mm:.3g} mm, a pair unlike any of the table "
                    f"(leverage {ratio:.1f} times its largest)"
                )
        return found


def quadratic_terms(u: FloatArray, v: FloatArray) -> FloatArray:
    """(..., 6) terms `QUADRATIC` of centred ln a and p."""
    return np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=-1)
