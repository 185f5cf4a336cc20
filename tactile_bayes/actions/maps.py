"""Scans made maps, and exams made pages."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import click
from click.core import ParameterSource

from tactile_bayes.api.exam_report import ExamFiles, Given, read_exam
from tactile_bayes.api.maps import map_provenance
from tactile_bayes.commands.options import also_read, settings_of
from tactile_bayes.commands.progress import progress_bar
from tactile_bayes.declarations import EXACT, to_plain
from tactile_bayes.errors import UsageError
from tactile_bayes.files.atomic import given_twice, refuse_existing
from tactile_bayes.files.map_nc import write_map
from tactile_bayes.files.provenance import repeated_scans
from tactile_bayes.files.shipped import size_calibration_path
from tactile_bayes.mapping import build_map
from tactile_bayes.options import MapOptions
from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.report.exam_page import PageFiles
from tactile_bayes.report.exam_words import headline
from tactile_bayes.report.figure_file import named_exam
from tactile_bayes.report.map_figure import map_figure
from tactile_bayes.report.map_text import map_text

# --- `map`: from scans to a tactile map.


def map_action(
    scans: tuple[Path, ...],
    output: Path,
    figure: Path | None,
    force: bool,
    verbose: bool,
    **options: Any,
) -> None:
    """Build a tactile map from one scan, or one common map from several scans of the same examination."""
    from tactile_bayes.files.scan_mcap import read_scan

    _check_paths(scans, output, figure, force=force)
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
        click.echo(map_text(tactile_map), nl=False)


def _check_paths(scans: tuple[Path, ...], output: Path, figure: Path | None, *, force: bool) -> None:
    """Raise an error, before any work, for an output that cannot be written or a scan given twice."""
    if twice := given_twice(scans):
        raise UsageError(f"{twice} is given twice; its frames would count twice: give each scan once")
    for path in [output, *([figure] if figure else [])]:
        refuse_existing(path, force=force)


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
    ctx: click.Context,
    /,
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
        _refuse_settings(ctx, asked)
    settings, size_calibration = settings_of(**asked), asked["size_calibration"]
    also_read(None if size_calibration is None else size_calibration_path(size_calibration))
    exam = read_exam(sorted_files, settings, given, notice=lambda line: click.echo(line, err=True))
    page.write(exam)
    if exam.main.tactile_map is None:
        click.echo("note: without its map the page has no picture and no coverage; give MAP.nc too", err=True)
    click.echo(f"{output}: {headline(exam)}")
    click.echo(RESEARCH_USE)


def _refuse_settings(ctx: click.Context, asked: Iterable[str]) -> None:
    """Refuse options of the estimate where an estimate is given: they would change nothing."""
    for name in asked:
        if ctx.get_parameter_source(name) is ParameterSource.COMMANDLINE:
            option = "--settings" if name == "settings_file" else f"--{name.replace('_', '-')}"
            raise UsageError(f"an estimate has settings of its own; leave out {option}, or give the map alone")
