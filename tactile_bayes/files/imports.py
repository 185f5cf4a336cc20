"""Scans from the arrays of other programs; an error names each that is missing, in other units or of another shape.

Arrays are in mm, kPa and s and read without pickle; `arrays_layout.LAYOUT` describes each.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final
from unicodedata import normalize

import numpy as np
from scipy.spatial.transform import Rotation

from tactile_bayes import scans
from tactile_bayes.declarations import names_of, replace
from tactile_bayes.errors import BadDataError, in_file, suggestion
from tactile_bayes.files.arrays_layout import KNOWN, LAYOUT, OPTIONAL, ArrayMap, Stated, in_words
from tactile_bayes.files.instrument import LEAST_STERNUM_MM, read_array_calibration, read_head_geometry
from tactile_bayes.files.named_arrays import Source, is_text, plain_names, read_named
from tactile_bayes.files.npz import Arrays
from tactile_bayes.files.reading import kind_of
from tactile_bayes.files.scan_text import is_identity, read_frames, read_poses, visible_poses
from tactile_bayes.files.sequence_mha import is_sequence, read_sequence
from tactile_bayes.findings import Finding, finding
from tactile_bayes.geometry import FloatArray, check_rigid
from tactile_bayes.mapping.select import LEAST_FRAMES, unit_question
from tactile_bayes.presets import KPA_PER_UNIT, MM_PER_UNIT, PRESSURE_RANGE_KPA, PRESSURE_WINDOW_KPA

# No value of a scan is larger, seconds since 1970 included; the squares of damaged ones would overflow.
_LARGEST: Final = 1e12
_STEP_KPA: Final = 0.001  #: To which pressures are kept: a tenth of what the best arrays resolve.
_MOST_COUNTS: Final = 65535
_SECONDS: Final = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0}
_FINER: Final = {"ms": "milliseconds", "us": "microseconds", "ns": "nanoseconds"}
_LONGEST_STEP_S: Final = 0.5  # between frames or poses
_MOST_NAMES: Final = 12  # of a file's arrays in an error
_TURN: Final = 2 * np.pi
_NOT_RIGID: Final = 1e-3  # of matrices that were written with few digits
_OTHER_ORDER: Final = 0.8  #: Roughness in another order over that as stated; right scans have 1.0 or more.
_LOOKED_AT: Final = 500  # frames
_TIME_OPTIONS: Final = {"frame_time_s": ("time-unit", "rate-hz"), "pose_time_s": ("pose-time-unit", "pose-rate-hz")}
_CALIBRATION: Final = ("gain_kpa_per_count", "offset_kpa")
_BESIDE: Final = {
    "--poses FILE": ("position_mm", "quaternion_wxyz", "pose_time_s"),
    "--head-geometry HEAD.json": ("pitch_mm", "array_from_tracker", "head_surface_mm"),
    "--unit or --array-calibration CAL.json": _CALIBRATION,
    "--rate-hz": ("frame_time_s",),
}
"""Options that give the arrays which a file may lack."""
_OF_AXES: Final = ("frames", "counts", "position_mm", "head_surface_mm")  # never one number
_TEMPLATE: Final = "`tactile-bayes import SRC --template` prints a MAP.toml for --columns, which says what is what"
_HELP: Final = "`tactile-bayes import --help` says what they are"


def read_arrays(path: Path) -> scans.Scan:
    """Read a scan from a file of arrays with the layout's names, for a command without the options of `import`."""
    try:
        return import_arrays(path, ArrayMap())[0]
    except BadDataError as error:
        of_import = " (options of `import`: list the scan that it makes)" if "--" in error.way_out else ""
        raise BadDataError(error.what, way_out=f"{error.way_out}{of_import}", path=error.path) from None


def import_arrays(path: Path, options: ArrayMap, others: Sequence[Source] = ()) -> tuple[scans.Scan, list[str]]:
    """A scan from a file of arrays and `others`, and a note for each guess; errors name file and array."""
    with in_file(path):
        source = replace(_read_source(path, options, others), path=str(path))
    try:
        return combine_sources([source, *others], options)
    except BadDataError as error:  # its first word is the array at fault
        name = error.what.split()[0]
        names = {"frames" if name == "counts" else name}
        if name in ("position_mm", "quaternion_wxyz"):
            names.add("pose_matrix")
        with_array = (other.path for other in reversed(others) if other.path and names & set(other.arrays))
        raise error.with_path(next(with_array, path)) from None


