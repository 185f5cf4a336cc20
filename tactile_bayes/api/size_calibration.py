"""Size calibrations of either form from a table of lumps, and one corrected by a site's phantoms."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, cast

import numpy as np

from tactile_bayes.api.arguments import PathLike, output_path, table_of, takes
from tactile_bayes.api.estimating import estimate_file
from tactile_bayes.api.settings import Settings
from tactile_bayes.api.sized import pooling_shape
from tactile_bayes.declarations import Record, replace
from tactile_bayes.errors import BadDataError, NotConvergedError, UsageError, in_file
from tactile_bayes.files.documents import load_json
from tactile_bayes.files.provenance import Provenance, exam_with_any, hash_inputs, recordings
from tactile_bayes.files.size_json import SHIPPED, read_size_calibration, size_calibration_path, write_size_calibration
from tactile_bayes.files.tables import Sheet, Table, header_of, read_table
from tactile_bayes.forward.tissue import parse_seat
from tactile_bayes.geometry import FloatArray
from tactile_bayes.options import LearnOptions
from tactile_bayes.presets import FIT_RADIUS_MM, HEAD_PROFILE, LEAST_HARD_RATIO, Background
from tactile_bayes.progress import Progress
from tactile_bayes.scans import HeadShape
from tactile_bayes.size.bodies import BodyCalibration
from tactile_bayes.size.draws import BumpDraws, ShapeDraws
from tactile_bayes.size.learn import bodies as learning
from tactile_bayes.size.learn import eq6
from tactile_bayes.size.learn.site import PhantomMap, correct_calibration
from tactile_bayes.size.pooling import Calibration
from tactile_bayes.size.terms import Normalise, Recipe
from tactile_bayes.studies.population import measuring_options, population_table, table_bodies, table_head

if TYPE_CHECKING:
    import pandas

_SOURCE: Final = "balls in a population of bodies, scanned by the solid model"
TINY_MM: Final = 4.0  #: Tables of lumps all below are rather in cm: no palpable mass is so small.
FAR_OFF: Final = 6.0  #: No lump of a table lies so far from its Eq 6 by both widths, unless it is in another unit.
_MAPS: Final = ("normalise", "background", "fit_radius_mm", "noise")  #: How a table's maps were made, if it is silent.


class LearnedCalibration(Record, eq=False):
    """A learned or corrected size calibration, with settings, inputs and diagnostics of its learning."""

    calibration: Calibration
    settings: dict[str, Any]  #: For the provenance.
    inputs: dict[str, Path]  #: Files by role, for the provenance.
    seed: int | None = None  #: Of the random numbers; None where it used none.
    base: dict[str, Any] | None = None  #: Document of the calibration that was corrected.
    lumps: eq6.SizeTable | None = None  #: The table as Eq 6 takes it, where that was learned.
    not_left_out: str = ""  #: Why no geometry could be left out; empty where they were, or the table is no study.
    other_fit: eq6.OtherFit | None = None  #: The table by the other of the two fits; None where that does not exist.
    table_rows: int = 0  #: Rows of the table that Eq 6 was learned from, those left out too.

    def write(self, path: Path, *, force: bool = False) -> None:
        """Write the file that `estimate --size-calibration` takes."""
        provenance = Provenance("calibrate size", self.settings, hash_inputs(**self.inputs), seed=self.seed)
        write_size_calibration(path, self.calibration, base=self.base, provenance=provenance, force=force)


def learn(
    table: Path | Sheet,
    options: LearnOptions,
    typed: Collection[str],
    *,
    correct: str | None = None,
    against: Path | None = None,
    progress: Progress | None = None,
) -> LearnedCalibration:
    """Learn a size calibration by the form of table and options; options of another form are refused.

    `typed`: names of the options that were typed; `correct`: name or path of the calibration to correct; `against`:
    lumps of another origin, for one over bodies.
    """
    if correct is not None:
        why = "is for learning a calibration; leave it out with --correct"
        _refuse(typed, why, "form", "against", "fit", "least_stiffness_ratio", "figure")
        return _corrected(table, correct, options, progress)
    if options.form != "eq6" or {"body", "exam"} <= set(header_of(table)):
        why = "is for tables of lumps: a table of `population` fixes how its maps were made"
        _refuse(typed, why, "fit", *_MAPS[1:], "least_stiffness_ratio", "figure", "seed")
        return _over_bodies(table, options, against)
    _refuse(typed, "is for a table of `population`; leave it out", "against")
    return _eq6(table, options, progress)


def _refuse(typed: Collection[str], why: str, *names: str) -> None:
    for name in names:
        if name in typed:
            raise UsageError(f"--{name.replace('_', '-')} {why}")


def _files(**tables: Path | Sheet | None) -> dict[str, Path]:
    return {role: table for role, table in tables.items() if isinstance(table, Path)}


def _eq6(table: Path | Sheet, options: LearnOptions, progress: Progress | None) -> LearnedCalibration:
    """Learn Eq 6 from a table of lumps, without those below the least stiffness ratio.

    By the joint posterior of all coefficients (``"joint"``), or as the paper does, with a bootstrap (``"two-stage"``).
    """
    rows = read_table(table, "size_table.table.json")
    recipe, least = table_recipe(rows, options), options.least_stiffness_ratio
    with in_file(rows.path):
        lumps = size_table(rows, least_stiffness_ratio=least)
        rng = np.random.default_rng(options.seed)
        if options.fit == "two-stage":
            calibration = eq6.learn_two_stage(lumps, recipe=recipe, rng=rng)
        else:
            calibration = eq6.learn_size_calibration(lumps, recipe=recipe, rng=rng, progress=progress)
        other = eq6.other_fit(calibration, lumps)
        one_axis = eq6.axis_in_two_stages if options.fit == "two-stage" else eq6.axis_at_mode
        left_out, not_left_out = None, ""  # cross-validated errors, or why Eq 6 has none
        try:
            left_out = eq6.cross_validate(lumps, least_stiffness_ratio=least, fit=one_axis)
        except (NotConvergedError, BadDataError) as error:
            not_left_out = str(error)
    made = (recipe.normalise, recipe.background, recipe.radius_mm, recipe.noise)
    settings = {**dict(zip(_MAPS, made, strict=True)), "least_stiffness_ratio": least, "fit": options.fit}
    cautions = table_cautions(rows.columns, least_stiffness_ratio=least)
    axes = zip((calibration.x, calibration.y), eq6.axis_rows(lumps), strict=False)
    errors = [np.abs(eq6.log_error(axis.size_mm(one.sigma_mm, one.amplitude), one.d_mm)) for axis, one in axes]
    if off := int(np.sum(np.min(errors, axis=0) > math.log(FAR_OFF))):
        cautions += (f"Eq 6 sizes {off} of its lumps more than {FAR_OFF:g} times too large or small: is d_mm in mm?",)
    learned = replace(calibration, left_out=left_out, cautions=cautions)
    files = _files(table=table)
    return LearnedCalibration(learned, settings, files, options.seed, None, lumps, not_left_out, other, len(rows))


def table_cautions(columns: Mapping[str, Sequence[Any]], *, least_stiffness_ratio: float = 0.0) -> tuple[str, ...]:
    """Cautions on sizes by Eq 6 from a table of lumps."""
    cautions, seats, largest_mm = [], set(columns["seat"]), max(columns["d_mm"])
    if largest_mm < TINY_MM:
        cautions.append(f"its largest lump has {largest_mm:g} mm; if its diameters are in cm, sizes come out as cm too")
    if set(columns["sigma_y_mm"]) == {None}:
        cautions.append(
            "its lumps have one width; if they were cylinders, as in a study in two dimensions, "
            "balls come out 40 to 110 % too large"
        )
    if len(seats) == 1 and None not in seats:
        cautions.append(f"its lumps have one seat ({seats.pop()}); one of another seat may come out half too large")
    softest = min((ratio for ratio in columns["stiffness_ratio"] if ratio is not None), default=LEAST_HARD_RATIO)
    if max(softest, least_stiffness_ratio) < LEAST_HARD_RATIO:
        cautions.append("it holds soft lumps, beside which hard ones come out too large (--least-stiffness-ratio 8)")
    return tuple(cautions)


def _over_bodies(table: Path | Sheet, options: LearnOptions, against: Path | None) -> LearnedCalibration:
    """Learn a calibration from a table of `population`; the lumps `against` it give the SD of other bodies."""
    other_rows = None if against is None else read_table(against, "population.table.json")
    rows, fit = read_table(table, "population.table.json"), measuring_options()
    way, columns = rows_of_one_way(rows, options.normalise)
    bodies, residual = table_bodies(columns), options.form == "eq6-residual"
    settings: dict[str, Any] = {"form": options.form, "masses": len(set(columns["body"])), "bodies": bodies}
    with in_file(rows.path):
        head = table_head(columns)
        recipe = Recipe(
            way, fit.background, fit.fit_radius_mm, declared=False, noise=fit.noise, flat_field=False, head=head
        )
        learned = learning.learn_population(population_table(columns), recipe=recipe, source=_SOURCE, residual=residual)
    if residual and learned.residual is None:
        raise BadDataError(
            f"fewer than {learning.LEAST_BODIES} bodies have a lump and a head profile: too few for a residual",
            way_out="give a larger population, or --form eq6",
            path=str(rows.path),
        )
    learned = replace(learned, bodies=bodies)
    if other_rows is not None:
        other_table = population_table(rows_of_one_way(other_rows, way)[1])
        settings["other_masses"] = len(set(other_table.body.tolist()))
        source = f"{settings['other_masses']} lumps of {other_rows.path.name}"
        learned = learning.learn_other_sd(learned, other_table, source=source)
    return LearnedCalibration(learned, settings, _files(table=table, against=against))


def table_recipe(table: Table, options: LearnOptions) -> Recipe:
    """Recipe of a size table's maps: from its columns, else as the options declare, else the default."""
    stated = {name: _constant(table, name) for name in (*_MAPS, "flat_field")}
    settings = {name: getattr(options, name) if stated[name] is None else stated[name] for name in _MAPS}
    for name, value in settings.items():
        if getattr(options, name) not in (None, value):
            option, also = f"--{name.replace('_', '-')}", ""
            if name == "normalise":
                also = f", and size maps made with `map --normalise {value}`; "
                also += "`population` gives a table for --normalise gain"
            what = f"its {name} is {value}, not {getattr(options, name)} as {option} says"
            raise BadDataError(what, way_out=f"leave out {option}{also}", path=str(table.path))
    normalise: Normalise = settings["normalise"] or "mean"
    background: Background = settings["background"] or ("free" if normalise == "none" else "fixed")
    if normalise == "none" and background == "fixed":
        raise UsageError("maps of --normalise none have no level to fix a background at; give --background free")
    return Recipe(
        normalise,
        background,
        settings["fit_radius_mm"] or FIT_RADIUS_MM,
        declared=any(stated[name] is None for name in _MAPS),
        noise=settings["noise"] or "independent",
        flat_field=stated["flat_field"],
        head=_named_head(table),
    )


