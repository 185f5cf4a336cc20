r"""How far sizes of one mass lie apart between its maps: prior, posterior, outlying maps, and tests of one size.

Map i gives :math:`g_i = m + E_i`, :math:`E_i \sim N(0, s_i^2 + \tau^2)`, s its own noise. One map says nothing of tau,
so there the prior speaks; several maps tell it by their restricted likelihood. Given tau, Cochran's
:math:`Q = \sum w_i (g_i - \bar g)^2` with :math:`w_i = 1 / (s_i^2 + \tau^2)` follows :math:`\chi^2_{k-1}`; the
probability of a Q as large or larger is averaged over what is known of tau before these maps. It is not learned from
them: two maps that contradict each other would make any difference likely.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from scipy.special import gammaincc

from tactile_bayes.declarations import Record
from tactile_bayes.geometry import FloatArray

PAPER_SPREAD: Final = 0.15
"""Wellman & Howe (1999), section 4: SD of the sizes of one mass over its maps, as a share of the size."""
OUTLYING: Final = 3.0
LEAST_PROBABILITY: Final = 0.01
"""Below it maps are not of one size, or of one place: one pool in a hundred is refused though it is."""
EXAM_SD: Final = 0.05
"""SD of ln d between exams of one mass, where a site does not tell it: of the exams of two simulators (record 0129)."""
_GRID = np.geomspace(1e-3, 1.5, 240)


class BetweenMaps(Record):
    """Log-normal prior of tau, the standard deviation of ln d between maps of one mass.

    `sd` is the root of the mean of tau^2: what the variance of a single map's log size has of it; 0 leaves the term
    out. A `log_sd` of 0 takes `sd` as known.
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
        """Posterior weights on `grid`, from (k,) means and variances of the maps' log sizes."""
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
    """(n,) log-likelihood of each tau of a grid, from (k,) means and variances of a mass's maps, its mean left open."""
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


def spread_tested(known: BetweenMaps | None) -> BetweenMaps:
    """The spread between exams that a test supposes: the site's or a stated one, else `EXAM_SD`."""
    return BetweenMaps(EXAM_SD, 0.0) if known is None else known


def one_size_probability(centre: FloatArray, noise: FloatArray, between: BetweenMaps) -> float:
    """Probability that maps of one mass come out as far apart in size or farther, from their (k,) means and variances.

    Notes
    -----
    Cochran (1954), Biometrics 10, 101; DerSimonian and Laird (1986), Controlled Clinical Trials 7, 177.
    """
    if len(centre) < 2:
        return 1.0
    prior = between.density(np.zeros(1), np.zeros(1))
    return float(prior @ apart_by_chance(centre, noise, between.grid))


def one_size_of(log_sizes: Sequence[FloatArray], known: BetweenMaps | None) -> float:
    """`one_size_probability` of maps by the draws of each one's log size."""
    centre, noise = (np.array([of(one) for one in log_sizes]) for of in (np.nanmean, np.nanvar))
    return one_size_probability(centre, noise, spread_tested(known))


def apart_by_chance(centre: FloatArray, noise: FloatArray, grid: FloatArray) -> FloatArray:
    """(n,) probability of a Q as large or larger, for each tau of a grid."""
    weight = 1.0 / (noise[:, None] + grid**2)
    mean = np.sum(weight * centre[:, None], axis=0) / weight.sum(axis=0)
    q = np.sum(weight * (centre[:, None] - mean) ** 2, axis=0)
    return above_chi_square(q, len(centre) - 1)


def above_chi_square(q: FloatArray, degrees: int) -> FloatArray:
    """(...,) probability that a chi-squared variable is above q."""
    return np.asarray(gammaincc(0.5 * degrees, 0.5 * q))
