"""`validate` and `plan`: a trial's report, and a trial planned."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from tactile_bayes.api.trials import analyse, load_trial, planned, read_pilot, settings_by
from tactile_bayes.commands.options import protect_inputs, typed_options
from tactile_bayes.errors import UsageError
from tactile_bayes.files.documents import dump_json
from tactile_bayes.report.pages import PageFiles
from tactile_bayes.shell import progress_bar


def validate_action(
    trial: Path,
    excision: Path,
    columns: Path | None,
    methods: bool,
    as_json: bool,
    output: Path | None,
    html: Path | None,
    pdf: Path | None,
    protocol: Path | None,
    force: bool,
    **settings: Any,
) -> None:
    """Compare sizes with excision: errors, lines, agreement, repeatability and calibration of each modality."""
    if pdf is not None and html is None:
        raise UsageError("--pdf prints the page that --html names; give --html REPORT.html too")
    if html is not None:
        PageFiles(html, pdf, force)
    title, chosen = settings_by(protocol, settings, typed=typed_options())
    inputs = load_trial(trial, excision, columns)
    protect_inputs(*inputs.files.values())
    analysis = analyse(inputs, chosen, protocol=protocol, title=title)
    try:
        if output:
            analysis.write_json(output, force=force)
        if html:
            analysis.write_html(html, pdf=pdf, force=force)
    finally:  # a file that cannot be written loses no result
        if as_json:
            for doubt in analysis.report.doubts:
                click.echo(f"doubtful: {doubt}", err=True)
        click.echo(dump_json(analysis.document) if as_json else analysis.text_with(methods=methods), nl=False)


def plan_action(
    pilot: Path | None,
    excision: Path | None,
    as_json: bool,
    output: Path | None,
    figure: Path | None,
    force: bool,
    **options: Any,
) -> None:
    """Plan a trial: power, widths of intervals and the worth of more maps, by simulation."""
    typed = {name: options[name] for name in options.keys() & typed_options()}
    errors = read_pilot(pilot, excision, typed.get("against"))
    if errors is not None:
        protect_inputs(*errors.trial.files.values())
        for doubt in errors.doubts() if as_json else ():
            click.echo(f"{pilot}: {doubt}", err=True)
    with progress_bar("designs") as progress:
        plan = planned(typed, errors, progress)
    try:
        if output:
            plan.write_json(output, force=force)
        if figure:
            plan.draw(figure, force=force)
    finally:  # a file that cannot be written loses no result
        click.echo(dump_json(plan.document) if as_json else plan.text, nl=False)
