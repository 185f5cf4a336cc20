"""Grids in files of other programs, before they are maps: tables of text, arrays and images."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from tactile_bayes.declarations import Record
from tactile_bayes.errors import BadDataError, UsageError
from tactile_bayes.files.images import read_image
from tactile_bayes.files.named_arrays import ARRAY_SUFFIXES, read_named
from tactile_bayes.files.text_lines import (
    FEWEST_LABELS,
    NO_SENSEL,
    counts_up,
    fields_of,
    read_lines,
    refuse_thousands,
    separator_of,
    with_comma,
)
from tactile_bayes.geometry import FloatArray

# --- What a file or a caller gives before it is a map.


class Grid(Record, eq=False):
    """Values in rows and columns, and what their file says of them."""

    arrays: dict[str, np.ndarray[Any, Any]]  #: ``mean (ny, nx)`` and, where known, ``count`` and ``variance``.
    spacing_mm: tuple[float, float] | None = None  #: Width and height of a cell, where the file states it.
    resolution_mm: tuple[float, float] | None = None  #: The same by an image's resolution, often of its printing.
    units: str = ""  #: Where the file states it.
    notes: tuple[str, ...] = ()  #: What was done on reading it.


# --- A grid of numbers in a text table, as programs and spreadsheets write it.
#
# Lines of text before and after the numbers are left out, and said to be. Tekscan's ASCII export (``.asf``,
# ``.csv``) is such a table: ``KEY value`` lines, ``ASCII_DATA @@``, ``Frame 1``, rows, ``@@``; ``B`` is no sensel.

_WAY_OUT: Final = "give a table of numbers, such as .csv"
_NUMBER: Final = re.compile(r"[+-]?(([0-9]+\.?[0-9]*|\.[0-9]+)(e[+-]?[0-9]+)?|nan|inf(inity)?)", re.IGNORECASE)
_TIME: Final = re.compile(r"(t|time|times|timestamp|date|frame|sample|index|s|ms|sec|seconds)\b.*", re.IGNORECASE)
"""A first column of this name stands before frames, one a row."""
_SPACING_LINE: Final = re.compile(
    r"^(ROW|COL)_SPACING[\s,;:=]+([0-9.]+)[\s,;]*(mm|cm|m|in|inch)?[\s,;]*$", re.MULTILINE
)
_UNITS_LINE: Final = re.compile(r"^UNITS[\s,;:=]+([^\s,;]+)[\s,;]*$", re.MULTILINE)
_MM: Final = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "in": 25.4, "inch": 25.4, None: 1.0}


def read_table(path: Path, *, no_value: Sequence[str] = ()) -> Grid:
    """Read a table of text, NaN where a field is empty or one of the texts of `no_value`."""
    words = [one for one in no_value if not is_number(one)]  # numbers are looked for among the values
    texts = read_lines(path)
    separator = separator_of(texts, words) or ","
    rows = [fields_of(one, separator) for one in texts]
    commas = with_comma(rows, words)
    refuse_thousands(commas, way_out="write numbers without commas")
    decimal = {one for one in commas if one.count(",") == 1}
    rows = [[field.replace(",", ".") if field in decimal else field for field in row] for row in rows]
    first, last = _numbers_within(rows, no_value)
    names = rows[first - 1] if first else []
    if len(names) == len(rows[first]) > 1 and _TIME.fullmatch(names[0]) and not any(map(is_number, names)):
        what = f"its first column is called {names[0][:20]!r}, as before frames that stand one a row"
        raise BadDataError(what, way_out="import them as a scan, or give one frame as rows and columns")
    text = "\n".join(texts)
    marks = (*words, NO_SENSEL) if "ASCII_DATA" in text else tuple(words)
    before, rows, after, notes = rows[:first], rows[first:last], rows[last:], list[str]()
    _refuse_several(rows, first)
    for part, where in ((before, "before"), (after, "after")):
        if lines := [said for row in part if (said := " ".join(filter(None, row)))]:
            more = f" and {len(lines) - 1} more" if len(lines) > 1 else ""
            notes.append(f"text {where} the numbers was left out: {lines[0][:40]!r}{more}")
    if len(rows[0]) > 2 and all(row[-1] == "" for row in rows):
        rows = [row[:-1] for row in rows]
        notes.append("every row ends with a separator: it begins no column")
    values = _values(rows, marks, first)
    for mark in dict.fromkeys(marks):
        if alike := sum(field == mark for row in rows for field in row):
            notes.append(f"{alike:,} cells hold {mark!r}, which is no value")
    _refuse_labels(values)
    _refuse_list(values)
    named = _UNITS_LINE.search(text)
    units = "" if named is None else "kPa" if named[1].lower() == "kpa" else named[1]
    sides = {side: float(number) * _MM[unit or None] for side, number, unit in _SPACING_LINE.findall(text)}
    spacing = (sides["COL"], sides["ROW"]) if len(sides) == 2 else None
    return Grid({"mean": values}, spacing, None, units, tuple(notes))


def is_number(field: str) -> bool:
    """True for a text that is a number, NaN and infinity included."""
    return _NUMBER.fullmatch(field) is not None


def _numbers_within(rows: Sequence[list[str]], no_value: Sequence[str]) -> tuple[int, int]:
    """Where lines of numbers begin and end: there every field is one, or empty, or a mark for no value."""
    marks = {"", NO_SENSEL, *no_value}
    plain = [
        i
        for i, row in enumerate(rows)
        if any(map(is_number, row)) and all(field in marks or is_number(field) for field in row)
    ]
    if not plain:
        faulty = next((row for row in rows if any(map(is_number, row))), None)
        if faulty is None:
            held = next((field for row in rows for field in row if field), "")
            what = f"holds {held[:30]!r} and no number" if held else "is empty"
            raise BadDataError(what, way_out=_WAY_OUT)
        return rows.index(faulty), len(rows)
    first, last = plain[0], plain[-1] + 1
    while last < len(rows) and any(map(is_number, rows[last])):  # a faulty row is told, not left out
        last += 1
    while first > 0 and len(rows[first - 1]) == len(rows[first]) and any(map(is_number, rows[first - 1])):
        if _is_title(rows[first - 1]):
            break
        first -= 1
    # rows of empty fields belong to the grid, blank lines do not
    while first > 0 and len(rows[first - 1]) > 1 and not any(rows[first - 1]):
        first -= 1
    while last < len(rows) and len(rows[last]) > 1 and not any(rows[last]):
        last += 1
    return first, last


def _is_title(row: Sequence[str]) -> bool:
    return row[0][:5].lower() == "frame"


def _refuse_several(rows: Sequence[list[str]], before: int) -> None:
    """Refuse several tables: blank lines and titles of frames separate tables, not rows."""
    for number, row in enumerate(rows, start=before):
        blank = len(row) <= 1 and not any(row)
        if blank or _is_title(row):
            what = f"has {'a blank line' if blank else repr(row[0][:20])} after row {number}"
            way_out = "give one grid, such as one frame or a mean of frames, in a file; frames with poses are a scan"
            raise BadDataError(what, way_out=way_out)


def _values(rows: Sequence[list[str]], marks: Sequence[str], before: int) -> FloatArray:
    for number, row in enumerate(rows, start=before + 1):
        if len(row) != len(rows[0]):
            what = f"row {number} has {len(row)} fields, row {before + 1} has {len(rows[0])}"
            raise BadDataError(what, way_out="give every row one length")
    none = {"", *marks}
    try:
        values = np.array([[np.nan if field in none else float(field) for field in row] for row in rows])
    except ValueError:
        raise _no_number(rows, none, before) from None
    if any("_" in field for row in rows for field in row if field not in none):  # which float() passes over
        raise _no_number(rows, none, before)
    return values


def _no_number(rows: Sequence[list[str]], marks: set[str], before: int) -> BadDataError:
    """The fault of the first field that is no number, with the way out for what it is."""
    fields = ((i, j, field) for i, row in enumerate(rows, before + 1) for j, field in enumerate(row, 1))
    faults = [one for one in fields if one[2] not in marks and not is_number(one[2])]
    row, column, field = faults[0]
    alike = sum(one[2] == field for one in faults) - 1
    what = f"row {row}, column {column} holds {field[:30]!r}" + (f" (and {alike} more do)" if alike else "")
    way_out = f"if it means no value, give --no-value {field[:30]}"
    if len(faults) > 1 and all(one[1] == 1 for one in faults) and len(faults) >= len(rows) - 1:
        way_out = "leave out the column of names"
    elif (row, column) == (before + 1, 1) and len(faults) == 1:
        way_out = f"leave out the labels of rows and columns; {way_out}"
    elif re.search(r"\d", field):
        way_out = "write numbers as 1.5"
    return BadDataError(what, way_out=way_out)


def _refuse_labels(table: FloatArray) -> None:
    """Refuse numbers of rows and columns, or their places, in the first row and column: they are no readings."""
    row, column = table[0], table[:, 0]
    both = np.isnan(table[0, 0]) and _evenly(row[1:]) and _evenly(column[1:])
    for found, line, where in (
        (both, row[1:], "row 1 and column 1"),
        (counts_up(row), row, "row 1"),
        (counts_up(column), column, "column 1"),
    ):
        if found:
            way_out = "save the grid without them (pandas: to_csv(..., header=False, index=False))"
            raise BadDataError(f"{where} count {_first_three(line)}... as labels do", way_out=way_out)
    for name, line, beside in (("column", column, table[:, 1:].T), ("row", row, table[1:])):
        if len(line) >= FEWEST_LABELS and _evenly(line) and not any(map(_evenly, beside)):
            what = f"{name} 1 runs in equal steps ({_first_three(line)}...)"
            raise BadDataError(what, way_out="leave out times or places; frames that stand one a row are a scan")


def _first_three(line: FloatArray) -> str:
    return ", ".join(f"{value:g}" for value in line[:3])


def _refuse_list(table: FloatArray) -> None:
    """Refuse a list of x, y and value, whose first two columns name each place of a lattice once."""
    if table.shape[1] != 3 or len(table) < 9:
        return
    nx, ny = (len(np.unique(table[:, column])) for column in (0, 1))
    places = len(np.unique(table[:, :2], axis=0))
    if nx > 2 and ny > 2 and nx * ny == places == len(table):
        what = f"is a list of {len(table)} values with their places, on {nx} by {ny} of them"
        raise BadDataError(what, way_out="give the values as rows and columns (pandas: pivot)")


def _evenly(line: FloatArray) -> bool:
    """True when three numbers or more run in equal steps."""
    steps = np.diff(line)
    return len(line) > 2 and bool(steps[0] != 0.0) and bool(np.allclose(steps, steps[0], rtol=1e-6, atol=0.0))


# --- A grid by its file's suffix.

IMAGE_SUFFIXES: Final = (".tif", ".tiff", ".pgm", ".png")
_ARRAY_SUFFIXES: Final = (*ARRAY_SUFFIXES, ".nc", ".cdf")
_BESIDE: Final = ("mean", "count", "variance", "spacing_mm")
TABLE_SUFFIXES: Final = (".csv", ".txt", ".tsv", ".asf", ".asc", ".dat")
GRID_SUFFIXES: Final = (*TABLE_SUFFIXES, *IMAGE_SUFFIXES, *ARRAY_SUFFIXES)
"""Of files that hold no map of this program, whatever else."""


def open_grid(path: Path, *, no_value: Sequence[str] = (), array: str = "") -> Grid:
    """Read a grid's file by its suffix: a table (see `read_table`), an image (see `read_image`), or arrays, of which
    ``mean (ny, nx)`` may have ``count``, ``variance`` (NaN where count is 1) and ``spacing_mm`` beside it.
    """
    suffix = path.suffix.lower()
    if suffix in _ARRAY_SUFFIXES:
        return _of_arrays(path, array)
    if array:
        raise UsageError(f"--array is for files of arrays; {path} has none")
    if suffix in IMAGE_SUFFIXES:
        picture = read_image(path)
        return Grid({"mean": picture.values}, None, picture.spacing_mm, "", picture.notes)
    if suffix in TABLE_SUFFIXES:
        return read_table(path, no_value=no_value)
    known = ", ".join((*TABLE_SUFFIXES, *IMAGE_SUFFIXES, *_ARRAY_SUFFIXES))
    sheets = suffix in (".xlsx", ".xls", ".ods")
    way_out = "save the grid as .csv" if sheets else f"grids are read from {known}"
    raise BadDataError(f"has the suffix {suffix or 'none'!r}", way_out=way_out)


def _of_arrays(path: Path, array: str) -> Grid:
    """The array that is named, else ``mean``, else the only one of rows and columns."""

    def wanted(names: Sequence[str]) -> Sequence[str]:
        return [name for name in _BESIDE if name in names] if "mean" in names and not array else names

    arrays = read_named(path, wanted)
    if not array and "mean" in arrays:
        if "spacing_mm" not in arrays:
            return Grid(arrays)
        sides = np.atleast_1d(arrays.pop("spacing_mm"))
        if sides.dtype.kind not in "iuf" or sides.ndim != 1 or len(sides) not in (1, 2):
            what = f"spacing_mm is {sides.dtype} of shape {sides.shape}"
            raise BadDataError(what, way_out="it must be one number")
        return Grid(arrays, (float(sides[0]), float(sides[-1])))
    flat = {name: held for name, held in arrays.items() if held.ndim == 2 and min(held.shape) > 1}
    if array:
        flat = {name: held for name, held in flat.items() if name == array}
    if len(flat) == 1:
        ((name, values),) = flat.items()
        return Grid({"mean": values}, notes=() if array or len(arrays) == 1 else (f"the array {name!r} was taken",))
    has = ", ".join(f"{name} {held.shape}" for name, held in sorted(arrays.items())[:12]) or "nothing"
    if len(flat) > 1:
        raise BadDataError(f"holds several arrays of rows and columns ({has})", way_out="name one with --array NAME")
    called = f" called {array!r}" if array else ""
    way_out = "name another" if array else "frames with poses are a scan; of frames alone give one, or their mean"
    raise BadDataError(f"holds no array of rows and columns{called} (it has {has})", way_out=way_out)
