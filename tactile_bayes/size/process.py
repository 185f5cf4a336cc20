r"""What Eq 6 leaves of a population's sizes, as a Gaussian process about it.

.. math:: h \sim GP(0, k), \quad k(x, x') = s_h^2 \exp\Big(-\tfrac12 \sum_i (x_i - x_i')^2 / l_i^2\Big), \quad
          x = (u, v, w)

by a subset of regressors (Quinonero-Candela & Rasmussen 2005, sec. 3): with the points U and
:math:`K_{UU} = L L^T`, :math:`h(x) = s_h\, k(x, U) L^{-T} c`, the weights c being standard normal a priori. Far from
all points h is 0 and the size is that of Eq 6.
"""

from __future__ import annotations

from functools import cached_property
from typing import Annotated

import numpy as np

from tactile_bayes.declarations import Meta, Record
from tactile_bayes.errors import BadDataError
from tactile_bayes.geometry import FloatArray, Matrix, Vector
from tactile_bayes.size.terms import LEARN_ANEW, check_shapes

_NUGGET = 1e-6


class Kernel(Record, eq=False, dict=True):
    """Squared exponential kernel between values of u, v and w, and the functions that it gives by its points."""

    points: Annotated[Matrix, Meta(description="u, v and w of the points.")]
    lengths: Annotated[Vector, Meta(description="Length of the kernel along each.")]
    scale: Annotated[float, Meta(gt=0, description="SD of the process before any data.")]

    def __post_init__(self) -> None:
        check_shapes(self, points=(len(self.points), 3), lengths=(3,))
        if not (self.lengths > 0).all():
            raise BadDataError("a length of the residual is not above 0", way_out=LEARN_ANEW)

    @cached_property
    def whitening(self) -> FloatArray:
        """(m, m) s_h L^{-T}, from k(x, U) to the functions."""
        factor = np.linalg.cholesky(self.correlation(self.points) + _NUGGET * np.eye(len(self.points)))
        return np.asarray(self.scale * np.linalg.inv(factor).T)

    def correlation(self, x: FloatArray) -> FloatArray:
        """(..., m) k(x, U) over s_h^2 for (..., 3) values."""
        x, points = x / self.lengths, self.points / self.lengths
        exponent = np.asarray(x @ points.T)
        exponent -= 0.5 * np.sum(points**2, axis=-1)
        exponent -= 0.5 * np.sum(x**2, axis=-1, keepdims=True)
        return np.asarray(np.exp(exponent, out=exponent))

    def functions(self, x: FloatArray) -> FloatArray:
        """(..., m) functions of (..., 3) values, whose weights are standard normal a priori."""
        return np.asarray(self.correlation(x) @ self.whitening)


class Residual(Kernel, eq=False, dict=True):
    """Gaussian process in u, v and w that is added to ln d, with the posterior of its weights."""

    mean: Annotated[Vector, Meta(description="Of the weights.")]
    covariance_factor: Annotated[
        tuple[tuple[float, ...], ...], Meta(description="Rows of the Cholesky factor of the weights' covariance.")
    ]

    def __post_init__(self) -> None:
        super().__post_init__()
        check_shapes(self, mean=(len(self.points),))
        wrong = [i + 1 for i, row in enumerate(self.covariance_factor) if len(row) != i + 1]
        if wrong or len(self.covariance_factor) != len(self.points):
            what = f"row {wrong[0]} has" if wrong else f"{len(self.covariance_factor)} rows have"
            raise BadDataError(f"covariance_factor: {what} another length than the points ask for", way_out=LEARN_ANEW)

    @cached_property
    def covariance(self) -> FloatArray:
        """(m, m) of the weights."""
        factor = np.zeros((len(self.points),) * 2)
        for i, row in enumerate(self.covariance_factor):
            factor[i, : i + 1] = row
        return factor @ factor.T

    def at(self, x: FloatArray) -> FloatArray:
        """(...,) mean of h at (..., 3) values."""
        return np.asarray(self.correlation(x) @ (self.whitening @ self.mean))
