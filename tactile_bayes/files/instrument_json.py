"""A scan head and its instrument, as JSON."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Any, Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from tactile_bayes.errors import BadDataError
from tactile_bayes.files.atomic import write_text
from tactile_bayes.files.documents import check_document, dump_json, load_json, load_schema, refuse_unknown
from tactile_bayes.files.provenance import Provenance
from tactile_bayes.forward.scene import FLAT_MM, Head, Scene
from tactile_bayes.geometry import FloatArray
from tactile_bayes.scan import ElementCalibration, HeadGeometry, HeadShape, Landmarks, Scan

# --- Parts of a scan file besides MCAP: head and calibration documents, times in ns, the reader's report.

_NS = 1_000_000_000
_T = TypeVar("_T")


@dataclass(frozen=True, slots=True, eq=False)
class ScanFile:
    """A scan and the report on its file.

    Parameters
    ----------
    scan
        Everything that could be read.
    complete
        True when the file was closed properly and nothing was lost.
    damaged
        True when bytes changed after they were written (a checksum failed); an unfinished file is not damaged.
    lost
        One line a loss, for people.
    topics
        Messages read, by topic.
    provenance
        What made the file, as `Provenance.as_dict` wrote it.
    schema
        Schema id of the file.
    """

    scan: Scan
    complete: bool
    damaged: bool
    lost: tuple[str, ...]
    topics: Mapping[str, int]
    provenance: Mapping[str, Any]
    schema: str


def ns_from_s(time_s: FloatArray) -> NDArray[np.int64]:
    """Convert times in s to whole ns.

    Seconds and their fraction are converted apart: a time since 1970 times 1e9 does not fit a double's 53 bits.
    """
    seconds = np.floor(time_s)
    nanos = np.rint((time_s - seconds) * _NS)
    return seconds.astype(np.int64) * _NS + nanos.astype(np.int64)


def s_from_ns(time_ns: NDArray[np.int64]) -> FloatArray:
    """Convert whole ns to times in s; undoes `ns_from_s` to the bit."""
    seconds, nanos = np.divmod(time_ns, _NS)
    times: FloatArray = seconds + nanos / _NS
    return times


def head_document(head: HeadGeometry) -> dict[str, Any]:
    """Head geometry as plain data; JSON keeps every bit of a double."""
    return {
        "pitch_mm": float(head.pitch_mm),
        "scanhead_from_tracker": head.scanhead_from_tracker.tolist(),
        "surface_mm": head.surface_mm.tolist(),
    }


def head_from_document(document: Mapping[str, Any]) -> HeadGeometry:
    """Undo `head_document`, checking everything."""
    return _build(
        "head.json",
        lambda: HeadGeometry(
            surface_mm=_array(document, "surface_mm", ndim=3),
            pitch_mm=float(document["pitch_mm"]),
            scanhead_from_tracker=_array(document, "scanhead_from_tracker", ndim=2),
        ),
    )


def calibration_document(calibration: ElementCalibration) -> dict[str, Any]:
    """Element calibration as plain data."""
    return {
        "saturation_count": int(calibration.saturation_count),
        "gain_kpa_per_count": calibration.gain_kpa_per_count.tolist(),
        "offset_kpa": calibration.offset_kpa.tolist(),
    }


def calibration_from_document(document: Mapping[str, Any]) -> ElementCalibration:
    """Undo `calibration_document`, checking everything."""
    return _build(
        "element_calibration.json",
        lambda: ElementCalibration(
            gain_kpa_per_count=_array(document, "gain_kpa_per_count", ndim=2),
            offset_kpa=_array(document, "offset_kpa", ndim=2),
            saturation_count=int(document["saturation_count"]),
        ),
    )


def _array(document: Mapping[str, Any], key: str, *, ndim: int) -> FloatArray:
    array: FloatArray = np.array(document[key], dtype=np.float64)
    if array.ndim != ndim:
        raise BadDataError(f"{key} has {array.ndim} dimensions", way_out=f"it must have {ndim}")
    return array


def _build(name: str, make: Callable[[], _T]) -> _T:
    """Call `make`, and turn an error in a foreign document into one line."""
    try:
        return make()
    except BadDataError as error:
        raise BadDataError(f"{name}: {error.what}", way_out=error.way_out) from None
    except KeyError as error:
        raise BadDataError(f"{name} lacks {error}", way_out="write the scan again with this program") from None
    except (TypeError, ValueError) as error:
        raise BadDataError(
            f"{name} holds what is not numbers ({error})", way_out="write the scan again with this program"
        ) from None


# --- Heads as JSON: places of the taxels, or their grid and arc, for `record` and for simulated bodies.

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
    document = _read_head(path)
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
    document = _read_head(path)
    try:
        return _arc(document) if "surface_mm" not in document else _fitted(document)
    except BadDataError as error:
        raise error.at(path) from None


def _read_head(path: Path) -> dict[str, Any]:
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


# --- Instrument files of `record`, as JSON: array calibration and landmarks.

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
