"""Accuracy of a modality against excision, and of two modalities compared."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import combinations

import numpy as np
from scipy.special import betaincinv

from tactile_bayes.declarations import replace
from tactile_bayes.options import NonNegative
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
    effective_number,
    fields_of,
    figure,
    ratio,
    resampled,
    squares,
)
from tactile_bayes.trial.lines import all_equal
from tactile_bayes.trial.readings import FloatArray, ModalitySizes

# --- Cautions about a modality's intervals.

FEW_MISSES = 3  #: Of so few misses each moves the mean error by more than an uncorrected interval allows for.


def cautions(sizes: ModalitySizes, *, intervals: Intervals) -> tuple[str, ...]:
    """Cautions about this modality's intervals; docs/coverage.md has the measured shares."""
    missed = len(sizes.size_mm) - int(sizes.detected.sum())
    if not 0 < missed <= FEW_MISSES or intervals.method == "corrected":
        return ()
    return (
        f"only {missed} of {len(sizes.size_mm)} masses missed: intervals of MAPE hold less often than they say; "
        "--intervals corrected allows for it",
    )


# --- Figures that count a missed mass as size 0, with intervals that allow for misses not yet observed.
#
# Where one mass in 25 is missed, a trial of 25 has none, one or two misses, and each moves the mean error by some 3
# points. Jackknife and bootstrap see only the misses that occurred: without any, the interval allows for none.


def figure_with_misses(
    statistic: SumStatistic, sizes: ModalitySizes, *, scale: Scale, intervals: Intervals, power: int, missed: Statistic
) -> Figure:
    r"""Weighted mean over masses, detected and missed, with an interval over patients.

    The weights of the mean are this `power` of the ex-vivo size, where 0 weighs all masses alike; `missed` is the mean
    if every mass were missed.

    The mean is :math:`(1 - p) a + p b` with the missed share p of the weights, a over detected masses and b if all were
    missed. The corrected interval recovers the variances of a and p from their own intervals (Zou & Donner 2008, Stat.
    Med. 27, 1693): a's is the jackknife's, p's that of Jeffreys' prior for the effective number of patients. Other
    methods treat a miss as one more size.
    """

    def weight(of: ModalitySizes) -> FloatArray:
        return np.asarray((of.ex_vivo_mm / of.ex_vivo_mm.max()) ** power)

    pooled = figure(statistic, sizes, scale=scale, intervals=intervals, leverage=weight)
    if intervals.method != "corrected" or pooled.value is None:
        return pooled
    of_detected = figure(statistic, sizes.only_detected(), scale=scale, intervals=intervals, leverage=weight)
    if of_detected.value is None or of_detected.interval is None:
        return pooled
    weights = weight(sizes)
    share = float(weights[~sizes.detected].sum() / weights.sum())
    low, high = share_interval(share, effective_number(weights, sizes.patient), confidence=intervals.probability)
    step = missed(sizes) - of_detected.value
    by_share = sorted((step * (low - share), step * (high - share)))
    by_detected = ((1 - share) * (end - of_detected.value) for end in of_detected.interval)
    below, above = (math.hypot(a, b) for a, b in zip(by_detected, by_share, strict=True))
    return replace(pooled, interval=(pooled.value - below, pooled.value + above), interval_reason="")


def share_interval(share: float, number: float, *, confidence: float) -> Ends:
    """Equal-tailed interval of a proportion with Jeffreys' prior; it contains the observed share (Brown et al. 2001).

    `number` of trials need not be a whole number.
    """
    tail, a, b = 0.5 * (1 - confidence), share * number + 0.5, (1 - share) * number + 0.5
    return min(share, float(betaincinv(a, b, tail))), max(share, float(betaincinv(a, b, 1 - tail)))


# --- Accuracy against excision: percent and mm errors, and bias.


def accuracy_figures(sizes: ModalitySizes, *, intervals: Intervals) -> dict[str, Figure]:
    """Accuracy of one modality, by the fields of its report; the bias is of detected masses: 0 has no logarithm."""
    detected = sizes.only_detected()
    bias = figure(geometric_ratio, detected, scale="log", intervals=intervals)
    on_log = partial(figure_with_misses, scale="log", intervals=intervals)
    return {
        "mape_percent": mape_figure(sizes, intervals=intervals),
        "mape_detected_percent": figure(mape_percent, detected, scale="log", intervals=intervals),
        "mae_mm": on_log(mae_mm, sizes, power=0, missed=lambda of: float(of.ex_vivo_mm.mean())),
        "mae_detected_mm": figure(mae_mm, detected, scale="log", intervals=intervals),
        "weighted_mape_percent": on_log(weighted_mape_percent, sizes, power=1, missed=lambda _: 100.0),
        "median_error_percent": figure(median_percent, sizes),
        "bias_percent": bias.mapped(lambda ratio: 100 * (ratio - 1)),
    }


