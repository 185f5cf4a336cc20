"""Scans from the arrays of other programs: what is missing, in other units or of another shape is said.

Arrays in mm, kPa and s, read without pickle; `arrays_layout.LAYOUT` says what each is.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final
from unicodedata import normalize

import numpy as np
from scipy.spatial.transform import Rotation

from tactile_bayes.declarations import names_of, replace
from tactile_bayes.errors import BadDataError, in_file, suggestion
from tactile_bayes.files.arrays_layout import KNOWN, LAYOUT, OPTIONAL, ArrayMap, Stated, in_words
from tactile_bayes.files.instrument import read_array_calibration, read_head_geometry, read_landmarks
from tactile_bayes.files.named_arrays import Source, is_text, plain_names, read_named
from tactile_bayes.files.npz import Arrays
from tactile_bayes.files.reading import kind_of
from tactile_bayes.files.scan_mcap import read_scan
from tactile_bayes.files.scan_text import is_identity, read_frames, read_poses, seen
from tactile_bayes.files.sequence_mha import is_sequence, read_sequence
from tactile_bayes.geometry import FloatArray, check_rigid
from tactile_bayes.mapping.select import other_units
from tactile_bayes.presets import KPA_PER_UNIT, MM_PER_UNIT, PRESSURE_RANGE_KPA, PRESSURE_WINDOW_KPA
from tactile_bayes.scans import ElementCalibration, HeadGeometry, Landmarks, PressureFrames, Scan, TrackerPoses

# No value of a scan is larger, seconds since 1970 included; the squares of damaged ones would overflow.
_LARGEST: Final = 1e12
_STEP_KPA: Final = 0.001  #: To which pressures are kept: a tenth of what the best arrays resolve.
_MOST_COUNTS: Final = 65535
_SECONDS: Final = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0}
_MOST_NAMES: Final = 12  # of a file's arrays in an error
_TURN: Final = 2 * np.pi
_NOT_RIGID: Final = 1e-3  # of matrices that were written with few digits
_TIME_OPTIONS: Final = {"frame_time_s": "time-unit", "pose_time_s": "pose-time-unit"}
_BESIDE: Final = {
    "--poses FILE": ("position_mm", "quaternion_wxyz", "pose_time_s"),
    "--head-geometry HEAD.json": ("pitch_mm", "array_from_tracker", "head_surface_mm"),
    "--unit or --array-calibration CAL.json": ("gain_kpa_per_count", "offset_kpa"),
    "--rate-hz": ("frame_time_s",),
}
"""Options that give what a file of arrays may lack."""
_TEMPLATE: Final = "`tactile-bayes import SRC --template` prints a MAP.toml for --columns, which says what is what"
_HELP: Final = "`tactile-bayes import --help` says what they are"


def read_arrays(path: Path) -> Scan:
    """Read a scan from a file of arrays that are called as in the layout."""
    return import_arrays(path, ArrayMap())[0]


def import_arrays(path: Path, given: ArrayMap, beside: Sequence[Source] = ()) -> tuple[Scan, list[str]]:
    """A scan from a file of arrays and what stands beside it, and a line for each guess; errors name file and array."""
    with in_file(path):
        own = replace(_read(path, given, beside), path=str(path))
    try:
        return combined([own, *beside], given)
    except BadDataError as error:  # its first word is an array at fault, of whose file it is
        name = {"counts": "frames"}.get(error.what.split()[0], error.what.split()[0])
        same = {name, "pose_matrix"} if name in ("position_mm", "quaternion_wxyz") else {name}
        of_it = (one.path for one in reversed(beside) if one.path and same & set(one.arrays))
        raise error.with_path(next(of_it, path)) from None


def _read(path: Path, given: ArrayMap, beside: Sequence[Source]) -> Source:
    if is_sequence(path):
        return read_sequence(path, given, frames=True)
    if is_text(path):
        heads = (one.arrays["head_surface_mm"].shape[:2] for one in reversed(beside) if "head_surface_mm" in one.arrays)
        shape = next(heads, None)
        return read_frames(path, given if given.frame_shape else replace(given, frame_shape=shape))
    for name in (*given.arrays, *given.values):
        if name not in KNOWN:
            raise BadDataError(f"--columns: {name!r} is no array of a scan", way_out=suggestion(name, KNOWN))
    there: dict[str, str] = {}
    others: set[str] = set()

    def choose(names: Sequence[str]) -> list[str]:
        held = ", ".join(sorted(names)[:_MOST_NAMES]) or "nothing"
        spelled = {normalize("NFC", name): name for name in names}  # a letter and its mark may be one sign or two
        for here, said in given.arrays.items():
            there[here] = said if said in names else spelled.get(normalize("NFC", said), "")
            if not there[here]:
                raise BadDataError(f"has no array {said!r} for {here}", way_out=f"it has {held}")
        there.update({name: name for name in KNOWN if name in names and name not in there})
        there.update(plain_names(names, there, given.values))
        if not there:
            needed = ", ".join(f"{name} ({in_words(LAYOUT[name].shape)})" for name in LAYOUT if name not in OPTIONAL)
            more = " (for a grid of values give --as map)" if "mean" in names else ""
            raise BadDataError(f"lacks {needed} (it has {held})", way_out=f"{_TEMPLATE}{more}; {_HELP}")
        others.update(set(names) - set(there.values()))
        return list(dict.fromkeys(there.values()))

    held = read_named(path, choose)
    arrays = {here: held[name] for here, name in there.items()}
    guessed = {here: name for here, name in there.items() if name not in (here, given.arrays.get(here))}
    arrays |= {name: np.asarray(value) for name, value in given.values.items()}
    notes = tuple(f"{name} is taken for {here}" for here, name in guessed.items())
    return Source(arrays, notes=notes, others=tuple(sorted(others)))


def of_poses(path: Path, given: Stated) -> Source:
    """Poses of a file of their own: a table, or a sequence metafile."""
    if not is_sequence(path) and not is_text(path):
        what = f"is {kind_of(path) or 'a file of arrays'}, and poses that stand apart are a table of text"
        way_out = "save them as .csv, or in the frames' file as pose_matrix and pose_time_s"
        raise BadDataError(what, way_out=way_out, path=str(path))
    found = read_sequence(path, given, frames=False) if is_sequence(path) else read_poses(path, given)
    return replace(found, path=str(path))


def of_head(given: Path | HeadGeometry) -> Source:
    """Arrays of a scan that are the head's."""
    head = given if isinstance(given, HeadGeometry) else read_head_geometry(given)
    arrays = {
        "pitch_mm": np.asarray(head.pitch_mm),
        "array_from_tracker": head.scanhead_from_tracker,
        "head_surface_mm": head.surface_mm,
    }
    return Source(arrays, checked_on=head.checked_on)


