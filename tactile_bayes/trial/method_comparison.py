"""One modality against excision: lines, concordance and limits of agreement, with intervals over patients."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import cache, lru_cache, partial
from typing import Annotated, Literal, TypeVar

import numpy as np
from scipy.special import chdtri, chndtrix, gammaincc, nctdtrit, ndtri, stdtr

from tactile_bayes.declarations import UNSET, Meta, Record, UnsetType, described, replace
from tactile_bayes.trial import lines
from tactile_bayes.trial.figures import (
    Count,
    Ends,
    Figure,
    Figures,
    Intervals,
    Reasons,
    Sample,
    Scale,
    Statistic,
    SumStatistic,
    UndefinedError,
    columns,
    fields_of,
    figure,
    interval_from_values,
    kurtosis_freedom,
    on_scale,
    ratio,
    squares,
)
from tactile_bayes.trial.readings import FloatArray, ModalitySizes

# --- Exact factors k such that mean + k SD of a normal sample bounds its percentiles with a stated confidence.

_NODES, _MOST_OFFSET = 400, 9.0  # of the quadrature over the sample's mean


def percentile_factor(n: int, *, percentile: float, confidence: float) -> float:
    r"""k with :math:`P(\mu + z_p \sigma \le \bar x + k s) =` `confidence` for a sample of n.

    A quantile of the noncentral t distribution over root n: the one-sided tolerance factor (Odeh & Owen 1980).
    Carkeet (2015), Optom. Vis. Sci. 92, e71, uses it for limits of agreement taken one at a time.
    """
    return float(nctdtrit(n - 1, math.sqrt(n) * float(ndtri(percentile)), confidence)) / math.sqrt(n)


@cache
def content_factor(n: int, *, content: float, confidence: float) -> float:
    r"""k such that mean +- k SD of a sample of n holds at least `content` of the population with this confidence.

    Two-sided tolerance factor of Wald & Wolfowitz (1946), exact as in Odeh & Owen (1980); Carkeet (2015) uses it for
    the two limits of agreement taken as a pair.
    """
    nodes, weights = np.polynomial.legendre.leggauss(_NODES)
    offset = (nodes + 1) / 2 * _MOST_OFFSET  # of the sample's mean, in standard errors
    weight = weights / 2 * _MOST_OFFSET * 2 * np.exp(-(offset**2) / 2) / math.sqrt(2 * math.pi)
    radius2, freedom = chndtrix(content, 1, offset**2 / n), n - 1  # Phi(shift + r) - Phi(shift - r) = content

    def confidence_at(k: float) -> float:
        return float(weight @ gammaincc(freedom / 2, freedom * radius2 / k**2 / 2))

    low, high = 0.0, 1.0
    while confidence_at(high) < confidence and high < 1e12:
        low, high = high, 4 * high
    while high - low > 1e-13 * high:
        middle = (low + high) / 2
        low, high = (middle, high) if confidence_at(middle) < confidence else (low, middle)
    return (low + high) / 2


# --- Limits of agreement: bias and spread of the differences between two methods, with and without replicates.
#
# Differences are the method under test less the reference, y - x. Intervals take the masses as independent; where a
# patient has several masses the jackknife over patients stands beside them.

SHARE = 0.95  #: Share of the differences that lie between the limits.
_REACH = float(ndtri(0.5 + 0.5 * SHARE))  #: SDs of a normal distribution within which they lie.
# Likelihood ratio above which errors count as proportional to size, and masses needed to judge it.
LIKELIER = 3.0
LEAST_MASSES = 8


class Limits(Record):
    """Limits of agreement and their intervals; all in the unit of the differences."""

    n: Count
    bias: float
    bias_interval: Ends | None
    sd: float  #: Standard deviation that the limits are built on: of one difference, for single readings.
    low: float
    high: float
    """`low`, `high`: bias -+ z sd, between which the stated share of differences lies."""
    low_interval: Ends | None = None
    high_interval: Ends | None = None
    """`low_interval`, `high_interval`: Each limit on its own: exact for single readings (Carkeet 2015), by variance
    recovery with replicates."""
    pair_intervals: tuple[Ends, Ends] | None = None
    """Of both limits taken together, exact (Carkeet 2015); None with replicates."""
    approximate_intervals: tuple[Ends, Ends] | None = None
    """Bland & Altman's (1986), for comparison with other programs; None with replicates."""
    components: dict[str, float] | None = None
    """Variances that add up to ``sd`` squared, by name; empty for single readings."""


