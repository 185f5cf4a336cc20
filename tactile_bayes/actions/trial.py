"""A trial validated or planned, printed and written."""

from __future__ import annotations

from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import numpy as np

from tactile_bayes.api.trial_report import TrialOutcome, TrialSettings, analyse
from tactile_bayes.api.trials import load_trial
from tactile_bayes.batch import open_executor, run_batch
from tactile_bayes.commands.options import also_read
from tactile_bayes.commands.progress import progress_bar
from tactile_bayes.errors import BadDataError, UsageError
from tactile_bayes.files.atomic import refuse_existing, write_text
from tactile_bayes.files.documents import check_document, dump_json, read_protocol
from tactile_bayes.files.provenance import Provenance, hash_inputs
from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.report.trial import plan_text, trial_text
from tactile_bayes.report.trial_html import trial_html
from tactile_bayes.trial.planning import assumptions_from, designs, map_gains, run_case
from tactile_bayes.trial.readings import gather, unit_doubts

if TYPE_CHECKING:
    from tactile_bayes.trial.planning import PlanCase


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
    more = [] if outcome.next_mass is None else outcome.next_mass.lines()
    return trial_text(outcome.report, methods=methods, checks=outcome.checks, more=more)


def _write_html(path: Path, outcome: TrialOutcome, *, force: bool) -> None:
    write_text(path, trial_html(outcome.report, outcome.document, text=_text(outcome, methods=True)), force=force)


# --- `plan`: sample size of a trial, and the value of more maps per mass.

SCHEMA = "tactile-bayes/plan/1"
_ERRORS = ("tactile_bias", "mass_sd", "map_sd", "other_bias", "other_sd", "other_miss")


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
    document = _document(cases, _simulate(cases, workers=workers), errors, sources, files)
    check_document(document, "plan.schema.json", path=output or Path("the plan"))
    try:
        if output:
            write_text(output, dump_json(document), force=force)
    finally:  # what was computed is not lost with the file
        click.echo(dump_json(document) if as_json else _plan_text(document), nl=False)


def _sources(typed: set[str], *, pilot: bool) -> dict[str, str]:
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
    sizes = gather(inputs.readings, inputs.ex_vivo_mm)
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


def _simulate(cases: list[PlanCase], *, workers: int) -> list[dict[str, Any]]:
    with open_executor(workers=workers) as executor, progress_bar("designs") as progress:
        outcomes = run_batch(run_case, cases, key=attrgetter("key"), executor=executor, progress=progress)
    for outcome in outcomes:
        if outcome.value is None:
            raise BadDataError(f"{outcome.key}: {outcome.error}", way_out="change the errors assumed")
    return [outcome.value for outcome in outcomes if outcome.value is not None]


def _document(
    cases: list[PlanCase],
    results: list[dict[str, Any]],
    errors: dict[str, float],
    sources: dict[str, str],
    files: dict[str, Path],
) -> dict[str, Any]:
    by_design = {(case.patients, case.maps): result for case, result in zip(cases, results, strict=True)}
    assumed = {name: float(f"{errors[name]:.9g}") for name in _ERRORS}
    settings = {"trials": cases[0].trials, "errors": assumed, "errors_from": sources}
    return {
        "schema": SCHEMA,
        "errors": assumed,
        "errors_from": sources,
        "designs": [{"patients": n, "maps": m, **result} for (n, m), result in by_design.items()],
        "gains": map_gains(by_design),
        "provenance": Provenance("plan", settings, hash_inputs(**files), seed=cases[0].seed).as_dict(),
        "research_use": RESEARCH_USE,
    }


def _plan_text(document: dict[str, Any]) -> str:
    return plan_text(document)