def of_calibration(given: Path | ElementCalibration) -> Source:
    """Arrays of a scan that are the calibration of its array."""
    found = given if isinstance(given, ElementCalibration) else read_array_calibration(given).calibration
    return Source({name: np.asarray(getattr(found, name)) for name in names_of(found)})


def of_landmarks(given: Path | Landmarks) -> Source:
    """Arrays of a scan that are its landmarks: of a JSON file or another scan."""
    found: Landmarks | None = given if isinstance(given, Landmarks) else None
    if isinstance(given, Path):
        found = read_scan(given).landmarks if given.suffix.lower() == ".mcap" else read_landmarks(given)
    if found is None:
        raise BadDataError("holds no landmarks", way_out="give another scan, or a JSON file", path=str(given))
    nipple = {} if found.nipple_mm is None else {"nipple_mm": found.nipple_mm}
    return Source({"landmarks_mm": np.stack([found.sternal_notch_mm, found.xiphoid_mm]), **nipple})


# --- From arrays as people have them to those of the layout: axes, clocks, units.


def combined(sources: Sequence[Source], given: Stated) -> tuple[Scan, list[str]]:
    """A scan of arrays by the names in `KNOWN`, of which the last source's stands, and the notes."""
    stated = given
    told: list[str] = []
    held: Arrays = {}
    checked_on = ""
    for source in sources:
        if "head_surface_mm" in source.arrays:
            checked_on = source.checked_on
        said = source.stated.given
        for name, theirs in said.items():
            if (ours := getattr(given, name)) not in (None, theirs):
                told.append(f"{name.replace('_', '-')} {ours} as stated, where the file says {theirs}")
        told += source.notes
        if stated.unit not in (None, source.stated.unit):
            said.pop("saturation", None)  # in the file's unit
        stated = replace(stated, **{name: value for name, value in said.items() if getattr(stated, name) is None})
        held |= {name: np.asarray(one) for name, one in source.arrays.items()}
    _leave_out_gaps(held, stated, told)
    _check_numbers(held)
    if "frames" in held:
        held["counts"] = held.pop("frames")
    _poses(held, stated, told)
    _frames(held, stated, told)
    _clocks(held, stated)
    _check_largest(held)
    pressure = stated.unit not in (None, "counts")
    if pressure:
        _as_counts(held, stated, told)
    elif stated.saturation is not None:
        held["saturation_count"] = np.asarray(int(np.ceil(stated.saturation)))
    held = {name: held[name] for name in LAYOUT if name in held}
    for name, array in held.items():  # without axes of length 1 that MATLAB adds
        axes = len(LAYOUT[name].shape)
        if axes < 2 and array.ndim > axes and array.size == max(array.shape):
            held[name] = array.reshape(-1) if axes else array.reshape(())
    for name in ("gain_kpa_per_count", "offset_kpa"):
        if name in held and held[name].size == 1 and held.get("counts", np.empty(0)).ndim == 3:
            held[name] = np.full(held["counts"].shape[1:], float(held[name].item()))  # one for all taxels
    _refuse_missing(held, [name for source in sources for name in source.others])
    _check_layout(held)
    _check_units(held, calibrated=pressure)
    facts = {"frames_unit": str(stated.unit)} if pressure else {}
    if told:
        facts["imported_as"] = "; ".join(told)[:2000]
    return _scan(held, facts, checked_on), told


