"""The trade-off ladder, and that of an estimate, with the numbers that it is read by."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Annotated, Any, Generic, TypeVar

import numpy as np

from tactile_bayes.declarations import Meta, Record, described, field, replace
from tactile_bayes.errors import NotConvergedError
from tactile_bayes.inference.draws import Quantity, summarise
from tactile_bayes.mapping.map import TactileMap
from tactile_bayes.posterior.draw import SamplerSettings
from tactile_bayes.posterior.estimate import estimate_map
from tactile_bayes.posterior.result import Estimate
from tactile_bayes.presets import INTERVAL, MOST_FIELD_COSINES, Background
from tactile_bayes.progress import Progress, no_progress
from tactile_bayes.size.pooling import Calibration

# --- The reported numbers of one setting, and how far they lie from a reference.

SIZE = "max_size_mm"
WIDTHS = ("sigma_x_mm", "sigma_y_mm")


class Interval(Record):
    """A median with its interval."""

    median: float
    low: float
    high: float
    mc_error: float  #: Monte-Carlo error of the interval's ends.


class SizeAnswer(Record):
    """What one setting says."""

    reason: str  #: Why there is no number; empty where there is one.
    detected_probability: Annotated[float, Meta(ge=0, le=1)] | None
    method: str  #: The method that drew.
    quantities: dict[str, Interval]
    """Medians and 95 % intervals, mm: max_size_mm, sigma_x_mm, sigma_y_mm; of a forward model also amplitude, and
    element_mm of its mesh."""
    variance_share: dict[str, float]  #: Percent of the variance of ln(largest size) by source.

    @property
    def reported(self) -> Interval | None:
        """The largest size; without a calibration the width across the head, without an estimate None."""
        return self.quantities.get(SIZE, self.quantities.get(WIDTHS[0]))

    @property
    def half_width_mm(self) -> float | None:
        """Half the width of the reported interval; None where there is none."""
        found = self.reported
        return None if found is None else 0.5 * (found.high - found.low)


class Unconverged(SizeAnswer):
    """An answer without numbers because no method converged."""


def no_number(reason: str, probability: float | None = None, *, converged: bool = True) -> SizeAnswer:
    """An answer without numbers, with the probability of a lump where that could be tested."""
    kind = SizeAnswer if converged else Unconverged
    return kind(reason, probability, "", {}, {})


def answer_of(estimate: Estimate, *, probability: float) -> SizeAnswer:
    """An estimate as its reported numbers, with intervals of the given probability."""
    if estimate.map_posterior is None or estimate.draws is None:
        return no_number(estimate.reason, estimate.probability, converged=estimate.code != "method")
    replicates = estimate.draws.replicates
    found = {
        name: summarise(getattr(estimate.map_posterior, name), probability=probability, replicates=replicates)
        for name in WIDTHS
    }
    if estimate.size is not None:
        found[SIZE] = estimate.size.summarise(SIZE, probability=probability)
    shares = {} if estimate.size is None else estimate.size.variance_share
    return SizeAnswer("", estimate.probability, estimate.draws.method, intervals(found), shares)


def intervals(found: Mapping[str, Quantity]) -> dict[str, Interval]:
    """Of summaries what a trade-off reports."""
    return {name: Interval(one.median, one.low, one.high, one.mc_error) for name, one in found.items()}


Distances = tuple[float | None, float | None, float | None]


def distances(answers: Sequence[SizeAnswer], reference: SizeAnswer | None) -> Distances:
    """How far answers lie from a reference, mm: the reported median, the ends of its interval, and those of the widths.

    Root mean squares over answers and ends; None where one of them, or the reference, has no number of the same kind.
    """
    if reference is None or reference.reported is None or not answers:
        return None, None, None
    if any(one.quantities.keys() != reference.quantities.keys() for one in answers):
        return None, None, None
    name, widths = SIZE if SIZE in reference.quantities else WIDTHS[0], [x for x in WIDTHS if x in reference.quantities]

    def apart(names: Sequence[str], ends: Sequence[str]) -> float:
        pairs = [(one.quantities[name], reference.quantities[name]) for one in answers for name in names]
        gaps = [getattr(ours, end) - getattr(theirs, end) for ours, theirs in pairs for end in ends]
        return float(np.sqrt(np.mean(np.square(gaps))))

    return apart([name], ["median"]), apart([name], ["low", "high"]), apart(widths, ["low", "high"])


# --- Settings with what each costs and answers, against one reference; the frontier, and which setting is enough.

Clock = Callable[[], float]
Seconds = Annotated[dict[str, float], described("CPU seconds by part.")]
WORTH = 0.8  #: A setting that takes more than this share of the default's time is not worth a choice.
MOST_S = 4.0  #: CPU seconds after which a setting is not run again: its least time is known well enough.


class Work(Record):
    """How a study is run."""

    clock: Clock  #: CPU seconds so far.
    tolerance_mm: float  #: See `Ladder`.
    runs: int = 3  #: Of each setting: times are the least of them, distances their root mean square.
    announce: Callable[[float], None] = lambda _seconds: None
    """Called once, when the default has been timed, with about how many CPU seconds the rest will take."""
    progress: Progress = no_progress  #: Called with settings done and in all.
    seed: int = 1  #: Of the random numbers.
    probability: float = INTERVAL  #: Of the intervals.


How = TypeVar("How")


class Choice(Record, Generic[How]):
    """A setting to be tried."""

    axis: str  #: What is varied.
    label: str  #: The setting in a few words; an option of the command line where there is one.
    how: How  #: Options of the estimate, or of the map.
    weight: float = 1.0  #: About how many times the default's CPU time it takes, for a forecast.
    default: bool = False  #: Whether this is what the program does by itself.
    usable: bool = True
    """Whether a user can choose it to save or to spend time; other rows show what the answer depends on."""


class Priced(Record):
    """One setting, its cost and its distance from the reference."""

    axis: str
    label: str = field(name="setting")
    default: bool
    usable: bool  #: Whether it may be chosen to save time; other settings are another model or less data.
    runs: Annotated[int, Meta(ge=1)]
    cpu_s: Seconds
    median_off_mm: float | None
    ends_off_mm: float | None  #: Root mean square over runs and both ends of the reported interval.
    width_ends_off_mm: float | None
    answer: SizeAnswer  #: The first run's.
    frontier: bool  #: No other setting is quicker and nearer at once.

    @property
    def seconds(self) -> float:
        """CPU time of all parts, of the run that took least."""
        return sum(self.cpu_s.values())


class Reference(Record):
    """What the settings are compared with."""

    words: str
    mc_error_mm: float | None
    half_width_mm: float | None
    cpu_s: float
    answer: SizeAnswer | None


def reference_of(words: str, answer: SizeAnswer | None, cpu_s: float) -> Reference:
    """A reference with the half width of its reported interval and the Monte-Carlo error of its ends."""
    if answer is None or answer.reported is None:
        return Reference(words, None, None, cpu_s, answer)
    return Reference(words, answer.reported.mc_error, answer.half_width_mm, cpu_s, answer)


class PooledRow(Record):
    """The size by the first few maps of a mass."""

    maps: Annotated[int, Meta(ge=1)]
    cpu_s: float  #: Of their estimates and of pooling.
    answer: SizeAnswer
    another_half_width_mm: float | None  #: Half width of the interval of another exam, mm.


class Ladder(Record):
    """All settings of a study."""

    rows: tuple[Priced, ...]  #: In the order of the table.
    reference: Reference  #: What they are compared with.
    tolerance_mm: float  #: Distance of interval ends below which more is not worth its cost.
    shared_cpu_s: dict[str, float] = field(default_factory=dict)
    """What every setting needs besides, by name, such as reading the file or starting the program."""
    pooled: tuple[PooledRow, ...] = ()
    """The size by the first map of one mass, by the first two, and so on; empty where one was given."""
    notes: tuple[str, ...] = ()  #: What else matters for the choice, in sentences.

    @property
    def default(self) -> Priced:
        """What the program does by itself."""
        return next(one for one in self.rows if one.default)

    def enough(self) -> Priced | None:
        """The cheapest usable setting within the tolerance, or the default where that costs hardly more."""
        within = [one for one in self.rows if one.usable and not self.beyond(one) and one.ends_off_mm is not None]
        if not within:
            return None
        best = min(within, key=lambda one: one.seconds)
        return self.default if self.default in within and best.seconds > WORTH * self.default.seconds else best

    def beyond(self, one: Priced) -> bool:
        """Whether a setting's interval ends are further off than the tolerance."""
        return one.ends_off_mm is not None and one.ends_off_mm > self.tolerance_mm

    def frontier(self) -> list[Priced]:
        """The settings that no other beats in time and distance at once, the cheapest first."""
        found: list[Priced] = []
        least = math.inf
        known = [(one.seconds, one.ends_off_mm, one) for one in self.rows if one.ends_off_mm is not None]
        for _, off, one in sorted(known, key=lambda each: each[:2]):
            if off < least:
                found.append(one)
                least = off
        return found


