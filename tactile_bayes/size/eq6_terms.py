r"""Eq 6 in logarithms, with constants that depend on the depth of the fat: d = m sigma / (e a^f) + b.

With :math:`u = \ln a - \alpha_0`, :math:`v = p - p_0` and :math:`w = \ln F - w_0`, p the log of the geometric mean
width and F the depth of the fat,

.. math:: d = e^{\mu + v - f u} + b, \qquad
          \frac{m}{e} = e^{\mu - p_0 + f\alpha_0}, \quad e = a_1^{-f},

where :math:`a_1` is the amplitude that lumps one diameter deep show on average, for Delta sigma is 1 there. mu and f
are full quadratics in v and w: what Eq 6 takes for constants depends on how deep the fat is, in mm and in widths of the
map. Without a depth of fat the three are constants.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from tactile_bayes.geometry import FloatArray

COEFFICIENTS: Final = ("mu", "f", "b_mm")
MU, F, B = range(len(COEFFICIENTS))
Powers = tuple[tuple[int, int, int], ...]
PLAIN: Final[Powers] = ((MU, 0, 0), (F, 0, 0), (B, 0, 0))
"""Which of `COEFFICIENTS` each belongs to, and its powers of v and w, where no depth of fat is known."""
BY_DEPTH: Final[Powers] = (*((row, i, k) for row in (MU, F) for k in range(3) for i in range(3 - k)), (B, 0, 0))
"""The same of the thirteen with the depth of fat; see docs/decisions/0093."""


def eq6_coefficients(theta: Sequence[float] | FloatArray, powers: Powers, v: FloatArray, w: FloatArray) -> FloatArray:
    """(3, ...) mu, f and b of maps, for coefficients in the order of `powers`."""
    found = np.zeros((len(COEFFICIENTS), *np.broadcast_shapes(v.shape, w.shape)))
    for value, (row, i, k) in zip(theta, powers, strict=True):
        found[row] += value * v**i * w**k
    return found


def eq6_parts(
    u: FloatArray, v: FloatArray, mu: FloatArray, f: FloatArray, b_mm: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """The term of Eq 6 that is proportional to sigma, and d, both (...,) in mm; d is NaN where it is not positive."""
    stretched = np.exp(mu + v - f * u)
    size = stretched + b_mm
    return stretched, np.where(size > 0, size, np.nan)


def eq6_terms(u: FloatArray, v: FloatArray, w: FloatArray, theta: FloatArray, powers: Powers) -> FloatArray:
    """(..., k) derivatives of ln d by the coefficients; NaN where Eq 6 has no positive size."""
    stretched, size = eq6_parts(u, v, *eq6_coefficients(theta, powers, v, w))
    share = stretched / size
    slopes = (share, -u * share, 1.0 / size)
    return np.stack([slopes[row] * v**i * w**k for row, i, k in powers], axis=-1)


def eq6_log_size(u: FloatArray, v: FloatArray, w: FloatArray, theta: FloatArray, powers: Powers) -> FloatArray:
    """(...,) ln d, d in mm."""
    return np.asarray(np.log(eq6_parts(u, v, *eq6_coefficients(theta, powers, v, w))[1]))
