"""Log-quadratic size calibrations as JSON: posterior mean and covariance, what a ball's map looks like, domain."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from tactile_bayes.errors import BadDataError
from tactile_bayes.files.atomic import write_text
from tactile_bayes.files.provenance import Provenance
from tactile_bayes.files.schema import check_document, dump_json
from tactile_bayes.files.size_fat_json import fat_document, parse_fat
from tactile_bayes.files.size_parts_json import array_of, hidden_document, number, numbers, parse_hidden
from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.size.eq6 import Recipe
from tactile_bayes.size.hidden import RoundLumps
from tactile_bayes.size.log_quadratic import PARAMETERS, QUADRATIC, LogQuadratic

SCHEMA = "tactile-bayes/size-calibration/2"
SCHEMA_FILE = "size_quadratic.schema.json"


def write_log_quadratic(path: Path, calibration: LogQuadratic, *, provenance: Provenance, force: bool = False) -> None:
    """Write a calibration atomically; numbers keep nine significant digits."""
    document = log_quadratic_document(calibration, provenance)
    check_document(document, SCHEMA_FILE, path=path)
    write_text(path, dump_json(document), force=force)


def log_quadratic_document(calibration: LogQuadratic, provenance: Provenance) -> dict[str, Any]:
    """The calibration as plain data, see data_schema/size_quadratic.schema.json."""
    balls = calibration.round_lumps
    return {
        "schema": SCHEMA,
        "research_use": RESEARCH_USE,
        "form": "log-quadratic",
        "source": calibration.source,
        "recipe": calibration.recipe.as_dict(),
        "parameters": list(PARAMETERS),
        "centre": {"log_amplitude": calibration.centre[0], "log_width": calibration.centre[1]},
        "mean": numbers(calibration.mean),
        "covariance": numbers(calibration.covariance),
        "round_lumps": {
            "coefficients": numbers(balls.coefficients),
            "body_sd": number(balls.body_sd),
            "exam_sd": number(balls.exam_sd),
        },
        "information_inverse": numbers(calibration.information_inverse),
        "most_leverage": number(calibration.most_leverage),
        "domain": {name: [number(low), number(high)] for name, (low, high) in calibration.domain.items()},
        "hidden": None if calibration.hidden is None else hidden_document(calibration.hidden),
        "fit": {name: number(value) for name, value in calibration.fit.items()},
        **({} if calibration.fat_cubic is None else {"fat_cubic": fat_document(calibration.fat_cubic)}),
        "provenance": provenance.as_dict(),
    }


def parse_log_quadratic(document: dict[str, Any], *, path: Path) -> LogQuadratic:
    """A calibration from a document that keeps the schema.

    Raises
    ------
    BadDataError
        When its numbers cannot be those of a calibration.
    """
    balls = document["round_lumps"]
    try:
        return LogQuadratic(
            centre=(float(document["centre"]["log_amplitude"]), float(document["centre"]["log_width"])),
            mean=array_of(document, "mean"),
            covariance=array_of(document, "covariance"),
            round_lumps=RoundLumps(array_of(balls, "coefficients"), float(balls["body_sd"]), float(balls["exam_sd"])),
            information_inverse=array_of(document, "information_inverse"),
            most_leverage=float(document["most_leverage"]),
            domain={name: (float(low), float(high)) for name, (low, high) in document["domain"].items()},
            recipe=Recipe(**document["recipe"]),
            hidden=parse_hidden(document["hidden"], terms=len(QUADRATIC)),
            fit={name: float(value) for name, value in document["fit"].items()},
            source=document["source"],
            fat_cubic=parse_fat(document["fat_cubic"]) if "fat_cubic" in document else None,
        )
    except BadDataError as error:
        raise error.at(path) from None
