"""What the maps of one mass say of the lump by a calibration: sizes without B and E, and the lump's shape."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tactile_bayes.geometry import FloatArray
from tactile_bayes.size.body_calibration import BodyCalibration
from tactile_bayes.size.elongation import Elongation, ShapePrior, elongation, shown_share, turn_matrix
from tactile_bayes.size.shape_draws import ShapeDraws
from tactile_bayes.size.site_shift import site_log_shift


def log_sizes(calibration: BodyCalibration, maps: Sequence[ShapeDraws]) -> list[FloatArray]:
    """(n,) ln d of each map's draws without B and E, with the site's correction where there is one."""
    return [corrected_log_size(calibration, one) for one in maps]


def corrected_log_size(calibration: BodyCalibration, shape: ShapeDraws) -> FloatArray:
    """The same of one map."""
    size = calibration.log_size(shape.log_amplitude, shape.log_width)
    return np.asarray(size + site_log_shift(calibration.site, shape.log_width))


def map_terms(calibration: BodyCalibration, maps: Sequence[ShapeDraws]) -> FloatArray:
    """(k, n, t) terms of each map's draws."""
    return np.stack([calibration.terms(one.log_amplitude, one.log_width) for one in maps])


def lump_shape(
    calibration: BodyCalibration, maps: Sequence[ShapeDraws], sizes: Sequence[FloatArray], prior: ShapePrior
) -> tuple[Elongation, float]:
    """Posterior of the lump's shape in the axes the maps share, and the share of it that they show."""
    excess, covariance, shown = np.zeros(2), np.zeros((2, 2)), 0.0
    k = len(maps)
    for one, size in zip(maps, sizes, strict=True):
        mean, spread = _axis_ratio(one)
        mean[0] -= float(np.nanmean(calibration.round_excess(one.log_amplitude, one.log_width)))
        turn = turn_matrix(-one.turn_rad)
        excess += mean @ turn / k
        covariance += turn.T @ spread @ turn / k**2
        shown += shown_share(size, one.log_width) / k
    balls = calibration.round_lumps.spread
    whole = balls.map_factor * covariance + (balls.variance(np.zeros(()), maps=k) + 1e-12) * np.eye(2)
    return elongation(excess, whole, shown=shown, prior=prior), shown


def _axis_ratio(one: ShapeDraws) -> tuple[FloatArray, FloatArray]:
    """Mean and covariance of q and r; where nobody measured r, it is within twice the SD of q about 0.

    It was left out because the map does not speak for it.
    """
    both = np.stack([one.q, one.r], axis=-1)
    both = both[np.isfinite(both).all(axis=1)]
    mean, covariance = both.mean(axis=0), np.cov(both.T)
    if not covariance[1, 1] > 0:
        mean[1], sd = one.oblique or (0.0, 2.0 * float(np.sqrt(covariance[0, 0])))
        covariance[1, 1] = sd**2
    return mean, covariance
