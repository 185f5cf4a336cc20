"""Maps from the grids of other programs: tables, arrays and images."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from tactile_bayes.declarations import replace
from tactile_bayes.errors import BadDataError, UsageError, in_file
from tactile_bayes.files import tables
from tactile_bayes.files.arrays_layout import GridOptions
from tactile_bayes.files.images import read_image
from tactile_bayes.files.named_arrays import ARRAY_SUFFIXES, AXES, Grid, orient_by_axes, read_named
from tactile_bayes.findings import finding, first_of
from tactile_bayes.geometry import BoolArray, FloatArray
from tactile_bayes.mapping.map import MapRecipe, TactileMap, block_sums
from tactile_bayes.posterior.draw import SamplerSettings
from tactile_bayes.posterior.estimate import estimate_map
from tactile_bayes.presets import CELL_MM, MM_PER_UNIT, Normalise
from tactile_bayes.progress import Progress, no_progress

# --- A grid of numbers in a text table, as programs and spreadsheets write it.
#
# Lines of text before and after the numbers are left out with a note. Tekscan's ASCII export (``.asf``,
# ``.csv``) is such a table: ``KEY value`` lines, ``ASCII_DATA @@``, ``Frame 1``, rows, ``@@``; ``B`` is no sensel.

_WAY_OUT: Final = "give a table of numbers, such as .csv"
_NUMBER: Final = re.compile(r"[+-]?(([0-9]+\.?[0-9]*|\.[0-9]+)(e[+-]?[0-9]+)?|nan|inf(inity)?)", re.IGNORECASE)
_TIME: Final = re.compile(r"(t|time|times|timestamp|date|frame|sample|index|s|ms|sec|seconds)\b.*", re.IGNORECASE)
"""Name of a first column before frames, one per row."""
_SPACING_LINE: Final = re.compile(
    r"^(ROW|COL)_SPACING[\s,;:=]+([0-9.]+)[\s,;]*(mm|cm|m|in|inch)?[\s,;]*$", re.MULTILINE
)
_UNITS_LINE: Final = re.compile(r"^UNITS[\s,;:=]+([^\s,;]+)[\s,;]*$", re.MULTILINE)


def read_table(path: Path, *, no_value: Sequence[str] = ()) -> Grid:
    """Read a table of text, NaN where a field is empty or one of the texts of `no_value`."""
    words = [text for text in no_value if not is_number(text)]  # numbers are matched as values, later
    texts = tables.read_lines(path)
    separator = tables.detect_separator(texts, words) or ","
    rows = [tables.split_fields(text, separator) for text in texts]
    commas = tables.comma_numbers(rows, words, way_out="write numbers without commas")
    decimal = {field for field in commas if field.count(",") == 1}
    rows = [[field.replace(",", ".") if field in decimal else field for field in row] for row in rows]
    first, last = _numbers_within(rows, no_value)
    names = rows[first - 1] if first else []
    if len(names) == len(rows[first]) > 1 and _TIME.fullmatch(names[0]) and not any(map(is_number, names)):
        what = f"its first column is called {names[0][:20]!r}, as before frames that stand one a row"
        raise BadDataError(what, way_out="import them as a scan, or give one frame as rows and columns")
    text = "\n".join(texts)
    marks = (*words, tables.NO_SENSEL) if "ASCII_DATA" in text else tuple(words)
    before, rows, after, notes = rows[:first], rows[first:last], rows[last:], list[str]()
    for number, row in enumerate(rows, start=first):  # blank lines and titles of frames separate tables, not rows
        if (blank := len(row) <= 1 and not any(row)) or _is_title(row):
            what = f"has {'a blank line' if blank else repr(row[0][:20])} after row {number}"
            way_out = "give one grid, such as one frame or a mean of frames, in a file; frames with poses are a scan"
            raise BadDataError(what, way_out=way_out)
    for part, where in ((before, "before"), (after, "after")):
        if lines := [text_of_row for row in part if (text_of_row := " ".join(filter(None, row)))]:
            notes.append(f"text {where} the numbers was left out: {first_of([repr(line[:40]) for line in lines], 1)}")
    if len(rows[0]) > 2 and all(row[-1] == "" for row in rows):
        rows = [row[:-1] for row in rows]
        notes.append("every row ends with a separator: it begins no column")
    if separator == ",":
        padded = {i % 2: field for row in rows for i, field in enumerate(row) if re.fullmatch(r"0\d+", field)}
        if list(padded) == [1]:  # in every second column alone
            what = f"holds {padded[1]!r} between commas, as of a number with a decimal comma"
            raise BadDataError(what, way_out="separate the columns by semicolons or tabs")
    values = _values(rows, marks, first)
    for mark in dict.fromkeys(marks):
        if count := sum(field == mark for row in rows for field in row):
            notes.append(f"{count:,} cells hold {mark!r}, which is no value")
    _refuse_labels(values)
    named = _UNITS_LINE.search(text)
    units = "" if named is None else "kPa" if named[1].lower() == "kpa" else named[1]
    sides = {side: float(number) * MM_PER_UNIT[unit or "mm"] for side, number, unit in _SPACING_LINE.findall(text)}
    spacing = (sides["COL"], sides["ROW"]) if len(sides) == 2 else None
    return Grid({"mean": values}, spacing, None, units, tuple(notes))


def is_number(field: str) -> bool:
    """True for a text that is a number, NaN and infinity included."""
    return _NUMBER.fullmatch(field) is not None


def _numbers_within(rows: Sequence[list[str]], no_value: Sequence[str]) -> tuple[int, int]:
    """First row of numbers, and one past the last: every field is a number, empty or a mark for no value."""
    marks = {"", tables.NO_SENSEL, *no_value}
    plain = [
        i
        for i, row in enumerate(rows)
        if any(map(is_number, row)) and all(field in marks or is_number(field) for field in row)
    ]
    if not plain:
        faulty = next((row for row in rows if any(map(is_number, row))), None)
        if faulty is None:
            first_text = next((field for row in rows for field in row if field), "")
            what = f"holds {first_text[:30]!r} and no number" if first_text else "is empty"
            raise BadDataError(what, way_out=_WAY_OUT)
        return rows.index(faulty), len(rows)
    first, last = plain[0], plain[-1] + 1
    while last < len(rows) and any(map(is_number, rows[last])):  # a faulty row is an error, not left out
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


def _values(rows: Sequence[list[str]], marks: Sequence[str], before: int) -> FloatArray:
    """Array of rows of one length, NaN for marks; any other field is an error."""
    for number, fields_of_row in enumerate(rows, start=before + 1):
        if len(fields_of_row) != len(rows[0]):
            what = f"row {number} has {len(fields_of_row)} fields, row {before + 1} has {len(rows[0])}"
            raise BadDataError(what, way_out="give every row one length")
    none = {"", *marks}
    fields = ((i, j, field) for i, row in enumerate(rows, before + 1) for j, field in enumerate(row, 1))
    faults = [one for one in fields if one[2] not in none and not is_number(one[2])]
    if not faults:
        return np.array([[np.nan if field in none else float(field) for field in row] for row in rows])
    row, column, field = faults[0]
    repeats = sum(fault[2] == field for fault in faults) - 1
    way_out = f"if it means no value, give --no-value {field[:30]}"
    if len(faults) > 1 and all(one[1] == 1 for one in faults) and len(faults) >= len(rows) - 1:
        way_out = "leave out the column of names"
    elif (row, column) == (before + 1, 1) and len(faults) == 1:
        way_out = f"leave out the labels of rows and columns; {way_out}"
    elif re.search(r"\d", field) and "#" not in field:  # 1.#QNAN and #DIV/0! are words
        way_out = "write numbers as 1.5"
    more = f" (and {repeats} more do)" if repeats else ""
    raise BadDataError(f"row {row}, column {column} holds {field[:30]!r}{more}", way_out=way_out)


def _refuse_labels(table: FloatArray) -> None:
    """Refuse row and column numbers or places in the first row or column, and lists of x, y and value."""
    row, column = table[0], table[:, 0]
    both = np.isnan(table[0, 0]) and _in_equal_steps(row[1:]) and _in_equal_steps(column[1:])
    for is_labels, line, where in (
        (both, row[1:], "row 1 and column 1"),
        (tables.is_label_sequence(row), row, "row 1"),
        (tables.is_label_sequence(column), column, "column 1"),
    ):
        if is_labels:
            way_out = "save the grid without them (pandas: to_csv(..., header=False, index=False))"
            raise BadDataError(f"{where} count {_first_three(line)}... as labels do", way_out=way_out)
    for name, line, beside in (("column", column, table[:, 1:].T), ("row", row, table[1:])):
        if len(line) >= tables.FEWEST_LABELS and _in_equal_steps(line) and not any(map(_in_equal_steps, beside)):
            what = f"{name} 1 runs in equal steps ({_first_three(line)}...)"
            raise BadDataError(what, way_out="leave out times or places; frames that stand one a row are a scan")
    nx, ny = (len(np.unique(line)) for line in (column, table[:, 1 % table.shape[1]]))
    each_once = table.shape[1] == 3 and len(np.unique(table[:, :2], axis=0)) == len(table)
    if each_once and nx > 2 and ny > 2 and nx * ny == len(table):
        what = f"is a list of {len(table)} values with their places, on {nx} by {ny} of them"
        raise BadDataError(what, way_out="give the values as rows and columns (pandas: pivot)")


def _first_three(line: FloatArray) -> str:
    return ", ".join(f"{value:g}" for value in line[:3])


def _in_equal_steps(line: FloatArray) -> bool:
    """True for three or more numbers in equal steps."""
    steps = np.diff(line)
    return len(line) > 2 and bool(steps[0] != 0.0) and bool(np.allclose(steps, steps[0], rtol=1e-6, atol=0.0))


# --- A grid by its file's suffix.

IMAGE_SUFFIXES: Final = (".tif", ".tiff", ".pgm", ".png")
_ARRAY_SUFFIXES: Final = (*ARRAY_SUFFIXES, ".nc", ".cdf")
_BESIDE: Final = ("mean", "count", "variance", "spacing_mm")
TABLE_SUFFIXES: Final = (".csv", ".txt", ".tsv", ".asf", ".asc", ".dat")
GRID_SUFFIXES: Final = (*TABLE_SUFFIXES, *IMAGE_SUFFIXES, *ARRAY_SUFFIXES)  #: Suffixes of files that `open_grid` reads.


def open_grid(path: Path, *, no_value: Sequence[str] = (), array: str = "") -> Grid:
    """Read a grid's file by its suffix: a table (see `read_table`), an image (see `read_image`), or arrays, of which
    ``mean (ny, nx)`` may have ``count``, ``variance`` (NaN where count is 1) and ``spacing_mm`` beside it.
    """
    suffix = path.suffix.lower()
    if suffix in _ARRAY_SUFFIXES:
        return _read_arrays(path, array)
    if array:
        raise UsageError(f"--array is for files of arrays; {path} has none")
    if suffix in IMAGE_SUFFIXES:
        return read_image(path)
    if suffix in TABLE_SUFFIXES:
        return read_table(path, no_value=no_value)
    sheets = suffix in (".xlsx", ".xls", ".ods")
    way_out = "save the grid as .csv" if sheets else f"grids are read from {', '.join(GRID_SUFFIXES)}"
    raise BadDataError(f"has the suffix {suffix or 'none'!r}", way_out=way_out)


def _read_arrays(path: Path, array: str) -> Grid:
    """Grid of the array that is named, else of ``mean``, else of the only one with two axes."""

    def choose(names: Sequence[str]) -> Sequence[str]:
        return [name for name in (*_BESIDE, *AXES) if name in names] if "mean" in names and not array else names

    arrays = read_named(path, choose)
    notes, steps = orient_by_axes(arrays)
    if not array and "mean" in arrays:
        if "spacing_mm" not in arrays:
            return Grid(arrays, notes=notes, steps=steps)
        stated = arrays.pop("spacing_mm")
        sides = stated.reshape(-1)  # MATLAB's numbers have two axes
        if sides.dtype.kind not in "iuf" or len(sides) not in (1, 2):
            raise BadDataError(f"spacing_mm is {stated.dtype} of shape {stated.shape}", way_out="it must be one number")
        return Grid(arrays, (float(sides[0]), float(sides[-1])), notes=notes)
    named = {name: one for name, one in arrays.items() if array in ("", name)}
    flat = {name: one for name, one in named.items() if one.ndim == 2 and min(one.shape) > 1}
    if len(flat) == 1:
        ((name, values),) = flat.items()
        choice = () if array or len(arrays) == 1 else (f"the array {name!r} was taken",)
        return Grid({"mean": values}, notes=(*choice, *notes), steps=steps)
    has = ", ".join(f"{name} {one.shape}" for name, one in sorted(arrays.items())[:12]) or "nothing"
    if len(flat) > 1:
        raise BadDataError(f"holds several arrays of rows and columns ({has})", way_out="name one with --array NAME")
    called = f" called {array!r}" if array else ""
    way_out = "name another" if array else "frames with poses are a scan; of frames alone give one, or their mean"
    raise BadDataError(f"holds no array of rows and columns{called} (it has {has})", way_out=way_out)


# --- Cells without a value: the file or the caller declares the number for it; an undeclared outlying one is refused.

ALL_ARE_VALUES: Final = "none"  #: ``--no-value none``: every number is a value.
_BEYOND: Final = 1e12  #: No value of a map is larger.
_FEWEST_STEPS: Final = 20
_TIMES: Final = 3.0
_TIMES_OF_ONE: Final = 6.0
"""An outlying number differs from its neighbours by so many times the largest other step; a single cell by more."""
_MOST_CONSTANT: Final = 8
_FEWEST_LINES: Final = 8
_TIMES_OF_LINES: Final = 10.0
"""Factor of an outlying line's median step, to both sides, over the largest of the other lines."""


