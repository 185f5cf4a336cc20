"""Log-quadratic size calibrations as JSON: posterior mean and covariance, what a ball's map looks like, domain."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from tactile_bayes.errors import BadDataError
from tactile_bayes.files.atomic import write_text
from tactile_bayes.files.provenance import Provenance
from tactile_bayes.files.schema import check_document, dump_json
from tactile_bayes.posterior.log_quadratic import PARAMETERS, HiddenTerms, LogQuadratic, RoundLumps
from tactile_bayes.posterior.size_calibration import Recipe
from tactile_bayes.presets import RESEARCH_USE

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
        "mean": _numbers(calibration.mean),
        "covariance": _numbers(calibration.covariance),
        "round_lumps": {
            "coefficients": _numbers(balls.coefficients),
            "body_sd": _number(balls.body_sd),
            "exam_sd": _number(balls.exam_sd),
        },
        "information_inverse": _numbers(calibration.information_inverse),
        "most_leverage": _number(calibration.most_leverage),
        "domain": {name: [_number(low), _number(high)] for name, (low, high) in calibration.domain.items()},
        "hidden": None if calibration.hidden is None else _hidden_document(calibration.hidden),
        "fit": {name: _number(value) for name, value in calibration.fit.items()},
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
            mean=np.asarray(document["mean"], dtype=np.float64),
            covariance=np.asarray(document["covariance"], dtype=np.float64),
            round_lumps=RoundLumps(
                np.asarray(balls["coefficients"], dtype=np.float64), float(balls["body_sd"]), float(balls["exam_sd"])
            ),
            information_inverse=np.asarray(document["information_inverse"], dtype=np.float64),
            most_leverage=float(document["most_leverage"]),
            domain={name: (float(low), float(high)) for name, (low, high) in document["domain"].items()},
            recipe=Recipe(**document["recipe"]),
            hidden=_hidden(document["hidden"]),
            fit={name: float(value) for name, value in document["fit"].items()},
            source=document["source"],
        )
    except BadDataError as error:
        raise error.at(path) from None


def _hidden_document(hidden: HiddenTerms) -> dict[str, Any]:
    return {
        "names": list(hidden.names),
        "expected": _numbers(hidden.expected),
        "covariance": _numbers(hidden.covariance),
        "with_body": _numbers(hidden.with_body),
        "body_variance": _number(hidden.body_variance),
    }


def _hidden(document: dict[str, Any] | None) -> HiddenTerms | None:
    if document is None:
        return None
    names, k = tuple(document["names"]), len(document["names"])
    arrays = [np.asarray(document[name], dtype=np.float64) for name in ("expected", "covariance", "with_body")]
    if [array.shape for array in arrays] != [(k, 6), (k, k), (k,)]:
        raise BadDataError("hidden has arrays of other sizes than its names", way_out="learn the calibration anew")
    expected, covariance, with_body = arrays
    return HiddenTerms(names, expected, covariance, with_body, float(document["body_variance"]))


def _number(value: float) -> float:
    return float(f"{value:.9g}")


def _numbers(values: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> list[Any]:
    if values.ndim == 1:
        return [_number(value) for value in values]
    return [_numbers(row) for row in values]
