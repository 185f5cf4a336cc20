"""Tables of text: CSV under a schema, and tables of numbers as instruments export them."""

from __future__ import annotations

import contextlib
import csv
import difflib
import io
import math
import operator
import re
import unicodedata
from collections.abc import Callable, Iterable, Mapping, Sequence
from datetime import UTC, date, datetime
from pathlib import Path
from typing import Any, Final

import numpy as np

from tactile_bayes.declarations import Record, short_repr
from tactile_bayes.errors import BadDataError, in_file
from tactile_bayes.files.documents import load_schema
from tactile_bayes.files.reading import TABLE_BYTES, ZIP_MAGIC, decoded, decoding, first_bytes, kind_of, read_bytes
from tactile_bayes.findings import counted
from tactile_bayes.geometry import FloatArray
from tactile_bayes.presets import MM_PER_UNIT

# --- Cells of a CSV file as text: its encoding, its separator, its quotes, and the decimal commas of spreadsheets.
#
# Spreadsheets set to the language of many countries save semicolons between the cells and commas in the numbers.
# The first lines tell the separator; a comma inside a number is a decimal comma only where it separates no cells.

DECIMAL_COMMA: Final = re.compile(r"[+-]?[0-9]+,[0-9]+")
_THOUSANDS: Final = re.compile(r"[+-]?[1-9][0-9]{0,2}(,[0-9]{3})+")
_QUOTED: Final = re.compile(r'"[^"]*"')
_AS_UTF8: Final = "save it as CSV UTF-8"
_MOST_HEADER: Final = 4096  # bytes
_EXPORT: Final = "export the sheet as CSV UTF-8"
_NOT_TEXT: Final = (
    (ZIP_MAGIC, "is a spreadsheet or another zip archive (xlsx, ods), not CSV", _EXPORT),
    (b"\xd0\xcf\x11\xe0", "is an old Office file (xls), not CSV", _EXPORT),
    (b"\x1f\x8b", "is compressed with gzip", "decompress it first"),
    (b"{\n", "is JSON, not CSV", "give the table"),
)
"""First bytes of files that are no UTF-8 text, what they are, and the way out."""


def read_text(path: Path) -> str:
    """Text of a CSV file in UTF-8, with or without a byte order mark."""
    data = read_bytes(path, most=TABLE_BYTES)
    for magic, what, way_out in _NOT_TEXT:
        if data.startswith(magic):
            raise BadDataError(what, way_out=way_out, path=str(path))
    return decoded(data, path=path, way_out=_AS_UTF8, as_utf8=_AS_UTF8)


def _split_cells(path: Path, text: str) -> RawTable:
    """Split CSV text into cells; blank rows, and columns without a name or any filled cell, are left out."""
    separator = csv_separator(text)
    reader = csv.reader(io.StringIO(text, newline=""), delimiter=separator, strict=True)
    rows: list[tuple[int, list[str]]] = []
    before = 0
    try:
        for cells in reader:
            if any(map(str.strip, cells)):
                rows.append((before + 1, cells))
            before = reader.line_num
    except csv.Error as error:
        what = f"line {before + 1}: not CSV ({error})"
        raise BadDataError(what, way_out="check the quotes and line ends around it") from None
    (_, header), *body = rows or [(1, [])]
    end = len(header)
    while end and not header[end - 1] and not any(cell for _, cells in body for cell in cells[end - 1 :]):
        end -= 1
    if end < len(header):
        header, body = header[:end], [(line, cells[:end]) for line, cells in body]
    commas = (cell for _, row in body for cell in map(str.strip, row) if DECIMAL_COMMA.fullmatch(cell))
    return RawTable(path, header, body, separator, separator != "," and not all(map(may_be_thousands, commas)))


def csv_separator(text: str) -> str:
    """Separator of CSV text: of comma, semicolon and tab the most frequent in the first line, outside quotes.

    One that the second line has as often goes first: commas in names like ``size (cm, by pathology)`` do not count.
    """
    first, second, *_ = (_QUOTED.sub("", line) for line in [*text.lstrip("\r\n").split("\n", 2), "", ""])

    def rank(separator: str) -> tuple[bool, int]:
        count = first.count(separator)
        return 0 < count == second.count(separator), count

    return max(",;\t", key=rank)


