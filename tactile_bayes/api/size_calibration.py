"""Size calibrations of either form from a table of lumps, and one corrected by a site's phantoms."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final, Literal, cast

import numpy as np

from tactile_bayes.api.estimating import estimate_file
from tactile_bayes.api.settings import Settings
from tactile_bayes.api.sized import pooling_shape
from tactile_bayes.declarations import Record, replace
from tactile_bayes.errors import BadDataError, NotConvergedError, UsageError, in_file
from tactile_bayes.files.documents import load_json
from tactile_bayes.files.provenance import Provenance, hash_inputs
from tactile_bayes.files.reading import open_input
from tactile_bayes.files.size_json import SHIPPED, read_size_calibration, size_calibration_path, write_size_calibration
from tactile_bayes.files.tables import Sheet, Table, read_table
from tactile_bayes.forward.tissue import parse_seat
from tactile_bayes.geometry import FloatArray
from tactile_bayes.presets import FIT_RADIUS_MM, HEAD_PROFILE, LEAST_HARD_RATIO, Background
from tactile_bayes.progress import Progress
from tactile_bayes.scans import HeadShape
from tactile_bayes.size.bodies import BodyCalibration
from tactile_bayes.size.draws import BumpDraws, ShapeDraws
from tactile_bayes.size.learn import bodies as learning
from tactile_bayes.size.learn.eq6 import (
    OtherFit,
    SizeTable,
    StudyCases,
    axis_in_two_stages,
    learn_size_calibration,
    learn_two_stage,
    left_out_of_study,
    other_fit,
    width_changes,
)
from tactile_bayes.size.learn.site import PhantomMap, correct_calibration
from tactile_bayes.size.pooling import Calibration
from tactile_bayes.size.terms import Normalise, Recipe
from tactile_bayes.studies.population import measuring_options, population_table, table_bodies, table_head

EqSixFit = Literal["joint", "two-stage"]
PopulationForm = Literal["eq6", "eq6-residual"]
"""What can be learned from a table of `population`; only the first from a table of lumps."""
_SOURCE: Final = "balls in a population of bodies, scanned by the solid model"


class Learned(Record, eq=False):
    """A learned or corrected size calibration, with what its file holds besides."""

    calibration: Calibration
    settings: dict[str, Any]  #: For the provenance.
    inputs: dict[str, Path]  #: Files by role, for the provenance.
    seed: int | None = None  #: Of the random numbers; None where it used none.
    base: dict[str, Any] | None = None  #: Document of the calibration that was corrected.
    lumps: SizeTable | None = None  #: The table as Eq 6 takes it, where that was learned.
    not_left_out: str = ""
    """Why no geometry could be left out; empty where they were, or the table is no study."""
    other_fit: OtherFit | None = None
    """What the other of the two fits makes of the table; None where it has none."""

    def write(self, path: Path, *, force: bool = False) -> None:
        """Write the file that `estimate --size-calibration` takes."""
        provenance = Provenance("calibrate size", self.settings, hash_inputs(**self.inputs), seed=self.seed)
        write_size_calibration(path, self.calibration, base=self.base, provenance=provenance, force=force)


def files_of(**tables: Path | Sheet | None) -> dict[str, Path]:
    """Those of the tables that are files, by role."""
    return {role: table for role, table in tables.items() if isinstance(table, Path)}


def learn_eq6(
    table: Path | Sheet,
    declared: Mapping[str, Any],
    *,
    fit: EqSixFit = "joint",
    least_stiffness_ratio: float = 0.0,
    seed: int = 1,
    progress: Progress | None = None,
) -> Learned:
    """Learn Eq 6 from a table of lumps, of which those softer than `least_stiffness_ratio` take no part.

    By the posterior of all coefficients from all rows (``"joint"``), or as printed, with a bootstrap (``"two-stage"``).
    """
    rows = read_table(table, "size_table.table.json")
    recipe = table_recipe(rows, declared)
    with in_file(rows.path):
        lumps = size_table(rows, least_stiffness_ratio=least_stiffness_ratio)
        rng = np.random.default_rng(seed)
        if fit == "two-stage":
            calibration = learn_two_stage(lumps, recipe=recipe, rng=rng)
        else:
            calibration = learn_size_calibration(lumps, recipe=recipe, rng=rng, progress=progress)
        other = other_fit(calibration, lumps)
        one_axis = axis_in_two_stages if fit == "two-stage" else None
        left_out, silent = None, ""  # cross-validated errors, or why Eq 6 has none
        try:
            left_out = left_out_of_study(lumps, least_stiffness_ratio=least_stiffness_ratio, fit=one_axis)
        except (NotConvergedError, BadDataError) as error:
            silent = str(error)
    settings = {
        "normalise": recipe.normalise,
        "background": recipe.background,
        "fit_radius_mm": recipe.radius_mm,
        "noise": recipe.noise,
        "least_stiffness_ratio": least_stiffness_ratio,
        "fit": fit,
    }
    cautions = table_cautions(rows.columns, least_stiffness_ratio=least_stiffness_ratio)
    learned = replace(calibration, left_out=left_out, cautions=cautions)
    return Learned(learned, settings, files_of(table=table), seed, lumps=lumps, not_left_out=silent, other_fit=other)


def table_cautions(columns: Mapping[str, Sequence[Any]], *, least_stiffness_ratio: float = 0.0) -> tuple[str, ...]:
    """What makes sizes by Eq 6 of a table of lumps doubtful, in words; see docs/decisions/0093 for the figures."""
    found, seats = [], set(columns["seat"])
    if set(columns["sigma_y_mm"]) == {None}:
        found.append(
            "its lumps have one width; if they were cylinders, as in a study in two dimensions, "
            "balls come out 40 to 110 % too large"
        )
    if len(seats) == 1 and None not in seats:
        found.append(f"its lumps have one seat ({seats.pop()}); one of another seat may come out half too large")
    softest = min((ratio for ratio in columns["stiffness_ratio"] if ratio is not None), default=LEAST_HARD_RATIO)
    if max(softest, least_stiffness_ratio) < LEAST_HARD_RATIO:
        found.append("it holds soft lumps, beside which hard ones come out too large (--least-stiffness-ratio 8)")
    return tuple(found)


def learn_population(
    table: Path | Sheet, form: PopulationForm, normalise: str | None = None, *, against: Path | None = None
) -> Learned:
    """Learn a calibration from a table of `population`.

    `normalise` is that of the rows to learn from, and may be left out where all are alike. Lumps of another origin, in
    the same columns, tell by how much such bodies depart: `against`.
    """
    given = None if against is None else read_table(against, "population.table.json")
    rows, fit = read_table(table, "population.table.json"), measuring_options()
    way, columns = rows_of_one_way(rows, normalise)
    settings: dict[str, Any] = {"form": form, "masses": len(set(columns["body"])), "bodies": table_bodies(columns)}
    with in_file(rows.path):
        head = table_head(columns)
        recipe = Recipe(
            way, fit.background, fit.fit_radius_mm, declared=False, noise=fit.noise, flat_field=False, head=head
        )
        found = learning.learn_population(
            population_table(columns), recipe=recipe, source=_SOURCE, residual=form == "eq6-residual"
        )
    if form == "eq6-residual" and found.residual is None:
        raise BadDataError(
            f"fewer than {learning.LEAST_BODIES} bodies have a lump and a head profile: too few for a residual",
            way_out="give a larger population, or --form eq6",
            path=str(rows.path),
        )
    found = replace(found, bodies=settings["bodies"])
    if given is not None:
        other_table = population_table(rows_of_one_way(given, way)[1])
        settings["other_masses"] = len(set(other_table.body.tolist()))
        source = f"{settings['other_masses']} lumps of {given.path.name}"
        found = learning.learn_other_sd(found, other_table, source=source)
    return Learned(found, settings, files_of(table=table, against=against))


def is_population(source: Path | Sheet) -> bool:
    """Whether a table is one of `population`: exams of bodies, by its header."""
    return {"body", "exam"} <= set(header_of(source))


def header_of(source: Path | Sheet) -> list[str]:
    """The names in a table's first line."""
    if isinstance(source, Path):
        with open_input(source) as file:
            first = file.readline(4096).decode("utf-8-sig", errors="replace")
    else:
        first = source.text.partition("\n")[0]
    return [name.strip() for name in next(csv.reader(io.StringIO(first)), [])]


