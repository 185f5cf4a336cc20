"""Figures of a trial with intervals over patients: jackknife, bootstrap, exact intervals of proportions."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from typing import Annotated, Any, Literal

import numpy as np
import numpy.typing as npt
from scipy.special import betaincinv, ndtr, ndtri, stdtrit

from tactile_bayes.declarations import UNSET, Meta, Record, described, replace
from tactile_bayes.options import IntervalMethod
from tactile_bayes.trial.readings import FloatArray, ModalitySizes

# --- Jackknife intervals over patients, keeping a patient's masses together.

Scale = Literal["log", "linear", "fisher", "slope"]

# The spread of fewer leave-one-out values says little, which Student's t with 6 degrees of freedom would hide.
MIN_PATIENTS = 8
# An interval on the logarithm whose upper end is more than this many times the lower one says nothing.
WIDEST = 1000.0


class UndefinedError(Exception):
    """The data leave a figure or its interval undefined; the message is the reason."""


def need_patients(groups: int) -> None:
    """Raise `UndefinedError` with fewer than `MIN_PATIENTS`."""
    if groups < MIN_PATIENTS:
        raise UndefinedError(f"an interval needs at least {MIN_PATIENTS} patients (found {groups})")


def interval_from_values(
    value: float, values: FloatArray, *, scale: Scale, confidence: float, freedom: float | None = None
) -> tuple[float, float]:
    r"""Two-sided jackknife interval of a statistic from its values with one patient left out.

    `values` are the statistic without each of G patients, `freedom` the degrees of freedom of Student's t where they
    are fewer than G - 1. ``log`` works on the logarithm (of figures above 0: the interval stays above 0), ``linear`` on
    the figure, ``fisher`` on the inverse hyperbolic tangent (of coefficients between -1 and 1), ``slope`` as ``log``
    where all values are above 0, else as ``linear``. Undefined with fewer than `MIN_PATIENTS` patients, or where the
    values do not exist or do not differ.

    .. math:: \hat\theta \pm t_{G-1}\sqrt{\tfrac{G-1}{G}\sum_g (\hat\theta_{(g)} - \bar\theta_{(\cdot)})^2}

    for G patients: Tukey (1958), Ann. Math. Statist. 29, 614; Efron & Tibshirani (1993), ch. 11.
    """
    groups = len(values)
    need_patients(groups)
    if scale == "slope":
        scale = "log" if value > 0 and np.all(values > 0) else "linear"
    centre, left_out = float(on_scale(value, scale)), on_scale(values, scale)
    variance = (groups - 1) / groups * float(np.sum((left_out - left_out.mean()) ** 2))
    if variance <= (1e-12 * max(1.0, abs(centre))) ** 2:
        raise UndefinedError("the figure is the same whichever patient is left out, so its error cannot be estimated")
    degrees = groups - 1 if freedom is None else min(max(freedom, 1.0), groups - 1)
    reach = float(stdtrit(degrees, 0.5 + 0.5 * confidence)) * math.sqrt(variance)
    low, high = centre - reach, centre + reach
    if scale == "linear":
        return low, high
    if scale == "fisher":
        return math.tanh(low), math.tanh(high)
    if high - low > math.log(WIDEST):
        raise UndefinedError(f"it would span more than a factor of {WIDEST:g}: the figure rests on one or two patients")
    return math.exp(low), math.exp(high)


def effective_number(weights: npt.NDArray[np.float64], patient: npt.NDArray[np.int64]) -> float:
    r"""Effective number of patients, :math:`(\sum_g W_g)^2 / \sum_g W_g^2` (Satterthwaite 1946).

    Masses have (n,) weights, not below 0; where all are 0 so is the number.
    """
    _, group = np.unique(patient, return_inverse=True)
    by_patient = np.bincount(group, weights=weights / max(float(weights.max(initial=0.0)), 1e-300))
    squares = float(np.sum(by_patient**2))
    return float(by_patient.sum()) ** 2 / squares if squares > 0 else 0.0


def kurtosis_freedom(values: npt.NDArray[np.float64]) -> float:
    r"""Degrees of freedom of a jackknife variance from the fourth moment of its leave-one-out values.

    With normal contributions of unequal variance the expected squares and fourth powers give Satterthwaite's
    :math:`(\sum\sigma_g^2)^2 / \sum\sigma_g^4 = 3 (\sum d_g^2)^2 / \sum d_g^4`.
    """
    off = np.abs(values - values.mean())
    if not off.any():
        return 1.0
    squares = (off / off.max()) ** 2
    return 3 * float(squares.sum()) ** 2 / float(np.sum(squares**2))


def on_scale(values: float | FloatArray, scale: Scale) -> FloatArray:
    """Values on a scale: unchanged, logarithms, or Fisher's z; `UndefinedError` where one has none."""
    numbers = np.asarray(values, dtype=np.float64)
    if scale == "linear":
        return numbers
    if scale == "fisher":
        if np.any(np.abs(numbers) >= 1):
            raise UndefinedError("the coefficient is 1 or -1, or becomes so without one patient")
        return np.arctanh(numbers)
    if np.any(numbers <= 0):
        raise UndefinedError("the figure is 0, or becomes 0 without one patient, and has no logarithm")
    return np.log(numbers)