def _refuse_outlying(values: FloatArray) -> None:
    """Refuse undeclared numbers far from all others, such as fill values and dead lines."""
    values = np.where(np.isfinite(values), values, np.nan)
    if outlier := _outlying_number(values):
        number, where, rest = outlier
        what = f"{number:g} in {where} stands apart from all other values"
        what += f", {rest.min():.4g} to {rest.max():.4g}" if rest.size else ""
        way_out = f"if it means no value, give --no-value {number:.12g}"
        way_out += "" if abs(number) > _BEYOND else f"; if all are values, --no-value {ALL_ARE_VALUES}"
        raise BadDataError(what, way_out=way_out)
    for axis, name in ((1, "column"), (0, "row")):
        if line := _outlying_line(values, axis):
            what = f"{name} {line[0]} differs from those beside it by {line[1]:.3g}, others by up to {line[2]:.3g}"
            way_out = f"leave its cells empty if that line is dead; if all are values, --no-value {ALL_ARE_VALUES}"
            raise BadDataError(what, way_out=way_out)


def _outlying_number(values: FloatArray) -> tuple[float, str, FloatArray] | None:
    """Outlying number, its cells in words and the other values; None without one.

    Candidates are the lowest, the highest and those of constant lines. The cells of an outlying one differ from their
    neighbours by several times the largest step between other neighbours.
    """
    known = np.isfinite(values)
    if not known.any():
        return None
    low, high = float(values[known].min()), float(values[known].max())
    lines = [line for table in (values, values.T) for line in table if np.isfinite(line).sum() > 4]
    constant = {float(line[np.isfinite(line)][0]) for line in lines if np.ptp(line[np.isfinite(line)]) == 0}
    constant = constant if len(constant) <= _MOST_CONSTANT else set()
    numbers = sorted({low, high} | constant, key=lambda one: -abs(one - float(np.median(values[known]))))
    special = np.isin(values, numbers)
    rest = values[known & ~special]
    largest = _steps(values, known & ~special, np.logical_and)
    for number in numbers:
        cells = values == number
        if abs(number) > _BEYOND:
            return number, _where(cells), rest
        border = _steps(values, cells, np.logical_xor)
        times = _TIMES if cells.sum() > 1 else _TIMES_OF_ONE
        if len(largest) >= _FEWEST_STEPS and len(border) and np.median(border) > times * largest.max():
            return number, _where(cells), rest
    return None


