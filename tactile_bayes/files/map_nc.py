"""Tactile maps as netCDF by the CF conventions; equal maps give equal bytes.

The cells' centres are the coordinate variables ``x`` and ``y`` (record 0089).
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np

from tactile_bayes.declarations import EXACT, Record, from_plain, names_of, to_plain
from tactile_bayes.errors import BadDataError
from tactile_bayes.files.atomic import write_bytes
from tactile_bayes.files.documents import parse_json
from tactile_bayes.files.netcdf import Contents, Group, Variable, grouped_netcdf_bytes, open_netcdf
from tactile_bayes.files.provenance import Provenance, scans_of
from tactile_bayes.files.reading import CELLS, check_limit
from tactile_bayes.findings import Finding
from tactile_bayes.geometry import LEAST_IN_PLANE, FloatArray, check_rigid
from tactile_bayes.mapping.map import MapRecipe, TactileMap
from tactile_bayes.scans import HeadShape

SCHEMA: Final = "tactile-bayes/map/2"
_WAY_OUT = "give a map this program wrote, or make it again with `tactile-bayes map`"

_CELLS: Final = ("y", "x")
# field of the map, whose variable has no _mm -> (type, dimensions, attributes for other programs)
_FIELDS: dict[str, tuple[str, tuple[str, ...], dict[str, str]]] = {
    "y_mm": ("f8", ("y",), {"units": "mm", "axis": "Y", "long_name": "cell centres along the head"}),
    "x_mm": ("f8", ("x",), {"units": "mm", "axis": "X", "long_name": "cell centres across the head"}),
    "mean": ("f8", _CELLS, {"long_name": "mean of the readings in the cell", "ancillary_variables": "variance count"}),
    "variance": (
        *("f8", _CELLS),
        {"long_name": "variance of the readings in the cell about their mean", "ancillary_variables": "count"},
    ),
    "count": (
        *("i8", _CELLS),
        {"units": "1", "long_name": "readings in the cell", "standard_name": "number_of_observations"},
    ),
}
# Units of pressure, force and voltage that UDUNITS reads; what else a user calls a grid's values is not checked.
_CF_UNITS = ("1", "Pa", "hPa", "kPa", "MPa", "bar", "mbar", "psi", "mmHg", "N", "mN", "V", "mV")
_TRANSFORMS = {
    "plane_from_base": "p_plane = plane_from_base p_base (tracker base, mm)",
    "patient_from_plane": "p_patient = patient_from_plane p_plane (origin xiphoid, y to sternal notch, mm)",
}


class MapHeader(Record, kw_only=True, omit_defaults=True):
    """Attributes of a map's file: the schema as a text, the others as JSON."""

    schema: Literal["tactile-bayes/map/2"]
    recipe: MapRecipe
    background: float | None
    frame_count: int
    quality: dict[str, float | None]  #: Null where a figure is not finite.
    masked_taxels: tuple[str, ...]
    head: HeadShape | None = None
    nipple_mm: tuple[float, float, float] | None = None
    findings: tuple[Finding, ...]
    provenance: dict[str, Any]


_SHARED: Final = ("recipe", "background", "frame_count", "masked_taxels", "head", "findings")
"""Fields of a header and of its map."""


def write_map(path: Path, tactile_map: TactileMap, *, provenance: Provenance, force: bool = False) -> None:
    """Write a map atomically, readable by its owner only; equal maps give equal bytes: no clock time is held."""
    _check_lattice({"x_mm": tactile_map.x_mm, "y_mm": tactile_map.y_mm}, tactile_map.recipe.cell_mm)
    groups = {"/": Contents(_variables(tactile_map), _attributes(tactile_map, provenance))}
    write_bytes(path, grouped_netcdf_bytes(groups), force=force)


def _variables(tactile_map: TactileMap) -> dict[str, Variable]:
    unit = tactile_map.recipe.value_unit  # empty where unknown
    square = unit if unit in ("", "1") else f"{unit}2" if unit.isalpha() else f"({unit})2"
    units = {"mean": unit, "variance": square}
    variables = {}
    for field, (kind, dimensions, attributes) in _FIELDS.items():
        more = {"units": units[field]} if units.get(field) else {}
        values = np.asarray(getattr(tactile_map, field), kind)
        fill = np.nan if field in units else None
        variables[field.removesuffix("_mm")] = Variable(values, dimensions, more | attributes, fill)
    for name, meaning in _TRANSFORMS.items():
        transform = getattr(tactile_map, name)
        if transform is not None:
            values = np.asarray(transform, dtype=np.float64)
            variables[name] = Variable(values, ("row", "column"), {"long_name": meaning})
    return variables


