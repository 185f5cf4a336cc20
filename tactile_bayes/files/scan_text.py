"""Poses of a tracker and frames of a pressure array, each in a text of its own; docs/guides/import.md lists the makers.

Poses are known by the names of their columns, frames by what stands in them: one row a frame, numbers alone or below a
header that names times, counters and sums, or one block of rows a frame, with a line or a blank one between.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from tactile_bayes.declarations import replace
from tactile_bayes.errors import BadDataError, in_file
from tactile_bayes.files.arrays_layout import PoseLayout, Stated
from tactile_bayes.files.named_arrays import Source
from tactile_bayes.files.tables import NO_SENSEL, Line, Sheet, is_label_sequence, number, read_text_table, unit_of_time
from tactile_bayes.geometry import BoolArray, FloatArray

# --- Poses: columns by their names, or numbers in a stated layout.

_NAMES: Final[Mapping[str, str]] = {
    name: kind
    for kind, names in {
        "x": "tx x px posx positionx",
        "y": "ty y py posy positiony",
        "z": "tz z pz posz positionz",
        "qw": "q0 qw w rotw orientationw",
        "qx": "qx q1 orientationx",
        "qy": "qy q2 orientationy",
        "qz": "qz q3 orientationz",
        "azimuth": "az azimuth azi",
        "elevation": "el elevation elev",
        "roll": "roll ro rl",
        "time": "time t zeit timestamp epoch datetime times timems timestampms timeus secs seconds",
        "seconds": "timespecs",
        "nanoseconds": "timespecns",
        "frame": "frame framenumber frameno",
        "status": "state status transformstatus trackingstatus",
        "tool": "tool toolid toolinfo port porthandle toolhandle station sensor",
    }.items()
    for name in names.split()
}
"""What a column is, by its name in small letters and digits."""
_ROTATIONS: Final = {"wxyz": ("qw", "qx", "qy", "qz"), "euler": ("azimuth", "elevation", "roll")}
_PLACE: Final = ("x", "y", "z")
_SEEN: Final = ("ok", "enabled", "valid", "tracked", "good", "true", "visible")
"""Status of a tool that is seen, in small letters."""
_UNIT: Final = re.compile(r"[\[(_ ](mm|cm|m|in|inch|inches)[\])]?$", re.IGNORECASE)
_RADIANS: Final = re.compile(r"[\[(_ ]rad(ians)?\b", re.IGNORECASE)
_LENGTH_LINE: Final = re.compile(r"\blength units?\W+(meters|millimeters|centimeters|mm|cm|m)\b", re.IGNORECASE)
_LENGTHS: Final = {"in": "inch", "inches": "inch", "meters": "m", "millimeters": "mm", "centimeters": "cm"}
_BARE: Final = {"wxyz": 7, "xyzw": 7, "euler": 6, "matrix": 16}
"""Numbers of a pose in a text without names, by its layout; a time and a station may stand before them."""
_MOST_NUMBERS: Final = 20  # of a pose with what stands before it
_MOST_STATIONS: Final = 16
_IDENTITY: Final = {"matrix": np.eye(4).ravel()[:12], "wxyz": np.eye(7)[3], "xyzw": np.eye(7)[6], "euler": np.zeros(6)}
_LARGEST_MM: Final = 1e7  # NDI writes -3.697314e28 where a tool is not seen


def read_poses(source: Path | Sheet, stated: Stated) -> Source:
    """Read times, places and rotations; rows in which the tool is not seen are left out and counted."""
    with in_file(source.name if isinstance(source, Sheet) else source):
        lines, words = read_text_table(source, stated.decimal)
        header = next((line for line in lines if is_header_of_poses(line)), None)
        poses = _poses_without_names(lines, stated) if header is None else _poses_by_names(lines, header, stated)
        return replace(poses, notes=(f"poses: {words}", *poses.notes))


def kind_of_column(name: str) -> str:
    """Kind of a column of a tracker's table by its name, such as ``qw``; empty for any other column."""
    plain = re.sub(r"[^a-z0-9]", "", re.sub(r"[\[(].*?[\])]", "", _UNIT.sub("", name.strip()).lower()))
    return _NAMES.get(plain) or _NAMES.get(re.sub(r"(mm|cm|inch|in|deg|rad|ms|us|s)$", "", plain), "")