def _outlying_line(values: FloatArray, axis: int) -> tuple[int, float, float] | None:
    """A dead or stuck row or column: its number, its step to both sides and the largest other; None without one."""
    steps = np.abs(np.diff(values, axis=axis))
    steps = steps if axis else steps.T
    lines = [line[np.isfinite(line)] for line in steps.T]
    medians = np.array([np.median(line) if len(line) > 4 else np.nan for line in lines])
    if np.isfinite(medians).sum() < _FEWEST_LINES:
        return None
    for line in range(len(medians) + 1):
        beside = medians[max(line - 1, 0) : line + 1]
        others = np.delete(medians, range(max(line - 1, 0), min(line + 1, len(medians))))
        if np.isfinite(beside).all() and beside.min() > _TIMES_OF_LINES * np.nanmax(others):
            return line + 1, float(beside.min()), float(np.nanmax(others))
    return None


def _steps(values: FloatArray, cells: BoolArray, which: np.ufunc) -> FloatArray:
    """Absolute differences of neighbours inside the cells (`np.logical_and`) or across their border (`logical_xor`)."""
    across = np.abs(np.diff(values, axis=1))[which(cells[:, 1:], cells[:, :-1])]
    along = np.abs(np.diff(values, axis=0))[which(cells[1:], cells[:-1])]
    steps: FloatArray = np.concatenate([across, along])
    return steps[np.isfinite(steps)]