def _named_head(table: Table) -> HeadShape | None:
    """Head that a table of lumps names; None where it names none."""
    names = ("head_rows", "head_columns", "head_pitch_mm")
    values = [_constant(table, name) for name in names]
    if values == [None, None, None]:
        return None
    if None in values:
        what = f"names a head without {names[values.index(None)]}"
        raise BadDataError(what, way_out=f"give {', '.join(names)} and head_radius_mm", path=str(table.path))
    return HeadShape(values[0], values[1], values[2], _constant(table, "head_radius_mm"))


def _constant(table: Table, name: str) -> Any:
    """Value of a column that must be constant."""
    values = table.columns[name]
    if len(set(values)) > 1:
        what = f"{name} differs between rows"
        raise BadDataError(what, way_out="join tables of maps made alike only", path=str(table.path))
    return values[0]


def rows_of_one_way(rows: Table, normalise: str | None) -> tuple[Normalise, dict[str, list[Any]]]:
    """How a `population` table's maps were normalised, and its columns for the rows that were.

    Tables without the column, and empty cells, are of maps normalised by the mean.
    """
    ways = [str(value or "mean") for value in rows.columns.get("normalise", ["mean"] * len(rows))]
    present = sorted(set(ways))
    chosen = normalise or present[0]
    if normalise is None and len(present) > 1:
        what = f"its maps were normalised in several ways ({', '.join(present)})"
        raise BadDataError(what, way_out=f"learn from the rows of one way: --normalise {chosen}", path=str(rows.path))
    if chosen not in present:
        what = f"none of its maps were made with --normalise {chosen}"
        raise BadDataError(what, way_out=f"give --normalise {present[0]}", path=str(rows.path))
    indices = [i for i, way in enumerate(ways) if way == chosen]
    return cast("Normalise", chosen), {name: [values[i] for i in indices] for name, values in rows.columns.items()}


