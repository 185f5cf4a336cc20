"""Trade-off of CPU time against accuracy: how any is measured, and that of an estimate."""

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

# --- The reported numbers of one setting, and their distance from a reference.

SIZE = "max_size_mm"
WIDTHS = ("sigma_x_mm", "sigma_y_mm")


class IntervalWithError(Record):
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
    quantities: dict[str, IntervalWithError]
    """Medians and 95 % intervals, mm: max_size_mm, sigma_x_mm, sigma_y_mm; of a forward model also amplitude, and
    element_mm of its mesh."""
    variance_share: dict[str, float]  #: Percent of the variance of ln(largest size) by source.

    @property
    def reported(self) -> IntervalWithError | None:
        """The largest size; without a calibration the width across the head, without an estimate None."""
        return self.quantities.get(SIZE, self.quantities.get(WIDTHS[0]))

    @property
    def half_width_mm(self) -> float | None:
        """Half the width of the reported interval; None without one."""
        reported = self.reported
        return None if reported is None else 0.5 * (reported.high - reported.low)


class Unconverged(SizeAnswer):
    """An answer without numbers, because no method converged."""


def answer_without_number(reason: str, probability: float | None = None, *, converged: bool = True) -> SizeAnswer:
    """An answer without numbers; with the probability of a lump where that could be tested."""
    kind = SizeAnswer if converged else Unconverged
    return kind(reason, probability, "", {}, {})


def answer_of(estimate: Estimate, *, probability: float) -> SizeAnswer:
    """The reported numbers of an estimate, with intervals of the given probability."""
    if estimate.map_posterior is None or estimate.draws is None:
        return answer_without_number(estimate.reason, estimate.probability, converged=estimate.code != "method")
    replicates = estimate.draws.replicates
    quantities = {
        name: summarise(getattr(estimate.map_posterior, name), probability=probability, replicates=replicates)
        for name in WIDTHS
    }
    if estimate.size is not None:
        quantities[SIZE] = estimate.size.summarise(SIZE, probability=probability)
    shares = {} if estimate.size is None else estimate.size.variance_share
    return SizeAnswer("", estimate.probability, estimate.draws.method, intervals(quantities), shares)


def intervals(quantities: Mapping[str, Quantity]) -> dict[str, IntervalWithError]:
    """Summaries as a trade-off reports them."""
    return {
        name: IntervalWithError(quantity.median, quantity.low, quantity.high, quantity.mc_error)
        for name, quantity in quantities.items()
    }


Distances = tuple[float | None, float | None, float | None]


def distances(answers: Sequence[SizeAnswer], reference: SizeAnswer | None) -> Distances:
    """Distances from a reference, mm: of the reported median, of the ends of its interval, and of those of the widths.

    Root mean squares over answers and ends; None where an answer or the reference lacks a number.
    """
    if reference is None or reference.reported is None or not answers:
        return None, None, None
    if any(answer.quantities.keys() != reference.quantities.keys() for answer in answers):
        return None, None, None
    name, widths = SIZE if SIZE in reference.quantities else WIDTHS[0], [x for x in WIDTHS if x in reference.quantities]

    def distance(names: Sequence[str], ends: Sequence[str]) -> float:
        pairs = [(answer.quantities[name], reference.quantities[name]) for answer in answers for name in names]
        gaps = [getattr(ours, end) - getattr(theirs, end) for ours, theirs in pairs for end in ends]
        return float(np.sqrt(np.mean(np.square(gaps))))

    return distance([name], ["median"]), distance([name], ["low", "high"]), distance(widths, ["low", "high"])


# --- Settings with their cost and answer, against one reference; the frontier, and the cheapest sufficient setting.

Clock = Callable[[], float]
Seconds = Annotated[dict[str, float], described("CPU seconds by part.")]
WORTHWHILE_SHARE = 0.8  #: A setting that takes more than this share of the default's time saves too little.
MOST_CPU_S = 4.0  #: CPU seconds after which a setting is not run again: its least time is known well enough.


