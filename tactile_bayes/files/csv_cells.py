"""Cells of a CSV file as text: its encoding, its separator, its quotes, and the decimal commas of spreadsheets.

Spreadsheets set to the language of many countries save semicolons between the cells and commas in the numbers. The
first lines tell the separator; a comma inside a number is a decimal comma only where it separates no cells.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from tactile_bayes.errors import BadDataError
from tactile_bayes.files.kinds import ZIP_MAGIC
from tactile_bayes.files.reading import TABLE_BYTES, decoded, read_bytes

DECIMAL_COMMA: Final = re.compile(r"[+-]?[0-9]+,[0-9]+")
_QUOTED: Final = re.compile(r'"[^"]*"')
_BYTE_ORDER_MARKS: Final = (b"\xff\xfe", b"\xfe\xff")
_AS_UTF8: Final = "save it as CSV UTF-8"
_EXPORT: Final = "export the sheet as CSV UTF-8"
_NOT_TEXT: Final = (
    (_BYTE_ORDER_MARKS, "is UTF-16 text", _AS_UTF8),
    ((ZIP_MAGIC,), "is a spreadsheet or another zip archive (xlsx, ods), not CSV", _EXPORT),
    ((b"\xd0\xcf\x11\xe0",), "is an old Office file (xls), not CSV", _EXPORT),
    ((b"\x1f\x8b",), "is compressed with gzip", "decompress it first"),
)
"""First bytes of files that are no UTF-8 text, what they are, and the way out."""


@dataclass(frozen=True, slots=True)
class Cells:
    """A CSV file's rows that are not blank.

    Parameters
    ----------
    header
        Cells of the first of them; none where there is none.
    body
        The others, each with the line on which it begins.
    separator
        Between the cells.
    decimal_comma
        Whether numbers are written as 12,5.
    """

    header: list[str]
    body: list[tuple[int, list[str]]]
    separator: str = ","
    decimal_comma: bool = False


def read_text(path: Path) -> str:
    """Text of a CSV file in UTF-8, with or without a byte order mark.

    Raises
    ------
    BadDataError
        When it is something else; spreadsheets and other encodings are named.
    """
    data = read_bytes(path, most=TABLE_BYTES)
    for marks, what, way_out in _NOT_TEXT:
        if data.startswith(marks):
            raise BadDataError(what, way_out=way_out, path=str(path))
    return decoded(data, path=path, way_out=_AS_UTF8, encoding="utf-8-sig")


def cells_of(path: Path, text: str) -> Cells:
    """Split CSV text into cells; columns without a name or any filled cell are left out.

    Raises
    ------
    BadDataError
        Naming the line where it is not CSV.
    """
    separator = separator_in(text)
    rows = _rows(path, text, separator)
    if not rows:
        return Cells([], [], separator)
    (_, header), *body = rows
    header, body = _without_blank_columns(header, body)
    return Cells(header, body, separator, separator != "," and _has_decimal_commas(body))


def separator_in(text: str) -> str:
    """Comma, semicolon or tab: one of which the first two lines have as many outside quotes, else most in the first.

    So names like ``size (cm, by pathology)`` do not make a table with semicolons one with commas.
    """
    first, second, *_ = (_QUOTED.sub("", line) for line in [*text.lstrip("\r\n").split("\n", 2), "", ""])

    def trust(separator: str) -> tuple[bool, int]:
        count = first.count(separator)
        return 0 < count == second.count(separator), count

    return max(",;\t", key=trust)


def may_be_thousands(number: str) -> bool:
    """Whether the comma of a number may separate thousands as well as decimals: 1,234 but not 0,234 or 1,23."""
    whole, _, rest = number.partition(",")
    return len(rest) == 3 and not whole.lstrip("+-").startswith("0")


def _rows(path: Path, text: str, separator: str) -> list[tuple[int, list[str]]]:
    """Rows that are not blank, each with its first line number."""
    reader = csv.reader(io.StringIO(text, newline=""), delimiter=separator, strict=True)
    rows: list[tuple[int, list[str]]] = []
    before = 0
    try:
        for cells in reader:
            if any(cells):
                rows.append((before + 1, cells))
            before = reader.line_num
    except csv.Error as error:
        way_out = "check the quotes and line ends around it"
        raise BadDataError(f"line {before + 1}: not CSV ({error})", way_out=way_out, path=str(path)) from None
    return rows


def _without_blank_columns(
    header: list[str], body: Sequence[tuple[int, list[str]]]
) -> tuple[list[str], list[tuple[int, list[str]]]]:
    """Header and rows without the blank columns that a spreadsheet writes to the right of its table."""
    end = len(header)
    while end and not header[end - 1] and not any(cell for _, cells in body for cell in cells[end - 1 :]):
        end -= 1
    if end == len(header):
        return header, list(body)
    return header[:end], [(line, cells[:end]) for line, cells in body]


def _has_decimal_commas(body: Sequence[tuple[int, list[str]]]) -> bool:
    """Whether some cell can be read as a number with a decimal comma alone."""
    cells = (cell.strip() for _, row in body for cell in row)
    return any(DECIMAL_COMMA.fullmatch(cell) and not may_be_thousands(cell) for cell in cells)