def limits(differences: FloatArray, *, confidence: float = 0.95) -> Limits:
    r"""Limits of agreement of single readings, between which `SHARE` of the differences lie.

    Differences are y - x; fewer than two leave the limits undefined.

    Bland & Altman (1986), Lancet i, 307: limits :math:`\bar d \mp z s`, their standard error
    :math:`s\sqrt{1/n + z^2/(2(n-1))}` for the approximate intervals. The exact ones are tolerance factors: Carkeet
    (2015), Optom. Vis. Sci. 92, e71.
    """
    plain = _limits_of_means(differences, 0.0, confidence=confidence)
    n, bias, sd, z, tail = plain.n, plain.bias, plain.sd, _REACH, 0.5 + 0.5 * confidence
    k_near = percentile_factor(n, percentile=0.5 + 0.5 * SHARE, confidence=1 - tail)
    k_far = percentile_factor(n, percentile=0.5 + 0.5 * SHARE, confidence=tail)
    pair = [content_factor(n, content=SHARE, confidence=c) for c in (1 - tail, tail)]
    reach = lines.student(n - 1, confidence=confidence) * math.sqrt(1 / n + z * z / (2 * (n - 1)))

    def symmetric(near: float, far: float) -> tuple[Ends, Ends]:
        return (bias - far * sd, bias - near * sd), (bias + near * sd, bias + far * sd)

    low, high = symmetric(k_near, k_far)
    pairs, approximate = symmetric(*pair), symmetric(z - reach, z + reach)
    return replace(plain, low_interval=low, high_interval=high, pair_intervals=pairs, approximate_intervals=approximate)


def limits_unlinked(x: Sequence[FloatArray], y: Sequence[FloatArray], *, confidence: float = 0.95) -> Limits:
    r"""Limits for single readings from unpaired replicates of an unchanging true size.

    Each mass has one or more replicates x by the reference and y by the method under test.

    The variance of the differences of means, plus what averaging took out of it:

    .. math:: s^2 = s_{\bar d}^2 + (1 - 1/m_x) s_{xw}^2 + (1 - 1/m_y) s_{yw}^2

    with the harmonic means m of the numbers of replicates and the within-mass variances of one-way analyses of
    variance: Bland & Altman (1999), Stat. Methods Med. Res. 8, 135, section 5; intervals by variance recovery, Zou
    (2013), Stat. Methods Med. Res. 22, 630.
    """
    means = np.array([b.mean() - a.mean() for a, b in zip(x, y, strict=True)])
    reference, within = _averaged_out(x), _averaged_out(y)
    plain = _limits_of_means(means, reference[0] + within[0], confidence=confidence)
    between = float(means.var(ddof=1))
    parts = {"means": (between, plain.n - 1), "reference_within": reference, "within": within}
    outer, inner = _recovered(list(parts.values()), plain.sd**2, bias_variance=between / plain.n, confidence=confidence)
    return replace(
        plain,
        low_interval=(plain.low - outer, plain.low + inner),
        high_interval=(plain.high - inner, plain.high + outer),
        components={name: variance for name, (variance, _) in parts.items()},
    )


def _limits_of_means(differences: FloatArray, averaged_out: float, *, confidence: float) -> Limits:
    """Limits without their intervals, from differences of means; `averaged_out` is the variance lost by averaging."""
    n = len(differences)
    if n < 2:
        raise UndefinedError(f"limits of agreement need at least 2 masses (found {n})")
    bias, between = float(differences.mean()), float(differences.var(ddof=1))
    sd, t = math.sqrt(between + averaged_out), lines.student(n - 1, confidence=confidence) * math.sqrt(between / n)
    return Limits(n, bias, (bias - t, bias + t), sd, low=bias - _REACH * sd, high=bias + _REACH * sd)


def _averaged_out(groups: Sequence[FloatArray]) -> tuple[float, int]:
    """Variance of one reading that averaging over a mass's replicates removed, and its degrees of freedom."""
    numbers = np.array([len(group) for group in groups])
    freedom = int(numbers.sum()) - len(groups)
    squares = sum(float(np.sum((group - group.mean()) ** 2)) for group in groups if len(group) > 1)
    return (1 - float(np.mean(1 / numbers))) * squares / max(freedom, 1), freedom


class Trend(Record):
    """Slope of the differences on size by least squares, per unit of size, with its t test."""

    slope: float
    interval: Ends | None
    p_value: float | None