def _where(cells: BoolArray) -> str:
    """Cells in words: whole rows or columns, or their number and the first."""
    number = int(cells.sum())
    for axis, name in ((0, "column"), (1, "row")):
        whole = np.flatnonzero(cells.all(axis=axis)) + 1
        if len(whole) * cells.shape[axis] == number:
            return f"{name} {whole[0]}" if len(whole) == 1 else f"{len(whole)} {name}s ({whole[0]} to {whole[-1]})"
    row, column = (int(i) + 1 for i in np.argwhere(cells)[0])
    return f"{number:,} cells (row {row}, column {column}...)" if number > 1 else f"row {row}, column {column}"


# --- Import of a grid or an image as a map.
#
# Orientation: arrays keep their order. Column 0 is the lowest x and row 0 the lowest y, so y runs down an image,
# whose row 0 is its top; a lump's angle is positive from x towards y, clockwise on the image. Pictures of such a
# map show it as the file reads, first row on top and first column on the left (see `mapping.convention`). Cell
# centres are placed about the centre of the grid, so x and y run from -(n-1)/2 to (n-1)/2 cells.

# A map divided by its level has a median near 1; farther off than this, it was not divided.
_NORMALISED_MEDIAN: Final = (0.2, 5.0)
_RANGE_ENDS: Final = (1.0, 100.0, 255.0, 65535.0)  #: To which programs stretch the values of a picture.
_LEAST_SPACING_MM: Final = 0.01
_MOST_READINGS: Final = 1e9  #: In a cell: no exam has more frames.
_SMALLEST: Final = 1e-100  #: Largest value below which squares vanish: a lump of 1e-160 was not found.
_MOST_KPA: Final = 1000.0  #: Median of a grid in kPa: no examination presses with more, and as Pa it is a light touch.
_LONGEST_MM: Final = 500.0
"""No examined breast is longer; frames that stand one in a row, or one below the other, are."""