def mape_figure(sizes: ModalitySizes, *, intervals: Intervals) -> Figure:
    """Percent error with its interval; a mass not detected counts as 100 %."""
    return figure_with_misses(mape_percent, sizes, scale="log", intervals=intervals, power=0, missed=lambda _: 100.0)


def _mm_errors(sizes: ModalitySizes) -> FloatArray:
    """(n, 3) absolute error in mm, 1, and ex-vivo size of each mass."""
    return columns(np.abs(sizes.size_mm - require_any(sizes.ex_vivo_mm)), 1.0, sizes.ex_vivo_mm)


def _mean(sums: FloatArray) -> FloatArray:
    return ratio(sums[..., 0], sums[..., 1])


# Mean absolute error in percent of the ex-vivo size, each mass alike; one not detected has size 0, an error of 100 %:
# 100/n sum |y - e| / e. Wellman & Howe (1999), section 3, call it "percent mean absolute error (MAE)".
mape_percent = SumStatistic(
    lambda sizes: columns(np.abs(sizes.size_mm / require_any(sizes.ex_vivo_mm) - 1), 1.0),
    lambda sums: 100 * _mean(sums),
    "no mass to average over",
)

# The same weighted by ex-vivo size: the sum of absolute errors over the sum of the sizes, in percent.
weighted_mape_percent = SumStatistic(
    _mm_errors, lambda sums: 100 * ratio(sums[..., 0], sums[..., 2]), "no mass to average over"
)

# Mean absolute error in mm.
mae_mm = SumStatistic(_mm_errors, _mean, "no mass to average over")

# Geometric mean of size over ex-vivo size; 1 without bias, and twofold up cancels twofold down.
geometric_ratio = SumStatistic(
    lambda sizes: columns(np.log(sizes.size_mm) - np.log(require_any(sizes.ex_vivo_mm)), 1.0),
    lambda sums: np.exp(_mean(sums)),
    "no mass to average over",
)


def median_percent(sizes: ModalitySizes) -> float:
    """Median absolute error in percent of the ex-vivo size."""
    return 100 * float(np.median(np.abs(sizes.size_mm / require_any(sizes.ex_vivo_mm) - 1)))


def require_any(values: FloatArray) -> FloatArray:
    """The values; `UndefinedError` when there are none."""
    if len(values) == 0:
        raise UndefinedError("no mass to average over")
    return values


# --- The paper's line through zero, with three figures that are all called r squared.
#
# The paper names no convention for r squared; its printed 0.14 can only be the centred or Pearson's (by Fig. 10), so
# the centred one leads. The regression is of sizes y on ex-vivo sizes e.


def origin_line_figures(sizes: ModalitySizes, *, intervals: Intervals) -> dict[str, Figure]:
    """Slope and r squared with missed masses at size 0 (the paper's convention), then over detected masses only."""
    result: dict[str, Figure] = {}
    for suffix, subset in (("", sizes), ("_detected", sizes.only_detected())):
        result[f"slope_through_origin{suffix}"] = figure_with_misses(
            slope, subset, scale="linear", intervals=intervals, power=2, missed=lambda _: 0.0
        )
        result |= {f"{name}{suffix}": figure(statistic, subset) for name, statistic in CORRELATIONS.items()}
    return result


def _terms(sizes: ModalitySizes) -> FloatArray:
    """(n, 9) products of sizes, then of sizes about their means: e e, e y, y y, 1, e', y', e'e', e'y', y'y'."""
    unit = require_any(sizes.ex_vivo_mm).max()  # so that squares neither overflow nor vanish
    e, y = sizes.ex_vivo_mm / unit, sizes.size_mm / unit
    de, dy = e - e.mean(), y - y.mean()
    return columns(e * e, e * y, y * y, 1.0, de, dy, de * de, de * dy, dy * dy)


def _terms_of_varied(sizes: ModalitySizes, *, ex_vivo: bool) -> FloatArray:
    """`_terms`; `UndefinedError` where the sizes, or with `ex_vivo` the ex-vivo sizes, do not vary."""
    if len(sizes.size_mm) == 1:
        raise UndefinedError("one mass has no spread")
    for name, values in (("sizes", sizes.size_mm), ("ex-vivo sizes", sizes.ex_vivo_mm))[: 1 + ex_vivo]:
        if all_equal(require_any(values)):
            raise UndefinedError(f"all {len(values)} {name} are equal")
    return _terms(sizes)