def trend(differences: FloatArray, sizes: FloatArray, *, confidence: float = 0.95) -> Trend:
    """Test proportional bias: slope of the differences on size.

    `sizes` are the means of both methods (Bland & Altman 1999) or, when the reference is much the better of the two,
    the reference itself (Krouwer 2008, Stat. Med. 27, 778): against the mean, unequal errors alone make a slope.
    """
    line = lines.least_squares(sizes, differences)
    intervals = line.intervals(confidence=confidence)
    if intervals is None or line.slope_se is None:
        return Trend(line.slope, None, None)
    if line.slope_se == 0:
        return Trend(line.slope, intervals[1], 1.0 if line.slope == 0 else 0.0)
    return Trend(line.slope, intervals[1], 2 * float(stdtr(line.n - 2, -abs(line.slope) / line.slope_se)))


def errors_are_proportional(x: FloatArray, y: FloatArray) -> bool:
    r"""True if normal ln y - ln x is `LIKELIER` than normal y - x; False for fewer than `LEAST_MASSES` masses.

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


def _recovered(parts: Sequence[tuple[float, int]], total: float, *, bias_variance: float, confidence: float) -> Ends:
    """Outer and inner reach of a limit's interval, from chi-squared intervals of each variance (Zou 2013)."""
    tail = 0.5 - 0.5 * confidence
    below = above = 0.0
    for variance, freedom in parts:
        if freedom == 0 or variance == 0:
            continue
        below += (variance * (1 - freedom / float(chdtri(freedom, tail)))) ** 2
        above += (variance * (1 - freedom / float(chdtri(freedom, 1 - tail)))) ** 2
    low, high = math.sqrt(max(0.0, total - math.sqrt(below))), math.sqrt(total + math.sqrt(above))
    of_bias = float(ndtri(1 - tail)) ** 2 * bias_variance
    wide = math.sqrt(of_bias + (_REACH * (high - math.sqrt(total))) ** 2)
    narrow = math.sqrt(of_bias + (_REACH * (math.sqrt(total) - low)) ** 2)
    return wide, narrow


# --- Limits of agreement with intervals over patients, for differences of any distribution and any masses per patient.
#
# The exact and the approximate intervals that other programs print, also in the JSON report, take the masses as
# independent and the differences as normal.

_NO_SPREAD = "one mass has no spread"


def limit_figures(detected: ModalitySizes, *, intervals: Intervals) -> dict[str, Figure]:
    """Lower and upper limit in mm and as the logarithm of the ratio, for single readings of detected masses."""
    figures = {}
    for unit, scale in (("mm", np.asarray), ("log_ratio", np.log)):
        terms = cache(partial(_limit_terms, scale))
        for side, sign in (("low", -1), ("high", 1)):
            figures[f"limit_{side}_{unit}"] = _limit(terms, sign, detected, intervals=intervals)
    return figures


def _limit(
    terms: Callable[[ModalitySizes], FloatArray], sign: int, detected: ModalitySizes, *, intervals: Intervals
) -> Figure:
    """A limit of agreement. Its corrected interval combines those of the mean and of the SD, on the log scale (Zou
    2013), whose degrees of freedom allow for few influential patients."""
    end = SumStatistic(terms, lambda sums: _limit_mean(sums) + sign * _REACH * _limit_sd(sums), _NO_SPREAD)
    plain = figure(end, detected, scale="linear", intervals=intervals)
    if intervals.method != "corrected" or plain.interval is None:
        return plain
    scales: dict[Callable[[FloatArray], FloatArray], Scale] = {_limit_mean: "linear", _limit_sd: "log"}
    parts = []
    try:
        for finish, scale in scales.items():
            sample = Sample(SumStatistic(terms, finish, _NO_SPREAD), (detected,))
            value, left_out = sample.value(), sample.left_out()
            freedom = kurtosis_freedom(on_scale(left_out, scale))
            ends = interval_from_values(value, left_out, scale=scale, confidence=intervals.probability, freedom=freedom)
            parts.append((value, ends))
    except UndefinedError as undefined:
        return replace(plain, interval=None, interval_reason=str(undefined))
    (mean, mean_ends), (sd, sd_ends) = parts
    limit = mean + sign * _REACH * sd
    below, above = (_REACH * (sd - sd_ends[0]), _REACH * (sd_ends[1] - sd))[::sign]
    ends = limit - math.hypot(mean - mean_ends[0], below), limit + math.hypot(mean_ends[1] - mean, above)
    return replace(plain, interval=ends)


