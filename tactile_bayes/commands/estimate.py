"""`estimate`: estimate sizes from tactile maps."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from tactile_bayes.api.estimating import Answer, answer_file, answer_of, estimate_file
from tactile_bayes.api.settings import Settings, refuse_checkpoint
from tactile_bayes.commands.options import (
    FORCE,
    METAVAR,
    FigurePath,
    FilePath,
    also_read,
    scheduler_option,
    settings_of,
    takes,
)
from tactile_bayes.errors import EXIT_DONE, EXIT_FAULT, EXIT_NO_ESTIMATE, UsageError

if TYPE_CHECKING:
    from tactile_bayes.api.estimating import Outcome as MapOutcome
    from tactile_bayes.batch import Outcome

_FILE = FilePath()


@click.command("estimate")
@click.argument("maps", metavar="MAP.nc...", nargs=-1, required=True, type=_FILE)
@takes(Settings, "size_calibration", "method", "seed", "interval")
@click.option(
    "-o",
    "--output",
    metavar="POST.nc",
    type=FilePath(writes="netCDF"),
    help="Write all draws (netCDF that arviz opens).",
)
@click.option("--json", "as_json", is_flag=True, help="Print JSON: one object, or a list for several maps.")
@click.option(
    "--figure", metavar=METAVAR, type=FigurePath(), help="Draw the size posterior, or the map where there is no size."
)
@click.option(
    "--map-figure",
    metavar=METAVAR,
    type=FigurePath(),
    help="Draw the map with the lump's size, or with the places looked at.",
)
@click.option(
    "--fit-figure",
    metavar=METAVAR,
    type=FigurePath(),
    help="Draw data, fit and residual of the fit window, or the map where there is no estimate.",
)
@takes(Settings, "centre_mm", "scene", "settings_file", "accuracy_sd", "known", "repeatability")
@click.option("--pool", is_flag=True, help="Pool the maps, all of one mass, into one size.")
@click.option(
    "--workers",
    type=click.IntRange(min=1),
    default=1,
    show_default=True,
    help="Number of worker processes, for several maps.",
)
@scheduler_option("several maps")
@FORCE
@click.option(
    "-v", "--verbose", is_flag=True, help="Print the full report instead of 12 lines, and the time taken on stderr."
)
@click.pass_context
def command(
    ctx: click.Context,
    /,
    maps: tuple[Path, ...],
    output: Path | None,
    as_json: bool,
    figure: Path | None,
    map_figure: Path | None,
    fit_figure: Path | None,
    pool: bool,
    workers: int,
    scheduler: str | None,
    force: bool,
    verbose: bool,
    **asked: Any,
) -> None:
    """Estimate a lump's size from tactile maps, with a credible interval.

    Every posterior draw of the map's Gaussian (Eq 7) goes through a size calibration with a draw of its coefficients
    and of what no map shows. Where the map shows no lump that can be measured there is no number: the reason is
    printed and the exit code is 6. With --pool the maps are repeats of one mass, and their spread is learned. Where a
    map tells how deep the fat under the head is, sizes are for that depth; where not, the report says so.

    Example: tactile-bayes estimate map.nc --figure size.png
    """
    settings, size_calibration = settings_of(**asked), asked["size_calibration"]
    if len(maps) > 1:
        refuse_checkpoint(settings)
    if figure is not None and size_calibration == "none":
        raise UsageError("--figure draws sizes and needs a --size-calibration; --map-figure draws the fit")
    outputs = {"output": output, "figure": figure, "map figure": map_figure, "fit figure": fit_figure}
    _check_outputs([path for path in outputs.values() if path], maps, pool, force=force)
    also_read(_named(size_calibration))
    begun = time.perf_counter()
    if pool:
        from tactile_bayes.commands.estimate_pool import estimate_pool

        if map_figure or fit_figure:
            raise UsageError("--map-figure and --fit-figure draw one map; leave out --pool")
        answers = _many_maps(maps, settings, workers=workers, scheduler=scheduler)
        printed = {"as_json": as_json, "verbose": verbose}
        ctx.exit(estimate_pool(maps, answers, settings, output, figure, **printed, force=force))
    if len(maps) == 1:
        outcome = _one_map(maps[0], settings)
        answers = [answer_of(outcome)]
    else:
        outcome = None
        with _printed_if_interrupted(maps, as_json=as_json, verbose=verbose):
            answers = _many_maps(maps, settings, workers=workers, scheduler=scheduler)
    try:
        if outcome is not None:
            _write(outcome, answers[0], output, (figure, map_figure, fit_figure), name=maps[0].stem, force=force)
    finally:  # what was computed is not lost with a file
        if verbose:
            print(f"estimate: {time.perf_counter() - begun:.3f} s", file=sys.stderr)
        _print(maps, answers, as_json=as_json, verbose=verbose, listed=len(maps) > 1)
    ctx.exit(_exit_code(answers))


def _named(calibration: str | None) -> Path | None:
    from tactile_bayes.files.shipped import size_calibration_path

    return None if calibration is None else size_calibration_path(calibration)


def _check_outputs(outputs: list[Path], maps: tuple[Path, ...], pool: bool, *, force: bool) -> None:
    """Raise an error, before any work is done, if an output cannot be written."""
    from tactile_bayes.files.atomic import given_twice, refuse_existing

    if twice := given_twice(maps):
        raise UsageError(f"{twice} is given twice; give each map once")
    if outputs and len(maps) > 1 and not pool:
        raise UsageError("--output and the figures take one map at a time; use --json for several")
    for path in outputs:
        refuse_existing(path, force=force)


def _one_map(path: Path, settings: Settings) -> MapOutcome:
    from tactile_bayes.commands.progress import progress_bar

    with progress_bar("effective draws") as progress:
        return estimate_file(
            path, settings, progress=progress, notice=lambda line: click.echo(f"{path}: {line}", err=True)
        )


def _write(
    outcome: MapOutcome,
    answer: Answer,
    output: Path | None,
    figures: tuple[Path | None, Path | None, Path | None],
    *,
    name: str,
    force: bool,
) -> None:
    tactile_map, estimate = outcome.tactile_map, outcome.estimate
    if output and estimate.status == "estimate":
        outcome.write(output, document=answer.document, force=force)
    if any(figures):
        from tactile_bayes.report.estimate_figures import draw_figures
        from tactile_bayes.report.figure_file import named_exam

        name = named_exam(name, outcome.provenance.scans)
        draw_figures(tactile_map, estimate, *figures, name=name, probability=outcome.settings.interval, force=force)


def _many_maps(maps: tuple[Path, ...], settings: Settings, *, workers: int, scheduler: str | None) -> list[Answer]:
    from functools import partial

    from tactile_bayes.batch import cluster_executor, local_executor, run_batch
    from tactile_bayes.commands.progress import progress_bar

    chosen = cluster_executor(scheduler) if scheduler else local_executor(min(workers, len(maps)))
    with chosen as executor, progress_bar("maps") as progress:
        outcomes = run_batch(
            partial(answer_file, settings=settings), maps, key=str, executor=executor, progress=progress
        )
    return _answers(outcomes)


def _answers(outcomes: Iterable[Outcome[Answer]]) -> list[Answer]:
    """Answers for all maps; maps with the same error of the batch are named together in the first's answer."""
    from tactile_bayes.batch import fault_lines

    found = list(outcomes)
    lines = dict(zip(dict.fromkeys(one.error for one in found if not one.ok), fault_lines(found), strict=True))
    faults = (lines.pop(one.error, "") if not one.ok else "" for one in found)
    return [
        one.value if one.value is not None else Answer(None, f"error: {fault}" if fault else "", EXIT_FAULT)
        for one, fault in zip(found, faults, strict=True)
    ]


