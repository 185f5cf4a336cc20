"""Limits of agreement: bias and spread of the differences between two methods, with and without replicates.

Differences are the method under test less the reference, y - x. Intervals take the masses as independent; where a
patient has several masses the jackknife over patients stands beside them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tactile_bayes.trial.jackknife import UndefinedError
from tactile_bayes.trial.lines import student
from tactile_bayes.trial.readings import FloatArray
from tactile_bayes.trial.tolerance import content_factor, percentile_factor

Ends = tuple[float, float]
# Share of the differences that lie between the limits.
SHARE = 0.95
# Times that errors proportional to size must be likelier than constant ones, and masses needed to judge it.
LIKELIER = 3.0
LEAST_MASSES = 8


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits of agreement and their intervals; all in the unit of the differences.

    Attributes
    ----------
    sd
        Standard deviation that the limits are built on: of one difference, for single readings.
    low, high
        bias -+ z sd, between which the stated share of differences lies.
    low_interval, high_interval
        Each limit on its own: exact for single readings (Carkeet 2015), by variance recovery with replicates.
    pair_intervals
        Of both limits taken together, exact (Carkeet 2015); None with replicates.
    approximate_intervals
        Bland & Altman's (1986), for comparison with other programs; None with replicates.
    components
        Variances that add up to ``sd`` squared, by name; empty for single readings.
    """

    n: int
    bias: float
    bias_interval: Ends | None
    sd: float
    low: float
    high: float
    low_interval: Ends | None = None
    high_interval: Ends | None = None
    pair_intervals: tuple[Ends, Ends] | None = None
    approximate_intervals: tuple[Ends, Ends] | None = None
    components: dict[str, float] | None = None


def limits(differences: FloatArray, *, confidence: float = 0.95) -> Limits:
    r"""Limits of agreement of single readings, between which `SHARE` of the differences lie.

    Parameters
    ----------
    differences : (n,) array
        y - x of each mass.

    Notes
    -----
    Bland & Altman (1986), Lancet i, 307: limits :math:`\bar d \mp z s`, their standard error
    :math:`s\sqrt{1/n + z^2/(2(n-1))}` for the approximate intervals. The exact ones are tolerance factors: Carkeet
    (2015), Optom. Vis. Sci. 92, e71.

    Raises
    ------
    UndefinedError
        With fewer than two differences.
    """
    n = len(differences)
    if n < 2:
        raise UndefinedError(f"limits of agreement need at least 2 masses (found {n})")
    bias, sd = float(differences.mean()), float(differences.std(ddof=1))
    z, tail = _normal(0.5 + 0.5 * SHARE), 0.5 + 0.5 * confidence
    t = student(n - 1, confidence=confidence)
    inner = percentile_factor(n, percentile=0.5 + 0.5 * SHARE, confidence=1 - tail)
    outer = percentile_factor(n, percentile=0.5 + 0.5 * SHARE, confidence=tail)
    pair = [content_factor(n, content=SHARE, confidence=c) for c in (1 - tail, tail)]
    reach = t * math.sqrt(1 / n + z * z / (2 * (n - 1)))
    return Limits(
        n=n,
        bias=bias,
        bias_interval=(bias - t * sd / math.sqrt(n), bias + t * sd / math.sqrt(n)),
        sd=sd,
        low=bias - z * sd,
        high=bias + z * sd,
        low_interval=(bias - outer * sd, bias - inner * sd),
        high_interval=(bias + inner * sd, bias + outer * sd),
        pair_intervals=((bias - pair[1] * sd, bias - pair[0] * sd), (bias + pair[0] * sd, bias + pair[1] * sd)),
        approximate_intervals=(
            (bias - (z + reach) * sd, bias - (z - reach) * sd),
            (bias + (z - reach) * sd, bias + (z + reach) * sd),
        ),
    )


def limits_unlinked(x: Sequence[FloatArray], y: Sequence[FloatArray], *, confidence: float = 0.95) -> Limits:
    r"""Limits for single readings from unpaired replicates of an unchanging true size.

    Parameters
    ----------
    x, y
        Replicates of each mass by the reference and by the method under test, one or more each.

    Notes
    -----
    The variance of the differences of means, plus what averaging took out of it:

    .. math:: s^2 = s_{\bar d}^2 + (1 - 1/m_x) s_{xw}^2 + (1 - 1/m_y) s_{yw}^2

    with the harmonic means m of the numbers of replicates and the within-mass variances of one-way analyses of
    variance: Bland & Altman (1999), Stat. Methods Med. Res. 8, 135, section 5; intervals by variance recovery, Zou
    (2013), Stat. Methods Med. Res. 22, 630.
    """
    means = np.array([b.mean() - a.mean() for a, b in zip(x, y, strict=True)])
    parts = [_within(x), _within(y)]
    return _from_means(means, parts, names=("reference_within", "within"), confidence=confidence)


@dataclass(frozen=True, slots=True)
class Trend:
    """How differences change with size: slope of a least-squares line, per unit of size, with its t test."""

    slope: float
    interval: Ends | None
    p_value: float | None