def read_map(path: Path) -> TactileMap:
    """Read a map and check all of it."""
    return read_map_and_header(path)[0]


def read_map_and_scans(path: Path) -> tuple[TactileMap, tuple[dict[str, str], ...]]:
    """Read a map, and the `Provenance.scans` it was made from; for the errors see `read_map`."""
    tactile_map, header = read_map_and_header(path)
    return tactile_map, scans_of(header.provenance)


def read_map_and_header(path: Path) -> tuple[TactileMap, MapHeader]:
    """Read a map and its file's header; for the errors see `read_map`."""
    with open_netcdf(path, way_out=_WAY_OUT) as file:
        header = _header(file)
        cells = 1
        for name in ("y", "x"):
            if (length := file.dimension(name)) is None:
                raise BadDataError(f"dimension {name} is missing", way_out=_WAY_OUT)
            cells *= length
        check_limit(cells, CELLS, what="it has {} cells")
        arrays = {}
        for field, (kind, dimensions, _) in _FIELDS.items():
            name = field.removesuffix("_mm")
            arrays[field] = file.array(name, kind=kind, dimensions=dimensions)
            if arrays[field] is None:
                raise BadDataError(f"variable {name} is missing", way_out=_WAY_OUT)
        transforms = {name: file.array(name, kind="f8", dimensions=("row", "column")) for name in _TRANSFORMS}
        for name, transform in transforms.items():
            if transform is not None:
                check_rigid(transform, name=name)
        patient = transforms["patient_from_plane"]
        if patient is not None and np.hypot(*patient[1, :2]) < 0.9 * LEAST_IN_PLANE:  # so low is no rounding
            what = "patient_from_plane has sternal notch and xiphoid on a line through the plane"
            raise BadDataError(what, way_out=_WAY_OUT)
        _check_lattice({"x": arrays["x_mm"], "y": arrays["y_mm"]}, header.recipe.cell_mm)
        tactile_map = TactileMap(
            **arrays,
            **transforms,
            **{name: getattr(header, name) for name in _SHARED},
            quality={name: math.nan if value is None else value for name, value in header.quality.items()},
            nipple_mm=None if header.nipple_mm is None else np.array(header.nipple_mm),
        )
        return tactile_map, header


def _attributes(tactile_map: TactileMap, provenance: Provenance) -> dict[str, str]:
    """Global attributes; a map without a unit that UDUNITS reads does not claim CF, which wants one."""
    header = MapHeader(
        schema=SCHEMA,
        **{name: getattr(tactile_map, name) for name in _SHARED},
        quality={name: float(v) if np.isfinite(v) else None for name, v in tactile_map.quality.items()},
        nipple_mm=None if tactile_map.nipple_mm is None else tuple(tactile_map.nipple_mm.tolist()),
        provenance=provenance.as_dict(),
    )
    plain = to_plain(header, digits=EXACT)
    del plain["schema"]
    return ({"Conventions": "CF-1.11"} if tactile_map.recipe.value_unit in _CF_UNITS else {}) | {
        "title": "Tactile map: mean normalised pressure on the best-fit plane",
        "schema": SCHEMA,
        **{name: json.dumps(value, allow_nan=False) for name, value in plain.items()},
    }


def _header(file: Group) -> MapHeader:
    if file.group("posterior") is not None:
        raise BadDataError("is a posterior, not a map", way_out="give the map that it was estimated from")
    texts = {name: text for name, text in file.attributes().items() if name in names_of(MapHeader)}
    document: dict[str, Any] = {
        name: text if name == "schema" else parse_json(text, name=f"attribute {name}", way_out=_WAY_OUT)
        for name, text in texts.items()
    }
    try:
        return from_plain(MapHeader, document, where="header")
    except BadDataError as error:
        raise BadDataError(error.what, way_out=_WAY_OUT) from None


def _check_lattice(axes: Mapping[str, FloatArray], cell_mm: float) -> None:
    """Raise `BadDataError` unless both axes are finite and step by one cell."""
    for name, axis in axes.items():
        if not np.isfinite(axis).all():
            raise BadDataError(f"variable {name} holds values that are not finite", way_out=_WAY_OUT)
        steps = np.diff(axis)
        rounding = 1e-6 * max(cell_mm, float(np.abs(axis).max(initial=0.0)))
        if len(steps) and float(np.abs(steps - cell_mm).max()) > min(rounding, 0.01 * cell_mm):
            what = f"variable {name} steps by {steps.min():g} to {steps.max():g} mm, not by the cell of {cell_mm:g} mm"
            raise BadDataError(what, way_out=_WAY_OUT)
