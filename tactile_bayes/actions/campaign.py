"""`campaign`: from a folder of exams to the trial's report."""

from __future__ import annotations

import os
import shlex
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from tactile_bayes.batch import open_executor
from tactile_bayes.campaign.exams import find_exams
from tactile_bayes.campaign.inputs import open_campaign, tidy
from tactile_bayes.campaign.report import (
    WRITTEN,
    Excision,
    check_inputs,
    copy_outputs,
    counts_words,
    repeatability_words,
    write_outputs,
)
from tactile_bayes.campaign.run import Campaign
from tactile_bayes.campaign.settings import CampaignSettings
from tactile_bayes.commands.options import also_read, refuse_same, settings_of
from tactile_bayes.commands.progress import progress_bar
from tactile_bayes.errors import BadDataError, UsageError
from tactile_bayes.files.atomic import refuse_existing
from tactile_bayes.files.manifest_csv import add_rows, read_manifest, read_rows, write_manifest
from tactile_bayes.files.remote import check_address
from tactile_bayes.files.shipped import NONE, size_calibration_path
from tactile_bayes.presets import RESEARCH_USE

if TYPE_CHECKING:
    from tactile_bayes.campaign.exams import Found
    from tactile_bayes.campaign.report import Written
    from tactile_bayes.campaign.run import Campaign
    from tactile_bayes.campaign.settings import CampaignSettings
    from tactile_bayes.campaign.stages import CampaignState
    from tactile_bayes.files.manifest_csv import Exam
_MOST_NAMED = 5
_LOG_EVERY_S = 60.0
"""Where stderr is no terminal, progress is a line so often."""


def campaign_init_action(folder: Path | str, output: Path, add: bool, force: bool) -> None:
    """Write the table of exams from a folder of scans and what they carry."""
    if add and force:
        raise UsageError("--add keeps the rows of a table, --force writes it anew; give one of them")
    before = read_rows(output) if add and output.exists() else None
    if output.exists() and not (add or force):
        raise UsageError(f"{output} exists; --add keeps its rows and adds other files, --force writes it anew")
    refuse_existing(output, force=force or add)
    found = find_exams(folder, output, listed=before.rows if before else ())
    for line in found.skipped:
        click.echo(f"left out: {line}", err=True)
    if before is None:
        if not found.rows:
            raise BadDataError(
                "holds no scan (.mcap, .npz) and no map (.nc)", way_out="give the folder of the scans", path=str(folder)
            )
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
    _say_names("listed, and not there any more", found.gone)
    if found.others:
        kinds = ", ".join(sorted(found.others))
        click.echo(f"passed over: {sum(found.others.values())} other files ({kinds})")
    nameless = sum(not row["patient"] for row in rows)
    if nameless:
        click.echo(f"{nameless} of them do not say whose they are: fill in the column patient")
    elif told := _to_correct(output):
        click.echo(f"to correct before the run: {told}")
    folder = shlex.quote(str(output.with_name("out")))
    click.echo(f"next: tactile-bayes campaign run {shlex.quote(str(output))} -o {folder} --dry-run")
    click.echo(RESEARCH_USE)


def _to_correct(output: Path) -> str:
    """Why `campaign run` would refuse the table; empty where it would take it."""
    try:
        read_manifest(output)
    except BadDataError as error:
        return str(error)
    return ""


def campaign_run_action(
    exams: Path,
    output: Path,
    excision: Path | None,
    columns: Path | None,
    protocol: Path | None,
    settings_file: Path | None,
    normalise: str,
    match_mm: float,
    repeatability: str | None,
    figures: bool,
    dry_run: bool,
    copy_to: str | None,
    workers: int,
    scheduler: str | None,
    **asked: Any,
) -> None:
    """Map, estimate and pool the exams of a table, and report the trial."""
    given = None if repeatability in (None, NONE) else Path(str(repeatability))
    also_read(given)
    settings = settings_of(settings_file=settings_file, repeatability=given, **asked)
    of_all = CampaignSettings(
        settings,
        normalise,
        figures,
        match_mm,
        own_repeatability=repeatability is None,
        copy_to="" if copy_to is None else check_address(copy_to),
    )
    table = read_manifest(exams)
    _check_paths(table, output, of_all)
    refuse_same(
        [output / name for name in WRITTEN],
        [path for path in (exams, excision, columns, protocol, settings_file, given) if path],
    )
    if columns is not None and excision is None:
        raise UsageError("--columns is the layout of the excision table; give --excision too")
    measured = None if excision is None else Excision(excision, columns)
    check_inputs(table, measured, protocol)
    with (
        open_campaign(output, dry=dry_run) as store,
        open_executor(workers=workers, cluster=None if dry_run else scheduler) as executor,
    ):
        place = Path(os.path.abspath(output))  # noqa: PTH100 (links stay links)
        bar = partial(progress_bar, log_every_s=_LOG_EVERY_S, time_left=False)
        campaign = Campaign(table, place, of_all, store=store, executor=executor, dry=dry_run, bar=bar)
        campaign.run()
        if not dry_run:
            left = tidy(place, table, campaign.found.results, unread=campaign.unread)
            written = write_outputs(campaign, measured, protocol)
            if of_all.copy_to:
                copy_outputs(place, of_all.copy_to)
    if dry_run:
        _say_plan(campaign)
    else:
        _say_done(campaign, written, output, left)
    if dry_run or not written.report:  # which ends with it
        click.echo(RESEARCH_USE)