def _refuse_missing(held: Arrays, others: Sequence[str]) -> None:
    missing = [name for name in LAYOUT if name not in held and name not in OPTIONAL]
    if not missing:
        return
    lacks = ", ".join(f"{name} ({in_words(LAYOUT[name].shape)})" for name in missing)
    options = [option for option, gives in _BESIDE.items() if set(gives) & set(missing)]
    way_out = f"add them, or give {', '.join(options)}" if options else "add them"
    if others:
        raise BadDataError(
            f"lacks {lacks}; not known: {', '.join(others[:_MOST_NAMES])}", way_out=f"{_TEMPLATE}; or {way_out}"
        )
    raise BadDataError(f"lacks {lacks} (it has {', '.join(sorted(held))})", way_out=f"{way_out}; {_HELP}")


def _leave_out_gaps(held: Arrays, stated: Stated, told: list[str]) -> None:
    """Leave out poses of arrays that are not finite or the identity: the tool was not seen."""
    layout = "matrix" if "pose_matrix" in held else stated.pose_layout or "wxyz"
    parts = [held[name] for name in ("pose_matrix", "position_mm", "quaternion_wxyz") if name in held]
    time = held.get("pose_time_s", np.empty(0)).reshape(-1)
    if not parts or any(one.dtype.kind not in "iuf" or one.ndim < 2 or len(one) != len(time) for one in parts):
        return  # whatever is wrong is told later
    numbers = np.hstack([one.reshape(len(time), -1) for one in parts]).astype(np.float64)
    if np.isfinite(numbers).all() and not is_identity(numbers, layout).any():
        return
    found = seen(time, numbers, [""] * len(time), layout=layout)
    held.update(found.arrays)
    told += found.notes


