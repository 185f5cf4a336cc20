"""`compare`: the maps of two visits and more."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click

from tactile_bayes.api.settings import GROWN_BY, Comparing, Settings, refuse_checkpoint, times_of
from tactile_bayes.commands.options import (
    FORCE,
    METAVAR,
    FigurePath,
    FilePath,
    FiniteRange,
    also_read,
    settings_of,
    takes,
)
from tactile_bayes.declarations import replace
from tactile_bayes.errors import UsageError
from tactile_bayes.presets import REGISTRATION_MM

if TYPE_CHECKING:
    from tactile_bayes.api.comparing import ComparedOutcome


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


def groups_of(later: Sequence[tuple[int, Path]]) -> list[tuple[Path, ...]]:
    """Files of each group, in the order of the groups."""
    found: dict[int, list[Path]] = {}
    for number, path in later:
        found.setdefault(number, []).append(path)
    return [tuple(found[number]) for number in sorted(found)]


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
def command(
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
    figure: Path | None,
    force: bool,
    verbose: bool,
    **asked: Any,
) -> None:
    """Compare the size of a mass at two visits and more.

    Each visit is one map or several. First the visits must be shown to be of one mass: by what their scans say
    (patient, side, mass) and by where it lies from the landmarks; if not, the reason is printed and the exit code is
    6. Then the sizes are estimated together: what the body hides is the same at both visits and cancels in the change.
    A mass has grown, or shrunk, where the 95 % interval of the change leaves out none; else the least growth and
    shrinkage that would have been seen are told.

    Example: tactile-bayes compare jan1.nc jan2.nc --with apr1.nc apr2.nc --days 92
    """
    from tactile_bayes.files.atomic import refuse_existing
    from tactile_bayes.files.documents import check_document, dump_json
    from tactile_bayes.files.shipped import size_calibration_path
    from tactile_bayes.report.compare import compare_summary, compare_text

    comparing = Comparing(
        days=times_of(days or None, None if dates is None else dates.split(",")),
        grown_by=tuple(percent / 100 for percent in grown_by),
        same_mass=same_mass,
        registration_mm=registration_mm,
    )
    settings, size_calibration = settings_of(**asked), asked["size_calibration"]
    visits = [first, *groups_of(later)]
    _check_maps(visits, settings)
    comparing.check_visits(len(visits))
    if figure is not None:
        refuse_existing(figure, force=force)
    also_read(None if size_calibration is None else size_calibration_path(size_calibration))
    outcome, draw = _compare(visits, settings, comparing)
    check_document(outcome.document, "compare.schema.json", path=Path("the report"))
    text_of = dump_json if as_json else compare_text if verbose else compare_summary
    try:
        if figure is not None:
            draw(figure, force)
    finally:  # what was computed is not lost with the figure
        click.echo(text_of(outcome.document), nl=False)
    ctx.exit(outcome.exit_code)


def _check_maps(visits: list[tuple[Path, ...]], settings: Settings) -> None:
    """Refuse a map that is given twice, and a checkpoint."""
    from tactile_bayes.files.atomic import given_twice

    if twice := given_twice(path for maps in visits for path in maps):
        raise UsageError(f"{twice} is given twice; give each map once, at its own visit")
    refuse_checkpoint(settings)


def _compare(
    visits: list[tuple[Path, ...]], settings: Settings, comparing: Comparing
) -> tuple[ComparedOutcome, Callable[[Path, bool], None]]:
    """Estimate every map and compare; also gives what draws the figure. An error with one map stops it."""
    from tactile_bayes.api.comparing import compare_answers, drawn_maps
    from tactile_bayes.api.estimating import answer_of, estimate_file
    from tactile_bayes.api.pooled import elsewhere
    from tactile_bayes.commands.progress import progress_bar

    total, outcomes = sum(len(maps) for maps in visits), []
    with progress_bar("maps") as progress:
        for maps in visits:
            outcomes.append([estimate_file(path, settings) for path in maps])
            progress(sum(len(one) for one in outcomes), total)
    answers = [[answer_of(outcome) for outcome in maps] for maps in outcomes]
    if settings.centre_mm is None:
        places = [(v, i) for v, maps in enumerate(visits) for i in range(len(maps))]
        for number, place in elsewhere([answers[v][i].document for v, i in places]).items():
            v, i = places[number]
            outcomes[v][i] = estimate_file(visits[v][i], replace(settings, centre_mm=place))
            answers[v][i] = answer_of(outcomes[v][i])
    names = [[str(path) for path in maps] for maps in visits]
    inputs = {f"visit_{v}_map_{i}": path for v, maps in enumerate(visits, 1) for i, path in enumerate(maps, 1)}
    compared = compare_answers(answers, settings, comparing=comparing, names=names, inputs=inputs)

    def draw(figure: Path, force: bool) -> None:
        from tactile_bayes.report.compare_figure import draw_comparison

        drawn = drawn_maps([[outcome.tactile_map for outcome in maps] for maps in outcomes], answers)
        draw_comparison(compared.compared, compared.document, drawn, figure, force=force)

    return compared, draw
