"""Parts of the documents of size calibrations."""

from __future__ import annotations

from typing import Any

import numpy as np

from tactile_bayes.errors import BadDataError
from tactile_bayes.geometry import FloatArray
from tactile_bayes.size.hidden import HiddenTerms, RoundSpread


def hidden_document(hidden: HiddenTerms) -> dict[str, Any]:
    """The hidden terms as plain data."""
    return {
        "names": list(hidden.names),
        "expected": numbers(hidden.expected),
        "covariance": numbers(hidden.covariance),
        "with_body": numbers(hidden.with_body),
        "body_variance": number(hidden.body_variance),
        **({"inverted": list(hidden.inverted)} if hidden.inverted else {}),
        **({"most_sd": number(hidden.most_sd)} if np.isfinite(hidden.most_sd) else {}),
    }


def parse_hidden(document: dict[str, Any] | None, *, terms: int) -> HiddenTerms | None:
    """Parse the hidden terms; `terms` is the number of terms of a map."""
    if document is None:
        return None
    names, k = tuple(document["names"]), len(document["names"])
    arrays = [array_of(document, name) for name in ("expected", "covariance", "with_body")]
    if [array.shape for array in arrays] != [(k, terms), (k, k), (k,)]:
        raise BadDataError("hidden has arrays of other sizes than its names", way_out="learn the calibration anew")
    expected, covariance, with_body = arrays
    return HiddenTerms(
        names,
        expected,
        covariance,
        with_body,
        body_variance=float(document["body_variance"]),
        inverted=tuple(document.get("inverted", ())),
        most_sd=float(document.get("most_sd", np.inf)),
    )


def round_document(coefficients: FloatArray, spread: RoundSpread) -> dict[str, Any]:
    """Maps of balls as plain data."""
    spreads = {name: number(getattr(spread, name)) for name in ("body_sd", "exam_sd", "map_factor")}
    return {"coefficients": numbers(coefficients), **spreads}


def parse_round_spread(balls: dict[str, Any]) -> RoundSpread:
    """Spread of balls' maps."""
    return RoundSpread(float(balls["body_sd"]), float(balls["exam_sd"]), float(balls["map_factor"]))


def array_of(document: dict[str, Any], name: str) -> FloatArray:
    """Array from nested lists of numbers.

    Raises
    ------
    BadDataError
        When its rows differ in length.
    """
    try:
        return np.asarray(document[name], dtype=np.float64)
    except ValueError:
        raise BadDataError(f"{name} has rows of different lengths", way_out="learn the calibration anew") from None


def number(value: float) -> float:
    """Round to nine significant digits."""
    return float(f"{value:.9g}")


def numbers(values: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> list[Any]:
    """Nested lists of numbers, rounded to nine significant digits."""
    if values.ndim == 1:
        return [number(value) for value in values]
    return [numbers(row) for row in values]
