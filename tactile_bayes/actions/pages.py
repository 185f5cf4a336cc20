"""`compare`, `report` and `export`: a mass over its visits, the page of an exam, and its files for other systems."""

from __future__ import annotations

from functools import partial
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from typing import Any

import click

from tactile_bayes.api.comparing import compare_estimates
from tactile_bayes.api.estimates import exam_from_files, export
from tactile_bayes.api.estimating import estimate_file
from tactile_bayes.api.settings import days_from_first, refuse_checkpoint, split_dates
from tactile_bayes.api.sized import SizeEstimate
from tactile_bayes.commands.options import make_settings, typed_options
from tactile_bayes.declarations import replace
from tactile_bayes.errors import UsageError
from tactile_bayes.files.atomic import first_duplicate
from tactile_bayes.files.reports import json_text
from tactile_bayes.findings import finding_lines
from tactile_bayes.options import CompareOptions
from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.report.compare import compare_summary, compare_text
from tactile_bayes.report.exam_page import exam_page
from tactile_bayes.report.exam_words import PageLabels, headline
from tactile_bayes.report.pages import PageFiles
from tactile_bayes.shell import progress_bar


def compare_action(
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
    **options: Any,
) -> int:
    """Compare the size of a mass at two visits and more."""
    comparing = CompareOptions(
        days=days_from_first(days or None, split_dates(dates) or None),
        grown_by=tuple(percent / 100 for percent in grown_by),
        same_mass=same_mass,
        registration_mm=registration_mm,
    )
    settings = make_settings(**options)
    visits = [first, *(tuple(path for _, path in group) for _, group in groupby(later, itemgetter(0)))]
    if twice := first_duplicate(path for maps in visits for path in maps):
        raise UsageError(f"{twice} is given twice; give each map once, at its own visit")
    refuse_checkpoint(settings)
    comparing.check_visits(len(visits))
    if pdf is not None and output is None:
        raise UsageError("--pdf prints the page that --output names; give -o GROWTH.html too")
    PageLabels(title, name)
    page = None if output is None else PageFiles(output, pdf, force)
    estimates, total = list[list[SizeEstimate]](), sum(len(maps) for maps in visits)
    with progress_bar("maps") as progress:
        for maps in visits:
            estimates.append([estimate_file(path, settings) for path in maps])
            progress(sum(map(len, estimates)), total)
    names = [[str(path) for path in maps] for maps in visits]
    comparison = compare_estimates(estimates, settings, comparing, names=names, files=visits)
    comparison = replace(comparison, dates=split_dates(dates))
    report = comparison.report.checked()
    text_of = json_text if as_json else compare_text if verbose else compare_summary
    try:
        if page is not None:
            page.write(comparison.page_text(title=title, name=name))
        if figure is not None:
            comparison.plot(figure, force=force)
    finally:  # a file that cannot be written loses no result
        click.echo(text_of(report), nl=False)
    return comparison.exit_code


def report_action(
    *,
    files: tuple[Path, ...],
    output: Path,
    pdf: Path | None,
    title: str,
    name: str,
    day: str,
    force: bool,
    **options: Any,
) -> None:
    """Write one page of an exam: the map, the size with its intervals, the place, and how good the exam was."""
    labels, page = PageLabels(title, name, day), PageFiles(output, pdf, force)
    typed = [name for name in options if name in typed_options()]
    notice = partial(click.echo, err=True)
    exam = exam_from_files(files, partial(make_settings, **options), typed=typed, notice=notice)
    exam = replace(exam, labels=labels)
    page.write(exam_page(exam))
    if exam.main.tactile_map is None:
        click.echo("note: without its map the page has no picture and no coverage; give MAP.nc too", err=True)
    for line in (*finding_lines(exam.report.findings, "caution"), f"{output}: {headline(exam)}"):
        click.echo(line)
    click.echo(RESEARCH_USE)


def export_action(*, files: tuple[Path, ...], output: Path | None, dictionary: Path | None, **options: Any) -> None:
    """Export maps and estimates as DICOM, FHIR, NRRD (3D Slicer) or CSV (REDCap)."""
    written = export(files, output, dictionary=dictionary, **{name: value for name, value in options.items() if value})
    for path in written.paths:
        contents = "data dictionary for REDCap" if path == dictionary else f"{path.stat().st_size} bytes"
        click.echo(f"{path}: {contents}")
    for note in written.notes:
        click.echo(f"note: {note}", err=True)
    click.echo(RESEARCH_USE)
