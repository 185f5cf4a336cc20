"""A posterior in seven numbers, its interval's kind and probability always named."""

from __future__ import annotations

import numpy as np

from tactile_bayes.geometry import FloatArray
from tactile_bayes.records import dataclass

INTERVAL_KIND = "eti"


@dataclass(frozen=True, slots=True)
class Quantity:
    """Summary of one quantity's draws.

    Parameters
    ----------
    low, high
        Ends of the equal-tailed interval of `probability`.
    mc_error
        Monte-Carlo standard error of the wider of the two ends; digits beyond it mean nothing.
    """

    median: float
    mean: float
    sd: float
    low: float
    high: float
    probability: float
    mc_error: float
    kind: str = INTERVAL_KIND

    def as_dict(self) -> dict[str, float | str]:
        """Plain data, rounded to nine significant digits."""
        names = ("median", "mean", "sd", "low", "high")
        numbers: dict[str, float | str] = {name: float(f"{getattr(self, name):.9g}") for name in names}
        return numbers | {"probability": self.probability, "kind": self.kind}


def summarise(draws: FloatArray, *, probability: float, effective_draws: float) -> Quantity:
    """Summarise draws; NaN draws are left out.

    Parameters
    ----------
    draws : (...) array
    probability
        Of the equal-tailed interval, in (0, 1).
    effective_draws
        How many independent draws they are worth for a tail.

    Raises
    ------
    ValueError
        When no draw is finite.
    """
    values = draws[np.isfinite(draws)]
    if not values.size:
        raise ValueError("no finite draws")
    tail = (1.0 - probability) / 2.0
    # an end's standard error is half the way between order statistics a binomial SD below and above (Maritz-Jarrett in
    # spirit)
    step = np.sqrt(tail * (1.0 - tail) / max(effective_draws, 1.0))
    about = np.clip([tail - step, tail + step, 1 - tail - step, 1 - tail + step], 0.0, 1.0)
    low, median, high, *ends = quantiles_of(np.sort(values), np.array([tail, 0.5, 1.0 - tail, *about]))
    return Quantity(
        median=float(median),
        mean=float(values.mean()),
        sd=float(values.std()),
        low=float(low),
        high=float(high),
        probability=probability,
        mc_error=float(max(ends[1] - ends[0], ends[3] - ends[2]) / 2.0),
    )


def quantiles_of(ordered: FloatArray, probabilities: FloatArray) -> FloatArray:
    """Quantiles of sorted values, linear between neighbours: ``np.quantile``, which does not use the fast sort."""
    return np.interp(probabilities * (len(ordered) - 1), np.arange(len(ordered)), ordered)


def weighted_quantiles_of(ordered: FloatArray, weights: FloatArray, probabilities: FloatArray) -> FloatArray:
    """Weighted quantiles of sorted values, linear between the middles of their steps."""
    edges = np.cumsum(weights)
    return np.interp(probabilities, (edges - 0.5 * weights) / edges[-1], ordered)
