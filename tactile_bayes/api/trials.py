"""A trial from its tables to its report, and a trial planned."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from functools import partial
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from tactile_bayes.api.arguments import PathLike, TextResult, dataframe, list_of, path_of, plain, table_of, takes
from tactile_bayes.batch import open_executor, run_batch
from tactile_bayes.declarations import EXACT, Record, as_dict, names_of, replace, to_plain
from tactile_bayes.errors import BadDataError, UsageError
from tactile_bayes.files.atomic import write_text
from tactile_bayes.files.column_map import read_mapping, read_wide, read_wide_excision
from tactile_bayes.files.documents import dump_json, read_protocol
from tactile_bayes.files.provenance import Provenance, hash_inputs
from tactile_bayes.files.tables import Sheet, Table, read_table
from tactile_bayes.findings import capitalised
from tactile_bayes.options import MOST_PATIENTS, Aim, PlanErrors, PlanOptions, TrialSettings
from tactile_bayes.presets import INTERVAL, RESEARCH_USE
from tactile_bayes.progress import Progress, no_progress
from tactile_bayes.report.pages import Growth, PageFiles
from tactile_bayes.report.trial import DIGITS, plan_text, trial_text
from tactile_bayes.report.trial_html import plan_figure, trial_html
from tactile_bayes.trial import planning
from tactile_bayes.trial.figures import MIN_PATIENTS, Intervals, UndefinedError
from tactile_bayes.trial.next_mass import next_mass
from tactile_bayes.trial.readings import Trial, at_excision, readings_from_columns
from tactile_bayes.trial.summary import TrialReport, summarise

if TYPE_CHECKING:
    import pandas


# --- Analysis of a trial from its tables: errors, lines, agreement and calibration of each modality.

_FROM_FILES: Final = (
    "Intervals from the column posterior are those of max_size_mm: without --repeatability for exams as alike as "
    "simulated ones, narrower than the interval that `estimate` leads with"
)


class TrialResult(TextResult, eq=False):
    """How each modality's sizes compare with excision."""

    report: TrialReport  #: What the file of ``validate --json`` holds.
    trial: Trial  #: What it was made from.

    @property
    def document(self) -> dict[str, Any]:
        """The document that ``validate --json`` prints."""
        return dict(to_plain(self.report, digits=DIGITS))

    @property
    def text(self) -> str:
        """The text that ``validate --methods`` prints."""
        return self.text_with(methods=True)

    def text_with(self, *, methods: bool) -> str:
        """The report as text, with or without the table of methods."""
        notes = [*self.trial.other_visits.lines(), *([_FROM_FILES] if "posterior_1" in self.trial.files else [])]
        return trial_text(self.report, notes=notes, methods=methods)

    def write_json(self, path: Path, *, force: bool = False) -> None:
        """Write the file of ``validate -o``."""
        write_text(path, dump_json(self.document), force=force)

    def write_html(
        self, path: Path, *, growth: Sequence[Growth] = (), pdf: Path | None = None, force: bool = False
    ) -> None:
        """Write the page of ``validate --html`` and ``--pdf``, with the growth of masses that have several visits."""
        PageFiles(path, pdf, force).write(trial_html(self.report, self.trial, text=self.text, growth=growth))

    def to_dataframe(self) -> pandas.DataFrame:
        """One row for each modality and figure: value, and the ends of its interval (NaN where it has none)."""
        rows = []
        for modality, figures in self.document["modalities"].items():
            for name, value in figures.items():
                if isinstance(value, int | float):
                    counted = name == "detected"  # the interval beside it is of the share
                    low, high = (None, None) if counted else figures.get(f"{name}_interval") or (None, None)
                    rows.append((modality, name, value, low, high))
        table = dataframe(rows, columns=["modality", "figure", "value", "low", "high"])
        return table.astype({"value": float, "low": float, "high": float})

    def __repr__(self) -> str:
        counts, names = self.report.counts, ", ".join(self.report.modalities)
        return f"<TrialResult {counts.masses} masses of {counts.patients} patients: {names}>"


def settings_by(
    protocol: Path | None, settings: Mapping[str, Any] = {}, *, typed: Collection[str] = ()
) -> tuple[str | None, TrialSettings]:
    """Title and settings of a protocol, if there is one, over those given; refuses typed ones that contradict it."""
    title, fixed = (None, {}) if protocol is None else read_protocol(protocol)
    for name, value in fixed.items():
        if name in typed and settings[name] != value:
            option = f"--{name.replace('_', '-')} {settings[name]}"
            raise UsageError(f"{option} contradicts {protocol}, which fixes {name} = {value}; leave the option out")
    return title, TrialSettings(**{**settings, **fixed})


