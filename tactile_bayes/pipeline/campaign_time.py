"""How long a campaign's steps take: by its journal for a plan, and by the run itself for the time that is left."""

from __future__ import annotations

import statistics
import time
from collections import defaultdict
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from tactile_bayes.pipeline.campaign_settings import CampaignSettings
    from tactile_bayes.pipeline.campaign_steps import Result

USUAL_S: Final = {
    "map": 0.08,
    "estimate": 0.8,
    "figures": 0.8,
    "repeatability": 0.3,
    "size": 0.06,
    "pool": 0.15,
    "compare": 0.15,
    "copy": 0.05,
}
"""CPU seconds of each step, which give the others' share until one of each was run; see record 0114."""
_LATEST: Final = 1000
"""So many results of a step tell how long it takes."""
_ODD: Final = 2
"""So many of a step's first results may be odd ones."""


def steps_needed(
    exams: int, masses: int, *, settings: CampaignSettings, learns: bool, compared: int = 0
) -> dict[str, int]:
    """Steps that so many exams and masses take, done or not.

    Parameters
    ----------
    masses, compared
        To be pooled, and to be compared between visits.
    learns
        Whether the repeats may teach the spread between exams; then every exam gets its size by it.
    """
    needed = {"map": exams, "estimate": exams, "figures": exams * settings.figures, "pool": masses, "compare": compared}
    needed |= {"repeatability": 1, "size": exams} if learns else {}
    return {**needed, "copy": (exams + masses + compared) * bool(settings.copy_to)}


def mean_seconds(values: Mapping[str, Result]) -> dict[str, float]:
    """Mean seconds of each step, by its latest results of any run; the mean, for a sum is wanted and times have tails.

    Parameters
    ----------
    values
        Results by the keys of the journal, which begin with the step.
    """
    taken: dict[str, list[float]] = defaultdict(list)
    for key in reversed([*values]):
        times = taken[key.split(" ")[0]]
        if len(times) < _LATEST:
            times.append(values[key]["seconds"])
    return {step: statistics.fmean(times) for step, times in taken.items()}


class Pace:
    """Time that a run takes for one of each step, whatever shares its processors, and so the time that is left.

    A stage is timed from its first result on: until then the workers load what they need.

    Parameters
    ----------
    earlier
        Mean seconds of steps in earlier runs.
    clock
        Seconds from anywhere.
    """

    def __init__(self, earlier: Mapping[str, float], clock: Callable[[], float] = time.monotonic) -> None:
        self._usual = {**USUAL_S, **_as_long_as(earlier)}
        self._clock = clock
        self._spent: dict[str, float] = defaultdict(float)
        self._timed: dict[str, int] = defaultdict(int)
        self._since, self._counted = 0.0, 0

    def begin(self) -> None:
        """Begin a stage."""
        self._counted = 0

    def note(self, step: str, done: int) -> None:
        """Note that so many of a stage's steps are done."""
        now = self._clock()
        if self._counted and done > self._counted:
            self._spent[step] += now - self._since
            self._timed[step] += done - self._counted
        if done > self._counted:
            self._since, self._counted = now, done

    def left(self, missing: Mapping[str, int]) -> float | None:
        """Seconds for the steps that are missing, by their numbers; None before two of any step are done."""
        timed = {step: self._spent[step] / count for step, count in self._timed.items()}
        if not timed or not all(timed.values()):
            return None
        slower = statistics.geometric_mean([seconds / self._usual[step] for step, seconds in timed.items()])
        return sum(count * self._of(step, slower) for step, count in missing.items())

    def _of(self, step: str, slower: float) -> float:
        """Seconds for one of a step; the usual time counts as much as two of them."""
        spent = self._spent.get(step, 0.0) + _ODD * slower * self._usual[step]
        return spent / (self._timed.get(step, 0) + _ODD)


def _as_long_as(earlier: Mapping[str, float]) -> dict[str, float]:
    """Earlier times in the unit of the usual ones, so that both can stand side by side."""
    both = [step for step, seconds in earlier.items() if step in USUAL_S and seconds > 0.0]
    if not both:
        return {}
    unit = sum(USUAL_S[step] for step in both) / sum(earlier[step] for step in both)
    return {step: unit * earlier[step] for step in both}
