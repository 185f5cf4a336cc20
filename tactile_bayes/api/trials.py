"""A trial's tables to its report."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tactile_bayes.api.arguments import PathLike, Told, door, path_of, plain, table_of, takes
from tactile_bayes.declarations import as_dict, replace, to_plain
from tactile_bayes.errors import NotConvergedError
from tactile_bayes.files.atomic import write_text
from tactile_bayes.files.column_map import read_mapping, read_wide, read_wide_excision
from tactile_bayes.files.documents import dump_json
from tactile_bayes.files.estimate_json import fill_from_posteriors
from tactile_bayes.files.provenance import Provenance, hash_inputs
from tactile_bayes.files.tables import Sheet, Table, check_references, read_table
from tactile_bayes.geometry import FloatArray
from tactile_bayes.inference.draws import ParameterDraws
from tactile_bayes.inference.ensemble import ensemble
from tactile_bayes.inference.importance import ImportanceOptions, importance
from tactile_bayes.inference.modes import LogDensity, mode_and_covariance
from tactile_bayes.options import TrialSettings
from tactile_bayes.presets import INTERVAL
from tactile_bayes.report.compare import Growth
from tactile_bayes.report.pages import PageFiles
from tactile_bayes.report.trial import DIGITS, trial_text
from tactile_bayes.report.trial_html import trial_html
from tactile_bayes.trial.figures import Intervals
from tactile_bayes.trial.next_mass import next_mass
from tactile_bayes.trial.planning import check_all
from tactile_bayes.trial.readings import Trial, at_excision, readings_from_columns
from tactile_bayes.trial.summary import TrialReport, summarise

if TYPE_CHECKING:
    import pandas


# --- Sampler for the next mass's model: importance sampling about the mode, or MCMC where it cannot be trusted.

_ACCURACY_SD = 0.03  #: Monte-Carlo error of interval ends, in posterior SDs.


def draw(
    log_density: LogDensity, centre: FloatArray, covariance: FloatArray, *, rng: np.random.Generator
) -> ParameterDraws:
    """Draw from a log density.

    The density takes (m, p) arrays to (m,); `centre` and `covariance` guess the mode and the covariance about it. Where
    MCMC, too, does not reach its criteria, `NotConvergedError` says so.
    """
    try:
        mode, about, _ = mode_and_covariance(log_density, centre, scale=np.sqrt(np.diag(covariance)))
        return importance(log_density, mode, about, rng=rng, options=ImportanceOptions(_ACCURACY_SD))
    except NotConvergedError:
        return ensemble(log_density, centre, covariance, rng=rng)


# --- Analysis of a trial from its tables: errors, lines, agreement and calibration of each modality.


class TrialResult(Told, eq=False):
    """How each modality's sizes compare with excision.

    `report` is what the file of ``validate --json`` holds, and `trial` what it was made from.
    """

    report: TrialReport
    trial: Trial

    @property
    def document(self) -> dict[str, Any]:
        """What ``validate --json`` prints."""
        document: dict[str, Any] = to_plain(self.report, digits=DIGITS)
        return document

    @property
    def text(self) -> str:
        """What ``validate --methods`` prints."""
        return self.told(methods=True)

    def told(self, *, methods: bool) -> str:
        """The report as text, with or without the table of methods."""
        return trial_text(self.report, left_out=self.trial.other_visits.lines(), methods=methods)

    def write_json(self, path: Path, *, force: bool = False) -> None:
        """Write what ``validate -o`` writes."""
        write_text(path, dump_json(self.document), force=force)

    def write_html(
        self, path: Path, *, growth: Sequence[Growth] = (), pdf: Path | None = None, force: bool = False
    ) -> None:
        """Write what ``validate --html`` and ``--pdf`` write, with what became of masses with several visits."""
        page = trial_html(self.report, self.trial, text=self.text, growth=growth)
        PageFiles(path, pdf, force).write(page)

    def to_dataframe(self) -> pandas.DataFrame:
        """One row for each modality and figure: value, and the ends of its interval (NaN where it has none)."""
        import pandas

        rows = []
        for modality, figures in self.document["modalities"].items():
            for name, value in figures.items():
                if isinstance(value, int | float):
                    counted = name == "detected"  # the interval beside it is of the share
                    low, high = (None, None) if counted else figures.get(f"{name}_interval") or (None, None)
                    rows.append((modality, name, value, low, high))
        found = pandas.DataFrame(rows, columns=["modality", "figure", "value", "low", "high"])
        return found.astype({"value": float, "low": float, "high": float})

    def __repr__(self) -> str:
        counts, names = self.report.counts, ", ".join(self.report.modalities)
        return f"<TrialResult {counts.masses} masses of {counts.patients} patients: {names}>"


def analyse(
    trial: Trial, settings: TrialSettings, *, protocol: Path | None = None, title: str | None = None
) -> TrialResult:
    """Analyse a trial; `protocol` and `title` are of the pre-specified analysis, where there is one."""
    confidence = Intervals(INTERVAL, method=settings.intervals, resamples=settings.resamples, seed=settings.seed)
    kept = {name: value for name, value in as_dict(settings).items() if name != "seed"}
    inputs = hash_inputs(**trial.files, **({} if protocol is None else {"protocol": protocol}))
    made = Provenance("validate", {"interval_probability": INTERVAL, **kept}, inputs, seed=settings.seed)
    report = summarise(
        trial, confidence=confidence, error_ratio=settings.error_ratio, seed=settings.seed, provenance=made.as_dict()
    )
    if title is not None:
        report = replace(report, title=title)
    if settings.check_intervals:
        trials = settings.check_intervals
        checks = check_all(trial.sizes(), confidence=confidence, trials=trials, seed=settings.seed)
        report = replace(report, interval_check=checks)
    if settings.bayes:
        rng = np.random.default_rng(settings.seed)
        report = replace(report, next_mass=next_mass(trial, sample=draw, rng=rng, probability=INTERVAL))
    return TrialResult(report, trial)


# --- Input of `validate` and `plan`: the tables of a trial, tidy or wide, and the estimates that they name.


def load_trial(trial: Path | Sheet, excision: Path | Sheet, columns: Path | None, *, tidy_trial: bool = False) -> Trial:
    """Read and check both tables.

    `columns` is the mapping file of a wide table; one without ``[[reading]]`` is for the excision sizes alone. A
    `tidy_trial` is tidy whatever the mapping holds.
    """
    sizes = read_excision(excision, columns)
    if columns is None or tidy_trial or isinstance(trial, Sheet) or read_mapping(columns).reading is None:
        table = read_table(trial, "trial.table.json")
    else:
        table = read_wide(trial, columns)
    check_references(table, "trial.table.json", targets={"excision": sizes})
    filled, posteriors = fill_from_posteriors(table)
    keys = list(zip(sizes.columns["patient"], sizes.columns["mass"], strict=True))
    readings = readings_from_columns(filled, fault=table.error)
    excised_on = dict(zip(keys, sizes.columns["date"], strict=True))
    analysed, other_visits = at_excision(readings, excised_on, fault=table.error)
    given = {"trial": trial, "excision": excision, "columns": columns}
    files = {role: path for role, path in given.items() if isinstance(path, Path)}
    return Trial(
        readings=analysed,
        other_visits=other_visits,
        ex_vivo_mm=dict(zip(keys, sizes.columns["ex_vivo_mm"], strict=True)),
        ex_vivo_sd_mm=dict(zip(keys, sizes.columns["sd_mm"], strict=True)),
        files=files | {f"posterior_{number}": path for number, path in enumerate(posteriors, start=1)},
    )


def read_excision(excision: Path | Sheet, columns: Path | None) -> Table:
    """Sizes after excision: from a wide table where the mapping has ``[excision]``, otherwise from a tidy one."""
    if columns is None or not isinstance(excision, Path) or read_mapping(columns).excision is None:
        return read_table(excision, "excision.table.json")
    return read_wide_excision(excision, columns)


@door
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
    used = TrialSettings(**{name: plain(value) for name, value in settings.items()})
    return analyse(load_trial(table_of(trial, "trial"), table_of(excision, "excision"), path_of(columns)), used)
