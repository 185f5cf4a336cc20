"""Other people's arrays as scans."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from tactile_bayes.errors import BadDataError
from tactile_bayes.files.arrays_layout import LAYOUT, OPTIONAL, Shape, in_words
from tactile_bayes.files.npz import Arrays, load_npz
from tactile_bayes.geometry import check_rigid
from tactile_bayes.scan import ElementCalibration, HeadGeometry, Landmarks, PressureFrames, Scan, TrackerPoses

# --- Import of arrays from other programs: an .npz of raw counts, poses and calibration becomes a scan.
#
# Arrays in mm, kPa and s, read without pickle; `arrays_layout.LAYOUT` says what each is.

# No value of a scan is larger, seconds since 1970 included; the squares of damaged ones would overflow.
_LARGEST: Final = 1e12


def read_arrays(path: Path) -> Scan:
    """Read a scan from an .npz file of the layout above."""
    try:
        required = [name for name in LAYOUT if name not in OPTIONAL]
        shapes = {name: in_words(layout.shape) for name, layout in LAYOUT.items()}
        arrays = load_npz(path, required=required, optional=OPTIONAL, shapes=shapes)
        _check_shapes(arrays)
        _check_numbers(arrays)
        _check_units(arrays)
        return _scan(arrays)
    except BadDataError as error:
        raise error.at(path) from None


def _check_shapes(arrays: Arrays) -> None:
    lengths: dict[str, tuple[int, str]] = {}  # letter -> length, and the array that set it
    for name, array in arrays.items():
        want = LAYOUT[name].shape
        fits = array.ndim == len(want)
        for letter, have in zip(want, array.shape, strict=False):
            length = letter if isinstance(letter, int) else lengths.setdefault(letter, (have, name))[0]
            fits = fits and length == have
        if not fits:
            raise BadDataError(f"{name} has shape {array.shape}", way_out=f"it must be {_spoken(want, lengths)}")
        if 0 in array.shape:
            raise BadDataError(f"{name} is empty (shape {array.shape})", way_out="give at least one frame and one pose")


def _spoken(want: Shape, lengths: Mapping[str, tuple[int, str]]) -> str:
    letters = [item for item in want if isinstance(item, str) and item in lengths]
    known = [f"{letter} = {lengths[letter][0]} as in {lengths[letter][1]}" for letter in letters]
    shape = "(" + ", ".join(map(str, want)) + ("," if len(want) == 1 else "") + ")"
    return shape + (f" with {', '.join(known)}" if known else "")


def _check_numbers(arrays: Arrays) -> None:
    counts = arrays["counts"]
    if counts.dtype.kind not in "iu":
        raise BadDataError(f"counts is {counts.dtype}", way_out="give raw integer readings, not pressures")
    low, high = int(counts.min()), int(counts.max())
    if low < 0 or high > 65535:
        raise BadDataError(f"counts holds {low if low < 0 else high}", way_out="raw readings lie in 0 to 65535")
    for name, array in arrays.items():
        if array.dtype.kind not in "iuf":
            raise BadDataError(f"{name} is {array.dtype}", way_out="give real numbers")
        finite = np.isfinite(array)
        if not finite.all():
            index = tuple(int(i) for i in np.unravel_index(int(finite.argmin()), finite.shape))
            where = f" (first at {index})" if index else ""
            number = finite.size - int(finite.sum())
            raise BadDataError(
                f"{name} holds {number} values that are not finite{where}", way_out="repair or leave them out"
            )
        largest = float(np.abs(array, dtype=np.float64).max(initial=0.0))
        if largest > _LARGEST:
            raise BadDataError(f"{name} holds {largest:.3g}", way_out="give mm, kPa and s; the file may be damaged")


def _check_units(arrays: Arrays) -> None:
    """Raise an error for numbers in other units: a factor of 25 or 1000 would pass every later check."""
    surface, position = arrays["head_surface_mm"], arrays["position_mm"]
    metres = "looks like metres or inches, give mm"
    extent = float(np.ptp(surface.reshape(-1, 3), axis=0).max())
    if extent < 5.0 and surface.shape[0] * surface.shape[1] > 1:
        raise BadDataError(f"head_surface_mm spans only {extent:.4g}", way_out=metres)
    travel, reach = float(np.ptp(position, axis=0).max()), float(np.abs(position).max())
    if travel < 1.0 and reach < 5.0 and len(position) > 1:
        raise BadDataError(f"position_mm spans only {travel:.4g}, none beyond {reach:.4g}", way_out=metres)
    if "landmarks_mm" in arrays:
        apart = float(np.linalg.norm(arrays["landmarks_mm"][0] - arrays["landmarks_mm"][1]))
        if apart < 10.0:
            raise BadDataError(f"the points of landmarks_mm are {apart:.4g} apart", way_out=metres)
    if "nipple_mm" in arrays:
        _check_nipple(arrays, metres)
    full_scale = float(np.median(arrays["gain_kpa_per_count"])) * 4095
    if full_scale > 1000.0 or 0 < full_scale < 0.5:
        raise BadDataError(
            f"gain_kpa_per_count gives {full_scale:.4g} kPa at 4095 counts", way_out="looks like Pa or MPa, give kPa"
        )
    _check_clock(arrays["frame_time_s"], arrays["pose_time_s"])
    _check_pitch(surface, float(arrays["pitch_mm"]))


def _check_nipple(arrays: Arrays, metres: str) -> None:
    if "landmarks_mm" not in arrays:
        raise BadDataError(
            "nipple_mm is without landmarks_mm", way_out="give notch and xiphoid too: they say what is up"
        )
    near = float(np.linalg.norm(arrays["landmarks_mm"] - arrays["nipple_mm"], axis=1).min())
    if near < 10.0:
        raise BadDataError(f"nipple_mm is {near:.4g} from a point of landmarks_mm", way_out=metres)


def _check_clock(frame_time_s: np.ndarray[Any, Any], pose_time_s: np.ndarray[Any, Any]) -> None:
    for name, times in (("frame_time_s", frame_time_s), ("pose_time_s", pose_time_s)):
        step = float(np.median(np.diff(times))) if len(times) > 1 else 0.0
        if step > 0.5:
            raise BadDataError(f"{name} steps by {step:.4g}", way_out="looks like milliseconds, give s")
    (a, b), (c, d) = ((float(times.min()), float(times.max())) for times in (frame_time_s, pose_time_s))
    if b < c or d < a:
        raise BadDataError(
            f"frame_time_s ({a:.3f} to {b:.3f}) and pose_time_s ({c:.3f} to {d:.3f}) do not overlap",
            way_out="give both on one clock",
        )


def _check_pitch(surface: np.ndarray[Any, Any], pitch_mm: float) -> None:
    for axis, along in ((0, "axis 0"), (1, "axis 1")):
        if surface.shape[axis] < 2:
            continue
        spacing = float(np.median(np.linalg.norm(np.diff(surface, axis=axis), axis=-1)))
        if not 0.8 * pitch_mm <= spacing <= 1.25 * pitch_mm:
            raise BadDataError(
                f"head_surface_mm has elements {spacing:.4g} mm apart along {along}, pitch_mm is {pitch_mm:.4g}",
                way_out="give both in mm, for the same head",
            )


def _scan(arrays: Arrays) -> Scan:
    values = {name: np.asarray(array, dtype=np.float64) for name, array in arrays.items() if name != "counts"}
    check_rigid(values["array_from_tracker"], name="array_from_tracker")
    landmarks = values.get("landmarks_mm")
    return Scan(
        frames=PressureFrames(values["frame_time_s"], arrays["counts"].astype(np.uint16)),
        poses=TrackerPoses(values["pose_time_s"], values["position_mm"], values["quaternion_wxyz"]),
        head=HeadGeometry(values["head_surface_mm"], float(values["pitch_mm"]), values["array_from_tracker"]),
        element_calibration=ElementCalibration(
            values["gain_kpa_per_count"], values["offset_kpa"], int(values.get("saturation_count", 4095))
        ),
        landmarks=None
        if landmarks is None
        else Landmarks(landmarks[0], landmarks[1], nipple_mm=values.get("nipple_mm")),
        session={"source": "imported"},
    )