def table_recipe(table: Table, declared: Mapping[str, Any]) -> Recipe:
    """Recipe of a size table's maps: from its columns, else as the options of these names declare, else the default."""
    said = {name: _alike(table, name) for name in (*declared, "flat_field")}
    for name, value in declared.items():
        if None not in (value, said[name]) and value != said[name]:
            raise _contradiction(table, name, said[name], value)
    found = {name: value if said[name] is None else said[name] for name, value in declared.items()}
    normalise: Normalise = found["normalise"] or "mean"
    background: Background = found["background"] or ("free" if normalise == "none" else "fixed")
    if normalise == "none" and background == "fixed":
        raise UsageError("maps of --normalise none have no level to fix a background at; give --background free")
    return Recipe(
        normalise,
        background,
        found["fit_radius_mm"] or FIT_RADIUS_MM,
        declared=any(said[name] is None for name in declared),
        noise=found["noise"] or "independent",
        flat_field=said["flat_field"],
        head=_named_head(table),
    )


def _named_head(table: Table) -> HeadShape | None:
    """Head that a table of lumps names; None where it does not."""
    names = ("head_rows", "head_columns", "head_pitch_mm")
    values = [_alike(table, name) for name in names]
    if values == [None, None, None]:
        return None
    if None in values:
        what = f"names a head without {names[values.index(None)]}"
        raise BadDataError(what, way_out=f"give {', '.join(names)} and head_radius_mm", path=str(table.path))
    return HeadShape(values[0], values[1], values[2], _alike(table, "head_radius_mm"))


