"""Wide trial tables (one row per patient or mass, as REDCap exports them), read by a column mapping in TOML.

The mapping names the column of each reading; nothing is guessed. A blank cell is `not_done`; for a mass that was looked
for and not found the mapping gives the table's word.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Final, Literal, NamedTuple

from tactile_bayes.declarations import Meta, Record
from tactile_bayes.errors import BadDataError, in_file
from tactile_bayes.files.documents import load_schema, parse_record, parse_toml
from tactile_bayes.files.reading import TOML_BYTES, read_text
from tactile_bayes.files.tables import RawTable, Table, check_unique, composed, read_raw
from tactile_bayes.presets import MM_PER_UNIT

_WAY_OUT: Final = "see A wide table in docs/guides/validate.md"
_OWN: Final = {"sd_mm": "sd", "low_mm": "low", "high_mm": "high", "ex_vivo_second_mm": "second", "date": "date"}
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
    synthetic: bool | None = None  #: True where all readings were made by a generator.
    reading: Annotated[tuple[ReadingColumns, ...], Meta(min_length=1)] | None = None
    """One for each modality and replicate of a wide table of readings."""
    excision: ExcisionColumns | None = None

    def __post_init__(self) -> None:
        readings = self.reading or ()
        named = Counter(f"column {name}" for one in readings for name in (one.size, one.low, one.high) if name)
        named.update(f"replicate {one.replicate} of {one.modality}" for one in readings)
        for name, times in named.items():
            if times > 1:
                raise BadDataError(f"{name} is named {times} times", way_out="give each reading its own")
        for word in self.not_detected:
            if word in self.not_done:
                raise BadDataError(f"{word} stands in not_detected and in not_done", way_out="leave it in one of them")

    def key_columns(self) -> list[str]:
        return [self.patient] if self.mass is None else [self.patient, self.mass]


def read_wide(path: Path, mapping: ColumnMap, readings: Sequence[ReadingColumns]) -> Table:
    """Convert a wide table to a tidy one with the columns of ``trial.table.json``; readings keep their line numbers."""
    named = [(one.size, one.sd, one.low, one.high, one.reader, one.date) for one in readings]
    rows = _rows(path, mapping, [name for names in named for name in names])
    tidy = [_reading(row, reading, mapping) for row in rows for reading in readings]
    keys, lines = ("patient", "mass", "modality", "replicate"), [row.line for row in rows for _ in readings]
    return _table(path, tidy, keys, lines=lines, called=[_called(mapping, one) for one in readings] * len(rows))


def read_wide_excision(path: Path, mapping: ColumnMap, excision: ExcisionColumns) -> Table:
    """Read ex-vivo sizes of a wide table into columns of ``excision.table.json``; rows without one are left out."""
    factor = MM_PER_UNIT[excision.unit or mapping.unit]
    named = (excision.size, excision.second, excision.sd, excision.date)
    rows = [row for row in _rows(path, mapping, named) if row.cells[excision.size]]
    if not rows:
        what = f"column {excision.size}: holds no size"
        raise BadDataError(what, way_out="correct the mapping or the table", path=str(path))
    sizes = [
        {
            **row.key(mapping),
            "ex_vivo_mm": row.size(excision.size, factor, "was the mass not measured? then leave the cell blank"),
            "ex_vivo_second_mm": row.number(excision.second, factor, "excision", "ex_vivo_second_mm"),
            "sd_mm": row.number(excision.sd, factor, "excision", "sd_mm"),
            "date": row.value(excision.date, "excision", "date"),
        }
        for row in rows
    ]
    lines, called = [row.line for row in rows], [_called(mapping, excision)] * len(rows)
    return _table(path, sizes, ("patient", "mass"), lines=lines, called=called)


def _called(mapping: ColumnMap, columns: ReadingColumns | ExcisionColumns) -> Mapping[str, str]:
    """Column of the wide table by that of the tidy one: that of the size where it has none of its own."""
    own = {tidy: getattr(columns, name, None) for tidy, name in _OWN.items()}
    own |= {"patient": mapping.patient, "mass": mapping.mass or mapping.patient}
    return defaultdict(lambda: columns.size, {tidy: column for tidy, column in own.items() if column})


def _table(
    path: Path,
    rows: Sequence[Mapping[str, Any]],
    keys: Sequence[str],
    *,
    lines: list[int],
    called: Sequence[Mapping[str, str]],
) -> Table:
    """Table of rows; no two may have the same keys."""
    columns = {name: [row[name] for row in rows] for name in rows[0]}
    table = Table(path=path, columns=columns, line_numbers=lines, called=called)
    check_unique(table, keys, way_out="remove one row, or name the column of the mass")
    return table


def read_mapping(path: Path) -> ColumnMap:
    """Read the mapping, with every text in NFC; for the errors see `files.documents.read_record`."""
    with in_file(path):
        text = composed(read_text(path, most=TOML_BYTES, way_out=_WAY_OUT))
        return parse_record(parse_toml(text, way_out=_WAY_OUT), ColumnMap, path=path)


class _Row(NamedTuple):
    """A row of a wide table."""

    table: RawTable
    line: int
    cells: Mapping[str, str]

    def key(self, mapping: ColumnMap) -> dict[str, Any]:
        for name in mapping.key_columns():
            if not self.cells[name]:
                raise self.table.error(self.line, name, "is blank", way_out="every row needs its patient and mass")
        mass = "1" if mapping.mass is None else self.cells[mapping.mass]
        return {"patient": self.cells[mapping.patient], "mass": mass}

    def value(self, column: str | None, schema: str, name: str) -> Any:
        """A value by the rules of the field `name` in ``SCHEMA.table.json``; None without its column or cell."""
        field = next(one for one in load_schema(f"{schema}.table.json")["fields"] if one["name"] == name)
        return self.table.cell(self.line, column, self.cells[column], field) if column else None

    def number(self, column: str | None, factor: float, schema: str, name: str) -> float | None:
        """A number in mm; see `value`."""
        value = self.value(column, schema, name)
        return None if value is None else factor * value

    def size(self, column: str, factor: float, ask: str) -> float:
        """A size in mm, which is above 0; `ask` is the way out of 0 and of a word."""
        text = self.cells[column]
        is_word = not any(map(str.isdigit, text))
        value: float = 0.0 if is_word else self.table.cell(self.line, column, text, {"type": "number"})
        if is_word or value == 0:
            raise self.table.error(self.line, column, f"is {text}", way_out=ask)
        if value < 0:
            raise self.table.error(self.line, column, f"is {value:g}", way_out="a size is above 0")
        return factor * value


def _rows(path: Path, mapping: ColumnMap, names: Sequence[str | None]) -> list[_Row]:
    """Rows with names and cells in NFC; the mapping's columns must be there."""
    table = read_raw(path)
    header = [composed(name) for name in table.header]
    for name in filter(None, (*mapping.key_columns(), *names)):
        if name not in header:
            column_names = ", ".join(repr(one) for one in header)
            raise table.error(1, name, "is missing", way_out=f"correct the mapping; the table has {column_names}")
    cells = ({composed(name): composed(cell) for name, cell in row.items()} for row in table.rows)
    return [_Row(table, line, row) for (line, _), row in zip(table.body, cells, strict=True)]


