"""A table of lumps to a size calibration of either form."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from tactile_bayes.errors import BadDataError
from tactile_bayes.presets import FIT_RADIUS_MM, Background, Noise

if TYPE_CHECKING:
    from tactile_bayes.files.tables import Table
    from tactile_bayes.pipeline.one_map import Progress
    from tactile_bayes.size.eq6 import LeftOutErrors, Recipe, SizeCalibration
    from tactile_bayes.size.learn.eq6 import SizeTable, StudyCases
    from tactile_bayes.size.log_quadratic import LogQuadratic


@dataclass(frozen=True, slots=True, eq=False)
class Learned:
    """A size calibration, what it was learned from and the settings for its provenance.

    Parameters
    ----------
    lumps
        Rows of the table as Eq 6 takes them.
    not_left_out
        Why no geometry could be left out; empty where they were, or the table is no study.
    """

    calibration: SizeCalibration
    lumps: SizeTable
    not_left_out: str
    settings: dict[str, Any]


def learn_eq6(
    rows: Table,
    declared: Mapping[str, Any],
    *,
    least_stiffness_ratio: float = 0.0,
    seed: int = 1,
    progress: Progress | None = None,
) -> Learned:
    """Learn Eq 6 from a table of lumps.

    Parameters
    ----------
    declared
        As for `table_recipe`.
    least_stiffness_ratio
        Softer lumps take no part.

    Raises
    ------
    BadDataError
        When the table does not hold what Eq 6 needs.
    NotConvergedError
        When the sampler does not converge.
    """
    from dataclasses import replace

    import numpy as np

    from tactile_bayes.size.learn.eq6 import learn_size_calibration

    recipe = table_recipe(rows, declared)
    try:
        lumps = size_table(rows, least_stiffness_ratio=least_stiffness_ratio)
        rng = np.random.default_rng(seed)
        calibration = learn_size_calibration(lumps, recipe=recipe, rng=rng, progress=progress)
        left_out, silent = _left_out(lumps, least_stiffness_ratio=least_stiffness_ratio)
    except BadDataError as error:
        raise error.at(rows.path) from None
    settings = {
        "normalise": recipe.normalise,
        "background": recipe.background,
        "fit_radius_mm": recipe.radius_mm,
        "noise": recipe.noise,
        "least_stiffness_ratio": least_stiffness_ratio,
    }
    return Learned(replace(calibration, left_out=left_out), lumps, silent, settings)


def learn_quadratic(rows: Table) -> tuple[LogQuadratic, dict[str, Any]]:
    """Learn the log-quadratic form from a table of `population`; the calibration, and settings for its provenance."""
    from tactile_bayes.forward.population import BodyPrior, ExamPrior, as_settings
    from tactile_bayes.size.eq6 import Recipe
    from tactile_bayes.size.learn.log_quadratic import learn_log_quadratic
    from tactile_bayes.studies.population import measuring_options, population_table

    fit = measuring_options().fit
    recipe = Recipe(
        _normalise_of(rows), fit.background, fit.radius_mm, declared=False, noise=fit.noise, flat_field=False
    )
    source = "balls in a population of bodies, scanned by the solid model"
    try:
        calibration = learn_log_quadratic(population_table(rows.columns), recipe=recipe, source=source)
    except BadDataError as error:
        raise error.at(rows.path) from None
    return calibration, {"form": "log-quadratic", **as_settings(BodyPrior(), ExamPrior())}


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
    background: Background = found["background"] or ("free" if normalise == "none" else "fixed")
    if normalise == "none" and background == "fixed":
        raise UsageError("maps of --normalise none have no level to fix a background at; give --background free")
    radius_mm = found["fit_radius_mm"] or FIT_RADIUS_MM
    noise: Noise = found["noise"] or "independent"
    by_hand = any(said[name] is None for name in declared)
    return Recipe(normalise, background, radius_mm, declared=by_hand, noise=noise, flat_field=said["flat_field"])


def _alike(table: Table, name: str) -> Any:
    """The value of a column that must be alike in all rows."""
    values = table.columns[name]
    if len(set(values)) > 1:
        what = f"{name} differs between rows"
        raise BadDataError(what, way_out="join tables of maps made alike only", path=str(table.path))
    return values[0]


def _contradiction(table: Table, name: str, said: object, declared: object) -> BadDataError:
    option = f"--{name.replace('_', '-')}"
    way_out = f"leave out {option}"
    if name == "normalise":
        way_out += f", and size maps made with `map --normalise {said}`"
        way_out += "; `population` and --form log-quadratic give a calibration for --normalise gain"
    what = f"its {name} is {said}, not {declared} as {option} says"
    return BadDataError(what, way_out=way_out, path=str(table.path))


def _left_out(lumps: SizeTable, *, least_stiffness_ratio: float) -> tuple[LeftOutErrors | None, str]:
    """Errors on geometries left out, or why Eq 6 has none."""
    from tactile_bayes.errors import NotConvergedError
    from tactile_bayes.size.learn.cross_validation import left_out_of_study

    try:
        return left_out_of_study(lumps, least_stiffness_ratio=least_stiffness_ratio), ""
    except NotConvergedError as error:
        return None, str(error)


def _normalise_of(rows: Table) -> str:
    """How the maps of a table of `population` were normalised; by the mean in tables that do not say."""
    found = {str(value or "mean") for value in rows.columns.get("normalise", ["mean"])}
    if len(found) > 1:
        raise BadDataError(
            f"its maps were normalised in several ways ({', '.join(sorted(found))})",
            way_out="learn from the rows of one way",
            path=str(rows.path),
        )
    return found.pop()


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
