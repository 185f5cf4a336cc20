"""Instrument files of `record`, as JSON: array calibration and landmarks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Any, Final

import numpy as np

from tactile_bayes.errors import BadDataError
from tactile_bayes.files.atomic import write_text
from tactile_bayes.files.documents import load_json
from tactile_bayes.files.provenance import Provenance
from tactile_bayes.files.scan_parts import (
    calibration_document,
    calibration_from_document,
)
from tactile_bayes.files.schema import dump_json
from tactile_bayes.scan import ElementCalibration, Landmarks

ARRAY_SCHEMA: Final = "tactile-bayes/array-calibration/1"
LANDMARKS_SCHEMA: Final = "tactile-bayes/landmarks/1"


@dataclass(frozen=True, slots=True, eq=False)
class ArrayCalibrationFile:
    """An array's calibration and its origin.

    Parameters
    ----------
    calibration
        Gains, offsets, curvatures.
    head_id
        The head it was measured on.
    day
        When it was measured.
    quality
        Figures of the fit.
    """

    calibration: ElementCalibration
    head_id: str
    day: date
    quality: Mapping[str, Any]


def write_array_calibration(
    path: Path, content: ArrayCalibrationFile, *, provenance: Provenance, force: bool = False
) -> None:
    """Write the calibration of an array."""
    document = {
        "schema": ARRAY_SCHEMA,
        "head_id": content.head_id,
        "date": content.day.isoformat(),
        "units": {"gain": "kPa per count", "offset": "kPa", "curvature": "kPa per count squared"},
        **calibration_document(content.calibration),
        "quality": dict(content.quality),
        "provenance": provenance.as_dict(),
    }
    write_text(path, dump_json(document), force=force)


def read_array_calibration(path: Path) -> ArrayCalibrationFile:
    """Read the calibration of an array.

    Raises
    ------
    BadDataError
        When it is another file, or damaged.
    """
    document = _read(path, ARRAY_SCHEMA, way_out="give a file from `tactile-bayes calibrate array`")
    try:
        return ArrayCalibrationFile(
            calibration=calibration_from_document(document),
            head_id=str(document["head_id"]),
            day=date.fromisoformat(document["date"]),
            quality=document.get("quality", {}),
        )
    except BadDataError as error:
        raise error.at(path) from None
    except (KeyError, TypeError, ValueError) as error:
        raise BadDataError(f"lacks a head_id or a date ({error})", way_out="calibrate again", path=str(path)) from None


def read_landmarks(path: Path) -> Landmarks:
    """Read sternal notch and xiphoid in `base`, and the nipple where the file has it."""
    document = _read(path, LANDMARKS_SCHEMA, way_out="give sternal_notch_mm and xiphoid_mm, three numbers each")
    try:
        notch, xiphoid = (np.array(document[name], dtype=np.float64) for name in ("sternal_notch_mm", "xiphoid_mm"))
        nipple = np.array(document["nipple_mm"], dtype=np.float64) if document.get("nipple_mm") is not None else None
        return Landmarks(notch, xiphoid, nipple_mm=nipple)
    except BadDataError as error:
        raise error.at(path) from None
    except (KeyError, TypeError, ValueError) as error:
        raise BadDataError(f"lacks a landmark ({error})", way_out="give three numbers each", path=str(path)) from None


def _read(path: Path, schema: str, *, way_out: str) -> dict[str, Any]:
    document: Any = load_json(path, way_out=way_out)
    found = document.get("schema") if isinstance(document, dict) else None
    if found != schema:
        raise BadDataError(f"has schema {found!r}, not {schema!r}", way_out=way_out, path=str(path))
    return dict(document)
