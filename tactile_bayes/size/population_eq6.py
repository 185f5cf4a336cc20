r"""Eq 6 learned over a population of bodies: d = m sigma / (e a^f) + b, with what a map does not show of a body.

With :math:`u = \ln a - \alpha_0` and :math:`v = p - p_0` as in `body_calibration`,

.. math:: d = e^{\mu + v - f u} + b, \qquad
          \frac{m}{e} = e^{\mu - p_0 + f\alpha_0}, \quad e = a_1^{-f},

where :math:`a_1` is the amplitude that lumps one diameter deep show on average, for Delta sigma is 1 there. sigma is
the geometric mean of the two widths: the head makes a ball's map oval, and an oval lump is told from that by
`elongation`. Where the depth F of the fat is known, :math:`\mu` and f are full quadratics in v and
:math:`w = \ln F - w_0`: what Eq 6 takes for constants depends on how deep the fat is, in mm and in widths of the map.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from tactile_bayes.geometry import FloatArray
from tactile_bayes.records import dataclass
from tactile_bayes.size.body_calibration import SPREAD_PARAMETERS, BodyCalibration
from tactile_bayes.size.fat_depth import FatTerms, Powers
from tactile_bayes.size.polynomials import monomials, powers

COEFFICIENTS: Final = ("mu", "f", "b_mm")
PARAMETERS: Final = (*COEFFICIENTS, *SPREAD_PARAMETERS)
MU, F, B = range(len(COEFFICIENTS))
PLAIN: Final = ((MU, 0), (F, 0), (B, 0))
"""For maps that do not tell the depth of fat: the three coefficients, each with its power of v."""
AT_ONE_DEPTH: Final = (*((row, i) for row in (MU, F) for i in range(3)), (B, 0))
"""The same of the seven at one depth of fat."""
FAT_COEFFICIENTS: Final = (*((row, i, k) for row in (MU, F) for k in range(3) for i in range(3 - k)), (B, 0, 0))
"""Which of `COEFFICIENTS` each of the thirteen belongs to, and its powers of v and w; see docs/decisions/0093."""
FEATURES: Final = powers(2)
FAT_FEATURES: Final = tuple((i, j, k) for k in range(3) for i, j in powers(2 - k))
"""Powers of u, v and w."""
_CONTRACTED: Final[Powers] = tuple((AT_ONE_DEPTH.index((row, i)), k) for row, i, k in FAT_COEFFICIENTS)
_CONTRACTED_FEATURES: Final[Powers] = tuple((FEATURES.index((i, j)), k) for i, j, k in FAT_FEATURES)


@dataclass(frozen=True, slots=True, eq=False)
class FatEq6(FatTerms):
    """mu and f as quadratics in the logs of the width and of the depth of fat; made by `learn_population_eq6`."""

    @property
    def file_key(self) -> str:
        """Its name in a calibration's file."""
        return "fat_eq6"

    @property
    def coefficient_powers(self) -> Powers:
        """At one depth `AT_ONE_DEPTH` is left."""
        return _CONTRACTED

    @property
    def feature_powers(self) -> Powers:
        """At one depth the quadratic `FEATURES` is left."""
        return _CONTRACTED_FEATURES


@dataclass(frozen=True, slots=True, eq=False)
class PopulationEq6(BodyCalibration):
    """The calibration; made by `learn_population_eq6`.

    `mean` and `covariance` are of `PARAMETERS`; at a known depth of fat of `AT_ONE_DEPTH` and the spreads.

    Parameters
    ----------
    log_amplitude_one_deep
        ln a_1.

    Notes
    -----
    Wellman & Howe (1999) eq. 6 with their Delta sigma as a ratio of widths, 1 at one diameter depth.
    """

    log_amplitude_one_deep: float = 0.0

    @property
    def coefficients(self) -> int:
        """Three, for only m / e matters to a size, or seven at a known depth of fat."""
        return len(self._powers)

    @property
    def form_name(self) -> str:
        """The form, for people."""
        return "Eq 6"

    def constants(self, sigma_mm: float | None = None) -> dict[str, float]:
        """m, b in mm, e and f of Eq 6 as it is printed, at the mean of the posterior.

        Parameters
        ----------
        sigma_mm
            Mean width of the map, on which m and f depend at a known depth of fat; the table's middle where left out.
        """
        alpha, p0 = self.centre
        v = np.array(0.0 if sigma_mm is None else np.log(sigma_mm) - p0)
        mu, f, b = (float(one) for one in self._coefficients(v))
        log_e = -f * self.log_amplitude_one_deep
        return {"m": float(np.exp(mu - p0 + f * alpha + log_e)), "b_mm": b, "e": float(np.exp(log_e)), "f": f}

    def terms(self, log_amplitude: FloatArray, log_width: FloatArray) -> FloatArray:
        """(..., 3) derivatives of ln d by the coefficients, or (..., 7); NaN where Eq 6 has no positive size."""
        u, v = self._centred(log_amplitude, log_width)
        slopes = eq6_slopes(u, *eq6_parts(u, v, *self._coefficients(v)))
        return np.stack([slopes[..., row] * v**i for row, i in self._powers], axis=-1)

    def features(self, log_amplitude: FloatArray, log_width: FloatArray) -> FloatArray:
        """(..., 6) terms of a full quadratic in u and v."""
        return monomials(self._centred(log_amplitude, log_width), FEATURES)

    def log_size(self, log_amplitude: FloatArray, log_width: FloatArray) -> FloatArray:
        """(...,) ln d without B and E, with the mean coefficients; NaN where Eq 6 has no positive size."""
        u, v = self._centred(log_amplitude, log_width)
        return np.asarray(np.log(eq6_parts(u, v, *self._coefficients(v))[1]))

    def width_slope(self, log_amplitude: FloatArray, log_width: FloatArray) -> FloatArray:
        """(...,) derivative of ln d by p: how much longer an axis is for a wider map."""
        u, v = self._centred(log_amplitude, log_width)
        stretched, size = eq6_parts(u, v, *self._coefficients(v))
        by_mu, by_f, _ = self._coefficients(v, derivative=True)
        return np.asarray(stretched / size * (1.0 + by_mu - u * by_f))

    @property
    def _powers(self) -> tuple[tuple[int, int], ...]:
        return PLAIN if self.fat_mm is None else AT_ONE_DEPTH

    def _centred(self, log_amplitude: FloatArray, log_width: FloatArray) -> tuple[FloatArray, FloatArray]:
        return np.asarray(log_amplitude - self.centre[0]), np.asarray(log_width - self.centre[1])

    def _coefficients(self, v: FloatArray, *, derivative: bool = False) -> FloatArray:
        """(3, ...) mu, f and b at each v, or their derivatives by v."""
        found = np.zeros((len(COEFFICIENTS), *v.shape))
        for value, (row, i) in zip(self.mean, self._powers, strict=False):
            found[row] += value * (i * v ** max(i - 1, 0) if derivative else v**i)
        return found


def eq6_parts(
    u: FloatArray, v: FloatArray, mu: FloatArray, f: FloatArray, b_mm: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """The term of Eq 6 that is proportional to sigma, and d, both (...,) in mm; d is NaN where it is not positive."""
    stretched = np.exp(mu + v - f * u)
    size = stretched + b_mm
    return stretched, np.where(size > 0, size, np.nan)


def eq6_slopes(u: FloatArray, stretched: FloatArray, size: FloatArray) -> FloatArray:
    """(..., 3) derivatives of ln d by mu, f and b."""
    share = stretched / size
    return np.stack([share, -u * share, 1.0 / size], axis=-1)
