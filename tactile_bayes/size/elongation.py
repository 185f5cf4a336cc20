"""Elongation of the lump: a ball's map is oval under an oblong head; only a larger axis ratio is evidence."""

from __future__ import annotations

import numpy as np

from tactile_bayes.geometry import FloatArray
from tactile_bayes.inference.normal import normal_quantile
from tactile_bayes.records import dataclass


@dataclass(frozen=True, slots=True)
class ShapePrior:
    """Prior of a lump's half log axis ratio, as a vector along and 45 degrees from the head's x axis.

    Parameters
    ----------
    oval_probability
        Of a lump that is not round.
    oval_sd
        Of each component for an oval lump: 0.15 is an axis ratio of 1.35 (the paper's Figure 9: 16 by 12 mm, 0.14).
    """

    oval_probability: float = 0.5
    oval_sd: float = 0.15


@dataclass(frozen=True, slots=True, eq=False)
class Elongation:
    """Posterior of a lump's half log axis ratio: round with a probability, else normal.

    Parameters
    ----------
    probability
        Of an oval lump.
    mean, covariance : (2,), (2, 2) arrays
        For an oval lump.
    """

    probability: float
    mean: FloatArray
    covariance: FloatArray

    def at(self, points: FloatArray) -> FloatArray:
        """(n, 2) draws from (n, 3) uniform points: the first decides between oval and round, which is (0, 0)."""
        values, vectors = np.linalg.eigh(self.covariance)
        normal = normal_quantile(points[:, 1:]) @ (vectors * np.sqrt(np.clip(values, 0.0, None))).T
        return np.where(points[:, :1] < self.probability, self.mean + normal, 0.0)

    @property
    def magnitude(self) -> float:
        """Posterior mean half log axis ratio of an oval lump."""
        return float(np.hypot(*self.mean))


def elongation(excess: FloatArray, covariance: FloatArray, *, slope: float, prior: ShapePrior) -> Elongation:
    """Compare a round lump with an oval one.

    Parameters
    ----------
    excess : (2,) array
        Half log axis ratio of the map beyond a ball's, along and 45 degrees from the head's x axis.
    covariance : (2, 2) array
        Of the map's noise and of balls about their own curve.
    slope
        Change of the log size by that of the log width.

    Notes
    -----
    Conjugate normal model; the odds are the ratio of the two marginal densities at the measured excess.
    """
    measured, noise = slope * excess, slope**2 * covariance
    wide = noise + prior.oval_sd**2 * np.eye(2)
    log_odds = _log_normal(measured, wide) - _log_normal(measured, noise)
    log_odds += np.log(prior.oval_probability) - np.log1p(-prior.oval_probability)
    gain = prior.oval_sd**2 * np.linalg.inv(wide)
    probability = float(1.0 / (1.0 + np.exp(-np.clip(log_odds, -700, 700))))
    return Elongation(probability, gain @ measured, prior.oval_sd**2 * (np.eye(2) - gain))


def turned(vector: FloatArray, angle_rad: float) -> FloatArray:
    """(..., 2) half log axis ratios in rotated axes: an ellipse repeats after half a turn."""
    c, s = np.cos(2 * angle_rad), np.sin(2 * angle_rad)
    return np.asarray(vector @ np.array([[c, s], [-s, c]]))


def _log_normal(x: FloatArray, covariance: FloatArray) -> float:
    _, log_det = np.linalg.slogdet(covariance)
    return float(-0.5 * (x @ np.linalg.solve(covariance, x) + log_det))
