"""`report`: one page of an exam, to read and to print."""

from __future__ import annotations

from typing import Any

import click

from tactile_bayes.api.settings import Settings
from tactile_bayes.commands.options import FORCE, FilePath, takes

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
def command(ctx: click.Context, /, **given: Any) -> None:
    """Write one page of an exam: the map, the size with its intervals, the place, and how good the exam was.

    The page is one HTML file that loads nothing and prints to one side of A4. Several maps are repeats of one mass:
    they are pooled into one size. With what `estimate` wrote for a map (-o POST.nc, or --json) nothing is computed
    again; without the map such a page has no picture, and says so. The page names the codes of the scan's session, and
    a name or a date only where they are given.

    Example: tactile-bayes report map.nc -o exam.html
    """
    from tactile_bayes.actions.maps import report_action

    report_action(ctx, **given)