def _read_source(path: Path, options: ArrayMap, others: Sequence[Source]) -> Source:
    if is_sequence(path):
        return read_sequence(path, options, frames=True)
    if is_text(path):
        heads = (one.arrays["head_surface_mm"].shape[:2] for one in reversed(others) if "head_surface_mm" in one.arrays)
        return read_frames(path, replace(options, frame_shape=options.frame_shape or next(heads, None)))
    for name in (*options.arrays, *options.values):
        if name not in KNOWN:
            raise BadDataError(f"--columns: {name!r} is no array of a scan", way_out=suggestion(name, KNOWN))
    names_in_file: dict[str, str] = {}
    unknown: set[str] = set()

    def choose(names: Sequence[str]) -> list[str]:
        by_nfc = {normalize("NFC", name): name for name in names}  # a letter and its mark may be one sign or two
        for layout_name, stated in options.arrays.items():
            name = stated if stated in names else by_nfc.get(normalize("NFC", stated), "")
            if not name:
                contents = ", ".join(sorted(names)[:_MOST_NAMES]) or "nothing"
                raise BadDataError(f"has no array {stated!r} for {layout_name}", way_out=f"it has {contents}")
            names_in_file[layout_name] = name
        names_in_file.update({name: name for name in KNOWN if name in names and name not in names_in_file})
        names_in_file.update(plain_names(names, names_in_file, options.values))
        unknown.update(set(names) - set(names_in_file.values()))
        return list(dict.fromkeys(names_in_file.values()))

    by_name = read_named(path, choose)
    arrays = {layout_name: by_name[name] for layout_name, name in names_in_file.items()}
    arrays |= {name: np.asarray(value) for name, value in options.values.items()}
    notes = tuple(
        f"{name} is taken for {layout_name}"
        for layout_name, name in names_in_file.items()
        if name not in (layout_name, options.arrays.get(layout_name))
    )
    return Source(arrays, notes=notes, others=tuple(sorted(unknown)))


def pose_source(path: Path, stated: Stated) -> Source:
    """Arrays of the poses, from a table or a sequence metafile of their own."""
    if not is_sequence(path) and not is_text(path):
        what = f"is {kind_of(path) or 'a file of arrays'}, and poses that stand apart are a table of text"
        way_out = "save them as .csv, or in the frames' file as pose_matrix and pose_time_s"
        raise BadDataError(what, way_out=way_out, path=str(path))
    poses = read_sequence(path, stated, frames=False) if is_sequence(path) else read_poses(path, stated)
    return replace(poses, path=str(path))


def head_source(head: Path | scans.HeadGeometry) -> Source:
    """Arrays of the head."""
    head = read_head_geometry(head) if isinstance(head, Path) else head
    arrays = {
        "pitch_mm": np.asarray(head.pitch_mm),
        "array_from_tracker": head.scanhead_from_tracker,
        "head_surface_mm": head.surface_mm,
    }
    return Source(arrays, checked_on=head.checked_on)


def calibration_source(calibration: Path | scans.ElementCalibration) -> Source:
    """Arrays of the pressure array's calibration."""
    calibration = read_array_calibration(calibration).calibration if isinstance(calibration, Path) else calibration
    return Source({name: np.asarray(getattr(calibration, name)) for name in names_of(calibration)})


def landmark_source(landmarks: scans.Landmarks) -> Source:
    """Arrays of the landmarks."""
    nipple = {} if landmarks.nipple_mm is None else {"nipple_mm": landmarks.nipple_mm}
    return Source({"landmarks_mm": np.stack([landmarks.sternal_notch_mm, landmarks.xiphoid_mm]), **nipple})


# --- Arrays of other axes, clocks and units, made those of the layout.


