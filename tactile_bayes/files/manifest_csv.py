"""The table of a campaign's exams, `exams.csv`, and the names of exams, masses and files in its output folder."""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Mapping, Sequence
from datetime import date
from pathlib import Path
from typing import Any, Final

from tactile_bayes.declarations import Record, field
from tactile_bayes.errors import BadDataError, UsageError
from tactile_bayes.files.atomic import write_text
from tactile_bayes.files.documents import load_schema
from tactile_bayes.files.reading import TABLE_BYTES, check_address, is_address, kind_of, read_bytes
from tactile_bayes.files.size_json import NONE, SHIPPED
from tactile_bayes.files.tables import RawTable, Table, csv_cell, csv_text, read_raw, read_table
from tactile_bayes.trial.readings import Reading, at_excision, same_code

# --- Names of exams and masses of a campaign, and of the files in its output folder.

JOURNAL: Final = "campaign.journal"
EXAMS, MASSES, GROWTH = "exams", "masses", "growth"
"""Folders of the exams, of the masses pooled at a visit, and of the masses compared between visits."""
DONE, FAILURES, TRIAL, GROWN = "exams_done.csv", "failures.csv", "trial.csv", "growth.csv"  #: Tables beside them.

SCAN, MAP, ESTIMATE, POSTERIOR = "scan.mcap", "map.nc", "estimate.json", "posterior.nc"
SHAPE, MAP_FIGURE, SIZE_FIGURE = "shape.npz", "map.png", "size.png"
EXAM_PAGE, THUMBNAIL = "exam.html", "thumbnail.svg"
SIZED, SIZED_FIGURE = "sized.json", "sized.png"  #: Files of an exam.
POOLED, POOLED_DRAWS = "pooled.json", "pooled.nc"  #: Files of a mass at a visit.
COMPARED, COMPARED_FIGURE, GROWTH_PAGE = "compare.json", "compare.png", "growth.html"
"""Files of a mass over its visits."""
REPEATABILITY: Final = "repeatability.json"  #: Beside the folders, as the tables are.


def mass_name(*, patient: str, visit: str, mass: str) -> str:
    """Name of a mass at a visit, which is also its folder's."""
    return f"{patient}.v{visit}.m{mass}"


def exam_name(of_mass: str, replicate: int | str) -> str:
    """Name of an exam of the mass that `mass_name` names, which is also its folder's."""
    return f"{of_mass}.r{replicate}"


# --- The table: which file is which exam of which mass.

SCHEMA: Final = "exams.table.json"
KNOWN: Final = ("seat", "depth_mm", "stiffness_ratio", "fat_kpa", "gland_ratio", "thickness_mm")
"""Properties of the body in columns ``known_...``, by the names of `Settings.known`."""
SAME_IN_SCANS: Final = {"patient": "subject", "side": "side", "reader": "examiner", "visit": "visit", "mass": "mass"}
"""Columns, and the facts of a scan's session that they repeat."""
_WRITTEN: Final = ("file", "patient", "visit", "mass", "replicate", "side", "reader")


class Exam(Record):
    """One exam of one mass: a row of the table."""

    file: str
    path: Path
    """`file`, `path`: As the table has it, and its absolute path; for a file in an object store only a name."""
    patient: str
    visit: str
    mass: str
    replicate: int
    """`patient`, `visit`, `mass`, `replicate`: Codes that name the exam."""
    day: date | None = None
    side: str | None = None
    reader: str | None = None
    """`day`, `side`, `reader`: None where the table leaves them blank."""
    centre_mm: tuple[float, float] | None = None
    """Place of the mass on the map; None takes the highest bump that can be a lump."""
    known: tuple[tuple[str, float], ...] = ()  #: Properties of the body, by the names of `KNOWN`.
    calibration: str | None = None  #: Name or path of a size calibration; None takes the campaign's.
    line: int = field(default=0)  #: Of the table.

    @property
    def address(self) -> str:
        """Address of a file in an object store; empty for one of this computer."""
        return self.file if is_address(self.file) else ""

    @property
    def of_mass(self) -> str:
        """Name of the mass at this visit, which is also its folder's."""
        return mass_name(patient=self.patient, visit=self.visit, mass=self.mass)

    @property
    def of_visits(self) -> str:
        """Name of the mass over all its visits, which is also its folder's."""
        return f"{self.patient}.m{self.mass}"

    @property
    def as_reading(self) -> Reading:
        """The exam as a reading that was done, for the order of visits; its size is not known yet."""
        key = (self.patient, self.mass)
        return Reading(key, "tactile", self.replicate, "not_detected", visit=self.visit, day=self.day)

    @property
    def name(self) -> str:
        """Name of the exam, which is also its folder's."""
        return exam_name(self.of_mass, self.replicate)

    @property
    def order(self) -> tuple[Any, ...]:
        """Sort key: patient, mass, visit and replicate, numbers by their value."""
        return (*map(natural_key, (self.patient, self.mass, self.visit)), self.replicate)


