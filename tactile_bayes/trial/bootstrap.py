"""Bootstrap intervals over patients (BCa), keeping a patient's masses together."""

from __future__ import annotations

from functools import lru_cache
from typing import Literal

import numpy as np

from tactile_bayes.trial.jackknife import UndefinedError
from tactile_bayes.trial.readings import FloatArray

Method = Literal["corrected", "jackknife", "bca"]
RESAMPLES = 2000
SEED = 1999
# Of the redrawn trials, at least this share must have the figure at all.
_LEAST_DEFINED = 0.99


class Intervals(float):
    """Probability of intervals together with their method; a plain number means the jackknife.

    Parameters
    ----------
    confidence
        Probability, two-sided.
    method, resamples, seed
        ``corrected`` is the jackknife with the corrections of record 0077; ``bca`` draws the patients
        `resamples` times from this seed.
    """

    method: Method
    resamples: int
    seed: int

    def __new__(
        cls, confidence: float, *, method: Method = "jackknife", resamples: int = RESAMPLES, seed: int = SEED
    ) -> Intervals:
        """A float with three more attributes."""
        made = super().__new__(cls, confidence)
        made.method, made.resamples, made.seed = method, resamples, seed
        return made


def method_of(confidence: float) -> Method:
    """Method of the intervals of a probability."""
    return confidence.method if isinstance(confidence, Intervals) else "jackknife"


@lru_cache(maxsize=8)
def draw_patients(patients: int, *, resamples: int, seed: int) -> FloatArray:
    """(resamples, patients) how often each patient is drawn, with replacement; equal for every figure."""
    rng = np.random.default_rng([seed, patients])
    draws = rng.multinomial(patients, np.full(patients, 1 / patients), size=resamples).astype(np.float64)
    draws.flags.writeable = False
    return draws


def bca_interval(value: float, drawn: FloatArray, left_out: FloatArray, *, confidence: float) -> tuple[float, float]:
    r"""BCa interval: quantiles corrected for bias and acceleration.

    Notes
    -----
    Efron (1987), J. Am. Stat. Assoc. 82, 171: bias from the share of draws below the figure (ties by half),
    acceleration from the skewness of the values with one patient left out.
    """
    from scipy.special import ndtr, ndtri

    drawn = _defined(drawn)
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


def _defined(drawn: FloatArray) -> FloatArray:
    defined = drawn[np.isfinite(drawn)]
    if len(defined) < _LEAST_DEFINED * len(drawn):
        raise UndefinedError(f"of {len(drawn)} redrawn trials {len(drawn) - len(defined)} leave the figure undefined")
    return defined
