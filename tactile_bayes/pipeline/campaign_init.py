"""A table of exams from a folder of scans and what they carry, new or added to one that is there."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import field
from pathlib import Path
from typing import Any, Final

from tactile_bayes.errors import BadDataError
from tactile_bayes.files.manifest_csv import natural
from tactile_bayes.files.remote import check_address, fetched, files_below, is_address
from tactile_bayes.pipeline.campaign_files import FolderFiles
from tactile_bayes.pipeline.campaign_said import SCANS, Said, check_name, said_by
from tactile_bayes.records import dataclass

_DEFAULTS: Final = {"patient": "", "visit": "1", "mass": "1", "side": ""}
"""Cells of a scan that does not say; patient and side are left blank, for somebody to fill in."""
_CODES: Final = ("patient", "visit", "mass")


@dataclass(frozen=True, slots=True)
class Found:
    """Rows for exams.csv, and what somebody should know of the folder.

    Parameters
    ----------
    rows
        Of files that the table does not list yet.
    skipped
        Files that give none, with the reason.
    spelled
        Codes that a file writes in other capitals than the table, in words.
    gone
        Files that the table lists and that are not there.
    others
        How many files are no exams by their names, by the ends of these.
    """

    rows: list[dict[str, Any]] = field(default_factory=list)
    skipped: list[str] = field(default_factory=list)
    spelled: list[str] = field(default_factory=list)
    gone: list[str] = field(default_factory=list)
    others: Mapping[str, int] = field(default_factory=dict)


def find_exams(folder: Path | str, table: Path, *, listed: Sequence[Mapping[str, str]] = ()) -> Found:
    """Look through a folder and those below it for scans (.mcap), arrays of scans (.npz) and maps (.nc).

    Parameters
    ----------
    folder
        Of this computer, or the address of one in an object store, whose maps are passed over.
    table
        Where the table is or will be: paths are written from its folder.
    listed
        Rows that the table has already.

    Raises
    ------
    UsageError
        When the folder is none or cannot be read, or the table would lie outside it and not above it.
    """
    known = {_normal(row["file"]): row for row in listed}
    found = _stored(folder, known) if isinstance(folder, str) else _local(folder, table, known)
    found.spelled.extend(_spell_as(listed, found.rows))
    found.rows.sort(key=_order)
    _number(found.rows, listed)
    found.gone.extend(row["file"] for name, row in known.items() if _is_gone(table.parent, name))
    return found


def _order(row: Mapping[str, str]) -> tuple[Any, ...]:
    return natural(row["patient"].casefold()), natural(row["visit"]), row["mass"], row["file"]


def _local(folder: Path, table: Path, known: Mapping[str, Mapping[str, str]]) -> Found:
    files = FolderFiles(folder, table)
    said: dict[str, Said] = {}
    found = Found(skipped=files.closed, others=files.others)
    for name, path in files.paths.items():
        try:
            said[name] = said_by(path, name)
        except BadDataError as error:
            if name not in known:
                found.skipped.append(f"{name}: {error.what}")
    repeated = files.repeated(said, known)
    found.skipped.extend(f"{name}: {reason}" for name, reason in repeated.items())
    new = (name for name in said if name not in repeated and name not in known)
    found.rows.extend({"file": name, **_DEFAULTS, **said[name].facts} for name in new)
    return found


def _stored(address: str, known: Mapping[str, Mapping[str, str]]) -> Found:
    """Scans in an object store, each named by its address."""
    found = Found()
    for one in files_below(check_address(address), *SCANS):
        if one in known:
            continue
        try:
            check_name(one)
            with fetched(one) as copy:
                facts = said_by(copy, one).facts
        except BadDataError as error:
            found.skipped.append(f"{one}: {error.what}")
        else:
            found.rows.append({"file": one, **_DEFAULTS, **facts})
    return found


def _normal(name: str) -> str:
    return name if is_address(name) else os.path.normpath(name)


def _is_gone(folder: Path, name: str) -> bool:
    return not is_address(name) and not os.path.lexists(folder / name)


def _spell_as(listed: Iterable[Mapping[str, str]], rows: Sequence[dict[str, Any]]) -> Iterator[str]:
    """Write codes that differ by capitals alone as the table or the first file does; `campaign run` takes one way."""
    first: dict[tuple[str, str, str], str] = {}
    for row in listed:
        for column in _CODES:
            first.setdefault(_code_key(row, column), row[column])
    for new in sorted(rows, key=lambda row: str(row["file"])):
        for column in _CODES:
            code = new[column]
            new[column] = first.setdefault(_code_key(new, column), code)
            if code != new[column]:
                yield f"{new['file']}: its {column} {code} is written {new[column]}, as in another row"


def _code_key(row: Mapping[str, str], column: str) -> tuple[str, str, str]:
    """What a code shares with those that differ from it by capitals alone; visits and masses are of one patient."""
    return column, "" if column == "patient" else row["patient"].casefold(), row[column].casefold()


def _number(rows: Sequence[dict[str, Any]], listed: Iterable[Mapping[str, str]]) -> None:
    """Number the exams of each mass at each visit, in the order of their files, after those listed."""
    last: dict[tuple[str, ...], int] = {}
    for row in listed:
        key = tuple(row[name] for name in _CODES)
        last[key] = max(last.get(key, 0), int(row["replicate"]) if row["replicate"].isdigit() else 0)
    for new in rows:
        key = tuple(new[name] for name in _CODES)
        new["replicate"] = last[key] = last.get(key, 0) + 1