def combine_sources(sources: Sequence[Source], options: Stated) -> tuple[scans.Scan, list[str]]:
    """A scan of the sources' arrays, of which a later one stands for an earlier, and the notes on what was guessed."""
    stated = options
    notes: list[str] = []
    findings: list[Finding] = []
    arrays: Arrays = {}
    checked_on = ""
    for source in sources:
        if "head_surface_mm" in source.arrays:
            checked_on = source.checked_on
        file_states = source.stated.given
        for name, file_value in file_states.items():
            if (option_value := getattr(options, name)) not in (None, file_value):
                notes.append(f"{name.replace('_', '-')} {option_value} as stated, where the file says {file_value}")
        notes += source.notes
        if stated.unit not in (None, source.stated.unit):
            file_states.pop("saturation", None)  # in the file's unit
        open_fields = {name: value for name, value in file_states.items() if getattr(stated, name) is None}
        stated = replace(stated, **open_fields)
        arrays |= {name: np.asarray(one) for name, one in source.arrays.items()}
    _leave_out_gaps(arrays, stated, notes)
    _check_numbers(arrays)
    if "frames" in arrays:
        arrays["counts"] = arrays.pop("frames")
    _arrange_poses(arrays, stated, notes, findings)
    _arrange_frames(arrays, stated, notes, findings)
    _arrange_times(arrays, stated)
    for name, array in arrays.items():
        if (largest := float(np.abs(array, dtype=np.float64).max(initial=0.0))) > _LARGEST:
            raise BadDataError(f"{name} holds {largest:.3g}", way_out="give mm, kPa and s; the file may be damaged")
    pressure = stated.unit not in (None, "counts")
    if pressure:
        _as_counts(arrays, stated, notes, findings)
    elif stated.saturation is not None:
        arrays["saturation_count"] = np.asarray(int(np.ceil(stated.saturation)))
    arrays = {name: arrays[name] for name in LAYOUT if name in arrays}
    for name, array in arrays.items():  # without axes of length 1 that MATLAB adds
        axes = len(LAYOUT[name].shape)
        if axes < 2 and array.ndim > axes and array.size == (max(array.shape) if axes else 1):
            arrays[name] = array.reshape(-1) if axes else array.reshape(())
    for name in _CALIBRATION:
        if name in arrays and arrays[name].size == 1 and arrays.get("counts", np.empty(0)).ndim == 3:
            arrays[name] = np.full(arrays["counts"].shape[1:], float(arrays[name].item()))  # one for all taxels
    _refuse_missing(arrays, [name for source in sources for name in source.others], pressure=pressure)
    _check_layout(arrays)
    _check_units(arrays, calibrated=pressure)
    facts = {"frames_unit": str(stated.unit)} if pressure else {}
    if notes:
        facts["imported_as"] = "; ".join(notes)[:2000]
    return replace(_scan_of_arrays(arrays, facts, checked_on), findings=tuple(findings)), notes


def _refuse_missing(arrays: Arrays, unknown: Sequence[str], *, pressure: bool) -> None:
    needless = {*OPTIONAL, *(_CALIBRATION if pressure else ())}
    missing = [name for name in LAYOUT if name not in arrays and name not in needless]
    if not missing:
        return
    lacks = f"lacks {', '.join(f'{name} ({in_words(LAYOUT[name].shape)})' for name in missing)}"
    options = [option for option, gives in _BESIDE.items() if set(gives) & set(missing)]
    way_out = f"add them, or give {', '.join(options)}" if options else "add them"
    if unknown:
        grid = " (for a grid of values give --as map)" if "mean" in unknown else ""
        what = f"{lacks}; not known: {', '.join(unknown[:_MOST_NAMES])}"
        raise BadDataError(what, way_out=f"{_TEMPLATE}{grid}; or {way_out}")
    raise BadDataError(f"{lacks} (it has {', '.join(sorted(arrays))})", way_out=f"{way_out}; {_HELP}")


def _leave_out_gaps(arrays: Arrays, stated: Stated, notes: list[str]) -> None:
    """Leave out poses that are not finite or the identity: the tool was not seen."""
    layout = "matrix" if "pose_matrix" in arrays else stated.pose_layout or "wxyz"
    parts = [arrays[name] for name in ("pose_matrix", "position_mm", "quaternion_wxyz") if name in arrays]
    time = arrays.get("pose_time_s", np.empty(0)).reshape(-1)
    if not parts or any(part.dtype.kind not in "iuf" or part.ndim < 2 or len(part) != len(time) for part in parts):
        return  # a later check names what is wrong
    numbers = np.hstack([one.reshape(len(time), -1) for one in parts]).astype(np.float64)
    if np.isfinite(numbers).all() and not is_identity(numbers, layout).any():
        return
    poses = visible_poses(time, numbers, [""] * len(time), layout=layout)
    arrays.update(poses.arrays)
    notes += poses.notes