def is_header_of_poses(line: Line) -> bool:
    """True for a line that names columns of places or rotations."""
    kinds = {kind_of_column(name) for name in line.fields}
    return kinds.issuperset(_PLACE) or len(kinds & {"qw", "qx", "azimuth", "elevation"}) > 1


def visible_poses(
    time: FloatArray, numbers: FloatArray, reasons: Sequence[str], *notes: str, layout: PoseLayout, **stated: Any
) -> Source:
    """Poses of the rows in which the tool is seen; a note after `notes` counts the others by their reasons.

    `numbers` are (m, k) places and then rotations in the layout, or (m, 16) matrices. `reasons` tell by the status why
    a row has no pose; empty where the tool is seen. `stated` are fields of `Stated`.
    """
    faults = {
        "without numbers": ~np.isfinite(numbers).all(axis=1),
        "with numbers that mean none": (np.abs(numbers) > _LARGEST_MM).any(axis=1),
        "with the identity": is_identity(numbers, layout),
        "without a rotation": ~numbers[:, 3:].any(axis=1) & (layout in ("wxyz", "xyzw")),
    }
    by_numbers = np.select(list(faults.values()), list(faults), "")
    reasons = [reason or str(fault) for reason, fault in zip(reasons, by_numbers, strict=True)]
    keep = np.array([not reason for reason in reasons], dtype=bool)
    counted = ", ".join(f"{number} {reason}" for reason, number in Counter(filter(None, reasons)).most_common())
    if not keep.any():
        raise BadDataError(f"has no pose in which the tool is seen ({counted})", way_out="give another file")
    if counted:
        notes = (*notes, f"{(~keep).sum()} of {len(keep)} poses left out as gaps: {counted}")
    arrays = {"pose_time_s": time[keep]}
    if layout == "matrix":
        arrays["pose_matrix"] = numbers[keep]
    else:
        arrays |= {"position_mm": numbers[keep, :3], "quaternion_wxyz": numbers[keep, 3:]}
    return Source(arrays, Stated(pose_layout=layout, **stated), notes)


def is_identity(numbers: FloatArray, layout: str) -> BoolArray:
    """True for rows of the identity, which a server goes on sending while a tool is out of sight."""
    first_numbers, identity = numbers[:, :12], _IDENTITY[layout]
    if first_numbers.shape[1] != len(identity):
        return np.zeros(len(first_numbers), dtype=bool)
    return np.asarray((first_numbers == identity).all(axis=1))


def choose_tool(names: Sequence[str], stated: Stated, *, place: str) -> str:
    """The tool that is stated, or the only one."""
    if stated.tool is not None:
        matches = [name for name in names if stated.tool in (name, name.partition(" ")[0], name.split("To")[0])]
        if len(matches) == 1:
            return matches[0]
        what = f"has no one tool {stated.tool!r} in {place}"
        raise BadDataError(what, way_out=f"--tool is one of {', '.join(names)}")
    if len(names) > 1:
        raise BadDataError(f"has {len(names)} tools in {place}: {', '.join(names)}", way_out="choose one, --tool NAME")
    return names[0]


# --- Columns by their names.