def _alike(table: Table, name: str) -> Any:
    """Value of a column that must be the same in all rows."""
    values = table.columns[name]
    if len(set(values)) > 1:
        what = f"{name} differs between rows"
        raise BadDataError(what, way_out="join tables of maps made alike only", path=str(table.path))
    return values[0]


def _contradiction(table: Table, name: str, said: object, declared: object) -> BadDataError:
    option = f"--{name.replace('_', '-')}"
    way_out = f"leave out {option}"
    if name == "normalise":
        way_out += (
            f", and size maps made with `map --normalise {said}`; `population` gives a table for --normalise gain"
        )
    what = f"its {name} is {said}, not {declared} as {option} says"
    return BadDataError(what, way_out=way_out, path=str(table.path))


def rows_of_one_way(rows: Table, normalise: str | None) -> tuple[Normalise, dict[str, list[Any]]]:
    """How a `population` table's maps were normalised, and its columns for the rows that were.

    Tables without the column, and empty cells, are of maps normalised by the mean.
    """
    ways = [str(value or "mean") for value in rows.columns.get("normalise", ["mean"] * len(rows))]
    found = sorted(set(ways))
    if normalise is None and len(found) > 1:
        raise BadDataError(
            f"its maps were normalised in several ways ({', '.join(found)})",
            way_out=f"learn from the rows of one way: --normalise {found[0]}",
            path=str(rows.path),
        )
    chosen = normalise or found[0]
    if chosen not in found:
        raise BadDataError(
            f"none of its maps were made with --normalise {chosen}",
            way_out=f"give --normalise {found[0]}",
            path=str(rows.path),
        )
    kept = [i for i, way in enumerate(ways) if way == chosen]
    return cast("Normalise", chosen), {name: [values[i] for i in kept] for name, values in rows.columns.items()}


def size_table(table: Table, *, least_stiffness_ratio: float = 0.0) -> SizeTable:
    """Columns of a table as arrays, with Delta sigma where depths are given; without softer lumps."""
    # only lumps marked as detectable: fits to the others describe a trough
    shown = [
        flag is not False and (ratio is None or ratio >= least_stiffness_ratio)
        for flag, ratio in zip(table.columns["detectable"], table.columns["stiffness_ratio"], strict=True)
    ]
    columns = {
        name: [v for v, keep in zip(values, shown, strict=True) if keep] for name, values in table.columns.items()
    }

    def array(name: str) -> FloatArray | None:
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
    return SizeTable(d_mm, amplitude, sigma_x, sigma_y, change_x, change_y, _study_cases(columns), depth)