_terms_with_size_spread, _terms_with_both_spreads = (partial(_terms_of_varied, ex_vivo=one) for one in (False, True))


def _slope(sums: FloatArray) -> FloatArray:
    return ratio(sums[..., 1], sums[..., 0])


def _sse(sums: FloatArray) -> FloatArray:
    """Sum of squared residuals of the line through zero."""
    return np.maximum(sums[..., 2] - _slope(sums) * sums[..., 1], 0.0)


def _pearson(sums: FloatArray) -> FloatArray:
    u, q, p = squares(sums)
    return np.clip(ratio(p, np.sqrt(u * q)), -1.0, 1.0)


# Least-squares slope of sizes on ex-vivo sizes without an intercept: sum e y / sum e^2.
slope = SumStatistic(_terms, _slope)

CORRELATIONS = {
    # share of the variance about the mean that the line through zero explains, 1 - SSE0 / SST; below 0 when the mean of
    # the sizes would do better. Kvalseth (1985), Am. Stat. 39, 279, recommends it
    "r2_centred": SumStatistic(_terms_with_size_spread, lambda sums: 1 - ratio(_sse(sums), squares(sums)[1])),
    # share of the sum of squares about zero that the line explains, 1 - SSE0 / sum y^2: what R prints for
    # lm(y ~ 0 + x). It flatters: any line through a cloud far from zero explains most of it
    "r2_uncentred": SumStatistic(_terms, lambda sums: 1 - ratio(_sse(sums), sums[..., 2]), "no mass was detected"),
    # squared correlation coefficient; blind to scale and offset
    "r2_pearson": SumStatistic(_terms_with_both_spreads, lambda sums: _pearson(sums) ** 2),
    # correlation coefficient; its sign says what the squares hide
    "pearson_r": SumStatistic(_terms_with_both_spreads, _pearson),
}


# --- Ratio of one modality's error to another's.

REFERENCE = "tactile"


class ModalityRatio(Figures):
    """Percent error of one modality over the tactile one's on common masses."""

    masses: Count  #: Masses that both modalities looked for.
    masses_detected: Count  #: Masses that both detected.
    ratio: NonNegative | None  #: On the masses that both looked for; masses not detected counted as size 0.
    ratio_interval: Ends | None
    ratio_detected: NonNegative | None  #: On the masses that both detected.
    ratio_detected_interval: Ends | None
    reasons: Reasons


def mape_ratios(sizes: Mapping[str, ModalitySizes], *, intervals: Intervals) -> dict[str, ModalityRatio]:
    """Ratio of every other modality to the tactile one; empty without a tactile one."""
    ratios = {}
    for name in [other for other in sizes if other != REFERENCE] if REFERENCE in sizes else []:
        pair = sizes[name], sizes[REFERENCE]
        looked_for, both_detected = on_common_masses(*pair), on_common_masses(*(one.only_detected() for one in pair))
        figures = {
            "ratio": mape_ratio(*looked_for, intervals=intervals),
            "ratio_detected": mape_ratio(*both_detected, intervals=intervals),
        }
        n, n_detected = len(looked_for[0].size_mm), len(both_detected[0].size_mm)
        ratios[name] = ModalityRatio(masses=n, masses_detected=n_detected, **fields_of(figures))
    return ratios


def on_common_masses(first: ModalitySizes, second: ModalitySizes) -> tuple[ModalitySizes, ModalitySizes]:
    """Both modalities, limited to their common masses, in the same order."""
    _, in_first, in_second = np.intersect1d(first.mass, second.mass, return_indices=True)
    return first.take(in_first), second.take(in_second)


def mape_ratio(sizes: ModalitySizes, reference: ModalitySizes, *, intervals: Intervals) -> Figure:
    """Quotient of two percent errors.

    The interval leaves each patient out of both at once, so that patients hard for both do not widen it.
    """
    return resampled(_error_sample(sizes, reference, ratio), scale="log", intervals=intervals)


def _error_sample(sizes: ModalitySizes, reference: ModalitySizes, combine: Callable[..., FloatArray]) -> Sample:
    """Percent errors of two modalities, combined by their difference or ratio."""
    return Sample(mape_percent, (sizes, reference), combine, f"the error of {reference.name} is 0")


# --- Paired comparison of two modalities: difference and ratio of errors, and a permutation test.