def size_table(table: Table, *, least_stiffness_ratio: float = 0.0) -> eq6.SizeTable:
    """Columns of a table as arrays, with Delta sigma where depths are stated; without softer lumps."""
    # only lumps marked as detectable: fits to the others describe a trough
    flags, ratios = table.columns["detectable"], table.columns["stiffness_ratio"]
    is_hard = [ratio is None or ratio >= least_stiffness_ratio for ratio in ratios]
    hard = [row for row in range(len(table)) if is_hard[row] and flags[row] is not False]
    columns = {name: [values[row] for row in hard] for name, values in table.columns.items()}

    def array(name: str) -> FloatArray | None:
        values = columns[name]
        if all(value is None for value in values):
            return None
        if any(value is None for value in values):
            row = hard[values.index(None)]
            raise table.error(row, name, "is blank in some rows only", way_out="fill the column or leave it out")
        return np.asarray(values, dtype=np.float64)

    d_mm, amplitude, sigma_x, sigma_y = (array(n) for n in ("d_mm", "amplitude", "sigma_x_mm", "sigma_y_mm"))
    depth = array("depth_ratio")
    if d_mm is None or amplitude is None or sigma_x is None:
        what = f"each of its lumps is marked as not detectable, or softer than {least_stiffness_ratio:g}"
        way_out = "give others, or a lower --least-stiffness-ratio"
        raise BadDataError(what, way_out=way_out, path=str(table.path))
    if depth is None:
        return eq6.SizeTable(d_mm, amplitude, sigma_x, sigma_y)
    same = [columns[name] for name in ("seat", "d_mm", "stiffness_ratio", "thickness_mm", "head_radius_mm", "head")]
    group = list(zip(*same, strict=True))
    change_x, change_y = (
        None if one is None else eq6.width_changes(one, depth_ratio=depth, group=group) for one in (sigma_x, sigma_y)
    )
    names = ("stiffness_ratio", "thickness_mm", "head_radius_mm")
    others = {name: np.asarray(columns[name], dtype=np.float64) for name in names if None not in columns[name]}
    ratio = others.pop("stiffness_ratio", None)  # a study states that of every lump
    cases = None if ratio is None else eq6.StudyCases(tuple(columns["seat"]), depth, ratio, others)
    return eq6.SizeTable(d_mm, amplitude, sigma_x, sigma_y, change_x, change_y, cases, depth)


