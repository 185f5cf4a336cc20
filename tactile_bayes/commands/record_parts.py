"""Instrument and provenance of a recording, checked before it starts."""

from __future__ import annotations

from datetime import date
from typing import TYPE_CHECKING, Any

from tactile_bayes.errors import UsageError
from tactile_bayes.presets import PRESSURE_RANGE_KPA

if TYPE_CHECKING:
    from tactile_bayes.commands.record_request import Request
    from tactile_bayes.files.provenance import Provenance
    from tactile_bayes.scan import ElementCalibration, HeadGeometry, Landmarks

_NOMINAL_FULL_SCALE = 4095


def instrument_of(request: Request) -> tuple[HeadGeometry, ElementCalibration, Landmarks | None]:
    """Read geometry, calibration and landmarks from the files given.

    Raises
    ------
    UsageError
        When one is missing or given twice.
    """
    from tactile_bayes.files.head_json import read_head_geometry
    from tactile_bayes.files.scan_mcap import read_scan

    like = read_scan(request.like) if request.like else None
    if request.head_geometry:
        head = read_head_geometry(request.head_geometry)
    elif like is not None:
        head = like.head
    else:
        raise UsageError("the head's geometry is missing; give --head-geometry HEAD.json or --like SCAN.mcap")
    return head, _calibration(request, head, like), _landmarks(request)


def _calibration(request: Request, head: HeadGeometry, like: Any) -> ElementCalibration:
    import numpy as np

    from tactile_bayes.files.instrument_json import read_array_calibration
    from tactile_bayes.scan import ElementCalibration

    if request.uncalibrated:
        gain = np.full(head.shape, PRESSURE_RANGE_KPA[1] / _NOMINAL_FULL_SCALE)
        return ElementCalibration(gain, np.zeros(head.shape), saturation_count=_NOMINAL_FULL_SCALE)
    if request.array_calibration:
        return read_array_calibration(request.array_calibration).calibration
    if like is not None:
        return like.element_calibration  # type: ignore[no-any-return]
    raise UsageError("the array's calibration is missing; give --array-calibration, --like or --uncalibrated")


def refuse_calibration(request: Request, *, head_id: str, today: date) -> None:
    """Raise `UsageError` for a calibration that is stale or of another head, unless accepted."""
    from tactile_bayes.files.instrument_json import read_array_calibration

    if not request.array_calibration or request.uncalibrated or request.accept_calibration:
        return
    found = read_array_calibration(request.array_calibration)
    age = (today - found.day).days
    if found.head_id != head_id:
        raise UsageError(
            f"{request.array_calibration} was measured on head {found.head_id!r}, this is {head_id!r}; calibrate this "
            "head, or give --accept-calibration"
        )
    if not 0 <= age <= request.calibration_days:
        raise UsageError(
            f"{request.array_calibration} is of {found.day}, {age} days ago (at most {request.calibration_days:g}); "
            "calibrate again, or give --accept-calibration"
        )


def calibration_age(request: Request, *, today: date) -> dict[str, str]:
    """Session fact on the age of the array calibration, in days; empty where it came from no calibration file."""
    from tactile_bayes.files.instrument_json import read_array_calibration

    if not request.array_calibration or request.uncalibrated:
        return {}
    return {"array_calibration_days": str((today - read_array_calibration(request.array_calibration).day).days)}


def _landmarks(request: Request) -> Landmarks | None:
    from tactile_bayes.files.instrument_json import read_landmarks
    from tactile_bayes.files.scan_mcap import read_scan

    if request.landmarks is None:
        return None
    if request.landmarks.suffix.lower() != ".mcap":
        return read_landmarks(request.landmarks)
    found = read_scan(request.landmarks).landmarks
    if found is None:
        raise UsageError(f"{request.landmarks} holds no landmarks; give a scan whose landmarks were touched")
    return found


def provenance_of(request: Request, settings: dict[str, Any]) -> Provenance:
    """Provenance of the recording, without its ports."""
    from tactile_bayes.files.provenance import Provenance, hash_inputs

    names = ("like", "head_geometry", "array_calibration", "landmarks")
    inputs = {name: path for name in names if (path := getattr(request, name)) is not None}
    return Provenance("record", settings, hash_inputs(**inputs))