def import_grid(path: Path, options: GridOptions, *, progress: Progress = no_progress) -> tuple[TactileMap, list[str]]:
    """Map of a file, and notes on how it was read; see `open_grid` and `grid_map`.

    `progress` counts reading and the map as two of three steps; the caller's work is the third.
    """
    with in_file(path):
        grid = open_grid(path, no_value=options.no_value, array=options.array or "")
        progress(1, 3)
        made = grid_map(grid, options)
    progress(2, 3)
    return made


def grid_map(grid: Grid, options: GridOptions) -> tuple[TactileMap, list[str]]:
    """Map of a grid, and notes on how it was read.

    The spacing may be left out where the grid has it. With ``normalise="none"`` values are divided only where a `level`
    is given, which makes it ``"gain"``.
    """
    spacing, notes = _spacing(grid, stated_mm=options.spacing_mm)
    marked: list[str] = []
    mean = _real(grid.arrays["mean"], name="mean")
    if mean.ndim != 2 or 0 in mean.shape:
        raise BadDataError(f"mean has shape {mean.shape}", way_out="it must be (ny, nx)")
    longest = max(mean.shape) * spacing
    if longest > _LONGEST_MM:
        what = f"{mean.shape[0]} x {mean.shape[1]} cells of {spacing:g} mm are {longest / 1000:.3g} m long"
        way_out = "one frame a row, or frames below each other? import them as a scan; otherwise check the spacing"
        raise BadDataError(what, way_out=way_out)
    values = mean
    for number in [float(text) for text in options.no_value if is_number(text)]:
        is_no_value = (values == number) | (values == np.float64(np.float32(number)))
        values = np.where(is_no_value, np.nan, values)
        marked.append(f"{int(is_no_value.sum()):,} cells hold {number:g}, stated to be no value")
    arrays = {**grid.arrays, "mean": values}
    if "count" in arrays:
        arrays["count"] = np.where(np.isnan(values) & ~np.isnan(mean), 0, _numbers(arrays, "count"))
        values = np.where(arrays["count"] > 0, values, np.nan)
    if ALL_ARE_VALUES not in options.no_value or (np.abs(values) > _BEYOND).any():
        _refuse_outlying(values)
    units = options.units or (grid.units if options.normalise == "none" else "")
    tactile_map = _map(arrays, spacing_mm=spacing, normalise=options.normalise, units=units)
    if options.normalise != "none" or options.level is not None:
        _refuse_stretched(tactile_map)
    cell = options.cell_mm or (CELL_MM if spacing < _FINEST_MM * (1 - 1e-6) else spacing)
    if cell < spacing * (1 - 1e-6):
        raise UsageError(f"--cell-mm is {cell:g}, and the grid's cells are {spacing:g} mm; give that or more")
    if (times := int(cell / spacing + 1e-6)) > 1:
        tactile_map = _average_cells(tactile_map, times)
        if not tactile_map.covered.any():
            what = f"no {times} x {times} cells of {spacing:g} mm have data in half of them"
            raise BadDataError(what, way_out="give a smaller --cell-mm, or a larger grid")
        notes.append(f"{times} x {times} cells of {spacing:g} mm were averaged into one of {times * spacing:g} mm")
    if options.level is not None:
        tactile_map = _divide_by_level(tactile_map, options.level)
    return tactile_map, [*grid.notes, *notes, *marked]


