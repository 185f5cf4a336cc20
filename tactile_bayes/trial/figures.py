"""A figure of a trial: a number, its interval, and the reason where one of them is missing."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Protocol, assert_never

import numpy as np
import numpy.typing as npt

from tactile_bayes.trial.bootstrap import Intervals, bca_interval, draw_patients, method_of
from tactile_bayes.trial.jackknife import (
    Scale,
    UndefinedError,
    effective_number,
    interval_from_values,
    need_patients,
)
from tactile_bayes.trial.readings import FloatArray, ModalitySizes
from tactile_bayes.trial.sums import SumStatistic

# Room above for percent and squares; NaN fails the comparison too.
LARGEST = 1e150

Statistic = Callable[[ModalitySizes], float]
Leverage = Callable[[ModalitySizes], FloatArray]


@dataclass(frozen=True, slots=True)
class Figure:
    """A number about one modality, never NaN or infinite.

    Attributes
    ----------
    value
        None where the data leave it undefined; `reason` then says why.
    interval
        Low and high end, None where none is given; `interval_reason` says why when one was asked for.
    has_interval
        Whether an interval belongs to this figure at all.
    """

    value: float | None
    reason: str = ""
    interval: tuple[float, float] | None = None
    interval_reason: str = ""
    has_interval: bool = False

    def mapped(self, function: Callable[[float], float]) -> Figure:
        """Convert the figure by an increasing function; ends beyond double precision drop the interval."""
        ends = self.interval
        one = replace(self, value=None if self.value is None else function(self.value))
        if ends is None:
            return one
        with contextlib.suppress(OverflowError):
            low, high = function(ends[0]), function(ends[1])
            if abs(low) < LARGEST and abs(high) < LARGEST:
                return replace(one, interval=(low, high))
        return replace(one, interval=None, interval_reason="the interval is wider than double precision holds")


def figure(
    statistic: Statistic,
    sizes: ModalitySizes,
    *,
    scale: Scale | None = None,
    confidence: float | None = None,
    leverage: Leverage | None = None,
) -> Figure:
    """Compute a statistic of these masses, with an interval over patients when `scale` and `confidence` are given.

    Parameters
    ----------
    statistic
        Returns a number or raises `UndefinedError` with the reason. A `SumStatistic` is left out in one step.
    scale
        ``log`` for a figure above 0, ``linear`` for one of either sign.
    confidence
        Probability of the interval, two-sided; or `Intervals`, to choose how it is made.
    leverage
        (n,) weight of each mass in the variance of the figure. The corrected jackknife takes the effective number of
        patients by these weights as its degrees of freedom (Bell & McCaffrey 2002, Survey Methodology 28, 169).
    """
    if scale is None or confidence is None:
        return _plain(partial(finite, statistic, sizes))
    freedom = None
    if leverage is not None and method_of(confidence) == "corrected" and len(sizes.size_mm):
        freedom = effective_number(leverage(sizes), sizes.patient)
    return resampled(Sample(statistic, sizes), scale=scale, confidence=confidence, freedom=freedom)


class Resampled(Protocol):
    """A statistic that can be computed without one patient, or from patients drawn anew."""

    @property
    def patients(self) -> npt.NDArray[np.int64]:
        """Patients to leave out in turn."""
        ...

    def value(self) -> float:
        """The statistic from all patients; raises `UndefinedError`."""
        ...

    def left_out(self) -> FloatArray:
        """(g,) statistic without each patient; raises `UndefinedError`."""
        ...

    def redrawn(self, draws: FloatArray) -> FloatArray:
        """(b,) statistic for each row of (b, g) counts of patients; NaN where undefined."""
        ...


@dataclass(frozen=True, slots=True)
class Sample:
    """A statistic of one modality, which can be resampled."""

    statistic: Statistic
    sizes: ModalitySizes
    among: npt.NDArray[np.int64] | None = None

    @property
    def patients(self) -> npt.NDArray[np.int64]:
        return self.sizes.patients if self.among is None else self.among

    def value(self) -> float:
        return finite(self.statistic, self.sizes)

    def left_out(self) -> FloatArray:
        if isinstance(self.statistic, SumStatistic):
            with np.errstate(all="ignore"):
                values = self.statistic.left_out(self.sizes, self.patients)
            if np.all(np.abs(values) < LARGEST):
                return values
        return np.array([finite(self.statistic, self.sizes.without(one)) for one in self.patients.tolist()])

    def redrawn(self, draws: FloatArray) -> FloatArray:
        if isinstance(self.statistic, SumStatistic):
            with np.errstate(all="ignore"):
                return self.statistic.redrawn(self.sizes, self.patients, draws)
        return np.array([self._redrawn_once(row) for row in draws])

    def _redrawn_once(self, counts: FloatArray) -> float:
        of_mass = counts[np.searchsorted(self.patients, self.sizes.patient)].astype(np.int64)
        try:
            return finite(self.statistic, self.sizes.take(np.repeat(np.arange(len(of_mass)), of_mass)))
        except UndefinedError:
            return math.nan


def resampled(sample: Resampled, *, scale: Scale, confidence: float, freedom: float | None = None) -> Figure:
    """Compute a figure with its interval over patients; `freedom` as in `interval_from_values`."""
    plain = _plain(sample.value)
    if plain.value is None:
        return replace(plain, has_interval=True, interval_reason=plain.reason)
    try:
        need_patients(len(sample.patients))
        interval = _interval(sample, plain.value, scale=scale, confidence=confidence, freedom=freedom)
    except UndefinedError as undefined:
        return replace(plain, has_interval=True, interval_reason=str(undefined))
    return replace(plain, has_interval=True, interval=interval)


def _interval(
    sample: Resampled, value: float, *, scale: Scale, confidence: float, freedom: float | None
) -> tuple[float, float]:
    chosen = confidence if isinstance(confidence, Intervals) else Intervals(confidence)
    match chosen.method:
        case "corrected" | "jackknife":
            left_out = sample.left_out()
            return interval_from_values(value, left_out, scale=scale, confidence=float(chosen), freedom=freedom)
        case "bca":
            draws = draw_patients(len(sample.patients), resamples=chosen.resamples, seed=chosen.seed)
            return bca_interval(value, sample.redrawn(draws), sample.left_out(), confidence=float(chosen))
    assert_never(chosen.method)


def _plain(compute: Callable[[], float]) -> Figure:
    try:
        return Figure(compute())
    except UndefinedError as undefined:
        return Figure(None, reason=str(undefined))


def finite(statistic: Statistic, sizes: ModalitySizes) -> float:
    """Compute the statistic; `UndefinedError` where double precision cannot hold it."""
    with np.errstate(all="ignore"):
        value = float(statistic(sizes))
    if not abs(value) < LARGEST:
        raise UndefinedError("the sizes are too large or too small for double precision")
    return value
