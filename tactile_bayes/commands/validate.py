"""`validate`: compare each modality with excision."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from tactile_bayes.api.trial_report import TrialOutcome, TrialSettings, analyse
from tactile_bayes.commands.options import FORCE, JSON, FilePath, FiniteRange, also_read, seed_option
from tactile_bayes.errors import UsageError

_FILE = FilePath()
_DEFAULTS = TrialSettings()


@click.command("validate")
@click.argument("trial", metavar="TRIAL.csv", type=_FILE)
@click.option("--excision", required=True, metavar="EX.csv", type=_FILE, help="Sizes measured after excision.")
@click.option(
    "--columns", metavar="MAP.toml", type=_FILE, help="Layout of a wide TRIAL.csv: which column holds which reading."
)
@click.option(
    "--intervals",
    type=click.Choice(["corrected", "jackknife", "bca"]),
    default=_DEFAULTS.intervals,
    show_default=True,
    help="Interval method, resampling patients. corrected: jackknife with Student's t, corrected for rare "
    "misses and few influential patients; jackknife: uncorrected; bca: bootstrap.",
)
@click.option(
    "--resamples",
    type=click.IntRange(200, 100_000),
    default=_DEFAULTS.resamples,
    show_default=True,
    help="Number of bootstrap resamples.",
)
@seed_option(_DEFAULTS.seed)
@click.option(
    "--error-ratio",
    type=FiniteRange(1e-6, 1e6),
    default=_DEFAULTS.error_ratio,
    show_default=True,
    help="Ratio of the ex-vivo error's variance to the modality's, for Deming lines.",
)
@click.option(
    "--check-intervals",
    type=click.IntRange(0),
    default=0,
    metavar="TRIALS",
    help="Simulate this many trials of this size and report how often the intervals cover.",
)
@click.option(
    "--bayes", is_flag=True, help="Predict the error of the next mass, by an errors-in-variables model and MCMC."
)
@click.option("--methods", is_flag=True, help="Also print lines, limits of agreement, repeatability and pairs.")
@JSON
@click.option(
    "-o", "--output", metavar="REPORT.json", type=FilePath(writes="JSON"), help="Write the report as JSON to this file."
)
@click.option(
    "--html",
    metavar="REPORT.html",
    type=FilePath(writes="HTML"),
    help="Write tables and figures as one self-contained page.",
)
@click.option(
    "--protocol", metavar="FILE.toml", type=_FILE, help="Pre-specified analysis; the report records its hash."
)
@FORCE
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
    from tactile_bayes.api.trials import load_trial
    from tactile_bayes.files.atomic import refuse_existing, write_text
    from tactile_bayes.files.documents import check_document, dump_json

    for target in (output, html):
        if target:
            refuse_existing(target, force=force)
    title, chosen = _settings(settings, protocol)
    inputs = load_trial(trial, excision, columns)
    also_read(*inputs.files.values())
    outcome = analyse(inputs, chosen, protocol=protocol, title=title)
    if output or as_json:
        check_document(outcome.document, "validate.schema.json", path=output or Path("the report"))
    try:
        if output:
            write_text(output, dump_json(outcome.document), force=force)
        if html:
            _write_html(html, outcome, force=force)
    finally:  # what was computed is not lost with a file
        if as_json:
            for doubt in outcome.report.doubts:
                click.echo(f"doubtful: {doubt}", err=True)
        click.echo(dump_json(outcome.document) if as_json else _text(outcome, methods=methods), nl=False)


def _settings(given: dict[str, Any], protocol: Path | None) -> tuple[str | None, TrialSettings]:
    """Title and settings of the protocol, if there is one; refuses options that contradict it."""
    from tactile_bayes.files.documents import read_protocol

    if protocol is None:
        return None, TrialSettings(**given)
    context = click.get_current_context()
    read = read_protocol(protocol)
    for name, value in read.fixed.items():
        typed = context.get_parameter_source(name) is click.core.ParameterSource.COMMANDLINE
        if typed and given[name] != value:
            option = f"--{name.replace('_', '-')} {given[name]}"
            raise UsageError(f"{option} contradicts {protocol}, which fixes {name} = {value}; leave the option out")
    return read.title, TrialSettings(**(given | read.fixed))


def _text(outcome: TrialOutcome, *, methods: bool) -> str:
    from tactile_bayes.report.trial import trial_text

    more = [] if outcome.next_mass is None else outcome.next_mass.lines()
    return trial_text(outcome.report, methods=methods, checks=outcome.checks, more=more)


def _write_html(path: Path, outcome: TrialOutcome, *, force: bool) -> None:
    from tactile_bayes.files.atomic import write_text
    from tactile_bayes.report.trial_html import trial_html

    write_text(path, trial_html(outcome.report, outcome.document, text=_text(outcome, methods=True)), force=force)