def _poses(held: Arrays, stated: Stated, told: list[str]) -> None:
    """Places in mm and quaternions with the scalar first, whatever they are given as."""
    if "pose_matrix" in held:
        if "position_mm" in held or "quaternion_wxyz" in held:
            raise BadDataError("pose_matrix is given beside position_mm or quaternion_wxyz", way_out="leave one out")
        held["position_mm"], held["quaternion_wxyz"] = _of_matrices(held.pop("pose_matrix"))
    number = held["pose_time_s"].size if "pose_time_s" in held else 0
    for name, width in (("position_mm", 3), ("quaternion_wxyz", 4)):
        if name in held and held[name].shape == (width, number) and number != width:
            held[name] = held[name].T
            told.append(f"{name} of shape {(width, number)} read along its columns")
    if "quaternion_wxyz" in held and stated.pose_layout in ("xyzw", "euler"):
        if stated.pose_layout == "euler" and np.abs(held["quaternion_wxyz"]).max() <= _TURN:
            told.append(
                f"angles lie within {_TURN:.1f} and are read as degrees: radians are to be multiplied by 57.296"
            )
        held["quaternion_wxyz"] = quaternions(held["quaternion_wxyz"], stated.pose_layout)
    if "position_mm" in held:
        held["position_mm"] = held["position_mm"] * MM_PER_UNIT[stated.length_unit or "mm"]


def quaternions(rotations: FloatArray, layout: str) -> FloatArray:
    """(m, 4) quaternions, scalar first, of quaternions with the scalar last (``xyzw``) or of (m, 3) azimuth, elevation
    and roll in degrees: about z, then about the new y, then about the new x.
    """
    width = 3 if layout == "euler" else 4
    if rotations.ndim != 2 or rotations.shape[1] != width:
        raise BadDataError(f"rotations have shape {rotations.shape}", way_out=f"as {layout} they must be (m, {width})")
    if layout == "euler":
        return np.asarray(Rotation.from_euler("ZYX", rotations, degrees=True).as_quat(scalar_first=True))
    return rotations[:, [3, 0, 1, 2]] if layout == "xyzw" else rotations


def _of_matrices(given: np.ndarray[Any, Any]) -> tuple[FloatArray, FloatArray]:
    """Places and quaternions of homogeneous matrices, of which each is (4, 4), (3, 4) or one row."""
    if given.ndim == 3 and given.shape[:2] in ((4, 4), (3, 4)) and given.shape[1:] != given.shape[:2]:
        given = np.moveaxis(given, 2, 0)
    if given.ndim == 2 and given.shape[1] in (12, 16):
        given = given.reshape(len(given), -1, 4)
    if given.ndim != 3 or given.shape[1:] not in ((4, 4), (3, 4)):
        raise BadDataError(f"pose_matrix has shape {given.shape}", way_out="it must be (m, 4, 4)")
    matrices = given.astype(np.float64)
    turned = matrices[:, :3, :3]
    departure = np.abs(turned @ turned.swapaxes(1, 2) - np.eye(3)).max(axis=(1, 2))
    wrong = (departure > _NOT_RIGID) | (np.linalg.det(turned) < 0)
    if wrong.any() or (matrices[:, 3:] != [0, 0, 0, 1]).any():
        first = int(wrong.argmax())
        what = f"pose_matrix is not rigid at index {first} (R R^T departs from 1 by {departure[first]:.1e})"
        raise BadDataError(what, way_out="give the 16 numbers row by row, translation last in each row")
    return matrices[:, :3, 3], np.asarray(Rotation.from_matrix(turned).as_quat(scalar_first=True))