def _reading(row: _Row, reading: ReadingColumns, mapping: ColumnMap) -> dict[str, Any]:
    key, factor = row.key(mapping), MM_PER_UNIT[reading.unit or mapping.unit]
    text = row.cells[reading.size]
    status, size = "not_done", None
    if text and text in mapping.not_detected:
        status = "not_detected"
    elif text and text not in mapping.not_done:
        ask = f'does {text} mean that the mass was not found? then add not_detected = ["{text}"] to the mapping'
        ask += f'; that it was not looked for? not_done = ["{text}"]'
        status, size = "detected", row.size(reading.size, factor, ask)
    ends = {"sd_mm": reading.sd, "low_mm": reading.low, "high_mm": reading.high}
    spread = {name: row.number(column, factor, "trial", name) for name, column in ends.items()}
    probability = None if spread["low_mm"] is None else reading.probability
    if status == "detected" and reading.low and spread["low_mm"] is not None and probability is None:
        what = "is an interval's end without probability"
        raise row.table.error(row.line, reading.low, what, way_out="add it to the mapping")
    return {
        **key,
        "modality": reading.modality,
        "replicate": reading.replicate,
        "size_mm": size,
        "status": status,
        **spread,
        "probability": probability,
        "reader": (row.cells[reading.reader] or None) if reading.reader else None,
        "visit": reading.visit,
        "date": row.value(reading.date, "trial", "date"),
        "posterior": None,
        "synthetic": mapping.synthetic,
    }
