"""The Gaussian bump of the map (Eqs 5 and 7), averaged over the map's square cells."""

from __future__ import annotations

import numpy as np

from tactile_bayes.geometry import FloatArray


def cell_mean_gaussian(x_mm: FloatArray, y_mm: FloatArray, *, covariance_mm2: FloatArray, cell_mm: float) -> FloatArray:
    r"""Mean over a square cell of a Gaussian of unit height, at cell centres relative to its centre, in mm.

    Leading axes of x and y are those of the (..., 2, 2) covariance, whose diagonal is sigma_x^2, sigma_y^2 when the
    axes agree. A cell of 0 gives the Gaussian at the centres.

    Averaging over a cell is a convolution with a box, which adds :math:`h^2/12` to each variance and brings a fourth
    cumulant of :math:`-h^4/120` along each axis of the grid. Both are kept (Edgeworth series); the first term left out
    is :math:`h^6/(12096\,\sigma^6)` for each axis, below 3e-5 of the height at :math:`h = 0.75\,\sigma`. Wellman & Howe
    (1999) eq. 7 is the case ``cell_mm=0`` and a diagonal covariance.
    """
    wide = covariance_mm2 + (cell_mm**2 / 12.0) * np.eye(2)
    sxx, sxy, syy = wide[..., 0, 0, None], wide[..., 0, 1, None], wide[..., 1, 1, None]
    wide_det = sxx * syy - sxy**2
    narrow_det = covariance_mm2[..., 0, 0] * covariance_mm2[..., 1, 1] - covariance_mm2[..., 0, 1] ** 2
    pxx, pxy, pyy = syy / wide_det, -sxy / wide_det, sxx / wide_det
    u = pxx * x_mm + pxy * y_mm
    v = pxy * x_mm + pyy * y_mm
    height = np.sqrt(np.clip(narrow_det, 0.0, None))[..., None] / np.sqrt(wide_det)
    gaussian = height * np.exp(-0.5 * (x_mm * u + y_mm * v))
    if cell_mm == 0.0:
        return np.asarray(gaussian)
    u2, v2 = u * u, v * v
    fourth = u2 * (u2 - 6.0 * pxx) + v2 * (v2 - 6.0 * pyy) + 3.0 * (pxx**2 + pyy**2)
    return np.asarray(gaussian * (1.0 - cell_mm**4 / 2880.0 * fourth))


def covariance_from_log_widths(p: FloatArray, q: FloatArray, r: FloatArray) -> FloatArray:
    r"""Covariance in mm^2, (..., 2, 2), of a Gaussian from unconstrained coordinates that are smooth through the round
    case.

    :math:`\Sigma^{1/2} = \exp\begin{pmatrix}p+q & r\\ r & p-q\end{pmatrix}` with lengths in mm: p is the log of the
    geometric mean width, ``(q, r)`` the log axis ratio and its direction. For r = 0, sigma_x = exp(p + q) and sigma_y =
    exp(p - q).
    """
    ratio = np.hypot(q, r)
    scale = np.exp(2.0 * p)
    even = scale * np.cosh(2.0 * ratio)
    # sinh(2 rho) / rho, finite at rho = 0
    odd = scale * 2.0 * np.where(ratio > 1e-8, np.sinh(2.0 * ratio) / np.where(ratio > 1e-8, 2.0 * ratio, 1.0), 1.0)
    return np.stack(
        [np.stack([even + odd * q, odd * r], axis=-1), np.stack([odd * r, even - odd * q], axis=-1)], axis=-2
    )


def principal_widths(p: FloatArray, q: FloatArray, r: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Widths (mm) along the ellipse's own axes, and the angle of the first.

    ``sigma_x_mm`` is the standard deviation along the axis within 45 degrees of x, ``sigma_y_mm`` the one at right
    angles to it; ``angle_rad`` goes from x to the axis of ``sigma_x_mm``, in (-pi/4, pi/4], 0 for a round Gaussian.
    """
    ratio = np.hypot(q, r)
    signed = np.where(q >= 0, ratio, -ratio)
    angle = np.where(ratio > 0, 0.5 * np.arctan2(np.where(q >= 0, r, -r), np.abs(q)), 0.0)
    return np.exp(p + signed), np.exp(p - signed), angle
