r"""A size calibration in logarithms: ln d as a quadratic in ln a and the log of the map's mean width.

With :math:`u = \ln a - \alpha_0` and :math:`v = p - p_0`, where p is the log of the geometric mean of the two widths,

.. math::
    \ln d = \beta_0 + \beta_1 u + \beta_2 v + \beta_3 u^2 + \beta_4 u v + \beta_5 v^2 + B + E

B differs from body to body, :math:`N(0, s\,e^{g u})`: what a map does not show (seat, stiffness, moduli). E differs
from exam to exam of one body. A ball under the oblong head gives an oval map; its half log axis ratio is
:math:`q_0 = \gamma_0 + \gamma_1 u + \gamma_2 v`, and only what exceeds it says that a lump is not round.

Where the depth F of the fat under the head is known it is of third order, `fat_depth.FatCubic` at that depth.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import field, replace

import numpy as np

from tactile_bayes.errors import BadDataError
from tactile_bayes.geometry import FloatArray
from tactile_bayes.records import dataclass
from tactile_bayes.size import omissions
from tactile_bayes.size.calibration_range import outside_domain, too_far
from tactile_bayes.size.eq6 import Recipe
from tactile_bayes.size.fat_depth import ORDER as FAT_ORDER
from tactile_bayes.size.fat_depth import SPREADS, FatCubic
from tactile_bayes.size.hidden import HiddenTerms, RoundLumps
from tactile_bayes.size.polynomials import monomials, powers

UNLIKE = "is unlike any body of the table"
QUADRATIC = ("1", "u", "v", "u2", "uv", "v2")
PARAMETERS = (*QUADRATIC, "log_body_sd", "body_sd_slope", "log_exam_sd")
MOST_LEVERAGE = 1.0
"""A map is outside the table where its leverage exceeds this multiple of the table's largest."""
FARTHEST_LEVERAGE = 3.0
"""Beyond this multiple there is no size."""


