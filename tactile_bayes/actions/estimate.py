"""Scans made maps; maps estimated, pooled and compared; exams made pages."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import click

from tactile_bayes.api.comparing import Comparison, compare_estimates
from tactile_bayes.api.estimating import answer_file, estimate_file
from tactile_bayes.api.maps import map_provenance
from tactile_bayes.api.pooled import of_one_mass, pool_answers
from tactile_bayes.api.reports import ExamFiles, exam_of_files
from tactile_bayes.api.settings import Comparing, Settings, dates_of, refuse_checkpoint, times_of
from tactile_bayes.api.sized import Answer, SizeEstimate
from tactile_bayes.batch import BatchInterrupted, Outcome, cluster_executor, fault_lines, local_executor, run_batch
from tactile_bayes.commands.options import settings_of, typed_options
from tactile_bayes.declarations import EXACT, replace, to_plain
from tactile_bayes.errors import EXIT_DONE, EXIT_FAULT, EXIT_NO_ESTIMATE, UsageError
from tactile_bayes.files.atomic import given_twice, refuse_existing
from tactile_bayes.files.documents import dump_json
from tactile_bayes.files.map_nc import write_map
from tactile_bayes.files.provenance import repeated_scans
from tactile_bayes.files.reports import json_text
from tactile_bayes.mapping.build import build_map
from tactile_bayes.options import MapOptions
from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.report.compare import compare_summary, compare_text
from tactile_bayes.report.estimate_figures import draw_figures, draw_size
from tactile_bayes.report.exam_page import exam_page
from tactile_bayes.report.exam_words import Given, headline
from tactile_bayes.report.figure_file import named_exam
from tactile_bayes.report.map_figure import map_figure
from tactile_bayes.report.map_text import map_summary, map_text
from tactile_bayes.report.pages import PageFiles
from tactile_bayes.report.pooled import pooled_summary, pooled_text
from tactile_bayes.shell import progress_bar

# --- `map`: from scans to a tactile map.


def map_action(
    scans: tuple[Path, ...], output: Path | None, figure: Path | None, force: bool, verbose: bool, **options: Any
) -> None:
    """Build a tactile map from one scan, or one common map from several scans of the same examination."""
    from tactile_bayes.files.scan_mcap import read_scan

    if twice := given_twice(scans):
        raise UsageError(f"{twice} is given twice; its frames would count twice: give each scan once")
    if output is None:
        output = beside(scans[0])
        if output.exists() and not force:
            raise UsageError(f"{output} exists; name another with -o, or give --force")
    refuse_existing(output, figure, force=force)
    settings = to_plain(MapOptions(**options), digits=EXACT)
    clock = _Clock(verbose)
    loaded = [read_scan(path) for path in scans]
    provenance = map_provenance(scans, loaded, settings)
    for later, earlier in repeated_scans([[facts] for facts in provenance.scans]).items():
        raise UsageError(f"{scans[later]} holds the recording of {scans[earlier]}; give each recording once")
    clock.tell("read")
    with progress_bar("frames") as progress:
        tactile_map = build_map(loaded, **options, progress=progress)
    clock.tell("map")
    write_map(output, tactile_map, provenance=provenance, force=force)
    try:
        if figure:
            title = f"Tactile map: {named_exam(output.stem, provenance.scans)}"
            map_figure(tactile_map, figure, title=title, force=force)
        clock.tell("write")
    finally:  # the map is written, whatever becomes of the figure
        text = map_text(tactile_map) if verbose else map_summary(tactile_map, written=str(output))
        click.echo(text, nl=False)


def beside(scan: Path) -> Path:
    """Where the map of a scan is written if no one says so: in its folder, and named after it."""
    return scan.parent / ("map.nc" if scan.stem == "scan" else f"{scan.stem}.nc")


class _Clock:
    """Prints the time of each step, if requested."""

    def __init__(self, verbose: bool) -> None:
        self._verbose = verbose
        self._last = time.perf_counter()

    def tell(self, step: str) -> None:
        now = time.perf_counter()
        if self._verbose:
            print(f"{step}: {now - self._last:.3f} s", file=sys.stderr)
        self._last = now


# --- `report`: one page of an exam, to read and to print.


def report_action(
    *,
    files: tuple[Path, ...],
    output: Path,
    pdf: Path | None,
    title: str,
    name: str,
    day: str,
    force: bool,
    **asked: Any,
) -> None:
    """Write one page of an exam: the map, the size with its intervals, the place, and how good the exam was."""
    given, page = Given(title, name, day), PageFiles(output, pdf, force)
    page.check()
    sorted_files = ExamFiles.sort(files)
    if sorted_files.estimates:
        for name in (name for name in asked if name in typed_options()):  # they would change nothing
            option = "--settings" if name == "settings_file" else f"--{name.replace('_', '-')}"
            raise UsageError(f"an estimate has settings of its own; leave out {option}, or give the map alone")
    settings = settings_of(**asked)
    exam = exam_of_files(sorted_files, settings, given, notice=lambda line: click.echo(line, err=True))
    page.write(exam_page(exam))
    if exam.main.tactile_map is None:
        click.echo("note: without its map the page has no picture and no coverage; give MAP.nc too", err=True)
    click.echo(f"{output}: {headline(exam)}")
    click.echo(RESEARCH_USE)


# --- `estimate --pool`: one size from several maps of one mass.


def estimate_pool(
    maps: tuple[Path, ...],
    answers: list[Answer],
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
    if settings.centre_mm is None:
        reports = [answer.report for answer in answers]
        answers = of_one_mass(
            answers, reports, lambda i, place: answer_file(maps[i], settings=replace(settings, centre_mm=place))
        )
    failed = [answer for answer in answers if answer.report is None]
    for answer in failed:
        click.echo(answer.text, err=True)
    if failed:
        return failed[0].exit_code
    inputs = {f"map_{i + 1}": one for i, one in enumerate(maps)}
    found = pool_answers(answers, settings, names=[str(one) for one in maps], inputs=inputs)
    report = found.pooled_report.checked()
    text_of = json_text if as_json else pooled_text if verbose else pooled_summary
    try:
        if found.pooled.size is not None and output is not None:
            found.write(output, force=force)
        if found.pooled.size is not None and figure is not None:
            name = named_exam(f"{len(found.pooled_report.maps)} maps pooled", found.provenance.scans)
            draw_size(
                found.pooled.size,
                figure,
                name=name,
                probability=found.probability,
                findings=found.findings,
                force=force,
            )
    finally:  # what was computed is not lost with a file
        click.echo(text_of(report), nl=False)
    return EXIT_DONE if found.pooled.size is not None else EXIT_NO_ESTIMATE


# --- `estimate`: estimate sizes from tactile maps.


def estimate_action(
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
    """Estimate a lump's size from tactile maps, with a credible interval."""
    settings = settings_of(**asked)
    if len(maps) > 1:
        refuse_checkpoint(settings)
    if figure is not None and settings.size_calibration == "none":
        raise UsageError("--figure draws sizes and needs a --size-calibration; --map-figure draws the fit")
    outputs = (output, figure, map_figure, fit_figure)
    if twice := given_twice(maps):
        raise UsageError(f"{twice} is given twice; give each map once")
    if any(outputs) and len(maps) > 1 and not pool:
        raise UsageError("--output and the figures take one map at a time; use --json for several")
    refuse_existing(*outputs, force=force)
    begun = time.perf_counter()
    if pool:
        if map_figure or fit_figure:
            raise UsageError("--map-figure and --fit-figure draw one map; leave out --pool")
        answers = _many_maps(maps, settings, workers=workers, scheduler=scheduler)
        printed = {"as_json": as_json, "verbose": verbose}
        ctx.exit(estimate_pool(maps, answers, settings, output, figure, **printed, force=force))
    if len(maps) == 1:
        found = _one_map(maps[0], settings)
        answers = [found.answer]
    else:
        found = None
        with _printed_if_interrupted(maps, as_json=as_json, verbose=verbose):
            answers = _many_maps(maps, settings, workers=workers, scheduler=scheduler)
    try:
        if found is not None and output and found.status == "estimate":
            found.write(output, force=force)
        if found is not None and any(outputs[1:]):
            name, share = named_exam(found.name, found.provenance.scans), found.probability
            draw_figures(found.tactile_map, found.estimate, *outputs[1:], name=name, probability=share, force=force)
    finally:  # what was computed is not lost with a file
        if verbose:
            print(f"estimate: {time.perf_counter() - begun:.3f} s", file=sys.stderr)
        _print(maps, answers, as_json=as_json, verbose=verbose, listed=len(maps) > 1)
    failed = [answer.exit_code for answer in answers if answer.report is None]
    ctx.exit(failed[0] if failed else max(answer.exit_code for answer in answers))


