"""Text tables as instruments export them: their separator, decimal commas, header and what stands before them."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

from tactile_bayes.declarations import Record
from tactile_bayes.errors import BadDataError
from tactile_bayes.files.reading import TABLE_BYTES, decoded, other_encoding, read_bytes
from tactile_bayes.files.tables import DECIMAL_COMMA, may_be_thousands

_SEPARATORS: Final = {"\t": "tabs", ";": "semicolons", ",": "commas", " ": "blanks"}
_SAMPLED: Final = 300  # lines by which the separator is told
_LEAST_NUMBERS: Final = 0.6  # share of a line's fields that are numbers where it is one of the table
_AS_UTF8: Final = "save it as UTF-8 text"
_AROUND: Final = " \t\"'[](){}"  # of a field, as R and Python print numbers
_CLOCK: Final = re.compile(r"(?:(\d{1,2}):)?(\d{1,2}):(\d{1,2}(?:\.\d+)?)")
_DATED: Final = re.compile(r"\d{4}-\d{2}-\d{2}[T ]\d{1,2}:\d{2}:\d{2}(\.\d+)?(Z|[+-]\d{2}:?\d{2})?")
_NO_VALUE: Final = ("", "nan", "na", "n/a", "-", "--", "b", "null")
"""Words for a reading that there is not; ``B`` is a cell beside the sensor in Tekscan's files."""


class Line(Record):
    """One line of a text table that is not blank."""

    number: int  #: From 1.
    text: str
    fields: list[str]
    after_blank: bool = False  #: A blank line stands before it.


class TextTable(Record):
    """A text in lines and fields."""

    lines: list[Line]
    separator: str
    decimal_comma: bool

    @property
    def words(self) -> str:
        """How its fields are separated, in words."""
        return f"fields between {_SEPARATORS[self.separator]}{', decimal commas' if self.decimal_comma else ''}"

    def numbers(self, fields: Sequence[str]) -> list[float] | None:
        """Numbers of a line's fields, NaN where one has no value; None where one is anything else."""
        try:
            return [number(one, decimal_comma=self.decimal_comma) for one in fields]
        except ValueError:
            return None


def number(text: str, *, decimal_comma: bool = False) -> float:
    """A number, a time of day in s, or a date and time in s since 1970; NaN for no value, else a ValueError."""
    text = text.strip(_AROUND)
    try:
        return float(text.replace(",", ".") if decimal_comma and DECIMAL_COMMA.match(text) else text)
    except ValueError:
        if text.lower() in _NO_VALUE:
            return float("nan")
    if _DATED.fullmatch(text):
        found = datetime.fromisoformat(text)
        return (found if found.tzinfo else found.replace(tzinfo=UTC)).timestamp()
    if clock := _CLOCK.fullmatch(text.replace(",", ".")):
        return 3600 * int(clock[1] or 0) + 60 * int(clock[2]) + float(clock[3])
    raise ValueError(text)


def read_text_table(path: Path, decimal: str | None = None) -> TextTable:
    """Read the lines of a text, UTF-8 or with a byte order mark; the separator is the one that makes numbers of them.

    Parameters
    ----------
    decimal
        ``"point"`` or ``"comma"`` where it is stated.

    Raises
    ------
    BadDataError
        When it is no text, or has no table of numbers, or commas that may separate thousands or decimals.
    """
    data = read_bytes(path, most=TABLE_BYTES)
    other = other_encoding(data)
    if other not in ("", "UTF-16"):
        raise BadDataError(f"is {other} text", way_out=_AS_UTF8, path=str(path))
    text = decoded(data, path=path, way_out=_AS_UTF8, encoding=other.lower() or "utf-8-sig")
    if "\0" in text:
        raise BadDataError("is not text", way_out="give frames as .npz, .npy, .mat, HDF5 or a table", path=str(path))
    texts = [(i, one) for i, one in enumerate(text.splitlines(), start=1) if one.strip()]
    separator = max(_SEPARATORS, key=lambda one: _numbers_by(one, texts))
    if not _numbers_by(separator, texts):
        raise BadDataError("holds no table of numbers", way_out="give one frame or pose a line", path=str(path))
    lines, before = [], 0
    for i, one in texts:
        lines.append(Line(i, one, _fields(one, separator), after_blank=i > before + 1))
        before = i
    commas = [f for line in lines for f in line.fields if DECIMAL_COMMA.fullmatch(f)] if separator != "," else []
    if decimal is None and commas and all(map(may_be_thousands, commas)):
        what = f"holds {commas[0]!r}, which is {commas[0].replace(',', '')} or {commas[0].replace(',', '.')}"
        raise BadDataError(what, way_out="state which, --decimal comma", path=str(path))
    return TextTable(lines, separator, decimal != "point" and bool(commas))


def _numbers_by(separator: str, texts: Sequence[tuple[int, str]]) -> int:
    """Numbers in the lines that a separator makes lines of a table, of a sample of all."""
    found = 0
    for _, text in texts[:: max(1, len(texts) // _SAMPLED)]:
        fields = _fields(text, separator)
        good = sum(_is_number(one, decimal_comma=separator != ",") for one in fields)
        found += good if good > 1 and good >= _LEAST_NUMBERS * len(fields) else 0
    return found


def _is_number(text: str, *, decimal_comma: bool) -> bool:
    try:
        return number(text, decimal_comma=decimal_comma) is not None
    except ValueError:
        return False


def _fields(text: str, separator: str) -> list[str]:
    """Fields without the blanks around them, and without an empty one after a separator at the line's end."""
    if separator == " ":
        return text.split()
    fields = [one.strip() for one in next(csv.reader(io.StringIO(text, newline=""), delimiter=separator), [])]
    while len(fields) > 1 and not fields[-1]:
        fields.pop()
    return fields
