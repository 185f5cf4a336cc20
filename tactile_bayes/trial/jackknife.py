"""Jackknife intervals over patients, keeping a patient's masses together."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal, TypeVar

import numpy as np
import numpy.typing as npt

Scale = Literal["log", "linear", "fisher", "slope"]
Values = TypeVar("Values", float, npt.NDArray[np.float64])

# Below this the spread of so few leave-one-out values says little; a Student t with 6 degrees of freedom would hide it.
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
    value: float,
    values: Sequence[float] | npt.NDArray[np.float64],
    *,
    scale: Scale,
    confidence: float,
    freedom: float | None = None,
) -> tuple[float, float]:
    r"""Two-sided jackknife interval of a statistic from its values with one patient left out.

    Parameters
    ----------
    value
        The statistic on all patients.
    values : (G,) array
        The statistic without each patient.
    scale
        ``log`` works on the logarithm (figures above 0: the interval then stays above 0), ``linear`` on the figure,
        ``fisher`` on the inverse hyperbolic tangent (coefficients between -1 and 1), ``slope`` as ``log`` where the
        figure is above 0 with every patient left out, else as ``linear``.
    confidence
        Probability of the interval.
    freedom
        Degrees of freedom of Student's t where they are fewer than G - 1.

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

    groups = len(values)
    need_patients(groups)
    left_out = np.asarray(values, dtype=np.float64)
    if scale == "slope":
        scale = "log" if value > 0 and np.all(left_out > 0) else "linear"
    everything, others = on_scale(value, scale), on_scale(left_out, scale)
    variance = (groups - 1) / groups * float(np.sum((others - others.mean()) ** 2))
    if variance <= (1e-12 * max(1.0, abs(everything))) ** 2:
        raise UndefinedError("the figure is the same whichever patient is left out, so its error cannot be estimated")
    degrees = groups - 1 if freedom is None else min(max(freedom, 1.0), groups - 1)
    reach = float(stdtrit(degrees, 0.5 + 0.5 * confidence)) * math.sqrt(variance)
    low, high = everything - reach, everything + reach
    if scale == "linear":
        return low, high
    if scale == "fisher":
        return math.tanh(low), math.tanh(high)
    if high - low > math.log(WIDEST):
        raise UndefinedError(f"it would span more than a factor of {WIDEST:g}: the figure rests on one or two patients")
    return math.exp(low), math.exp(high)


def effective_number(weights: npt.NDArray[np.float64], patient: npt.NDArray[np.int64]) -> float:
    r"""Effective number of patients, :math:`(\sum_g W_g)^2 / \sum_g W_g^2` (Satterthwaite 1946).

    Parameters
    ----------
    weights : (n,) array
        Of each mass, not below 0; 0 is returned where all are 0.
    patient : (n,) array
        Patient of each mass.
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


def on_scale(values: Values, scale: Scale) -> Values:
    """Transform values to a scale: unchanged, logarithms, or Fisher's z; `UndefinedError` where one has none."""
    if scale == "linear":
        return values
    if scale == "fisher":
        if np.any(np.abs(np.asarray(values)) >= 1):
            raise UndefinedError("the coefficient is 1 or -1, or becomes so without one patient")
        stretched: Values = np.arctanh(values)
        return stretched
    if np.any(np.asarray(values) <= 0):
        raise UndefinedError("the figure is 0, or becomes 0 without one patient, and has no logarithm")
    logarithms: Values = np.log(values)
    return logarithms
