r"""What Eq 6 leaves of a population's sizes, as a Gaussian process about it.

.. math:: h \sim GP(0, k), \quad k(x, x') = s_h^2 \exp\Big(-\tfrac12 \sum_i (x_i - x_i')^2 / l_i^2\Big), \quad
          x = (u, v, w)

by a subset of regressors (Quinonero-Candela & Rasmussen 2005, sec. 3): with the points U and
:math:`K_{UU} = L L^T`, :math:`h(x) = s_h\, k(x, U) L^{-T} c`, the weights c being standard normal a priori. Far from
all points h is 0 and the size is that of Eq 6.
"""

from __future__ import annotations

from dataclasses import field

import numpy as np

from tactile_bayes.errors import BadDataError
from tactile_bayes.geometry import FloatArray
from tactile_bayes.records import dataclass

_NUGGET = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class Residual:
    """The process h as functions with standard normal weights.

    Parameters
    ----------
    points : (m, 3) array
        U: u, v and w.
    lengths : (3,) array
        l.
    scale
        s_h.
    whitening : (m, m) array
        s_h L^{-T}, from k(x, U) to the functions.
    """

    points: FloatArray
    lengths: FloatArray
    scale: float
    whitening: FloatArray = field(init=False, repr=False)

    def __post_init__(self) -> None:
        m, k = self.points.shape
        if self.lengths.shape != (k,) or not (self.lengths > 0).all() or not self.scale > 0:
            raise BadDataError(f"lengths and scale of a residual with {m} points of {k} values must be above 0")
        factor = np.linalg.cholesky(self.correlation(self.points) + _NUGGET * np.eye(m))
        object.__setattr__(self, "whitening", np.asarray(self.scale * np.linalg.inv(factor).T))

    def correlation(self, x: FloatArray) -> FloatArray:
        """(..., m) k(x, U) over s_h^2 for (..., k) values."""
        x, points = x / self.lengths, self.points / self.lengths
        exponent = np.asarray(x @ points.T)
        exponent -= 0.5 * np.sum(points**2, axis=-1)
        exponent -= 0.5 * np.sum(x**2, axis=-1, keepdims=True)
        return np.asarray(np.exp(exponent, out=exponent))

    def functions(self, x: FloatArray) -> FloatArray:
        """(..., m) functions of (..., k) values."""
        return np.asarray(self.correlation(x) @ self.whitening)