# --- A calibration corrected by a site's phantoms, from a table of their bumps or of their map files.

HARDEST_RATIO = 100.0
"""Largest E2/E1 of the simulated bodies; a harder lump counts as this one, because widths hardly change beyond it."""


def _corrected(table: Path | Sheet, base: str, options: LearnOptions, progress: Progress | None) -> LearnedCalibration:
    """Correct a calibration over bodies by phantoms.

    `table`: a row for each map of a phantom: its bump (size_table) or its file (phantom_maps); `base`: name or path of
    the calibration.
    """
    path = size_calibration_path(base)
    calibration = None if path is None else read_size_calibration(path)
    if path is None or not isinstance(calibration, BodyCalibration):
        raise UsageError(
            f"{base} cannot be corrected: it was not learned over bodies; "
            "give --correct solid, solid-mean or eq6, or a file learned from a table of `population`"
        )
    by_files, inputs = "file" in header_of(table), {**_files(table=table), "size_calibration": path}
    with in_file(table if isinstance(table, Path) else table.name):
        if by_files:
            declared = [name for name in _MAPS if getattr(options, name) is not None]
            _refuse(declared, "is for tables of amplitudes and widths: map files state how they were made", *_MAPS)
            rows = read_table(table, "phantom_maps.table.json")
            names = [str(file) for file in rows.columns["file"]]
            folder = table.parent if isinstance(table, Path) else Path()
            inputs |= {f"map_{i}": folder / name for i, name in enumerate(names, start=1)}
        else:
            rows = read_table(table, "size_table.table.json")
            _check_table(rows, calibration, options)
            names = [f"line {line}" for line in rows.line_numbers]
        maps, left_out, by_recipe = [], [], Settings(size_calibration=base, seed=options.seed)
        made = dict[str, str]()  # the row of each scan
        lines = [dict(zip(rows.columns, cells, strict=True)) for cells in zip(*rows.columns.values(), strict=True)]
        for i, (phantom, row) in enumerate(zip(_names(rows, lines, names), lines, strict=True)):
            bump = None if by_files else _bump(rows, i, row)
            if why := _unfit(row):
                left_out.append(f"{phantom}: {why}")
                continue
            if bump is None:
                outcome = estimate_file(folder / names[i], by_recipe)
                marks = str(outcome.tactile_map.fingerprint), *recordings(outcome.provenance.scans)
                if twin := exam_with_any(marks, names[i], made):
                    raise rows.error(i, "file", f"is of the same scan as {twin}", way_out="list each scan once")
                if progress is not None:
                    progress(i + 1, len(rows))
                bump = pooling_shape(outcome.tactile_map, outcome.estimate)
                if bump is None:
                    left_out.append(f"{names[i]}: {outcome.estimate.reason}")
                    continue
            maps.append(PhantomMap(phantom, row["d_mm"], bump, _known(rows, i, row)))
        name = base if base in SHIPPED else path.name
        corrected = correct_calibration(calibration, maps, base=name, left_out=left_out)
    document: Any = load_json(path)
    settings = {"correct": name, "of": "maps" if by_files else "bumps", "seed": options.seed}
    return LearnedCalibration(corrected, settings, inputs, base=document)