# Up to so many patients every pattern of signs is tried; beyond, this many random ones.
MOST_EXACT = 14
FLIPS = 9_999
_FLIPS_AT_ONCE = 111


class PairedComparison(Figures):
    """Percent errors of `first` against `second` on their common masses; a mass not detected has size 0."""

    first: str
    second: str
    masses: Count
    patients: Count
    first_percent: float | None
    second_percent: float | None
    p_value: float | None  #: Two-sided, of the sign-flip test by patient; null where no patient differs.
    p_holm: float | None  #: The same, corrected for all pairs of this trial.
    difference_percent: float | None  #: Mean error of the first less that of the second.
    difference_percent_interval: Ends | None
    ratio: float | None  #: Mean error of the first over that of the second.
    ratio_interval: Ends | None
    reasons: Reasons


def paired_comparisons(sizes: Mapping[str, ModalitySizes], *, intervals: Intervals) -> list[PairedComparison]:
    """Compare every pair of modalities on their common masses, with Holm's correction of p values."""
    pairs = [_paired_comparison(sizes[first], sizes[second], intervals) for first, second in combinations(sizes, 2)]
    corrected = holm([pair.p_value for pair in pairs])
    return [replace(pair, p_holm=p) for pair, p in zip(pairs, corrected, strict=True)]


def least_p(patients: int) -> float:
    """Smallest two-sided p value that a sign-flip test of so many patients can give: 2 of 2^n patterns."""
    return min(1.0, 2.0 ** (1 - patients))


def holm(p_values: Sequence[float | None]) -> list[float | None]:
    """Correct p values for their number, leaving None out: Holm (1979), Scand. J. Statist. 6, 65."""
    known = sorted((p, index) for index, p in enumerate(p_values) if p is not None)
    corrected: list[float | None] = [None] * len(p_values)
    largest = 0.0
    for rank, (p, index) in enumerate(known):
        largest = max(largest, min(1.0, (len(known) - rank) * p))
        corrected[index] = largest
    return corrected


def sign_flip(by_patient: FloatArray, *, seed: int, flips: int = FLIPS) -> float | None:
    """Two-sided p value of a sum of patients' differences, by a permutation test that flips their signs.

    `by_patient` is the (g,) sum over each patient's masses of the difference of absolute errors.

    Exact when all patterns are tried; with random ones the observed pattern is counted in (Phipson & Smyth 2010, Stat.
    Appl. Genet. Mol. Biol. 9, 39). Valid when, under the null hypothesis, exchanging the two modalities of a patient
    changes no probability.
    """
    differences = by_patient[by_patient != 0]
    if len(differences) == 0:
        return None
    # sums in another order differ by rounding, and count as equal
    observed = abs(float(differences.sum())) * (1 - 1e-9)
    if len(differences) <= MOST_EXACT:
        patterns = (np.arange(2 ** len(differences))[:, None] >> np.arange(len(differences))) & 1
        return float(np.mean(np.abs((1 - 2 * patterns) @ differences) >= observed))
    rng = np.random.default_rng([seed, len(differences)])
    beyond = 1
    for start in range(0, flips, _FLIPS_AT_ONCE):
        signs = 1 - 2 * rng.integers(0, 2, (min(_FLIPS_AT_ONCE, flips - start), len(differences)), dtype=np.int8)
        beyond += int(np.sum(np.abs(signs @ differences) >= observed))
    return beyond / (flips + 1)


def _paired_comparison(first: ModalitySizes, second: ModalitySizes, intervals: Intervals) -> PairedComparison:
    """Difference and ratio of the errors of two modalities on their common masses, and the test."""
    first, second = on_common_masses(first, second)
    difference = resampled(_error_sample(first, second, np.subtract), scale="linear", intervals=intervals)
    quotient = resampled(_error_sample(first, second, ratio), scale="log", intervals=intervals)
    patients = first.patients
    with np.errstate(all="ignore"):
        off = np.abs(first.size_mm / first.ex_vivo_mm - 1) - np.abs(second.size_mm / second.ex_vivo_mm - 1)
    sums = np.zeros(len(patients))
    np.add.at(sums, np.searchsorted(patients, first.patient), off)
    return PairedComparison(
        first=first.name,
        second=second.name,
        masses=len(first.size_mm),
        patients=len(patients),
        first_percent=figure(mape_percent, first).value,
        second_percent=figure(mape_percent, second).value,
        p_value=sign_flip(sums, seed=intervals.seed) if len(patients) and np.all(np.isfinite(sums)) else None,
        p_holm=None,
        **fields_of({"difference_percent": difference, "ratio": quotient}),
    )