def _poses_by_names(lines: Sequence[Line], header: Line, stated: Stated) -> Source:
    kinds = [kind_of_column(name) for name in header.fields]
    if "qx" not in kinds:
        for i, kind in enumerate(kinds):
            if kind == "qw" and kinds[max(i - 3, 0) : i] == list(_PLACE):  # of a quaternion, not of a place
                kinds[i - 3 : i] = ["qx", "qy", "qz"]
    lower = [name.lower() for name in header.fields]
    rotations = (tuple(f"r{i}{j}" for i in range(k, k + 3) for j in range(k, k + 3)) for k in (0, 1))  # row by row
    matrix_names = next((names for names in rotations if set(names) <= set(lower)), ())
    kinds = [name if name in matrix_names else kind for name, kind in zip(lower, kinds, strict=True)]
    layout: PoseLayout = "matrix" if matrix_names else "wxyz" if {"qw", "qx", "qy"} & set(kinds) else "euler"
    names = (*_PLACE, *(matrix_names or _ROTATIONS[layout]))
    if not set(names) <= set(kinds):
        what = f"line {header.number} names no {', '.join(sorted(set(names) - set(kinds)))}"
        way_out = (
            "name columns Tx, Ty, Tz and Q0, Qx, Qy, Qz or R00 to R22, or x, y, z and azimuth, elevation, roll (yaw, "
            "pitch and roll: about z, then the new y, then the new x)"
        )
        raise BadDataError(what, way_out=way_out)
    if stated.pose_layout not in (None, layout):
        raise BadDataError(f"line {header.number} names its rotations ({layout})", way_out="leave --pose-layout out")
    rows = [line for line in lines if line.number > header.number]
    if not rows:
        raise BadDataError(f"line {header.number} names columns, and no row stands below it", way_out="give the poses")
    columns, rows = _columns_and_rows_of_tool(header, kinds, rows, names, stated)
    matrix_rows = (3, 4, 5, 0, 6, 7, 8, 1, 9, 10, 11, 2)  # R, then place
    order = matrix_rows if matrix_names else range(len(names))
    numbers = np.column_stack([_column_values(rows, columns[names[i]]) for i in order])
    if layout == "euler" and _RADIANS.search(header.fields[columns["azimuth"]]):
        numbers[:, 3:] *= 180 / np.pi
    status = [_cell(line, columns["status"]) for line in rows] if "status" in columns else [""] * len(rows)
    time, unit = _pose_times(rows, columns, header, stated)
    header_stated: dict[str, Any] = {"pose_time_unit": unit} if unit else {}
    above = [line.text for line in lines if line.number < header.number]
    lengths = [_UNIT.search(header.fields[columns["x"]].strip()), *map(_LENGTH_LINE.search, above)]
    if length := next((match[1].lower() for match in lengths if match), ""):
        header_stated["length_unit"] = _LENGTHS.get(length, length)
    elif layout == "euler" and stated.length_unit is None:
        raise BadDataError("does not say the unit of x, y and z", way_out="give --length-unit cm, inch or mm")
    reasons = _reasons_by_status(status, stated) if "status" in columns else status
    note = f"poses by the names of line {header.number}: {', '.join(header.fields[columns[one]] for one in names)}"
    return visible_poses(time, numbers, reasons, note, layout=layout, **header_stated)


def _columns_and_rows_of_tool(
    header: Line, kinds: Sequence[str], rows: Sequence[Line], names: Sequence[str], stated: Stated
) -> tuple[dict[str, int], list[Line]]:
    """Columns and rows of one tool, which may stand beside others (as NDI writes them) or in rows between theirs."""
    sets = [i for i, kind in enumerate(kinds) if kind == names[3]]
    at = sets[0]
    if len(sets) > 1:
        numbered = []
        for i, column in enumerate(sets, start=1):  # NDI's ToolBox names the tool before its columns
            ports = [name for name in header.fields[:column] if name.lower().startswith("port ")]
            numbered.append(f"{i} ({' '.join(ports[-1].split())})" if ports else f"{i}")
        at = sets[numbered.index(choose_tool(numbered, stated, place=f"{len(sets)} groups of columns"))]
    ahead = not set(_PLACE) & set(kinds[: sets[0]])  # a tool's place stands behind its rotation, not before it
    columns = {kind: _nearest_column(kinds, kind, at, pose=kind in names, ahead=ahead) for kind in set(kinds) if kind}
    tool_rows = list(rows)
    if len(sets) == 1 and "tool" in columns:
        tool = choose_tool(list(dict.fromkeys(_cell(line, columns["tool"]) for line in rows)), stated, place="its rows")
        tool_rows = [line for line in rows if _cell(line, columns["tool"]) == tool]
    return columns, tool_rows


def _nearest_column(kinds: Sequence[str], kind: str, at: int, *, pose: bool, ahead: bool) -> int:
    """The column of a kind nearest to column `at`; columns about a tool stand before its pose."""
    places = [i for i, one in enumerate(kinds) if one == kind]
    beside = [i for i in places if (i > at) == (ahead and pose)]
    if kind in _PLACE or not pose:
        places = beside or places
    return min(places, key=lambda i: abs(i - at))