def _arrange_poses(arrays: Arrays, stated: Stated, notes: list[str], findings: list[Finding]) -> None:
    """Make positions in mm, and quaternions with the scalar first, of the poses in any layout and unit."""
    if "pose_matrix" in arrays:
        if "position_mm" in arrays or "quaternion_wxyz" in arrays:
            raise BadDataError("pose_matrix is given beside position_mm or quaternion_wxyz", way_out="leave one out")
        arrays["position_mm"], arrays["quaternion_wxyz"] = _poses_of_matrices(arrays.pop("pose_matrix"))
    pose_count = arrays["pose_time_s"].size if "pose_time_s" in arrays else 0
    for name, width in (("position_mm", 3), ("quaternion_wxyz", 4)):
        if name in arrays and arrays[name].shape == (width, pose_count) and pose_count != width:
            arrays[name] = arrays[name].T
            notes.append(f"{name} of shape {(width, pose_count)} read along its columns")
    if stated.pose_layout is None and (shape := np.shape(arrays.get("quaternion_wxyz", 0.0)))[1:] == (3,):
        way_out = "give --pose-layout euler for degrees of azimuth, elevation, roll: about z, the new y, the new x"
        raise BadDataError(f"quaternion_wxyz has shape {shape}", way_out=way_out)
    if "quaternion_wxyz" in arrays and stated.pose_layout in ("xyzw", "euler"):
        if stated.pose_layout == "euler" and np.abs(arrays["quaternion_wxyz"]).max() <= _TURN:
            text = f"angles lie within {_TURN:.1f} and are read as degrees"
            findings.append(finding("unlike_an_exam", text, "multiply radians by 57.296, and import them again"))
        arrays["quaternion_wxyz"] = quaternions(arrays["quaternion_wxyz"], stated.pose_layout)
    if "position_mm" in arrays:
        arrays["position_mm"] = arrays["position_mm"] * MM_PER_UNIT[stated.length_unit or "mm"]


def quaternions(rotations: FloatArray, layout: str) -> FloatArray:
    """(m, 4) quaternions, scalar first, of quaternions with the scalar last (``xyzw``) or of (m, 3) azimuth, elevation
    and roll in degrees: about z, then about the new y, then about the new x.
    """
    width = 3 if layout == "euler" else 4
    if rotations.ndim != 2 or rotations.shape[1] != width:
        raise BadDataError(f"rotations have shape {rotations.shape}", way_out=f"as {layout} they must be (m, {width})")
    if layout == "euler":
        return np.asarray(Rotation.from_euler("ZYX", rotations, degrees=True).as_quat(scalar_first=True))
    return rotations[:, [3, 0, 1, 2]]


