"""A table of exams from a folder of scans and what they carry."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import field
from pathlib import Path
from typing import Any, Final

from tactile_bayes.errors import BadDataError, UsageError
from tactile_bayes.files.campaign_names import JOURNAL
from tactile_bayes.files.manifest_csv import natural
from tactile_bayes.files.remote import check_address, fetched, files_below
from tactile_bayes.records import dataclass

_FACTS: Final = {"patient": "subject", "visit": "visit", "mass": "mass", "side": "side", "reader": "examiner"}
_ENDINGS: Final = (".mcap", ".npz")
_DEFAULTS: Final = {"patient": "", "visit": "1", "mass": "1", "side": ""}
"""Cells of a scan that does not say; patient and side are left blank, for somebody to fill in."""


@dataclass(frozen=True, slots=True)
class Found:
    """Rows for exams.csv, and the files that give none, with the reason."""

    rows: list[dict[str, Any]] = field(default_factory=list)
    skipped: list[str] = field(default_factory=list)


def find_exams(folder: Path | str, table: Path) -> Found:
    """Look through a folder and those below it for scans (.mcap) and arrays of scans (.npz).

    Parameters
    ----------
    folder
        Of this computer, or the address of one in an object store.
    table
        Where the table will be: paths are written from its folder.

    Raises
    ------
    UsageError
        When the folder is none or cannot be read, or the table would lie outside it and not above it.
    """
    found = Found()
    for where, name in _local(folder, table, found) if isinstance(folder, Path) else _stored(folder):
        try:
            facts = _facts(where, name)
        except BadDataError as error:
            found.skipped.append(f"{name}: {error.what}")
        else:
            found.rows.append({"file": name, **_DEFAULTS, **facts})
    found.rows.sort(key=lambda row: (natural(row["patient"]), natural(row["visit"]), row["mass"], row["file"]))
    _number(found.rows)
    return found


def _local(folder: Path, table: Path, found: Found) -> Iterator[tuple[Path, str]]:
    """Files of a folder that may be scans, each with its name from the table's folder."""
    if not folder.is_dir():
        raise UsageError(f"{folder} is not a directory; give the folder of the scans")
    base = Path(os.path.realpath(table.parent))
    if not Path(os.path.realpath(folder)).is_relative_to(base):
        raise UsageError(f"{folder} is not inside {table.parent}, the table's folder; write the table beside the scans")
    for path in _files(folder, found):
        yield path, os.path.relpath(os.path.realpath(path.parent) + os.sep + path.name, base)


def _stored(address: str) -> Iterator[tuple[str, str]]:
    """Files in an object store that may be scans, each named by its address."""
    for one in files_below(check_address(address), *_ENDINGS):
        yield one, one


def _files(folder: Path, found: Found) -> Iterator[Path]:
    """Files that may be scans, in a fixed order; folders that a campaign wrote are passed over, closed ones noted."""

    def skip(error: OSError) -> None:
        if error.filename == os.fspath(folder):
            raise UsageError(f"{folder} cannot be read ({error.strerror}); give a folder that can")
        found.skipped.append(f"{error.filename}: cannot be read ({error.strerror})")

    for place, folders, names in os.walk(folder, onerror=skip):
        if JOURNAL in names:
            folders.clear()
            continue
        folders.sort()
        for name in sorted(names):
            if name.lower().endswith(_ENDINGS):
                yield Path(place) / name


def _facts(path: Path | str, name: str) -> dict[str, str]:
    """What a file says of its exam, by the columns of the table."""
    if name[0] in "=+@-" or name != name.strip() or not name.isprintable() or len(name) > 1000:
        raise BadDataError("the table takes no such file name: rename it")
    if name.lower().endswith(".npz"):
        return {}
    if isinstance(path, str):
        with fetched(path) as copy:
            return _facts(copy, name)
    from tactile_bayes.files.scan_mcap import scan_records

    session = scan_records(path, keep=()).metadata.get("session", {})
    return {column: session[key] for column, key in _FACTS.items() if session.get(key)}


def _number(rows: list[dict[str, Any]]) -> None:
    """Number the exams of each mass at each visit, in the order of their files."""
    count: dict[tuple[str, str, str], int] = {}
    for row in rows:
        key = (row["patient"], row["visit"], row["mass"])
        row["replicate"] = count[key] = count.get(key, 0) + 1