# --- Cells much finer than any lump, as pixels are: they are averaged before anything is fitted to them.

_FINEST_MM: Final = 0.5  #: In finer cells with correlated errors the fit took noise for lumps, and minutes.


def _average_cells(tactile_map: TactileMap, times: int) -> TactileMap:
    """The map in blocks of `times` by `times` cells, weighted by their readings; a block needs data in half of them."""
    weight = np.where(tactile_map.covered, tactile_map.count, 0).astype(np.float64)
    total = block_sums(weight, times)
    known = block_sums(tactile_map.covered.astype(np.float64), times) >= times**2 / 2
    each = np.where(known, total, np.nan)
    mean = block_sums(weight * np.nan_to_num(tactile_map.mean), times) / each
    squares = np.nan_to_num(tactile_map.variance) + np.nan_to_num(tactile_map.mean) ** 2
    square = block_sums(weight * squares, times) / each
    variance = np.maximum(square - mean**2, 0.0) if tactile_map.counts_known else np.where(known, 0.0, np.nan)
    count = np.where(known, total if tactile_map.counts_known else 1.0, 0.0).astype(np.int64)
    x_mm, y_mm = (axis[::times] + (times - 1) / 2 * np.ptp(axis[:2]) for axis in (tactile_map.x_mm, tactile_map.y_mm))
    recipe = replace(tactile_map.recipe, cell_mm=times * tactile_map.recipe.cell_mm)
    return replace(tactile_map, mean=mean, variance=variance, count=count, x_mm=x_mm, y_mm=y_mm, recipe=recipe)


