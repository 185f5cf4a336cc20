"""`plan`: sample size of a trial, and the value of more maps per mass."""

from __future__ import annotations

from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from tactile_bayes.commands.options import FORCE, JSON, MOST_ITEMS, WORKERS, FilePath, FiniteRange, seed_option
from tactile_bayes.errors import UsageError

if TYPE_CHECKING:
    from tactile_bayes.trial.planning import PlanCase

SCHEMA = "tactile-bayes/plan/1"
_FILE = FilePath()
# ln size: 3 is a factor of 20.
_BIAS, _SD = FiniteRange(-3, 3), FiniteRange(0, 3)
_ERRORS = ("tactile_bias", "mass_sd", "map_sd", "other_bias", "other_sd", "other_miss")


@click.command("plan")
@click.option(
    "--patients",
    type=click.IntRange(8, 10_000),
    multiple=True,
    default=(16, 24, 32, 48),
    show_default=True,
    help="Number of patients, one mass each.",
)
@click.option(
    "--maps",
    type=click.IntRange(1, 1000),
    multiple=True,
    default=(1, 3, 5),
    show_default=True,
    help="Number of tactile maps per mass.",
)
@click.option("--tactile-bias", type=_BIAS, default=0.02, show_default=True, help="Mean of ln(size / ex vivo).")
@click.option("--mass-sd", type=_SD, default=0.18, show_default=True, help="SD of ln size shared by a mass's maps.")
@click.option("--map-sd", type=_SD, default=0.15, show_default=True, help="SD of ln size of single maps.")
@click.option(
    "--other-bias",
    type=_BIAS,
    default=-0.08,
    show_default=True,
    help="Mean of ln(size / ex vivo) of the modality compared with.",
)
@click.option(
    "--other-sd", type=_SD, default=0.40, show_default=True, help="SD of ln size of the modality compared with."
)
@click.option(
    "--other-miss",
    type=FiniteRange(0, 1),
    default=0.04,
    show_default=True,
    help="Share of masses that the modality compared with misses.",
)
@click.option(
    "--pilot",
    metavar="TRIAL.csv",
    type=_FILE,
    help="Take the errors that no option gives from this trial; needs --excision.",
)
@click.option("--excision", metavar="EX.csv", type=_FILE, help="Sizes measured after excision in the pilot.")
@click.option("--against", default="ultrasound", show_default=True, help="Modality of the pilot to compare with.")
@click.option(
    "--trials",
    type=click.IntRange(50, MOST_ITEMS),
    default=1000,
    show_default=True,
    help="Number of simulated trials per design.",
)
@seed_option(1999)
@WORKERS
@JSON
@click.option(
    "-o", "--output", metavar="PLAN.json", type=FilePath(writes="JSON"), help="Write the plan as JSON to this file."
)
@FORCE
def command(
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
    """Plan a trial: power, widths of intervals and the worth of more maps, by simulation.

    Each design is simulated with log-normal errors. Power is the share of trials in which the tactile percent error is
    the smaller one and a sign-flip test by patient finds p < 0.05. SDs are of ln size: 0.15 is about 15 %.

    Example: tactile-bayes plan --patients 24 --patients 40 --maps 3 --maps 5 -o plan.json
    """
    from tactile_bayes.files.atomic import refuse_existing, write_text
    from tactile_bayes.files.documents import check_document, dump_json
    from tactile_bayes.trial.planning import designs

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
        click.echo(dump_json(document) if as_json else _text(document), nl=False)


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
    import numpy as np

    from tactile_bayes.api.trials import load_trial
    from tactile_bayes.commands.options import also_read
    from tactile_bayes.errors import BadDataError
    from tactile_bayes.trial.planning import assumptions_from
    from tactile_bayes.trial.readings import gather, unit_doubts

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
    from tactile_bayes.batch import open_executor, run_batch
    from tactile_bayes.commands.progress import progress_bar
    from tactile_bayes.errors import BadDataError
    from tactile_bayes.trial.planning import run_case

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
    from tactile_bayes.files.provenance import Provenance, hash_inputs
    from tactile_bayes.presets import RESEARCH_USE
    from tactile_bayes.trial.planning import map_gains

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


def _text(document: dict[str, Any]) -> str:
    from tactile_bayes.report.trial import plan_text

    return plan_text(document)
