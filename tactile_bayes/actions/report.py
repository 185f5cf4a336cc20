"""`report`: one page of an exam, to read and to print."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from tactile_bayes.api.reports import ExamFiles, exam_of_files
from tactile_bayes.commands.options import settings_of, typed_options
from tactile_bayes.errors import UsageError
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