@dataclass(frozen=True, slots=True, eq=False)
class LogQuadratic:
    """The calibration; made by `learn_log_quadratic`.

    Parameters
    ----------
    centre
        alpha_0 and p_0.
    mean, covariance : (9,), (9, 9) arrays
        Posterior of `PARAMETERS`, taken as normal; (13,) and (13, 13), with the terms of third order before the
        spreads, at a known depth.
    round_lumps
        What a ball's map looks like.
    information_inverse : (6, 6) or (10, 10) array
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
    fat_cubic
        The same for maps that tell how deep the fat under the head is; None where the table did not.
    fat_mm
        Depth F that this calibration is for; None where it is for any.
    fat_note
        Why the depth is not used though the calibration could; empty otherwise.
    any_depth
        Of a calibration for one depth, that for any.
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
    fat_cubic: FatCubic | None = None
    fat_mm: float | None = None
    fat_note: str = ""
    any_depth: LogQuadratic | None = None

    def __post_init__(self) -> None:
        k = len(PARAMETERS) if self.fat_mm is None else len(powers(FAT_ORDER)) + SPREADS
        if self.mean.shape != (k,) or self.covariance.shape != (k, k):
            raise BadDataError(
                f"mean and covariance have shapes {self.mean.shape} and {self.covariance.shape}",
                way_out=f"they must be ({k},) and ({k}, {k})",
            )
        if not (np.isfinite(self.mean).all() and np.isfinite(self.covariance).all()):
            raise BadDataError("a coefficient is not finite", way_out="learn the calibration anew")
        if np.linalg.eigvalsh(self.covariance)[0] < -1e-9 * np.trace(self.covariance):
            raise BadDataError("the covariance has a negative eigenvalue", way_out="learn the calibration anew")

    def at_fat(self, profiles: Sequence[tuple[float, ...] | None]) -> LogQuadratic:
        """The calibration for a mass whose maps have these `presets.HEAD_PROFILE`, None for a map without one.

        Where they tell no depth it is this one, with the reason in `fat_note`.
        """
        cubic = self.fat_cubic
        if cubic is None:
            return self
        log_depth, why_not = cubic.log_depth(profiles)
        if log_depth is None:
            return replace(self, fat_cubic=None, fat_note=why_not)
        at = cubic.contraction(log_depth)
        whole = np.block([[at, np.zeros((len(at), SPREADS))], [np.zeros((SPREADS, at.shape[1])), np.eye(SPREADS)]])
        hidden = cubic.hidden
        return replace(
            self,
            centre=cubic.centre[:2],
            mean=whole @ cubic.mean,
            covariance=whole @ cubic.covariance @ whole.T,
            round_lumps=cubic.round_lumps(log_depth),
            information_inverse=at @ cubic.information_inverse @ at.T,
            most_leverage=cubic.most_leverage,
            hidden=None if hidden is None else replace(hidden, expected=hidden.expected @ at.T),
            fit=cubic.fit,
            fat_cubic=None,
            fat_mm=float(np.exp(log_depth)),
            any_depth=replace(self, fat_cubic=None),
        )

    def fitting(self, amplitude: float, sigma_x_mm: float, sigma_y_mm: float | None = None) -> LogQuadratic:
        """This calibration, or the one for any depth where no body of the table looks like the map at this depth.

        A polynomial of third order says nothing beyond its table: there sizes were wrong by up to a factor of 11.
        """
        sigma_mm = mean_width_mm(sigma_x_mm, sigma_y_mm)
        if self.any_depth is None or self.leverage(amplitude, sigma_mm) <= MOST_LEVERAGE:
            return self
        what = f"amplitude {amplitude:.3g} with sigma {sigma_mm:.3g} mm over {self.fat_mm:.3g} mm of fat"
        return replace(self.any_depth, fat_note=f"{what} {UNLIKE}")

    @property
    def unknowns(self) -> dict[str, float]:
        """Share of the variance between bodies that knowing each property alone would take away."""
        return {} if self.hidden is None else {name: self.hidden.share(name) for name in self.hidden.names}

    def terms(self, log_amplitude: FloatArray, log_width: FloatArray) -> FloatArray:
        """(..., 6) terms of the quadratic, or (..., 10)."""
        return monomials((log_amplitude - self.centre[0], log_width - self.centre[1]), self._powers)

    @property
    def _powers(self) -> tuple[tuple[int, int], ...]:
        return powers(2 if self.fat_mm is None else FAT_ORDER)

    def log_size(self, log_amplitude: FloatArray, log_width: FloatArray) -> FloatArray:
        """(...,) ln d without B and E, with the mean coefficients."""
        return np.asarray(self.terms(log_amplitude, log_width) @ self.mean[:-SPREADS])

    def width_slope(self, log_amplitude: FloatArray, log_width: FloatArray) -> FloatArray:
        """(...,) derivative of ln d by p: how much longer an axis is for a wider map."""
        b = np.array([j for _, j in self._powers]) * self.mean[:-SPREADS]
        lower = [(i, max(j - 1, 0)) for i, j in self._powers]
        return np.asarray(monomials((log_amplitude - self.centre[0], log_width - self.centre[1]), lower) @ b)

    def round_excess(self, log_amplitude: FloatArray, log_width: FloatArray) -> FloatArray:
        """(...,) q0, the half log axis ratio of a ball's map."""
        c = self.round_lumps.coefficients
        return np.asarray(c[0] + c[1] * (log_amplitude - self.centre[0]) + c[2] * (log_width - self.centre[1]))

    def body_and_error(
        self, terms: FloatArray, log_amplitude: FloatArray, score: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Standard deviation of B, and what the coefficients' error does to ln d given it.

        Parameters
        ----------
        terms : (n, k) array
            `terms` of the maps.
        log_amplitude : (n,) array
        score : (n,) array
            Standard normal scores of the uncertain ln SD(B).

        Returns
        -------
        body_sd, shift, variance : (n,) arrays
            Given `body_sd`, ln d is off by a normal error with mean `shift` and this variance: all parameters are
            jointly normal.
        """
        x = np.stack([np.ones_like(log_amplitude), log_amplitude - self.centre[0]], axis=-1)
        spread = self.covariance[-3:-1, -3:-1]
        sd = np.sqrt(np.maximum(np.sum(x @ spread * x, axis=-1), 0.0))
        body_sd = np.exp(x @ self.mean[-3:-1] + sd * score)
        together = np.sum(terms @ self.covariance[:-SPREADS, -3:-1] * x, axis=-1)
        slope = np.divide(together, sd, out=np.zeros_like(sd), where=sd > 0)
        whole = np.sum(terms @ self.covariance[:-SPREADS, :-SPREADS] * terms, axis=-1)
        return body_sd, slope * score, np.maximum(whole - slope**2, 0.0)

    def leverage(self, amplitude: float, sigma_mm: float) -> float:
        """Leverage of a map over the largest in the table; infinite without a rise."""
        if not (amplitude > 0 and sigma_mm > 0):
            return float("inf")
        x = self.terms(np.log(np.array(amplitude)), np.log(np.array(sigma_mm)))
        return float(x @ self.information_inverse @ x) / self.most_leverage

    def outside(self, amplitude: float, sigma_x_mm: float, sigma_y_mm: float | None = None) -> list[str]:
        """In what a map lies outside the table, in words; empty when it lies inside."""
        sigma_mm = mean_width_mm(sigma_x_mm, sigma_y_mm)
        found = outside_domain(self.domain, amplitude, sigma_mm)
        if not found and self.leverage(amplitude, sigma_mm) > MOST_LEVERAGE:
            found.append(self._unlike(amplitude, sigma_mm))
        if self.fat_note.endswith(UNLIKE):
            found.append(f"{self.fat_note}, so that depth is not used")
        return found

    def too_far(self, amplitude: float, sigma_x_mm: float, sigma_y_mm: float | None = None) -> list[str]:
        """In what a map lies so far outside the table that there is no size, in words."""
        sigma_mm = mean_width_mm(sigma_x_mm, sigma_y_mm)
        found = too_far(self.domain, amplitude, sigma_mm)
        if not found and self.leverage(amplitude, sigma_mm) > FARTHEST_LEVERAGE:
            found.append(self._unlike(amplitude, sigma_mm))
        return found

    def omissions(self, between_map_sd: float) -> list[str]:
        """What a size from one map does not contain, in words.

        Parameters
        ----------
        between_map_sd
            Median of the prior on the spread of ln d between maps of one mass; 0 leaves the term out.
        """
        spread = [] if between_map_sd > 0 else [omissions.SPREAD]
        return spread + ([omissions.fat_depth(self.fat_note)] if self.fat_note else [])

    def _unlike(self, amplitude: float, sigma_mm: float) -> str:
        return (
            f"amplitude {amplitude:.3g} with sigma {sigma_mm:.3g} mm, a pair unlike any of the table "
            f"(leverage {self.leverage(amplitude, sigma_mm):.1f} times its largest)"
        )


def mean_width_mm(sigma_x_mm: float, sigma_y_mm: float | None) -> float:
    """The geometric mean of two widths; one alone stands for both."""
    return float(np.sqrt(sigma_x_mm * (sigma_x_mm if sigma_y_mm is None else sigma_y_mm)))


def quadratic_terms(u: FloatArray, v: FloatArray) -> FloatArray:
    """(..., 6) terms `QUADRATIC` of centred ln a and p."""
    return monomials((u, v), powers(2))
