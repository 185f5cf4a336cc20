"""`compare`: the maps of two visits and more."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import click

from tactile_bayes.api.settings import GROWN_BY, Settings
from tactile_bayes.commands.options import FORCE, METAVAR, FigurePath, FilePath, FiniteRange, takes
from tactile_bayes.errors import UsageError
from tactile_bayes.presets import REGISTRATION_MM

# --- A command with groups of files: what follows ``--with`` up to the next option is one group.

WITH: Final = "--with"


class VisitsCommand(click.Command):
    """A command whose option ``--with`` takes several files, as often as it is given.

    The option's value is a pair, the group's number and one file: ``--with a b`` is parsed as
    ``--with 1 a --with 1 b``.
    """

    def make_parser(self, ctx: click.Context) -> Any:
        """Make the parser of the command line."""
        parser = super().make_parser(ctx)
        parse = parser.parse_args
        parser.parse_args = lambda args: parse(numbered(args, strict=not ctx.resilient_parsing))  # type: ignore[method-assign]
        return parser


def numbered(args: Sequence[str], *, strict: bool = True) -> list[str]:
    """The words with every file after ``--with`` as an option of its own, with the number of its group.

    Parameters
    ----------
    strict
        Refuse a ``--with`` that no file follows; a shell that completes words leaves it out.

    Raises
    ------
    UsageError
        When no file follows a ``--with``, and `strict`.
    """
    found: list[str] = []
    group, files = 0, -1  # files of the group so far; -1 outside one
    for word in [*args, ""]:
        if files >= 0 and word and not word.startswith("-"):
            found += [WITH, str(group), word]
            files += 1
            continue
        if files == 0 and strict:
            raise UsageError(f"{WITH} names no map; give the maps of a later visit after it")
        group, files = (group + 1, 0) if word == WITH else (group, -1)
        found += [word] if word not in (WITH, "") else []
    return found


# --- `compare`: change of a mass's size between visits.

_FILE = FilePath()
_PERCENT = tuple(100 * share for share in GROWN_BY)


@click.command("compare", cls=VisitsCommand)
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
    type=FiniteRange(),
    multiple=True,
    metavar="DAYS",
    help="Time of a later visit in days from the first, once for each: growth rates are told.",
)
@click.option("--dates", metavar="DATE,DATE...", help="The visits' dates, in place of --days: 2026-01-15,2026-04-20.")
@click.option(
    "--grown-by",
    type=FiniteRange(min=-100.0, max=1000.0, min_open=True, max_open=True),
    multiple=True,
    default=_PERCENT,
    show_default=True,
    metavar="PERCENT",
    help="Growth of the diameter, in percent, that a probability of more is told for.",
)
@click.option(
    "--same-mass",
    is_flag=True,
    help="Say that the visits are of one mass where landmarks are missing, or place it too far apart.",
)
@click.option(
    "--registration-mm",
    type=FiniteRange(min=0.0, min_open=True),
    default=REGISTRATION_MM,
    show_default=True,
    help="SD each way of one mass's place between visits, by posture and landmarks.",
)
@takes(
    Settings, "size_calibration", metavar="solid|eq6|solid-mean|SIZE.json",
    help="Calibration over bodies. Default: solid, or solid-mean for maps of frames divided by their means."
)  # fmt: skip
@takes(Settings, "method", help="As `estimate`.")
@takes(
    Settings, "settings_file", help="As `estimate`; between_map_sd states the spread between exams of a visit."
)  # fmt: skip
@takes(
    Settings, "repeatability",
    help="Spread between exams of one mass at this site, from `calibrate repeatability`. Default: two intervals, for "
    "exams as alike as simulated ones and as the paper's."
)  # fmt: skip
@takes(Settings, "seed", "interval")
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
@click.option("--figure", metavar=METAVAR, type=FigurePath(), help="Draw the maps, their difference and the change.")
@FORCE
@click.option("-v", "--verbose", is_flag=True, help="Print the full report instead of 12 lines.")
@click.pass_context
def command(ctx: click.Context, /, **given: Any) -> None:
    """Compare the size of a mass at two visits and more.

    Each visit is one map or several. First the visits must be shown to be of one mass: by what their scans say
    (patient, side, mass) and by where it lies from the landmarks; if not, the reason is printed and the exit code is
    6. Then the sizes are estimated together: what the body hides is the same at both visits and cancels in the change.
    A mass has grown, or shrunk, where the 95 % interval of the change leaves out none; else the least growth and
    shrinkage that would have been seen are told.

    Example: tactile-bayes compare jan1.nc jan2.nc --with apr1.nc apr2.nc --days 92
    """
    from tactile_bayes.actions.estimate import compare_action

    compare_action(ctx, **given)