def header_of(source: Path | Sheet) -> list[str]:
    """Names in a table's first line; empty where that is no CSV."""
    text = (
        source.text if isinstance(source, Sheet) else first_bytes(source, _MOST_HEADER).decode("utf-8-sig", "replace")
    )
    with contextlib.suppress(csv.Error):
        return [name.strip() for name in next(csv.reader(io.StringIO(text), delimiter=csv_separator(text)), [])]
    return []


def composed(text: str) -> str:
    """A name or code in Unicode NFC: programs write an accented letter as one character or as two."""
    return unicodedata.normalize("NFC", text)


def may_be_thousands(number: str) -> bool:
    """True when the comma of a number may separate thousands as well as decimals: 1,234; not 0,234, 1,23, 1234,567."""
    return _THOUSANDS.fullmatch(number) is not None


# --- Reading of comma-separated tables under a Table Schema, with each bad cell named in one line.
#
# Nothing is guessed or repaired. Each fault is one `BadDataError` naming the file, the line, the column, the value
# and what to do. Two properties of a field go beyond the Table Schema standard: ``"column": "required"`` (the
# column must be there although its cells may be blank) and ``ifZero`` (the question when a cell that must exceed 0
# holds 0). So does one of a schema: ``wide`` (how tables with other columns are read).

_NUMBER = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?")
_DATE = re.compile(r"[0-9]{4}-[0-9]{2}-[0-9]{2}")
_INTEGER = re.compile(r"[+-]?[0-9]+")
_IN_MM = re.compile(r"\b(size|sd|low|high|ex_vivo|ex_vivo_second)_mm\b")
_NOT_FINITE = {"nan", "inf", "infinity"}


class Sheet(Record):
    """A table without a file: CSV text with a name for its errors."""

    name: Path
    text: str


class Table(Record):
    """A validated table, column by column."""

    path: Path  #: Where it was read.
    columns: dict[str, list[Any]]
    """A list for each column of the schema, in the schema's order and of the schema's type: str, float, int, bool or
    date. A blank cell is None, and so is each cell of an optional column that the file leaves out.
    """
    line_numbers: list[int]  #: The line of the file at which each row begins; the header is line 1.
    called: Sequence[Mapping[str, str]] = ()
    """What the file calls the columns of each row, where it calls them otherwise."""

    def __len__(self) -> int:
        return len(self.line_numbers)

    def error(self, row: int, column: str, what: str, *, way_out: str) -> BadDataError:
        """Error for a cell that is wrong beyond its schema, in the reader's words and columns; rows count from 0."""
        if self.called:
            names = self.called[row]
            column = " + ".join(dict.fromkeys(map(names.__getitem__, column.split(" + "))))
            what, way_out = (_IN_MM.sub(lambda name: names[name[0]], text) for text in (what, way_out))
        return _fault(self.line_numbers[row], column, what, way_out=way_out).with_path(self.path)


def read_table(source: Path | Sheet, schema_name: str, *, may_be_empty: bool = False) -> Table:
    """Read a CSV file under the Table Schema ``data_schema/SCHEMA_NAME`` (``trial.table.json``...).

    The file is UTF-8, with or without a byte order mark. Between the cells are commas, semicolons or tabs, and with the
    last two a number may have a decimal comma. Blank lines are skipped, and so are rows without a filled cell and
    columns without a name or a filled cell, which spreadsheets write.
    """
    schema = load_schema(schema_name)
    fields = {field["name"]: field for field in schema["fields"]}
    path, text = (source.name, source.text) if isinstance(source, Sheet) else (source, read_text(source))
    columns: dict[str, list[Any]] = {name: [] for name in fields}
    keys = schema.get("primaryKey", [])
    with in_file(path):
        raw = _split_cells(path, text)
        header, body = raw.header, raw.body
        if not header:
            raise BadDataError("is empty", way_out=f"its first line must name columns: {_names(fields)}")
        _check_header(header, fields, wide=schema.get("wide", ""))
        if not body and not may_be_empty:
            raise BadDataError("holds a header and no rows", way_out="add at least one row")
        for line, cells in body:
            _check_length(line, cells, header)
            row = dict(zip(header, cells, strict=True))
            row |= {name: composed(row.get(name, "")) for name in keys}
            for name, field in fields.items():
                columns[name].append(_cell(line, row.get(name, ""), field, decimal_comma=raw.decimal_comma))
    table = Table(path=path, columns=columns, line_numbers=[line for line, _ in body])
    check_unique(table, keys)
    return table


