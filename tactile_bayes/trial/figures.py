"""A figure of a trial: a number, its interval, and the reason wherever one of the two is not there."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from tactile_bayes.trial.jackknife import Scale, UndefinedError, jackknife_interval
from tactile_bayes.trial.readings import ModalitySizes

# Room above for percent and squares; NaN fails the comparison too.
LARGEST = 1e150

Statistic = Callable[[ModalitySizes], float]


@dataclass(frozen=True, slots=True)
class Figure:
    """One number about one modality; never NaN or infinite.

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
        """The figure in other units, by an increasing function."""
        ends = self.interval
        return replace(
            self,
            value=None if self.value is None else function(self.value),
            interval=None if ends is None else (function(ends[0]), function(ends[1])),
        )


def figure(
    statistic: Statistic, sizes: ModalitySizes, *, scale: Scale | None = None, confidence: float | None = None
) -> Figure:
    """The statistic of these masses, with a jackknife interval over patients when `scale` and `confidence` are given.

    Parameters
    ----------
    statistic
        Returns a number or raises `UndefinedError` with the reason.
    scale
        ``log`` for a figure above 0, ``linear`` for one of either sign.
    confidence
        Probability of the interval, two-sided.
    """

    def compute(left_out: int | None) -> float:
        return finite(statistic, sizes if left_out is None else sizes.without(left_out))

    if scale is None or confidence is None:
        return _plain(compute)
    return jackknifed(compute, sizes.patients.tolist(), scale=scale, confidence=confidence)


def jackknifed(
    compute: Callable[[int | None], float], patients: Sequence[int], *, scale: Scale, confidence: float
) -> Figure:
    """A figure with its jackknife interval.

    Parameters
    ----------
    compute
        The number without the given patient, or with all of them for None; raises `UndefinedError`.
    patients
        Those to leave out in turn.
    """
    plain = _plain(compute)
    if plain.value is None:
        return replace(plain, has_interval=True, interval_reason=plain.reason)
    try:
        left_out = [partial(compute, patient) for patient in patients]
        interval = jackknife_interval(plain.value, left_out, scale=scale, confidence=confidence)
    except UndefinedError as undefined:
        return replace(plain, has_interval=True, interval_reason=str(undefined))
    return replace(plain, has_interval=True, interval=interval)


def _plain(compute: Callable[[int | None], float]) -> Figure:
    try:
        return Figure(compute(None))
    except UndefinedError as undefined:
        return Figure(None, reason=str(undefined))


def finite(statistic: Statistic, sizes: ModalitySizes) -> float:
    """The statistic's value, or `UndefinedError` where double precision cannot hold it."""
    with np.errstate(all="ignore"):
        value = float(statistic(sizes))
    if not abs(value) < LARGEST:
        raise UndefinedError("the sizes are too large or too small for double precision")
    return value
