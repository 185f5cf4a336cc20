"""Parts of a scan file besides MCAP: head and calibration documents, times in ns, the reader's report."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from tactile_bayes.errors import BadDataError
from tactile_bayes.geometry import FloatArray
from tactile_bayes.scan import ElementCalibration, HeadGeometry, Scan

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
