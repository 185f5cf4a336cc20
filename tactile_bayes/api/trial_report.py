"""Analysis of a trial from its tables: errors, lines, agreement and calibration of each modality."""

from __future__ import annotations

from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tactile_bayes.api.trial_sampler import draw
from tactile_bayes.declarations import Record, as_dict, replace, to_plain
from tactile_bayes.files.atomic import write_text
from tactile_bayes.files.documents import dump_json
from tactile_bayes.files.provenance import Provenance, hash_inputs
from tactile_bayes.options import TrialSettings
from tactile_bayes.presets import INTERVAL, RESEARCH_USE
from tactile_bayes.report.trial import DIGITS, trial_text
from tactile_bayes.report.trial_html import trial_html
from tactile_bayes.trial.figures import Intervals
from tactile_bayes.trial.next_mass import next_mass
from tactile_bayes.trial.planning import check_all
from tactile_bayes.trial.readings import Trial
from tactile_bayes.trial.summary import TrialReport, summarise

if TYPE_CHECKING:
    from collections.abc import Sequence

    import pandas

    from tactile_bayes.report.compare import Growth


class TrialResult(Record, eq=False):
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

    def write_html(self, path: Path, *, growth: Sequence[Growth] = (), force: bool = False) -> None:
        """Write what ``validate --html`` writes, with what became of masses with several visits."""
        write_text(path, trial_html(self.report, self.trial, text=self.text, growth=growth), force=force)

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

    def _repr_html_(self) -> str:
        return f"<pre>{escape(self.text)}</pre><p><small>{escape(RESEARCH_USE)}</small></p>"


def analyse(
    trial: Trial, settings: TrialSettings, *, protocol: Path | None = None, title: str | None = None
) -> TrialResult:
    """Analyse a trial; `protocol` and `title` are of the pre-specified analysis, where there is one."""
    confidence = Intervals(INTERVAL, method=settings.intervals, resamples=settings.resamples, seed=settings.seed)
    provenance = _provenance(trial, settings, protocol)
    report = summarise(
        trial, confidence=confidence, error_ratio=settings.error_ratio, seed=settings.seed, provenance=provenance
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


def _provenance(trial: Trial, settings: TrialSettings, protocol: Path | None) -> dict[str, Any]:
    files = {**trial.files, **({} if protocol is None else {"protocol": protocol})}
    kept = {name: value for name, value in as_dict(settings).items() if name != "seed"}
    return Provenance(
        command="validate",
        settings={"interval_probability": INTERVAL, **kept},
        inputs=hash_inputs(**files),
        seed=settings.seed,
    ).as_dict()
