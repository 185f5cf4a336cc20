"""Text tables as instruments export them: their separator, decimal commas, header and what stands before them."""

from __future__ import annotations

import contextlib
import csv
import re
from collections.abc import Iterable, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

import numpy as np

from tactile_bayes.declarations import Record
from tactile_bayes.errors import BadDataError
from tactile_bayes.files.reading import TABLE_BYTES, decoded, decoding, kind_of, read_bytes
from tactile_bayes.files.tables import may_be_thousands
from tactile_bayes.geometry import FloatArray

_SEPARATORS: Final = {"\t": "tabs", ";": "semicolons", ",": "commas", " ": "blanks"}
_SAMPLED: Final = 300  # lines by which the separator is told
_LEAST_NUMBERS: Final = 0.6  # share of a line's fields that are numbers where it is one of the table
_AS_UTF8: Final = "save it as UTF-8 text"
_AROUND: Final = " \t\"'[](){}"  # of a field, as R and Python print numbers
_TOUCHING: Final = re.compile(r"(\.\d+)(?=[+-]\d+\.\d)")  # numbers of Polhemus, of one width each
_CLOCK: Final = re.compile(r"(?:(\d{1,2}):)?(\d{1,2}):(\d{1,2}(?:\.\d+)?)")
_DATED: Final = re.compile(r"\d{4}-\d{2}-\d{2}[T ]\d{1,2}:\d{2}:\d{2}(\.\d+)?(Z|[+-]\d{2}:?\d{2})?")
_UNIT_OF_TIME: Final = re.compile(r"(?:[\[(_ ]|(?<=time))(ms|us|ns|s|min|msec|µs|secs?|seconds)[\])]?$", re.IGNORECASE)
_DECIMAL_COMMA: Final = re.compile(r"[+-]?[0-9]*,[0-9]+(e[+-]?[0-9]+)?", re.IGNORECASE)
FEWEST_LABELS: Final = 8
"""So many numbers that count 0, 1, 2... or 1, 2, 3... are labels of rows or columns, not readings."""
NO_SENSEL: Final = "B"  #: A cell beside the sensor in Tekscan's files.
_NO_VALUE: Final = ("", "nan", "na", "n/a", "-", "--", NO_SENSEL.lower(), "null")
"""Words for a reading that there is not."""


class Line(Record):
    """One line of a text table that is not blank."""

    number: int  #: From 1.
    text: str
    fields: list[str]
    values: list[float | None]  #: The number of each field, NaN for no value; None where it is anything else.
    after_blank: bool  #: A blank line stands before it.

    @property
    def is_numbers(self) -> bool:
        """Whether each of its fields is a number or no value."""
        return None not in self.values


def number(text: str, *, decimal_comma: bool) -> float | None:
    """A number, a time of day in s, or a date and time in s since 1970; NaN for no value, None for anything else."""
    text = text.strip(_AROUND)
    try:
        return float(text.replace(",", ".") if decimal_comma and _DECIMAL_COMMA.fullmatch(text) else text)
    except ValueError:
        if text.lower() in _NO_VALUE:
            return float("nan")
    if clock := _CLOCK.fullmatch(text.replace(",", ".")):
        return 3600 * int(clock[1] or 0) + 60 * int(clock[2]) + float(clock[3])
    with contextlib.suppress(ValueError):  # of a day that there is not
        if _DATED.fullmatch(text):
            found = datetime.fromisoformat(text)
            return (found if found.tzinfo else found.replace(tzinfo=UTC)).timestamp()
    return None


def read_lines(path: Path) -> list[str]:
    """Lines of a text, UTF-8 or with a byte order mark; a minus sign that is no hyphen is one."""
    data = read_bytes(path, most=TABLE_BYTES)
    if b"\0" in data and (kind := kind_of(path)):
        raise BadDataError(f"is {kind}, not a table of text", way_out="save it as .csv", path=str(path))
    text = decoded(data, path=path, way_out=_AS_UTF8, as_utf8=_AS_UTF8, may_be=("UTF-16",))
    if "\0" in text:
        raise BadDataError("is not text", way_out="give numbers as .npz, .npy, .mat, HDF5 or a table", path=str(path))
    text = text.replace("\r\n", "\n").replace("\r", "\n").replace("\u2212", "-")
    return text.removesuffix("\n").split("\n")


