"""Log-quadratic size calibrations as JSON: posterior mean and covariance, the ball's oval, domain."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from tactile_bayes.errors import BadDataError
from tactile_bayes.files.atomic import write_text
from tactile_bayes.files.provenance import Provenance
from tactile_bayes.files.schema import check_document, dump_json
from tactile_bayes.files.size_bodies_json import bodies_document, parse_bodies
from tactile_bayes.files.size_fat_json import fat_document, parse_fat
from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.size.fat_depth import POWERS, FatCubic
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
    return {
        "schema": SCHEMA,
        "research_use": RESEARCH_USE,
        "form": "log-quadratic",
        "parameters": list(PARAMETERS),
        **bodies_document(calibration),
        **({} if calibration.with_fat is None else {"fat_cubic": fat_document(calibration.with_fat, POWERS)}),
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
        fat = parse_fat(document["fat_cubic"], FatCubic) if "fat_cubic" in document else None
        return LogQuadratic(**parse_bodies(document), with_fat=fat)
    except BadDataError as error:
        raise error.at(path) from None
