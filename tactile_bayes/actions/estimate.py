"""`estimate`: sizes from tactile maps, and one size of several maps of a mass."""

from __future__ import annotations

import time
from collections.abc import Sequence
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
from tactile_bayes.report.pooled import maps_of_another_mass, pooled_summary, pooled_text
from tactile_bayes.shell import progress_bar

Answers = Sequence[Answer | Failure]


def _pool(
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

    If one of the maps cannot be read, its error is printed and nothing is pooled.
    """
    if failures := [one for one in answers if isinstance(one, Failure)]:
        for failure in failures:
            click.echo(failure.text, err=True)
        return failures[0].exit_code
    exams = [answer for answer in answers if isinstance(answer, Answer)]
    if settings.centre_mm is None:
        for i, place in maps_of_another_mass([exam.report for exam in exams]).items():
            exams[i] = estimate_file(maps[i], replace(settings, centre_mm=place)).answer
    result = pool_answers(exams, settings, names=[str(path) for path in maps], files=maps)
    report = result.pooled_report.checked()
    text_of = json_text if as_json else pooled_text if verbose else pooled_summary
    sized = result.pooled.size is not None
    try:
        if sized and output is not None:
            result.write(output, force=force)
        if sized and figure is not None:
            result.plot(figure, force=force)
    finally:  # a file that cannot be written loses no result
        click.echo(text_of(report), nl=False)
    return EXIT_DONE if sized else EXIT_NO_ESTIMATE


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
    **options: Any,
) -> int:
    """Estimate a lump's size from tactile maps, with a credible interval."""
    settings = make_settings(**options)
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
        return _pool(maps, answers, settings, output, figure, as_json=as_json, verbose=verbose, force=force)
    if len(maps) == 1:
        with progress_bar("effective draws") as progress:
            estimate = estimate_file(
                maps[0], settings, progress=progress, notice=lambda line: click.echo(f"{maps[0]}: {line}", err=True)
            )
        answers = [estimate.answer]
    else:
        estimate = None
        try:
            answers = _many_maps(maps, settings, workers=workers, scheduler=scheduler)
        except BatchInterrupted as interrupt:
            done = {outcome.key for outcome in interrupt.outcomes}
            finished = [path for path in maps if str(path) in done]
            _print(finished, _answers(interrupt.outcomes), as_json=as_json, verbose=verbose, listed=True)
            raise
    try:
        if estimate is not None and output and estimate.status == "estimate":
            estimate.write(output, force=force)
        if estimate is not None and estimate.tactile_map.covered.any():  # one without data cannot be drawn
            for path, draw in zip(outputs[1:], (estimate.plot, estimate.plot_map, estimate.plot_fit), strict=True):
                if path is not None:
                    draw(path, force=force)
    finally:  # a file that cannot be written loses no result
        elapsed_s = time.perf_counter() - begun
        _print(maps, answers, as_json=as_json, verbose=verbose, listed=len(maps) > 1)
        if verbose:
            click.echo(f"estimate: {elapsed_s:.3f} s", err=True)
    failures = [answer.exit_code for answer in answers if isinstance(answer, Failure)]
    return failures[0] if failures else max(one.exit_code for one in answers)


def _many_maps(maps: tuple[Path, ...], settings: Settings, *, workers: int, scheduler: str | None) -> Answers:
    work = partial(answer_file, settings=settings)
    with (
        open_executor(workers=min(workers, len(maps)), cluster=scheduler) as executor,
        progress_bar("maps") as progress,
    ):
        return _answers(run_batch(work, maps, key=str, executor=executor, progress=progress))


def _answers(outcomes: Sequence[Outcome[Answer | Failure]]) -> Answers:
    """Answers for all maps; maps with the same error of the batch are named together in the first's answer."""
    lines = dict(zip(dict.fromkeys(one.error for one in outcomes if not one.ok), fault_lines(outcomes), strict=True))
    faults = (lines.pop(outcome.error, "") if not outcome.ok else "" for outcome in outcomes)
    return [
        one.value if one.value is not None else Failure(f"error: {fault}" if fault else "", EXIT_FAULT)
        for one, fault in zip(outcomes, faults, strict=True)
    ]


def _print(maps: Sequence[Path], answers: Answers, *, as_json: bool, verbose: bool, listed: bool) -> None:
    """Print errors on stderr and answers on stdout: in full with `verbose`, `listed` for several maps."""
    for answer in answers:
        if isinstance(answer, Failure) and answer.text:
            click.echo(answer.text, err=True)
    if as_json:
        documents = [one.report.checked().document for one in answers if isinstance(one, Answer)]
        click.echo(dump_json(documents if listed else documents[0]), nl=False)
        return
    texts = [
        (f"{path}\n" if listed else "") + (one.full_text if verbose else one.text)
        for path, one in zip(maps, answers, strict=True)
        if isinstance(one, Answer)
    ]
    click.echo("\n".join([*(text.replace(f"{RESEARCH_USE}\n", "") for text in texts[:-1]), *texts[-1:]]), nl=False)
