"""Masses of a map that may be one lump: whether they touch, and how long they are together."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import Any

import numpy as np

from tactile_bayes.findings import Finding
from tactile_bayes.inference.summary import nine_digits

Touching = Mapping[str, Any]
_ENDS = ("median", "low", "high")


def touching_masses(masses: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Pairs of sized masses whose outlines may touch, as the JSON of an estimate has them.

    Parameters
    ----------
    masses
        As `masses_document` gives them.

    Returns
    -------
    list of dict
        ``masses``: their numbers; ``apart_mm``: between their centres; ``together_mm``: length over both, with the
        ends of its interval, in mm.

    Notes
    -----
    Both lie in one body, so their errors go together: ends of the length are made of the same ends of both sizes. A
    pair touches where the upper ends of its radii reach over the distance of the centres.
    """
    sized = [one for one in masses if one["max_size_mm"] is not None]
    found = []
    for one, other in combinations(sized, 2):
        apart = _apart_mm(one, other)
        radii = {end: (one["max_size_mm"][end] + other["max_size_mm"][end]) / 2 for end in _ENDS}
        if apart <= radii["high"]:
            # one may lie within the other's outline
            larger = {end: max(mass["max_size_mm"][end] for mass in (one, other)) for end in _ENDS}
            together = {end: nine_digits(max(apart + radii[end], larger[end])) for end in _ENDS}
            together["probability"] = one["max_size_mm"]["probability"]
            numbers = [one["number"], other["number"]]
            found.append({"masses": numbers, "apart_mm": nine_digits(apart), "together_mm": together})
    return found


def _apart_mm(one: Mapping[str, Any], other: Mapping[str, Any]) -> float:
    return float(np.hypot(*(one["centre_mm"][axis] - other["centre_mm"][axis] for axis in "xy")))


def together_words(pair: Touching) -> str:
    """How long two masses are together."""
    length = pair["together_mm"]
    return f"together {length['median']:.1f} mm long ({length['low']:.1f} to {length['high']:.1f})"


def touching_findings(pairs: Sequence[Touching]) -> list[Finding]:
    """Which masses may be one lump."""
    return [
        Finding("touching", "masses {} and {} may be one lump: ".format(*one["masses"]) + together_words(one))
        for one in pairs
    ]