def _limit_terms(scale: Callable[[FloatArray], FloatArray], sizes: ModalitySizes) -> FloatArray:
    """(n, 7) 1, d, d', d'd', 1/m, sum of squares within the mass and its degrees of freedom; ' about the mean of all d.

    Differences d, on a scale, are of the mean of a mass's m replicates.
    """
    if len(sizes.size_mm) == 0:
        raise UndefinedError("no mass was detected")
    groups = [scale(group) for group in sizes.replicates_mm]
    pairs = list(zip(groups, scale(sizes.size_mm), strict=True))
    means = np.array([group.mean() if len(group) > 1 else size for group, size in pairs])
    differences = means - scale(sizes.ex_vivo_mm)
    off = lines.centred(differences, differences.mean())
    number = np.array([max(len(group), 1) for group in groups], dtype=np.float64)
    squares = np.array([float(np.sum((group - mean) ** 2)) for group, mean in zip(groups, means, strict=True)])
    return columns(1.0, differences, off, off * off, 1 / number, squares, number - 1)


def _limit_mean(sums: FloatArray) -> FloatArray:
    return ratio(sums[..., 1], sums[..., 0])


def _limit_sd(sums: FloatArray) -> FloatArray:
    """SD of the difference of single readings: between masses, plus what averaging over replicates removed."""
    n, _, first, second, inverse, squares, freedom = sums.T
    between = ratio(second - first**2 / n, n - 1)
    within = np.where(freedom > 0.5, ratio(squares, freedom), 0.0)
    return np.asarray(np.sqrt(np.maximum(between + (1 - inverse / n) * within, 0.0)))


# --- Method comparison of one modality: all figures and their intervals.

# Lines that are not sums are fitted anew without each patient; with more masses that takes too long.
MOST_REFITTED = 300
# Squares of sizes beyond these overflow or vanish.
_SMALLEST, _LARGEST = 1e-100, 1e100

_Result = TypeVar("_Result")
_Fit = Callable[[FloatArray, FloatArray], lines.Line]
Unit = Literal["mm", "log_ratio"]
Against = Literal["on_ex_vivo", "on_mean"]
_Refitted = Ends | None | UnsetType  #: An interval that is left out for more than `MOST_REFITTED` masses.
_LimitMm = Annotated[float, described("Limit of agreement in mm for single readings; the interval is over patients.")]
_LimitLog = Annotated[
    float, described("Limit of agreement in ln(size / ex vivo) for single readings; the interval is over patients.")
]


class MethodComparison(Figures, kw_only=True):
    """Sizes of detected masses against excision: lines, concordance, limits, with intervals over patients."""

    masses: Count
    error_ratio: Annotated[float, Meta(gt=0)]  #: Variance of the ex-vivo error over that of the modality's.
    ols_intercept_mm: float | None
    ols_intercept_mm_interval: Ends | None
    ols_slope: float | None
    ols_slope_interval: Ends | None
    deming_intercept_mm: float | None
    deming_intercept_mm_interval: Ends | None
    deming_slope: float | None
    deming_slope_interval: Ends | None
    weighted_deming_intercept_mm: float | None
    weighted_deming_intercept_mm_interval: _Refitted = UNSET
    passing_bablok_intercept_mm: float | None
    passing_bablok_intercept_mm_interval: _Refitted = UNSET
    weighted_deming_slope: float | None
    weighted_deming_slope_interval: _Refitted = UNSET
    passing_bablok_slope: float | None
    passing_bablok_slope_interval: _Refitted = UNSET
    concordance: float | None
    concordance_interval: Ends | None
    difference_mean_mm: float | None
    difference_mean_mm_interval: Ends | None
    difference_sd_mm: float | None
    difference_sd_mm_interval: Ends | None
    limit_low_mm: _LimitMm | None
    limit_low_mm_interval: Ends | None
    limit_high_mm: _LimitMm | None
    limit_high_mm_interval: Ends | None
    limit_low_log_ratio: _LimitLog | None
    limit_low_log_ratio_interval: Ends | None
    limit_high_log_ratio: _LimitLog | None
    limit_high_log_ratio_interval: Ends | None
    reasons: Reasons
    analytic_intervals: dict[str, Ends | None]  #: As if masses were independent.
    limits: dict[Unit, Limits]
    """Of differences and of logarithms of ratios; of single readings, replicates allowed for."""
    trends: dict[Against, Trend]  #: Slope of the differences on the ex-vivo size, and on the mean of both.
    concordance_parts: lines.Concordance | None
    errors_grow_with_size: bool
    """Errors are likelier proportional to size than constant: limits in mm suit no one size."""


