"""Tactile maps as netCDF: everything a map is, readable by any netCDF tool; equal maps give equal bytes."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from tactile_bayes.errors import BadDataError
from tactile_bayes.files.atomic import atomic_path, unreadable
from tactile_bayes.files.kinds import not_a
from tactile_bayes.files.provenance import Provenance
from tactile_bayes.geometry import check_rigid
from tactile_bayes.mapping.tactile_map import MapRecipe, TactileMap
from tactile_bayes.presets import NORMALISE

SCHEMA = "tactile-bayes/map/1"
MAX_CELLS = 2**24
_WAY_OUT = "give a map this program wrote, or make it again with `tactile-bayes map`"

# variable -> (type, dimensions, attributes); the long names are for the reader of the file.
_VARIABLES: dict[str, tuple[str, tuple[str, ...], dict[str, str]]] = {
    "y_mm": ("f8", ("y",), {"units": "mm", "axis": "Y", "long_name": "cell centres along the head"}),
    "x_mm": ("f8", ("x",), {"units": "mm", "axis": "X", "long_name": "cell centres across the head"}),
    "mean": ("f8", ("y", "x"), {"long_name": "mean of the readings in the cell"}),
    "variance": ("f8", ("y", "x"), {"long_name": "variance of the readings in the cell about their mean"}),
    "count": ("i8", ("y", "x"), {"units": "1", "long_name": "readings in the cell"}),
}
_TRANSFORMS = {
    "plane_from_base": "p_plane = plane_from_base p_base (tracker base, mm)",
    "patient_from_plane": "p_patient = patient_from_plane p_plane (origin xiphoid, y to sternal notch, mm)",
}


def write_map(path: Path, tactile_map: TactileMap, *, provenance: Provenance, force: bool = False) -> None:
    """Write a map atomically, for its owner's eyes only.

    Parameters
    ----------
    path
        Usually ``*.nc``.
    provenance
        What made the map; it holds no clock time, so that equal maps give equal bytes.
    force
        Overwrite an existing file.

    Raises
    ------
    UsageError
        When `path` exists and `force` is false.
    BadDataError
        When the map's axes do not step by its cell.
    """
    import netCDF4

    _check_lattice({"x_mm": tactile_map.x_mm, "y_mm": tactile_map.y_mm}, tactile_map.recipe.cell_mm)
    with (
        atomic_path(path, force=force) as partial,
        netCDF4.Dataset(str(partial), "w", clobber=True, format="NETCDF4") as file,
    ):
        file.setncatts(_attributes(tactile_map, provenance))
        file.createDimension("y", len(tactile_map.y_mm))
        file.createDimension("x", len(tactile_map.x_mm))
        file.createDimension("row", 4)
        file.createDimension("column", 4)
        for name, (kind, dimensions, attributes) in _VARIABLES.items():
            units = _units(tactile_map).get(name)
            _write_variable(
                file,
                name,
                kind,
                dimensions,
                getattr(tactile_map, name),
                attributes | ({"units": units} if units else {}),
            )
        for name, meaning in _TRANSFORMS.items():
            transform = getattr(tactile_map, name)
            if transform is not None:
                _write_variable(file, name, "f8", ("row", "column"), transform, {"long_name": meaning})


def read_map(path: Path) -> TactileMap:
    """Read a map and check all of it.

    Raises
    ------
    BadDataError
        Naming the file, the variable or attribute, its value and the way out.
    """
    with _opened(path) as file:
        header = _header(file)
        arrays = {name: _read_variable(file, name) for name in _VARIABLES}
        transforms = {name: _read_transform(file, name) for name in _TRANSFORMS}
        _check_lattice({name: arrays[name] for name in ("x_mm", "y_mm")}, header["recipe"].cell_mm)
        return TactileMap(
            **arrays,
            **transforms,
            recipe=header["recipe"],
            background=header["background"],
            frame_count=header["frame_count"],
            quality=header["quality"],
            masked_taxels=tuple(header["masked_taxels"]),
        )


def read_map_header(path: Path) -> dict[str, Any]:
    """What a map file says about itself: schema, recipe, quality, provenance... without the arrays.

    Returns
    -------
    dict with ``schema``, ``recipe`` (`MapRecipe`), ``quality``, ``masked_taxels``, ``provenance``, ``background``,
    ``frame_count`` and ``shape`` (ny, nx).
    """
    with _opened(path) as file:
        shape = tuple(_dimension(file, name) for name in ("y", "x"))
        return _header(file) | {"shape": shape}


def _units(tactile_map: TactileMap) -> dict[str, str]:
    """Units of the variables whose unit hangs on the recipe."""
    if tactile_map.recipe.normalise == "none":
        return {"mean": "kPa", "variance": "kPa2"}
    return {"mean": "1", "variance": "1"}


def _attributes(tactile_map: TactileMap, provenance: Provenance) -> dict[str, str]:
    """Global attributes; whatever has structure is JSON with keys in a fixed order."""
    return {
        "Conventions": "CF-1.11",
        "title": "Tactile map: mean normalised pressure on the best-fit plane",
        "schema": SCHEMA,
        "recipe": _json(asdict(tactile_map.recipe)),
        "background": _json(tactile_map.background),
        "frame_count": _json(int(tactile_map.frame_count)),
        "quality": _json({name: _finite(value) for name, value in tactile_map.quality.items()}),
        "masked_taxels": _json(list(tactile_map.masked_taxels)),
        "provenance": _json(provenance.as_dict()),
    }


def _json(value: object) -> str:
    return json.dumps(value, allow_nan=False)


def _finite(value: float) -> float | None:
    """A figure for JSON, which has no NaN: an unknown one is null."""
    return float(value) if np.isfinite(value) else None


def _write_variable(
    file: Any, name: str, kind: str, dimensions: tuple[str, ...], values: object, attributes: Mapping[str, str]
) -> None:
    packing = {"zlib": True, "complevel": 4, "shuffle": True, "fletcher32": True}  # a check sum, so that damage shows
    variable = file.createVariable(name, kind, dimensions, fill_value=False, **packing)
    variable.setncatts(attributes)
    variable[:] = values


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """The open file; every fault in it becomes a `BadDataError` that names `path`."""
    import netCDF4

    try:
        with path.open("rb"):
            pass
        file = netCDF4.Dataset(str(path), "r")
    except OSError as error:
        if path.is_file() and (error.errno or 0) < 0:  # the library numbers its own faults below zero
            raise not_a(
                path, "a map or posterior (netCDF)", what="not a readable netCDF file", way_out=_WAY_OUT
            ) from None
        raise unreadable(path, error) from None
    try:
        file.set_auto_mask(False)
        yield file
    except BadDataError as error:
        raise error.at(path) from None
    except (RuntimeError, OSError) as error:
        raise BadDataError(f"the file is damaged ({error})", way_out=_WAY_OUT, path=str(path)) from None
    finally:
        file.close()


def _header(file: Any) -> dict[str, Any]:
    if "posterior" in file.groups:
        raise BadDataError("is a posterior, not a map", way_out="give the map that it was estimated from")
    schema = _attribute(file, "schema")
    if schema != SCHEMA:
        raise BadDataError(f"schema is {schema!r}, not {SCHEMA!r}", way_out=_WAY_OUT)
    return {
        "schema": schema,
        "recipe": _recipe(_decoded(file, "recipe", dict)),
        "background": _number(_decoded(file, "background", (float, int, type(None))), name="background"),
        "frame_count": _decoded(file, "frame_count", int),
        "quality": _quality(_decoded(file, "quality", dict)),
        "masked_taxels": [str(line) for line in _decoded(file, "masked_taxels", list)],
        "provenance": _decoded(file, "provenance", dict),
    }


def _attribute(file: Any, name: str) -> str:
    if name not in file.ncattrs():
        raise BadDataError(f"attribute {name} is missing", way_out=_WAY_OUT)
    return str(file.getncattr(name))


def _decoded(file: Any, name: str, kind: type | tuple[type, ...]) -> Any:
    text = _attribute(file, name)
    try:
        value = json.loads(text)
    except json.JSONDecodeError:
        value = ...
    if not isinstance(value, kind) or isinstance(value, bool):
        raise BadDataError(f"attribute {name} holds {_short(text)}", way_out=_WAY_OUT)
    return value


def _number(value: float | int | None, *, name: str) -> float | None:
    if value is not None and not np.isfinite(value):
        raise BadDataError(f"attribute {name} holds {value}", way_out=_WAY_OUT)
    return None if value is None else float(value)


def _quality(values: dict[str, Any]) -> dict[str, float]:
    for name, value in values.items():
        if value is not None and not isinstance(value, int | float):
            raise BadDataError(f"quality.{name} is {_short(value)}, not a number", way_out=_WAY_OUT)
    return {name: float("nan") if value is None else float(value) for name, value in values.items()}


def _recipe(fields: dict[str, Any]) -> MapRecipe:
    """The recipe from its JSON, each field checked."""
    window = fields.get("pressure_window_kpa")
    checks = {
        "source": isinstance(fields.get("source"), str),
        "normalise": fields.get("normalise") in NORMALISE,
        "cell_mm": _is_number(fields.get("cell_mm")) and fields["cell_mm"] > 0,
        "pressure_window_kpa": window is None
        or (isinstance(window, list) and len(window) == 2 and all(_is_number(end) for end in window)),
        "latency_ms": _is_number(fields.get("latency_ms")),
    }
    for name, good in checks.items():
        if not good:
            raise BadDataError(f"recipe.{name} is {_short(fields.get(name))}", way_out=_WAY_OUT)
    ends = None if window is None else (float(window[0]), float(window[1]))
    later = {name: fields.get(name, False) for name in ("flat_field", "registered")}  # not in the first maps
    for name, value in later.items():
        if not isinstance(value, bool):
            raise BadDataError(f"recipe.{name} is {_short(value)}", way_out=_WAY_OUT)
    return MapRecipe(
        fields["source"], fields["normalise"], float(fields["cell_mm"]), ends, float(fields["latency_ms"]), **later
    )


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and bool(np.isfinite(value))


def _short(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


def _dimension(file: Any, name: str) -> int:
    if name not in file.dimensions:
        raise BadDataError(f"dimension {name} is missing", way_out=_WAY_OUT)
    return len(file.dimensions[name])


def _read_variable(file: Any, name: str) -> Any:
    """One array, after its type, dimensions and size were checked."""
    kind, dimensions, _ = _VARIABLES[name]
    return _checked(file, name, kind, dimensions)


def _checked(file: Any, name: str, kind: str, dimensions: tuple[str, ...]) -> Any:
    if name not in file.variables:
        raise BadDataError(f"variable {name} is missing", way_out=_WAY_OUT)
    variable = file.variables[name]
    if variable.dimensions != dimensions:
        raise BadDataError(f"variable {name} has dimensions {variable.dimensions}, not {dimensions}", way_out=_WAY_OUT)
    if variable.dtype != np.dtype(kind):
        raise BadDataError(f"variable {name} is {variable.dtype}, not {np.dtype(kind)}", way_out=_WAY_OUT)
    size = int(np.prod([len(file.dimensions[dimension]) for dimension in dimensions], dtype=object))
    if size > MAX_CELLS:
        raise BadDataError(f"variable {name} has {size} cells, over {MAX_CELLS}", way_out=_WAY_OUT)
    return np.asarray(variable[:], dtype=np.dtype(kind).newbyteorder("="))


def _read_transform(file: Any, name: str) -> Any:
    if name not in file.variables:
        return None
    if len(file.dimensions.get("row", ())) != 4 or len(file.dimensions.get("column", ())) != 4:
        raise BadDataError(f"variable {name} is not 4 by 4", way_out=_WAY_OUT)
    transform = _checked(file, name, "f8", ("row", "column"))
    check_rigid(transform, name=name)
    return transform


def _check_lattice(axes: Mapping[str, Any], cell_mm: float) -> None:
    """Raise `BadDataError` unless both axes are finite and step by one cell."""
    for name, axis in axes.items():
        if not np.isfinite(axis).all():
            raise BadDataError(f"variable {name} holds values that are not finite", way_out=_WAY_OUT)
        steps = np.diff(axis)
        if len(steps) and float(np.abs(steps - cell_mm).max()) > 1e-6 * max(cell_mm, float(np.abs(axis).max())):
            raise BadDataError(
                f"variable {name} steps by {steps.min():g} to {steps.max():g} mm, not by the cell of {cell_mm:g} mm",
                way_out=_WAY_OUT,
            )
