"""Wide trial tables (one row per patient or mass, as REDCap exports them), read by a column mapping in TOML.

The mapping says which column holds what; nothing is guessed. A blank cell is `not_done` unless the mapping gives the
word that the table writes for a mass that was looked for and not found.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from datetime import date
from pathlib import Path
from typing import Any

from tactile_bayes.errors import BadDataError
from tactile_bayes.files.documents import check_document, load_toml
from tactile_bayes.files.tables import RawTable, Table, parse_date, read_raw

_EXCISION = ("patient", "mass", "ex_vivo_mm", "ex_vivo_second_mm", "sd_mm", "date")
_FACTOR = {"mm": 1.0, "cm": 10.0, "in": 25.4}


def read_wide(path: Path, mapping_path: Path) -> Table:
    """Convert a wide table to a tidy one with the columns of ``trial.table.json``; readings keep their line numbers.

    Raises
    ------
    BadDataError
        At the first fault of the mapping or of a cell, naming file, line and column of the wide table.
    """
    mapping = read_mapping(mapping_path)
    if "reading" not in mapping:
        way_out = "add one for each modality, or give a table of readings that is tidy"
        raise BadDataError("has no [[reading]]", way_out=way_out, path=str(mapping_path))
    raw = read_raw(path)
    _check_columns(raw, [*_key_columns(mapping), *_reading_columns(mapping)])
    columns: dict[str, list[Any]] = {}
    line_numbers = []
    for line, row in zip(raw.line_numbers, raw.rows, strict=True):
        for reading in _readings(raw, line, row, mapping):
            for name, value in reading.items():
                columns.setdefault(name, []).append(value)
            line_numbers.append(line)
    table = Table(path=path, columns=columns, line_numbers=line_numbers)
    _check_keys(table, ("patient", "mass", "modality", "replicate"))
    return table


def read_wide_excision(path: Path, mapping_path: Path) -> Table:
    """Read ex-vivo sizes from a wide table into columns of ``excision.table.json``; rows without a size are left out.

    Raises
    ------
    BadDataError
        At the first fault, as `read_wide`, when the mapping has no table ``[excision]``, or when two rows are of one
        mass.
    """
    mapping = read_mapping(mapping_path)
    if "excision" not in mapping:
        way_out = "add it, with size as the column of the sizes"
        raise BadDataError("has no table [excision]", way_out=way_out, path=str(mapping_path))
    raw = read_raw(path)
    excision = mapping["excision"]
    _check_columns(raw, [*_key_columns(mapping), *excision_columns(excision)])
    columns: dict[str, list[Any]] = {name: [] for name in _EXCISION}
    factor = _FACTOR[excision.get("unit", mapping.get("unit", "mm"))]
    kept = []
    for line, row in zip(raw.line_numbers, raw.rows, strict=True):
        if not row[excision["size"]]:
            continue
        kept.append(line)
        patient, mass = _key(raw, line, row, mapping)
        size = factor * _positive(raw, line, excision["size"], row[excision["size"]])
        second, sd = (_number(raw, line, row, excision, key, factor) for key in ("second", "sd"))
        day = _date(raw, line, row, excision)
        for name, value in zip(_EXCISION, (patient, mass, size, second, sd, day), strict=True):
            columns[name].append(value)
    if not kept:
        what = f"column {excision['size']}: holds no size"
        raise BadDataError(what, way_out="correct the mapping or the table", path=str(path))
    table = Table(path=path, columns=columns, line_numbers=kept)
    _check_keys(table, ("patient", "mass"))
    return table


def excision_columns(excision: Mapping[str, Any]) -> list[str]:
    """Columns of the wide table that the mapping's ``[excision]`` names."""
    return [excision[key] for key in ("size", "second", "sd", "date") if key in excision]


def read_mapping(path: Path) -> dict[str, Any]:
    """Read the mapping and check it against ``column_map.schema.json``."""
    document = load_toml(path, way_out="see the column mapping in the tutorial")
    check_document(document, "column_map.schema.json", path=path)
    return document


def _key_columns(mapping: Mapping[str, Any]) -> list[str]:
    return [mapping[key] for key in ("patient", "mass") if key in mapping]