def trend(differences: FloatArray, sizes: FloatArray, *, confidence: float = 0.95) -> Trend:
    """Test proportional bias: slope of the differences on size.

    `sizes` are the means of both methods (Bland & Altman 1999) or, when the reference is much the better of the two,
    the reference itself (Krouwer 2008, Stat. Med. 27, 778): against the mean, unequal errors alone make a slope.
    """
    from scipy.special import stdtr

    from tactile_bayes.trial.lines import least_squares

    line = least_squares(sizes, differences)
    both = line.intervals(confidence=confidence)
    if both is None or line.slope_se is None:
        return Trend(line.slope, None, None)
    if line.slope_se == 0:
        return Trend(line.slope, both[1], 1.0 if line.slope == 0 else 0.0)
    return Trend(line.slope, both[1], 2 * float(stdtr(line.n - 2, -abs(line.slope) / line.slope_se)))


def errors_are_proportional(x: FloatArray, y: FloatArray) -> bool:
    r"""Whether normal ln y - ln x with one SD is likelier than normal y - x, by a factor of `LIKELIER`.

    Parameters
    ----------
    x, y : (n,) arrays, above 0
        Ex-vivo sizes and sizes; False for fewer than `LEAST_MASSES`.

    Notes
    -----
    Likelihoods of y, profiled over mean and SD as in Box & Cox (1964), J. R. Stat. Soc. B 26, 211: the logarithm's
    carries the Jacobian :math:`\prod 1/y`.
    """
    n = len(x)
    if n < LEAST_MASSES:
        return False
    with np.errstate(all="ignore"):
        logs, off = np.var(np.log(y) - np.log(x)), np.var(y - x)
        gain = 0.5 * n * (np.log(off) - np.log(logs)) - float(np.sum(np.log(y)))
    return bool(np.isfinite(gain) and gain > np.log(LIKELIER))


@dataclass(frozen=True, slots=True)
class _Within:
    """Pooled within-mass variance, its degrees of freedom and the harmonic mean number of replicates."""

    variance: float
    freedom: int
    harmonic: float

    @property
    def restored(self) -> float:
        """Variance of one reading that averaging over replicates removed."""
        return (1 - 1 / self.harmonic) * self.variance


def _within(groups: Sequence[FloatArray]) -> _Within:
    numbers = np.array([len(group) for group in groups])
    freedom = int(numbers.sum()) - len(groups)
    squares = sum(float(np.sum((group - group.mean()) ** 2)) for group in groups if len(group) > 1)
    return _Within(squares / freedom if freedom else 0.0, freedom, len(groups) / float(np.sum(1 / numbers)))


def _from_means(means: FloatArray, within: Sequence[_Within], *, names: Sequence[str], confidence: float) -> Limits:
    n = len(means)
    if n < 2:
        raise UndefinedError(f"limits of agreement need at least 2 masses (found {n})")
    between = float(means.var(ddof=1))
    total = between + sum(one.restored for one in within)
    bias, z = float(means.mean()), _normal(0.5 + 0.5 * SHARE)
    low, high = bias - z * math.sqrt(total), bias + z * math.sqrt(total)
    parts = [(between, n - 1), *((one.restored, one.freedom) for one in within)]
    wide, narrow = _recovered(parts, total, z=z, bias_variance=between / n, confidence=confidence)
    t = student(n - 1, confidence=confidence) * math.sqrt(between / n)
    return Limits(
        n=n,
        bias=bias,
        bias_interval=(bias - t, bias + t),
        sd=math.sqrt(total),
        low=low,
        high=high,
        low_interval=(low - wide, low + narrow),
        high_interval=(high - narrow, high + wide),
        components={"means": between} | {name: one.restored for name, one in zip(names, within, strict=True)},
    )


def _recovered(
    parts: Sequence[tuple[float, int]], total: float, *, z: float, bias_variance: float, confidence: float
) -> Ends:
    """Outer and inner reach of a limit's interval, from chi-squared intervals of each variance (Zou 2013)."""
    from scipy.special import chdtri

    tail = 0.5 - 0.5 * confidence
    below = above = 0.0
    for variance, freedom in parts:
        if freedom == 0 or variance == 0:
            continue
        below += (variance * (1 - freedom / float(chdtri(freedom, tail)))) ** 2
        above += (variance * (1 - freedom / float(chdtri(freedom, 1 - tail)))) ** 2
    low, high = math.sqrt(max(0.0, total - math.sqrt(below))), math.sqrt(total + math.sqrt(above))
    of_bias = _normal(1 - tail) ** 2 * bias_variance
    wide = math.sqrt(of_bias + (z * (high - math.sqrt(total))) ** 2)
    narrow = math.sqrt(of_bias + (z * (math.sqrt(total) - low)) ** 2)
    return wide, narrow


def _normal(probability: float) -> float:
    from scipy.special import ndtri

    return float(ndtri(probability))