def analyse(
    trial: Trial, settings: TrialSettings, *, protocol: Path | None = None, title: str | None = None
) -> TrialResult:
    """Analyse a trial; `protocol` and `title` are of the pre-specified analysis, where there is one."""
    intervals = Intervals(INTERVAL, method=settings.intervals, resamples=settings.resamples, seed=settings.seed)
    recorded = {name: value for name, value in as_dict(settings).items() if name != "seed"}
    inputs = hash_inputs(**trial.files, protocol=protocol)
    provenance = Provenance("validate", {"interval_probability": INTERVAL, **recorded}, inputs, seed=settings.seed)
    report = summarise(trial, intervals=intervals, error_ratio=settings.error_ratio, provenance=provenance.as_dict())
    extra: dict[str, Any] = {} if title is None else {"title": title}
    if settings.bayes:
        extra["next_mass"] = next_mass(trial, rng=np.random.default_rng(settings.seed))
    return TrialResult(replace(report, **extra), trial)


# --- Input of `validate` and `plan`: the tables of a trial, tidy or wide, and the estimates that they name.


def load_trial(trial: Path | Sheet, excision: Path | Sheet, columns: Path | None, *, tidy_trial: bool = False) -> Trial:
    """Read and check both tables.

    `columns` is the mapping file of a wide table; one without ``[[reading]]`` is for the excision sizes alone. A
    `tidy_trial` is tidy whatever the mapping holds.
    """
    sizes = read_excision(excision, columns)
    mapping = None if columns is None or tidy_trial else read_mapping(columns)
    if mapping is None or mapping.reading is None or isinstance(trial, Sheet):
        table = read_table(trial, "trial.table.json")
    else:
        table = read_wide(trial, mapping, mapping.reading)
    columns_filled: Mapping[str, list[Any]] = table.columns
    posteriors: list[Path] = []
    if any(columns_filled.get("posterior", ())):
        from tactile_bayes.files.estimate_json import fill_from_posteriors  # h5py and the estimates' declarations

        columns_filled, posteriors = fill_from_posteriors(table)
    extents = zip(sizes.columns["ex_vivo_mm"], sizes.columns["ex_vivo_second_mm"], strict=True)
    for row, (largest_mm, across_mm) in enumerate(extents):
        if across_mm is not None and across_mm > largest_mm:
            problem = f"is {across_mm:g}, above ex_vivo_mm {largest_mm:g}, which is the largest extent"
            raise sizes.error(row, "ex_vivo_second_mm", problem, way_out="exchange or correct them")
    keys = list(zip(sizes.columns["patient"], sizes.columns["mass"], strict=True))
    ex_vivo_mm = dict(zip(keys, sizes.columns["ex_vivo_mm"], strict=True))
    readings = readings_from_columns(columns_filled, fault=table.error)
    for row, reading in enumerate(readings):
        if reading.key not in ex_vivo_mm and reading.status != "not_done":
            what = f"{reading.key[0]!r} + {reading.key[1]!r} has no size in {sizes.path}"
            way_out = "add it there, correct the key, or leave its readings out"
            raise table.error(row, "patient + mass", what, way_out=way_out)
    excised_on = dict(zip(keys, sizes.columns["date"], strict=True))
    analysed, other_visits = at_excision(readings, excised_on, fault=table.error)
    tables = {"trial": trial, "excision": excision, "columns": columns}
    files = {role: path for role, path in tables.items() if isinstance(path, Path)}
    return Trial(
        readings=[one for one in analysed if one.key in ex_vivo_mm],  # of a patient who withdrew, none was done
        other_visits=other_visits,
        ex_vivo_mm=ex_vivo_mm,
        ex_vivo_sd_mm=dict(zip(keys, sizes.columns["sd_mm"], strict=True)),
        files=files | {f"posterior_{number}": path for number, path in enumerate(posteriors, start=1)},
    )


def read_excision(excision: Path | Sheet, columns: Path | None) -> Table:
    """Sizes after excision: from a wide table where the mapping has ``[excision]``, otherwise from a tidy one."""
    mapping = None if columns is None else read_mapping(columns)
    if mapping is None or mapping.excision is None or isinstance(excision, Sheet):
        return read_table(excision, "excision.table.json")
    return read_wide_excision(excision, mapping, mapping.excision)


@takes(TrialSettings)
def validate(
    trial: PathLike | pandas.DataFrame,
    excision: PathLike | pandas.DataFrame,
    *,
    columns: PathLike | None = None,
    **settings: Any,
) -> TrialResult:
    """Compare sizes with excision.

    Parameters
    ----------
    trial
        Readings: patient, mass, modality, replicate, size_mm, status..., a CSV file or a DataFrame.
    excision
        Sizes after excision: patient, mass, ex_vivo_mm...
    columns
        For a wide CSV file: a TOML file that says which column holds which reading.
    **settings
        As of `tactile_bayes.options.TrialSettings`, by default as on the command line.

    Raises
    ------
    BadDataError
        Naming the table, the line (1 is the header), the column, the value and the way out.
    """
    own_settings = TrialSettings(**settings)
    readings, sizes = table_of(trial, "trial"), table_of(excision, "excision")
    if columns is not None and isinstance(readings, Sheet) and isinstance(sizes, Sheet):
        raise UsageError("columns is for wide CSV files, not for DataFrames; rename their columns, or give files")
    return analyse(load_trial(readings, sizes, path_of(columns)), own_settings)