def check_unique(table: Table, keys: Sequence[str], *, way_out: str = "remove one row or correct its key") -> None:
    """Refuse two rows with the same values in the columns `keys`."""
    first: dict[tuple[Any, ...], int] = {}
    for row, key in enumerate(zip(*(table.columns[name] for name in keys), strict=True)):
        if (before := first.setdefault(key, row)) != row:
            shown = " + ".join(short_repr(str(part)) for part in key)
            what = f"{shown} stands on line {table.line_numbers[before]} already"
            raise table.error(row, " + ".join(keys), what, way_out=way_out)


class RawTable(Record):
    """A CSV table under no schema: its rows that are not blank."""

    path: Path  #: Where it was read.
    header: list[str]  #: Cells of the first row; none where there is none.
    body: list[tuple[int, list[str]]]  #: The others, each with the line at which it begins.
    separator: str  #: Between the cells.
    decimal_comma: bool  #: True when numbers are written as 12,5.

    @property
    def rows(self) -> list[dict[str, str]]:
        """Cells of the body without blanks around them, by their columns."""
        return [dict(zip(self.header, map(str.strip, cells), strict=True)) for _, cells in self.body]

    def error(self, line: int, column: str, what: str, *, way_out: str) -> BadDataError:
        """Error for a cell; lines count from 1."""
        return _fault(line, column, what, way_out=way_out).with_path(self.path)

    def cell(self, line: int, column: str, text: str, field: Mapping[str, Any]) -> Any:
        """Parse a cell by a field of a schema, which this table calls `column`; None where it is blank."""
        with in_file(self.path):
            return _cell(line, text, {**field, "name": column}, decimal_comma=self.decimal_comma)


def read_raw(path: Path) -> RawTable:
    """Read the cells of any CSV table as text; for the errors see `read_table`."""
    with in_file(path):
        table = _split_cells(path, read_text(path))
        if not table.body:
            raise BadDataError("holds no rows", way_out="give a header and at least one row")
        for name in table.header:
            if table.header.count(name) > 1:
                raise _fault(1, name, "appears more than once", way_out="keep one of them")
        for line, row in table.body:
            _check_length(line, row, table.header)
    return table


def csv_text(names: Sequence[str], rows: Iterable[Iterable[object]], *, digits: int | None = None) -> str:
    """CSV text of rows below their names, with cells of `csv_cell`."""
    out = io.StringIO(newline="")
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(names)
    writer.writerows([csv_cell(value, digits) for value in row] for row in rows)
    return out.getvalue()


def csv_cell(value: object, digits: int | None = None) -> str:
    """Text of a cell as `read_table` takes it: None is blank; floats have all digits, or so many significant ones."""
    if value is None:
        return ""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float):
        return repr(value) if digits is None else f"{value:.{digits}g}"
    return "".join(letter if letter.isprintable() else ascii(letter)[1:-1] for letter in str(value).strip())


def _check_header(header: Sequence[str], fields: Mapping[str, Any], *, wide: str) -> None:
    for name in header:
        if name not in fields:
            advice = _advice_on_column(name, header, fields) + (f", or {wide}" if wide else "")
            raise _fault(1, name, "is not known here", way_out=advice)
        if header.count(name) > 1:
            raise _fault(1, name, "appears more than once", way_out="keep one of them")
    needed = [name for name, field in fields.items() if _is_required(field) or field.get("column") == "required"]
    if missing := [name for name in needed if name not in header]:
        first, *others = (fields[name]["description"].rstrip(".") for name in missing)
        also = "".join(f"; and {name}: {words}" for name, words in zip(missing[1:], others, strict=True))
        raise _fault(1, missing[0], "is missing", way_out=f"add it: {first}{also}")


