"""Sizes that are read back from `estimate`'s JSON or posterior file."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product
from pathlib import Path
from typing import Any, Final, TypeVar

import numpy as np

from tactile_bayes.errors import BadDataError
from tactile_bayes.files.documents import load_json, parse_json, parse_record
from tactile_bayes.files.netcdf import open_netcdf
from tactile_bayes.files.provenance import scans_of
from tactile_bayes.files.reading import first_bytes, is_json
from tactile_bayes.files.reports import AnotherExam, EstimateReport, Interval, MassReport, PooledReport
from tactile_bayes.files.tables import Table
from tactile_bayes.findings import verdict
from tactile_bayes.inference.draws import Quantity

# --- Sizes from the output of `estimate`: its JSON, or the draws in its netCDF.

PROBABILITY = 0.95

_COLUMNS: Final = {"size_mm": "median", "low_mm": "low", "high_mm": "high", "probability": "probability"}
"""Columns of a trial table that a size fills."""
StatedSize = Quantity | Interval


def read_stated_size(path: Path) -> StatedSize | None:
    """Largest size in a file of `estimate`, mm; None without one."""
    return _size_and_provenance(path, None)[0]


def _size_and_provenance(path: Path, number: int | None) -> tuple[StatedSize | None, object]:
    """Size and provenance in a file; `number`: the estimate's place in a list, from 1; a list of one needs none."""
    head = first_bytes(path, 8)
    if is_json(head):
        return _from_json(path, number)
    if number is not None:
        raise BadDataError("is no list of estimates", way_out=f"leave out #{number}", path=str(path))
    if head.startswith(b"\x89HDF"):
        return _from_netcdf(path)
    way_out = "give what `estimate` wrote with --json or -o"
    raise BadDataError("is neither JSON nor netCDF", way_out=way_out, path=str(path))


def fill_from_posteriors(table: Table) -> tuple[dict[str, list[Any]], list[Path]]:
    """Columns of a trial table, with sizes and intervals from the files of its ``posterior`` column, and these files.

    Relative paths start at the table's folder; ``batch.json#3`` is the third of a list.
    """
    filled = {name: list(values) for name, values in table.columns.items()}
    folder, first = table.path.parent, dict[tuple[Path, str], int]()
    for row, name in enumerate(filled.get("posterior", [])):
        if not name:
            continue
        for column in (*_COLUMNS, "sd_mm"):
            if (value := filled[column][row]) is not None:
                what, way_out = f"is {value:g} beside a posterior", "leave it blank: the file says it"
                raise table.error(row, column, what, way_out=way_out)
        stem, mark, number = name.rpartition("#")
        if not (mark and number.isascii() and number.isdigit() and len(number) < 10) or (folder / name).exists():
            stem, number = name, ""
        if (before := first.setdefault((folder / stem, number), row)) != row:
            what = f"names the estimate of line {table.line_numbers[before]}"
            raise table.error(row, "posterior", what, way_out="give each reading the estimate of its own exam")
        stated, provenance = _size_and_provenance(folder / stem, int(number) if number else None)
        subjects = {scan["subject"] for scan in scans_of(provenance) if "subject" in scan}
        known = subjects.intersection(filled["patient"])  # codes of another study may be others
        if known and filled["patient"][row] not in known:
            what = f"names an estimate of patient {', '.join(sorted(known))}"
            raise table.error(row, "posterior", what, way_out="give one of this row's mass")
        _check_status(table, row, sized=stated is not None)
        for column, part in _COLUMNS.items():
            filled[column][row] = None if stated is None else getattr(stated, part)
    return filled, list(dict.fromkeys(path for path, _ in first))


def _check_status(table: Table, row: int, *, sized: bool) -> None:
    status = table.columns["status"][row]
    if (status == "detected") == sized and status is not None:
        return
    column, what = "posterior", f"names an estimate with a size while status is {status or 'blank'}"
    way_out = "give status detected, or leave posterior blank"
    if not sized and status is None:
        column, what = "status", "is blank beside a posterior that names an estimate without a size"
        way_out = "give status not_detected (the mass was looked for), or not_done"
    elif not sized:
        what = "names an estimate without a size while status is detected"
        way_out = "give status not_detected, or not_done"
    raise table.error(row, column, what, way_out=way_out)


def _from_json(path: Path, number: int | None) -> tuple[Quantity | None, object]:
    document = load_json(path, way_out="give `estimate --json`")
    if isinstance(document, list):
        number = 1 if number is None and len(document) == 1 else number
        if number is None or not 1 <= number <= len(document):
            number_words = "" if number is None else f" and none with the number {number}"
            way_out = f"name one as {path.name}#1 to {path.name}#{len(document)}, in the order of the maps"
            raise BadDataError(f"holds {len(document)} estimates{number_words}", way_out=way_out, path=str(path))
        document = document[number - 1]
    elif number is not None:
        raise BadDataError("holds one estimate, no list", way_out=f"leave out #{number}", path=str(path))
    pooled = isinstance(document, dict) and str(document.get("schema", "")).startswith("tactile-bayes/pooled/")
    kind: type[EstimateReport | PooledReport] = PooledReport if pooled else EstimateReport
    report = parse_record(document, kind, path=path)
    return report.max_size_mm, report.provenance