def _one_map(path: Path, settings: Settings) -> SizeEstimate:
    with progress_bar("effective draws") as progress:
        return estimate_file(
            path, settings, progress=progress, notice=lambda line: click.echo(f"{path}: {line}", err=True)
        )


def _many_maps(maps: tuple[Path, ...], settings: Settings, *, workers: int, scheduler: str | None) -> list[Answer]:
    chosen = cluster_executor(scheduler) if scheduler else local_executor(min(workers, len(maps)))
    with chosen as executor, progress_bar("maps") as progress:
        outcomes = run_batch(
            partial(answer_file, settings=settings), maps, key=str, executor=executor, progress=progress
        )
    return _answers(outcomes)


def _answers(outcomes: Iterable[Outcome[Answer]]) -> list[Answer]:
    """Answers for all maps; maps with the same error of the batch are named together in the first's answer."""
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
    try:
        yield
    except BatchInterrupted as stop:
        done = {one.key for one in stop.outcomes}
        finished = [path for path in maps if str(path) in done]
        _print(finished, _answers(stop.outcomes), as_json=as_json, verbose=verbose, listed=True)
        raise


def _print(maps: Sequence[Path], answers: list[Answer], *, as_json: bool, verbose: bool, listed: bool) -> None:
    """Print errors on stderr and answers on stdout: in full with `verbose`, `listed` for several maps."""
    for answer in answers:
        if answer.report is None and answer.text:
            click.echo(answer.text, err=True)
    if as_json:
        documents = [answer.report.checked().document for answer in answers if answer.report is not None]
        click.echo(dump_json(documents if listed else documents[0]), nl=False)
        return
    for path, answer in zip(maps, answers, strict=True):
        if answer.report is not None:
            click.echo((f"{path}\n" if listed else "") + (answer.full_text if verbose else answer.text), nl=listed)