def _frames(held: Arrays, stated: Stated, told: list[str]) -> None:
    """Counts as (n, rows, columns)."""
    if "counts" not in held:
        return
    counts = held["counts"]
    n = held["frame_time_s"].size if "frame_time_s" in held else counts.shape[0]
    if counts.ndim in (2, 3) and counts.shape[0] != n and counts.shape[-1] == n:
        told.append(f"frames of shape {counts.shape} read along the last axis, which is as long as their times")
        counts = np.moveaxis(counts, -1, 0)
    if counts.ndim == 2:
        beside = (held[name] for name in ("head_surface_mm", "gain_kpa_per_count") if name in held)
        shape = stated.frame_shape or next((one.shape[:2] for one in beside if one.ndim > 1), None)
        each = f"frames of {counts.shape[1]} numbers (counts has shape {counts.shape})"
        if shape is None:
            raise BadDataError(each, way_out="give --frame-shape ROWS COLUMNS, or --head-geometry HEAD.json")
        if shape[0] * shape[1] != counts.shape[1]:
            what = f"{each}, and {_sides(shape)} taxels are {shape[0] * shape[1]}"
            way_out = "give --frame-shape ROWS COLUMNS, or --skip-columns for those before the readings"
            raise BadDataError(what, way_out=way_out)
        along = stated.frame_order or "rows"
        if stated.frame_order is None or stated.frame_shape is None:
            told.append(f"each {counts.shape[1]} numbers read as {_sides(shape)}, along the array's {along}")
        by_columns = counts.reshape(-1, shape[1], shape[0]).swapaxes(1, 2)
        counts = by_columns if along == "columns" else counts.reshape(-1, *shape)
    elif stated.frame_shape is not None and counts.shape[1:] != stated.frame_shape:
        what = f"frames have {_sides(counts.shape[1:])} taxels, not {_sides(stated.frame_shape)}"
        raise BadDataError(what, way_out="leave --frame-shape out")
    head = held["head_surface_mm"].shape[:2] if "head_surface_mm" in held else counts.shape[1:]
    if counts.ndim == 3 and counts.shape[1:] != head:
        what = f"counts has frames of {_sides(counts.shape[1:])} taxels, and the head {_sides(head)}"
        turned = counts.shape[1:] == head[::-1]
        way_out = "swap their last two axes" if turned else "give the head of this array, or the frames of this head"
        raise BadDataError(what, way_out=way_out)
    held["counts"] = counts


def _sides(shape: Sequence[int]) -> str:
    return " x ".join(map(str, shape))


def _clocks(held: Arrays, stated: Stated) -> None:
    """Times in s, on the frames' clock."""
    for time, each, unit, rate in (
        ("frame_time_s", "counts", stated.time_unit, stated.rate_hz),
        ("pose_time_s", "position_mm", stated.pose_time_unit, stated.pose_rate_hz),
    ):
        if time in held:
            held[time] = held[time] * _SECONDS[unit or "s"]
        elif rate is not None and each in held:
            held[time] = np.arange(len(held[each])) / rate
    if "pose_time_s" in held and stated.pose_offset_s:
        held["pose_time_s"] = held["pose_time_s"] + stated.pose_offset_s


def _as_counts(held: Arrays, stated: Stated, told: list[str]) -> None:
    """Frames of pressures as counts, with the gain and offset that give the pressures back."""
    unit = str(stated.unit)
    for name in ("gain_kpa_per_count", "offset_kpa"):
        if name in held:
            raise BadDataError(f"{name} is for counts, and frames are in {unit}", way_out="leave it or --unit out")
    if "counts" not in held:
        return
    frames, factor = held["counts"], KPA_PER_UNIT[unit]
    whole = frames.dtype.kind in "iu" and frames.min() >= 0 and frames.max() <= _MOST_COUNTS
    kpa = frames.astype(np.float64) * factor
    gain, offset = (factor, 0.0) if whole else (_STEP_KPA, min(0.0, float(np.floor(kpa.min() / _STEP_KPA)) * _STEP_KPA))
    told.append(_told_pressure(kpa, unit, kept="" if whole else f", kept to {1000 * _STEP_KPA:g} Pa"))
    if offset + gain * _MOST_COUNTS < min(kpa.max(), PRESSURE_RANGE_KPA[1]):  # the others would be cut off
        at = tuple(map(int, np.unravel_index(kpa.argmin(), kpa.shape)))
        what = f"frames in {unit} hold {frames.min():g} (first at {at}), and an array reads no such pressure"
        raise BadDataError(
            what, way_out="write 0 in all frames of an element that does not work, or repair the reading"
        )
    held["counts"] = np.clip(np.rint((kpa - offset) / gain), 0, _MOST_COUNTS).astype(np.uint16)
    full = _MOST_COUNTS if stated.saturation is None else round((stated.saturation * factor - offset) / gain)
    held |= {"gain_kpa_per_count": np.asarray(gain), "offset_kpa": np.asarray(offset)}
    held["saturation_count"] = np.asarray(min(max(full, 1), _MOST_COUNTS))


