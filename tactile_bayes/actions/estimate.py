"""`estimate`: sizes from tactile maps, and one size of several maps of a mass."""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import click

from tactile_bayes.api.estimating import answer_file, estimate_file
from tactile_bayes.api.pooled import pool_answers
from tactile_bayes.api.settings import Settings, refuse_checkpoint
from tactile_bayes.api.sized import Answer, Failure
from tactile_bayes.batch import BatchInterrupted, Outcome, fault_lines, open_executor, run_batch
from tactile_bayes.commands.options import make_settings
from tactile_bayes.declarations import replace
from tactile_bayes.errors import EXIT_DONE, EXIT_FAULT, EXIT_NO_ESTIMATE, UsageError
from tactile_bayes.files.atomic import first_duplicate
from tactile_bayes.files.documents import dump_json
from tactile_bayes.files.reports import json_text
from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.report.pooled import elsewhere, pooled_summary, pooled_text
from tactile_bayes.shell import progress_bar

Answers = Sequence[Answer | Failure]


def estimate_pool(
    maps: tuple[Path, ...],
    answers: Answers,
    settings: Settings,
    output: Path | None,
    figure: Path | None,
    *,
    as_json: bool,
    verbose: bool,
    force: bool,
) -> int:
    """Pool the maps, print and write the result; return the exit code.

    A map that could not be read stops it: its error is printed, for a mass is not sized from what is left by accident.
    """
    if failed := [one for one in answers if isinstance(one, Failure)]:
        for one in failed:
            click.echo(one.text, err=True)
        return failed[0].exit_code
    same = [one for one in answers if isinstance(one, Answer)]
    if settings.centre_mm is None:
        for i, place in elsewhere([one.report for one in same]).items():
            same[i] = estimate_file(maps[i], replace(settings, centre_mm=place)).answer
    found = pool_answers(same, settings, names=[str(one) for one in maps], files=maps)
    report = found.pooled_report.checked()
    text_of = json_text if as_json else pooled_text if verbose else pooled_summary
    try:
        if found.pooled.size is not None and output is not None:
            found.write(output, force=force)
        if found.pooled.size is not None and figure is not None:
            found.plot(figure, force=force)
    finally:  # what was computed is not lost with a file
        click.echo(text_of(report), nl=False)
    return EXIT_DONE if found.pooled.size is not None else EXIT_NO_ESTIMATE


def estimate_action(
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
) -> int:
    """Estimate a lump's size from tactile maps, with a credible interval."""
    settings = make_settings(**asked)
    if len(maps) > 1:
        refuse_checkpoint(settings)
    if figure is not None and settings.size_calibration == "none":
        raise UsageError("--figure draws sizes and needs a --size-calibration; --map-figure draws the fit")
    outputs = (output, figure, map_figure, fit_figure)
    if twice := first_duplicate(maps):
        raise UsageError(f"{twice} is given twice; give each map once")
    if any(outputs) and len(maps) > 1 and not pool:
        raise UsageError("--output and the figures take one map at a time; use --json for several")
    begun = time.perf_counter()
    answers: Answers
    if pool:
        if map_figure or fit_figure:
            raise UsageError("--map-figure and --fit-figure draw one map; leave out --pool")
        answers = _many_maps(maps, settings, workers=workers, scheduler=scheduler)
        return estimate_pool(maps, answers, settings, output, figure, as_json=as_json, verbose=verbose, force=force)
    if len(maps) == 1:
        with progress_bar("effective draws") as progress:
            found = estimate_file(
                maps[0], settings, progress=progress, notice=lambda line: click.echo(f"{maps[0]}: {line}", err=True)
            )
        answers = [found.answer]
    else:
        found = None
        try:
            answers = _many_maps(maps, settings, workers=workers, scheduler=scheduler)
        except BatchInterrupted as stop:
            done = {one.key for one in stop.outcomes}
            finished = [path for path in maps if str(path) in done]
            _print(finished, _answers(stop.outcomes), as_json=as_json, verbose=verbose, listed=True)
            raise
    try:
        if found is not None and output and found.status == "estimate":
            found.write(output, force=force)
        if found is not None and found.tactile_map.covered.any():  # one without data cannot be drawn
            for path, draw in zip(outputs[1:], (found.plot, found.plot_map, found.plot_fit), strict=True):
                if path is not None:
                    draw(path, force=force)
    finally:  # what was computed is not lost with a file
        took_s = time.perf_counter() - begun
        _print(maps, answers, as_json=as_json, verbose=verbose, listed=len(maps) > 1)
        if verbose:
            click.echo(f"estimate: {took_s:.3f} s", err=True)
    failed = [one.exit_code for one in answers if isinstance(one, Failure)]
    return failed[0] if failed else max(one.exit_code for one in answers)


def _many_maps(maps: tuple[Path, ...], settings: Settings, *, workers: int, scheduler: str | None) -> Answers:
    chosen = open_executor(workers=min(workers, len(maps)), cluster=scheduler)
    with chosen as executor, progress_bar("maps") as progress:
        outcomes = run_batch(
            partial(answer_file, settings=settings), maps, key=str, executor=executor, progress=progress
        )
    return _answers(outcomes)


def _answers(outcomes: Iterable[Outcome[Answer | Failure]]) -> Answers:
    """Answers for all maps; maps with the same error of the batch are named together in the first's answer."""
    found = list(outcomes)
    lines = dict(zip(dict.fromkeys(one.error for one in found if not one.ok), fault_lines(found), strict=True))
    faults = (lines.pop(one.error, "") if not one.ok else "" for one in found)
    return [
        one.value if one.value is not None else Failure(f"error: {fault}" if fault else "", EXIT_FAULT)
        for one, fault in zip(found, faults, strict=True)
    ]


def _print(maps: Sequence[Path], answers: Answers, *, as_json: bool, verbose: bool, listed: bool) -> None:
    """Print errors on stderr and answers on stdout: in full with `verbose`, `listed` for several maps."""
    for one in answers:
        if isinstance(one, Failure) and one.text:
            click.echo(one.text, err=True)
    if as_json:
        documents = [one.report.checked().document for one in answers if isinstance(one, Answer)]
        click.echo(dump_json(documents if listed else documents[0]), nl=False)
        return
    texts = [
        (f"{path}\n" if listed else "") + (one.full_text if verbose else one.text)
        for path, one in zip(maps, answers, strict=True)
        if isinstance(one, Answer)
    ]
    click.echo("\n".join([*(one.replace(f"{RESEARCH_USE}\n", "") for one in texts[:-1]), *texts[-1:]]), nl=False)
