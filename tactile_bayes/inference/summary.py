"""Summary of a posterior in seven numbers, with its interval's kind and probability."""

from __future__ import annotations

import numpy as np

from tactile_bayes.geometry import FloatArray
from tactile_bayes.inference.draws import Labels
from tactile_bayes.records import dataclass

INTERVAL_KIND = "eti"


def nine_digits(value: float) -> float:
    """The value to nine significant digits, as JSON has them."""
    return float(f"{value:.9g}")


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
        names = ("median", "mean", "sd", "low", "high", "mc_error")
        numbers: dict[str, float | str] = {name: nine_digits(getattr(self, name)) for name in names}
        return numbers | {"probability": self.probability, "kind": self.kind}


def summarise(
    draws: FloatArray,
    *,
    probability: float,
    effective_draws: float | None = None,
    replicates: Labels | None = None,
) -> Quantity:
    """Summarise draws, leaving NaN out.

    Parameters
    ----------
    draws : (...) array
    probability
        Of the equal-tailed interval, in (0, 1).
    effective_draws
        How many independent draws they are worth for a tail. Default: all of them.
    replicates : (n,) array
        Label of the independent replicate of each draw, in the order of ``draws.ravel()``: the Monte-Carlo error then
        comes from the spread between replicates, and `effective_draws` is not used.

    Raises
    ------
    ValueError
        When no draw is finite.
    """
    flat = draws.ravel()
    finite = np.isfinite(flat)
    values = flat[finite]
    if not values.size:
        raise ValueError("no finite draws")
    tail = (1.0 - probability) / 2.0
    ordered = np.sort(values)
    low, median, high = quantiles_of(ordered, np.array([tail, 0.5, 1.0 - tail]))
    if replicates is None:
        step = float(np.sqrt(tail * (1.0 - tail) / max(effective_draws or values.size, 1.0)))
    else:
        step = _tail_error(values, replicates[finite], (low, high))
    # an end's standard error is half the way between order statistics a standard error below and above (Maritz-Jarrett
    # in spirit)
    about = np.clip([tail - step, tail + step, 1 - tail - step, 1 - tail + step], 0.0, 1.0)
    ends = quantiles_of(ordered, about)
    return Quantity(
        median=float(median),
        mean=float(values.mean()),
        sd=float(values.std()),
        low=float(low),
        high=float(high),
        probability=probability,
        mc_error=float(max(ends[1] - ends[0], ends[3] - ends[2]) / 2.0),
    )


def _tail_error(values: FloatArray, replicates: Labels, ends: tuple[float, float]) -> float:
    """Standard error of the probability beyond an interval's end, from the replicates; one value for both ends.

    Notes
    -----
    Of a ratio of sums over replicates (Cochran 1977, Sampling Techniques, ch. 6). Taking both ends together doubles the
    few degrees of freedom. It is no less than what one draw moves.
    """
    count, n = np.bincount(replicates), len(values)
    r = int(np.count_nonzero(count))
    if r < 2:
        return 0.5
    squares = []
    for beyond in (values < ends[0], values > ends[1]):
        inside = np.bincount(replicates, weights=beyond)
        squares.append(float(np.sum((inside - count * inside.sum() / n) ** 2)) * r / (r - 1))
    return max(float(np.sqrt(np.mean(squares))), 1.0) / n


def quantiles_of(ordered: FloatArray, probabilities: FloatArray) -> FloatArray:
    """Quantiles of sorted values, linear between neighbours: ``np.quantile``, which does not use the fast sort."""
    return np.interp(probabilities * (len(ordered) - 1), np.arange(len(ordered)), ordered)


def weighted_quantiles_of(ordered: FloatArray, weights: FloatArray, probabilities: FloatArray) -> FloatArray:
    """Weighted quantiles of sorted values, linear between the middles of their steps."""
    edges = np.cumsum(weights)
    return np.interp(probabilities, (edges - 0.5 * weights) / edges[-1], ordered)
