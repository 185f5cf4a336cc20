r"""Prior and posterior of the spread of log sizes between maps of one mass, beyond their own noise.

Map i departs from the mass by :math:`N(0, \tau^2)` beside its own noise. One map says nothing of tau, so there the
prior speaks; several maps tell it by their restricted likelihood.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from tactile_bayes.geometry import FloatArray
from tactile_bayes.records import dataclass

PAPER_SPREAD: Final = 0.15
"""Wellman & Howe (1999), section 4: SD of the sizes of one mass over its maps, as a share of the size."""
OUTLYING: Final = 3.0
_GRID = np.geomspace(1e-3, 1.5, 240)


@dataclass(frozen=True, slots=True)
class BetweenMaps:
    """Log-normal prior of tau, the standard deviation of ln d between maps of one mass.

    Parameters
    ----------
    sd
        Root of the mean of tau^2: what the variance of a single map's log size has of it. 0 leaves the term out.
    log_sd
        0 takes `sd` as known.
    """

    sd: float = PAPER_SPREAD
    log_sd: float = 0.6

    @property
    def median(self) -> float:
        """Median of tau: below `sd`, because a log-normal is skewed."""
        return float(self.sd * np.exp(-(self.log_sd**2)))

    @property
    def grid(self) -> FloatArray:
        """Grid of tau values."""
        return np.array([self.sd]) if self.sd <= 0 or self.log_sd <= 0 else _GRID

    def density(self, centre: FloatArray, noise: FloatArray) -> FloatArray:
        """Posterior weights on `grid`: restricted likelihood of the maps' centres times the prior.

        Parameters
        ----------
        centre, noise : (k,) arrays
            Mean and variance of each map's log size.
        """
        grid = self.grid
        if len(grid) == 1:
            return np.ones(1)
        log = restricted_log_likelihood(centre, noise, grid)
        log -= 0.5 * (np.log(grid / self.median) / self.log_sd) ** 2
        density = np.exp(log - log.max())  # even steps in ln tau, in which the prior is normal
        return np.asarray(density / density.sum())

    def at(self, points: FloatArray, centre: FloatArray, noise: FloatArray) -> FloatArray:
        """(n,) draws of tau from its posterior by uniform points."""
        edges = np.cumsum(self.density(centre, noise))
        return np.asarray(self.grid[np.minimum(np.searchsorted(edges, points), len(self.grid) - 1)])


def restricted_log_likelihood(centre: FloatArray, noise: FloatArray, grid: FloatArray) -> FloatArray:
    """(n,) log-likelihood of each tau of a grid by the maps of one mass, its mean integrated out.

    Parameters
    ----------
    centre, noise : (k,) arrays
        Mean and variance of each map's log size.
    """
    variance = noise[:, None] + grid**2
    weight = 1.0 / variance
    mean = np.sum(weight * centre[:, None], axis=0) / weight.sum(axis=0)
    log = -0.5 * np.sum(np.log(variance) + weight * (centre[:, None] - mean) ** 2, axis=0)
    return np.asarray(log - 0.5 * np.log(weight.sum(axis=0)))


def outlying_maps(centre: FloatArray, noise: FloatArray, prior: BetweenMaps) -> tuple[int, ...]:
    """Indices of maps more than three standard deviations from what the others predict.

    The spread between maps is taken from the others alone, so that an outlier cannot hide itself by widening it.
    """
    if len(centre) < 3:
        return ()
    found = []
    for i in range(len(centre)):
        others = np.delete(centre, i), np.delete(noise, i)
        tau2 = float(prior.density(*others) @ prior.grid**2)
        weight = 1.0 / (others[1] + tau2)
        expected, variance = float(weight @ others[0] / weight.sum()), float(1.0 / weight.sum() + noise[i] + tau2)
        if abs(centre[i] - expected) > OUTLYING * np.sqrt(variance):
            found.append(i)
    return tuple(found)
