"""Elongation of the lump: a ball's map is oval under an oblong head; only a larger axis ratio is evidence."""

from __future__ import annotations

import numpy as np

from tactile_bayes.geometry import FloatArray
from tactile_bayes.inference.normal import normal_quantile
from tactile_bayes.records import dataclass

SHOWN, SHOWN_POWER = 0.083, 1.5
"""Share of a lump's half log axis ratio that its map shows: factor, and power of d in map widths (record 0107)."""
SHOWN_CV = 0.2
"""Coefficient of variation of that between lumps."""
OVAL_SD = 0.4
"""SD of the log mean diameter by which an oval lump is off the calibration for balls, over its half log axis ratio."""


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

    oval_probability: float = 0.3
    oval_sd: float = 0.2


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


def shown_share(log_size: FloatArray, log_width: FloatArray) -> float:
    """Share of a lump's half log axis ratio that its map shows, from (n,) draws of ln d and of the log mean width."""
    return SHOWN * float(np.exp(SHOWN_POWER * np.nanmean(log_size - log_width)))


def elongation(excess: FloatArray, covariance: FloatArray, *, shown: float, prior: ShapePrior) -> Elongation:
    """Compare a round lump with an oval one.

    Parameters
    ----------
    excess : (2,) array
        Half log axis ratio of the map beyond a ball's, along and 45 degrees from the head's x axis.
    covariance : (2, 2) array
        Of the map's noise and of balls about their own curve.
    shown
        Share of the lump's half log axis ratio that the map shows, see `shown_share`.

    Notes
    -----
    Conjugate normal model; the odds are the ratio of the two marginal densities at the measured excess. The share is
    known to `SHOWN_CV` only, which matters to an oval lump alone: to first order it adds to the noise along the excess.
    """
    measured, noise = excess / shown, covariance / shown**2
    wide = noise + prior.oval_sd**2 * np.eye(2)
    log_odds = _log_normal(measured, wide) - _log_normal(measured, noise)
    log_odds += np.log(prior.oval_probability) - np.log1p(-prior.oval_probability)
    probability = float(1.0 / (1.0 + np.exp(-np.clip(log_odds, -700, 700))))
    wide = wide + SHOWN_CV**2 * np.outer(measured, measured)
    gain = prior.oval_sd**2 * np.linalg.inv(wide)
    return Elongation(probability, gain @ measured, prior.oval_sd**2 * (np.eye(2) - gain))


def turn_matrix(angle_rad: float) -> FloatArray:
    """(2, 2) matrix T that takes a half log axis ratio h to rotated axes as h @ T: half a turn changes nothing."""
    c, s = np.cos(2 * angle_rad), np.sin(2 * angle_rad)
    return np.array([[c, s], [-s, c]])


def _log_normal(x: FloatArray, covariance: FloatArray) -> float:
    _, log_det = np.linalg.slogdet(covariance)
    return float(-0.5 * (x @ np.linalg.solve(covariance, x) + log_det))
