r"""Outline of a lump: whether its bump is skewed, or rounder inside than outside, more than a ball's is.

With :math:`z` the place in widths along the ellipse's axes and :math:`G = e^{-|z|^2/2}`, the columns are
:math:`G\,|z|^2 (z_1, z_2)` for skewness and :math:`G\,|z|^2 (z_1^2 - z_2^2, 2 z_1 z_2)` for an axis ratio that changes
outwards. What they have in common with the bump, its derivatives and its exponent is taken off under the noise field.
"""

from __future__ import annotations

import numpy as np

from tactile_bayes.forward.gaussian import covariance_from_log_widths
from tactile_bayes.geometry import FloatArray
from tactile_bayes.posterior.correlated.fit import FieldFit
from tactile_bayes.posterior.correlated.linear import FLOOR
from tactile_bayes.posterior.correlated.tangent import tangent_columns

BALLS_SD = (0.008, 0.01)
"""Of skewness and change of balls' maps beyond their noise, over the amplitude (record 0107)."""
NOISE_FACTOR = 2.5
"""Variance of both over that by the residuals: deep and faint lumps are off by more than they say."""
MOST_SDS = 2.5
"""Length of either beyond which a ball is unlikely: of two components, in the SD of one."""


def irregular(fit: FieldFit) -> bool:
    """Whether the bump is more skewed, or its axis ratio changes more outwards, than a ball's.

    Judged where the lump stands alone: what is left of a neighbour would answer.
    """
    if fit.scene.extra or fit.scene.shape == "ridge":
        return False
    found, covariance = outline(fit)
    pairs = ((slice(0, 2), BALLS_SD[0]), (slice(2, 4), BALLS_SD[1]))
    return any(
        float(found[at] @ np.linalg.solve(NOISE_FACTOR * covariance[at, at] + sd**2 * np.eye(2), found[at]))
        > MOST_SDS**2
        for at, sd in pairs
    )


def outline(fit: FieldFit) -> tuple[FloatArray, FloatArray]:
    """(4,) skewness and change of the axis ratio, over the amplitude, and their (4, 4) covariance."""
    cells = fit.target.window.cells
    asked, further = _columns(fit)
    known = np.concatenate([tangent_columns(fit), further])
    value = cells.value - cells.value.mean()
    columns = np.concatenate([known, asked, value[None]])
    products = fit.target.products(columns, columns, fit.mode)
    v = len(known)
    shared = np.linalg.lstsq(products[:v, :v], products[:v, v:], rcond=None)[0]
    left = products[v:, v:] - products[v:, :v] @ shared
    found = np.linalg.solve(left[:4, :4], left[:4, 4])
    squares = max(float(left[4, 4] - found @ left[:4, 4]), FLOOR * float(products[-1, -1]))
    variance = squares / max(len(cells) - v - 4, 1)
    amplitude = fit.target.amplitude_at(fit.mode)
    return np.asarray(found / amplitude), np.asarray(np.linalg.inv(left[:4, :4]) * variance / amplitude**2)


def _columns(fit: FieldFit) -> tuple[FloatArray, FloatArray]:
    """(4, n) columns of the outline, and (2, n) of the oblique axis ratio and the exponent."""
    scene, mode, cells = fit.scene, fit.mode, fit.target.window.cells
    away = np.stack([cells.x_mm - scene.column(mode, "x"), cells.y_mm - scene.column(mode, "y")])
    x, y = np.linalg.solve(np.linalg.cholesky(covariance_from_log_widths(*scene.widths(mode))), away)
    square = x**2 + y**2
    bump = np.exp(-0.5 * square)
    outer = bump * square
    return np.stack([outer * x, outer * y, outer * (x**2 - y**2), outer * 2 * x * y]), np.stack(
        [bump * x * y, outer * square]
    )