@contextmanager
def _printed_if_interrupted(maps: tuple[Path, ...], *, as_json: bool, verbose: bool) -> Iterator[None]:
    """On Ctrl-C print the finished answers, and pass the interruption on."""
    from tactile_bayes.batch import BatchInterrupted

    try:
        yield
    except BatchInterrupted as stop:
        done = {one.key for one in stop.outcomes}
        finished = [path for path in maps if str(path) in done]
        _print(finished, _answers(stop.outcomes), as_json=as_json, verbose=verbose, listed=True)
        raise


def _print(maps: Sequence[Path], answers: list[Answer], *, as_json: bool, verbose: bool, listed: bool) -> None:
    """Print errors on stderr and answers on stdout: in full with `verbose`, `listed` for several maps."""
    from tactile_bayes.files.documents import check_document, dump_json

    for answer in answers:
        if answer.document is None and answer.text:
            click.echo(answer.text, err=True)
    if as_json:
        documents = [answer.document for answer in answers if answer.document is not None]
        for document in documents:
            check_document(document, "estimate.schema.json", path=Path("the report"))
        click.echo(dump_json(documents if listed else documents[0]), nl=False)
        return
    for path, answer in zip(maps, answers, strict=True):
        if answer.document is not None:
            click.echo((f"{path}\n" if listed else "") + (answer.full_text if verbose else answer.text), nl=listed)


def _exit_code(answers: list[Answer]) -> int:
    """The first error's code, else 6 when a map gave no estimate, else 0."""
    failed = [answer.exit_code for answer in answers if answer.document is None]
    if failed:
        return failed[0]
    return EXIT_NO_ESTIMATE if any(answer.exit_code for answer in answers) else EXIT_DONE
