"""Trials: a campaign run, a trial validated or planned, printed and written."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import click

from tactile_bayes.api.planning import planned, read_pilot
from tactile_bayes.api.trials import analyse, load_trial
from tactile_bayes.campaigns.campaign import names_line, run_campaign
from tactile_bayes.campaigns.exams import Found, find_exams
from tactile_bayes.commands.options import also_read, settings_of, typed_options
from tactile_bayes.declarations import names_of
from tactile_bayes.errors import BadDataError, UsageError
from tactile_bayes.files.atomic import refuse_existing
from tactile_bayes.files.documents import dump_json, read_protocol
from tactile_bayes.files.manifest_csv import add_rows, read_manifest, read_rows, write_manifest
from tactile_bayes.files.size_json import NONE
from tactile_bayes.options import CampaignOptions, TrialSettings
from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.report.pages import PageFiles
from tactile_bayes.shell import progress_bar

# --- `validate`: compare each modality with excision.


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
        PageFiles(html, pdf, force).check()
    title, chosen = _settings(settings, protocol)
    inputs = load_trial(trial, excision, columns)
    also_read(*inputs.files.values())
    found = analyse(inputs, chosen, protocol=protocol, title=title)
    try:
        if output:
            found.write_json(output, force=force)
        if html:
            found.write_html(html, pdf=pdf, force=force)
    finally:  # what was computed is not lost with a file
        if as_json:
            for doubt in found.report.doubts:
                click.echo(f"doubtful: {doubt}", err=True)
        click.echo(dump_json(found.document) if as_json else found.told(methods=methods), nl=False)


def _settings(given: dict[str, Any], protocol: Path | None) -> tuple[str | None, TrialSettings]:
    """Title and settings of the protocol, if there is one; refuses options that contradict it."""
    if protocol is None:
        return None, TrialSettings(**given)
    title, fixed = read_protocol(protocol)
    typed = typed_options()
    for name, value in fixed.items():
        if name in typed and given[name] != value:
            option = f"--{name.replace('_', '-')} {given[name]}"
            raise UsageError(f"{option} contradicts {protocol}, which fixes {name} = {value}; leave the option out")
    return title, TrialSettings(**(given | fixed))


# --- `plan`: sample size of a trial, and the value of more maps per mass.


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
    given = {name: options[name] for name in options.keys() & typed_options()}
    read = read_pilot(pilot, excision, given.get("against"))
    if read is not None:
        also_read(*read.trial.files.values())
        for doubt in read.doubts():
            click.echo(f"{pilot}: {doubt}", err=True)
    with progress_bar("designs") as progress:
        found = planned(given, read, progress)
    try:
        if output:
            found.write_json(output, force=force)
        if figure:
            found.draw(figure, force=force)
    finally:  # what was computed is not lost with the file
        click.echo(dump_json(found.document) if as_json else found.text, nl=False)


# --- `campaign`: from a folder of exams to the trial's report.

_LOG_EVERY_S = 60.0  #: Where stderr is no terminal, progress is a line so often.


def campaign_init_action(folder: Path | str, output: Path, names: str | None, add: bool, force: bool) -> None:
    """Write the table of exams from a folder of scans and what they carry."""
    if add and force:
        raise UsageError("--add keeps the rows of a table, --force writes it anew; give one of them")
    before = read_rows(output) if add and output.exists() else None
    if output.exists() and not (add or force):
        raise UsageError(f"{output} exists; --add keeps its rows and adds other files, --force writes it anew")
    refuse_existing(output, force=force or add)
    found = find_exams(folder, output, listed=before.rows if before else (), names=names)
    for line in found.skipped:
        click.echo(f"left out: {line}", err=True)
    if before is None:
        if not found.rows:
            what, way_out = "holds no scan (.mcap, .npz) and no map (.nc)", "give the folder of the scans"
            if found.skipped:
                what, way_out = "holds no file that can be an exam", "see why each was left out"
            raise BadDataError(what, way_out=way_out, path=str(folder))
        write_manifest(output, found.rows, force=force)
    elif found.rows:
        add_rows(before, found.rows)
    _say_found(found, output, before.rows if before else None)


def _say_found(found: Found, output: Path, before: Sequence[Mapping[str, str]] | None) -> None:
    """What the table holds now, what is to be looked at, and the next command."""
    rows = [*(before or ()), *found.rows]
    patients = {row["patient"].casefold() for row in rows} - {""}
    added = "" if before is None else f" ({len(found.rows)} added, {len(before)} kept)"
    click.echo(f"{output}: {len(rows)} exams of {len(patients)} patients{added}")
    for line in found.spelled:
        click.echo(line)
    for line in names_line("listed, and not there any more", found.gone):
        click.echo(line)
    if found.others:
        kinds = ", ".join(sorted(found.others))
        click.echo(f"passed over: {sum(found.others.values())} other files ({kinds})")
    nameless = sum(not row["patient"] for row in rows)
    if nameless:
        click.echo(f"{nameless} of them do not say whose they are: fill in the column patient")
    else:
        try:
            read_manifest(output)
        except BadDataError as error:
            click.echo(f"to correct before the run: {error}")
    folder = shlex.quote(str(output.with_name("out")))
    click.echo(f"next: tactile-bayes campaign run {shlex.quote(str(output))} -o {folder} --dry-run")
    click.echo(RESEARCH_USE)


def campaign_run_action(
    exams: Path, output: Path, settings_file: Path | None, repeatability: str | None, **options: Any
) -> None:
    """Map, estimate and pool the exams of a table, and report the trial."""
    asked = CampaignOptions(**{name: options.pop(name) for name in names_of(CampaignOptions)})
    given = None if repeatability in (None, NONE) else Path(str(repeatability))
    found = run_campaign(
        exams,
        output,
        asked,
        settings_of(settings_file=settings_file, repeatability=given, **options),
        own_repeatability=repeatability is None,
        read=[path for path in (settings_file, given) if path],
        bar=partial(progress_bar, log_every_s=_LOG_EVERY_S, time_left=False),
    )
    for line in () if asked.dry_run else found.failed:
        click.echo(f"failed: {line}", err=True)
    click.echo(found.text, nl=False)
