"""Errors of a map's cells, from the residuals of a fit, and the odds of a bump against them."""

from __future__ import annotations

import numpy as np

from tactile_bayes.declarations import Record
from tactile_bayes.geometry import FloatArray
from tactile_bayes.inference.modes import LeastSquaresFit, inverse_information
from tactile_bayes.posterior.bump import FitCells

# --- Error model from a fit's residuals: variance, weights by count, correlation.


class ErrorModel(Record):
    """Size and correlation of a map's errors, from a fit's residuals."""

    noise_sd: float  #: Standard deviation of a cell of unit weight.
    inflation: float
    """Factor by which correlated errors widen the parameters' variance over that of independent cells; at least 1."""
    dof: float  #: Effective degrees of freedom of `noise_sd`.


MINIMUM_DOF = 6.0
"""Tails no heavier than a t with this many degrees of freedom: below it the draws' variance would mean nothing."""


def count_weights(cells: FitCells, residual_variance: float) -> FloatArray:
    """(k,) weights from counts, of mean 1: the variance of a cell is ``v / n + delta^2``.

    v is the pooled within-cell variance of a reading, n the count; delta^2 is the rest of `residual_variance`, the mean
    squared residual of a fit with equal weights: the model's own misfit, that more readings do not reduce.
    """
    reading = cells.reading_variance
    if not reading > 0:
        return np.ones(len(cells))
    misfit = max(residual_variance - reading * float(np.mean(1.0 / cells.count)), 1e-3 * residual_variance)
    weight = 1.0 / (reading / cells.count + misfit)
    return np.asarray(weight / weight.mean())


def independent_errors(fit: LeastSquaresFit, weight: FloatArray) -> ErrorModel:
    """Error model without correlation, for fits whose model contains the correlation itself."""
    k, p = fit.jacobian.shape
    dof = max(k - p, 1)
    return ErrorModel(float(np.sqrt(weight @ fit.residual**2 / dof)), 1.0, float(dof))


def error_model(cells: FitCells, fit: LeastSquaresFit, weight: FloatArray) -> ErrorModel:
    """Estimate the error model from a fit's residuals.

    Neighbouring cells share frames and the model's misfit, so their errors correlate. The least-squares estimate stays
    as it is; its covariance becomes the sandwich :math:`H^{-1} J^T W C W J H^{-1}` with C from the residuals'
    autocorrelation, and `inflation` is the mean factor over the parameters. Dividing the log-likelihood by it is the
    magnitude adjustment of composite likelihoods (Chandler & Bate 2007, Biometrika 94:167; Pauli, Racugno & Ventura
    2011, Statistica Sinica 21:149).

    A level and a tilt are taken out of the residuals first. They are the misfit of a fixed background, which the maps
    that a size calibration was learned from share; `level_offset` reports it instead.
    """
    k, p = fit.jacobian.shape
    dof = max(k - p, 1)
    residual = fit.residual - fitted_tilt(cells, fit.residual, weight=weight)
    noise_variance = float(weight @ residual**2) / dof
    if not noise_variance > 0 or k <= p:
        return ErrorModel(float(np.sqrt(max(noise_variance, 0.0))), 1.0, float(dof))
    white = residual * np.sqrt(weight / noise_variance)
    correlation, half = residual_autocorrelation(*cells.on_grid(np.stack([white, np.ones(k)])))
    root = fit.jacobian * np.sqrt(weight)[:, None]
    information = inverse_information(fit.jacobian, weight)
    if not np.isfinite(information).all():
        return ErrorModel(float(np.sqrt(noise_variance)), 1.0, float(dof))
    smeared = _correlate_columns(cells, root, correlation, half)
    inflation = float(np.trace(information @ (root.T @ smeared)) / p)
    inflation = float(np.clip(inflation, 1.0, k / (p + MINIMUM_DOF)))
    return ErrorModel(float(np.sqrt(noise_variance)), inflation, max(dof / inflation, MINIMUM_DOF))


