"""What the files of both forms of a size calibration over a population share."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from tactile_bayes.files.size_parts_json import (
    array_of,
    hidden_document,
    number,
    numbers,
    parse_hidden,
    parse_round_spread,
    round_document,
)
from tactile_bayes.head_shape import DEFAULT_HEAD
from tactile_bayes.size.body_calibration import BodyCalibration
from tactile_bayes.size.eq6 import Recipe
from tactile_bayes.size.hidden import RoundLumps


def bodies_document(calibration: BodyCalibration) -> dict[str, Any]:
    """Its shared part as plain data; numbers keep nine significant digits."""
    balls = calibration.round_lumps
    return {
        "source": calibration.source,
        **({"bodies": ranges(calibration.bodies)} if calibration.bodies else {}),
        "recipe": calibration.recipe.as_dict(),
        "centre": {"log_amplitude": calibration.centre[0], "log_width": calibration.centre[1]},
        "mean": numbers(calibration.mean),
        "covariance": numbers(calibration.covariance),
        "round_lumps": round_document(balls.coefficients, balls.spread),
        "information_inverse": numbers(calibration.information_inverse),
        "most_leverage": number(calibration.most_leverage),
        "domain": ranges(calibration.domain),
        "hidden": None if calibration.hidden is None else hidden_document(calibration.hidden),
        "fit": {name: number(value) for name, value in calibration.fit.items()},
    }


def parse_bodies(document: dict[str, Any]) -> dict[str, Any]:
    """The arguments of a `BodyCalibration` from a document that keeps its schema.

    Raises
    ------
    BadDataError
        When its numbers cannot be those of a calibration.
    """
    balls = document["round_lumps"]
    return {
        "centre": (float(document["centre"]["log_amplitude"]), float(document["centre"]["log_width"])),
        "mean": array_of(document, "mean"),
        "covariance": array_of(document, "covariance"),
        "round_lumps": RoundLumps(array_of(balls, "coefficients"), parse_round_spread(balls)),
        "information_inverse": array_of(document, "information_inverse"),
        "most_leverage": float(document["most_leverage"]),
        "domain": {name: (float(low), float(high)) for name, (low, high) in document["domain"].items()},
        "recipe": Recipe.from_document(document["recipe"], head=DEFAULT_HEAD),
        "hidden": parse_hidden(document["hidden"], terms=len(document["information_inverse"])),
        "fit": {name: float(value) for name, value in document["fit"].items()},
        "source": document["source"],
        "bodies": {name: (float(low), float(high)) for name, (low, high) in document.get("bodies", {}).items()},
    }


def ranges(ends: Mapping[str, tuple[float, float]]) -> dict[str, list[float]]:
    """Named ranges as plain data."""
    return {name: [number(low), number(high)] for name, (low, high) in ends.items()}
