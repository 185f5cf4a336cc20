r"""A size calibration in logarithms: ln d as a quadratic in ln a and the log of the map's mean width.

.. math:: g = \beta_0 + \beta_1 u + \beta_2 v + \beta_3 u^2 + \beta_4 u v + \beta_5 v^2

Where the depth F of the fat under the head is known it is of third order, `fat_depth.FatCubic` at that depth.
"""

from __future__ import annotations

import numpy as np

from tactile_bayes.geometry import FloatArray
from tactile_bayes.records import dataclass
from tactile_bayes.size.body_calibration import SPREAD_PARAMETERS, BodyCalibration
from tactile_bayes.size.fat_depth import ORDER as FAT_ORDER
from tactile_bayes.size.polynomials import monomials, powers

QUADRATIC = ("1", "u", "v", "u2", "uv", "v2")
PARAMETERS = (*QUADRATIC, *SPREAD_PARAMETERS)


@dataclass(frozen=True, slots=True, eq=False)
class LogQuadratic(BodyCalibration):
    """The calibration; made by `learn_log_quadratic`.

    `mean` and `covariance` are of `PARAMETERS`; at a known depth the terms of third order stand before the spreads.
    """

    @property
    def coefficients(self) -> int:
        """Six, or ten at a known depth of fat."""
        return len(self._powers)

    @property
    def form_name(self) -> str:
        """The form, for people."""
        return "the log-quadratic"

    def terms(self, log_amplitude: FloatArray, log_width: FloatArray) -> FloatArray:
        """(..., 6) terms of the quadratic, or (..., 10)."""
        return monomials((log_amplitude - self.centre[0], log_width - self.centre[1]), self._powers)

    def features(self, log_amplitude: FloatArray, log_width: FloatArray) -> FloatArray:
        """The terms: ln d is linear in them."""
        return self.terms(log_amplitude, log_width)

    @property
    def _powers(self) -> tuple[tuple[int, int], ...]:
        return powers(2 if self.fat_mm is None else FAT_ORDER)

    def log_size(self, log_amplitude: FloatArray, log_width: FloatArray) -> FloatArray:
        """(...,) ln d without B and E, with the mean coefficients."""
        return np.asarray(self.terms(log_amplitude, log_width) @ self.mean[: self.coefficients])

    def width_slope(self, log_amplitude: FloatArray, log_width: FloatArray) -> FloatArray:
        """(...,) derivative of ln d by p: the relative growth of size with the map's width."""
        b = np.array([j for _, j in self._powers]) * self.mean[: self.coefficients]
        lower = [(i, max(j - 1, 0)) for i, j in self._powers]
        return np.asarray(monomials((log_amplitude - self.centre[0], log_width - self.centre[1]), lower) @ b)


def quadratic_terms(u: FloatArray, v: FloatArray) -> FloatArray:
    """(..., 6) terms `QUADRATIC` of centred ln a and p."""
    return monomials((u, v), powers(2))