# --- Statistics that depend on masses only through sums, so that resampling patients is cheap.


class SumStatistic(Record):
    """A figure computed from the sums of a few terms over the masses."""

    terms: Callable[[ModalitySizes], FloatArray]
    """(n, k) array of what each mass adds; raises `UndefinedError` where the masses leave the figure undefined."""
    finish: Callable[[FloatArray], FloatArray]
    """The figure from (..., k) sums, over any leading axes; NaN where it does not exist."""
    undefined: str = "the masses do not determine it"  #: The reason when `finish` gives NaN.

    def __call__(self, sizes: ModalitySizes) -> float:
        """Compute the statistic of these masses."""
        value = float(self.finish(self.terms(sizes).sum(axis=0)))
        if np.isnan(value):
            raise UndefinedError(self.undefined)
        return value

    def by_patient(self, sizes: ModalitySizes, patients: npt.NDArray[np.int64]) -> FloatArray:
        """(g, k) sums of the terms within each patient; 0 for one without a mass."""
        terms = self.terms(sizes)
        sums = np.zeros((len(patients), terms.shape[1]))
        np.add.at(sums, np.searchsorted(patients, sizes.patient), terms)
        return sums


def columns(*values: FloatArray | float) -> FloatArray:
    """(n, k) array of k columns, each of length n or one number for all rows."""
    table = np.empty((*np.broadcast(*values).shape, len(values)))
    for i, value in enumerate(values):
        table[..., i] = value
    return table


def ratio(above: FloatArray, below: FloatArray) -> FloatArray:
    """`above` over `below`, NaN where `below` is 0."""
    with np.errstate(all="ignore"):
        quotient: FloatArray = np.where(below == 0, np.nan, above / np.where(below == 0, 1.0, below))
    return quotient


