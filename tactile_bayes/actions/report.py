"""`report` and `export`: one page of an exam, and its files for other systems."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from tactile_bayes.api.reports import exam_of_files, export
from tactile_bayes.commands.options import settings_of, typed_options
from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.report.exam_page import exam_page
from tactile_bayes.report.exam_words import Given, headline
from tactile_bayes.report.pages import PageFiles


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
    typed = [name for name in asked if name in typed_options()]
    found = exam_of_files(
        files, lambda: settings_of(**asked), typed=typed, notice=lambda line: click.echo(line, err=True)
    )
    exam = given.on(found)
    page.write(exam_page(exam))
    if exam.main.tactile_map is None:
        click.echo("note: without its map the page has no picture and no coverage; give MAP.nc too", err=True)
    click.echo(f"{output}: {headline(exam)}")
    click.echo(RESEARCH_USE)


def export_action(*, files: tuple[Path, ...], output: Path | None, dictionary: Path | None, **given: Any) -> None:
    """Export maps and estimates as DICOM, FHIR, NRRD (3D Slicer) or CSV (REDCap)."""
    written = export(files, output, dictionary=dictionary, **{name: value for name, value in given.items() if value})
    for path in written.paths:
        is_dictionary = path == dictionary
        click.echo(f"{path}: {'data dictionary for REDCap' if is_dictionary else f'{path.stat().st_size} bytes'}")
    for note in written.notes:
        click.echo(f"note: {note}", err=True)
    click.echo(RESEARCH_USE)