def _bump(rows: Table, i: int, row: Mapping[str, Any]) -> ShapeDraws:
    if row["sigma_y_mm"] is None:
        raise rows.error(i, "sigma_y_mm", "is blank", way_out="give both widths of the map")
    a, x, y = (np.array([row[one]], dtype=np.float64) for one in ("amplitude", "sigma_x_mm", "sigma_y_mm"))
    profile = tuple(row[one] for one in HEAD_PROFILE)
    return ShapeDraws.of(BumpDraws(a, x, y, np.zeros(1)), profile=None if None in profile else profile)


def _names(rows: Table, lines: Sequence[Mapping[str, Any]], otherwise: Sequence[str]) -> list[str]:
    """Phantom of each row; rows of one phantom must state the same properties."""
    names = [other if row["phantom"] is None else row["phantom"] for row, other in zip(lines, otherwise, strict=True)]
    first: dict[str, Mapping[str, Any]] = {}
    for i, (name, row) in enumerate(zip(names, lines, strict=True)):
        other = first.setdefault(name, row)
        for column in ("d_mm", "depth_ratio", "stiffness_ratio", "seat"):
            if row[column] != other[column]:
                what = f"is {row[column]}, but {other[column]} in another row of {name}"
                raise rows.error(i, column, what, way_out="give each lump a name of its own")
    return names