Run = Callable[[How, int], tuple[dict[str, float], SizeAnswer]]
"""From a setting and the number of the run, which seeds its random numbers, to CPU seconds by part, and the answer."""


def priced(one: Choice[How], run: Run[How], reference: Reference, *, runs: int) -> Priced:
    """Run a setting so often, or twice where that took `MOST_S`, and compare its answers with the reference."""
    spent: list[dict[str, float]] = []
    answers: list[SizeAnswer] = []
    for number in range(runs):
        seconds, answer = run(one.how, number)
        spent.append(seconds)
        answers.append(answer)
        # the first run also imports: a second one is worth its wait
        if number >= 1 and sum(sum(parts.values()) for parts in spent) > MOST_S:
            break
    least, off = min(spent, key=lambda parts: sum(parts.values())), distances(answers, reference.answer)
    return Priced(one.axis, one.label, one.default, one.usable, len(answers), least, *off, answers[0], False)


def climbed(
    choices: Sequence[Choice[How]],
    run: Run[How],
    reference: Callable[[], Reference],
    work: Work,
    *,
    worth: Callable[[SizeAnswer], Sequence[Choice[How]]] | None = None,
) -> Ladder:
    """Say how long it takes, make the reference and price every setting.

    `worth` says which settings can make a difference where the default gives an answer; without it all are tried.
    """
    default = next(one.how for one in choices if one.default)
    run(default, 0)  # twice: imports and first calls cost nothing afterwards
    seconds, answer = run(default, 0)
    choices = choices if worth is None else worth(answer)
    work.announce(sum(seconds.values()) * (4.0 + work.runs * sum(one.weight for one in choices)))
    made, rows = reference(), []
    for number, one in enumerate(choices, start=1):
        rows.append(priced(one, run, made, runs=work.runs))
        work.progress(number, len(choices))
    ladder = Ladder(tuple(rows), made, work.tolerance_mm)
    best = set(map(id, ladder.frontier()))
    return replace(ladder, rows=tuple(replace(one, frontier=id(one) in best) for one in rows))