MAPS_OF_AIMS = 3  #: Maps of a mass where the number of patients is asked for, by default.
_ERRORS = names_of(PlanErrors)


class TrialPlan(TextResult, eq=False):
    """Power and widths of intervals of planned trials."""

    report: planning.PlanReport  #: What the file of ``plan -o`` holds.
    doubts: tuple[str, ...] = ()  #: What speaks against the pilot's tables.

    @property
    def document(self) -> dict[str, Any]:
        """The document that ``plan --json`` prints."""
        return dict(to_plain(self.report, digits=EXACT))

    @property
    def text(self) -> str:
        """The text that ``plan`` prints."""
        return "".join(f"{capitalised(doubt)}\n" for doubt in self.doubts) + plan_text(self.report)

    def write_json(self, path: Path, *, force: bool = False) -> None:
        """Write the file of ``plan -o``."""
        write_text(path, dump_json(self.document), force=force)

    def draw(self, path: Path, *, force: bool = False) -> None:
        """Draw the figure of ``plan --figure``."""
        plan_figure(self.report, path, force=force)

    def __repr__(self) -> str:
        first, last = self.report.designs[0], self.report.designs[-1]
        return f"<TrialPlan power {first.power:.2f} ({first.patients} patients) to {last.power:.2f} ({last.patients})>"


class Pilot(Record, eq=False):
    """An earlier trial, whose errors a plan assumes."""

    trial: Trial
    path: Path  #: Of its readings, for error messages; the name of a DataFrame.

    def doubts(self) -> Iterator[str]:
        """Doubts about the tables, a line each."""
        yield from self.trial.other_visits.lines()
        yield from (f"doubtful: {doubt}" for doubt in self.trial.doubts())

    def errors(self, against: str, stated: Mapping[str, float]) -> dict[str, float]:
        """Errors of ln size: the stated ones, else the pilot's."""
        sizes = self.trial.sizes()
        for name in ("tactile", against):
            if name not in sizes:
                way_out = f"it has {', '.join(sizes)}; choose one with --against"
                raise BadDataError(f"holds no readings by {name}", way_out=way_out, path=str(self.path))
        errors = planning.pilot_errors(sizes["tactile"], sizes[against], map_sd=stated.get("map_sd"))
        if errors is None:
            way_out = "give the errors by options"
            what = f"has fewer than 3 masses found by tactile, or fewer than 3 by {against}"
            raise BadDataError(what, way_out=way_out, path=str(self.path))
        if "map_sd" not in errors:
            what = "has no mass with two tactile readings, so the SD of single maps is unknown"
            raise BadDataError(what, way_out="give it with --map-sd", path=str(self.path))
        return {**errors, **stated}


def read_pilot(pilot: Path | Sheet | None, excision: Path | Sheet | None, against: str | None) -> Pilot | None:
    """Read a pilot's tables, None without one; refuses what goes only with one, and a pilot without its excision."""
    if pilot is None:
        for name, value in (("excision", excision), ("against", against)):
            if value is not None:
                raise UsageError(f"--{name} says how a pilot is read; give --pilot TRIAL.csv, or leave it out")
        return None
    if excision is None:
        raise UsageError("--pilot needs --excision; give the pilot's excision table")
    if against == "tactile":
        raise UsageError("--against tactile compares tactile sizes with themselves; name another modality")
    return Pilot(load_trial(pilot, excision, None), pilot.name if isinstance(pilot, Sheet) else pilot)


@takes(PlanOptions, PlanErrors)
def plan(
    *,
    pilot: PathLike | pandas.DataFrame | None = None,
    excision: PathLike | pandas.DataFrame | None = None,
    progress: Progress = no_progress,
    **options: Any,
) -> TrialPlan:
    """Plan a trial: power, widths of intervals and the worth of more maps, by simulation.

    Parameters
    ----------
    pilot, excision
        Tables of an earlier trial, files or DataFrames: it gives the errors that no keyword states.
    progress
        Called with the numbers of designs done and in all.
    **options
        As of `tactile_bayes.options.PlanOptions` and `PlanErrors`, by default as on the command line. Every pair of
        patients and maps is a design; with a power or a precision `report.needed` holds the patients that reach it.

    Raises
    ------
    BadDataError
        When a table is malformed, or too small to estimate the errors.
    UsageError
        When a value is out of range, or needs a pilot.

    Examples
    --------
    >>> import tactile_bayes as tb
    >>> tb.plan(patients=[24], maps=[3], trials=50).report.designs[0].patients
    24
    """
    values = {name: value for name, value in options.items() if value is not None}
    for name in {"patients", "maps"} & set(values):
        values[name] = tuple(map(plain, list_of(name, values[name], "whole numbers")))
        if not values[name]:
            raise UsageError(f"{name} is empty; give at least one whole number")
    readings = None if pilot is None else table_of(pilot, "pilot")
    sizes = None if excision is None else table_of(excision, "excision")
    return planned(values, read_pilot(readings, sizes, values.get("against")), progress)