def _refuse_stretched(tactile_map: TactileMap) -> None:
    """Raise `BadDataError` for values from 0 to the end of a range: their level beside a lump is lost."""
    values = tactile_map.mean[tactile_map.covered]
    if values.min() == 0 and (high := values.max()) in _RANGE_ENDS:
        what = f"values go from 0 to {high:g}, as those stretched to a range do: their level is lost"
        raise BadDataError(what, way_out="give them as measured, or without --normalise and --level for widths alone")


def _divide_by_level(tactile_map: TactileMap, level: float | str) -> TactileMap:
    """The map divided by its level, as maps normalised by gains are; a fitted level is a finding."""
    if isinstance(level, str):  # of a fit about the highest bump; the median where nothing rises
        options = SamplerSettings(method="optimise", background="free")
        fit = estimate_map(tactile_map, calibration=None, options=options, rng=np.random.default_rng(1)).fit
        divisor = float(np.median(tactile_map.mean[tactile_map.covered]) if fit is None else fit.bump.level(fit.theta))
    else:
        divisor = level
    if not divisor > 0:
        raise BadDataError(f"the level is {divisor:.4g}", way_out="subtract the offset of the readings first")
    unit = tactile_map.recipe.units
    by = f"{divisor:.4g}{f' {unit}' if unit else ''}, the level beside the highest bump of the map"
    text = f"values were divided by {by}; what the hand's pressure changed between frames is still in them"
    fitted = (finding("level_fitted", text),) if isinstance(level, str) else ()
    divided = replace(
        tactile_map,
        mean=tactile_map.mean / divisor,
        variance=tactile_map.variance / divisor**2,
        recipe=replace(tactile_map.recipe, normalise="gain", units=""),
        background=1.0,
        findings=(*tactile_map.findings, *fitted),
    )
    median = float(np.median(divided.mean[divided.covered]))
    if not _NORMALISED_MEDIAN[0] <= median <= _NORMALISED_MEDIAN[1]:
        what = f"the median value is {divisor * median:.4g}, not near the level of {divisor:.4g}"
        raise BadDataError(what, way_out="give the level in the values' own unit, or --level fit")
    return divided


def _spacing(grid: Grid, *, stated_mm: float | None) -> tuple[float, list[str]]:
    """Side of the cells in mm, and a note where an image's resolution differs."""
    for sides in (grid.spacing_mm, grid.resolution_mm):
        if sides is not None and not np.isclose(*sides, rtol=1e-3, atol=0.0):
            what = f"its cells are {sides[0]:g} by {sides[1]:g} mm"
            raise BadDataError(what, way_out="resample to square cells first")
    if grid.spacing_mm is not None:
        value, notes = grid.spacing_mm[0], []
        if stated_mm is not None and not np.isclose(stated_mm, value, rtol=1e-9, atol=0.0):
            raise UsageError(f"--spacing-mm is {stated_mm:g}, but the file says {value:g}; leave the option out")
    else:
        mm = grid.resolution_mm[0] if grid.resolution_mm else None
        dots = f" ({25.4 / mm:.4g} dpi, often of a print)" if mm else ""
        resolution_words = f"its resolution says {mm:.4g} mm a pixel{dots}" if mm else ""
        if stated_mm is None:
            resolution_words = resolution_words and f"; {resolution_words}"
            raise UsageError(f"a grid needs --spacing-mm, the side of its square cells in mm{resolution_words}")
        value, agrees = float(stated_mm), mm is None or np.isclose(stated_mm, mm, rtol=1e-2, atol=0.0)
        notes = [] if agrees else [f"{resolution_words}; {stated_mm:g} mm was taken, as stated"]
    if not _LEAST_SPACING_MM <= value < 1000:
        way_out = "looks like metres, give mm" if 0 < value < 1000 else "it must be positive, in mm"
        raise BadDataError(f"the spacing is {value:g} mm", way_out=way_out)
    for step in grid.steps:  # in mm, cm, inches or m
        if not np.isclose(value, step * np.array([1.0, 10.0, 25.4, 1000.0]), rtol=0.01, atol=0.0).any():
            what = f"the spacing is {value:g} mm, and the places of the cells run in steps of {step:g}"
            raise BadDataError(what, way_out="give --spacing-mm the side of the square cells, or leave out the places")
    return value, notes


