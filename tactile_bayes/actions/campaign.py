"""`campaign`: from a folder of exams to the trial's report."""

from __future__ import annotations

import shlex
from functools import partial
from pathlib import Path
from typing import Any

import click

from tactile_bayes.campaigns.campaign import run_campaign
from tactile_bayes.campaigns.exams import SCANS, FolderExams, find_exams
from tactile_bayes.campaigns.run import FEW
from tactile_bayes.campaigns.steps import CampaignSettings
from tactile_bayes.commands.options import make_settings
from tactile_bayes.declarations import names_of
from tactile_bayes.errors import BadDataError, UsageError
from tactile_bayes.files.atomic import refuse_existing
from tactile_bayes.files.manifest_csv import add_rows, read_manifest, read_rows, write_manifest
from tactile_bayes.files.size_json import NONE
from tactile_bayes.files.tables import RawTable
from tactile_bayes.findings import counted, first_of
from tactile_bayes.options import CampaignOptions
from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.shell import progress_bar

_LOG_EVERY_S = 60.0  #: Interval of progress lines where stderr is no terminal.


def campaign_init_action(folder: Path | str, output: Path, names: str | None, add: bool, force: bool) -> None:
    """Write the table of exams from a folder of scans and what they carry."""
    if add and force:
        raise UsageError("--add keeps the rows of a table, --force writes it anew; give one of them")
    table = read_rows(output) if add and output.exists() else None
    if output.exists() and not (add or force):
        raise UsageError(f"{output} exists; --add keeps its rows and adds other files, --force writes it anew")
    refuse_existing(output, force=force or add)
    search = find_exams(folder, output, listed=table.rows if table else (), names=names)
    for line in search.skipped:
        click.echo(f"left out: {line}", err=True)
    if table is None:
        if not search.rows:
            what, way_out = f"holds no scan ({', '.join(SCANS)}) and no map (.nc)", "give the folder of the scans"
            if search.skipped:
                what, way_out = "holds no file that can be an exam", "see why each was left out"
            raise BadDataError(what, way_out=way_out, path=str(folder))
        write_manifest(output, search.rows, force=force)
    elif search.rows:
        add_rows(table, search.rows)
    _print_table_summary(search, output, table, names)


def _print_table_summary(search: FolderExams, output: Path, kept: RawTable | None, names: str | None) -> None:
    """Print the number of exams and patients, gaps and faults of the table, and the next command."""
    rows = [*(kept.rows if kept else ()), *search.rows]
    patients = {row["patient"].casefold() for row in rows} - {""}
    of_patients = f" of {counted(len(patients), 'patient')}" if patients else ""
    added = "" if kept is None else f" ({len(search.rows)} added, {len(kept.rows)} kept)"
    click.echo(f"{output}: {counted(len(rows), 'exam')}{of_patients}{added}")
    for line in search.spelled:
        click.echo(line)
    if search.gone:
        click.echo(f"listed, and not there any more: {first_of(search.gone, FEW)}")
    if search.others:
        others = counted(search.others.total(), "other file")
        click.echo(f"passed over: {others} ({', '.join(sorted(search.others))})")
    nameless = sum(not row["patient"] for row in rows)
    if nameless:
        from_names = ", or take it from the files' names (--names, --force)" if kept is None and names is None else ""
        click.echo(f"{counted(nameless, 'exam')} without a patient: fill in the column patient{from_names}")
    else:
        try:
            read_manifest(output)
        except BadDataError as error:
            click.echo(f"to correct before the run: {error}")
    folder = shlex.quote(str(output.with_name("out")))
    click.echo(f"next: tactile-bayes campaign run {shlex.quote(str(output))} -o {folder} --dry-run")
    click.echo(RESEARCH_USE)


def campaign_run_action(
    exams: Path, output: Path, settings_file: Path | None, repeatability: Path | None, **options: Any
) -> None:
    """Map, estimate and pool the exams of a table, and report the trial."""
    campaign = {name: options.pop(name) for name in names_of(CampaignOptions)}
    site = None if repeatability == Path(NONE) else repeatability
    estimate = make_settings(settings_file=settings_file, repeatability=site, **options)
    result = run_campaign(
        exams,
        output,
        CampaignSettings(**campaign, estimate=estimate, own_repeatability=repeatability is None),
        read=[path for path in (settings_file, site) if path],
        bar=partial(progress_bar, log_every_s=_LOG_EVERY_S, time_left=False),
    )
    for line in () if campaign["dry_run"] else result.failed:
        click.echo(f"failed: {line}", err=True)
    click.echo(result.text, nl=False)