def _cell(line: Line, column: int) -> str:
    return line.fields[column] if column < len(line.fields) else ""


def _column_values(rows: Sequence[Line], column: int) -> FloatArray:
    """Numbers of a column, NaN where there is none."""
    return np.array([line.values[column] if column < len(line.values) else None for line in rows], dtype=np.float64)


def _reasons_by_status(status: Sequence[str], stated: Stated) -> list[str]:
    """Reason, by its status, why each row has no pose; empty where the tool is seen."""
    values = Counter(status)
    good = _SEEN if stated.pose_good is None else (stated.pose_good.lower(),)
    if not any(value.lower() in good for value in values):
        if stated.pose_good is None and len(values) == 1:
            return [""] * len(status)
        counts_of_status = ", ".join(f"{value or 'blank'} ({number} rows)" for value, number in values.most_common(6))
        what = f"its status is {counts_of_status}"
        raise BadDataError(what, way_out="give the one in which the tool is seen, --pose-good VALUE")
    return ["" if value.lower() in good else f"with status {value or 'blank'}" for value in status]


def _pose_times(
    rows: Sequence[Line], columns: Mapping[str, int], header: Line, stated: Stated
) -> tuple[FloatArray, str]:
    """Times of all rows and their unit where the header says it."""
    named = ("time", "seconds", "nanoseconds", "frame")
    columns_read = {name: _column_values(rows, columns[name]) for name in named if name in columns}
    if "time" in columns_read:
        _refuse_unknown_times(columns_read["time"], rows, columns["time"], "--pose-rate-hz")
        return _interpolated(columns_read["time"]), unit_of_time(header.fields[columns["time"]])
    if "seconds" in columns_read:
        return _interpolated(columns_read["seconds"] + 1e-9 * columns_read.get("nanoseconds", 0.0)), "s"
    if stated.pose_rate_hz is None:
        lacking = "frame numbers but no times" if "frame" in columns_read else "no column of times"
        raise BadDataError(f"has {lacking}", way_out="give the tracker's rate, --pose-rate-hz HZ")
    number = _interpolated(columns_read["frame"]) if "frame" in columns_read else np.arange(len(rows), dtype=np.float64)
    return (number - number[0]) / stated.pose_rate_hz, "s"


def _refuse_unknown_times(values: FloatArray, rows: Sequence[Line], column: int, rate: str) -> None:
    """Refuse a column of times of which none is known."""
    if not np.isfinite(values).any():
        what = f"its column of times holds {_cell(rows[0], column)!r}, which is no time that is known"
        way_out = f"write s, HH:MM:SS.s or YYYY-MM-DD HH:MM:SS.s, or leave it out and give {rate}"
        raise BadDataError(what, way_out=way_out)


def _interpolated(values: FloatArray) -> FloatArray:
    """Times with those that are missing interpolated; a row without a time has no pose either."""
    known = np.isfinite(values)
    if not known.any():
        what = "its column of times or frame numbers has no number"
        raise BadDataError(what, way_out="leave it out, and give --pose-rate-hz HZ")
    index = np.arange(len(values))
    return np.asarray(np.interp(index, index[known], values[known]))


# --- Numbers without names.


