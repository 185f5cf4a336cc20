r"""Growth of a mass over time: its rate between visits, and a straight line of ln d over three visits and more.

The specific growth rate of the volume is :math:`3\, d(\ln d)/dt`, and the doubling time ln 2 over it (Mehrara et al.
2007, Cancer Research 67:3970). The rate is the better figure: it is zero, not infinite, for a mass that stays, and its
interval is about as wide on both sides.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from tactile_bayes.geometry import FloatArray
from tactile_bayes.records import dataclass

VOLUME: Final = 3.0
"""d ln V / d ln d of a lump that keeps its form."""


@dataclass(frozen=True, slots=True)
class Trend:
    """Straight line of ln d over time.

    Parameters
    ----------
    per_day, sd
        Slope of ln d and its posterior SD.
    departure
        Probability that sizes on a straight line come out as far from one or farther; None for two visits, which are
        always on one.
    """

    per_day: float
    sd: float
    departure: float | None


def straight_line(log_size: FloatArray, covariance: FloatArray, days: Sequence[float]) -> Trend:
    """Fit ln d of several visits by generalised least squares, with flat priors of level and slope.

    Parameters
    ----------
    log_size : (v,) array
    covariance : (v, v) array
        With what the visits share, so that it cancels in the slope.
    days
        Times of the visits.
    """
    columns = np.stack([np.ones(len(days)), np.array(days) - np.mean(days)], axis=1)
    weighted = np.linalg.solve(covariance, columns)
    spread = np.linalg.inv(columns.T @ weighted)
    found = spread @ (weighted.T @ log_size)
    left = log_size - columns @ found
    square = float(left @ np.linalg.solve(covariance, left))
    return Trend(float(found[1]), float(np.sqrt(spread[1, 1])), _tail(square, len(days) - 2))


def _tail(square: float, dof: int) -> float | None:
    """Upper tail of chi square."""
    if dof < 1:
        return None
    from scipy.special import gammaincc

    return float(gammaincc(0.5 * dof, 0.5 * square))


def doubling_days(rate_per_day: float) -> float | None:
    """Doubling time of the volume in days by a specific growth rate; None where the volume does not grow."""
    return float(np.log(2.0) / rate_per_day) if rate_per_day > 0 else None