def _study_cases(columns: dict[str, list[Any]]) -> StudyCases | None:
    """Study case of each row; None where a row lacks the lump's stiffness."""
    if None in columns["stiffness_ratio"]:
        return None
    depth, ratio = (np.asarray(columns[name], dtype=np.float64) for name in ("depth_ratio", "stiffness_ratio"))
    told = {name: columns[name] for name in ("thickness_mm", "head_radius_mm") if None not in columns[name]}
    others = {name: np.asarray(values, dtype=np.float64) for name, values in told.items()}
    return StudyCases(tuple(columns["seat"]), depth, ratio, others)


# --- A calibration corrected by a site's phantoms, from a table of their bumps or of their map files.

HARDEST_RATIO = 100.0
"""Largest E2/E1 of the simulated bodies; a harder lump counts as this one, because widths hardly change beyond it."""


class _Phantoms(Record):
    maps: list[PhantomMap]
    left_out: list[str]
    inputs: dict[str, Path]


def correct_size(
    table: Path | Sheet, base: str, declared: Mapping[str, Any], *, seed: int = 1, progress: Progress | None = None
) -> Learned:
    """Correct a calibration over bodies by phantoms.

    `table`: a row for each map of a phantom: its bump (size_table) or its file (phantom_maps); `base`: name or path of
    the calibration; `declared`: as for `table_recipe`; for a table of bumps; `seed`: of the random numbers with which
    maps are estimated.
    """
    path = size_calibration_path(base)
    calibration = None if path is None else read_size_calibration(path)
    if path is None or not isinstance(calibration, BodyCalibration):
        raise UsageError(
            f"{base} cannot be corrected: it was not learned over bodies; "
            "give --correct solid, solid-mean or eq6, or a file learned from a table of `population`"
        )
    where = table if isinstance(table, Path) else table.name
    by_files = "file" in header_of(table)
    with in_file(where):
        if by_files:
            for name in (name for name, value in declared.items() if value is not None):
                option = name.replace("_", "-")
                what = f"--{option} is for tables of amplitudes and widths"
                raise UsageError(f"{what}: map files state how they were made")
            found = _from_maps(table, base, seed=seed, progress=progress)
        else:
            found = _from_bumps(table, calibration, declared)
        name = base if base in SHIPPED else path.name
        corrected = correct_calibration(calibration, found.maps, base=name, left_out=found.left_out)
    document: Any = load_json(path)
    settings = {"correct": name, "of": "maps" if by_files else "bumps", "seed": seed}
    inputs = {**files_of(table=table), "size_calibration": path, **found.inputs}
    return Learned(corrected, settings, inputs, base=document)


def _from_bumps(source: Path | Sheet, calibration: BodyCalibration, declared: Mapping[str, Any]) -> _Phantoms:
    """The phantoms of a table of amplitudes and widths."""
    rows = read_table(source, "size_table.table.json")
    _check_recipe(rows, calibration, declared)
    _check_head(rows, calibration)
    columns, maps, left_out = rows.columns, [], []
    for i, name in enumerate(_names(rows, [f"line {line}" for line in rows.line_numbers])):
        if columns["sigma_y_mm"][i] is None:
            raise rows.error(i, "sigma_y_mm", "is blank", way_out="give both widths of the map")
        if columns["detectable"][i] is False:
            left_out.append(f"{name}: its row says that it is not detectable")
        elif (why := _too_soft(rows, i)) is not None:
            left_out.append(f"{name}: {why}")
        else:
            amplitude, sigma_x, sigma_y = (
                np.array([columns[one][i]], dtype=np.float64) for one in ("amplitude", "sigma_x_mm", "sigma_y_mm")
            )
            told = tuple(columns[one][i] for one in HEAD_PROFILE)
            profile = None if None in told else told
            shape = ShapeDraws.of(BumpDraws(amplitude, sigma_x, sigma_y, np.zeros(1)), profile=profile)
            maps.append(PhantomMap(name, columns["d_mm"][i], shape, _known(rows, i)))
    return _Phantoms(maps, left_out, {})