class StudyRun(Record):
    """How a trade-off is measured."""

    clock: Clock  #: CPU seconds so far.
    tolerance_mm: float  #: See `Tradeoff`.
    runs: int = 3  #: Runs of each setting; its time is the least of theirs, its distances their root mean square.
    announce: Callable[[float], None] = lambda _seconds: None
    """Called once, when the default has been timed, with a forecast of the CPU seconds of the rest."""
    progress: Progress = no_progress  #: Called with the settings done and in all.
    seed: int = 1  #: Random seed.
    probability: float = INTERVAL  #: Probability of the intervals.


Options = TypeVar("Options")


class Setting(Record, Generic[Options]):
    """A setting to measure."""

    axis: str  #: The property that is varied.
    label: str  #: The setting in a few words; an option of the command line where there is one.
    options: Options  #: Options of the estimate, or of the map.
    weight: float = 1.0  #: Its CPU time over the default's, roughly, for a forecast.
    default: bool = False  #: True for the program's default.
    usable: bool = True
    """True if a user can choose it to save or to spend time; other settings show what the answer depends on."""


class MeasuredSetting(Record):
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


def make_reference(words: str, answer: SizeAnswer | None, cpu_s: float) -> Reference:
    """Reference with the half width of its reported interval and the Monte-Carlo error of its ends."""
    if answer is None or answer.reported is None:
        return Reference(words, None, None, cpu_s, answer)
    return Reference(words, answer.reported.mc_error, answer.half_width_mm, cpu_s, answer)


class PooledRow(Record):
    """The size by the first few maps of a mass."""

    maps: Annotated[int, Meta(ge=1)]
    cpu_s: float  #: Of their estimates and of pooling.
    answer: SizeAnswer
    another_half_width_mm: float | None  #: Half width of the interval of another exam, mm.


class Tradeoff(Record):
    """All settings of a study."""

    rows: tuple[MeasuredSetting, ...]  #: In the order of the table.
    reference: Reference  #: What they are compared with.
    tolerance_mm: float  #: Distance of interval ends below which more is not worth its cost.
    shared_cpu_s: dict[str, float] = field(default_factory=dict)
    """What every setting needs besides, by name, such as reading the file or starting the program."""
    pooled: tuple[PooledRow, ...] = ()
    """The size by the first map of one mass, by the first two, and so on; empty where one was given."""
    notes: tuple[str, ...] = ()  #: What else matters for the choice, in sentences.

    @property
    def default(self) -> MeasuredSetting:
        """The program's default."""
        return next(row for row in self.rows if row.default)

    def cheapest_sufficient(self) -> MeasuredSetting | None:
        """The cheapest usable setting within the tolerance, or the default where that costs hardly more."""
        within = [row for row in self.rows if row.usable and row.ends_off_mm is not None]
        within = [row for row in within if not self.exceeds_tolerance(row)]
        if not within:
            return None
        best = min(within, key=lambda one: one.seconds)
        saves_little = best.seconds > WORTHWHILE_SHARE * self.default.seconds
        return self.default if saves_little and self.default in within else best

    def exceeds_tolerance(self, one: MeasuredSetting) -> bool:
        """True if a setting's interval ends are further off than the tolerance."""
        return one.ends_off_mm is not None and one.ends_off_mm > self.tolerance_mm

    def frontier(self) -> list[MeasuredSetting]:
        """The settings that no other beats in time and distance at once, the cheapest first."""
        frontier: list[MeasuredSetting] = []
        least = math.inf
        measured = [(row.seconds, row.ends_off_mm, row) for row in self.rows if row.ends_off_mm is not None]
        for _, off, row in sorted(measured, key=lambda each: each[:2]):
            if off < least:
                frontier.append(row)
                least = off
        return frontier


Run = Callable[[Options, int], tuple[dict[str, float], SizeAnswer]]
"""Runs a setting: from its options and the number of the run, which seeds it, to CPU seconds by part and the answer."""


def measure_setting(one: Setting[Options], run: Run[Options], reference: Reference, *, runs: int) -> MeasuredSetting:
    """Run a setting `runs` times, or twice where that took `MOST_CPU_S`, and compare its answers with the reference."""
    spent: list[dict[str, float]] = []
    answers: list[SizeAnswer] = []
    for number in range(runs):
        seconds, answer = run(one.options, number)
        spent.append(seconds)
        answers.append(answer)
        # the first run also imports: a second one is worth its wait
        if number >= 1 and sum(sum(parts.values()) for parts in spent) > MOST_CPU_S:
            break
    least, off = min(spent, key=lambda parts: sum(parts.values())), distances(answers, reference.answer)
    return MeasuredSetting(one.axis, one.label, one.default, one.usable, len(answers), least, *off, answers[0], False)


