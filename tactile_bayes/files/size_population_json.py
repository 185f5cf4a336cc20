"""Size calibrations over a population as JSON: Eq 6 and its residual, the spread of bodies, the depth of the fat."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from tactile_bayes.errors import BadDataError
from tactile_bayes.files.atomic import write_text
from tactile_bayes.files.provenance import Provenance
from tactile_bayes.files.schema import check_document, dump_json
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
from tactile_bayes.head_shape import DEFAULT_HEAD
from tactile_bayes.presets import HEAD_PROFILE, RESEARCH_USE
from tactile_bayes.size.body_calibration import BodyCalibration, block_diagonal
from tactile_bayes.size.eq6 import Recipe
from tactile_bayes.size.fat_depth import FatDepth
from tactile_bayes.size.hidden import RoundLumps
from tactile_bayes.size.residual import Residual

SCHEMA = "tactile-bayes/size-calibration/4"
SCHEMA_FILE = "size_population.schema.json"
FORM = "population"


def write_population(path: Path, calibration: BodyCalibration, *, provenance: Provenance, force: bool = False) -> None:
    """Write a calibration atomically; numbers keep nine significant digits, the covariance of the residual six."""
    document = {**population_document(calibration), "provenance": provenance.as_dict()}
    check_document(document, SCHEMA_FILE, path=path)
    write_text(path, dump_json(document), force=force)


def population_document(calibration: BodyCalibration) -> dict[str, Any]:
    """The calibration as plain data, without its provenance; see data_schema/size_population.schema.json."""
    one, k = calibration, len(calibration.eq6_powers)
    m, balls = one.coefficients - k, one.round_lumps
    alpha, p0, w0 = one.centre
    covariance = one.covariance
    return {
        "schema": SCHEMA,
        "research_use": RESEARCH_USE,
        "form": FORM,
        "source": one.source,
        "bodies": ranges(one.bodies),
        "recipe": one.recipe.as_dict(),
        "centre": {"log_amplitude": alpha, "log_width": p0, "log_fat": w0},
        "constants": {name: number(value) for name, value in one.constants().items()},
        "eq6": {
            "powers": [list(power) for power in one.eq6_powers],
            "mean": numbers(one.mean[:k]),
            "covariance": numbers(covariance[:k, :k]),
            "log_amplitude_one_deep": number(one.log_amplitude_one_deep),
        },
        "residual": None if one.residual is None else _residual_document(one.residual, one.mean[k : k + m],
                                                                          covariance[k : k + m, k : k + m]),
        "spread": {
            "powers": [list(power) for power in one.spread_powers],
            "mean": numbers(one.mean[k + m : -1]),
            "covariance": numbers(covariance[k + m : -1, k + m : -1]),
            "log_exam_sd": number(one.mean[-1]),
            "log_exam_sd_variance": number(covariance[-1, -1]),
            "other_sd": number(one.other_sd),
            "other_source": one.other_source,
        },
        "round_lumps": round_document(balls.coefficients, balls.spread),
        "depth": None if one.depth is None else _depth_document(one.depth),
        "feature_powers": [list(power) for power in one.feature_powers],
        "information_inverse": numbers(one.information_inverse),
        "most_leverage": number(one.most_leverage),
        "domain": ranges(one.domain),
        "hidden": None if one.hidden is None else hidden_document(one.hidden),
        "hidden_any": None if one.hidden_any is None else hidden_document(one.hidden_any),
        "fit": {name: number(value) for name, value in one.fit.items()},
    }  # fmt: skip


def parse_population(document: dict[str, Any], *, path: Path) -> BodyCalibration:
    """A calibration from a document that keeps the schema.

    Raises
    ------
    BadDataError
        When its numbers cannot be those of a calibration.
    """
    try:
        return _parsed(document)
    except BadDataError as error:
        raise error.at(path) from None


def _parsed(document: dict[str, Any]) -> BodyCalibration:
    eq6, spread, balls, centre = (document[name] for name in ("eq6", "spread", "round_lumps", "centre"))
    residual, weights, of_weights = _parse_residual(document["residual"])
    exam = np.array([[float(spread["log_exam_sd_variance"])]])
    blocks = [array_of(eq6, "covariance"), of_weights, array_of(spread, "covariance"), exam]
    return BodyCalibration(
        centre=(float(centre["log_amplitude"]), float(centre["log_width"]), float(centre["log_fat"])),
        mean=np.concatenate([array_of(eq6, "mean"), weights, array_of(spread, "mean"), [spread["log_exam_sd"]]]),
        covariance=block_diagonal([one for one in blocks if one.size]),
        round_lumps=RoundLumps(array_of(balls, "coefficients"), parse_round_spread(balls)),
        information_inverse=array_of(document, "information_inverse"),
        most_leverage=float(document["most_leverage"]),
        domain=_parse_ranges(document["domain"]),
        recipe=Recipe.from_document(document["recipe"], head=DEFAULT_HEAD),
        depth=None if document["depth"] is None else _parse_depth(document["depth"]),
        residual=residual,
        log_amplitude_one_deep=float(eq6["log_amplitude_one_deep"]),
        hidden=parse_hidden(document["hidden"], terms=len(document["information_inverse"])),
        hidden_any=parse_hidden(document["hidden_any"], terms=len(document["information_inverse"])),
        other_sd=float(spread["other_sd"]),
        other_source=spread["other_source"],
        fit={name: float(value) for name, value in document["fit"].items()},
        source=document["source"],
        bodies=_parse_ranges(document["bodies"]),
    )


def _residual_document(residual: Residual, mean: FloatArray, covariance: FloatArray) -> dict[str, Any]:
    """The covariance is kept as its Cholesky factor's rows, which stay one's own however they are rounded."""
    factor = np.linalg.cholesky(covariance)
    return {
        "points": numbers(residual.points),
        "lengths": numbers(residual.lengths),
        "scale": number(residual.scale),
        "mean": numbers(mean),
        "covariance_factor": [[float(f"{value:.6g}") for value in row[: i + 1]] for i, row in enumerate(factor)],
    }


def _parse_residual(document: dict[str, Any] | None) -> tuple[Residual | None, FloatArray, FloatArray]:
    if document is None:
        return None, np.zeros(0), np.zeros((0, 0))
    rows = document["covariance_factor"]
    factor = np.zeros((len(rows), len(rows)))
    for i, row in enumerate(rows):
        if len(row) != i + 1:
            raise BadDataError(f"row {i + 1} of covariance_factor has {len(row)} numbers", way_out="learn it anew")
        factor[i, : i + 1] = row
    residual = Residual(array_of(document, "points"), array_of(document, "lengths"), float(document["scale"]))
    return residual, array_of(document, "mean"), factor @ factor.T


def _depth_document(depth: FatDepth) -> dict[str, Any]:
    arrays = ("centre", "scale", "coefficients", "information_inverse", "expected")
    return {
        "profile": list(HEAD_PROFILE),
        **{name: numbers(getattr(depth, name)) for name in arrays},
        **{name: number(getattr(depth, name)) for name in ("most_leverage", "log_sd", "expected_sd")},
        "fat_mm": [number(end) for end in depth.fat_mm],
    }


def _parse_depth(document: dict[str, Any]) -> FatDepth:
    low, high = document["fat_mm"]
    return FatDepth(
        centre=array_of(document, "centre"),
        scale=array_of(document, "scale"),
        coefficients=array_of(document, "coefficients"),
        information_inverse=array_of(document, "information_inverse"),
        most_leverage=float(document["most_leverage"]),
        log_sd=float(document["log_sd"]),
        fat_mm=(float(low), float(high)),
        expected=array_of(document, "expected"),
        expected_sd=float(document["expected_sd"]),
    )


def ranges(ends: Mapping[str, tuple[float, float]]) -> dict[str, list[float]]:
    """Named ranges as plain data."""
    return {name: [number(low), number(high)] for name, (low, high) in ends.items()}


def _parse_ranges(document: Mapping[str, Any]) -> dict[str, tuple[float, float]]:
    return {name: (float(low), float(high)) for name, (low, high) in document.items()}
