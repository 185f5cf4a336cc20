r"""Spread between exams of one mass, learned from the repeated exams of several masses.

Exam j of mass i gives :math:`g_{ij} = \mu_i + E_{ij} + e_{ij}`, with :math:`E_{ij} \sim N(0, \tau^2)` between exams
and :math:`e_{ij} \sim N(0, v_{ij})` the map's own error. Nothing is supposed of :math:`\mu_i`: the mass's size, and all
that its body does to every map of it, cancel. The restricted likelihood of tau is the product over masses of that of
one mass, `between_maps.restricted_log_likelihood`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from tactile_bayes.errors import BadDataError
from tactile_bayes.geometry import FloatArray
from tactile_bayes.records import dataclass
from tactile_bayes.size.between_maps import restricted_log_likelihood
from tactile_bayes.size.repeatability import PROBABILITY, Repeatability

FEWEST_MASSES: Final = 3
PRIOR_MEDIAN: Final = 0.08
"""Of tau: between the spread of simulated exams (5 %) and that of the paper's maps (15 %)."""
PRIOR_LOG_SD: Final = 1.0
"""95 % of the prior lies between 1.1 and 57 %."""
FALSE_ALARMS: Final = 0.05
"""Share of sites with nothing wrong at which some mass is named as outlying."""
GRID: Final = np.geomspace(1e-3, 1.5, 600)


@dataclass(frozen=True, slots=True, eq=False)
class RepeatedExams:
    """Exams of one mass at one visit.

    Parameters
    ----------
    name
        Of the mass at this visit.
    mass
        Of the mass at any visit.
    centre, noise : (k,) arrays
        Mean and variance of ln d by each map alone.
    """

    name: str
    mass: str
    centre: FloatArray
    noise: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class LearnedSpread:
    """What repeated exams say of the spread.

    Parameters
    ----------
    density : (n,) array
        Posterior weights on `GRID`.
    by_chance
        For each of the given exams of a mass: the probability of a spread as large as theirs, by the other masses.
    repeatability
        The summary, without the calibration's name.
    """

    density: FloatArray
    by_chance: tuple[float, ...]
    repeatability: Repeatability


def learn_repeatability(repeats: Sequence[RepeatedExams], *, fewest: int = FEWEST_MASSES) -> LearnedSpread:
    """Learn the spread between exams of one mass.

    Parameters
    ----------
    repeats
        One for each mass and visit with two exams or more; those of one mass are left out together when its exams are
        compared with the others'.
    fewest
        Masses with repeated exams that it takes.

    Raises
    ------
    BadDataError
        When fewer masses have repeated exams.
    """
    repeats = [one for one in repeats if len(one.centre) > 1]
    masses = sorted({one.mass for one in repeats})
    if len(masses) < fewest:
        what = f"{len(masses)} {'mass has' if len(masses) == 1 else 'masses have'} repeated exams with sizes"
        raise BadDataError(what, way_out=f"give at least {fewest}: {_WHY}")
    by_exams = np.stack([restricted_log_likelihood(one.centre, one.noise, GRID) for one in repeats])
    density = _density(by_exams.sum(axis=0))
    by_chance = []
    for one in repeats:
        others = [row for row, other in zip(by_exams, repeats, strict=True) if other.mass != one.mass]
        by_chance.append(_by_chance(one, _density(np.sum(others, axis=0))))
    limit = FALSE_ALARMS / len(repeats)
    outlying = tuple(one.name for one, chance in zip(repeats, by_chance, strict=True) if chance < limit)
    maps = sum(len(one.centre) for one in repeats)
    return LearnedSpread(density, tuple(by_chance), _summary(density, len(masses), maps, outlying))


_WHY: Final = "one or two masses do not tell an unusual mass from a site's spread"


def _density(log_likelihood: FloatArray) -> FloatArray:
    """(n,) posterior weights on the grid, whose steps in ln tau are even."""
    log = log_likelihood - 0.5 * (np.log(GRID / PRIOR_MEDIAN) / PRIOR_LOG_SD) ** 2
    density = np.exp(log - log.max())
    return np.asarray(density / density.sum())


def _summary(density: FloatArray, masses: int, maps: int, outlying: tuple[str, ...]) -> Repeatability:
    """Quantiles, and the log-normal with the same means of tau^2 and tau^4: a map's size has tau in its variance."""
    square, fourth = float(density @ GRID**2), float(density @ GRID**4)
    tails = 0.5 * (1.0 - PROBABILITY)
    low, median, high = np.interp((tails, 0.5, 1.0 - tails), np.cumsum(density) - 0.5 * density, GRID)
    log_sd = float(np.sqrt(max(np.log(fourth / square**2), 0.0) / 4.0))
    return Repeatability(
        float(np.sqrt(square)), log_sd, float(median), float(low), float(high), masses, maps, outlying=outlying
    )


def _by_chance(one: RepeatedExams, density: FloatArray) -> float:
    """Probability, given the other masses, that exams of a mass lie as far apart as these or further.

    Given tau the weighted sum of squares about their mean has a chi-squared distribution.
    """
    from scipy.special import gammaincc

    weight = 1.0 / (one.noise[:, None] + GRID**2)
    mean = np.sum(weight * one.centre[:, None], axis=0) / weight.sum(axis=0)
    squares = np.sum(weight * (one.centre[:, None] - mean) ** 2, axis=0)
    return float(density @ gammaincc(0.5 * (len(one.centre) - 1), 0.5 * squares))