def run_tradeoff(
    choices: Sequence[Setting[Options]],
    run: Run[Options],
    reference: Callable[[], Reference],
    work: StudyRun,
    *,
    relevant: Callable[[SizeAnswer], Sequence[Setting[Options]]] | None = None,
) -> Tradeoff:
    """Forecast the time, make the reference and measure every setting.

    `relevant` returns the settings that can make a difference beside the default's answer; without it all are measured.
    """
    default = next(choice.options for choice in choices if choice.default)
    run(default, 0)  # run twice: the first run also imports
    seconds, answer = run(default, 0)
    choices = choices if relevant is None else relevant(answer)
    work.announce(sum(seconds.values()) * (4.0 + work.runs * sum(one.weight for one in choices)))
    compared_with, rows = reference(), []
    for number, one in enumerate(choices, start=1):
        rows.append(measure_setting(one, run, compared_with, runs=work.runs))
        work.progress(number, len(choices))
    tradeoff = Tradeoff(tuple(rows), compared_with, work.tolerance_mm)
    best = set(map(id, tradeoff.frontier()))
    return replace(tradeoff, rows=tuple(replace(row, frontier=id(row) in best) for row in rows))


# --- Cost of accuracy on one map: whole estimates at many settings against a long run of the default's posterior.

LONG_RUNS = (("importance", 0.003), ("importance", 0.01), ("ensemble", 0.05), ("ensemble", 0.1))
"""Methods and accuracies (SD) of the reference: the first that converges."""
ACCURACIES_SD = (0.05, 0.01, 0.005)
CHAIN_ACCURACIES_SD = (0.05,)
LAPLACE_DRAWS = (400, 16000)
FIELDS = (8, 12, 18, 24, 30, MOST_FIELD_COSINES)
RADII_MM = (8.0, 12.0, 16.0, 20.0, 25.0, 30.0)
METHOD, ACCURACY, FIELD, WINDOW = "method", "draws", "noise field", "fit window"

EstimateSetting = Setting[SamplerSettings]


def settings_of(options: SamplerSettings, *, level_known: bool) -> list[EstimateSetting]:
    """Settings to measure; the default, which `estimate` chooses for this map, comes first.

    `level_known`: the map has a background at which the paper's least squares can be fixed.
    """
    settings = [EstimateSetting(METHOD, f"--method {options.method}", options, default=True)]
    if options.method != "optimise":
        level: Background = "fixed" if level_known else "free"
        # another model: no noise field, no prior
        plain = replace(_with_method(options, "optimise"), scene="auto", noise="independent", background=level)
        settings.append(EstimateSetting(METHOD, "--method optimise", plain, 0.5, usable=False))
    for method, weight in (("laplace", 1.0), ("importance", 1.0), ("ensemble", 8.0)):
        if method != options.method:
            settings.append(EstimateSetting(METHOD, f"--method {method}", _with_method(options, method), weight))
    for number in LAPLACE_DRAWS if options.correlated else ():
        drawn = replace(_with_method(options, "laplace"), draws=number)
        settings.append(EstimateSetting(ACCURACY, f"laplace, {number} draws", drawn, usable=False))
    for accuracy in ACCURACIES_SD:
        drawn = _with_method(options, "importance", accuracy)
        settings.append(EstimateSetting(ACCURACY, f"--accuracy-sd {accuracy:g}", drawn, 1.0 + 0.005 / accuracy))
    for accuracy in CHAIN_ACCURACIES_SD if options.correlated else ():
        drawn = _with_method(options, "ensemble", accuracy)
        settings.append(EstimateSetting(ACCURACY, f"--method ensemble --accuracy-sd {accuracy:g}", drawn, 25.0))
    for number in FIELDS if options.correlated else ():
        finer, weight = replace(options, field_cosines=number), max(0.7, (number / 18.0) ** 3.2)
        settings.append(EstimateSetting(FIELD, f"field_cosines {number}", finer, weight, usable=False))
    for radius in RADII_MM:
        if radius != options.fit_radius_mm:
            resized = replace(options, fit_radius_mm=radius)
            settings.append(EstimateSetting(WINDOW, f"fit_radius_mm {radius:g}", resized, usable=False))
    return settings