def compare_methods(sizes: ModalitySizes, *, intervals: Intervals, error_ratio: float = 1.0) -> MethodComparison:
    """Compare one modality's detected sizes with excision."""
    detected, level = sizes.only_detected(), intervals.probability
    x, y = detected.ex_vivo_mm, detected.size_mm
    fits: dict[str, _Fit] = {
        "ols": lines.least_squares,
        "deming": partial(lines.deming, error_ratio=error_ratio),
        "weighted_deming": _kept(partial(lines.weighted_deming, error_ratio=error_ratio)),
        "passing_bablok": _kept(partial(lines.passing_bablok, confidence=level)),
    }
    figures: dict[str, Figure] = {}
    slope: Scale = "slope" if intervals.method == "corrected" else "linear"
    for name, statistic, scale in _statistics(error_ratio, fits, slope):
        on = scale if isinstance(statistic, SumStatistic) or len(x) <= MOST_REFITTED else None
        figures[name] = figure(statistic, detected, scale=on, intervals=intervals, leverage=_squared_distance)
    figures |= limit_figures(detected, intervals=intervals)
    measurable = len(x) >= 2 and _can_be_squared(x, y)
    return MethodComparison(
        masses=len(x),
        error_ratio=error_ratio,
        **fields_of(figures),
        analytic_intervals=_analytic_intervals(x, y, fits, confidence=level) if measurable else {},
        limits=_limits(detected, confidence=level) if measurable else {},
        trends=_trends(x, y, confidence=level) if measurable else {},
        concordance_parts=_or_none(lambda: lines.concordance(x, y, confidence=level)) if measurable else None,
        errors_grow_with_size=measurable and errors_are_proportional(x, y),
    )


def _squared_distance(sizes: ModalitySizes) -> FloatArray:
    """(n,) contribution of each ex-vivo size to their variance, the leverage of a mass on a slope."""
    share = sizes.ex_vivo_mm / sizes.ex_vivo_mm.max()
    return np.asarray((share - share.mean()) ** 2)


def _statistics(error_ratio: float, fits: Mapping[str, _Fit], slope: Scale) -> list[tuple[str, Statistic, Scale]]:
    """All figures with their names and the scales of their intervals."""

    def demings(sums: FloatArray) -> FloatArray:
        return lines.deming_slopes(*squares(sums), error_ratio=error_ratio)

    def part(line: str, name: str) -> Statistic:
        def statistic(sizes: ModalitySizes) -> float:
            x, y = sizes.ex_vivo_mm, sizes.size_mm
            _require_squarable(x, y)
            return float(getattr(fits[line](x, y), name))

        return statistic

    return [
        ("ols_intercept_mm", SumStatistic(_terms, _intercept_with(_ols_slope), _NO_LINE), "linear"),
        ("ols_slope", SumStatistic(_terms, _ols_slope, _NO_LINE), slope),
        ("deming_intercept_mm", SumStatistic(_terms, _intercept_with(demings), _NO_LINE), "linear"),
        ("deming_slope", SumStatistic(_terms, demings, _NO_LINE), slope),
        ("weighted_deming_intercept_mm", part("weighted_deming", "intercept"), "linear"),
        ("passing_bablok_intercept_mm", part("passing_bablok", "intercept"), "linear"),
        ("weighted_deming_slope", part("weighted_deming", "slope"), slope),
        ("passing_bablok_slope", part("passing_bablok", "slope"), slope),
        ("concordance", SumStatistic(_terms, _concordance, "concordance needs sizes that vary"), "fisher"),
        ("difference_mean_mm", SumStatistic(_terms, _mean_difference), "linear"),
        ("difference_sd_mm", SumStatistic(_terms, _difference_sd, _NO_SPREAD), "log"),
    ]


_NO_LINE = "the ex-vivo sizes or the sizes do not vary, so no line is determined"


def _terms(sizes: ModalitySizes) -> FloatArray:
    """(n, 8) x, y, 1, x', y', x'x', x'y', y'y' with ' about the means."""
    x, y = sizes.ex_vivo_mm, sizes.size_mm
    if len(x) == 0:
        raise UndefinedError("no mass was detected")
    _require_squarable(x, y)
    dx, dy = lines.centred(x, x.mean()), lines.centred(y, y.mean())
    return columns(x, y, 1.0, dx, dy, dx * dx, dx * dy, dy * dy)


def _ols_slope(sums: FloatArray) -> FloatArray:
    u, _, p = squares(sums)
    return ratio(p, u)


