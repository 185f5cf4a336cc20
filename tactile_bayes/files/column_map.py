"""Wide trial tables (one row per patient or mass, as REDCap exports them), read by a column mapping in TOML.

The mapping says which column holds what; nothing is guessed. A blank cell is `not_done` unless the mapping gives the
word that the table writes for a mass that was looked for and not found.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from tactile_bayes.errors import BadDataError
from tactile_bayes.files.documents import load_toml
from tactile_bayes.files.schema import check_document
from tactile_bayes.files.tables import Table, parse_number, read_raw

_FACTOR = {"mm": 1.0, "cm": 10.0, "in": 25.4}


def read_wide(path: Path, mapping_path: Path) -> Table:
    """Convert a wide table to a tidy one with the columns of ``trial.table.json``; readings keep their line numbers.

    Raises
    ------
    BadDataError
        At the first fault of the mapping or of a cell, naming file, line and column of the wide table.
    """
    mapping = read_mapping(mapping_path)
    lines, rows = read_raw(path)
    _check_columns(path, mapping, rows[0] if rows else {})
    columns: dict[str, list[Any]] = {}
    line_numbers = []
    for line, row in zip(lines, rows, strict=True):
        for reading in _readings(path, line, row, mapping):
            for name, value in reading.items():
                columns.setdefault(name, []).append(value)
            line_numbers.append(line)
    _check_keys(path, columns, line_numbers)
    return Table(path=path, columns=columns, line_numbers=line_numbers)


def read_wide_excision(path: Path, mapping_path: Path) -> Table:
    """Read ex-vivo sizes from a wide table into columns of ``excision.table.json``; rows without a size are left out.

    Raises
    ------
    BadDataError
        At the first fault, as `read_wide`, or when the mapping has no table ``[excision]``.
    """
    mapping = read_mapping(mapping_path)
    lines, rows = read_raw(path)
    excision = mapping["excision"]
    columns: dict[str, list[Any]] = {
        name: [] for name in ("patient", "mass", "ex_vivo_mm", "ex_vivo_second_mm", "sd_mm")
    }
    factor = _FACTOR[excision.get("unit", mapping.get("unit", "mm"))]
    kept = []
    for line, row in zip(lines, rows, strict=True):
        for name in [mapping["patient"], *excision_columns(excision)]:
            if name not in row:
                raise _fault(path, 1, name, "is missing", "correct the mapping or the table")
        if not row[excision["size"]]:
            continue
        kept.append(line)
        columns["patient"].append(row[mapping["patient"]])
        columns["mass"].append(row[mapping["mass"]] if "mass" in mapping else "1")
        columns["ex_vivo_mm"].append(factor * _positive(path, line, excision["size"], row[excision["size"]]))
        for key, column in (("second", "ex_vivo_second_mm"), ("sd", "sd_mm")):
            columns[column].append(_number(path, line, row, excision, key, factor))
    return Table(path=path, columns=columns, line_numbers=kept)


def excision_columns(excision: Mapping[str, Any]) -> list[str]:
    """Columns of the wide table that the mapping's ``[excision]`` names."""
    return [excision[key] for key in ("size", "second", "sd") if key in excision]


def read_mapping(path: Path) -> dict[str, Any]:
    """Read the mapping and check it against ``column_map.schema.json``."""
    document = load_toml(path, way_out="see the column mapping in the tutorial")
    check_document(document, "column_map.schema.json", path=path)
    return document


def _check_columns(path: Path, mapping: Mapping[str, Any], row: Mapping[str, str]) -> None:
    named = [mapping["patient"], *([mapping["mass"]] if "mass" in mapping else [])]
    for reading in mapping["reading"]:
        named += [reading[key] for key in ("size", "sd", "low", "high", "reader") if key in reading]
    for name in named:
        if name not in row:
            raise BadDataError(
                f"line 1, column {name}: is missing", way_out="correct the mapping or the table", path=str(path)
            )


def _readings(path: Path, line: int, row: Mapping[str, str], mapping: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    patient = row[mapping["patient"]]
    mass = row[mapping["mass"]] if "mass" in mapping else "1"
    for name, value in ((mapping["patient"], patient), (mapping.get("mass", ""), mass)):
        if not value:
            raise _fault(path, line, name, "is blank", "every row needs its patient and mass")
    for reading in mapping["reading"]:
        yield {"patient": patient, "mass": mass, **_reading(path, line, row, reading, mapping)}


def _reading(
    path: Path, line: int, row: Mapping[str, str], reading: Mapping[str, Any], mapping: Mapping[str, Any]
) -> dict[str, Any]:
    factor = _FACTOR[reading.get("unit", mapping.get("unit", "mm"))]
    text = row[reading["size"]]
    status, size = "not_done", None
    if text and text in mapping.get("not_detected", []):
        status = "not_detected"
    elif text and text not in mapping.get("not_done", []):
        status, size = "detected", factor * _positive(path, line, reading["size"], text)
    values = {key: _number(path, line, row, reading, key, factor) for key in ("sd", "low", "high")}
    probability = reading.get("probability") if values["low"] is not None else None
    if status == "detected" and values["low"] is not None and probability is None:
        raise _fault(path, line, reading["low"], "is an interval's end without probability", "add it to the mapping")
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
        "posterior": None,
        "synthetic": mapping.get("synthetic"),
    }


def _number(
    path: Path, line: int, row: Mapping[str, str], reading: Mapping[str, Any], key: str, factor: float
) -> float | None:
    if key not in reading or not row[reading[key]]:
        return None
    return factor * parse_number(path, line, reading[key], row[reading[key]])


def _positive(path: Path, line: int, column: str, text: str) -> float:
    value = parse_number(path, line, column, text)
    if value == 0:
        ask = 'does 0 mean that the mass was not found? then add not_detected = ["0"] to the mapping'
        raise _fault(path, line, column, "is 0", ask)
    if value < 0:
        raise _fault(path, line, column, f"is {value:g}", "a size is above 0")
    return value


def _check_keys(path: Path, columns: Mapping[str, list[Any]], lines: list[int]) -> None:
    seen: dict[tuple[Any, ...], int] = {}
    names = ("patient", "mass", "modality", "replicate")
    for line, key in zip(lines, zip(*(columns.get(name, []) for name in names), strict=True), strict=True):
        if key in seen:
            shown = " + ".join(map(str, key))
            raise _fault(path, line, "patient", f"{shown} stands on line {seen[key]} already", "remove one row")
        seen[key] = line


def _fault(path: Path, line: int, column: str, what: str, way_out: str) -> BadDataError:
    return BadDataError(f"line {line}, column {column}: {what}", way_out=way_out, path=str(path))
