"""Heads as JSON: places of the taxels, or their grid and arc, for `record` and for simulated bodies."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from tactile_bayes.errors import BadDataError
from tactile_bayes.files.documents import load_json
from tactile_bayes.files.keys import refuse_unknown
from tactile_bayes.files.scan_parts import head_from_document
from tactile_bayes.files.schema import check_document, load_schema
from tactile_bayes.forward.scene import FLAT_MM, Head, Scene
from tactile_bayes.head_shape import HeadShape
from tactile_bayes.scan import HeadGeometry

HEAD_SCHEMA: Final = "tactile-bayes/head/1"
SCHEMA_FILE: Final = "head.schema.json"
_OF_ARC: Final = ("rows", "columns", "radius_mm")
_DEFAULT_RIM_MM: Final = Head().rim_mm
# Taxels further than this from a regular grid on an arc make a head that the models do not have.
_REGULAR_MM: Final = 0.05
_WAY_OUT: Final = (
    "give pitch_mm, and surface_mm or rows, columns and radius_mm; `record` needs scanhead_from_tracker too"
)


def read_head_geometry(path: Path) -> HeadGeometry:
    """Read the places of the taxels and the mounting of the tracker.

    Raises
    ------
    BadDataError
        Naming the file, the key, its value and what is allowed.
    """
    document = _read(path)
    try:
        if "scanhead_from_tracker" not in document:
            raise BadDataError("lacks scanhead_from_tracker", way_out="add the transform from the sensor to the head")
        if "surface_mm" not in document:
            document = {**document, "surface_mm": _arc(document).surface_mm()}
        return head_from_document(document)
    except BadDataError as error:
        raise error.at(path) from None


def read_simulated_head(path: Path) -> Head:
    """Read a head for the solid model, in which taxels form a regular grid on an arc, or on a plane.

    Raises
    ------
    BadDataError
        Naming the file, the key, its value and what is allowed; also for taxels on another surface.
    """
    document = _read(path)
    try:
        return _arc(document) if "surface_mm" not in document else _fitted(document)
    except BadDataError as error:
        raise error.at(path) from None


def _read(path: Path) -> dict[str, Any]:
    document: Any = load_json(path, way_out=_WAY_OUT)
    found = document.get("schema") if isinstance(document, dict) else None
    if found != HEAD_SCHEMA:
        raise BadDataError(f"has schema {found!r}, not {HEAD_SCHEMA!r}", way_out=_WAY_OUT, path=str(path))
    refuse_unknown(document, load_schema(SCHEMA_FILE)["properties"], path=path)
    check_document(document, SCHEMA_FILE, path=path)
    given = [name for name in _OF_ARC if name in document]
    if "surface_mm" in document and given:
        what = f"gives both surface_mm and {given[0]}"
        raise BadDataError(what, way_out="leave out one of the two descriptions", path=str(path))
    missing = [] if "surface_mm" in document else [name for name in _OF_ARC if name not in document]
    if missing:
        raise BadDataError(f"lacks {missing[0]}", way_out=_WAY_OUT, path=str(path))
    return dict(document)


def _arc(document: Mapping[str, Any]) -> Head:
    """Head of a grid on an arc, checked as a scene's."""
    radius = document["radius_mm"]
    return _checked(document, document["rows"], document["columns"], FLAT_MM if radius is None else float(radius))


def _checked(document: Mapping[str, Any], rows: int, columns: int, radius_mm: float) -> Head:
    shoulder = float(document.get("shoulder_mm", 0.0))
    rim = float(document.get("rim_mm", 0.0 if shoulder else _DEFAULT_RIM_MM))
    if shoulder and rim:
        raise BadDataError(f"gives shoulder_mm {shoulder:g} and rim_mm {rim:g}", way_out="give one of them above 0")
    head = Head(rows, columns, float(document["pitch_mm"]), radius_mm, shoulder, rim)
    Scene(head=head)  # refuses what is no head
    return head


def _fitted(document: Mapping[str, Any]) -> Head:
    """Head whose taxels are where `surface_mm` has them."""
    surface = _surface(document)
    pitch = float(document["pitch_mm"])
    shape = HeadShape.of(surface, pitch)
    head = _checked(document, shape.rows, shape.columns, FLAT_MM if shape.radius_mm is None else shape.radius_mm)
    apart = float(np.abs(_centred(surface) - _centred(head.surface_mm())).max())
    if apart > _REGULAR_MM:
        raise BadDataError(
            f"surface_mm lies up to {apart:.2g} mm from a regular grid of {pitch:g} mm on an arc across the head",
            way_out="the model has such heads only: give rows, columns and radius_mm of the nearest one (null: flat)",
        )
    return head


def _surface(document: Mapping[str, Any]) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    try:
        surface = np.array(document["surface_mm"], dtype=np.float64)
    except ValueError:
        raise BadDataError("surface_mm has rows of different lengths", way_out="give every row a taxel each") from None
    return surface


def _centred(surface_mm: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> Any:
    """Places about the array's middle: where a site puts the origin does not change the head."""
    middle = surface_mm.reshape(-1, 3).mean(axis=0)
    return surface_mm - middle