def _poses_without_names(lines: Sequence[Line], stated: Stated) -> Source:
    rows = [line for line in lines if line.is_numbers and len(line.fields) > 1]
    width = max(Counter(len(line.fields) for line in rows).items(), key=lambda one: one[1])[0] if rows else 0
    values = np.array([line.values for line in rows if len(line.fields) == width], dtype=np.float64)
    if width > _MOST_NUMBERS:
        raise BadDataError(f"has {width} numbers a row, which is no pose", way_out="give a table of poses")
    layout = stated.pose_layout
    of_matrix = next((n for n in (16, 12) if width - n in (0, 1)), 0)
    if layout is None and not of_matrix:
        what = f"has {width} numbers a row and no names"
        raise BadDataError(what, way_out="give --pose-layout wxyz, xyzw, euler or matrix")
    layout = layout or "matrix"
    size = of_matrix or 16 if layout == "matrix" else _BARE[layout]
    if not 0 <= width - size <= 3:
        raise BadDataError(f"has {width} numbers a row, and a pose as {layout} has {size}", way_out="correct one")
    if layout == "euler" and stated.length_unit is None:
        raise BadDataError("does not say the unit of x, y and z", way_out="give --length-unit cm, inch or mm")
    before, numbers = values[:, : width - size], values[:, width - size :]
    keep = np.ones(len(values), dtype=bool)
    for column in before.T:
        stations = [f"{one:g}" for one in np.unique(column)]
        if len(stations) <= _MOST_STATIONS < len(values):
            keep &= column == float(choose_tool(stations, stated, place="its rows (stations)"))
    # with a rate stated, a column of whole numbers that rises counts the poses
    before, rate_hz = before[keep], stated.pose_rate_hz
    rising = [i for i, one in enumerate(np.diff(before, axis=0).T) if (one >= 0).all() and one.any()]
    counting = [i for i in rising if rate_hz and (before[:, i] == np.rint(before[:, i])).all()]
    if rate_hz and (counting or not rising):
        number = before[:, counting[-1]] if counting else np.arange(len(before), dtype=np.float64)
        time, unit = (number - number[0]) / rate_hz, {"pose_time_unit": "s"}
        time_words = f"counted in column {counting[-1] + 1}" if counting else "counted by rows"
    elif rising:
        time, unit, time_words = before[:, rising[-1]], {}, f"in column {rising[-1] + 1}"
    else:
        raise BadDataError(f"has {width} numbers a row, of which none is a time", way_out="give --pose-rate-hz HZ")
    notes = [f"poses as {layout} from column {width - size + 1} on, times {time_words}"]
    if lost := sum(line.number > rows[0].number for line in lines) + 1 - len(values):
        notes.append(f"{lost} lines of other than {width} numbers left out as gaps")
    return visible_poses(time, numbers[keep], [""] * len(time), *notes, layout=layout, **unit)


# --- Frames: one row a frame, or blocks of rows, behind what their program writes first.

_UNITS: Final = {
    **{unit.lower(): unit for unit in ("kPa", "Pa", "psi", "mmHg", "N/cm2", "counts")},
    "n/cm²": "N/cm2",
    "n/cm^2": "N/cm2",
    "raw": "counts",
}
"""Units by what programs call them, in small letters."""
_NUMBER: Final = r"(?P<number>\d+(?:[.,]\d+)?(?:e[+-]?\d+)?)"
_UNIT_LINE: Final = re.compile(r"^\W*(?:(?:pressure[ _])?units?\b|pressure values in\b)[^\w]*([\w/^²]+)", re.IGNORECASE)
_UNIT_WORD: Final = re.compile(r"[\[(]\s*(kpa|psi|mmhg|n/cm2|n/cm²|n/cm\^2)\.?\s*[\])]", re.IGNORECASE)
_FULL_SCALE: Final = re.compile(r"\b\d+ *= *full[ -]scale", re.IGNORECASE)
"""SingleTact's program says so of counts in columns that it calls PSI."""
_PERIOD_LINE: Final = re.compile(rf"\b(seconds_per_frame|time per (?:pic|frame))\b\D*{_NUMBER}", re.IGNORECASE)
_RATE_LINE: Final = re.compile(
    rf"\b((?:sampl\w*|scan\w*|frame|record\w*)[ _]?(?:rate|frequency)|frames per second|fps)\b\D*{_NUMBER}",
    re.IGNORECASE,
)
_TIME_LINE: Final = re.compile(r"\btime\b[^\d\n]*(\d+(?:[:.,]\d+)*)\s*(ms|s|secs?|seconds)?\b", re.IGNORECASE)
_SATURATION_LINE: Final = re.compile(rf"^\W*saturation[_ ]pressure\b\D*{_NUMBER}", re.IGNORECASE)
_FIELD_NAME: Final = re.compile(r"b[xyz]_?\d*", re.IGNORECASE)
"""A component of a magnetometer's field, as ReSkin's library calls it."""
_TIME_NAME: Final = re.compile(
    r"(time|t|timestamp|epoch|datetime|elapsed|elapsed time|secs?|seconds|clock|zeit)", re.IGNORECASE
)
_OTHER_NAME: Final = re.compile(
    r"^(no|nr|#|n|i|id)\W*$|\b(frame|index|idx|sample|number|counter|date|sum|total|mean|average|avg|max|min|peak|force|"
    r"load|area|cof|cop)(?![a-z])",
    re.IGNORECASE,
)
"""Names of columns that hold no reading of one taxel, nor a time."""
_PLAIN: Final = re.compile(r"[\[(].*?[\])]|_?(ms|us|ns|secs?|s)$", re.IGNORECASE)  # what is no part of a name
_LAYOUTS: Final = "give one row a frame, or blocks of rows; --skip-columns says how many stand before the readings"
_MOST_OF_POSES: Final = 24  # columns: a table of more holds readings, too
_SAMPLED: Final = 50