# --- Cost of accuracy on one map: whole estimates at many settings against a long run of the default's posterior.

LONG_RUNS = (("importance", 0.003), ("importance", 0.01), ("ensemble", 0.05), ("ensemble", 0.1))
"""Methods and accuracies (SD) of the reference: the first that converges."""
ACCURACIES_SD = (0.05, 0.01, 0.005)
CHAIN_ACCURACIES_SD = (0.05,)
LAPLACE_DRAWS = (400, 16000)
FIELDS = (8, 12, 18, 24, 30, MOST_FIELD_COSINES)
RADII_MM = (8.0, 12.0, 16.0, 20.0, 25.0, 30.0)
METHOD, ACCURACY, FIELD, WINDOW = "method", "draws", "noise field", "fit window"


Setting = Choice[SamplerSettings]


def settings_of(options: SamplerSettings, *, level_known: bool) -> list[Setting]:
    """Everything that is tried, the default, what `estimate` takes by itself for this map, first.

    `level_known` is whether the map has a background that the paper's least squares can be fixed at.
    """
    found = [Setting(METHOD, f"--method {options.method}", options, default=True)]
    if options.method != "optimise":
        level: Background = "fixed" if level_known else "free"
        # another model: no noise field, no prior
        plain = replace(
            options, method="optimise", scene="auto", accuracy_mm=None, noise="independent", background=level
        )
        found.append(Setting(METHOD, "--method optimise", plain, 0.5, usable=False))
    for method, weight in (("laplace", 1.0), ("importance", 1.0), ("ensemble", 8.0)):
        if method != options.method:
            found.append(Setting(METHOD, f"--method {method}", _by(options, method), weight))
    for number in LAPLACE_DRAWS if options.correlated else ():
        drawn = replace(_by(options, "laplace"), draws=number)
        found.append(Setting(ACCURACY, f"laplace, {number} draws", drawn, usable=False))
    for accuracy in ACCURACIES_SD:
        drawn = _by(options, "importance", accuracy)
        found.append(Setting(ACCURACY, f"--accuracy-sd {accuracy:g}", drawn, 1.0 + 0.005 / accuracy))
    for accuracy in CHAIN_ACCURACIES_SD if options.correlated else ():
        drawn = _by(options, "ensemble", accuracy)
        found.append(Setting(ACCURACY, f"--method ensemble --accuracy-sd {accuracy:g}", drawn, 25.0))
    for number in FIELDS if options.correlated else ():
        finer, weight = replace(options, field_cosines=number), max(0.7, (number / 18.0) ** 3.2)
        found.append(Setting(FIELD, f"field_cosines {number}", finer, weight, usable=False))
    for radius in RADII_MM:
        if radius != options.fit_radius_mm:
            other = replace(options, fit_radius_mm=radius)
            found.append(Setting(WINDOW, f"fit_radius_mm {radius:g}", other, usable=False))
    return found


