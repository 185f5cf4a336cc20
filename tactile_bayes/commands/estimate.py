"""Options of the way from scans to sizes: `map`, `estimate`, `compare`, `report`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import click

from tactile_bayes.api.settings import Settings
from tactile_bayes.commands import options
from tactile_bayes.errors import UsageError
from tactile_bayes.options import GROWTH_SHARES, CompareOptions, MapOptions

_FILE = options.FilePath()


@options.command("map", "mapping.map_action")
@click.argument("scans", metavar="SCAN.mcap...", nargs=-1, required=True, type=_FILE)
@options.output_option(
    "MAP.nc",
    "netCDF",
    "Where to write the map. Default: beside the first scan; map.nc for scan.mcap, s01.nc for s01.mcap.",
)
@options.record_options(MapOptions)
@options.figure_option("Draw the map and its coverage.")
@options.FORCE
@click.option("-v", "--verbose", is_flag=True, help="Print all figures of the map; times on stderr.")
def map_command() -> None:
    """Build a tactile map from one scan, or one common map from several scans of the same examination.

    The plane of the motion is fitted, frames outside the pressure window are left out, the rest are normalised,
    projected on the plane and averaged in cells. The verdict is printed, and what was left out and why. Frames without
    a lump give the head's pressure profile, from which `estimate` computes the depth of the fat.

    Example: tactile-bayes map scan.mcap -o map.nc --figure map.png
    """


@options.command("estimate", "estimate.estimate_action")
@click.argument("maps", metavar="MAP.nc...", nargs=-1, required=True, type=_FILE)
@options.record_options(Settings, "size_calibration", "method", "seed", "interval")
@options.output_option("POST.nc", "netCDF", "Write all draws (netCDF that arviz opens).")
@click.option("--json", "as_json", is_flag=True, help="Print JSON: one object, or a list for several maps.")
@options.figure_option("Draw the size posterior, or the map where there is no size.")
@options.figure_option("Draw the map with the lump's size, or with the places looked at.", "--map-figure")
@options.figure_option(
    "Draw data, fit and residual of the fit window, or the map where there is no estimate.", "--fit-figure"
)
@options.record_options(Settings, "centre_mm", "scene", "settings_file", "accuracy_sd", "known", "repeatability")
@click.option("--pool", is_flag=True, help="Pool the maps, all of one mass, into one size.")
@options.number_option("--workers", options.WholeRange(min=1), 1, "Number of worker processes, for several maps.")
@options.scheduler_option("several maps")
@options.FORCE
@click.option(
    "-v", "--verbose", is_flag=True, help="Print the full report instead of 12 lines, and the time taken on stderr."
)
def estimate_command() -> None:
    """Estimate a lump's size from tactile maps, with a credible interval.

    Every posterior draw of the map's Gaussian (Eq 7) goes through a size calibration with a draw of its coefficients
    and of what no map shows. Where the map shows no lump that can be measured there is no number: the reason is printed
    and the exit code is 6. With --pool the maps are repeats of one mass, and their spread is learned. Sizes are for the
    depth of the fat under the head where the map gives it; where not, the report says so.

    Example: tactile-bayes estimate map.nc --figure size.png
    """


# --- A command with groups of files: the words after ``--with`` up to the next option are one group.

WITH: Final = "--with"


class VisitsCommand(click.Command):
    """A command whose option ``--with`` takes several files, as often as it is given.

    The option's value is a pair, the group's number and one file: ``--with a b`` is parsed as
    ``--with 1 a --with 1 b``.
    """

    def make_parser(self, ctx: click.Context) -> Any:
        parser = super().make_parser(ctx)
        parse = parser.parse_args
        parser.parse_args = lambda args: parse(number_groups(args, strict=not ctx.resilient_parsing))  # type: ignore[method-assign]
        return parser


def number_groups(args: Sequence[str], *, strict: bool = True) -> list[str]:
    """The words with each file after ``--with``, or ``--with=``, as ``--with GROUP FILE``, groups numbered from 1.

    With `strict` a ``--with`` without a file is refused; a shell that completes words drops it.
    """
    words: list[str] = []
    group, files = 0, -1  # files of the group so far; -1 outside one
    parted = [part for word in args for part in (word.split("=", 1) if word.startswith(f"{WITH}=") else [word])]
    for word in [*parted, ""]:
        if files >= 0 and word and not word.startswith("-"):
            words += [WITH, str(group), word]
            files += 1
            continue
        if files == 0 and strict:
            raise UsageError(f"{WITH} names no map; give the maps of a later visit after it")
        group, files = (group + 1, 0) if word == WITH else (group, -1)
        words += [word] if word not in (WITH, "") else []
    return words


_PERCENT = tuple(100 * share for share in GROWTH_SHARES)


@options.command("compare", "pages.compare_action", kind=VisitsCommand)
@click.argument("first", metavar="VISIT1.nc...", nargs=-1, required=True, type=_FILE)
@click.option(
    "--with",
    "later",
    type=(click.INT, _FILE),
    multiple=True,
    required=True,
    metavar="VISIT2.nc...",
    help="Maps of a later visit, up to the next option; again for a third visit.",
)
@click.option(
    "--days",
    type=options.FiniteRange(),
    multiple=True,
    metavar="DAYS",
    help="Days from the first visit to a later one, once for each later visit; adds growth rates.",
)
@click.option("--dates", metavar="DATE,DATE...", help="The visits' dates, in place of --days: 2026-01-15,2026-04-20.")
@click.option(
    "--grown-by",
    type=options.FiniteRange(min=-100.0, max=1000.0, min_open=True, max_open=True),
    multiple=True,
    default=_PERCENT,
    show_default=True,
    metavar="PERCENT",
    help="Growth of the diameter, in percent: adds the probability of having grown by more.",
)
@options.record_options(CompareOptions, "same_mass", "registration_mm")
@options.record_options(
    Settings, "size_calibration", metavar="solid|eq6|solid-mean|SIZE.json",
    help="Calibration over bodies. Default: solid, or solid-mean for maps of frames divided by their means."
)  # fmt: skip
@options.record_options(Settings, "method", help="As `estimate`.")
@options.record_options(
    Settings, "settings_file", help="As `estimate`; between_map_sd states the spread between exams of a visit."
)  # fmt: skip
@options.record_options(
    Settings, "repeatability",
    help="Spread between exams of one mass at this site, from `calibrate repeatability`. Default: two intervals, for "
    "exams as alike as simulated ones and as the paper's."
)  # fmt: skip
@options.record_options(Settings, "seed", "interval")
@options.JSON
@options.output_option(
    "GROWTH.html", "HTML", "Write one page: the maps on common axes, the size at each visit, and the change."
)
@options.page_options("GROWTH.pdf", "Tactile exams over time")
@options.figure_option("Draw the maps, their difference and the change.")
@options.FORCE
@click.option("-v", "--verbose", is_flag=True, help="Print the full report instead of 12 lines.")
def compare_command() -> None:
    """Compare the size of a mass at two visits and more.

    Each visit is one map or several. First the visits must be shown to be of one mass: by what their scans say
    (patient, side, mass) and by where it lies from the landmarks; if not, the reason is printed and the exit code is 6.
    Then the sizes are estimated together: what the body hides is the same at both visits and cancels in the change. A
    mass has grown, or shrunk, where the 95 % interval of the change excludes 0; else the least growth and shrinkage
    that would have been seen are printed.

    Example: tactile-bayes compare jan1.nc jan2.nc --with apr1.nc apr2.nc --days 92 -o growth.html
    """


@options.command("report", "pages.report_action")
@click.argument("files", metavar="MAP.nc... [POST.nc|ESTIMATE.json]", nargs=-1, required=True, type=_FILE)
@options.output_option("EXAM.html", None, "Page to write.", required=True)
@options.page_options("EXAM.pdf", "Tactile exam")
@click.option("--date", "day", default="", metavar="YYYY-MM-DD", help="Date to print on the page. Default: none.")
@options.record_options(
    Settings,
    "size_calibration",
    metavar="solid|eq6|solid-mean|plane-strain|SIZE.json",
    help="Calibration from widths to sizes, as of `estimate`. Default: the one that fits the maps.",
)
@options.record_options(Settings, "settings_file", help="Settings, as of `estimate`.")
@options.record_options(
    Settings,
    "repeatability",
    help="Spread between exams of one mass at this site, as of `estimate`. Default: two intervals.",
)
@options.record_options(Settings, "seed", "interval")
@options.FORCE
def report_command() -> None:
    """Write one page of an exam: the map, the size with its intervals, the place, and how good the exam was.

    The page is one HTML file that loads nothing and prints to one side of A4. Several maps are repeats of one mass:
    they are pooled into one size. With what `estimate` wrote for a map (-o POST.nc, or --json) nothing is computed
    again; without the map such a page has no picture, and says so. The page names the codes of the scan's session, and
    a name or a date only where they are given.

    Example: tactile-bayes report map.nc -o exam.html
    """
