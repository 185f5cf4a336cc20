"""Wide trial tables (one row per patient or mass, as REDCap exports them), read by a column mapping in TOML.

The mapping says which column holds what; nothing is guessed. A blank cell is `not_done` unless the mapping gives the
word that the table writes for a mass that was looked for and not found.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import date
from pathlib import Path
from typing import Annotated, Any, Literal

from tactile_bayes.declarations import Meta, Record, replace
from tactile_bayes.errors import BadDataError
from tactile_bayes.files.documents import load_toml, parse_record
from tactile_bayes.files.tables import RawTable, Table, composed, parse_date, read_raw

_EXCISION = ("patient", "mass", "ex_vivo_mm", "ex_vivo_second_mm", "sd_mm", "date")
_FACTOR = {"mm": 1.0, "cm": 10.0, "in": 25.4}
Unit = Literal["mm", "cm", "in"]
Column = Annotated[str, Meta(min_length=1)]
Modality = Annotated[
    str, Meta(pattern="^[a-z][a-z0-9_-]*$", extra={"words": "small letters, digits, _ and -, a letter first"})
]


class ReadingColumns(Record, kw_only=True):
    """Columns of a modality's readings."""

    modality: Modality
    replicate: Annotated[int, Meta(ge=1)] = 1
    size: Column  #: Column of the size.
    unit: Unit | None = None
    sd: Column | None = None
    low: Column | None = None
    high: Column | None = None
    probability: Annotated[float, Meta(gt=0, lt=1)] | None = None
    reader: Column | None = None
    visit: Column | None = None  #: Code of the visit that these readings are of, such as 1.
    date: Column | None = None  #: Column of the readings' date.


class ExcisionColumns(Record):
    """Columns of the ex-vivo sizes, when --excision names a wide table too."""

    size: Column
    second: Column | None = None
    sd: Column | None = None
    unit: Unit | None = None
    date: Column | None = None  #: Column of the date of excision.


class ColumnMap(Record):
    """Which column of a wide table holds which reading."""

    patient: Column  #: Column of the coded patient.
    mass: Column | None = None  #: Column of the mass within the patient; without it every patient has one.
    unit: Unit = "mm"  #: Of all sizes, unless a reading says otherwise.
    not_detected: tuple[str, ...] = ()  #: Words that the table writes for a mass looked for and not found.
    not_done: tuple[str, ...] = ()  #: Words for a mass not looked for; a blank is one already.
    synthetic: bool | None = None  #: Whether all readings were made by a generator.
    reading: Annotated[tuple[ReadingColumns, ...], Meta(min_length=1)] | None = None
    """One for each modality and replicate of a wide table of readings."""
    excision: ExcisionColumns | None = None

    def key_columns(self) -> list[str]:
        """Columns of the patient and of the mass."""
        return [self.patient] if self.mass is None else [self.patient, self.mass]


def read_wide(path: Path, mapping_path: Path) -> Table:
    """Convert a wide table to a tidy one with the columns of ``trial.table.json``; readings keep their line numbers."""
    mapping = read_mapping(mapping_path)
    if mapping.reading is None:
        way_out = "add one for each modality, or give a table of readings that is tidy"
        raise BadDataError("has no [[reading]]", way_out=way_out, path=str(mapping_path))
    named = [(one.size, one.sd, one.low, one.high, one.reader, one.date) for one in mapping.reading]
    raw = _raw(path, mapping, [name for names in named for name in names])
    rows = zip(raw.line_numbers, raw.rows, strict=True)
    return _table(
        path,
        [(line, _reading(raw, line, row, reading, mapping)) for line, row in rows for reading in mapping.reading],
        ("patient", "mass", "modality", "replicate"),
    )


def read_wide_excision(path: Path, mapping_path: Path) -> Table:
    """Read ex-vivo sizes of a wide table into columns of ``excision.table.json``; rows without one are left out."""
    mapping = read_mapping(mapping_path)
    excision = mapping.excision
    if excision is None:
        way_out = "add it, with size as the column of the sizes"
        raise BadDataError("has no table [excision]", way_out=way_out, path=str(mapping_path))
    raw = _raw(path, mapping, (excision.size, excision.second, excision.sd, excision.date))
    factor = _FACTOR[excision.unit or mapping.unit]
    rows = []
    for line, row in zip(raw.line_numbers, raw.rows, strict=True):
        if row[excision.size]:
            patient, mass = _key(raw, line, row, mapping)
            size = factor * _positive(raw, line, excision.size, row[excision.size])
            second, sd = (_number(raw, line, row, column, factor) for column in (excision.second, excision.sd))
            day = _date(raw, line, row, excision.date)
            rows.append((line, dict(zip(_EXCISION, (patient, mass, size, second, sd, day), strict=True))))
    if not rows:
        what = f"column {excision.size}: holds no size"
        raise BadDataError(what, way_out="correct the mapping or the table", path=str(path))
    return _table(path, rows, ("patient", "mass"))


