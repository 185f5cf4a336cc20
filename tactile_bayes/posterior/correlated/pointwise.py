r"""What draws say of a window's cells under correlated errors: the density of each given the others.

A likelihood with correlated errors is no product over cells. What takes the place of a cell's factor is the density of
its value given all the others, with level, tilt, amplitudes and the noise scale integrated out as in `marginal`. For
one field, with :math:`Q = C^{-1} - C^{-1} X (X^T C^{-1} X)^{-1} X^T C^{-1}`,

.. math::
    y_i \mid y_{-i}, \theta \sim t_{\nu - 1}\Bigl(y_i - (Qy)_i / Q_{ii},\; S_{-i} / ((\nu - 1)\, Q_{ii})\Bigr),
    \qquad S_{-i} = y^T Q y - (Qy)_i^2 / Q_{ii}.

Fields are mixed with their evidence without the cell. The sum over cells is not the log likelihood of the map.

References
----------
Buerkner, Gabry & Vehtari (2021), Computational Statistics 36:1243 (non-factorised models).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from itertools import islice
from math import lgamma, log, pi

import numpy as np

from tactile_bayes.geometry import FloatArray
from tactile_bayes.posterior.correlated.linear import FieldColumns
from tactile_bayes.posterior.correlated.marginal import CollapsedTarget, linear_columns
from tactile_bayes.posterior.correlated.window import Profiles

LEAST_SHARE = 1e-6
"""Fields with a smaller share of the evidence at a draw add nothing there."""


def pointwise_log_likelihood(target: CollapsedTarget, theta: FloatArray) -> FloatArray:
    """(m, n) log density of each cell's value given the other cells, at (m, p) shape vectors.

    Parameters
    ----------
    target
        Window, scene and noise fields.
    theta : (m, p) array
        Draws of the scene's parameters.
    """
    evidence = target.by_field(theta)
    log_share = evidence - np.logaddexp.reduce(evidence, axis=1)[:, None]
    window, fixed = target.window, _fixed_columns(target)
    templates = [window.of_cells(one.full()) for one in target.scene.templates(theta, window)]
    inverse = np.full((len(theta), len(window.cells)), -np.inf)
    for h, precision_of_field in enumerate(_fields(target)):
        precision = precision_of_field()
        for m in np.flatnonzero(log_share[:, h] > log(LEAST_SHARE)):
            regressors = np.stack([*fixed, *(one[m] for one in templates)])
            found = _without_each(precision, regressors, window.cells.value)
            # p(field | the others) is its share over the cell's density under it
            inverse[m] = np.logaddexp(inverse[m], log_share[m, h] - found)
    return -inverse


def fitted_values(target: CollapsedTarget, theta: FloatArray) -> FloatArray:
    """(n,) values of the model without noise at a (p,) shape, by generalised least squares in the likeliest field."""
    window, at = target.window, theta[None]
    likeliest = int(np.argmax(target.by_field(at)[0]))
    templates = [window.of_cells(one.full())[0] for one in target.scene.templates(at, window)]
    regressors = np.stack([*_fixed_columns(target), *templates])
    precision = next(islice(_fields(target), likeliest, None))()
    middle = window.cells.value.mean()
    across = precision.times(regressors)
    solved = np.linalg.solve(across @ regressors.T, across @ (window.cells.value - middle))
    return np.asarray(middle + solved @ regressors)


def _fields(target: CollapsedTarget) -> Iterator[Callable[[], _Precision]]:
    """What makes the precision of each field and share, in the order of `CollapsedTarget.by_field`."""
    cosines = _cosines(target)
    for columns in target.fields:
        low = cosines @ columns.field.turn
        for index in range(len(columns.shares)):
            yield partial(_Precision, 1.0 / target.window.variance, low, columns, index)


def _cosines(target: CollapsedTarget) -> FloatArray:
    """A row for each cell: its products with the cosines, over its independent variance."""
    window = target.window
    unit = Profiles(grid=window.on_grid(np.eye(len(window.cells))))
    return np.asarray(window.project(unit, np.zeros((1, *window.weight.shape))).low)


def _fixed_columns(target: CollapsedTarget) -> FloatArray:
    """(c, n) level, tilt and the departure from a Gaussian where there is one."""
    columns = linear_columns(target.window.cells, tilt=target.scene.tilt)
    departure = target.problem.departure
    return columns if departure is None else np.concatenate([columns, departure])


class _Precision:
    """Inverse covariance of the cells under one field and share, up to the noise scale."""

    def __init__(self, weight: FloatArray, low: FloatArray, columns: FieldColumns, index: int) -> None:
        self._weight, self._low, self._taken = weight, low, columns.weight[:, index]
        self.diagonal = weight - np.square(low) @ self._taken

    def times(self, rows: FloatArray) -> FloatArray:
        """(v, n) products with (v, n) vectors."""
        return np.asarray(rows * self._weight - ((rows @ self._low) * self._taken) @ self._low.T)


def _without_each(precision: _Precision, regressors: FloatArray, value: FloatArray) -> FloatArray:
    """(n,) log density of each value given the others, for (v, n) columns with free coefficients."""
    # without its mean, a large level does not cost the digits that the bump is in
    centred = value - value.mean()
    weighted = precision.times(np.concatenate([regressors, centred[None]]))
    across, data = weighted[:-1], weighted[-1]
    inverse = np.linalg.inv(across @ regressors.T)
    residual = data - (inverse @ (across @ centred)) @ across
    power = precision.diagonal - np.einsum("vn,vw,wn->n", across, inverse, across)
    dof = len(value) - len(regressors) - 1
    squares = float(residual @ centred) - residual**2 / power
    scale = squares / (dof * power)
    constant = lgamma((dof + 1) / 2) - lgamma(dof / 2) - 0.5 * log(dof * pi)
    return np.asarray(
        constant - 0.5 * np.log(scale) - 0.5 * (dof + 1) * np.log1p((residual / power) ** 2 / (dof * scale))
    )
