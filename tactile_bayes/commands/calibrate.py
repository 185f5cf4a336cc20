"""`calibrate`: learn a calibration from known objects."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from tactile_bayes.commands.number_or import FiniteRange
from tactile_bayes.commands.paths import FilePath
from tactile_bayes.presets import FIT_RADIUS_MM, NOISE, NORMALISE

if TYPE_CHECKING:
    from collections.abc import Mapping
    from datetime import datetime

    from tactile_bayes.errors import BadDataError
    from tactile_bayes.files.tables import Table
    from tactile_bayes.size.eq6 import LeftOutErrors, Recipe
    from tactile_bayes.size.learn.eq6 import SizeTable, StudyCases

_FILE = FilePath()


@click.group("calibrate")
def command() -> None:
    """Learn a calibration from known objects."""


@command.command("size")
@click.argument("table", metavar="TABLE.csv", type=_FILE)
@click.option("-o", "--output", required=True, metavar="SIZE.json", type=_FILE, help="Where to write the calibration.")
@click.option(
    "--form",
    type=click.Choice(["eq6", "log-quadratic"]),
    default="eq6",
    show_default=True,
    help="eq6: as printed, one row a lump; log-quadratic: from a table of `population`, one row an exam.",
)
@click.option(
    "--normalise",
    type=click.Choice(NORMALISE),
    help="How the table's maps were normalised, for a table that does not say. Default: mean.",
)
@click.option(
    "--background",
    type=click.Choice(["fixed", "free"]),
    help="Level of the table's maps in their fits, for a table that does not say. Default: fixed, or free with "
    "--normalise none.",
)
@click.option(
    "--fit-radius-mm",
    type=FiniteRange(min=0.0, min_open=True),
    help="Radius about the lump within which they were fitted, for a table that does not say. "
    f"Default: {FIT_RADIUS_MM:g}.",
)
@click.option(
    "--noise",
    type=click.Choice(NOISE),
    help="Errors they were fitted under, for a table that does not say; least squares is independent. "
    "Default: independent.",
)
@click.option(
    "--least-stiffness-ratio",
    type=FiniteRange(min=0.0),
    default=0.0,
    show_default=True,
    help="Leave out softer lumps: above 8 the paper's widths change by less than 5 %.",
)
@click.option("--seed", type=click.IntRange(min=0), default=1, show_default=True, help="Of the random numbers.")
@click.option("--force", is_flag=True, help="Overwrite an existing output.")
@click.pass_context
def size(
    ctx: click.Context,
    /,
    table: Path,
    output: Path,
    form: str,
    normalise: str | None,
    background: str | None,
    fit_radius_mm: float | None,
    noise: str | None,
    least_stiffness_ratio: float,
    seed: int,
    force: bool,
) -> None:
    """Learn Eq 6, d = m sigma / (e a^f) + b, from a study or a set of phantoms, or a quadratic in logarithms.

    TABLE.csv has a row for each lump: d_mm, amplitude, sigma_x_mm, and optionally sigma_y_mm, depth_ratio,
    stiffness_ratio and seat. With depth_ratio the rows at one diameter depth define Delta sigma as a ratio. How the
    table's maps were made and fitted stands in its columns normalise, background, fit_radius_mm, noise and flat_field,
    as in a table of `study`, or is declared by the options; an option that contradicts the table is refused, and
    `estimate` refuses a map made otherwise. With depth_ratio and stiffness_ratio the table is a study: each geometry
    (seat, d_mm, depth_ratio) is also left out of the learning in turn, and the report tells how far Eq 6 and a
    quadratic in logarithms then miss the hard lumps' sizes. Where seat, stiffness below 8, thickness_mm or
    head_radius_mm vary in it, the report tells what each does to the size that Eq 6 gives, and how much of its scatter
    would go if it were known; `estimate` does not use that.

    The log-quadratic form, ln d as a quadratic in ln a and ln sigma, tells apart what differs between bodies and
    between exams of one body. Its table comes from `population`, which made the maps: nothing is declared. From the
    pressure over the head where it felt no lump it also learns how deep the fat is, and sizes that go with it.

    Example: tactile-bayes calibrate size phantoms.csv -o size.json
    """
    from dataclasses import replace

    import numpy as np

    from tactile_bayes.commands.progress import progress_bar
    from tactile_bayes.errors import BadDataError
    from tactile_bayes.files.atomic import refuse_existing
    from tactile_bayes.files.provenance import Provenance, hash_inputs
    from tactile_bayes.files.size_json import write_size_calibration
    from tactile_bayes.files.tables import read_table
    from tactile_bayes.report.calibration_text import calibration_text
    from tactile_bayes.size.learn.body_effects import size_terms
    from tactile_bayes.size.learn.eq6 import learn_size_calibration

    refuse_existing(output, force=force)
    if form == "log-quadratic":
        _refuse_declared(ctx)
        click.echo(_log_quadratic(table, output, force=force), nl=False)
        return
    rows = read_table(table, "size_table.table.json")
    declared = {"normalise": normalise, "background": background, "fit_radius_mm": fit_radius_mm, "noise": noise}
    recipe = table_recipe(rows, declared)
    rng = np.random.default_rng(seed)
    try:
        lumps = size_table(rows, least_stiffness_ratio=least_stiffness_ratio)
        with progress_bar("effective draws") as progress:
            calibration = learn_size_calibration(lumps, recipe=recipe, rng=rng, progress=progress)
        left_out, silent = _left_out(lumps, least_stiffness_ratio=least_stiffness_ratio)
        calibration = replace(calibration, left_out=left_out)
    except BadDataError as error:
        raise error.at(table) from None
    settings = {
        "normalise": recipe.normalise,
        "background": recipe.background,
        "fit_radius_mm": recipe.radius_mm,
        "noise": recipe.noise,
        "least_stiffness_ratio": least_stiffness_ratio,
    }
    provenance = Provenance("calibrate size", settings, hash_inputs(table=table), seed=seed)
    write_size_calibration(output, calibration, provenance=provenance, force=force)
    click.echo(calibration_text(calibration, terms=size_terms(lumps), not_left_out=silent), nl=False)


def table_recipe(table: Table, declared: Mapping[str, Any]) -> Recipe:
    """How the maps of a size table were made and fitted: what its columns say, else what is declared, else the default.

    Parameters
    ----------
    declared
        The options ``normalise``, ``background``, ``fit_radius_mm`` and ``noise``; None where one was not given.

    Raises
    ------
    BadDataError
        When rows differ in it, or the table says something else than an option.
    UsageError
        When a level is to be fixed on maps that have none.
    """
    from tactile_bayes.errors import UsageError
    from tactile_bayes.size.eq6 import Recipe

    said = {name: _alike(table, name) for name in (*declared, "flat_field")}
    for name, value in declared.items():
        if None not in (value, said[name]) and value != said[name]:
            raise _contradiction(table, name, said[name], value)
    found = {name: value if said[name] is None else said[name] for name, value in declared.items()}
    normalise = found["normalise"] or "mean"
    background = found["background"] or ("free" if normalise == "none" else "fixed")
    if normalise == "none" and background == "fixed":
        raise UsageError("maps of --normalise none have no level to fix a background at; give --background free")
    radius_mm, noise = found["fit_radius_mm"] or FIT_RADIUS_MM, found["noise"] or "independent"
    by_hand = any(said[name] is None for name in declared)
    return Recipe(normalise, background, radius_mm, declared=by_hand, noise=noise, flat_field=said["flat_field"])


def _alike(table: Table, name: str) -> Any:
    """The value of a column that must be alike in all rows."""
    from tactile_bayes.errors import BadDataError

    values = table.columns[name]
    if len(set(values)) > 1:
        what = f"{name} differs between rows"
        raise BadDataError(what, way_out="join tables of maps made alike only", path=str(table.path))
    return values[0]


def _contradiction(table: Table, name: str, said: object, declared: object) -> BadDataError:
    from tactile_bayes.errors import BadDataError

    option = f"--{name.replace('_', '-')}"
    way_out = f"leave out {option}"
    if name == "normalise":
        way_out += f", and size maps made with `map --normalise {said}`"
        way_out += "; `population` and --form log-quadratic give a calibration for --normalise gain"
    what = f"its {name} is {said}, not {declared} as {option} says"
    return BadDataError(what, way_out=way_out, path=str(table.path))


def _refuse_declared(ctx: click.Context) -> None:
    from tactile_bayes.errors import UsageError

    for name in ("normalise", "background", "fit_radius_mm", "noise", "least_stiffness_ratio", "seed"):
        if ctx.get_parameter_source(name) is click.core.ParameterSource.COMMANDLINE:
            option = name.replace("_", "-")
            raise UsageError(f"--{option} is for --form eq6: a table of `population` fixes how its maps were made")


def _left_out(lumps: SizeTable, *, least_stiffness_ratio: float) -> tuple[LeftOutErrors | None, str]:
    """Errors on geometries left out, or why Eq 6 has none."""
    from tactile_bayes.errors import NotConvergedError
    from tactile_bayes.size.learn.cross_validation import left_out_of_study

    try:
        return left_out_of_study(lumps, least_stiffness_ratio=least_stiffness_ratio), ""
    except NotConvergedError as error:
        return None, str(error)


def _log_quadratic(table: Path, output: Path, *, force: bool) -> str:
    from tactile_bayes.errors import BadDataError
    from tactile_bayes.files.provenance import Provenance, hash_inputs
    from tactile_bayes.files.size_quadratic_json import write_log_quadratic
    from tactile_bayes.files.tables import read_table
    from tactile_bayes.forward.population import BodyPrior, ExamPrior, as_settings
    from tactile_bayes.report.quadratic_text import log_quadratic_text
    from tactile_bayes.size.eq6 import Recipe
    from tactile_bayes.size.learn.log_quadratic import learn_log_quadratic
    from tactile_bayes.studies.population import measuring_options, population_table

    rows = read_table(table, "population.table.json")
    fit = measuring_options().fit
    recipe = Recipe(
        _normalise_of(rows, table), fit.background, fit.radius_mm, declared=False, noise=fit.noise, flat_field=False
    )
    source = "balls in a population of bodies, scanned by the solid model"
    try:
        calibration = learn_log_quadratic(population_table(rows.columns), recipe=recipe, source=source)
    except BadDataError as error:
        raise error.at(table) from None
    settings = {"form": "log-quadratic", **as_settings(BodyPrior(), ExamPrior())}
    provenance = Provenance("calibrate size", settings, hash_inputs(table=table))
    write_log_quadratic(output, calibration, provenance=provenance, force=force)
    return log_quadratic_text(calibration)


def _normalise_of(rows: Table, path: Path) -> str:
    """How the maps of a table of `population` were normalised; by the mean in tables that do not say."""
    from tactile_bayes.errors import BadDataError

    found = {str(value or "mean") for value in rows.columns.get("normalise", ["mean"])}
    if len(found) > 1:
        raise BadDataError(
            f"its maps were normalised in several ways ({', '.join(sorted(found))})",
            way_out="learn from the rows of one way",
            path=str(path),
        )
    return found.pop()


@command.command("array")
@click.option(
    "--step",
    "steps",
    type=(float, _FILE),
    metavar="KPA SCAN.mcap",
    multiple=True,
    required=True,
    help="The bladder's pressure and what the head recorded under it.",
)
@click.option("-o", "--output", required=True, metavar="ARRAY.json", type=_FILE, help="Where to write the calibration.")
@click.option("--head-id", metavar="ID", help="Of the head; by default what the scans say.")
@click.option(
    "--date", "day", type=click.DateTime(["%Y-%m-%d"]), metavar="DAY", help="When it was measured; by default today."
)
@click.option("--force", is_flag=True, help="Overwrite an existing output.")
def array(
    steps: tuple[tuple[float, Path], ...], output: Path, head_id: str | None, day: datetime | None, force: bool
) -> None:
    """Learn gain and offset of each taxel from a pressure bladder, with what is left uneven.

    Record each step with `record --uncalibrated`. Dead and hot taxels are found and get gain 0, which leaves them out
    of maps. A parabola is fitted as well, to tell whether a straight line is enough.

    Example: tactile-bayes calibrate array --step 0 p0.mcap --step 8 p8.mcap --step 16 p16.mcap -o array.json
    """
    from datetime import date

    from tactile_bayes.commands.calibrate_array import calibrate_array
    from tactile_bayes.files.atomic import refuse_existing

    refuse_existing(output, force=force)
    measured = day.date() if day else date.today()
    click.echo(calibrate_array(steps, output, head_id=head_id, day=measured, force=force), nl=False)


def size_table(table: Table, *, least_stiffness_ratio: float = 0.0) -> SizeTable:
    """The columns of a table as arrays, with Delta sigma where the table has depths; softer lumps are left out."""
    import numpy as np

    from tactile_bayes.errors import BadDataError
    from tactile_bayes.size.learn.eq6 import SizeTable, width_changes

    # a study says which of its lumps show; the others' fits are fits to a trough
    shown = [
        flag is not False and (ratio is None or ratio >= least_stiffness_ratio)
        for flag, ratio in zip(table.columns["detectable"], table.columns["stiffness_ratio"], strict=True)
    ]
    columns = {
        name: [v for v, keep in zip(values, shown, strict=True) if keep] for name, values in table.columns.items()
    }

    def array(name: str) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]] | None:
        values = columns[name]
        if all(value is None for value in values):
            return None
        if any(value is None for value in values):
            row = table.columns[name].index(None)
            raise table.error(row, name, "is blank in some rows only", way_out="fill the column or leave it out")
        return np.asarray(values, dtype=np.float64)

    d_mm, amplitude, sigma_x, sigma_y = (array(n) for n in ("d_mm", "amplitude", "sigma_x_mm", "sigma_y_mm"))
    depth = array("depth_ratio")
    if d_mm is None or amplitude is None or sigma_x is None:
        raise BadDataError("no rows", way_out="give a row for each lump", path=str(table.path))
    if depth is None:
        return SizeTable(d_mm, amplitude, sigma_x, sigma_y)
    same = [columns[name] for name in ("seat", "d_mm", "stiffness_ratio", "thickness_mm", "head_radius_mm", "head")]
    group = list(zip(*same, strict=True))
    change_x = width_changes(sigma_x, depth_ratio=depth, group=group)
    change_y = None if sigma_y is None else width_changes(sigma_y, depth_ratio=depth, group=group)
    return SizeTable(d_mm, amplitude, sigma_x, sigma_y, change_x, change_y, _study_cases(columns))


def _study_cases(columns: dict[str, list[Any]]) -> StudyCases | None:
    """Which case each row is; None where a row does not say how stiff its lump is."""
    import numpy as np

    from tactile_bayes.size.learn.eq6 import StudyCases

    if None in columns["stiffness_ratio"]:
        return None
    depth, ratio = (np.asarray(columns[name], dtype=np.float64) for name in ("depth_ratio", "stiffness_ratio"))
    told = {"seat_number": _seat_numbers(columns["seat"])}
    told |= {name: columns[name] for name in ("thickness_mm", "head_radius_mm")}
    others = {name: np.asarray(values, dtype=np.float64) for name, values in told.items() if None not in values}
    return StudyCases(tuple(columns["seat"]), depth, ratio, others)


def _seat_numbers(seats: list[str | None]) -> list[float | None]:
    """0 for centred, 1 for resting; None for names that are the table's own."""
    from tactile_bayes.errors import TactileBayesError
    from tactile_bayes.forward.body import parse_seat

    def number(seat: str | None) -> float | None:
        try:
            return None if seat is None else parse_seat(seat)
        except TactileBayesError:
            return None

    return [number(seat) for seat in seats]
