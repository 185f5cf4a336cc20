"""A size calibration corrected by a site's phantoms, from a table of their bumps or of their map files."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from tactile_bayes.api.estimating import estimate_file
from tactile_bayes.api.settings import Settings
from tactile_bayes.api.size_calibration import Learned, files_of, header_of, table_recipe
from tactile_bayes.api.sized import pooling_shape
from tactile_bayes.declarations import Record, replace
from tactile_bayes.errors import BadDataError, UsageError, in_file
from tactile_bayes.files.documents import load_json
from tactile_bayes.files.size_json import SHIPPED, read_size_calibration, size_calibration_path
from tactile_bayes.files.tables import Sheet, Table, read_table
from tactile_bayes.forward.tissue import parse_seat
from tactile_bayes.presets import HEAD_PROFILE, LEAST_HARD_RATIO
from tactile_bayes.progress import Progress
from tactile_bayes.size.bodies import BodyCalibration
from tactile_bayes.size.draws import BumpDraws, ShapeDraws
from tactile_bayes.size.learn.site import PhantomMap, correct_calibration

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
