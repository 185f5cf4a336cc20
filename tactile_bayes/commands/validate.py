"""`validate`: accuracy of each modality against excision."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import click

from tactile_bayes.commands.number_or import FiniteRange
from tactile_bayes.commands.paths import FilePath
from tactile_bayes.errors import UsageError

if TYPE_CHECKING:
    from tactile_bayes.commands.trial_inputs import TrialInputs
    from tactile_bayes.trial.bootstrap import Intervals
    from tactile_bayes.trial.check_intervals import IntervalCheck
    from tactile_bayes.trial.next_mass import NextMass
    from tactile_bayes.trial.summary import TrialReport

SCHEMA = "tactile-bayes/validate/1"
_FILE = FilePath()


@dataclass(frozen=True, slots=True)
class Settings:
    """How the analysis is made; each enters the provenance."""

    intervals: Literal["corrected", "jackknife", "percentile", "bca"]
    resamples: int
    seed: int
    error_ratio: float
    check_intervals: int
    bayes: bool


@dataclass(frozen=True, slots=True)
class Outcome:
    """Everything a run found."""

    report: TrialReport
    document: dict[str, Any]
    checks: dict[str, IntervalCheck]
    next_mass: NextMass | None


@click.command("validate")
@click.argument("trial", metavar="TRIAL.csv", type=_FILE)
@click.option("--excision", required=True, metavar="EX.csv", type=_FILE, help="Sizes measured after excision.")
@click.option("--columns", metavar="MAP.toml", type=_FILE, help="TRIAL.csv is wide: which column holds which reading.")
@click.option(
    "--intervals",
    type=click.Choice(["corrected", "jackknife", "percentile", "bca"]),
    default="corrected",
    show_default=True,
    help="Over patients: leave-one-out with Student's t, corrected for rare misses and few influential patients; the "
    "same uncorrected; or two bootstraps.",
)
@click.option(
    "--resamples", type=click.IntRange(200, 100_000), default=2000, show_default=True, help="Of the bootstraps."
)
@click.option("--seed", type=click.IntRange(0), default=1999, show_default=True, help="Of everything random.")
@click.option(
    "--error-ratio",
    type=FiniteRange(1e-6, 1e6),
    default=1.0,
    show_default=True,
    help="Variance of the ex-vivo error over the modality's, for the Deming lines.",
)
@click.option(
    "--check-intervals",
    type=click.IntRange(0),
    default=0,
    metavar="TRIALS",
    help="Simulate so many trials of this size and count how often the intervals hold.",
)
@click.option("--bayes", is_flag=True, help="Errors-in-variables model by MCMC: the error of the next mass.")
@click.option("--methods", is_flag=True, help="Also print lines, limits of agreement, repeatability and pairs.")
@click.option("--json", "as_json", is_flag=True, help="Print the report as JSON.")
@click.option("-o", "--output", metavar="REPORT.json", type=_FILE, help="Write the report as JSON to this file.")
@click.option("--html", metavar="REPORT.html", type=_FILE, help="Write tables and figures as one self-contained page.")
@click.option("--protocol", metavar="FILE.toml", type=_FILE, help="Pre-specified analysis; its hash enters the report.")
@click.option("--force", is_flag=True, help="Overwrite an existing output.")
def command(
    trial: Path,
    excision: Path,
    columns: Path | None,
    methods: bool,
    as_json: bool,
    output: Path | None,
    html: Path | None,
    protocol: Path | None,
    force: bool,
    **settings: Any,
) -> None:
    """Compare sizes with excision: errors, lines, agreement, repeatability and calibration of each modality.

    TRIAL.csv has the columns patient, mass, modality, replicate, size_mm, status (detected, not_detected, not_done or
    blank) and optionally sd_mm, low_mm, high_mm, probability, reader, posterior, synthetic. EX.csv has patient, mass,
    ex_vivo_mm and optionally ex_vivo_second_mm, sd_mm, synthetic. Sizes are in mm.

    Example: tactile-bayes validate trial.csv --excision excision.csv -o report.json
    """
    from tactile_bayes.commands.trial_inputs import load_trial
    from tactile_bayes.files.atomic import refuse_existing, write_text
    from tactile_bayes.files.schema import check_document, dump_json

    for target in (output, html):
        if target:
            refuse_existing(target, force=force)
    title, chosen = _settings(settings, protocol)
    outcome = _analyse(load_trial(trial, excision, columns), chosen, protocol, title=title)
    if output or as_json:
        check_document(outcome.document, "validate.schema.json", path=output or Path("the report"))
    if output:
        write_text(output, dump_json(outcome.document), force=force)
    if html:
        _write_html(html, outcome, force=force)
    if as_json:
        for doubt in outcome.report.doubts:
            click.echo(f"doubtful: {doubt}", err=True)
    click.echo(dump_json(outcome.document) if as_json else _text(outcome, methods=methods), nl=False)


def _settings(given: dict[str, Any], protocol: Path | None) -> tuple[str | None, Settings]:
    """Title and settings of the protocol, where there is one; an option that contradicts it is refused."""
    from tactile_bayes.files.protocol import read_protocol

    if protocol is None:
        return None, Settings(**given)
    context = click.get_current_context()
    read = read_protocol(protocol)
    # TOML and its schema take 1000.0 for a whole number
    fixed = {name: type(given[name])(value) for name, value in read.analysis.items()}
    for name, value in fixed.items():
        typed = context.get_parameter_source(name) is click.core.ParameterSource.COMMANDLINE
        if typed and given[name] != value:
            option = f"--{name.replace('_', '-')} {given[name]}"
            raise UsageError(f"{option} contradicts {protocol}, which fixes {name} = {value}; leave the option out")
    return read.title, Settings(**(given | fixed))


def _intervals(settings: Settings) -> Intervals:
    from tactile_bayes.presets import INTERVAL
    from tactile_bayes.trial.bootstrap import Intervals

    return Intervals(INTERVAL, method=settings.intervals, resamples=settings.resamples, seed=settings.seed)


def _analyse(inputs: TrialInputs, settings: Settings, protocol: Path | None, *, title: str | None) -> Outcome:
    from tactile_bayes.presets import RESEARCH_USE
    from tactile_bayes.trial.check_intervals import check_all
    from tactile_bayes.trial.document import as_document, checks_document
    from tactile_bayes.trial.summary import summarise

    confidence = _intervals(settings)
    report = summarise(
        inputs.readings,
        inputs.ex_vivo_mm,
        confidence=confidence,
        error_ratio=settings.error_ratio,
        ex_vivo_sd_mm=inputs.ex_vivo_sd_mm,
        seed=settings.seed,
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
    return Outcome(report, {**document, "research_use": RESEARCH_USE}, checks, next_mass)


def _next_mass(inputs: TrialInputs, settings: Settings) -> NextMass:
    """The Bayesian model; the sampler is handed in, because the trial's package imports none."""
    import numpy as np

    from tactile_bayes.commands.trial_sampler import draw
    from tactile_bayes.presets import INTERVAL
    from tactile_bayes.trial.next_mass import next_mass

    return next_mass(
        inputs.readings,
        inputs.ex_vivo_mm,
        inputs.ex_vivo_sd_mm,
        sample=draw,
        rng=np.random.default_rng(settings.seed),
        probability=INTERVAL,
    )


def _provenance(inputs: TrialInputs, settings: Settings, protocol: Path | None) -> dict[str, Any]:
    from dataclasses import asdict

    from tactile_bayes.files.provenance import Provenance, hash_inputs
    from tactile_bayes.presets import INTERVAL

    files = inputs.files | ({} if protocol is None else {"protocol": protocol})
    kept = {name: value for name, value in asdict(settings).items() if name != "seed"}
    return Provenance(
        command="validate",
        settings={"interval_probability": INTERVAL, **kept},
        inputs=hash_inputs(**files),
        seed=settings.seed,
    ).as_dict()


def _text(outcome: Outcome, *, methods: bool) -> str:
    from tactile_bayes.report.trial_text import trial_text

    more = [] if outcome.next_mass is None else outcome.next_mass.lines()
    return trial_text(outcome.report, methods=methods, checks=outcome.checks, more=more)


def _write_html(path: Path, outcome: Outcome, *, force: bool) -> None:
    from tactile_bayes.files.atomic import write_text
    from tactile_bayes.report.trial_html import trial_html

    write_text(path, trial_html(outcome.report, outcome.document, text=_text(outcome, methods=True)), force=force)