def _map(arrays: dict[str, np.ndarray[Any, Any]], *, spacing_mm: float, normalise: Normalise, units: str) -> TactileMap:
    """Map of arrays in kPa, or divided by their level, as `normalise` declares.

    Without ``count`` and ``variance`` a value is one reading of variance 0. A variance may be NaN where a
    cell has a single reading: a sample variance, numpy's with ddof=1, does not exist there.
    """
    mean = _numbers(arrays, "mean")
    count_values = _numbers(arrays, "count") if "count" in arrays else np.isfinite(mean).astype(np.float64)
    if index := _first(~((count_values >= 0) & (count_values <= _MOST_READINGS) & (count_values % 1 == 0))):
        raise BadDataError(f"count is {count_values[index]:g} at {index}", way_out="give whole numbers from 0 up")
    count = count_values.astype(np.int64)
    if index := _first((count > 0) & np.isnan(mean)):
        raise BadDataError(f"mean is NaN at {index}, where count is {count[index]}", way_out="set count to 0 there")
    if not count.any():
        raise BadDataError("no cell holds data", way_out="give at least one finite value")
    variance = _numbers(arrays, "variance") if "variance" in arrays else np.zeros(mean.shape)
    if index := _first((count > 0) & ~(variance >= 0) & ~((count == 1) & np.isnan(variance))):
        what = f"variance is {variance[index]:g} at {index}, where count is {count[index]}"
        raise BadDataError(what, way_out="it must not be negative, and NaN (not known) only where count is 0 or 1")
    median, largest = float(np.median(mean[count > 0])), float(np.abs(mean[count > 0]).max())
    if 0 < largest < _SMALLEST:
        raise BadDataError(f"the largest value is {largest:.4g}", way_out="give readings, in kPa or a unit near it")
    if units.strip().lower() == "kpa" and median > _MOST_KPA:
        what = f"the median value is {median:.4g} kPa"
        raise BadDataError(what, way_out="looks like Pa, give --units Pa, or divide by 1000")
    low, high = _NORMALISED_MEDIAN
    if normalise != "none" and not low <= median <= high:
        what = f"the median value is {median:.4g}, not near 1 as --normalise {normalise} says"
        raise BadDataError(what, way_out="divide by the level first, or give its unit and --level fit")
    y_mm, x_mm = ((np.arange(n) - (n - 1) / 2) * spacing_mm for n in mean.shape)
    return TactileMap(
        mean=np.where(count > 0, mean, np.nan),
        variance=np.where(count > 0, variance, np.nan),
        count=count,
        x_mm=x_mm,
        y_mm=y_mm,
        recipe=MapRecipe(source="grid", normalise=normalise, cell_mm=spacing_mm, units=units),
        background=None if normalise == "none" else 1.0,
        frame_count=0,
    )


def _real(array: np.ndarray[Any, Any], *, name: str) -> FloatArray:
    if array.dtype.kind not in "iuf":
        raise BadDataError(f"{name} is {array.dtype}", way_out="give real numbers")
    with np.errstate(invalid="ignore"):  # a signalling NaN is one, too
        return np.asarray(array, dtype=np.float64)


def _numbers(arrays: Mapping[str, np.ndarray[Any, Any]], name: str) -> FloatArray:
    values, shape = _real(arrays[name], name=name), arrays["mean"].shape
    if values.shape != shape:
        raise BadDataError(f"{name} has shape {values.shape}", way_out=f"it must be {shape}, as mean")
    if index := _first(np.isinf(values)):
        raise BadDataError(f"{name} is infinite at {index}", way_out="mark cells without data by NaN")
    return values


def _first(wrong: BoolArray) -> tuple[int, ...]:
    """Index of the first True; empty without one."""
    return tuple(int(i) for i in np.argwhere(wrong)[0]) if wrong.any() else ()