# --- `compare`: the maps of two visits and more.


def groups_of(later: Sequence[tuple[int, Path]]) -> list[tuple[Path, ...]]:
    """Files of each group, in the order of the groups."""
    found: dict[int, list[Path]] = {}
    for number, path in later:
        found.setdefault(number, []).append(path)
    return [tuple(found[number]) for number in sorted(found)]


def compare_action(
    ctx: click.Context,
    /,
    first: tuple[Path, ...],
    later: tuple[tuple[int, Path], ...],
    days: tuple[float, ...],
    dates: str | None,
    grown_by: tuple[float, ...],
    same_mass: bool,
    registration_mm: float,
    as_json: bool,
    output: Path | None,
    pdf: Path | None,
    title: str,
    name: str,
    figure: Path | None,
    force: bool,
    verbose: bool,
    **asked: Any,
) -> None:
    """Compare the size of a mass at two visits and more."""
    comparing = Comparing(
        days=times_of(days or None, dates_of(dates) or None),
        grown_by=tuple(percent / 100 for percent in grown_by),
        same_mass=same_mass,
        registration_mm=registration_mm,
    )
    settings = settings_of(**asked)
    visits = [first, *groups_of(later)]
    if twice := given_twice(path for maps in visits for path in maps):
        raise UsageError(f"{twice} is given twice; give each map once, at its own visit")
    refuse_checkpoint(settings)
    comparing.check_visits(len(visits))
    if pdf is not None and output is None:
        raise UsageError("--pdf prints the page that --output names; give -o GROWTH.html too")
    Given(title, name)
    page = None if output is None else PageFiles(output, pdf, force)
    if page is not None:
        page.check()
    refuse_existing(figure, force=force)
    found = replace(_compare(visits, settings, comparing), dates=dates_of(dates))
    report = found.report.checked()
    text_of = json_text if as_json else compare_text if verbose else compare_summary
    try:
        if page is not None:
            page.write(found.page_text(title=title, name=name))
        if figure is not None:
            found.draw(figure, force=force)
    finally:  # what was computed is not lost with the figure
        click.echo(text_of(report), nl=False)
    ctx.exit(found.exit_code)


def _compare(visits: list[tuple[Path, ...]], settings: Settings, comparing: Comparing) -> Comparison:
    """Estimate every map and compare. An error with one map stops it."""
    total, found = sum(len(maps) for maps in visits), list[list[SizeEstimate]]()
    with progress_bar("maps") as progress:
        for maps in visits:
            found.append([estimate_file(path, settings) for path in maps])
            progress(sum(len(one) for one in found), total)
    names = [[str(path) for path in maps] for maps in visits]
    inputs = {f"visit_{v}_map_{i}": path for v, maps in enumerate(visits, 1) for i, path in enumerate(maps, 1)}
    return compare_estimates(found, settings, comparing=comparing, names=names, inputs=inputs)