def _advice_on_column(name: str, header: Sequence[str], fields: Mapping[str, Any]) -> str:
    """Way out for an unknown column: give the other table (trial and excision exchanged), or correct the name."""
    for kind, contents in (("trial", "readings"), ("excision", "sizes after excision")):
        known = {field["name"]: field for field in load_schema(f"{kind}.table.json")["fields"]}
        needed = {name for name, field in known.items() if _is_required(field)}
        if list(known) != list(fields) and needed <= set(header) <= set(known):
            return f"this is a trial's table of {contents}: give the one with the columns {_names(fields)}"
    if set(fields).isdisjoint(header):
        return f"the first line names the columns, which are {_names(fields)}"
    name = name.strip().lower()
    stem, _, unit = name.rpartition("_")
    if unit in MM_PER_UNIT and unit != "mm" and f"{stem}_mm" in fields:
        return f"convert it to {stem}_mm (multiply by {MM_PER_UNIT[unit]:g})"
    columns_left = [field for field in fields if field not in header]
    if f"{name}_mm" in columns_left:
        return f"did you mean {name}_mm, in millimetres?"
    near = difflib.get_close_matches(name, columns_left, n=1, cutoff=0.7)
    return f"did you mean {near[0]}?" if near else f"remove it; the columns are {_names(fields)}"


def _check_length(line: int, cells: Sequence[str], header: Sequence[str]) -> None:
    if len(cells) == len(header):
        return
    way_out = "give every row a cell for each column"
    if len(cells) > len(header):
        way_out += " (a decimal comma? write 12.5, not 12,5)"
    what = f"line {line}: {counted(len(cells), 'cell')} under {len(header)} columns"
    raise BadDataError(what, way_out=way_out)


def _cell(line: int, text: str, field: Mapping[str, Any], *, decimal_comma: bool) -> Any:
    """Value of a cell; an error names its line and column."""
    try:
        return _parse_cell(text, field, decimal_comma=decimal_comma)
    except BadDataError as error:
        raise _fault(line, field["name"], error.what, way_out=error.way_out) from None


def _parse_cell(text: str, field: Mapping[str, Any], *, decimal_comma: bool) -> Any:
    """Value of a cell by its field's type and rules; None where it is blank and may be."""
    if text == "":
        if _is_required(field):
            raise BadDataError("is blank", way_out=field.get("ifZero", f"fill it in: {field['description']}"))
        return None
    if text != text.strip() or not text.isprintable():
        what = f"{short_repr(text)} has blanks or unprintable characters around or in it"
        raise BadDataError(what, way_out="remove them")
    if decimal_comma and field["type"] == "number":
        if "." in text:  # thousands?
            what = f"{short_repr(text)} has a point, and other numbers have decimal commas"
            raise BadDataError(what, way_out="write all numbers one way")
        text = text.replace(",", ".") if DECIMAL_COMMA.fullmatch(text) else text
    value = _parse_by_type(text, field)
    rules = field.get("constraints", {})
    if value == 0 and "exclusiveMinimum" in rules and "ifZero" in field:
        raise BadDataError("is 0", way_out=field["ifZero"])
    for rule, (holds, words) in _LIMITS.items():
        if rule in rules and not holds(value, rules[rule]):
            what = f"{short_repr(text)} is not {words} {rules[rule]}"
            raise BadDataError(what, way_out=f"correct it: {field['description']}")
    if "enum" in rules and value not in rules["enum"]:
        near = difflib.get_close_matches(text.lower(), rules["enum"], n=1)
        guess = f"did you mean {near[0]}? it must be" if near else "it must be"
        raise BadDataError(f"{short_repr(text)} is not known", way_out=f"{guess} {' or '.join(rules['enum'])}")
    if "pattern" in rules and not re.fullmatch(rules["pattern"], text):
        small = text.lower() if re.fullmatch(rules["pattern"], text.lower()) else ""
        way_out = f"write {small}, in small letters" if small else f"correct it: {field['description']}"
        raise BadDataError(f"{short_repr(text)} is too long or has letters that may not be there", way_out=way_out)
    return value