def fitted_tilt(cells: FitCells, residual: FloatArray, *, weight: FloatArray) -> FloatArray:
    """(k,) weighted least-squares plane through the residuals; zeros where there are too few cells."""
    if len(cells) < 12:
        return np.zeros(len(cells))
    design = np.stack([np.ones(len(cells)), cells.x_mm - cells.x_mm.mean(), cells.y_mm - cells.y_mm.mean()], axis=1)
    root = np.sqrt(weight)
    solution = np.linalg.lstsq(design * root[:, None], residual * root, rcond=None)[0]
    return np.asarray(design @ solution)


def level_offset(residual: FloatArray, *, weight: FloatArray) -> float:
    """Mean residual of the window: distance of the map's level from the assumed background."""
    return float(weight @ residual / weight.sum())


def residual_autocorrelation(grid: FloatArray, mask: FloatArray) -> tuple[FloatArray, int]:
    """Radial autocorrelation of whitened residuals, (2 half + 1, 2 half + 1) by lag in cells, and the largest lag kept.

    1 in the middle, isotropic, and 0 beyond the first lag that is not clearly above its noise.
    """
    ny, nx = grid.shape
    size = (2 * ny, 2 * nx)
    spectrum = np.fft.rfft2(grid, size)
    cover = np.fft.rfft2(mask, size)
    products = np.fft.irfft2(np.abs(spectrum) ** 2, size)
    pairs = np.round(np.fft.irfft2(np.abs(cover) ** 2, size))
    lag_y = np.fft.fftfreq(2 * ny, 1 / (2 * ny))[:, None]
    lag_x = np.fft.fftfreq(2 * nx, 1 / (2 * nx))[None, :]
    ring = np.round(np.hypot(lag_y, lag_x)).astype(int)
    most = max(1, min(ny, nx) // 2)
    near = (ring <= most) & (pairs > 0)
    total = np.bincount(ring[near], products[near], most + 1)
    number = np.bincount(ring[near], pairs[near], most + 1)
    radial = total / np.maximum(number, 1)
    radial = radial / radial[0] if radial[0] > 0 else np.eye(1, most + 1)[0]
    quiet = np.flatnonzero(radial < 2.0 / np.sqrt(np.maximum(number / 2.0, 1.0)))
    half = int(quiet[0]) - 1 if len(quiet) else most
    axis = np.arange(-half, half + 1)
    lag = np.round(np.hypot(axis[:, None], axis[None, :])).astype(int)
    return np.where(lag <= half, radial[np.minimum(lag, most)], 0.0), half


def _correlate_columns(cells: FitCells, columns: FloatArray, correlation: FloatArray, half: int) -> FloatArray:
    """``C @ columns`` for the stationary correlation on the cells' grid."""
    if half == 0:
        return columns
    grid = cells.on_grid(columns.T)
    size = (grid.shape[1] + 2 * half, grid.shape[2] + 2 * half)
    full = np.fft.irfft2(np.fft.rfft2(grid, size) * np.fft.rfft2(correlation, size), size)
    return full[:, cells.row - cells.row.min() + half, cells.column - cells.column.min() + half].T


# --- Odds of a bump.


class Detection(Record):
    """Odds of a bump against smooth errors alone; see `verdict` for whether it is a lump."""

    probability: float  #: Probability of a bump, at even odds and if there were only bumps and smooth errors.
    log_bayes_factor: float  #: Natural log of the evidence ratio.
    ridge: str = ""
    """The ridge, in words, that a lump's evidence was held against; empty where it was held against noise alone."""


def detection_from_odds(log_bayes_factor: float, *, ridge: str = "") -> Detection:
    """Convert a Bayes factor to a probability at even prior odds."""
    return Detection(float(1.0 / (1.0 + np.exp(-np.clip(log_bayes_factor, -700, 700)))), log_bayes_factor, ridge)
