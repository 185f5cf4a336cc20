"""Intervals by leaving out one patient at a time: masses of one patient go together."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Literal

import numpy as np

Scale = Literal["log", "linear"]

# Below this the spread of so few leave-one-out values says little; a Student t with 6 degrees of freedom would hide it.
MIN_PATIENTS = 8


class UndefinedError(Exception):
    """A figure, or its interval, that the data leave undefined; the message is the reason."""


def jackknife_interval(
    value: float, left_out: Sequence[Callable[[], float]], *, scale: Scale, confidence: float
) -> tuple[float, float]:
    r"""Two-sided interval of a statistic from its values with one patient left out.

    Parameters
    ----------
    value
        The statistic on all patients.
    left_out
        One function a patient, giving the statistic without that patient.
    scale
        ``log`` works on the logarithm (figures above 0: the interval then stays above 0), ``linear`` on the figure.
    confidence
        Probability of the interval.

    Raises
    ------
    UndefinedError
        With fewer than `MIN_PATIENTS` patients, or where the leave-one-out values do not exist or do not differ.

    Notes
    -----
    .. math:: \hat\theta \pm t_{G-1}\sqrt{\tfrac{G-1}{G}\sum_g (\hat\theta_{(g)} - \bar\theta_{(\cdot)})^2}

    for G patients: Tukey (1958), Ann. Math. Statist. 29, 614; Efron & Tibshirani (1993), ch. 11.
    """
    from scipy.special import stdtrit

    groups = len(left_out)
    if groups < MIN_PATIENTS:
        raise UndefinedError(f"an interval needs at least {MIN_PATIENTS} patients (found {groups})")
    everything = _on_scale(value, scale)
    others = np.array([_on_scale(one(), scale) for one in left_out])
    variance = (groups - 1) / groups * float(np.sum((others - others.mean()) ** 2))
    if variance <= (1e-12 * max(1.0, abs(everything))) ** 2:
        raise UndefinedError("the figure is the same whichever patient is left out, so its error cannot be estimated")
    reach = float(stdtrit(groups - 1, 0.5 + 0.5 * confidence)) * math.sqrt(variance)
    low, high = everything - reach, everything + reach
    if scale == "linear":
        return low, high
    if high > math.log(1e300):
        raise UndefinedError("the interval is wider than double precision holds")
    return math.exp(low), math.exp(high)


def _on_scale(value: float, scale: Scale) -> float:
    if scale == "linear":
        return value
    if value <= 0:
        raise UndefinedError("the figure is 0, or becomes 0 without one patient, and has no logarithm")
    return math.log(value)