def relevant_settings(settings: list[EstimateSetting], answer: SizeAnswer) -> list[EstimateSetting]:
    """The settings that can make a difference where the default gives this answer.

    Without draws, the settings of their number are left out. Where the default has resorted to chains, noise fields and
    windows are measured by laplace: chains for each would take minutes.
    """
    if answer.reported is None and not isinstance(answer, Unconverged):
        without_accuracy = [setting for setting in settings if setting.axis != ACCURACY]
        return [replace(one, weight=min(one.weight, 1.0)) if one.axis == METHOD else one for one in without_accuracy]
    default = settings[0].options
    if answer.method != "ensemble" or default.method == "ensemble":
        return settings
    return [settings[0], *map(_beside_chains, settings[1:])]


def _beside_chains(one: EstimateSetting) -> EstimateSetting:
    """A setting with a weight against chains; by laplace if it is another model."""
    if one.options.method == "ensemble":
        return replace(one, weight=one.weight / 8.0)
    if one.axis in (FIELD, WINDOW):
        by_laplace = _with_method(one.options, "laplace")
        return replace(one, label=f"{one.label}, laplace", options=by_laplace, weight=0.05 * one.weight)
    return replace(one, weight=0.2 * one.weight)


def _with_method(options: SamplerSettings, method: Any, accuracy_sd: float | None = None) -> SamplerSettings:
    """The options with another method, after which no other one is tried if it fails."""
    return replace(options, method=method, accuracy_sd=accuracy_sd, accuracy_mm=None, step_up=False)


class MapEstimator(Record):
    """Estimates of one map, seeded by the map and the number of the run."""

    tactile_map: TactileMap
    calibration: Calibration | None  #: Calibration from widths to sizes; None for an estimate without sizes.
    work: StudyRun

    def run(self, options: SamplerSettings, number: int) -> tuple[dict[str, float], SizeAnswer]:
        """Estimate the map, up to the size.

        The calibration's recipe is replaced by the options': `estimate` refuses a size from a map that was fitted in
        another way, but here that size shows how far off it would be.
        """
        calibration = self.calibration
        if calibration is not None:
            recipe = {"background": options.background, "radius_mm": options.fit_radius_mm, "noise": options.noise}
            calibration = replace(calibration, recipe=replace(calibration.recipe, **recipe))
        rng = np.random.default_rng([self.work.seed, number, self.tactile_map.fingerprint])
        begun = self.work.clock()
        try:
            estimate = estimate_map(self.tactile_map, calibration=calibration, options=options, rng=rng)
            answer = answer_of(estimate, probability=self.work.probability)
        except NotConvergedError as error:
            answer = answer_without_number(str(error), converged=False)
        return {"estimate": self.work.clock() - begun}, answer

    def reference(self, options: SamplerSettings) -> Reference:
        """Reference from the first long run of the same posterior that converges; without an answer if none does."""
        spent, why = 0.0, ""
        for method, accuracy in LONG_RUNS:
            seconds, answer = self.run(_with_method(options, method, accuracy), -1 % 2**32)
            spent, why = spent + seconds["estimate"], answer.reason
            if answer.reported is not None:
                name = "importance sampling" if method == "importance" else "MCMC (four ensembles)"
                words = f"{name} of the default's posterior, asked for {accuracy:g} SD"
                return make_reference(words, answer, spent)
            if not isinstance(answer, Unconverged):  # no draws are made, so a longer run changes nothing
                break
        return make_reference(f"none: {why}", None, spent)


def measure(
    tactile_map: TactileMap, *, calibration: Calibration | None, options: SamplerSettings, work: StudyRun
) -> Tradeoff:
    """Measure every setting on one map; `calibration` and `options` are those that `estimate` chooses for it."""
    estimator = MapEstimator(tactile_map, calibration, work)
    settings = settings_of(options, level_known=tactile_map.background is not None)
    return run_tradeoff(
        settings,
        estimator.run,
        lambda: estimator.reference(options),
        work,
        relevant=partial(relevant_settings, settings),
    )
