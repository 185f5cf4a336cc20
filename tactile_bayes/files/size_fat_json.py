"""The part of a log-quadratic size calibration that knows the depth of the fat, as JSON."""

from __future__ import annotations

from typing import Any

from tactile_bayes.files.size_parts_json import array_of, hidden_document, number, numbers, parse_hidden
from tactile_bayes.presets import HEAD_PROFILE
from tactile_bayes.size.fat_depth import POWERS, ROUND, FatCubic, FatDepth


def fat_document(cubic: FatCubic) -> dict[str, Any]:
    """As plain data, see ``fat_cubic`` in data_schema/size_quadratic.schema.json."""
    depth, (alpha, p0, w0) = cubic.depth, cubic.centre
    return {
        "depth": {
            "profile": list(HEAD_PROFILE),
            "centre": numbers(depth.centre),
            "scale": numbers(depth.scale),
            "coefficients": numbers(depth.coefficients),
            "information_inverse": numbers(depth.information_inverse),
            "most_leverage": number(depth.most_leverage),
            "log_sd": number(depth.log_sd),
        },
        "powers": [list(one) for one in POWERS],
        "round_powers": [list(one) for one in ROUND],
        "centre": {"log_amplitude": alpha, "log_width": p0, "log_fat": w0},
        "mean": numbers(cubic.mean),
        "covariance": numbers(cubic.covariance),
        "round_lumps": {
            "coefficients": numbers(cubic.round_coefficients),
            "body_sd": number(cubic.round_sd[0]),
            "exam_sd": number(cubic.round_sd[1]),
        },
        "information_inverse": numbers(cubic.information_inverse),
        "most_leverage": number(cubic.most_leverage),
        "fat_mm": [number(end) for end in cubic.fat_mm],
        "hidden": None if cubic.hidden is None else hidden_document(cubic.hidden),
        "fit": {name: number(value) for name, value in cubic.fit.items()},
    }


def parse_fat(document: dict[str, Any]) -> FatCubic:
    """From plain data that keeps the schema.

    Raises
    ------
    BadDataError
        When its numbers cannot be those of a calibration.
    """
    depth, balls, centre = document["depth"], document["round_lumps"], document["centre"]
    low, high = document["fat_mm"]
    arrays = {name: array_of(depth, name) for name in ("centre", "scale", "coefficients")}
    return FatCubic(
        depth=FatDepth(
            **arrays,
            information_inverse=array_of(depth, "information_inverse"),
            most_leverage=float(depth["most_leverage"]),
            log_sd=float(depth["log_sd"]),
        ),
        centre=(float(centre["log_amplitude"]), float(centre["log_width"]), float(centre["log_fat"])),
        mean=array_of(document, "mean"),
        covariance=array_of(document, "covariance"),
        round_coefficients=array_of(balls, "coefficients"),
        round_sd=(float(balls["body_sd"]), float(balls["exam_sd"])),
        information_inverse=array_of(document, "information_inverse"),
        most_leverage=float(document["most_leverage"]),
        fat_mm=(float(low), float(high)),
        hidden=parse_hidden(document["hidden"], terms=len(POWERS)),
        fit={name: float(value) for name, value in document["fit"].items()},
    )
