"""A grid of numbers in a text table, as programs and spreadsheets write it.

Fields are separated by semicolons where the file has one, else by tabs where it has one, else by commas. With
semicolons or tabs a comma is a decimal comma, as a spreadsheet writes it under the settings of many countries.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Final

import numpy as np

from tactile_bayes.errors import BadDataError
from tactile_bayes.files.reading import TABLE_BYTES, decoding, read_bytes
from tactile_bayes.geometry import FloatArray

_WAY_OUT: Final = "give a table of numbers, such as .csv"
_UTF_16: Final = (b"\xff\xfe", b"\xfe\xff")
_THOUSANDS: Final = re.compile(r"[+-]?[1-9][0-9]{0,2}(,[0-9]{3})+")
_MOST_COUNTED: Final = 8
"""A first row or column of so many numbers that counts 0, 1, 2... or 1, 2, 3... holds labels, whatever its corner."""


def read_table(path: Path) -> FloatArray:
    """Read a table as an (ny, nx) array, NaN where a field is empty.

    Raises
    ------
    BadDataError
        Naming the row and column, what it holds and the way out.
    """
    text = _text(path)
    separator = next((one for one in ";\t" if one in text), ",")
    with decoding("is not a table of text", way_out=_WAY_OUT):
        rows = list(csv.reader(io.StringIO(text, newline=""), delimiter=separator))
    rows = _one_block(rows)
    if separator != ",":
        rows = _with_points(rows)
    values = [[_number(field, i, j) for j, field in enumerate(row, 1)] for i, row in enumerate(rows, 1)]
    for number, row in enumerate(values, start=1):
        if len(row) != len(values[0]):
            what = f"row {number} has {len(row)} fields, row 1 has {len(values[0])}"
            raise BadDataError(what, way_out="give every row one length")
    table: FloatArray = np.array(values)
    _refuse_labels(table)
    return table


def _text(path: Path) -> str:
    data = read_bytes(path, most=TABLE_BYTES)
    encoding = "utf-16" if data[:2] in _UTF_16 else "utf-8-sig"
    try:
        return data.decode(encoding)
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        what = f"line {line}: byte 0x{data[error.start]:02x} is not {encoding[:6].upper().rstrip('-')} text"
        raise BadDataError(what, way_out=_WAY_OUT) from None


def _one_block(rows: Sequence[list[str]]) -> list[list[str]]:
    """The rows without blank lines before and after them; blank lines between them separate tables, not rows."""
    held = [number for number, row in enumerate(rows) if len(row) > 1 or any(field.strip() for field in row)]
    if not held:
        raise BadDataError("is empty", way_out=_WAY_OUT)
    gap = next((one for one, after in pairwise(held) if after > one + 1), None)
    if gap is not None:
        raise BadDataError(
            f"has a blank line after row {gap - held[0] + 1}",
            way_out="give one grid, such as one frame or a mean of frames, in a file",
        )
    return list(rows[held[0] : held[-1] + 1])


def _with_points(rows: Sequence[list[str]]) -> list[list[str]]:
    """The rows with decimal points in place of decimal commas."""
    commas = [field.strip() for row in rows for field in row if "," in field]
    if commas and all(_THOUSANDS.fullmatch(field) for field in commas):
        digits = commas[0].replace(",", "")
        what = f"holds {commas[0]!r}, which is {digits} or {commas[0].replace(',', '.', 1)}"
        raise BadDataError(what, way_out="write numbers without commas")
    return [[field.replace(",", ".") if field.count(",") == 1 else field for field in row] for row in rows]


def _number(text: str, row: int, column: int) -> float:
    try:
        return float(text) if text.strip() else np.nan
    except ValueError:
        what = f"row {row}, column {column} holds {text.strip()[:30]!r}"
        raise BadDataError(what, way_out="give numbers only, without a header") from None


def _refuse_labels(table: FloatArray) -> None:
    """Refuse numbers of rows and columns, or their places, in the first row and column: they are no readings."""
    row, column = table[0], table[:, 0]
    both = np.isnan(table[0, 0]) and _evenly(row[1:]) and _evenly(column[1:])
    for found, line, where in ((both, row[1:], "row 1 and column 1"), (_counts(row), row, "row 1")):
        if found:
            _refuse(line, where)
    if _counts(column):
        _refuse(column, "column 1")


def _refuse(line: FloatArray, where: str) -> None:
    told = ", ".join(f"{value:g}" for value in line[:3])
    way_out = "save the grid without them (pandas: to_csv(..., header=False, index=False))"
    raise BadDataError(f"{where} count {told}... as labels do", way_out=way_out)


def _evenly(line: FloatArray) -> bool:
    """Whether three numbers or more run in equal steps."""
    steps = np.diff(line)
    return len(line) > 2 and bool(steps[0] != 0.0) and bool(np.allclose(steps, steps[0], rtol=1e-6, atol=0.0))


def _counts(line: FloatArray) -> bool:
    return len(line) >= _MOST_COUNTED and line[0] in (0.0, 1.0) and bool((np.diff(line) == 1.0).all())
