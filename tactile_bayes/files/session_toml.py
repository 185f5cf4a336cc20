"""Session facts of a recording as TOML: side, posture, lubricant, examiner, subject and other text."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Final

from tactile_bayes.errors import BadDataError
from tactile_bayes.files.documents import load_toml
from tactile_bayes.files.schema import check_document

if TYPE_CHECKING:
    from tactile_bayes.scan import Scan

SCHEMA: Final = "scan_session.schema.json"
SET_BY_RECORDING: Final = ("head_id", "tracker_id", "source", "clock", "rotation", "array_calibration_days")
"""Keys that the recording itself writes."""


def with_session(scan: Scan, path: Path | None) -> Scan:
    """The scan with the facts of a session file over its own; for the errors see `read_session`."""
    return scan if path is None else replace(scan, session={**scan.session, **read_session(path)})


def read_session(path: Path) -> dict[str, str]:
    """Read the session facts.

    Raises
    ------
    BadDataError
        When the file is not TOML, a value is not text as `scan_session.schema.json` has it, or a key is one of
        `SET_BY_RECORDING`.
    """
    document = load_toml(path, way_out=f"see {SCHEMA}")
    for key in SET_BY_RECORDING:
        if key in document:
            raise BadDataError(f"{key} is set by the recording itself", way_out=f"leave {key} out", path=str(path))
    check_document(document, SCHEMA, path=path)
    return {key: str(value) for key, value in document.items()}