def _intercept_with(slope: Callable[[FloatArray], FloatArray]) -> Callable[[FloatArray], FloatArray]:
    def intercept(sums: FloatArray) -> FloatArray:
        n = sums[..., 2]
        return np.asarray(ratio(sums[..., 1], n) - slope(sums) * ratio(sums[..., 0], n))

    return intercept


def _concordance(sums: FloatArray) -> FloatArray:
    u, q, p = squares(sums)
    bias = _mean_difference(sums)
    return np.where((u == 0) | (q == 0), np.nan, ratio(2 * p, u + q + sums[..., 2] * bias**2))


def _mean_difference(sums: FloatArray) -> FloatArray:
    return ratio(sums[..., 1] - sums[..., 0], sums[..., 2])


def _difference_sd(sums: FloatArray) -> FloatArray:
    u, q, p = squares(sums)
    return np.sqrt(np.maximum(ratio(u + q - 2 * p, sums[..., 2] - 1), 0.0))


def _kept(fit: _Fit) -> _Fit:
    """The fit, which keeps its lines: intercept and slope, and both jackknifes, ask for the same ones."""

    @lru_cache(maxsize=4096)
    def line(x: bytes, y: bytes) -> lines.Line:
        return fit(np.frombuffer(x), np.frombuffer(y))

    return lambda x, y: line(x.tobytes(), y.tobytes())


def _require_squarable(x: FloatArray, y: FloatArray) -> None:
    if len(x) and not _can_be_squared(x, y):
        raise UndefinedError("the sizes are too large or too small for double precision")


def _can_be_squared(x: FloatArray, y: FloatArray) -> bool:
    """True if squares of all sizes are within double precision."""
    both = np.concatenate([x, y])
    return bool(both.min() > _SMALLEST and both.max() < _LARGEST)


def _analytic_intervals(
    x: FloatArray, y: FloatArray, fits: Mapping[str, _Fit], *, confidence: float
) -> dict[str, Ends | None]:
    """Intervals of the lines and of concordance that take the masses as independent, by name; None where undefined.

    Those of the weighted Deming line, which has no formula, leave out one mass at a time.
    """
    intervals: dict[str, Ends | None] = {}
    for name, fit in fits.items():
        line = _or_none(partial(fit, x, y))
        if line is None and name == "passing_bablok":
            continue
        if line is not None and name == "weighted_deming" and 3 < len(x) <= MOST_REFITTED:
            errors = _or_none(partial(lines.jackknife_errors, fit, x, y)) or (None, None)
            line = replace(line, intercept_se=errors[0], slope_se=errors[1])
        both = (None if line is None else line.intervals(confidence=confidence)) or (None, None)
        for part, interval in zip(("intercept_mm", "slope"), both, strict=True):
            intervals[f"{name}_{part}"] = None if interval is None or not np.all(np.isfinite(interval)) else interval
    agreement = _or_none(lambda: lines.concordance(x, y, confidence=confidence))
    intervals["concordance"] = None if agreement is None else agreement.interval
    return intervals


def _limits(detected: ModalitySizes, *, confidence: float) -> dict[Unit, Limits]:
    """Limits of agreement in mm and on the logarithm, allowing for replicates where there are any."""
    scales: dict[Unit, Callable[[FloatArray], FloatArray]] = {"mm": np.asarray, "log_ratio": np.log}
    x, y, groups = detected.ex_vivo_mm, detected.size_mm, detected.replicates_mm
    if all(len(group) == 1 for group in groups):
        return {unit: limits(on(y) - on(x), confidence=confidence) for unit, on in scales.items()}
    return {
        unit: limits_unlinked([on(e) for e in x[:, None]], [on(group) for group in groups], confidence=confidence)
        for unit, on in scales.items()
    }


def _trends(x: FloatArray, y: FloatArray, *, confidence: float) -> dict[Against, Trend]:
    """Trends of the differences with the ex-vivo size and with the mean of both; those undefined are left out."""
    against: dict[Against, FloatArray] = {"on_ex_vivo": x, "on_mean": (x + y) / 2}
    trend_on = partial(trend, y - x, confidence=confidence)
    trends = ((name, _or_none(partial(trend_on, sizes))) for name, sizes in against.items())
    return {name: result for name, result in trends if result is not None}


def _or_none(compute: Callable[[], _Result]) -> _Result | None:
    """The result; None where the data leave it undefined."""
    try:
        return compute()
    except UndefinedError:
        return None
