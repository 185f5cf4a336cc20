"""Is there a lump at all, under independent noise: detection and residuals."""

from __future__ import annotations

from math import lgamma, log, pi

import numpy as np

from tactile_bayes.declarations import Record
from tactile_bayes.geometry import FloatArray
from tactile_bayes.inference.modes import inverse_information
from tactile_bayes.mapping.map import TactileMap
from tactile_bayes.options import BumpPrior
from tactile_bayes.posterior.bump import Bump, FitCells, window_cells

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
    squared residual of a fit with equal weights: the model's own misfit, that more readings do not reduce. So counts
    weigh where readings are few, and level off where the model, not the sensor, is the limit.
    """
    reading = cells.reading_variance
    if not reading > 0:
        return np.ones(len(cells))
    misfit = max(residual_variance - reading * float(np.mean(1.0 / cells.count)), 1e-3 * residual_variance)
    weight = 1.0 / (reading / cells.count + misfit)
    return np.asarray(weight / weight.mean())


def independent_errors(*, jacobian: FloatArray, residual: FloatArray, weight: FloatArray) -> ErrorModel:
    """Error model without correlation, for fits whose model contains the correlation itself."""
    k, p = jacobian.shape
    dof = max(k - p, 1)
    return ErrorModel(float(np.sqrt(weight @ residual**2 / dof)), 1.0, float(dof))


def error_model(cells: FitCells, *, jacobian: FloatArray, residual: FloatArray, weight: FloatArray) -> ErrorModel:
    """Estimate the error model from a fit's residuals.

    Neighbouring cells share frames and the model's misfit, so their errors correlate. The least-squares estimate stays
    as it is; its covariance becomes the sandwich :math:`H^{-1} J^T W C W J H^{-1}` with C from the residuals'
    autocorrelation, and `inflation` is the mean factor over the parameters. Dividing the log-likelihood by it is the
    magnitude adjustment of composite likelihoods (Chandler & Bate 2007, Biometrika 94:167; Pauli, Racugno & Ventura
    2011, Statistica Sinica 21:149).

    A level and a tilt are taken out of the residuals first. They are the misfit of a fixed background, which the maps
    that a size calibration was learned from share; `level_offset` reports it instead.
    """
    k, p = jacobian.shape
    dof = max(k - p, 1)
    residual = residual - fitted_tilt(cells, residual, weight=weight)
    noise_variance = float(weight @ residual**2) / dof
    if not noise_variance > 0 or k <= p:
        return ErrorModel(float(np.sqrt(max(noise_variance, 0.0))), 1.0, float(dof))
    white = residual * np.sqrt(weight / noise_variance)
    correlation, half = residual_autocorrelation(*cells.on_grid(np.stack([white, np.ones(k)])))
    root = jacobian * np.sqrt(weight)[:, None]
    information = inverse_information(jacobian, weight)
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


# --- Detection of a lump: evidence for a bump against noise alone, over the whole map.

LENGTHS_IN_WIDTHS = (0.35, 0.7, 1.4, 2.8, 5.6)
"""Correlation lengths tried for the noise, in widths of the bump under test."""
FIELD_SHARES = (0.5, 0.9, 0.99)
"""Share of the error variance that is correlated; none of it is as likely as each of them, at every length."""
MOST_BLOCKS = 480


class Detection(Record):
    """Odds of a bump against smooth errors alone; see `verdict` for whether it is a lump."""

    probability: float  #: Probability of a bump, at even odds and if there were only bumps and smooth errors.
    log_bayes_factor: float  #: Natural log of the evidence ratio.
    ridge: str = ""
    """The ridge, in words, that a lump's evidence was held against; empty where it was held against noise alone."""


class _Blocks(Record, eq=False):
    """The map about a candidate, averaged over square blocks of cells."""

    x_mm: FloatArray
    y_mm: FloatArray
    value: FloatArray
    template: FloatArray
    reading_variance: FloatArray


def detect(
    tactile_map: TactileMap, bump: Bump, *, theta: FloatArray, covariance: FloatArray, prior: BumpPrior
) -> Detection:
    """Bayes factor of "a bump of this shape somewhere on the map" against "correlated noise on a level background".

    `theta` (p,) is the least-squares estimate of the bump. Both models carry the same noise, an exponentially
    correlated field plus independent errors, whose length and share are averaged over a grid. The field is either alike
    all over the map, as the model's misfit is, or larger where readings are few, as errors are that a frame's readings
    share: few frames reach the map's rim, and with the same errors there as in the middle a rise of the rim would be
    "detected". Level, amplitude and noise scale are integrated out; position and widths enter by their Laplace volume
    against the map's area and the prior (the Occam factor, MacKay 2003, Information Theory, Inference, and Learning
    Algorithms, ch. 28), so that a search over a large map costs what it should. A lump-free map has bumps of its own,
    and with independent noise each would be "detected".
    """
    blocks = _blocks(tactile_map, bump, theta)
    if len(blocks.value) < 8 or theta[0] <= 0:
        return Detection(0.0, -np.inf)
    sigma_x, sigma_y, _ = bump.widths(theta)
    width = float(np.sqrt(sigma_x * sigma_y))
    null, lump = _log_evidences(blocks, width, amplitude_sd=prior.amplitude_sd * bump.scale)
    occam = _log_occam_factor(tactile_map, bump, theta=theta, covariance=covariance, prior=prior)
    return detection_from_odds(lump - null + occam)


