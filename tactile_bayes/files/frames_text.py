"""Frames of a pressure array in a text: one row a frame, or blocks of rows, behind what their program writes first.

Layouts that are known by what stands in them:

- one row a frame: numbers alone, or below a header that names times and counters (pedar and pliance of novel:
  ``time[secs]``, then a column a sensor)
- one block of rows a frame, with a line such as ``Frame 12`` or a blank one between (Tekscan's ASCII movie with
  ``ROWS``, ``SECONDS_PER_FRAME`` and ``UNITS``; XSENSOR's CSV with ``Time`` and ``Units``)
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from tactile_bayes.declarations import replace
from tactile_bayes.errors import BadDataError
from tactile_bayes.files.arrays_layout import Stated
from tactile_bayes.files.named_arrays import Source
from tactile_bayes.files.poses_text import is_header_of_poses, kind_of_column
from tactile_bayes.files.text_lines import NO_SENSEL, Line, counts_up, number, read_text_table, unit_of_time
from tactile_bayes.geometry import FloatArray

_UNITS: Final = {
    **{unit.lower(): unit for unit in ("kPa", "Pa", "psi", "mmHg", "N/cm2", "counts")},
    "n/cm²": "N/cm2",
    "n/cm^2": "N/cm2",
    "raw": "counts",
}
"""Units by what programs call them, in small letters."""
_UNIT_LINE: Final = re.compile(r"^\W*(pressure[ _])?units?\b[^\w]*([\w/^²]+)", re.IGNORECASE)
_UNIT_WORD: Final = re.compile(r"[\[(]\s*(kpa|psi|mmhg|n/cm2|n/cm²|n/cm\^2)\s*[\])]", re.IGNORECASE)
_PERIOD_LINE: Final = re.compile(r"\b(seconds_per_frame|time per pic)\b\D*([\d.,]+)", re.IGNORECASE)
_RATE_LINE: Final = re.compile(
    r"\b((?:sampl\w*|scan\w*|frame|record\w*)[ _]?(?:rate|frequency)|frames per second|fps)\b\D*([\d.,]+)",
    re.IGNORECASE,
)
_TIME_LINE: Final = re.compile(r"\btime\b[^\d\n]*(\d[\d:.,]*)\s*(ms|s|secs?|seconds)?\b", re.IGNORECASE)
_SATURATION_LINE: Final = re.compile(r"^\W*saturation[_ ]pressure\b\D*([\d.,]+)", re.IGNORECASE)
_TIME_NAME: Final = re.compile(r"(time|t|timestamp|elapsed|elapsed time|secs?|seconds|clock|zeit)", re.IGNORECASE)
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


def read_frames(path: Path, given: Stated, *, shape: tuple[int, int] | None) -> Source:
    """Read frames and, where the text has them, times, unit and rate; `shape` is the head's, where it is known."""
    table = read_text_table(path, given.decimal)
    lines = _without_words(table.lines)
    shape = given.frame_shape or shape
    if header := next((line for line in lines if is_header_of_poses(line) and len(line.fields) < _MOST_OF_POSES), None):
        what = f"is a table of poses by line {header.number}"
        raise BadDataError(what, way_out="give the frames, and it as --poses")
    blocks = _blocks(lines, None if shape is None else shape[0] * shape[1])
    if beside := sum(one == NO_SENSEL for line in blocks[0] for one in line.fields):
        cells = f"{beside} cells {NO_SENSEL!r} from line {blocks[0][0].number} on"
        what = f"has {cells}, which Tekscan writes beside a sensor"
        raise BadDataError(what, way_out="export the rows and columns without them, and give a head of these")
    before = [line for line in lines if line.number < blocks[0][0].number]
    stated, told = _said(before)
    notes = [f"frames: {table.words}", *told]
    if len(blocks) > 1 and len(blocks[0]) > 1:
        return _of_blocks(lines, blocks, stated, notes)
    rows = [line for block in blocks for line in block]
    names = before[-1].fields if before and len(before[-1].fields) == len(rows[0].fields) else []
    return _of_rows(rows, names, shape, given, stated, notes)