_LIMITS: Final[Mapping[str, tuple[Callable[[Any, Any], bool], str]]] = {
    "minimum": (operator.ge, "at least"),
    "exclusiveMinimum": (operator.gt, "above"),
    "maximum": (operator.le, "at most"),
    "exclusiveMaximum": (operator.lt, "below"),
}


def _parse_by_type(text: str, field: Mapping[str, Any]) -> Any:
    """Value of a cell by the type of its field."""
    match field["type"]:
        case "string":
            return text
        case "number":
            return _parse_number(text, field)
        case "integer":
            if _INTEGER.fullmatch(text) and len(text) <= 15:
                return int(text)
            what, way_out = "is not a whole number", f"write it as 1, 2, 3; {_blank_advice(field)}"
        case "date":
            with contextlib.suppress(ValueError):  # of a day that does not exist
                if _DATE.fullmatch(text):
                    return date.fromisoformat(text)
            what, way_out = "is no date", f"write it as 2026-03-01; {_blank_advice(field)}"
        case _:
            for value, words in ((True, field["trueValues"]), (False, field["falseValues"])):
                if text in words:
                    return value
            what, way_out = "is neither true nor false", "write true or false"
    raise BadDataError(f"{short_repr(text)} {what}", way_out=way_out)


def _parse_number(text: str, field: Mapping[str, Any]) -> float:
    if _NUMBER.fullmatch(text):
        value = float(text)
        if math.isfinite(value):
            return value
    if text.lstrip("+-").lower() in _NOT_FINITE or _NUMBER.fullmatch(text):
        raise BadDataError(f"{short_repr(text)} is not a finite number", way_out=_blank_advice(field))
    if DECIMAL_COMMA.fullmatch(text):
        whole, _, rest = text.partition(",")
        if may_be_thousands(text):
            what = f"{short_repr(text)} has a comma that may separate thousands or decimals"
            raise BadDataError(what, way_out=f"write {whole}{rest} or {whole}.{rest}, whichever is meant")
        raise BadDataError(f"{short_repr(text)} has a decimal comma", way_out=f"write {whole}.{rest}")
    if text[0] in "<>≤≥":
        what = f"{short_repr(text)} is a bound, not a number"
        raise BadDataError(what, way_out="give the number measured, or leave it out")
    if text.endswith("%"):
        way_out = "write the number that is meant without it, as 12.5 or 0.125"
        raise BadDataError(f"{short_repr(text)} has a percent sign", way_out=way_out)
    digits = f"write digits only{' in mm' if field['name'].endswith('_mm') else ''}"
    raise BadDataError(f"{short_repr(text)} is not a number", way_out=f"{digits}; {_blank_advice(field)}")


def _is_required(field: Mapping[str, Any]) -> bool:
    return bool(field.get("constraints", {}).get("required", False))


def _blank_advice(field: Mapping[str, Any]) -> str:
    return "correct it" if _is_required(field) else "leave the cell blank if there is none"


def _names(fields: Mapping[str, Any]) -> str:
    return ", ".join(name if _is_required(field) else f"[{name}]" for name, field in fields.items())


def _fault(line: int, column: str, what: str, *, way_out: str) -> BadDataError:
    shown = column if re.fullmatch(r"\w+( \+ \w+)*", column) and len(column) <= 60 else short_repr(column)
    return BadDataError(f"line {line}, column {shown}: {what}", way_out=way_out)


# --- Text tables as instruments export them: their separator, decimal commas, header and what stands before them.