def natural_key(code: str) -> tuple[int, str]:
    """Sort key of a code: whole numbers by their value, words before them."""
    return (int(code) if code.isascii() and code.isdigit() else -1, code)


def read_manifest(path: Path) -> list[Exam]:
    """Read the table; exams come in the order of `Exam.order`, whatever the order of the rows.

    Besides cells that are not as ``exams.table.json`` has them it refuses a path that leaves the table's folder or has
    backslashes, half a place, codes that differ by capitals or leading zeros alone, rows of one mass that contradict
    each other, and visits of one mass whose order is not known.
    """
    if kind := "a folder" if path.is_dir() else kind_of(path):
        way_out = "give the table of exams: `tactile-bayes campaign init FOLDER -o exams.csv` writes one"
        raise BadDataError(f"is {kind}, not a table", way_out=way_out, path=str(path))
    table = read_table(path, SCHEMA)
    exams = [_exam(table, row) for row in range(len(table))]
    _check_spelling(table, exams)
    _check_masses(table, exams)
    at_excision([exam.as_reading for exam in exams], {}, fault=table.error)
    return sorted(exams, key=lambda exam: exam.order)


def _exam(table: Table, row: int) -> Exam:
    cells = {name: values[row] for name, values in table.columns.items()}
    x, y = cells["centre_x_mm"], cells["centre_y_mm"]
    if (x is None) != (y is None):
        blank = "centre_x_mm" if x is None else "centre_y_mm"
        raise table.error(row, blank, "is blank while the other coordinate is not", way_out="give both, or neither")
    calibration = cells["calibration"]
    if calibration is not None and calibration not in (*SHIPPED, NONE):
        calibration = str(_path_inside(table, row, "calibration", calibration))
    return Exam(
        path=_exam_path(table, row, cells["file"]),
        centre_mm=None if x is None else (x, y),
        known=tuple((name, cells[f"known_{name}"]) for name in KNOWN if cells[f"known_{name}"] is not None),
        calibration=calibration,
        day=cells["date"],
        line=table.line_numbers[row],
        **{name: cells[name] for name in _WRITTEN},
    )


def _exam_path(table: Table, row: int, name: str) -> Path:
    if not is_address(name):
        path = Path(os.path.abspath(_path_inside(table, row, "file", name)))  # noqa: PTH100 (links stay links)
        if "\\" in name and not os.path.lexists(path):
            way_out = "write the path from the table's folder with / between folders"
            raise table.error(row, "file", f"{_shown(name)} has backslashes, and no file is called so", way_out=way_out)
        return path
    try:
        return Path(check_address(name))
    except UsageError as error:
        raise table.error(row, "file", str(error), way_out="correct the address") from None


def _path_inside(table: Table, row: int, column: str, name: str) -> Path:
    """Path of a file that the table names; it must lie in the table's folder after following links."""
    folder = Path(os.path.realpath(table.path.parent))
    path = table.path.parent / name
    if Path(name).is_absolute() or not Path(os.path.realpath(path)).is_relative_to(folder):
        way_out = "give a path inside it, or put the table into a folder above the file"
        raise table.error(row, column, f"{_shown(name)} leaves the table's folder", way_out=way_out)
    return path