def worth_trying(settings: list[Setting], answer: SizeAnswer) -> list[Setting]:
    """The settings that can make a difference where the default gives this answer.

    Without draws their number plays no part. Where the default has fallen through to chains, noise fields and windows
    are tried by laplace: chains for each would take minutes.
    """
    if answer.reported is None and not isinstance(answer, Unconverged):
        kept = [one for one in settings if one.axis != ACCURACY]
        return [replace(one, weight=min(one.weight, 1.0)) if one.axis == METHOD else one for one in kept]
    default = settings[0].how
    if answer.method != "ensemble" or default.method == "ensemble":
        return settings
    return [settings[0], *map(_beside_chains, settings[1:])]


def _beside_chains(one: Setting) -> Setting:
    """A setting with a weight against chains; by laplace if it is another model."""
    if one.how.method == "ensemble":
        return replace(one, weight=one.weight / 8.0)
    if one.axis in (FIELD, WINDOW):
        return replace(one, label=f"{one.label}, laplace", how=_by(one.how, "laplace"), weight=0.05 * one.weight)
    return replace(one, weight=0.2 * one.weight)


def _by(options: SamplerSettings, method: Any, accuracy_sd: float | None = None) -> SamplerSettings:
    """The options with another method, which stands for itself: where it fails no other one is tried."""
    return replace(options, method=method, accuracy_sd=accuracy_sd, accuracy_mm=None, step_up=False)


class Estimator(Record):
    """Estimates of one map, seeded by the map and the number of the run."""

    tactile_map: TactileMap
    calibration: Calibration | None  #: From widths to sizes; None stops at widths.
    work: Work

    def run(self, options: SamplerSettings, number: int) -> tuple[dict[str, float], SizeAnswer]:
        """A whole estimate, from the map to the size.

        The calibration counts as learned from maps fitted as the options say: `estimate` refuses a size from a map
        fitted in another way, and here it is wanted, to see how far off it would be.
        """
        calibration = self.calibration
        if calibration is not None:
            used = {"background": options.background, "radius_mm": options.fit_radius_mm, "noise": options.noise}
            calibration = replace(calibration, recipe=replace(calibration.recipe, **used))
        rng = np.random.default_rng([self.work.seed, number, self.tactile_map.fingerprint])
        begun = self.work.clock()
        try:
            found = estimate_map(self.tactile_map, calibration=calibration, options=options, rng=rng)
            answer = answer_of(found, probability=self.work.probability)
        except NotConvergedError as error:
            answer = no_number(str(error), converged=False)
        return {"estimate": self.work.clock() - begun}, answer

    def reference(self, options: SamplerSettings) -> Reference:
        """The same posterior by the first long run that converges; without one, or without a lump, no answer."""
        spent, why = 0.0, ""
        for method, accuracy in LONG_RUNS:
            seconds, answer = self.run(_by(options, method, accuracy), -1 % 2**32)
            spent, why = spent + seconds["estimate"], answer.reason
            if answer.reported is not None:
                name = "importance sampling" if method == "importance" else "MCMC (four ensembles)"
                words = f"{name} of the default's posterior, asked for {accuracy:g} SD"
                return reference_of(words, answer, spent)
            if not isinstance(answer, Unconverged):  # no draws are made, so none can be more exact
                break
        return reference_of(f"none: {why}", None, spent)


def measure(
    tactile_map: TactileMap, *, calibration: Calibration | None, options: SamplerSettings, work: Work
) -> Ladder:
    """Run every setting on one map, from the calibration and options that `estimate` takes by itself for it."""
    estimator = Estimator(tactile_map, calibration, work)
    settings = settings_of(options, level_known=tactile_map.background is not None)
    return climbed(
        settings, estimator.run, lambda: estimator.reference(options), work, worth=partial(worth_trying, settings)
    )