def squares(sums: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Sums of squares of x, of y and of products about their means, from (..., k) sums of terms.

    The last six terms are 1, x', y', x'x', x'y', y'y', where ' is about the means of all masses.
    """
    n, a, b, aa, ab, bb = np.moveaxis(sums[..., -6:], -1, 0)
    return aa - a * a / n, bb - b * b / n, ab - a * b / n


# --- Exact intervals of a proportion k of n.


def clopper_pearson(k: float, n: float, *, confidence: float) -> tuple[float, float]:
    r"""Exact two-sided interval of a binomial proportion.

    Fractions of successes and trials are allowed, for effective numbers of trials.

    The ends are quantiles of Beta(k, n-k+1) and Beta(k+1, n-k). Clopper & Pearson (1934), Biometrika 26, 404.
    """
    if not 0 <= k <= n or n <= 0:
        raise ValueError(f"need 0 <= k <= n and n > 0 (found k = {k}, n = {n})")
    tail = 0.5 * (1 - confidence)
    low = 0.0 if k <= 0 else float(betaincinv(k, n - k + 1, tail))
    high = 1.0 if k >= n else float(betaincinv(k + 1, n - k, 1 - tail))
    return low, high


# --- Bootstrap intervals over patients (BCa), keeping a patient's masses together.

_LEAST_DEFINED = 0.99  #: Share of the redrawn trials in which the figure must exist.


class Intervals(Record):
    """Settings of the intervals of figures.

    Method ``corrected`` is the jackknife with the corrections of record 0077; ``bca`` draws the patients `resamples`
    times. The seed is also that of the sign flips.
    """

    probability: float = 0.95
    method: IntervalMethod = "jackknife"
    resamples: int = 2000
    seed: int = 1999


JACKKNIFE = Intervals()


@lru_cache(maxsize=8)
def draw_patients(patients: int, *, resamples: int, seed: int) -> FloatArray:
    """(resamples, patients) numbers of times that each patient is drawn with replacement, for every figure alike."""
    rng = np.random.default_rng([seed, patients])
    draws = rng.multinomial(patients, np.full(patients, 1 / patients), size=resamples).astype(np.float64)
    draws.flags.writeable = False
    return draws


def bca_interval(value: float, drawn: FloatArray, left_out: FloatArray, *, confidence: float) -> tuple[float, float]:
    r"""BCa interval: quantiles corrected for bias and acceleration.

    Efron (1987), J. Am. Stat. Assoc. 82, 171: bias from the share of draws below the figure (ties by half),
    acceleration from the skewness of the values with one patient left out.
    """
    undefined = int(np.sum(~np.isfinite(drawn)))
    if undefined > (1 - _LEAST_DEFINED) * len(drawn):
        raise UndefinedError(f"of {len(drawn)} redrawn trials {undefined} leave the figure undefined")
    drawn = drawn[np.isfinite(drawn)]
    share = (np.sum(drawn < value) + 0.5 * np.sum(drawn == value)) / len(drawn)
    bias = float(ndtri(np.clip(share, 0.5 / len(drawn), 1 - 0.5 / len(drawn))))
    off = left_out.mean() - left_out
    squares = float(np.sum(off**2))
    if squares == 0:
        raise UndefinedError("the figure is the same whichever patient is left out, so its error cannot be estimated")
    acceleration = float(np.sum(off**3)) / (6 * squares**1.5)
    z = bias + np.array([-1, 1]) * float(ndtri(0.5 + 0.5 * confidence))
    low, high = np.quantile(drawn, ndtr(bias + z / (1 - acceleration * z)))
    return float(low), float(high)


# --- A figure of a trial: a number, its interval, and the reason where one of them is missing.

LARGEST = 1e150  #: Larger figures are refused: percent and squares of them would overflow. NaN fails `<` too.

Statistic = Callable[[ModalitySizes], float]


class Figure(Record):
    """A number about one modality, never NaN or infinite."""

    value: float | None  #: None where the data leave it undefined; `reason` then says why.
    reason: str = ""
    interval: tuple[float, float] | None = None
    """Low and high end; None where there is none, and `interval_reason` says why if the figure has intervals."""
    interval_reason: str = ""
    has_interval: bool = False  #: True for a figure that is reported with an interval, even where it is undefined.

    def mapped(self, function: Callable[[float], float]) -> Figure:
        """Convert the figure by a monotonic function; ends beyond double precision drop the interval."""
        ends = self.interval
        mapped = replace(self, value=None if self.value is None else function(self.value))
        if ends is None:
            return mapped
        with contextlib.suppress(OverflowError):
            low, high = sorted(map(function, ends))
            if abs(low) < LARGEST and abs(high) < LARGEST:
                return replace(mapped, interval=(low, high))
        return replace(mapped, interval=None, interval_reason="the interval is wider than double precision holds")


Ends = tuple[float, float]
Count = Annotated[int, Meta(ge=0)]
Reasons = Annotated[dict[str, Annotated[str, Meta(min_length=1)]], described("Why a figure or an interval is null.")]


class Figures(Record):
    """Base of the records that hold figures: the value of each, its ends as ``NAME_interval``, and `reasons`."""

    def figure(self, name: str) -> Figure:
        """A figure with its interval, by its name."""
        interval, reasons = f"{name}_interval", getattr(self, "reasons", {})
        ends: Any = getattr(self, interval, UNSET)
        if ends is UNSET:
            return Figure(getattr(self, name), reasons.get(name, ""))
        return Figure(getattr(self, name), reasons.get(name, ""), ends, reasons.get(interval, ""), True)


def fields_of(figures: Mapping[str, Figure]) -> dict[str, Any]:
    """Fields of a `Figures` record: values, intervals, and reasons for those that are missing."""
    fields: dict[str, Any] = {}
    reasons: dict[str, str] = {}
    for name, item in figures.items():
        fields[name] = item.value
        if item.value is None:
            reasons[name] = item.reason
        if item.has_interval:
            fields[f"{name}_interval"] = item.interval
            if item.interval is None:
                reasons[f"{name}_interval"] = item.interval_reason
    return {**fields, "reasons": reasons}


def figure(
    statistic: Statistic,
    sizes: ModalitySizes,
    *,
    scale: Scale | None = None,
    intervals: Intervals | None = None,
    leverage: Callable[[ModalitySizes], FloatArray] | None = None,
) -> Figure:
    """Compute a statistic of these masses, with an interval over patients when `scale` and `intervals` are given.

    `leverage` gives the (n,) weight of each mass in the variance of the figure: the corrected jackknife takes the
    effective number of patients by these weights as its degrees of freedom (Bell & McCaffrey 2002, Survey Methodology
    28, 169).
    """
    if scale is None or intervals is None:
        try:
            return Figure(evaluate(statistic, sizes))
        except UndefinedError as undefined:
            return Figure(None, str(undefined))
    freedom = None
    if leverage is not None and intervals.method == "corrected" and len(sizes.size_mm):
        freedom = effective_number(leverage(sizes), sizes.patient)
    return resampled(Sample(statistic, (sizes,)), scale=scale, intervals=intervals, freedom=freedom)


class Sample(Record):
    """A statistic of one modality, or of two combined, which can be computed again from other patients."""

    statistic: Statistic
    sizes: tuple[ModalitySizes, ...]
    combine: Callable[..., FloatArray] = lambda value: value  #: Combines the statistics of all modalities.
    undefined: str = ""  #: The reason when `combine` gives NaN.

    @property
    def patients(self) -> npt.NDArray[np.int64]:
        """Patients with a mass in any modality."""
        return np.unique(np.concatenate([size.patient for size in self.sizes]))

    def value(self) -> float:
        """The statistic from all patients."""
        return self._combined([np.array(evaluate(self.statistic, size)) for size in self.sizes]).item()

    def left_out(self) -> FloatArray:
        """(g,) statistic without each patient."""
        return self._combined([self._without_each(size, self.patients) for size in self.sizes], " without one patient")

    def redrawn(self, draws: FloatArray) -> FloatArray:
        """(b,) statistic for each row of (b, g) counts of patients; NaN where undefined."""
        return self.combine(*(self._redrawn_one(size, self.patients, draws) for size in self.sizes))

    def _combined(self, values: Sequence[FloatArray], when: str = "") -> FloatArray:
        """The combined statistics; `UndefinedError` with the reason and `when` where one does not exist."""
        combined = self.combine(*values)
        if np.any(np.isnan(combined)):
            raise UndefinedError(self.undefined + when)
        return combined

    def _without_each(self, sizes: ModalitySizes, patients: npt.NDArray[np.int64]) -> FloatArray:
        """(g,) statistic of one modality without each patient, from sums where they suffice."""
        if isinstance(self.statistic, SumStatistic):
            with np.errstate(all="ignore"):
                sums = self.statistic.by_patient(sizes, patients)
                values = self.statistic.finish(sums.sum(axis=0) - sums)
            if np.all(np.abs(values) < LARGEST):
                return values  # else one by one below, for the reason why one is undefined
        return np.array([evaluate(self.statistic, sizes.only(sizes.patient != patient)) for patient in patients])

    def _redrawn_one(self, sizes: ModalitySizes, patients: npt.NDArray[np.int64], draws: FloatArray) -> FloatArray:
        """(b,) statistic of one modality for each row of counts; NaN where undefined."""
        if isinstance(self.statistic, SumStatistic):
            with np.errstate(all="ignore"):
                return self.statistic.finish(draws @ self.statistic.by_patient(sizes, patients))
        values = np.full(len(draws), np.nan)
        counts = draws[:, np.searchsorted(patients, sizes.patient)].astype(np.int64)
        for i, count in enumerate(counts):
            with contextlib.suppress(UndefinedError):
                values[i] = evaluate(self.statistic, sizes.take(np.repeat(np.arange(len(count)), count)))
        return values


def resampled(sample: Sample, *, scale: Scale, intervals: Intervals, freedom: float | None = None) -> Figure:
    """Compute a figure with its interval over patients; `freedom` as in `interval_from_values`."""
    value: float | None = None
    try:
        value, patients = sample.value(), len(sample.patients)
        need_patients(patients)
        left_out, level = sample.left_out(), intervals.probability
        if intervals.method == "bca":
            draws = draw_patients(patients, resamples=intervals.resamples, seed=intervals.seed)
            interval = bca_interval(value, sample.redrawn(draws), left_out, confidence=level)
        else:
            interval = interval_from_values(value, left_out, scale=scale, confidence=level, freedom=freedom)
    except UndefinedError as undefined:
        reason = str(undefined)
        return Figure(value, reason if value is None else "", None, reason, has_interval=True)
    return Figure(value, interval=interval, has_interval=True)


def evaluate(statistic: Statistic, sizes: ModalitySizes) -> float:
    """Value of the statistic; `UndefinedError` where double precision cannot hold it."""
    with np.errstate(all="ignore"):
        value = float(statistic(sizes))
    if not abs(value) < LARGEST:
        raise UndefinedError("the sizes are too large or too small for double precision")
    return value