def read_text_table(path: Path, decimal: str | None = None) -> tuple[list[Line], str]:
    """The lines of a text that are not blank, and how their fields are separated: so that most of them are numbers.

    Where no `decimal` (``"point"`` or ``"comma"``) is stated, commas that may separate thousands are refused.
    """
    texts = read_lines(path)
    separator = separator_of(texts)
    if not separator:
        raise BadDataError("holds no table of numbers", way_out="give one frame or pose a line", path=str(path))
    split = []
    for i, one in enumerate(texts, start=1):
        if one.strip():
            fields = fields_of(one.lstrip("# "), separator)  # numpy writes it before names
            if one.lstrip().startswith("#") and any(_is_number(field, ()) for field in fields):
                fields = fields_of(one, separator)
            while len(fields) > 1 and not fields[-1]:
                fields.pop()
            split.append((i, one, fields, i > 1 and not texts[i - 2].strip()))
    way_out = "state which, --decimal comma" if decimal is None else ""
    comma = bool(with_comma((fields for _, _, fields, _ in split), way_out=way_out)) and decimal != "point"
    lines = [
        Line(i, text, fields, [number(one, decimal_comma=comma) for one in fields], after)
        for i, text, fields, after in split
    ]
    return lines, f"fields between {_SEPARATORS[separator]}{', decimal commas' if comma else ''}"


def separator_of(texts: Sequence[str], marks: Sequence[str] = ()) -> str:
    """The separator that makes most numbers of lines and least else; empty where none makes two of any.

    `marks` are words for no value, beside those that are known.
    """
    filled = [one for one in texts if one.strip()]
    sample = filled[:: max(1, len(filled) // _SAMPLED)]
    made = {}  # numbers, and other fields as a negative number, in the lines that it makes lines of a table
    for separator in _SEPARATORS:
        rows = [row for text in sample if _of_numbers(row := fields_of(text, separator), marks)]
        numbers = sum(_is_number(field, marks) for row in rows for field in row)
        made[separator] = numbers, numbers - sum(map(len, rows))
    best = max(made, key=made.__getitem__)
    return best if made[best][0] else ""


def _of_numbers(fields: Sequence[str], marks: Sequence[str]) -> bool:
    """True for a line of a table: two numbers or more, and little else."""
    good = sum(_is_number(field, marks) for field in fields)
    return good > 1 and good >= _LEAST_NUMBERS * len(fields)


def _is_number(text: str, marks: Sequence[str]) -> bool:
    return text in marks or may_be_thousands(text) or number(text, decimal_comma=True) is not None


def fields_of(text: str, separator: str) -> list[str]:
    """Fields of a line without the blanks around them."""
    text = " ".join(_TOUCHING.sub(r"\1 ", text).split()) if separator == " " else text
    with decoding("is not a table of text", way_out="give a table of numbers, such as .csv"):
        return [one.strip() for one in next(csv.reader([text], delimiter=separator, skipinitialspace=True), [])]


def with_comma(rows: Iterable[Sequence[str]], marks: Sequence[str] = (), *, way_out: str) -> list[str]:
    """Fields of the table's lines that are numbers with a decimal comma, or with commas between thousands.

    All of them may not be of the latter, where there is a way out of that.
    """
    fields = (field for row in rows if _of_numbers(row, marks) for field in row)
    commas = [one for one in fields if _DECIMAL_COMMA.fullmatch(one) or may_be_thousands(one)]
    if way_out and commas and all(map(may_be_thousands, commas)):
        first = commas[0]
        what = f"holds {first!r}, which is {first.replace(',', '')} or {first.replace(',', '.', 1)}"
        raise BadDataError(what, way_out=way_out)
    return commas


def counts_up(line: FloatArray) -> bool:
    """True for labels of rows or columns."""
    return len(line) >= FEWEST_LABELS and line[0] in (0.0, 1.0) and bool((np.diff(line) == 1.0).all())


def unit_of_time(name: str) -> str:
    """Unit in the name of a column of times; empty where it says none."""
    found = _UNIT_OF_TIME.search(name.strip())
    unit = found[1].lower() if found else ""
    return {"msec": "ms", "µs": "us", "sec": "s", "secs": "s", "seconds": "s"}.get(unit, unit)
