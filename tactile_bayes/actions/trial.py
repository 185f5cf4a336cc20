"""Trials: a campaign run, a trial validated or planned, printed and written."""

from __future__ import annotations

import os
import shlex
from collections.abc import Mapping, Sequence
from functools import partial
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import numpy as np

from tactile_bayes.api.trials import analyse, load_trial
from tactile_bayes.batch import open_executor, run_batch
from tactile_bayes.campaigns.exams import find_exams
from tactile_bayes.campaigns.inputs import open_campaign, tidy
from tactile_bayes.campaigns.report import (
    WRITTEN,
    Excision,
    check_inputs,
    copy_outputs,
    counts_words,
    repeatability_words,
    write_outputs,
)
from tactile_bayes.campaigns.run import Campaign
from tactile_bayes.campaigns.settings import CampaignSettings
from tactile_bayes.commands.options import also_read, refuse_same, settings_of
from tactile_bayes.commands.progress import progress_bar
from tactile_bayes.declarations import EXACT, names_of, to_plain
from tactile_bayes.errors import BadDataError, UsageError
from tactile_bayes.files.atomic import refuse_existing, write_text
from tactile_bayes.files.documents import dump_json, read_protocol
from tactile_bayes.files.manifest_csv import add_rows, read_manifest, read_rows, write_manifest
from tactile_bayes.files.provenance import Provenance, hash_inputs
from tactile_bayes.files.reading import check_address
from tactile_bayes.files.size_json import NONE, size_calibration_path
from tactile_bayes.options import PlanErrors, TrialSettings
from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.report.trial import plan_text
from tactile_bayes.trial.planning import Design, ErrorSource, PlanReport, assumptions_from, designs, map_gains, run_case
from tactile_bayes.trial.readings import unit_doubts

if TYPE_CHECKING:
    from tactile_bayes.campaigns.exams import Found
    from tactile_bayes.campaigns.report import Written
    from tactile_bayes.campaigns.run import CampaignState
    from tactile_bayes.files.manifest_csv import Exam
    from tactile_bayes.trial.planning import PlanCase


# --- A trial validated or planned, printed and written.

# --- `validate`: compare each modality with excision.