_TEXT_AS_UTF8: Final = "save it as UTF-8 text"
_SEPARATORS: Final = {"\t": "tabs", ";": "semicolons", ",": "commas", " ": "blanks"}
_SAMPLED: Final = 300  # lines by which the separator is chosen
_LEAST_NUMBERS: Final = 0.6  # share of numbers among the fields of a row of numbers
_AROUND: Final = " \t\"'[](){}"  # of a field, as R and Python print numbers
_TOUCHING: Final = re.compile(r"(\.\d+)(?=[+-]\d+\.\d)")  # numbers of Polhemus, of one width each
_CLOCK: Final = re.compile(r"(?:(\d{1,2}):)?(\d{1,2}):(\d{1,2}(?:\.\d+)?)")
_DATED: Final = re.compile(r"\d{4}-\d{2}-\d{2}[T ]\d{1,2}:\d{2}:\d{2}(\.\d+)?(Z|[+-]\d{2}:?\d{2})?")
_UNIT_OF_TIME: Final = re.compile(r"(?:[\[(_ ]|(?<=time))(ms|us|ns|s|min|msec|µs|secs?|seconds)[\])]?$", re.IGNORECASE)
_ANY_DECIMAL_COMMA: Final = re.compile(r"[+-]?[0-9]*,[0-9]+(e[+-]?[0-9]+)?", re.IGNORECASE)
FEWEST_LABELS: Final = 8  #: From so many on, numbers that count up are labels of rows or columns, not readings.
NO_SENSEL: Final = "B"  #: A cell beside the sensor in Tekscan's files.
_NO_VALUE: Final = ("", "nan", "na", "n/a", "-", "--", NO_SENSEL.lower(), "null")  #: Words for a missing reading.


class Line(Record):
    """One line of a text table that is not blank."""

    number: int  #: From 1.
    text: str
    fields: list[str]
    values: list[float | None]  #: The number of each field, NaN for no value; None where it is anything else.
    after_blank: bool  #: True after a blank line.

    @property
    def is_numbers(self) -> bool:
        """True if each field is a number or no value."""
        return None not in self.values


def number(text: str, *, decimal_comma: bool) -> float | None:
    """A number, a time of day in s, or a date and time in s since 1970; NaN for no value, None for anything else."""
    text = text.strip(_AROUND)
    decimal_comma = decimal_comma and "," in text and _ANY_DECIMAL_COMMA.fullmatch(text) is not None
    try:
        return float(text.replace(",", ".") if decimal_comma else text)
    except ValueError:
        if text.lower() in _NO_VALUE:
            return float("nan")
    if clock := _CLOCK.fullmatch(text.replace(",", ".")):
        return 3600 * int(clock[1] or 0) + 60 * int(clock[2]) + float(clock[3])
    with contextlib.suppress(ValueError):  # of a day that there is not
        if _DATED.fullmatch(text):
            moment = datetime.fromisoformat(text)
            return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()
    return None


def read_lines(source: Path | Sheet) -> list[str]:
    """Lines of a text in UTF-8, or in UTF-16 with a byte order mark; the minus sign U+2212 becomes a hyphen."""
    if isinstance(source, Sheet):
        return source.text.splitlines()
    data = read_bytes(source, most=TABLE_BYTES)
    if b"\0" in data and (kind := kind_of(source)):
        raise BadDataError(f"is {kind}, not a table of text", way_out="save it as .csv", path=str(source))
    text = decoded(data, path=source, way_out=_TEXT_AS_UTF8, as_utf8=_TEXT_AS_UTF8, may_be=("UTF-16",))
    if "\0" in text:
        raise BadDataError("is not text", way_out="give numbers as .npz, .npy, .mat, HDF5 or a table", path=str(source))
    text = text.replace("\r\n", "\n").replace("\r", "\n").replace("\u2212", "-")
    return text.removesuffix("\n").split("\n")