def _told_pressure(kpa: FloatArray, unit: str, *, kept: str) -> str:
    """What the frames' means are, with a question for their unit where no examination presses so."""
    means = kpa.reshape(len(kpa), -1).mean(axis=1)
    if means.max() < 0:
        raise BadDataError(f"frames in {unit} are below 0 throughout", way_out="give pressures that rise when pressed")
    pressed = means[means >= means.max() / 2]
    low, high = np.quantile(pressed, [0.05, 0.95]) / KPA_PER_UNIT[unit]
    middle = float(np.median(pressed))
    asked = other_units(middle, unit, PRESSURE_WINDOW_KPA)
    means_of = f"pressed ones have means of {low:.3g} to {high:.3g} {unit}"
    if middle >= PRESSURE_RANGE_KPA[1]:
        what = f"frames in {unit}: {means_of}, and an array's range ends at {PRESSURE_RANGE_KPA[1]:g} kPa"
        raise BadDataError(what, way_out=asked or "give their unit, --unit")
    return f"{'CAUTION: ' if asked else ''}frames in {unit}{kept}; {means_of}{f': {asked}' if asked else ''}"


# --- Checks of arrays in the layout.


def _check_layout(arrays: Arrays) -> None:
    lengths: dict[str, tuple[int, str]] = {}  # letter -> length, and the array that set it
    for name, array in arrays.items():
        want = LAYOUT[name].shape
        fits = array.ndim == len(want)
        for letter, have in zip(want, array.shape, strict=False):
            length = letter if isinstance(letter, int) else lengths.setdefault(letter, (have, name))[0]
            fits = fits and length == have
        if not fits:
            known = [f"{one} = {lengths[one][0]} as in {lengths[one][1]}" for one in want if one in lengths]
            shape = "(" + ", ".join(map(str, want)) + ("," if len(want) == 1 else "") + ")"
            way_out = f"it must be {shape}" + (f" with {', '.join(known)}" if known else "")
            raise BadDataError(f"{name} has shape {array.shape}", way_out=way_out)
    counts = arrays["counts"]
    if counts.dtype.kind not in "iu" and (odd := counts[counts != np.rint(counts)]).size:
        what = f"counts holds {float(odd[0]):.6g}, which is no raw reading"
        raise BadDataError(what, way_out="for pressures give their unit: --unit kPa")
    low, high = int(counts.min()), int(counts.max())
    if low < 0 or high > _MOST_COUNTS:
        raise BadDataError(f"counts holds {low if low < 0 else high}", way_out="raw readings lie in 0 to 65535")


def _check_numbers(arrays: Arrays) -> None:
    for name, array in arrays.items():
        if array.dtype.kind not in "iuf":
            what = "not an array of numbers (a cell, a table or text?)" if array.dtype.kind in "OV" else array.dtype
            raise BadDataError(f"{name} is {what}", way_out="give real numbers")
        if 0 in array.shape:
            raise BadDataError(f"{name} is empty (shape {array.shape})", way_out="give at least one frame and one pose")
        finite = np.isfinite(array)
        if not finite.all():
            index = tuple(int(i) for i in np.unravel_index(int(finite.argmin()), finite.shape))
            where = f" (first at {index})" if index else ""
            what = f"{name} holds {finite.size - int(finite.sum())} values that are not finite{where}"
            raise BadDataError(what, way_out="repair or leave them out")


def _check_largest(arrays: Arrays) -> None:
    for name, array in arrays.items():
        largest = float(np.abs(array, dtype=np.float64).max(initial=0.0))
        if largest > _LARGEST:
            unit = f"; times in ms are stated, --{_TIME_OPTIONS[name]} ms" if name in _TIME_OPTIONS else ""
            way_out = f"give mm, kPa and s; the file may be damaged{unit}"
            raise BadDataError(f"{name} holds {largest:.3g}", way_out=way_out)


