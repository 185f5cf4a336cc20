"""Log-quadratic size calibrations as JSON: posterior mean and covariance, the ball's oval, domain."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from tactile_bayes.errors import BadDataError
from tactile_bayes.files.atomic import write_text
from tactile_bayes.files.provenance import Provenance
from tactile_bayes.files.schema import check_document, dump_json
from tactile_bayes.files.size_bodies_json import bodies_document, parse_bodies
from tactile_bayes.files.size_fat_json import fat_document, parse_fat, parse_process, process_document
from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.size.fat_depth import POWERS, FatCubic, FatTerms
from tactile_bayes.size.fat_process import FatProcess
from tactile_bayes.size.log_quadratic import PARAMETERS, LogQuadratic

SCHEMA = "tactile-bayes/size-calibration/2"
SCHEMA_FILE = "size_quadratic.schema.json"


def write_log_quadratic(path: Path, calibration: LogQuadratic, *, provenance: Provenance, force: bool = False) -> None:
    """Write a calibration atomically; numbers keep nine significant digits."""
    document = log_quadratic_document(calibration, provenance)
    check_document(document, SCHEMA_FILE, path=path)
    write_text(path, dump_json(document), force=force)


def log_quadratic_document(calibration: LogQuadratic, provenance: Provenance) -> dict[str, Any]:
    """The calibration as plain data, see data_schema/size_quadratic.schema.json."""
    fat, part = calibration.with_fat, {}
    if isinstance(fat, FatProcess):
        part = {fat.file_key: process_document(fat)}
    elif fat is not None:
        part = {fat.file_key: fat_document(fat, POWERS)}
    return {
        "schema": SCHEMA,
        "research_use": RESEARCH_USE,
        "form": "gaussian-process" if isinstance(fat, FatProcess) else "log-quadratic",
        "parameters": list(PARAMETERS),
        **bodies_document(calibration),
        **part,
        "provenance": provenance.as_dict(),
    }


def parse_log_quadratic(document: dict[str, Any], *, path: Path) -> LogQuadratic:
    """Parse a calibration from a document that passed the schema.

    Raises
    ------
    BadDataError
        When its numbers cannot be those of a calibration.
    """
    try:
        fat: FatTerms | None = None
        if "fat_process" in document:
            fat = parse_process(document["fat_process"])
        elif "fat_cubic" in document:
            fat = parse_fat(document["fat_cubic"], FatCubic)
        return LogQuadratic(**parse_bodies(document), with_fat=fat)
    except BadDataError as error:
        raise error.at(path) from None
