"""Passing and Bablok's line: the shifted median of the slopes of all pairs of masses.

Conventions, those that laboratories' programs share: the slope of a vertical pair is +90 degrees when Kendall's tau is
0 or more and -90 degrees otherwise; coincident pairs are left out; a slope of exactly -1 (+1 for a falling line) counts
half in the shift; means of two middle slopes are taken between angles (``radian``) or between slopes (``tangent``).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from tactile_bayes.trial.jackknife import UndefinedError
from tactile_bayes.trial.pair_angles import PairAngles, kendall_sign
from tactile_bayes.trial.readings import FloatArray

Measure = Literal["radian", "tangent"]


@dataclass(frozen=True, slots=True)
class PassingBablok:
    """A Passing-Bablok line with its intervals; ends may be infinite for few masses."""

    intercept: float
    slope: float
    intercept_interval: tuple[float, float]
    slope_interval: tuple[float, float]
    n: int


def passing_bablok(
    x: FloatArray, y: FloatArray, *, confidence: float = 0.95, measure: Measure = "radian"
) -> PassingBablok:
    """Fit y on x without assuming a distribution or knowing which method errs more.

    Parameters
    ----------
    x, y : (n,) arrays
    measure
        How two middle slopes are averaged.

    Notes
    -----
    Passing & Bablok (1983), J. Clin. Chem. Clin. Biochem. 21, 709, for a line that rises; the mirror image for one that
    falls. The intercept is the median of y - slope x. Slope ends are order statistics at the shifted median -+
    :math:`z\\sqrt{n(n-1)(2n+5)/18}/2`, intercept ends the medians for the two slope ends. When either slope end lies
    beyond the ordered slopes, both ends of both intervals are infinite.

    Raises
    ------
    UndefinedError
        With fewer than two different points, when the middle slope is vertical, or when so many slopes are beyond 45
        degrees against the line that the shifted median lies beyond the last.
    """
    if len(x) < 2:
        raise UndefinedError(f"a line needs at least 2 masses (found {len(x)})")
    rising = kendall_sign(x, y) >= 0
    angles = PairAngles(x, y, vertical=math.pi / 2 if rising else -math.pi / 2)
    if angles.number == 0:
        raise UndefinedError("all points coincide, so no line is determined")
    shift = angles.shift(rising=rising)
    if (angles.number + shift) // 2 + 1 > angles.number or angles.number + shift < 1:
        raise UndefinedError("the shifted median lies beyond the slopes: the points neither rise nor fall")
    slope = _at(angles, angles.number + shift, measure)
    if not abs(slope) < 1e15:
        raise UndefinedError("the middle slope is vertical")
    ends = _slope_ends(angles, shift, rising=rising, confidence=confidence, measure=measure, n=len(x))
    return PassingBablok(
        intercept=float(np.median(y - slope * x)),
        slope=slope,
        intercept_interval=_intercept_ends(x, y, ends),
        slope_interval=ends,
        n=len(x),
    )


def _slope_ends(
    angles: PairAngles, shift: int, *, rising: bool, confidence: float, measure: Measure, n: int
) -> tuple[float, float]:
    from scipy.special import ndtri

    sd = math.sqrt(n * (n - 1) * (2 * n + 5) / 18)
    reach = math.floor(float(ndtri(0.5 + 0.5 * confidence)) * sd + 0.5)
    low, high = angles.number - reach + shift, angles.number + reach + shift
    # ranks below the slopes of -1 (+1 for a falling line) say nothing of the line
    least = 2 * angles.exactly_on_the_shift(rising=rising) + 1
    if (low + 1) // 2 < least or (high + 1) // 2 > angles.number - (high % 2 == 0):
        return -math.inf, math.inf
    return _at(angles, low, measure), _at(angles, high, measure)


def _intercept_ends(x: FloatArray, y: FloatArray, slopes: tuple[float, float]) -> tuple[float, float]:
    if not all(math.isfinite(slope) and abs(slope) < 1e15 for slope in slopes):
        return -math.inf, math.inf
    return float(np.median(y - slopes[1] * x)), float(np.median(y - slopes[0] * x))


def _at(angles: PairAngles, twice: int, measure: Measure) -> float:
    """The slope at rank (twice + 1) / 2: one ordered angle, or the middle of two."""
    rank = (twice + 1) // 2
    first = angles.ranked(rank)
    if twice % 2:
        return math.tan(first)
    second = angles.ranked(rank + 1)
    if measure == "tangent":
        return (math.tan(first) + math.tan(second)) / 2
    return math.tan((first + second) / 2)