def read_frames(path: Path, stated: Stated) -> Source:
    """Read frames and, where the text has them, times, unit and rate; the frames' shape is stated where it is known."""
    all_lines, words = read_text_table(path, stated.decimal)
    lines = _without_word_columns(all_lines)
    if header := next((line for line in lines if len(line.fields) < _MOST_OF_POSES and is_header_of_poses(line)), None):
        raise BadDataError(f"is a table of poses by line {header.number}", way_out="give the frames, and it as --poses")
    blocks = _blocks(lines, math.prod(stated.frame_shape) if stated.frame_shape else None)
    if blank_cells := sum(field == NO_SENSEL for line in blocks[0] for field in line.fields):
        cells = f"{blank_cells} cells {NO_SENSEL!r} from line {blocks[0][0].number} on"
        what = f"has {cells}, which Tekscan writes beside a sensor"
        raise BadDataError(what, way_out="export the rows and columns without them, and give a head of these")
    before = [line for line in lines if line.number < blocks[0][0].number]
    header_stated, header_notes = _stated_by_lines(before)
    notes = [f"frames: {words}", *header_notes]
    for line in before:
        if len({name[:2].lower() for name in line.fields if _FIELD_NAME.fullmatch(name)}) == 3:
            what = f"is a log of magnetic fields by line {line.number} ({', '.join(line.fields[:4])})"
            raise BadDataError(what, way_out="make pressures of them by your calibration, and give those")
    if len(blocks) > 1 and len(blocks[0]) > 1:
        return _frames_of_blocks(lines, blocks, header_stated, notes)
    rows = [line for block in blocks for line in block]
    names = before[-1].fields if before and len(before[-1].fields) == len(rows[0].fields) else []
    return _frames_of_rows(rows, names, stated, header_stated, notes)