def _shown(name: str) -> str:
    """Path for a message: quoted, as it is in the table but for unprintable characters, cut to 80 characters."""
    short = name if len(name) <= 80 else f"{name[:77]}..."
    return f"'{short}'" if short.isprintable() and "'" not in short else repr(short)


def _check_spelling(table: Table, exams: Sequence[Exam]) -> None:
    """Refuse codes that `same_code` makes one: one may be mistyped, and on some disks their folders are one."""
    first: dict[tuple[str, str, str], tuple[str, int]] = {}
    for row, exam in enumerate(exams):
        for column in ("patient", "visit", "mass"):
            code, whose = getattr(exam, column), "" if column == "patient" else exam.patient
            spelled, line = first.setdefault((column, whose, same_code(code)), (code, exam.line))
            if code != spelled:
                apart = "leading zeros" if code.isdigit() else "capitals"
                fault = f"{code!r} differs from {spelled!r} on line {line} by {apart} alone"
                way_out = f"write it one way, or give the other {column} another code"
                raise table.error(row, column, fault, way_out=way_out)


def _check_masses(table: Table, exams: Sequence[Exam]) -> None:
    """Refuse rows of one mass that differ in what belongs to the mass or its body."""
    first_row: dict[tuple[str, str], int] = {}
    for row, exam in enumerate(exams):
        first_exam = exams[first_row.setdefault((exam.patient, exam.mass), row)]
        for column, name, value, first_value in (
            ("side", "side", exam.side, first_exam.side),
            ("calibration", "calibration", exam.calibration, first_exam.calibration),
            ("mass", "known values", dict(exam.known), dict(first_exam.known)),
        ):
            if value != first_value:
                fault = f"the {name} {value or 'blank'} differs from {first_value or 'blank'} on line {first_exam.line}"
                way_out = f"rows of patient {exam.patient}, mass {exam.mass} must agree: correct one"
                raise table.error(row, column, f"{fault}, of the same mass", way_out=way_out)


def write_manifest(path: Path, rows: Sequence[Mapping[str, object]], *, force: bool = False) -> None:
    """Write a table of exams; keys of the rows are columns, those that no row has are left out."""
    filled = [name for name in columns_of("exams") if any(row.get(name) is not None for row in rows)]
    write_text(path, table_text(rows, filled), force=force)


def read_rows(path: Path) -> RawTable:
    """Read the rows of a table as they stand, cells that are still blank included."""
    table = read_raw(path)
    for name in ("file", "patient", "visit", "mass", "replicate"):
        if name not in table.header:
            raise BadDataError(f"line 1, column {name}: is missing", way_out="add it", path=str(path))
    return table


def add_rows(table: RawTable, rows: Sequence[Mapping[str, object]]) -> None:
    """Write a table again with rows after those that it has, whose cells stay; its separator and columns stay too."""
    more = [name for name in columns_of("exams") if name not in table.header and any(row.get(name) for row in rows)]
    header = [*table.header, *more]
    out = io.StringIO(newline="")
    writer = csv.writer(out, delimiter=table.separator, lineterminator="\n")
    writer.writerow(header)
    writer.writerows([row.get(name, "") for name in header] for row in table.rows)
    writer.writerows([csv_cell(row.get(name)) for name in header] for row in rows)
    mark = "\ufeff" if read_bytes(table.path, most=TABLE_BYTES).startswith(b"\xef\xbb\xbf") else ""
    write_text(table.path, mark + out.getvalue(), force=True)


def columns_of(table: str) -> list[str]:
    """Columns of a table of a campaign, by its schema."""
    return [one["name"] for one in load_schema(f"{table}.table.json")["fields"]]


def table_text(rows: Sequence[Mapping[str, object]], columns: Sequence[str]) -> str:
    """CSV text of rows."""
    return csv_text(columns, ([row.get(name) for name in columns] for row in rows))