def _without_words(lines: Sequence[Line]) -> Sequence[Line]:
    """The lines without the words in their columns of words, such as a status beside the readings."""
    several = [line for line in lines if len(line.fields) > 1]
    widths = Counter(len(line.fields) for line in several)
    width = max(widths.items(), key=lambda one: one[0] * one[1], default=(0, 0))[0]
    held = [line for line in several if len(line.fields) == width]
    sample = held[:: max(1, len(held) // _SAMPLED)]
    words = [i for i in range(width) if 2 * sum(one.values[i] is None for one in sample) > len(sample)]
    if not words or 2 * len(words) > width:
        return lines

    def blanked(line: Line) -> Line:
        values = [math.nan if i in words else one for i, one in enumerate(line.values)]
        return line if len(values) != width or None in values else replace(line, values=values)

    return [blanked(line) for line in lines]


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
        held = len(line.fields) == width and line.is_numbers
        if held and open_block and not line.after_blank:
            blocks[-1].append(line)
        elif held:
            blocks.append([line])
        elif blocks and (held_too := _like_a_row(line, width)):
            what = f"line {line.number} holds {held_too}, the others {width} numbers"
            raise BadDataError(what, way_out="give every row one length, numbers alone")
        open_block = held
    if taxels is not None and width >= taxels:  # rows of one table, whatever stands between
        return [[line for block in blocks for line in block]]
    lengths = {len(block) for block in blocks}
    if len(lengths) > 1 and min(lengths) > 1:
        odd = next(block for block in blocks if len(block) != len(blocks[0]))
        what = f"has frames of {len(blocks[0])} rows and, at line {odd[0].number}, one of {len(odd)}"
        raise BadDataError(what, way_out="leave out a frame that is cut off")
    return blocks if len(lengths) == 1 else [[line for block in blocks for line in block]]


def _like_a_row(line: Line, width: int) -> str:
    """What a line holds that looks like one of the table, and is not; empty for a title and for other lines."""
    if len(line.fields) < 2 or line.text.lstrip('" ').lower().startswith(("frame", "time", "@@")):
        return ""
    odd = [field for field, value in zip(line.fields, line.values, strict=True) if value is None]
    if odd and len(line.fields) < width - 1:
        return ""
    return repr(odd[0][:30]) if odd else f"{len(line.fields)} numbers"


def _said(before: Iterable[Line]) -> tuple[Stated, list[str]]:
    """What the lines before the numbers say of unit, rate and saturation, and a note for each."""
    found: dict[str, Any] = {}
    notes = []
    for line in before:
        for option, value in _said_in(line.text):
            if option not in found:
                found[option] = value
                said = f"{value:g}" if isinstance(value, float) else value
                notes.append(f"{option.replace('_', '-')} {said} by line {line.number}, {line.text.strip()[:40]!r}")
    if found.get("unit", "counts") == "counts":
        found.pop("saturation", None)  # of a pressure, where there are none
    return Stated(**found), notes


def _said_in(text: str) -> Iterable[tuple[str, Any]]:
    unit = _UNIT_LINE.search(text)
    word = unit[2] if unit else (named[1] if (named := _UNIT_WORD.search(text)) else "")
    if word.lower() in _UNITS:
        yield "unit", _UNITS[word.lower()]
    for pattern, option, made in (
        (_PERIOD_LINE, "rate_hz", lambda value: 1 / value),
        (_RATE_LINE, "rate_hz", float),
        (_SATURATION_LINE, "saturation", float),
    ):
        if (found := pattern.search(text)) and (value := float(found[found.lastindex or 1].replace(",", "."))) > 0:
            yield option, made(value)


def _of_blocks(lines: Sequence[Line], blocks: Sequence[Sequence[Line]], stated: Stated, notes: list[str]) -> Source:
    frames = np.array([[line.values for line in block] for block in blocks], dtype=np.float64)
    arrays = {"frames": frames}
    first = blocks[0][0].number
    titles = [line for line in lines if not line.is_numbers]
    times = _times_between(titles, [block[0].number for block in blocks])
    if times is not None:
        arrays["frame_time_s"] = times
        notes.append("times of the frames by the lines above them")
    notes.append(f"{len(frames)} frames, each a block of {frames.shape[1]} rows (the first at line {first})")
    return Source(arrays, stated, tuple(notes))


def _times_between(titles: Sequence[Line], starts: Sequence[int]) -> FloatArray | None:
    """A time above each block, in s; None where one has none."""
    found, before = [], 0
    for start in starts:
        texts = [line.text for line in titles if before < line.number < start]
        match = next((one for text in reversed(texts) if (one := _TIME_LINE.search(text))), None)
        if match is None:
            return None
        try:
            found.append(number(match[1], decimal_comma=True) * (0.001 if (match[2] or "").lower() == "ms" else 1.0))
        except ValueError:
            return None
        before = start
    return np.array(found)


def _of_rows(
    rows: Sequence[Line],
    names: Sequence[str],
    shape: tuple[int, int] | None,
    given: Stated,
    stated: Stated,
    notes: list[str],
) -> Source:
    values = np.array([line.values for line in rows], dtype=np.float64)
    if counts_up(values[0][np.isfinite(values[0])]) and len(rows) > 1:
        notes.append(f"line {rows[0].number} counts {values[0, -2]:g}, {values[0, -1]:g}: taken for labels")
        values = values[1:]
    taxels = None if shape is None else shape[0] * shape[1]
    if taxels is not None and len(values) == taxels and values.shape[1] < taxels:
        notes.append(f"{taxels} rows of {values.shape[1]} numbers: rows are read as taxels, columns as frames")
        return Source({"frames": values.T}, stated, tuple(notes))
    if shape is not None and values.shape[1] - (given.skip_columns or 0) == shape[1] and len(values) % shape[0] == 0:
        notes.append(f"{len(values)} rows of {shape[1]} numbers: each {shape[0]} are read as a frame")
        return Source({"frames": values[:, -shape[1] :].reshape(-1, *shape)}, stated, tuple(notes))
    time, readings = _columns(values, list(names), taxels, given)
    arrays = {"frames": values[:, readings]}
    if len(readings) < values.shape[1]:
        notes.append(f"{len(readings)} of {values.shape[1]} columns are readings, from column {readings[0] + 1} on")
    if time is not None:
        arrays["frame_time_s"] = values[:, time]
        unit = unit_of_time(names[time]) if names else ""
        named = f" ({names[time]!r})" if names else ""
        notes.append(f"times in column {time + 1}{named}" + (f", in {unit}" if unit else ""))
        if unit and stated.time_unit is None:
            stated = replace(stated, time_unit=unit)
    return Source(arrays, stated, tuple(notes))


def _columns(values: FloatArray, names: list[str], taxels: int | None, given: Stated) -> tuple[int | None, list[int]]:
    """Columns of times (None without) and of readings: as stated, by their names, else by how many there are."""
    width = values.shape[1]
    plain = [_PLAIN.sub("", name.strip()).strip(" _") for name in names]
    timed = [i for i, name in enumerate(plain) if _TIME_NAME.fullmatch(name) or _TIME_NAME.fullmatch(names[i])]
    others = [i for i, name in enumerate(plain) if _OTHER_NAME.search(name) or kind_of_column(names[i])]
    others += [i for i in range(width) if i not in others and np.isnan(values[:, i]).all()]
    first = given.skip_columns
    if first is None and (timed or others):
        readings = [i for i in range(width) if i not in (*timed, *others)]
        if taxels is None or len(readings) == taxels:
            return (timed[0] if timed else None), readings
        told = ", ".join(repr(one) for one in (*names[:3], *names[-1:]))
        what = f"names {width} columns ({told}), {len(readings)} of which may be readings, for {taxels} taxels"
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
    others = [i for i, one in enumerate(steps) if given.time_unit or not one.size or (one != 1).any()]
    rising = [i for i in others if (steps[i] >= 0).all() and steps[i].any()]
    return next(reversed(rising), None if given.rate_hz else next(reversed(others), None)), readings