def detection_from_odds(log_bayes_factor: float, *, ridge: str = "") -> Detection:
    """Convert a Bayes factor to a probability at even prior odds."""
    return Detection(float(1.0 / (1.0 + np.exp(-np.clip(log_bayes_factor, -700, 700)))), log_bayes_factor, ridge)


def _blocks(tactile_map: TactileMap, bump: Bump, theta: FloatArray) -> _Blocks:
    sigma_x, sigma_y, _ = bump.widths(theta)
    cell = tactile_map.recipe.cell_mm
    side = max(1, int(min(sigma_x, sigma_y) / cell))
    radius = np.sqrt(MOST_BLOCKS / pi) * side * cell
    cells = window_cells(tactile_map, (float(theta[1]), float(theta[2])), radius_mm=float(radius))
    if not len(cells):
        return _Blocks(*[np.zeros(0)] * 5)
    key = (cells.row // side) * (int(cells.column.max()) // side + 1) + cells.column // side
    _, index, number = np.unique(key, return_inverse=True, return_counts=True)
    keep = number >= 0.5 * side**2
    averaged = (cells.x_mm, cells.y_mm, cells.value, bump.unit_bump(theta[None], cells)[0], 1.0 / cells.count)
    x, y, value, template, reading = ((np.bincount(index, one) / number)[keep] for one in averaged)
    return _Blocks(x, y, value, template, reading / number[keep])


def _log_evidences(blocks: _Blocks, width_mm: float, *, amplitude_sd: float) -> tuple[float, float]:
    """Log evidence without and with the bump, averaged over the noise fields, up to a common constant."""
    distance = np.hypot(blocks.x_mm[:, None] - blocks.x_mm, blocks.y_mm[:, None] - blocks.y_mm)
    nugget = blocks.reading_variance / blocks.reading_variance.mean()
    scales = (np.ones_like(nugget), np.sqrt(nugget))
    white = _log_evidence_pair(blocks, np.diag(nugget), amplitude_sd=amplitude_sd)
    pairs = [np.array(white) + log(len(scales) * len(LENGTHS_IN_WIDTHS))]
    for length in LENGTHS_IN_WIDTHS:
        alike = np.exp(-distance / (length * width_mm))
        for scale in scales:
            field = alike * scale[:, None] * scale
            for share in FIELD_SHARES:
                errors = share * field + (1.0 - share) * np.diag(nugget)
                pairs.append(np.array(_log_evidence_pair(blocks, errors, amplitude_sd=amplitude_sd)))
    null, lump = np.logaddexp.reduce(pairs, axis=0)
    return float(null), float(lump)


def _log_evidence_pair(blocks: _Blocks, errors: FloatArray, *, amplitude_sd: float) -> tuple[float, float]:
    """Log evidence without and with the bump for errors of one covariance (n, n), up to a common constant."""
    n = len(blocks.value)
    factor = np.linalg.cholesky(errors + 1e-9 * np.eye(n))
    white = np.linalg.solve(factor, np.stack([np.ones(n), blocks.value, blocks.template], axis=1))
    one, y, g = white.T
    half_log_det = float(np.log(np.diag(factor)).sum())
    level = one @ one
    y = y - one * (one @ y) / level
    g = g - one * (one @ g) / level
    tiny = np.finfo(float).tiny
    rss = max(float(y @ y), tiny)
    null = -half_log_det - 0.5 * log(level) + lgamma((n - 1) / 2) - (n - 1) / 2 * log(pi * rss)
    power = float(g @ g)
    amplitude = float(g @ y) / power if power > 0 else 0.0
    if not power > 1e-12 or amplitude <= 0:
        return null, -np.inf
    left = max(rss - power * amplitude**2, 1e-12 * rss)
    prior = -0.5 * (amplitude / amplitude_sd) ** 2 - log(amplitude_sd) - 0.5 * log(2 * pi)
    lump = -half_log_det - 0.5 * log(level * power) + lgamma((n - 2) / 2) - (n - 2) / 2 * log(pi * left) + prior
    return null, lump


def _log_occam_factor(
    tactile_map: TactileMap, bump: Bump, *, theta: FloatArray, covariance: FloatArray, prior: BumpPrior
) -> float:
    """Log of the posterior volume of position and widths over their prior volume."""
    block = covariance[1:5, 1:5]
    if not np.isfinite(block).all():
        return -np.inf
    sign, log_det = np.linalg.slogdet(block)
    if sign <= 0 or not np.isfinite(log_det):
        return -np.inf
    area = float(tactile_map.covered.sum()) * tactile_map.recipe.cell_mm**2
    p, q, _ = bump.shape_parameters(theta)
    density = (
        -0.5 * ((p - log(prior.width_median_mm)) / prior.log_width_sd) ** 2
        - 0.5 * (q / prior.log_ratio_sd) ** 2
        - log(2 * pi * prior.log_width_sd * prior.log_ratio_sd)
        - log(area)
    )
    return float(min(2 * log(2 * pi) + 0.5 * log_det + density, 0.0))