def _without_word_columns(lines: Sequence[Line]) -> Sequence[Line]:
    """The lines without the words in their columns of words, such as a status beside the readings."""
    widths = Counter(len(line.fields) for line in lines if len(line.fields) > 1)
    width = max(widths, key=lambda one: one * widths[one], default=0)
    table_lines = [line for line in lines if len(line.fields) == width > 1]
    sample = table_lines[:: max(1, len(table_lines) // _SAMPLED)]
    words = [i for i in range(width) if 2 * sum(one.values[i] is None for one in sample) > len(sample)]
    if not words or 2 * len(words) > width:
        return lines
    kept = []
    for line in lines:
        values = [math.nan if i in words else one for i, one in enumerate(line.values)]
        kept.append(line if len(values) != width or None in values else replace(line, values=values))
    return kept


def _blocks(lines: Sequence[Line], taxels: int | None) -> list[list[Line]]:
    """Runs of lines of numbers, of which each has as many as the last: the longest of the text's widths.

    Lines of numbers of another width that come first belong to what stands before.
    """
    widths = [len(line.fields) for line in lines if len(line.fields) > 1 and line.is_numbers]
    if not widths:
        raise BadDataError("holds no row of numbers", way_out="give one row a frame, or blocks of rows")
    width = max(set(widths), key=lambda one: (widths.count(one) * one, one))
    blocks: list[list[Line]] = []
    open_block = False
    for line in lines:
        is_row = len(line.fields) == width and line.is_numbers
        if is_row and open_block and not line.after_blank:
            blocks[-1].append(line)
        elif is_row:
            blocks.append([line])
        elif blocks and (fault := _fault_of_row(line, width)):
            what = f"line {line.number} holds {fault}, the others {width} numbers"
            raise BadDataError(what, way_out="give every row one length, numbers alone")
        open_block = is_row
    if taxels is not None and width >= taxels:  # rows of one table, whatever stands between
        return [[line for block in blocks for line in block]]
    lengths = {len(block) for block in blocks}
    if len(lengths) > 1 and min(lengths) > 1:
        odd = next(block for block in blocks if len(block) != len(blocks[0]))
        what = f"has frames of {len(blocks[0])} rows and, at line {odd[0].number}, one of {len(odd)}"
        raise BadDataError(what, way_out="leave out a frame that is cut off")
    return blocks if len(lengths) == 1 else [[line for block in blocks for line in block]]


def _fault_of_row(line: Line, width: int) -> str:
    """Fault of a line that looks like a row of the table and is none; empty for a title and for other lines."""
    if len(line.fields) < 2 or line.text.lstrip('" ').lower().startswith(("frame", "time", "@@")):
        return ""
    odd = [field for field, value in zip(line.fields, line.values, strict=True) if value is None]
    if odd and len(line.fields) < width - 1:
        return ""
    return repr(odd[0][:30]) if odd else f"{len(line.fields)} numbers"


def _stated_by_lines(before: Iterable[Line]) -> tuple[Stated, list[str]]:
    """Unit, rate and saturation by the lines before the numbers, and a note for each."""
    values: dict[str, Any] = {}
    notes = []
    for line in before:
        for option, value in _stated_by_line(line.text):
            if option not in values:
                values[option] = value
                shown = f"{value:g}" if isinstance(value, float) else value
                notes.append(f"{option.replace('_', '-')} {shown} by line {line.number}, {line.text.strip()[:40]!r}")
    if values.get("unit", "counts") == "counts":
        values.pop("saturation", None)  # of a pressure, where there are none
    return Stated(**values), notes


def _stated_by_line(text: str) -> Iterable[tuple[str, Any]]:
    word = _UNIT_LINE.search(text) or _UNIT_WORD.search(text)
    if _FULL_SCALE.search(text):
        yield "unit", "counts"
    elif word and word[1].lower() in _UNITS:
        yield "unit", _UNITS[word[1].lower()]
    for pattern, option in ((_PERIOD_LINE, "rate_hz"), (_RATE_LINE, "rate_hz"), (_SATURATION_LINE, "saturation")):
        if (match := pattern.search(text)) and (value := float(match["number"].replace(",", "."))) > 0:
            yield option, 1 / value if pattern is _PERIOD_LINE else value


def _frames_of_blocks(
    lines: Sequence[Line], blocks: Sequence[Sequence[Line]], stated: Stated, notes: list[str]
) -> Source:
    """One frame per block, with its time where every block has one above it."""
    frames = np.array([[line.values for line in block] for block in blocks], dtype=np.float64)
    titles = [line for line in reversed(lines) if not line.is_numbers]
    times, before = [], 0
    for start in (block[0].number for block in blocks):
        above = (_TIME_LINE.search(line.text) for line in titles if before < line.number < start)
        match = next(filter(None, above), None)
        time = None if match is None else number(match[1], decimal_comma=True)
        if match is None or time is None:
            break
        times.append(time * (0.001 if (match[2] or "").lower() == "ms" else 1.0))
        before = start
    arrays = {"frames": frames}
    if len(times) == len(frames):
        arrays["frame_time_s"] = np.array(times)
        notes.append("times of the frames by the lines above them")
    first = f"the first at line {blocks[0][0].number}"
    notes.append(f"{len(frames)} frames, each a block of {frames.shape[1]} rows ({first})")
    return Source(arrays, stated, tuple(notes))


def _frames_of_rows(
    rows: Sequence[Line], names: Sequence[str], options: Stated, stated: Stated, notes: list[str]
) -> Source:
    values = np.array([line.values for line in rows], dtype=np.float64)
    if not np.isfinite(values).any():
        raise BadDataError("holds no number other than NaN or infinity", way_out="give the array's readings")
    if is_label_sequence(values[0][np.isfinite(values[0])]) and len(rows) > 1:
        notes.append(f"line {rows[0].number} counts {values[0, -2]:g}, {values[0, -1]:g}: taken for labels")
        values = values[1:]
    shape = options.frame_shape
    taxels = math.prod(shape) if shape else None
    if taxels is not None and len(values) == taxels and values.shape[1] < taxels:
        notes.append(f"{taxels} rows of {values.shape[1]} numbers: rows are read as taxels, columns as frames")
        return Source({"frames": values.T}, stated, tuple(notes))
    if shape is not None and values.shape[1] - (options.skip_columns or 0) == shape[1] and len(values) % shape[0] == 0:
        notes.append(f"{len(values)} rows of {shape[1]} numbers: each {shape[0]} are read as a frame")
        return Source({"frames": values[:, -shape[1] :].reshape(-1, *shape)}, stated, tuple(notes))
    time, readings = _time_and_readings(values, list(names), taxels, options)
    arrays = {"frames": values[:, readings]}
    if len(readings) < values.shape[1]:
        notes.append(f"{len(readings)} of {values.shape[1]} columns are readings, from column {readings[0] + 1} on")
    if time is not None:
        _refuse_unknown_times(values[:, time], rows, time, "--rate-hz")
        arrays["frame_time_s"] = values[:, time]
        unit = unit_of_time(names[time]) if names else ""
        named = f" ({names[time]!r})" if names else ""
        notes.append(f"times in column {time + 1}{named}" + (f", in {unit}" if unit else ""))
        if unit and stated.time_unit is None:
            stated = replace(stated, time_unit=unit)
    return Source(arrays, stated, tuple(notes))


def _time_and_readings(
    values: FloatArray, names: list[str], taxels: int | None, stated: Stated
) -> tuple[int | None, list[int]]:
    """Columns of times (None without) and of readings: as stated, by their names, else by how many there are."""
    width = values.shape[1]
    plain = [_PLAIN.sub("", name.strip()).strip(" _") for name in names]
    timed = [i for i, name in enumerate(plain) if _TIME_NAME.fullmatch(name) or _TIME_NAME.fullmatch(names[i])]
    others = [i for i, name in enumerate(plain) if _OTHER_NAME.search(name) or kind_of_column(names[i])]
    others += [i for i in range(width) if i not in others and np.isnan(values[:, i]).all()]
    first = stated.skip_columns
    if first is None and (timed or others):
        readings = [i for i in range(width) if i not in (*timed, *others)]
        if taxels is not None and len(readings) != taxels:  # by names that differ by their numbers only
            stems = [re.sub(r"\d+", "0", name) for name in names]
            alike = [stem for stem, number in Counter(stems).items() if number == taxels]
            readings = [i for i, stem in enumerate(stems) if alike == [stem]] or readings
        if taxels is None or len(readings) == taxels:
            return (timed[0] if timed else None), readings
        names_shown = ", ".join(repr(one) for one in (*names[:3], *names[-1:]))
        what = f"names {width} columns ({names_shown}), {len(readings)} of which may be readings, for {taxels} taxels"
        raise BadDataError(what, way_out=_LAYOUTS)
    if first is None:
        first = 0 if taxels is None else width - taxels
    if not 0 <= first < width or (taxels is not None and first + taxels > width):
        raise BadDataError(f"has {width} columns, and the head {taxels} taxels", way_out=_LAYOUTS)
    readings = list(range(first, width if taxels is None else first + taxels))
    if timed and timed[0] < first:
        return timed[0], readings
    # of the columns before the readings the last that rises, or the last (one that falls is told when times are
    # checked), and none that only counts
    steps = np.diff(values[:, :first], axis=0).T
    others = [i for i, one in enumerate(steps) if stated.time_unit or not one.size or (one != 1).any()]
    rising = [i for i in others if (steps[i] >= 0).all() and steps[i].any()]
    return next(reversed(rising), None if stated.rate_hz else next(reversed(others), None)), readings