def _from_netcdf(path: Path) -> tuple[Interval, object]:
    with open_netcdf(path, way_out="give what `estimate` wrote with --json or -o") as file:
        group = file.group("posterior")
        attributes = {} if group is None else group.attributes()
        values = None if group is None else group.array("max_size_mm", kind="f8", dimensions=("chain", "draw"))
    values = np.zeros(0) if values is None else values.ravel()[np.isfinite(values.ravel()) & (values.ravel() > 0)]
    if len(values) < 2:
        way_out = "estimate with --size-calibration, so that the posterior holds sizes"
        raise BadDataError("holds no draws of max_size_mm", way_out=way_out, path=str(path))
    low, median, high = np.quantile(values, [0.5 - PROBABILITY / 2, 0.5, 0.5 + PROBABILITY / 2])
    size = Interval(float(median), float(low), float(high), PROBABILITY)
    return size, parse_json(attributes.get("provenance", "{}"))


# --- Checks of an estimate beyond its declaration: sizes that can be one lump's, in their order.

MOST_MM: Final = 500.0  #: Sizes above it are no lump's.
_SIZES: Final = ("max_size_mm", "min_size_mm", "d_x_mm", "d_y_mm")
R = TypeVar("R", bound=EstimateReport | PooledReport)
Holder = EstimateReport | PooledReport | MassReport | AnotherExam


def checked_report(document: object, kind: type[R], *, path: Path) -> R:
    """Report of `estimate --json`, for one map or pooled; its fields and the order of its sizes are checked."""
    report = parse_record(document, kind, path=path)
    if (fault := next(_report_faults(report), None)) is not None:
        what, rule = fault
        raise BadDataError(what, way_out=f"{rule}give the JSON as `estimate --json` printed it", path=str(path))
    return report


def _report_faults(report: EstimateReport | PooledReport) -> Iterator[tuple[str, str]]:
    """Contradictions in a report, each with the rule that it breaks; empty where the fault says it."""
    if report.status != "estimate" and report.max_size_mm is not None:
        yield f"status is {report.status!r}, and there is a max_size_mm", ""
    masses = report.masses if isinstance(report, EstimateReport) else ()
    holders: list[tuple[str, Holder]] = [("", report), *((f"masses[{i}].", mass) for i, mass in enumerate(masses))]
    for where, holder in holders:
        yield from _size_faults(where, holder)
        if (another := getattr(holder, "another_exam", None)) is not None:
            yield from _size_faults(f"{where}another_exam.", another)
    numbers = [one.number for one in masses]
    if len(set(numbers)) < len(numbers):
        yield f"masses are numbered {', '.join(map(str, numbers[:9]))}", ""
    reported = [i for i, one in enumerate(masses) if one.reported]
    if len(reported) > 1:
        yield f"{len(reported)} masses are the reported one", ""
    for i, name in product(reported, ("max_size_mm", "min_size_mm")):
        if getattr(masses[i], name) != getattr(report, name):
            yield f"masses[{i}].{name} is not the document's, of the same mass", ""
    made = verdict(report.findings, answered=report.max_size_mm is not None)
    if report.verdict != made:
        yield f"verdict is {report.verdict!r}, and its findings make it {made!r}", ""


def _size_faults(where: str, holder: Holder) -> Iterator[tuple[str, str]]:
    """Faults in the sizes of a report, a mass or another exam; `where` is its place in the document."""
    for name in _SIZES:
        size: Quantity | None = getattr(holder, name, None)
        if size is None:
            continue
        low, median, high, ends = size.low, size.median, size.high, "ends of an interval rise from above 0 to at most"
        if not 0 < low <= high <= MOST_MM:
            yield f"{where}{name} has low {low:g} and high {high:g}", f"{ends} {MOST_MM:g} mm; "
        if size.kind == "eti" and not low <= median <= high:
            yield f"{where}{name} has median {median:g} outside its interval of {low:g} to {high:g} mm", ""
        if not 0 < median <= MOST_MM:
            yield f"{where}{name} has median {median:g}", ""
    largest, smallest = holder.max_size_mm, holder.min_size_mm
    if (largest is None) != (smallest is None):
        yield f"{where}max_size_mm and min_size_mm are not both there", ""
    if largest is not None and smallest is not None and smallest.median > largest.median:
        yield f"{where}min_size_mm is {smallest.median:g} mm and max_size_mm {largest.median:g} mm", ""
