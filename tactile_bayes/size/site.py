"""A site's repeatability: how far sizes of one mass lie apart between its exams, learned from repeated exams there."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from tactile_bayes.declarations import Record
from tactile_bayes.errors import BadDataError
from tactile_bayes.size.bodies import BodyCalibration
from tactile_bayes.size.draws import ShapeDraws, SizePosterior
from tactile_bayes.size.pooling import SizePriors, log_sizes, pooled_size
from tactile_bayes.size.spread import BetweenMaps

PROBABILITY: Final = 0.95
"""Of the interval of a learned spread."""


class Repeatability(Record):
    """Spread of ln d between exams of one mass at a site, beyond the maps' own errors.

    `sd` and `log_sd` are as of `BetweenMaps`: root mean square of the posterior, and the log-SD of the log-normal that
    has the same mean of tau^2 and of tau^4; median, low and high are the posterior's, with its interval of
    `PROBABILITY`. `sha256` is of the file that it was read from, empty where it is in none.
    """

    sd: float
    log_sd: float
    median: float
    low: float
    high: float
    masses: int
    maps: int
    calibration: str = ""
    calibration_sha256: str = ""
    normalise: str = ""
    outlying: tuple[str, ...] = ()
    sha256: str = ""

    def __post_init__(self) -> None:
        if not (0.0 < self.low <= self.median <= self.high):
            what = f"the spread has the median {self.median:g} and the interval {self.low:g} to {self.high:g}"
            raise BadDataError(what, way_out="learn it again: `calibrate repeatability`")

    @property
    def between_maps(self) -> BetweenMaps:
        """The spread as a prior of a mass's maps."""
        return BetweenMaps(self.sd, self.log_sd)

    def as_dict(self) -> dict[str, float]:
        """What a size used of it, as plain data."""
        return {"between_map_sd": self.sd, "log_sd": self.log_sd, "masses": self.masses, "maps": self.maps}

    def words(self) -> str:
        """The spread with its interval, and what it was learned from."""
        spread = f"{_percent(self.median)} % (95 %: {_percent(self.low)} to {_percent(self.high)})"
        return f"exams of one mass differ by {spread} at this site, by {self.masses} masses and {self.maps} exams"


def _percent(share: float) -> str:
    return f"{100 * share:.1f}" if share < 0.0995 else f"{100 * share:.0f}"


def log_size_alone(calibration: BodyCalibration, shape: ShapeDraws) -> tuple[float, float]:
    """Mean and variance of ln d by a map alone, without what no map shows."""
    (log_size,) = log_sizes(calibration.for_maps([shape]), [shape])
    return float(np.nanmean(log_size)), float(np.nanvar(log_size))


def size_alone(
    shape: ShapeDraws, *, calibration: BodyCalibration, priors: SizePriors, rng: np.random.Generator
) -> SizePosterior:
    """Size by a map alone from the draws that pooling keeps of it, without fitting the map again.

    It has the draws of the map one by one, as `estimate_map` gives them, paired with other random points.
    """
    used: Sequence[ShapeDraws] = [shape]
    return pooled_size(used, calibration=calibration.for_maps([shape]), priors=priors, rng=rng)