def read_text_table(source: Path | Sheet, decimal: str | None = None) -> tuple[list[Line], str]:
    """Lines of a text that are not blank, split so that most fields are numbers, and their separator in words.

    Where no `decimal` (``"point"`` or ``"comma"``) is stated, commas that may separate thousands are refused.
    """
    texts = read_lines(source)
    separator = detect_separator(texts)
    if not separator:
        raise BadDataError("holds no table of numbers", way_out="give one frame or pose a line")
    split = []
    for i, one in enumerate(texts, start=1):
        if one.strip():
            fields = split_fields(one.lstrip("# "), separator)  # numpy writes it before names
            if one.lstrip().startswith("#") and any(_is_number(field, ()) for field in fields):
                fields = split_fields(one, separator)
            while len(fields) > 1 and not fields[-1]:
                fields.pop()
            split.append((i, one, fields, i > 1 and not texts[i - 2].strip()))
    way_out = "state which, --decimal comma" if decimal is None else ""
    comma = bool(comma_numbers((fields for _, _, fields, _ in split), way_out=way_out)) and decimal != "point"
    lines = [
        Line(i, text, fields, [number(one, decimal_comma=comma) for one in fields], after)
        for i, text, fields, after in split
    ]
    return lines, f"fields between {_SEPARATORS[separator]}{', decimal commas' if comma else ''}"


def detect_separator(texts: Sequence[str], marks: Sequence[str] = ()) -> str:
    """Separator with the most numbers (or `marks`) and the fewest other fields; empty where no line has two numbers."""
    filled = [text for text in texts if text.strip()]
    sample = filled[:: max(1, len(filled) // _SAMPLED)]
    scores = {}  # by separator: numbers in rows of numbers, and minus the other fields there
    for separator in _SEPARATORS:
        rows = [row for text in sample if _is_number_row(row := split_fields(text, separator), marks)]
        numbers = sum(_is_number(field, marks) for row in rows for field in row)
        scores[separator] = numbers, numbers - sum(map(len, rows))
    best = max(scores, key=scores.__getitem__)
    return best if scores[best][0] else ""


def _is_number_row(fields: Sequence[str], marks: Sequence[str]) -> bool:
    """True for a line of a table: two numbers or more, and little else."""
    numbers = sum(_is_number(field, marks) for field in fields)
    return numbers > 1 and numbers >= _LEAST_NUMBERS * len(fields)


def _is_number(text: str, marks: Sequence[str]) -> bool:
    return text in marks or number(text, decimal_comma=True) is not None or may_be_thousands(text)


def split_fields(text: str, separator: str) -> list[str]:
    """Fields of a line without the blanks around them."""
    text = " ".join(_TOUCHING.sub(r"\1 ", text).split()) if separator == " " else text
    with decoding("is not a table of text", way_out="give a table of numbers, such as .csv"):
        return [one.strip() for one in next(csv.reader([text], delimiter=separator, skipinitialspace=True), [])]


def comma_numbers(rows: Iterable[Sequence[str]], marks: Sequence[str] = (), *, way_out: str) -> list[str]:
    """Fields of rows of numbers that have a decimal comma, or commas between thousands.

    With a `way_out` they are refused where all may have commas between thousands: which is meant cannot be told.
    """
    with_commas = (row for row in rows if any("," in field for field in row))
    fields = (field for row in with_commas if _is_number_row(row, marks) for field in row)
    commas = [one for one in fields if _ANY_DECIMAL_COMMA.fullmatch(one) or may_be_thousands(one)]
    if way_out and commas and all(map(may_be_thousands, commas)):
        first = commas[0]
        what = f"holds {first!r}, which is {first.replace(',', '')} or {first.replace(',', '.', 1)}"
        raise BadDataError(what, way_out=way_out)
    return commas


def is_label_sequence(line: FloatArray) -> bool:
    """True for numbers that count 0, 1, 2... or 1, 2, 3..., as labels of rows or columns do."""
    return len(line) >= FEWEST_LABELS and line[0] in (0.0, 1.0) and bool((np.diff(line) == 1.0).all())


def unit_of_time(name: str) -> str:
    """Unit in the name of a column of times; empty without one."""
    match = _UNIT_OF_TIME.search(name.strip())
    unit = match[1].lower() if match else ""
    return {"msec": "ms", "µs": "us", "sec": "s", "secs": "s", "seconds": "s"}.get(unit, unit)