def validate_action(
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
    """Compare sizes with excision: errors, lines, agreement, repeatability and calibration of each modality."""
    for target in (output, html):
        if target:
            refuse_existing(target, force=force)
    title, chosen = _settings(settings, protocol)
    inputs = load_trial(trial, excision, columns)
    also_read(*inputs.files.values())
    found = analyse(inputs, chosen, protocol=protocol, title=title)
    try:
        if output:
            found.write_json(output, force=force)
        if html:
            found.write_html(html, force=force)
    finally:  # what was computed is not lost with a file
        if as_json:
            for doubt in found.report.doubts:
                click.echo(f"doubtful: {doubt}", err=True)
        click.echo(dump_json(found.document) if as_json else found.told(methods=methods), nl=False)


def _settings(given: dict[str, Any], protocol: Path | None) -> tuple[str | None, TrialSettings]:
    """Title and settings of the protocol, if there is one; refuses options that contradict it."""
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


# --- `plan`: sample size of a trial, and the value of more maps per mass.

_ERRORS = names_of(PlanErrors)


def plan_action(
    patients: tuple[int, ...],
    maps: tuple[int, ...],
    pilot: Path | None,
    excision: Path | None,
    against: str,
    trials: int,
    seed: int,
    workers: int,
    as_json: bool,
    output: Path | None,
    force: bool,
    **errors: float,
) -> None:
    """Plan a trial: power, widths of intervals and the worth of more maps, by simulation."""
    if output:
        refuse_existing(output, force=force)
    typed = _typed()
    files: dict[str, Path] = {}
    if pilot is not None:
        if excision is None:
            raise UsageError("--pilot needs --excision; give the pilot's excision table")
        if against == "tactile":
            raise UsageError("--against tactile compares tactile sizes with themselves; name another modality")
        given = {name: errors[name] for name in _ERRORS if name in typed}
        errors, files = _from_pilot(pilot, excision, against, given), {"pilot": pilot, "excision": excision}
    elif unused := [name for name in ("excision", "against") if name in typed]:
        raise UsageError(f"--{unused[0]} says how a pilot is read; give --pilot TRIAL.csv, or leave it out")
    cases = list(designs(sorted(set(patients)), sorted(set(maps)), **errors, trials=trials, seed=seed))
    sources = _sources(typed, pilot=pilot is not None)
    plan = _plan(cases, _simulate(cases, workers=workers), errors, sources, files)
    written = dump_json(to_plain(plan, digits=EXACT))
    try:
        if output:
            write_text(output, written, force=force)
    finally:  # what was computed is not lost with the file
        click.echo(written if as_json else plan_text(plan), nl=False)


def _sources(typed: set[str], *, pilot: bool) -> dict[str, ErrorSource]:
    """Source of each assumed error: an option, the pilot or the default."""
    return {name: "option" if name in typed else "pilot" if pilot else "default" for name in _ERRORS}


def _typed() -> set[str]:
    """Options given on the command line."""
    context = click.get_current_context()
    return {
        name for name in context.params if context.get_parameter_source(name) is click.core.ParameterSource.COMMANDLINE
    }


def _from_pilot(pilot: Path, excision: Path, against: str, given: dict[str, float]) -> dict[str, float]:
    """Errors from the pilot, where no option gives them."""
    inputs = load_trial(pilot, excision, None)
    also_read(*inputs.files.values())
    for line in inputs.other_visits.lines():
        click.echo(f"{pilot}: {line}", err=True)
    sizes = inputs.sizes()
    for doubt in unit_doubts(sizes, np.array(list(inputs.ex_vivo_mm.values()))):
        click.echo(f"{pilot}: doubtful: {doubt}", err=True)
    for name in ("tactile", against):
        if name not in sizes:
            way_out = f"it has {', '.join(sizes)}; choose one with --against"
            raise BadDataError(f"holds no readings by {name}", way_out=way_out, path=str(pilot))
    found = assumptions_from(sizes["tactile"], sizes[against], map_sd=given.get("map_sd"))
    if found is None:
        way_out = "give the errors by options"
        raise BadDataError("has fewer than 3 masses found by a modality", way_out=way_out, path=str(pilot))
    if "map_sd" not in found:
        what = "has no mass with two tactile readings, so the SD of single maps is unknown"
        raise BadDataError(what, way_out="give it with --map-sd", path=str(pilot))
    return found | given


def _simulate(cases: list[PlanCase], *, workers: int) -> list[Design]:
    with open_executor(workers=workers) as executor, progress_bar("designs") as progress:
        outcomes = run_batch(run_case, cases, key=attrgetter("key"), executor=executor, progress=progress)
    for outcome in outcomes:
        if outcome.value is None:
            raise BadDataError(f"{outcome.key}: {outcome.error}", way_out="change the errors assumed")
    return [outcome.value for outcome in outcomes if outcome.value is not None]


def _plan(
    cases: list[PlanCase],
    found: list[Design],
    errors: dict[str, float],
    sources: dict[str, ErrorSource],
    files: dict[str, Path],
) -> PlanReport:
    assumed = {name: float(f"{errors[name]:.9g}") for name in _ERRORS}
    settings = {"trials": cases[0].trials, "errors": assumed, "errors_from": sources}
    return PlanReport(
        schema="tactile-bayes/plan/1",
        errors=assumed,
        errors_from=sources,
        designs=tuple(found),
        gains=map_gains(found),
        provenance=Provenance("plan", settings, hash_inputs(**files), seed=cases[0].seed).as_dict(),
        research_use=RESEARCH_USE,
    )


# --- `campaign`: from a folder of exams to the trial's report.

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
