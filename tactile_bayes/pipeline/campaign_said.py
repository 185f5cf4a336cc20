"""What a file says of its exam: facts of the session, and the files that it was made from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import field
from pathlib import Path
from typing import Any, Final

from tactile_bayes.errors import BadDataError
from tactile_bayes.records import dataclass

SCANS: Final = (".mcap", ".npz")
MAP: Final = ".nc"
_FACTS: Final = {"patient": "subject", "visit": "visit", "mass": "mass", "side": "side", "reader": "examiner"}
"""Columns of the table of exams, and what a scan calls the same."""


@dataclass(frozen=True, slots=True)
class Said:
    """What a file says of its exam.

    Parameters
    ----------
    facts
        By the columns of the table of exams.
    sources
        SHA-256 of the files that it was made from.
    """

    facts: Mapping[str, str] = field(default_factory=dict)
    sources: frozenset[str] = frozenset()


def said_by(path: Path, name: str) -> Said:
    """What a scan, arrays of a scan or a map say of the exam.

    Raises
    ------
    BadDataError
        When the table takes no such name, or the file is none of these.
    """
    check_name(name)
    if name.lower().endswith(".npz"):
        return Said()
    return _of_map(path) if name.lower().endswith(MAP) else _of_scan(path)


def check_name(name: str) -> None:
    """Refuse the name of a file that a table of exams does not take."""
    if name[0] in "=+@-" or name != name.strip() or not name.isprintable() or len(name) > 1000:
        raise BadDataError("the table takes no such file name: rename it")


def _of_scan(path: Path) -> Said:
    from tactile_bayes.files.scan_mcap import json_object, scan_records

    metadata = scan_records(path, keep=()).metadata
    made = json_object(metadata.get("provenance", {}).get("json", "{}"), name="provenance").get("inputs")
    inputs = made if isinstance(made, list) else []
    sources = frozenset(str(one.get("sha256")) for one in inputs if isinstance(one, dict))
    return Said(_facts([metadata.get("session", {})]), sources)


def _of_map(path: Path) -> Said:
    from tactile_bayes.files.map_nc import read_map_and_scans

    _, scans = read_map_and_scans(path)
    return Said(_facts(scans), frozenset(one["sha256"] for one in scans if "sha256" in one))


def _facts(sessions: Sequence[Mapping[str, Any]]) -> dict[str, str]:
    """Facts on which all scans of a file agree."""
    told = {column: {session.get(key) or "" for session in sessions} for column, key in _FACTS.items()}
    return {column: min(values) for column, values in told.items() if len(values) == 1 and values != {""}}
