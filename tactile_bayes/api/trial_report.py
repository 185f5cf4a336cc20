"""Analysis of a trial from its tables: errors, lines, agreement and calibration of each modality."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

from tactile_bayes.declarations import Record, as_dict
from tactile_bayes.errors import check_choice, check_number
from tactile_bayes.presets import INTERVAL, RESEARCH_USE

if TYPE_CHECKING:
    from tactile_bayes.api.trials import TrialInputs
    from tactile_bayes.trial.figures import Intervals
    from tactile_bayes.trial.next_mass import NextMass
    from tactile_bayes.trial.planning import IntervalCheck
    from tactile_bayes.trial.summary import TrialReport

IntervalMethod = Literal["corrected", "jackknife", "bca"]
SCHEMA = "tactile-bayes/validate/1"


class TrialSettings(Record):
    """Settings of the analysis; each is part of the provenance."""

    intervals: IntervalMethod = "corrected"
    resamples: int = 2000
    seed: int = 1999
    error_ratio: float = 1.0
    check_intervals: int = 0
    bayes: bool = False

    def __post_init__(self) -> None:
        check_choice("intervals", self.intervals, get_args(IntervalMethod))
        check_number("resamples", self.resamples, 200, 100_000, whole=True)
        check_number("seed", self.seed, 0, whole=True)
        check_number("error_ratio", self.error_ratio, 1e-6, 1e6)
        check_number("check_intervals", self.check_intervals, 0, whole=True)


class TrialOutcome(Record):
    """Results of an analysis."""

    report: TrialReport
    document: dict[str, Any]
    checks: dict[str, IntervalCheck]
    next_mass: NextMass | None


def intervals_of(settings: TrialSettings) -> Intervals:
    """Intervals of a report: probability and method."""
    from tactile_bayes.trial.figures import Intervals

    return Intervals(INTERVAL, method=settings.intervals, resamples=settings.resamples, seed=settings.seed)


def analyse(
    inputs: TrialInputs, settings: TrialSettings, *, protocol: Path | None = None, title: str | None = None
) -> TrialOutcome:
    """Analyse a trial.

    Parameters
    ----------
    protocol, title
        File and title of the pre-specified analysis, where there is one.
    """
    from tactile_bayes.report.trial import as_document, checks_document
    from tactile_bayes.trial.planning import check_all
    from tactile_bayes.trial.summary import summarise

    confidence = intervals_of(settings)
    report = summarise(
        inputs.readings,
        inputs.ex_vivo_mm,
        confidence=confidence,
        error_ratio=settings.error_ratio,
        ex_vivo_sd_mm=inputs.ex_vivo_sd_mm,
        seed=settings.seed,
        other_visits=inputs.other_visits,
    )
    document = {"schema": SCHEMA, **({} if title is None else {"title": title}), **as_document(report)}
    checks: dict[str, IntervalCheck] = {}
    if settings.check_intervals:
        checks = check_all(report.sizes, confidence=confidence, trials=settings.check_intervals, seed=settings.seed)
        document["interval_check"] = checks_document(checks)
    next_mass = _next_mass(inputs, settings) if settings.bayes else None
    if next_mass is not None:
        document["next_mass"] = next_mass.as_document()
    document["provenance"] = _provenance(inputs, settings, protocol)
    return TrialOutcome(report, {**document, "research_use": RESEARCH_USE}, checks, next_mass)


def _next_mass(inputs: TrialInputs, settings: TrialSettings) -> NextMass:
    """Fit the Bayesian model of the next mass, with the sampler passed in (the trial package imports none)."""
    import numpy as np

    from tactile_bayes.api.trial_sampler import draw
    from tactile_bayes.trial.next_mass import next_mass

    return next_mass(
        inputs.readings,
        inputs.ex_vivo_mm,
        inputs.ex_vivo_sd_mm,
        sample=draw,
        rng=np.random.default_rng(settings.seed),
        probability=INTERVAL,
    )


def _provenance(inputs: TrialInputs, settings: TrialSettings, protocol: Path | None) -> dict[str, Any]:
    from tactile_bayes.files.provenance import Provenance, hash_inputs

    files = inputs.files | ({} if protocol is None else {"protocol": protocol})
    kept = {name: value for name, value in as_dict(settings).items() if name != "seed"}
    return Provenance(
        command="validate",
        settings={"interval_probability": INTERVAL, **kept},
        inputs=hash_inputs(**files),
        seed=settings.seed,
    ).as_dict()