def _known(rows: Table, i: int, row: Mapping[str, Any]) -> dict[str, float]:
    """The properties of a row's phantom, by the names of `HiddenTerms`."""
    properties: dict[str, float] = {}
    if row["depth_ratio"] is not None:
        properties["depth_mm"] = row["depth_ratio"] * row["d_mm"]
    if row["stiffness_ratio"] is not None:
        properties["stiffness_ratio"] = min(row["stiffness_ratio"], HARDEST_RATIO)
    if row["seat"] is not None:
        try:
            properties["seat"] = parse_seat(row["seat"])
        except BadDataError as error:
            raise rows.error(i, "seat", f"is {row['seat']!r}", way_out=error.way_out) from None
    return properties


def _unfit(row: Mapping[str, Any]) -> str:
    """Reason why a lump is left out: not detectable, or softer than the calibration's; empty where it is used."""
    if row.get("detectable") is False:
        return "its row says that it is not detectable"
    ratio = row["stiffness_ratio"]
    if ratio is None or ratio >= LEAST_HARD_RATIO:
        return ""
    return f"its stiffness_ratio is {ratio:g}, and the calibration's lumps have {LEAST_HARD_RATIO:g} and more"


def _check_table(rows: Table, calibration: BodyCalibration, options: LearnOptions) -> None:
    """Refuse a table of maps that were made or fitted otherwise than the calibration's, or with another head."""
    ours = calibration.recipe
    if differs := ours.differences(table_recipe(rows, options)):
        raise BadDataError(
            f"its maps were made by another recipe: {'; '.join(differs)}",
            way_out=f"a correction needs maps made with {ours.map_command}, fitted by `estimate` with the calibration "
            f"({ours}), and the table's columns must say so; or list the map files in a column named file",
        )
    head = ours.head
    for i, radius_mm in enumerate(rows.columns["head_radius_mm"]):  # the table may name no more of its head
        if head is not None and radius_mm is not None and head.differences(replace(head, radius_mm=radius_mm)):
            shape = "that is flat" if head.radius_mm is None else f"with a radius of {head.radius_mm:g} mm"
            what = f"is {radius_mm:g}, and the calibration is for a head {shape}"
            raise rows.error(i, "head_radius_mm", what, way_out="learn a calibration for this head")


# --- From Python.


@takes(LearnOptions)
def calibrate_size(
    table: PathLike | pandas.DataFrame,
    *,
    correct: PathLike | None = None,
    path: PathLike | None = None,
    force: bool = False,
    progress: Progress | None = None,
    **options: Any,
) -> Calibration:
    """Learn a size calibration from lumps of known size, which takes some seconds.

    Parameters
    ----------
    table
        A row for each lump: d_mm, amplitude, sigma_x_mm...; or a table of `population`, a row for each exam.
    correct
        Name or path of a calibration over bodies that the table's lumps correct; the table may also list map files.
    path
        Also write the calibration there.
    progress
        Called with the numbers done and required: of effective draws for each axis, or of the maps that a table lists.
    **options
        As of `tactile_bayes.options.LearnOptions`, by default as on the command line.

    Returns
    -------
    calibration
        For ``estimate(..., size_calibration=...)``.

    Raises
    ------
    BadDataError
        Naming the table, the line, the column, the value and the way out.
    UsageError
        When a keyword's value is out of range, or belongs to another form.
    """
    target = None if path is None else output_path(path, "JSON")
    base = None if correct is None else str(correct)
    learned = learn(table_of(table, "table"), LearnOptions(**options), options, correct=base, progress=progress)
    if target is not None:
        learned.write(target, force=force)
    return learned.calibration
