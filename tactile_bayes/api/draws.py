"""Posterior draws of one quantity, with its median and intervals."""

from __future__ import annotations

import numpy as np

from tactile_bayes.declarations import Record
from tactile_bayes.errors import check_number
from tactile_bayes.geometry import FloatArray
from tactile_bayes.inference.draws import Labels, Quantity, summarise
from tactile_bayes.presets import INTERVAL


class Draws(Record, eq=False):
    """Posterior draws of one quantity.

    Parameters
    ----------
    values : (chain, draw) array
        NaN where a draw has no value.
    unit
        Such as ``"mm"``; empty for a ratio.
    probability
        Of the interval that is shown where none is asked for.
    replicates : (chain * draw,) array
        Label of the independent replicate of each draw; their spread is the Monte-Carlo error.
    effective_draws
        How many independent draws they are worth, where there are no replicates.

    Examples
    --------
    >>> import tactile_bayes as tb
    >>> size = tb.estimate(tb.demo_map()).max_size_mm
    >>> low, high = size.interval(0.9)
    >>> bool(low < size.median < high)
    True
    """

    values: FloatArray
    unit: str = ""
    probability: float = INTERVAL
    replicates: Labels | None = None
    effective_draws: float | None = None

    def summary(self, probability: float | None = None) -> Quantity:
        """Median, mean, SD, equal-tailed interval and its Monte-Carlo error, as the command line prints them.

        Parameters
        ----------
        probability
            Of the interval, between 0 and 1.

        Raises
        ------
        UsageError
            When the probability is not between 0 and 1.
        """
        wanted = self.probability if probability is None else probability
        check_number("the probability of an interval", wanted, 0, 1, open_ends=True)
        return summarise(
            self.values, probability=wanted, effective_draws=self.effective_draws, replicates=self.replicates
        )

    def interval(self, probability: float | None = None) -> tuple[float, float]:
        """Ends of the equal-tailed credible interval."""
        found = self.summary(probability)
        return found.low, found.high

    @property
    def median(self) -> float:
        """The posterior's median."""
        return self.summary().median

    @property
    def mean(self) -> float:
        """The posterior's mean."""
        return self.summary().mean

    @property
    def sd(self) -> float:
        """The posterior's standard deviation."""
        return self.summary().sd

    @property
    def mc_error(self) -> float:
        """Monte-Carlo standard error of the interval's ends."""
        return self.summary().mc_error

    def __array__(self, dtype: object = None, copy: bool | None = None) -> FloatArray:
        """The draws as an array."""
        del copy
        return np.asarray(self.values, dtype=dtype)  # type: ignore[call-overload, no-any-return]

    def __repr__(self) -> str:
        found = self.summary()
        unit = f" {self.unit}" if self.unit else ""
        return f"{found.median:.3g}{unit} ({found.low:.3g} to {found.high:.3g}, {100 * found.probability:g} % interval)"
