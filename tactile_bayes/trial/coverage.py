"""Coverage of stated intervals against the size after excision."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby

from tactile_bayes.trial.proportion import clopper_pearson
from tactile_bayes.trial.readings import IntervalReading


@dataclass(frozen=True, slots=True)
class Coverage:
    """Coverage of the ex-vivo size by intervals of one nominal probability: `covered` of `n`, on `masses` masses.

    The ex-vivo size is itself a measurement (+-5 % in the paper), so even honest intervals of the true size cover it a
    little less often than they say.
    """

    probability: float
    n: int
    covered: int
    masses: int
    interval: tuple[float, float]

    @property
    def fraction(self) -> float:
        """Share covered."""
        return self.covered / self.n


def coverage(intervals: Sequence[IntervalReading], *, confidence: float) -> list[Coverage]:
    """Coverage at each nominal probability, with an exact interval.

    Notes
    -----
    Replicates of a mass share its ex-vivo size, so n intervals on m masses are not n trials. The interval takes the
    share covered as found on m trials: exact where each mass has one interval, on the wide side where it has more.
    """
    ordered = sorted(intervals, key=lambda one: one.interval.probability)
    return [
        _coverage(probability, list(group), confidence=confidence)
        for probability, group in groupby(ordered, key=lambda one: one.interval.probability)
    ]


def _coverage(probability: float, group: Sequence[IntervalReading], *, confidence: float) -> Coverage:
    covered = sum(one.covered for one in group)
    masses = len({one.key for one in group})
    return Coverage(
        probability=probability,
        n=len(group),
        covered=covered,
        masses=masses,
        interval=clopper_pearson(covered * masses / len(group), masses, confidence=confidence),
    )