def _check_paths(table: Sequence[Exam], output: Path, settings: CampaignSettings) -> None:
    """Refuse exams inside the output folder, an output folder that is a file, and a checkpoint for many maps."""
    if output.exists() and not output.is_dir():
        raise UsageError(f"{output} is a file; give the name of a folder")
    if settings.estimate.checkpoint is not None:
        raise UsageError("a checkpoint is for one map; leave it out of the settings file")
    folder = Path(os.path.realpath(output))
    local = [exam for exam in table if not exam.address]
    inside = next((exam.file for exam in local if Path(os.path.realpath(exam.path)).is_relative_to(folder)), None)
    if inside is not None:
        raise UsageError(f"{inside} lies in the output folder {output}; choose another folder")
    for name in {settings.of(exam).size_calibration for exam in table} - {None}:
        also_read(size_calibration_path(str(name)))


def _say_plan(campaign: Campaign) -> None:
    found = campaign.found
    for step, todo in found.todo.items():
        named = f" ({', '.join(found.names[step])})" if _few(found, step) and found.kept[step] else ""
        click.echo(f"{step}: {todo} to do{named}, {found.kept[step]} done")
    for name, fault in list(found.faults.items())[:_MOST_NAMED]:
        click.echo(f"{name}: {fault.step} failed: {fault.reason}")
    if len(found.faults) > _MOST_NAMED:
        click.echo(f"{len(found.faults) - _MOST_NAMED} more failed")
    click.echo("Nothing was run.")


def _few(found: CampaignState, step: str) -> bool:
    """Whether all exams or masses that need a step are known by name, and fit a line."""
    return 0 < found.todo[step] == len(found.names[step])


def _say_done(campaign: Campaign, written: Written, output: Path, left: Sequence[str]) -> None:
    found = campaign.found
    counts = counts_words(written.sized, written.unsized, written.failed)
    click.echo(f"{output}: {len(campaign.exams)} exams: {counts}")
    if written.pooled:
        click.echo(f"{written.pooled} masses pooled, each at one visit")
    elif campaign.not_pooled:
        click.echo(f"no mass pooled: {campaign.not_pooled}")
    if line := repeatability_words(campaign):
        click.echo(line)
    if written.growth:
        click.echo(written.growth)
    click.echo(f"{sum(found.todo.values())} steps run, {sum(found.kept.values())} kept from earlier runs")
    if any(found.kept.values()):
        for step, todo in found.todo.items():
            more = "" if _few(found, step) else f" and {todo - len(found.names[step])} more"
            if todo:
                click.echo(f"{step} run: {', '.join(found.names[step])}{more}")
    for name, fault in list(found.faults.items())[:_MOST_NAMED]:
        click.echo(f"failed: {name}: {fault.step}: {fault.reason}", err=True)
    if len(found.faults) > _MOST_NAMED:
        click.echo(f"failed: {len(found.faults) - _MOST_NAMED} more, see failures.csv", err=True)
    _say_names("no size after excision, left out of trial.csv", written.left_out)
    _say_names("masses whose exams disagree, without a pooled size", written.disagreeing)
    _say_names("exams with a mass that no row names, see their findings", written.unnamed)
    _say_names("folders of exams that the table does not list", left)
    if written.report:
        click.echo(written.report, nl=False)
    elif written.no_report:
        click.echo(f"no trial report: {written.no_report}")


def _say_names(words: str, names: Sequence[str]) -> None:
    if names:
        more = f" and {len(names) - _MOST_NAMED} more" if len(names) > _MOST_NAMED else ""
        click.echo(f"{words}: {', '.join(names[:_MOST_NAMED])}{more}")
