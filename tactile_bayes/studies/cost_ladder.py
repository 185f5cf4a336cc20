"""Settings with what each costs and answers, against one reference; the frontier, and which setting is enough."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Protocol, TypeVar

from tactile_bayes.presets import INTERVAL
from tactile_bayes.studies.size_answers import Deviation, SizeAnswer, deviation

Clock = Callable[[], float]
Progress = Callable[[int, int], None]
WORTH = 0.8
"""A setting that takes more than this share of the default's time is not worth a choice."""
MOST_S = 4.0
"""CPU seconds after which a setting is not run again: its least time is known well enough."""


@dataclass(frozen=True, slots=True)
class Work:
    """How a study is run.

    Parameters
    ----------
    clock
        CPU seconds so far.
    tolerance_mm
        See `Ladder`.
    runs
        Of each setting: times are the least of them, distances their root mean square.
    announce
        Called once, when the default has been timed, with about how many CPU seconds the rest will take.
    progress
        Called with settings done and in all.
    seed
        Of the random numbers.
    probability
        Of the intervals.
    """

    clock: Clock
    tolerance_mm: float
    runs: int = 3
    announce: Callable[[float], None] = lambda _seconds: None
    progress: Progress | None = None
    seed: int = 1
    probability: float = INTERVAL


class Choice(Protocol):
    """A setting to be tried: `axis`, `label`, `default` and `usable` as of `Priced`.

    `weight` is about how many times the default's CPU time it takes, for a forecast.
    """

    @property
    def axis(self) -> str: ...
    @property
    def label(self) -> str: ...
    @property
    def weight(self) -> float: ...
    @property
    def default(self) -> bool: ...
    @property
    def usable(self) -> bool: ...


Chosen = TypeVar("Chosen", bound=Choice)


@dataclass(frozen=True, slots=True)
class Priced:
    """One setting.

    Parameters
    ----------
    axis
        What is varied.
    label
        The setting in a few words; an option of the command line where there is one.
    cpu_s
        Least CPU time of the runs, each part by name ("map", "estimate"); their sum is the setting's cost.
    answers
        One for each run.
    off
        From the reference.
    default
        Whether this is what the program does by itself.
    usable
        Whether a user can choose it to save or to spend time; other rows show what the answer depends on.
    """

    axis: str
    label: str
    cpu_s: dict[str, float]
    answers: tuple[SizeAnswer, ...]
    off: Deviation
    default: bool = False
    usable: bool = True

    @property
    def seconds(self) -> float:
        """CPU time of all parts."""
        return sum(self.cpu_s.values())

    @property
    def answer(self) -> SizeAnswer:
        """The first run's."""
        return self.answers[0]


@dataclass(frozen=True, slots=True)
class Reference:
    """What the settings are compared with.

    Parameters
    ----------
    words
        How it was made.
    answer
        None where there is none.
    cpu_s
        What it took.
    """

    words: str
    answer: SizeAnswer | None
    cpu_s: float

    @property
    def error_mm(self) -> float:
        """Monte-Carlo error of the reported interval's ends; NaN where there is no number."""
        found = None if self.answer is None else self.answer.reported
        return float("nan") if found is None else found.mc_error


@dataclass(frozen=True, slots=True)
class PooledRow:
    """The size by the first few of several maps of one mass.

    Parameters
    ----------
    maps
        How many.
    cpu_s
        Of their estimates and of pooling.
    answer
        The reported size; a reason where there is none.
    another_half_mm
        Half width of the second interval, of another exam that may differ as in the paper; NaN where there is none.
    """

    maps: int
    cpu_s: float
    answer: SizeAnswer
    another_half_mm: float = float("nan")


@dataclass(frozen=True, slots=True)
class Ladder:
    """All settings of a study.

    Parameters
    ----------
    rows
        In the order of the table.
    reference
        What they are compared with.
    tolerance_mm
        Distance of interval ends below which more is not worth its cost.
    shared_cpu_s
        What every setting needs besides, by name, such as reading the file or starting the program.
    pooled
        The size by the first map of one mass, by the first two, and so on; empty where one was given.
    """

    rows: tuple[Priced, ...]
    reference: Reference
    tolerance_mm: float
    shared_cpu_s: dict[str, float] = field(default_factory=dict)
    pooled: tuple[PooledRow, ...] = ()

    @property
    def default(self) -> Priced:
        """What the program does by itself."""
        return next(one for one in self.rows if one.default)

    def enough(self) -> Priced | None:
        """The cheapest usable setting within the tolerance, or the default where that costs hardly more."""
        within = [one for one in self.rows if one.usable and one.off.ends <= self.tolerance_mm]
        if not within:
            return None
        best = min(within, key=lambda one: one.seconds)
        return self.default if self.default in within and best.seconds > WORTH * self.default.seconds else best

    def frontier(self) -> list[Priced]:
        """The settings that no other beats in time and distance at once, the cheapest first."""
        found: list[Priced] = []
        known = [one for one in self.rows if one.off.ends == one.off.ends]
        for one in sorted(known, key=lambda one: (one.seconds, one.off.ends)):
            if not found or one.off.ends < found[-1].off.ends:
                found.append(one)
        return found


Run = Callable[[int], tuple[dict[str, float], SizeAnswer]]
"""From the number of the run, which seeds its random numbers, to CPU seconds by part, and the answer."""


def priced(
    axis: str,
    label: str,
    run: Run,
    reference: Reference,
    *,
    runs: int,
    default: bool = False,
    usable: bool = True,
) -> Priced:
    """Run a setting, time it and compare its answers with the reference.

    Parameters
    ----------
    runs
        How often: once or twice only where that took `MOST_S`.
    default, usable
        As of `Priced`.
    """
    spent: list[dict[str, float]] = []
    answers: list[SizeAnswer] = []
    for number in range(runs):
        seconds, answer = run(number)
        spent.append(seconds)
        answers.append(answer)
        # the first run also imports: a second one is worth its wait
        if number >= 1 and sum(sum(one.values()) for one in spent) > MOST_S:
            break
    least = min(spent, key=lambda one: sum(one.values()))
    return Priced(axis, label, least, tuple(answers), deviation(answers, reference.answer), default, usable)


def default_run(run: Run) -> tuple[float, SizeAnswer]:
    """CPU seconds and answer of the default, which is run twice: imports and first calls cost nothing afterwards."""
    run(0)
    seconds, answer = run(0)
    return sum(seconds.values()), answer


def climbed(
    choices: Sequence[Chosen],
    run_of: Callable[[Chosen], Run],
    reference: Callable[[], Reference],
    *,
    default_s: float,
    work: Work,
) -> Ladder:
    """Say how long it takes, make the reference and price every setting.

    Parameters
    ----------
    default_s
        CPU seconds of the default.
    """
    work.announce(default_s * (4.0 + work.runs * sum(one.weight for one in choices)))
    made, rows = reference(), []
    for number, one in enumerate(choices, start=1):
        run = run_of(one)
        rows.append(priced(one.axis, one.label, run, made, runs=work.runs, default=one.default, usable=one.usable))
        if work.progress is not None:
            work.progress(number, len(choices))
    return Ladder(tuple(rows), made, work.tolerance_mm)