def _reading_columns(mapping: Mapping[str, Any]) -> list[str]:
    keys = ("size", "sd", "low", "high", "reader", "date")
    return [reading[key] for reading in mapping["reading"] for key in keys if key in reading]


def _check_columns(table: RawTable, names: Sequence[str]) -> None:
    for name in names:
        if name not in table.header:
            held = ", ".join(repr(one) for one in table.header)
            raise _fault(table.path, 1, name, "is missing", f"correct the mapping; the table has {held}")


def _readings(
    table: RawTable, line: int, row: Mapping[str, str], mapping: Mapping[str, Any]
) -> Iterator[dict[str, Any]]:
    patient, mass = _key(table, line, row, mapping)
    for reading in mapping["reading"]:
        yield {"patient": patient, "mass": mass, **_reading(table, line, row, reading, mapping)}


def _key(table: RawTable, line: int, row: Mapping[str, str], mapping: Mapping[str, Any]) -> tuple[str, str]:
    """Patient and mass of a row."""
    for name in _key_columns(mapping):
        if not row[name]:
            raise _fault(table.path, line, name, "is blank", "every row needs its patient and mass")
    return row[mapping["patient"]], row[mapping["mass"]] if "mass" in mapping else "1"


def _reading(
    table: RawTable, line: int, row: Mapping[str, str], reading: Mapping[str, Any], mapping: Mapping[str, Any]
) -> dict[str, Any]:
    factor = _FACTOR[reading.get("unit", mapping.get("unit", "mm"))]
    text = row[reading["size"]]
    status, size = "not_done", None
    if text and text in mapping.get("not_detected", []):
        status = "not_detected"
    elif text and text not in mapping.get("not_done", []):
        status, size = "detected", factor * _positive(table, line, reading["size"], text)
    values = {key: _number(table, line, row, reading, key, factor) for key in ("sd", "low", "high")}
    probability = reading.get("probability") if values["low"] is not None else None
    if status == "detected" and values["low"] is not None and probability is None:
        raise _fault(
            table.path, line, reading["low"], "is an interval's end without probability", "add it to the mapping"
        )
    return {
        "modality": reading["modality"],
        "replicate": reading.get("replicate", 1),
        "size_mm": size,
        "status": status,
        "sd_mm": values["sd"],
        "low_mm": values["low"],
        "high_mm": values["high"],
        "probability": probability,
        "reader": (row[reading["reader"]] or None) if "reader" in reading else None,
        "visit": reading.get("visit"),
        "date": _date(table, line, row, reading),
        "posterior": None,
        "synthetic": mapping.get("synthetic"),
    }


def _number(
    table: RawTable, line: int, row: Mapping[str, str], reading: Mapping[str, Any], key: str, factor: float
) -> float | None:
    if key not in reading or not row[reading[key]]:
        return None
    return factor * table.number(line, reading[key], row[reading[key]])


def _date(table: RawTable, line: int, row: Mapping[str, str], columns: Mapping[str, Any]) -> date | None:
    text = row[columns["date"]] if "date" in columns else ""
    try:
        return parse_date(text) if text else None
    except ValueError:
        raise _fault(table.path, line, columns["date"], f"{text!r} is no date", "write it as 2026-03-01") from None


def _positive(table: RawTable, line: int, column: str, text: str) -> float:
    value = table.number(line, column, text)
    if value == 0:
        ask = 'does 0 mean that the mass was not found? then add not_detected = ["0"] to the mapping'
        raise _fault(table.path, line, column, "is 0", ask)
    if value < 0:
        raise _fault(table.path, line, column, f"is {value:g}", "a size is above 0")
    return value


def _check_keys(table: Table, names: Sequence[str]) -> None:
    seen: dict[tuple[Any, ...], int] = {}
    for row, key in enumerate(zip(*(table.columns.get(name, []) for name in names), strict=True)):
        if key in seen:
            shown = " + ".join(map(str, key))
            way_out = "remove one row" if "modality" in names else "remove one, or name the column of the mass"
            raise table.error(
                row, "patient", f"{shown} stands on line {table.line_numbers[seen[key]]} already", way_out=way_out
            )
        seen[key] = row


def _fault(path: Path, line: int, column: str, what: str, way_out: str) -> BadDataError:
    return BadDataError(f"line {line}, column {column}: {what}", way_out=way_out, path=str(path))
