"""The part of a size calibration over a population that knows the depth of the fat, as JSON."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeVar

import numpy as np

from tactile_bayes.errors import BadDataError
from tactile_bayes.files.size_parts_json import (
    array_of,
    hidden_document,
    number,
    numbers,
    parse_hidden,
    parse_round_spread,
    round_document,
)
from tactile_bayes.geometry import FloatArray
from tactile_bayes.presets import BY_PLACE, HEAD_PROFILE
from tactile_bayes.size.fat_depth import ROUND, FatDepth, FatTerms
from tactile_bayes.size.fat_process import LINEAR_POWERS, SPREAD, FatProcess, Kernel, PlaceTable

Terms = TypeVar("Terms", bound=FatTerms)


def fat_document(fat: FatTerms, powers: Sequence[Sequence[int]]) -> dict[str, Any]:
    """As plain data, see ``fat_cubic`` in data_schema/size_quadratic.schema.json; `powers` are the coefficients'."""
    return {**_shared_document(fat, powers), "covariance": numbers(fat.covariance)}


def process_document(fat: FatProcess) -> dict[str, Any]:
    """As plain data, see ``fat_process`` in data_schema/size_quadratic.schema.json.

    The covariance is kept as its Cholesky factor's rows, which stay one's own however they are rounded.
    """
    kernel = fat.kernel
    assert kernel is not None
    factor = np.linalg.cholesky(fat.covariance)
    return {
        **_shared_document(fat, LINEAR_POWERS),
        "spread_powers": [list(one) for one in SPREAD],
        "kernel": {
            "points": numbers(kernel.points),
            "lengths": numbers(kernel.lengths),
            "scale": number(kernel.scale),
        },
        "other_sd": number(fat.other_sd),
        "map_factor": number(fat.map_factor),
        **({} if fat.places is None else {"places": _places_document(fat.places)}),
        **({} if fat.with_places is None else {"with_places": process_document(fat.with_places)}),
        "covariance_factor": [[float(f"{value:.6g}") for value in row[: i + 1]] for i, row in enumerate(factor)],
    }


def _places_document(places: PlaceTable) -> dict[str, Any]:
    return {
        "names": list(BY_PLACE),
        "centre": numbers(places.centre),
        "scale": numbers(places.scale),
        "information_inverse": numbers(places.information_inverse),
        "most_leverage": number(places.most_leverage),
    }


def _shared_document(fat: FatTerms, powers: Sequence[Sequence[int]]) -> dict[str, Any]:
    depth, (alpha, p0, w0) = fat.depth, fat.centre
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
        "powers": [list(one) for one in powers],
        "round_powers": [list(one) for one in ROUND],
        "centre": {"log_amplitude": alpha, "log_width": p0, "log_fat": w0},
        "mean": numbers(fat.mean),
        "round_lumps": round_document(fat.round_coefficients, fat.round_spread),
        "information_inverse": numbers(fat.information_inverse),
        "most_leverage": number(fat.most_leverage),
        "fat_mm": [number(end) for end in fat.fat_mm],
        "hidden": None if fat.hidden is None else hidden_document(fat.hidden),
        "fit": {name: number(value) for name, value in fat.fit.items()},
    }


def parse_fat(document: dict[str, Any], form: type[Terms]) -> Terms:
    """From plain data that keeps the schema.

    Raises
    ------
    BadDataError
        When its numbers cannot be those of a calibration.
    """
    return form(**_shared_fields(document), covariance=array_of(document, "covariance"))


def parse_process(document: dict[str, Any]) -> FatProcess:
    """From plain data that keeps the schema; raises as `parse_fat`."""
    kernel, rows = document["kernel"], document["covariance_factor"]
    factor = np.zeros((len(rows), len(rows)))
    for i, row in enumerate(rows):
        if len(row) != i + 1:
            raise BadDataError(f"row {i + 1} of covariance_factor has {len(row)} numbers", way_out="learn it anew")
        factor[i, : i + 1] = row
    points, lengths = array_of(kernel, "points"), array_of(kernel, "lengths")
    places, further = document.get("places"), document.get("with_places")
    if further is not None and (places is not None or "places" not in further):
        raise BadDataError("with_places is no process of figures by place", way_out="learn it anew")
    return FatProcess(
        **_shared_fields(document),
        covariance=factor @ factor.T,
        kernel=Kernel(points, lengths, float(kernel["scale"])),
        other_sd=float(document["other_sd"]),
        map_factor=float(document.get("map_factor", 1.0)),
        places=None if places is None else _parse_places(places),
        with_places=None if further is None else parse_process(further),
    )


def _parse_places(document: dict[str, Any]) -> PlaceTable:
    arrays = {name: array_of(document, name) for name in ("centre", "scale", "information_inverse")}
    return PlaceTable(**arrays, most_leverage=float(document["most_leverage"]))


def _shared_fields(document: dict[str, Any]) -> dict[str, Any]:
    depth, balls, centre = document["depth"], document["round_lumps"], document["centre"]
    low, high = document["fat_mm"]
    arrays = {name: array_of(depth, name) for name in ("centre", "scale", "coefficients")}
    return {
        "depth": FatDepth(
            **arrays,
            information_inverse=array_of(depth, "information_inverse"),
            most_leverage=float(depth["most_leverage"]),
            log_sd=float(depth["log_sd"]),
        ),
        "centre": (float(centre["log_amplitude"]), float(centre["log_width"]), float(centre["log_fat"])),
        "mean": array_of(document, "mean"),
        "round_coefficients": _round_coefficients(document),
        "round_spread": parse_round_spread(balls),
        "information_inverse": array_of(document, "information_inverse"),
        "most_leverage": float(document["most_leverage"]),
        "fat_mm": (float(low), float(high)),
        "hidden": parse_hidden(document["hidden"], terms=len(document["information_inverse"])),
        "fit": {name: float(value) for name, value in document["fit"].items()},
    }


def _round_coefficients(document: dict[str, Any]) -> FloatArray:
    """Coefficients of `ROUND`; files of earlier versions have fewer powers."""
    found, powers = array_of(document["round_lumps"], "coefficients"), document["round_powers"]
    if len(found) != len(powers):
        raise BadDataError(f"round_lumps has {len(found)} coefficients of {len(powers)} terms", way_out="learn it anew")
    whole = np.zeros(len(ROUND))
    for value, power in zip(found, powers, strict=True):
        whole[ROUND.index(tuple(power))] = value
    return whole