def planned(values: Mapping[str, Any], pilot: Pilot | None, progress: Progress) -> TrialPlan:
    """Plan with the stated options and errors, then the pilot's errors, then the defaults."""
    options = PlanOptions(**{name: value for name, value in values.items() if name not in _ERRORS})
    stated = {name: value for name, value in values.items() if name in _ERRORS}
    aims = options.targets
    if aims and "patients" in values:
        raise UsageError("--power and --precision find the number of patients; leave out --patients")
    errors = as_dict(PlanErrors(**stated)) if pilot is None else pilot.errors(options.against, stated)
    files = {} if pilot is None else pilot.trial.files
    inputs = hash_inputs(pilot=files.get("trial"), excision=files.get("excision"))
    unstated: planning.ErrorSource = "default" if pilot is None else "pilot"
    case = partial(planning.PlanCase, **errors, trials=options.trials, seed=options.seed)
    each_maps = (MAPS_OF_AIMS,) if aims and "maps" not in values else sorted(set(options.maps))
    with open_executor(workers=options.workers) as executor:

        def run(cases: Sequence[planning.PlanCase]) -> tuple[planning.Design, ...]:
            outcomes = run_batch(
                planning.simulate_design, cases, key=attrgetter("key"), executor=executor, progress=progress
            )
            for outcome in outcomes:
                if outcome.value is None:
                    raise BadDataError(f"{outcome.key}: {outcome.error}", way_out="change the errors assumed")
            return tuple(outcome.value for outcome in outcomes if outcome.value is not None)

        if aims:
            designs, needed = _needed(each_maps, aims, case, run)
        else:
            pairs = itertools.product(sorted(set(options.patients)), each_maps)
            designs, needed = run([case(patients=patients, maps=number) for patients, number in pairs]), ()
    assumed = {name: float(f"{errors[name]:.9g}") for name in _ERRORS}
    sources: dict[str, planning.ErrorSource] = {name: "option" if name in stated else unstated for name in _ERRORS}
    settings: dict[str, Any] = {"trials": options.trials, "errors": assumed, "errors_from": sources}
    settings |= {str(aim): target for aim, target in aims.items()}
    report = planning.PlanReport(
        schema="tactile-bayes/plan/1",
        errors=assumed,
        errors_from=sources,
        designs=designs,
        gains=() if aims else planning.map_gains(designs),
        needed=needed,
        provenance=Provenance("plan", settings, inputs, seed=options.seed).as_dict(),
        research_use=RESEARCH_USE,
    )
    return TrialPlan(report, () if pilot is None else tuple(pilot.doubts()))


def _needed(
    maps: Sequence[int],
    aims: Mapping[Aim, float],
    case: Callable[..., planning.PlanCase],
    run: Callable[[Sequence[planning.PlanCase]], tuple[planning.Design, ...]],
) -> tuple[tuple[planning.Design, ...], tuple[planning.Needed, ...]]:
    """Simulate designs near the numbers of patients that reach the aims; return them and these numbers."""
    designs: dict[tuple[int, int], planning.Design] = {}
    needed = []
    for number, (aim, target) in itertools.product(maps, aims.items()):
        first = case(patients=MIN_PATIENTS, maps=number)
        try:
            guess = planning.first_guess(first, aim, target)
        except UndefinedError as undefined:
            raise BadDataError(str(undefined), way_out="change the errors assumed") from None
        for _ in range(planning.ROUNDS):
            about = planning.patients_around(guess)
            cases = [case(patients=one, maps=number) for one in about if (number, one) not in designs]
            designs |= {(number, one.patients): one for one in run(cases)}
            answer = planning.patients_needed([designs[number, one] for one in about], aim, target, trials=first.trials)
            if answer is None or about[0] <= answer.patients <= about[-1] or answer.patients == guess:
                break
            guess = answer.patients
        if answer is None or answer.patients >= MOST_PATIENTS:
            what = f"{MOST_PATIENTS} patients do not reach {aim} {target:g} (maps of each mass: {number})"
            raise BadDataError(what, way_out="ask for less, or change the errors assumed")
        needed.append(answer)
    return tuple(designs[key] for key in sorted(designs)), tuple(needed)