def _from_maps(source: Path | Sheet, base: str, *, seed: int, progress: Progress | None) -> _Phantoms:
    """The phantoms of a table of map files, each estimated by the calibration's recipe."""
    rows = read_table(source, "phantom_maps.table.json")
    folder = source.parent if isinstance(source, Path) else Path()
    settings, columns = Settings(size_calibration=base, seed=seed), rows.columns
    maps, left_out, inputs = [], [], {}
    for i, name in enumerate(_names(rows, [str(one) for one in columns["file"]])):
        path = folder / columns["file"][i]
        inputs[f"map_{i + 1}"] = path
        if (why := _too_soft(rows, i)) is not None:
            left_out.append(f"{name}: {why}")
            continue
        outcome = estimate_file(path, settings)
        shape = pooling_shape(outcome.tactile_map, outcome.estimate)
        if shape is None:
            left_out.append(f"{columns['file'][i]}: {outcome.estimate.reason}")
        else:
            maps.append(PhantomMap(name, columns["d_mm"][i], shape, _known(rows, i)))
        if progress is not None:
            progress(i + 1, len(rows))
    return _Phantoms(maps, left_out, inputs)


def _names(rows: Table, otherwise: list[str]) -> list[str]:
    """Name of the phantom of each row; rows of one phantom must state the same properties."""
    told = rows.columns["phantom"]
    names = [other if name is None else name for name, other in zip(told, otherwise, strict=True)]
    first: dict[str, int] = {}
    for i, name in enumerate(names):
        j = first.setdefault(name, i)
        for column in ("d_mm", "depth_ratio", "stiffness_ratio", "seat"):
            here, there = rows.columns[column][i], rows.columns[column][j]
            if here != there:
                what = f"is {here}, but {there} in another row of {name}"
                raise rows.error(i, column, what, way_out="give each lump a name of its own")
    return names


def _known(rows: Table, i: int) -> dict[str, float]:
    """The properties of a row's phantom, by the names of `HiddenTerms`."""
    row = {name: values[i] for name, values in rows.columns.items()}
    found: dict[str, float] = {}
    if row["depth_ratio"] is not None:
        found["depth_mm"] = row["depth_ratio"] * row["d_mm"]
    if row["stiffness_ratio"] is not None:
        found["stiffness_ratio"] = min(row["stiffness_ratio"], HARDEST_RATIO)
    if row["seat"] is not None:
        try:
            found["seat"] = parse_seat(row["seat"])
        except BadDataError as error:
            raise rows.error(i, "seat", f"is {row['seat']!r}", way_out=error.way_out) from None
    return found


def _too_soft(rows: Table, i: int) -> str | None:
    """Why a lump is too soft for a calibration over bodies with hard ones."""
    ratio = rows.columns["stiffness_ratio"][i]
    if ratio is None or ratio >= LEAST_HARD_RATIO:
        return None
    return f"its stiffness_ratio is {ratio:g}, and the calibration's lumps have {LEAST_HARD_RATIO:g} and more"


def _check_recipe(rows: Table, calibration: BodyCalibration, declared: Mapping[str, Any]) -> None:
    """Refuse a table of maps that were made or fitted otherwise than the calibration's."""
    ours = calibration.recipe
    if differs := ours.differences(table_recipe(rows, declared)):
        raise BadDataError(
            f"its maps were made by another recipe: {'; '.join(differs)}",
            way_out=f"a correction needs maps made with {ours.map_command}, fitted by `estimate` with the calibration "
            f"({ours}), and the table's columns must say so; or list the map files in a column named file",
        )


def _check_head(rows: Table, calibration: BodyCalibration) -> None:
    """Refuse a table of maps from a head with another radius than the calibration's, where it names no more of it."""
    head = calibration.recipe.head
    if head is None:
        return
    ours = "that is flat" if head.radius_mm is None else f"with a radius of {head.radius_mm:g} mm"
    for i, radius_mm in enumerate(rows.columns["head_radius_mm"]):
        if radius_mm is not None and head.differences(replace(head, radius_mm=radius_mm)):
            what = f"is {radius_mm:g}, and the calibration is for a head {ours}"
            raise rows.error(i, "head_radius_mm", what, way_out="learn a calibration for this head")
