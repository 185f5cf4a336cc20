"""Detection of a lump: evidence for a bump against noise alone, over the whole map."""

from __future__ import annotations

from math import lgamma, log, pi

import numpy as np

from tactile_bayes.geometry import FloatArray
from tactile_bayes.mapping.tactile_map import TactileMap
from tactile_bayes.posterior.lump.bump import Bump, BumpPrior
from tactile_bayes.posterior.lump.cells import FitCells, window_cells
from tactile_bayes.records import dataclass

LENGTHS_IN_WIDTHS = (0.35, 0.7, 1.4, 2.8, 5.6)
"""Correlation lengths tried for the noise, in widths of the bump under test."""
FIELD_SHARES = (0.5, 0.9, 0.99)
"""Share of the error variance that is correlated; none of it is as likely as each of them, at every length."""
MOST_BLOCKS = 480


@dataclass(frozen=True, slots=True)
class Detection:
    """Odds of a bump against smooth errors alone; see `lump_probability` for whether it is a lump.

    Parameters
    ----------
    probability
        Of a bump, at even odds and if there were only bumps and smooth errors.
    log_bayes_factor
        Natural log of the evidence ratio.
    ridge
        The ridge, in words, that a lump's evidence was held against; empty where it was held against noise alone.
    """

    probability: float
    log_bayes_factor: float
    ridge: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class _Blocks:
    """The map about a candidate, averaged over square blocks of cells."""

    x_mm: FloatArray
    y_mm: FloatArray
    value: FloatArray
    template: FloatArray
    reading_variance: FloatArray


def detect(
    tactile_map: TactileMap, bump: Bump, *, theta: FloatArray, covariance: FloatArray, prior: BumpPrior
) -> Detection:
    r"""Bayes factor of "a bump of this shape somewhere on the map" against "correlated noise on a level background".

    Parameters
    ----------
    theta, covariance : (p,), (p, p) arrays
        Least-squares estimate of the bump and its covariance.

    Notes
    -----
    Both models carry the same noise, an exponentially correlated field plus independent errors, whose length and
    share are averaged over a grid. The field is either alike all over the map, as what the model misses is, or larger
    where readings are few, as errors are that a frame's readings share: few frames reach the map's rim, and with the
    same errors there as in the middle a rise of the rim would be "detected". Level, amplitude and noise scale are
    integrated out; position and widths enter by their Laplace volume against the map's area and the prior, so that a
    search over a large map costs what it should. A lump-free map has bumps of its own, and with independent noise each
    would be "detected".

    References
    ----------
    MacKay (2003), Information Theory, Inference, and Learning Algorithms, ch. 28 (Occam factor).
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
    return _average(cells, bump.unit_bump(theta[None], cells)[0], side)


def _average(cells: FitCells, template: FloatArray, side: int) -> _Blocks:
    if not len(cells):
        empty = np.zeros(0)
        return _Blocks(empty, empty, empty, empty, empty)
    key = (cells.row // side) * (int(cells.column.max()) // side + 1) + cells.column // side
    _, index, number = np.unique(key, return_inverse=True, return_counts=True)
    keep = number >= 0.5 * side**2

    def mean(values: FloatArray) -> FloatArray:
        return np.asarray((np.bincount(index, values) / number)[keep])

    return _Blocks(
        mean(cells.x_mm), mean(cells.y_mm), mean(cells.value), mean(template), mean(1.0 / cells.count) / number[keep]
    )


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