def _check_units(arrays: Arrays, *, calibrated: bool) -> None:
    """Raise an error for numbers in other units: a factor of 25 or 1000 would pass every later check."""
    surface, position = arrays["head_surface_mm"], arrays["position_mm"]
    metres = "looks like metres or inches, give mm"
    extent = float(np.ptp(surface.reshape(-1, 3), axis=0).max())
    if extent < 5.0 and surface.shape[0] * surface.shape[1] > 1:
        raise BadDataError(f"head_surface_mm spans only {extent:.4g}", way_out=metres)
    travel, reach = float(np.ptp(position, axis=0).max()), float(np.abs(position).max())
    if travel < 1.0 and reach < 5.0 and len(position) > 1:
        what = f"position_mm spans only {travel:.4g}, none beyond {reach:.4g}"
        raise BadDataError(what, way_out=f"{metres} or their unit, --length-unit m or inch")
    if "landmarks_mm" in arrays:
        apart = float(np.linalg.norm(arrays["landmarks_mm"][0] - arrays["landmarks_mm"][1]))
        if apart < 10.0:
            raise BadDataError(f"the points of landmarks_mm are {apart:.4g} apart", way_out=metres)
    if "nipple_mm" in arrays:
        if "landmarks_mm" not in arrays:
            what = "nipple_mm is without landmarks_mm"
            raise BadDataError(what, way_out="give notch and xiphoid too: they say what is up")
        near = float(np.linalg.norm(arrays["landmarks_mm"] - arrays["nipple_mm"], axis=1).min())
        if near < 10.0:
            raise BadDataError(f"nipple_mm is {near:.4g} from a point of landmarks_mm", way_out=metres)
    full_scale = float(np.median(arrays["gain_kpa_per_count"])) * 4095
    if not calibrated and (full_scale > 1000.0 or 0 < full_scale < 0.5):
        what = f"gain_kpa_per_count gives {full_scale:.4g} kPa at 4095 counts"
        raise BadDataError(what, way_out="looks like Pa or MPa, give kPa")
    _check_clocks(arrays)
    pitch_mm = float(arrays["pitch_mm"])
    for axis in (one for one in (0, 1) if surface.shape[one] > 1):
        spacing = float(np.median(np.linalg.norm(np.diff(surface, axis=axis), axis=-1)))
        if not 0.8 * pitch_mm <= spacing <= 1.25 * pitch_mm:
            what = f"head_surface_mm has elements {spacing:.4g} mm apart along axis {axis}, pitch_mm is {pitch_mm:.4g}"
            raise BadDataError(what, way_out="give both in mm, for the same head")


def _check_clocks(arrays: Arrays) -> None:
    ends = []
    for name, option in _TIME_OPTIONS.items():
        times = arrays[name]
        if len(times) > 1 and times[0] == times.min() == times.max():
            raise BadDataError(f"{name} is {times[0]:g} throughout", way_out="give its times, not a constant")
        if len(times) > 1 and (step := float(np.median(np.diff(times)))) > 0.5:
            what = f"{name} steps by {step:.4g}"
            raise BadDataError(what, way_out=f"looks like milliseconds, give s or --{option} ms")
        ends.append((float(times.min()), float(times.max())))
    (a, b), (c, d) = ends
    if b < c or d < a:
        what = f"frame_time_s ({a:.3f} to {b:.3f}) and pose_time_s ({c:.3f} to {d:.3f}) do not overlap"
        raise BadDataError(what, way_out="give both on one clock: --pose-offset-s is added to the poses' times")


def _scan(arrays: Arrays, facts: Mapping[str, str], checked_on: str) -> Scan:
    values = {name: np.asarray(array, dtype=np.float64) for name, array in arrays.items() if name != "counts"}
    marks = values.get("landmarks_mm")
    surface, transform = values["head_surface_mm"], values["array_from_tracker"]
    check_rigid(transform, name="array_from_tracker")
    return Scan(
        frames=PressureFrames(values["frame_time_s"], arrays["counts"].astype(np.uint16)),
        poses=TrackerPoses(values["pose_time_s"], values["position_mm"], values["quaternion_wxyz"]),
        head=HeadGeometry(surface, float(values["pitch_mm"]), transform, checked_on),
        element_calibration=ElementCalibration(
            values["gain_kpa_per_count"], values["offset_kpa"], int(values.get("saturation_count", 4095))
        ),
        landmarks=None if marks is None else Landmarks(marks[0], marks[1], nipple_mm=values.get("nipple_mm")),
        session={"source": "imported", **facts},
    )