def _table(path: Path, rows: Sequence[tuple[int, dict[str, Any]]], keys: Sequence[str]) -> Table:
    """Rows with their line numbers as columns; no two may have the same keys."""
    columns = {name: [row[name] for _, row in rows] for name in rows[0][1]}
    table = Table(path=path, columns=columns, line_numbers=[line for line, _ in rows])
    first: dict[tuple[Any, ...], int] = {}
    for row, key in enumerate(zip(*(columns[name] for name in keys), strict=True)):
        if (before := first.setdefault(key, row)) != row:
            what = f"{' + '.join(map(str, key))} stands on line {table.line_numbers[before]} already"
            way_out = "remove one row" if "modality" in keys else "remove one, or name the column of the mass"
            raise table.error(row, "patient", what, way_out=way_out)
    return table


def read_mapping(path: Path) -> ColumnMap:
    """Read the mapping; for the errors see `files.documents.read_record`."""
    document = load_toml(path, way_out="see the column mapping in the tutorial")
    return parse_record(_composed_texts(document), ColumnMap, path=path)


def _composed_texts(item: Any) -> Any:
    """What stands in a document, with every text in one spelling."""
    if isinstance(item, dict):
        return {composed(key): _composed_texts(value) for key, value in item.items()}
    if isinstance(item, list):
        return [_composed_texts(value) for value in item]
    return composed(item) if isinstance(item, str) else item


def _raw(path: Path, mapping: ColumnMap, names: Sequence[str | None]) -> RawTable:
    """The table with its names and cells in one spelling, in which the mapping's columns are there."""
    table = read_raw(path)
    rows = [{composed(name): composed(cell) for name, cell in row.items()} for row in table.rows]
    table = replace(table, header=[composed(name) for name in table.header], rows=rows)
    for name in filter(None, (*mapping.key_columns(), *names)):
        if name not in table.header:
            held = ", ".join(repr(one) for one in table.header)
            raise table.error(1, name, "is missing", way_out=f"correct the mapping; the table has {held}")
    return table


def _key(table: RawTable, line: int, row: Mapping[str, str], mapping: ColumnMap) -> tuple[str, str]:
    """Patient and mass of a row."""
    for name in mapping.key_columns():
        if not row[name]:
            raise table.error(line, name, "is blank", way_out="every row needs its patient and mass")
    return row[mapping.patient], "1" if mapping.mass is None else row[mapping.mass]


def _reading(
    table: RawTable, line: int, row: Mapping[str, str], reading: ReadingColumns, mapping: ColumnMap
) -> dict[str, Any]:
    patient, mass = _key(table, line, row, mapping)
    factor = _FACTOR[reading.unit or mapping.unit]
    text = row[reading.size]
    status, size = "not_done", None
    if text and text in mapping.not_detected:
        status = "not_detected"
    elif text and text not in mapping.not_done:
        status, size = "detected", factor * _positive(table, line, reading.size, text)
    sd, low, high = (_number(table, line, row, column, factor) for column in (reading.sd, reading.low, reading.high))
    probability = None if low is None else reading.probability
    if status == "detected" and reading.low and low is not None and probability is None:
        what = "is an interval's end without probability"
        raise table.error(line, reading.low, what, way_out="add it to the mapping")
    return {
        "patient": patient,
        "mass": mass,
        "modality": reading.modality,
        "replicate": reading.replicate,
        "size_mm": size,
        "status": status,
        "sd_mm": sd,
        "low_mm": low,
        "high_mm": high,
        "probability": probability,
        "reader": (row[reading.reader] or None) if reading.reader else None,
        "visit": reading.visit,
        "date": _date(table, line, row, reading.date),
        "posterior": None,
        "synthetic": mapping.synthetic,
    }


def _number(table: RawTable, line: int, row: Mapping[str, str], column: str | None, factor: float) -> float | None:
    return factor * table.number(line, column, row[column]) if column and row[column] else None


def _date(table: RawTable, line: int, row: Mapping[str, str], column: str | None) -> date | None:
    text = row[column] if column else ""
    try:
        return parse_date(text) if text else None
    except ValueError:
        raise table.error(line, str(column), f"{text!r} is no date", way_out="write it as 2026-03-01") from None


def _positive(table: RawTable, line: int, column: str, text: str) -> float:
    value = table.number(line, column, text)
    if value == 0:
        ask = 'does 0 mean that the mass was not found? then add not_detected = ["0"] to the mapping'
        raise table.error(line, column, "is 0", way_out=ask)
    if value < 0:
        raise table.error(line, column, f"is {value:g}", way_out="a size is above 0")
    return value