def _poses_of_matrices(matrices: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Positions and quaternions of homogeneous matrices, each (4, 4), (3, 4) or one row of 12 or 16 numbers."""
    shape, sides = matrices.shape, ((4, 4), (3, 4))
    if matrices.ndim == 3 and shape[:2] in sides and shape[1:] != shape[:2]:
        matrices = np.moveaxis(matrices, 2, 0)
    elif matrices.ndim == 2 and shape[1] in (12, 16):
        matrices = matrices.reshape(len(matrices), -1, 4)
    if matrices.ndim != 3 or matrices.shape[1:] not in sides:
        raise BadDataError(f"pose_matrix has shape {matrices.shape}", way_out="it must be (m, 4, 4)")
    matrices = matrices.astype(np.float64)
    rotations = matrices[:, :3, :3]
    departure = np.abs(rotations @ rotations.swapaxes(1, 2) - np.eye(3)).max(axis=(1, 2))
    faults = {
        "its last row is not 0 0 0 1": (matrices[:, 3:] != [0, 0, 0, 1]).any(axis=(1, 2)),
        "R R^T is not 1": departure > _NOT_RIGID,
        "it mirrors": np.linalg.det(rotations) < 0,
    }
    for fault, wrong in faults.items():
        if wrong.any():
            what = f"pose_matrix is not rigid at index {wrong.argmax()} ({fault})"
            raise BadDataError(what, way_out="give the 16 numbers row by row, translation last in each row")
    return matrices[:, :3, 3], np.asarray(Rotation.from_matrix(rotations).as_quat(scalar_first=True))


def _arrange_frames(arrays: Arrays, stated: Stated, notes: list[str], findings: list[Finding]) -> None:
    """Make the counts (n, rows, columns)."""
    if "counts" not in arrays:
        return
    counts = arrays["counts"]
    n = arrays["frame_time_s"].size if "frame_time_s" in arrays else counts.shape[0]
    if counts.ndim in (2, 3) and counts.shape[0] != n and counts.shape[-1] == n:
        notes.append(f"frames of shape {counts.shape} read along the last axis, which is as long as their times")
        counts = np.moveaxis(counts, -1, 0)
    if counts.ndim == 2:
        shape_arrays = (arrays[name] for name in ("head_surface_mm", "gain_kpa_per_count") if name in arrays)
        shape = stated.frame_shape or next((array.shape[:2] for array in shape_arrays if array.ndim > 1), None)
        each = f"frames of {counts.shape[1]} numbers (counts has shape {counts.shape})"
        if shape is None:
            raise BadDataError(each, way_out="give --frame-shape ROWS COLUMNS, or --head-geometry HEAD.json")
        if shape[0] * shape[1] != counts.shape[1]:
            what = f"{each}, and {_sides(shape)} taxels are {shape[0] * shape[1]}"
            way_out = "give --frame-shape ROWS COLUMNS, or --skip-columns for those before the readings"
            raise BadDataError(what, way_out=way_out)
        order = stated.frame_order or "rows"
        if stated.frame_order is None or stated.frame_shape is None:
            notes.append(f"each {counts.shape[1]} numbers read as {_sides(shape)}, along the array's {order}")
        by_columns = counts.reshape(-1, shape[1], shape[0]).swapaxes(1, 2)
        counts = by_columns if order == "columns" else counts.reshape(-1, *shape)
    elif stated.frame_shape is not None and counts.shape[1:] != stated.frame_shape:
        what = f"frames have {_sides(counts.shape[1:])} taxels, not {_sides(stated.frame_shape)}"
        raise BadDataError(what, way_out="leave --frame-shape out")
    head = arrays["head_surface_mm"].shape[:2] if "head_surface_mm" in arrays else counts.shape[1:]
    if counts.ndim == 3 and counts.shape[1:] != head:
        what = f"frames have {_sides(counts.shape[1:])} taxels, and the head {_sides(head)}"
        turned = counts.shape[1:] == head[::-1]
        way_out = (
            "swap their last two axes, or the head's"
            if turned
            else "give the head of this array, or the frames of this head"
        )
        raise BadDataError(what, way_out=way_out)
    arrays["counts"] = counts
    if counts.ndim == 3 and min(counts.shape[1:]) > 3:
        _check_order(counts, stated, findings)


def _check_order(counts: np.ndarray, stated: Stated, findings: list[Finding]) -> None:
    """Refuse readings of which neighbours agree better in another order, unless their order is stated."""
    means = counts.mean(axis=(1, 2), dtype=np.float64)
    if means.max() <= 0:
        return
    pressed = np.flatnonzero(2 * means > means.max())
    if len(pressed) < LEAST_FRAMES:  # the noise of few frames has an order by chance
        return
    frames = counts[pressed[:: max(1, len(pressed) // _LOOKED_AT)]].astype(np.float64)
    frames /= frames.mean(axis=(1, 2), keepdims=True)
    frames -= frames.mean(axis=0)
    rough = {}
    for name, lines in (("row", frames), ("column", frames.swapaxes(1, 2))):
        backwards, apart = lines.copy(), np.empty_like(lines)
        backwards[:, 1::2] = lines[:, 1::2, ::-1]
        apart[:, np.r_[0 : lines.shape[1] : 2, 1 : lines.shape[1] : 2]] = lines
        rough[f"every second {name} runs backwards"] = _roughness(backwards)
        rough[f"every second {name} stands behind all the others"] = _roughness(apart)
    other = min(rough, key=rough.__getitem__)
    roughness, as_stated = rough[other], _roughness(frames)
    transposed = _roughness(frames.reshape(-1, *frames.shape[:0:-1]).swapaxes(1, 2))
    if roughness >= min(_OTHER_ORDER * as_stated, transposed):  # of transposed frames the check of arrangements speaks
        return
    what = f"frames have neighbours that differ by {100 * (1 - np.sqrt(roughness / as_stated)):.0f} % less if {other}"
    way_out = "put the readings in the order of the array"
    if stated.frame_order is None:
        raise BadDataError(what, way_out=f"{way_out}; --frame-order rows takes them as they are")
    findings.append(finding("unlike_an_exam", f"{what}: the size may be wrong", way_out))


def _roughness(frames: FloatArray) -> float:
    """Mean squared difference of neighbouring readings."""
    return float(np.square(np.diff(frames, axis=1)).mean() + np.square(np.diff(frames, axis=2)).mean())


def _sides(shape: Sequence[int]) -> str:
    return " x ".join(map(str, shape))


def _arrange_times(arrays: Arrays, stated: Stated) -> None:
    """Make the times s, on the frames' clock."""
    for time, timed, unit, rate in (
        ("frame_time_s", "counts", stated.time_unit, stated.rate_hz),
        ("pose_time_s", "position_mm", stated.pose_time_unit, stated.pose_rate_hz),
    ):
        if time in arrays:
            steps = np.diff(arrays[time].astype(np.float64).reshape(-1))
            step = float(np.median(steps)) if steps.size else 0.0
            if step * _SECONDS[unit or "s"] > _LONGEST_STEP_S:
                guess = next((name for name in _FINER if step * _SECONDS[name] <= _LONGEST_STEP_S), "ns")
                way_out = f"looks like {_FINER[guess]}, give s or --{_TIME_OPTIONS[time][0]} {guess}"
                raise BadDataError(f"{time} steps by {step:.4g}", way_out=way_out)
            arrays[time] = arrays[time] * _SECONDS[unit or "s"]
        elif rate is not None and timed in arrays:
            arrays[time] = np.arange(len(arrays[timed])) / rate
    if "pose_time_s" in arrays and stated.pose_offset_s:
        arrays["pose_time_s"] = arrays["pose_time_s"] + stated.pose_offset_s


def _as_counts(arrays: Arrays, stated: Stated, notes: list[str], findings: list[Finding]) -> None:
    """Make counts of frames of pressures, with the gain and offset that give the pressures back."""
    unit = str(stated.unit)
    for name in _CALIBRATION:
        if name in arrays:
            raise BadDataError(f"{name} is for counts, and frames are in {unit}", way_out="leave it or --unit out")
    if "counts" not in arrays:
        return
    frames, factor = arrays["counts"], KPA_PER_UNIT[unit]
    whole = frames.dtype.kind in "iu" and frames.min() >= 0 and frames.max() <= _MOST_COUNTS
    kpa = frames.astype(np.float64) * factor
    gain, offset = (factor, 0.0) if whole else (_STEP_KPA, min(0.0, float(np.floor(kpa.min() / _STEP_KPA)) * _STEP_KPA))
    means_of, question = _pressed_means(kpa, unit)
    rounding = "" if whole else f", kept to {1000 * _STEP_KPA:g} Pa"
    notes.append(f"frames in {unit}{rounding}; {means_of}")
    if question:
        text = f"frames in {unit}: {means_of}"
        findings.append(finding("unlike_an_exam", text, f"import them again with the right --unit ({question})"))
    if offset + gain * _MOST_COUNTS < min(kpa.max(), PRESSURE_RANGE_KPA[1]):  # the others would be cut off
        at = tuple(map(int, np.unravel_index(kpa.argmin(), kpa.shape)))
        what = f"frames in {unit} hold {frames.min():g} (first at {at}), and an array reads no such pressure"
        raise BadDataError(
            what, way_out="write 0 in all frames of an element that does not work, or repair the reading"
        )
    arrays["counts"] = np.clip(np.rint((kpa - offset) / gain), 0, _MOST_COUNTS).astype(np.uint16)
    full = _MOST_COUNTS if stated.saturation is None else round((stated.saturation * factor - offset) / gain)
    arrays |= {"gain_kpa_per_count": np.asarray(gain), "offset_kpa": np.asarray(offset)}
    arrays["saturation_count"] = np.asarray(min(max(full, 1), _MOST_COUNTS))


def _pressed_means(kpa: FloatArray, unit: str) -> tuple[str, str]:
    """Words on the pressed frames' means, and a question for another unit where no examination presses so."""
    means = kpa.reshape(len(kpa), -1).mean(axis=1)
    if means.max() < 0:
        raise BadDataError(f"frames in {unit} are below 0 throughout", way_out="give pressures that rise when pressed")
    pressed = means[means >= means.max() / 2]
    low, high = np.quantile(pressed, [0.05, 0.95]) / KPA_PER_UNIT[unit]
    middle = float(np.median(pressed))
    question = unit_question(middle, unit, PRESSURE_WINDOW_KPA)
    means_of = f"pressed ones have means of {low:.3g} to {high:.3g} {unit}"
    if middle >= PRESSURE_RANGE_KPA[1]:
        what = f"frames in {unit}: {means_of}, and an array's range ends at {PRESSURE_RANGE_KPA[1]:g} kPa"
        raise BadDataError(what, way_out=question or "give their unit, --unit")
    return means_of, question


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
            shape = f"({in_words(want)}{',' if len(want) == 1 else ''})" if want else in_words(want)
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
            way_out = "give s on one clock, as numbers" if name in _TIME_OPTIONS else "give real numbers"
            raise BadDataError(f"{name} is {what}", way_out=way_out)
        if array.ndim == 0 and name in _OF_AXES:
            raise BadDataError(f"{name} is a single number", way_out="give an array")
        if 0 in array.shape:
            raise BadDataError(f"{name} is empty (shape {array.shape})", way_out="give at least one frame and one pose")
        finite = np.isfinite(array)
        if not finite.all():
            index = tuple(int(i) for i in np.unravel_index(int(finite.argmin()), finite.shape))
            where = f" (first at {index})" if index else ""
            what = f"{name} holds {finite.size - int(finite.sum())} values that are not finite{where}"
            way_out = "repair or leave them out"
            if name in ("frames", "counts"):
                way_out = "leave such frames out; write 0 in all frames of an element that does not work"
            raise BadDataError(what, way_out=way_out)


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
        if apart < LEAST_STERNUM_MM:
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
    scans.check_pitch(surface, float(arrays["pitch_mm"]))


def _check_clocks(arrays: Arrays) -> None:
    ends = []
    for name, (_, rate) in _TIME_OPTIONS.items():
        times = arrays[name]
        if len(times) == 1 and name == "frame_time_s":
            raise BadDataError("holds one frame", way_out="join a scan's frames in one file, one below the other")
        if len(times) > 1 and times[0] == times.min() == times.max():
            raise BadDataError(f"{name} is {times[0]:g} throughout", way_out="give its times, not a constant")
        if 2 * (repeats := int((np.diff(times) == 0).sum())) > len(times):
            what = f"{name} repeats the time before {repeats} times of {len(times)}"
            raise BadDataError(what, way_out=f"give fractions of a second, or leave it out and give --{rate}")
        ends.append((float(times.min()), float(times.max())))
    (a, b), (c, d) = ends
    if b < c or d < a:
        what = f"frame_time_s ({a:.3f} to {b:.3f}) and pose_time_s ({c:.3f} to {d:.3f}) do not overlap"
        way_out = "give both on one clock: --pose-offset-s is added to the poses' times"
        hours = round((c - a) / 3600)
        if 0 < abs(hours) <= 26 and abs(c - a - 3600 * hours) < 60:  # more is another clock
            way_out = f"{way_out}; is it {-3600 * hours}, of a time zone?"
        raise BadDataError(what, way_out=way_out)


def _scan_of_arrays(arrays: Arrays, facts: Mapping[str, str], checked_on: str) -> scans.Scan:
    values = {name: np.asarray(array, dtype=np.float64) for name, array in arrays.items() if name != "counts"}
    marks = values.get("landmarks_mm")
    surface, transform = values["head_surface_mm"], values["array_from_tracker"]
    check_rigid(transform, name="array_from_tracker")
    return scans.Scan(
        frames=scans.PressureFrames(values["frame_time_s"], arrays["counts"].astype(np.uint16)),
        poses=scans.TrackerPoses(values["pose_time_s"], values["position_mm"], values["quaternion_wxyz"]),
        head=scans.HeadGeometry(surface, float(values["pitch_mm"]), transform, checked_on),
        element_calibration=scans.ElementCalibration(
            values["gain_kpa_per_count"], values["offset_kpa"], int(values.get("saturation_count", 4095))
        ),
        landmarks=None if marks is None else scans.Landmarks(marks[0], marks[1], nipple_mm=values.get("nipple_mm")),
        session={"source": "imported", **facts},
    )
