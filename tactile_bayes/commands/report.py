"""`report`: one page of an exam, to read and to print."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import click
from click.core import ParameterSource

from tactile_bayes.api.settings import Settings
from tactile_bayes.commands.options import FORCE, FilePath, also_read, settings_of, takes
from tactile_bayes.errors import UsageError
from tactile_bayes.presets import RESEARCH_USE

_FILE = FilePath()


@click.command("report")
@click.argument("files", metavar="MAP.nc... [POST.nc|ESTIMATE.json]", nargs=-1, required=True, type=_FILE)
@click.option("-o", "--output", metavar="EXAM.html", required=True, type=_FILE, help="Page to write.")
@click.option(
    "--pdf", metavar="EXAM.pdf", type=_FILE, help="Also print it to PDF, by an installed Chromium or WeasyPrint."
)
@click.option("--title", default="", help="Title of the page. Default: Tactile exam.")
@click.option("--name", default="", help="Name to print on the page. Default: none.")
@click.option("--date", "day", default="", metavar="YYYY-MM-DD", help="Date to print on the page. Default: none.")
@takes(
    Settings,
    "size_calibration",
    metavar="solid|eq6|solid-mean|plane-strain|SIZE.json",
    help="Calibration from widths to sizes, as of `estimate`. Default: the one that fits the maps.",
)
@takes(Settings, "settings_file", help="Settings, as of `estimate`.")
@takes(
    Settings,
    "repeatability",
    help="Spread between exams of one mass at this site, as of `estimate`. Default: two intervals.",
)
@takes(Settings, "seed", "interval")
@FORCE
@click.pass_context
def command(
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
    """Write one page of an exam: the map, the size with its intervals, the place, and how good the exam was.

    The page is one HTML file that loads nothing and prints to one side of A4. Several maps are repeats of one mass:
    they are pooled into one size. With what `estimate` wrote for a map (-o POST.nc, or --json) nothing is computed
    again; without the map such a page has no picture, and says so. The page names the codes of the scan's session, and
    a name or a date only where they are given.

    Example: tactile-bayes report map.nc -o exam.html
    """
    from tactile_bayes.api.exam_report import ExamFiles, Given, read_exam
    from tactile_bayes.files.shipped import size_calibration_path
    from tactile_bayes.report.exam_page import PageFiles
    from tactile_bayes.report.exam_words import headline

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
