"""Which mass of each map is the one that is pooled: by its place in the patient.

A report is about the surest mass of its map, so of two maps of one breast each may report another one. With landmarks
the masses of all maps have places in patient axes, and the one that most maps show is pooled.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from tactile_bayes.pipeline.one_map import Answer
from tactile_bayes.presets import MATCH_MM
from tactile_bayes.records import dataclass
from tactile_bayes.size.visits import Place as PatientPlace

Document = Mapping[str, Any]
Place = tuple[float, float]


@dataclass(frozen=True, slots=True)
class _Mass:
    """A mass of one map: its places in the patient and on the map, mm, and what ranks it."""

    patient_mm: Place
    map_mm: Place
    sized: bool
    reported: bool
    amplitude: float

    def away_mm(self, other: _Mass) -> float:
        return float(np.hypot(*np.subtract(self.patient_mm, other.patient_mm)))


def of_one_mass(answers: Sequence[Answer], again: Callable[[int, Place], Answer]) -> list[Answer]:
    """Answers for the mass that most maps show; a map whose report is about another one is estimated at its place.

    Parameters
    ----------
    again
        Takes the number of a map in the list and a place on it, and gives the answer there.
    """
    found = list(answers)
    for i, place in elsewhere([one.document for one in answers]).items():
        found[i] = again(i, place)
    return found


def elsewhere(documents: Sequence[Document | None]) -> dict[int, Place]:
    """Maps that report another mass than the common one, with the place of that one on each, mm.

    Empty where a map with a lump has no landmarks, or no two maps show a mass at one place.
    """
    maps = _masses(documents)
    common = None if maps is None else _common(maps)
    if maps is None or common is None:
        return {}
    there = {i: _nearest(masses, common) for i, masses in maps.items()}
    return {i: one.map_mm for i, one in there.items() if one is not None and not one.reported}


def apart_from_others(documents: Sequence[Document | None]) -> dict[int, str]:
    """Maps whose reported mass lies elsewhere than the common one, in words; empty without landmarks."""
    maps = _masses(documents)
    if maps is None:
        return {}
    reported = {i: [one for one in masses if one.reported] for i, masses in maps.items()}
    found = [one for masses in reported.values() for one in masses]
    common = _common(reported) or max(found, key=lambda one: one.amplitude, default=None)
    away = {i: one.away_mm(common) for i, masses in reported.items() for one in masses if common is not None}
    words = "its mass lies {:.0f} mm from that of the other maps and may be another one"
    return {i: words.format(mm) for i, mm in away.items() if mm > MATCH_MM}


def one_place(documents: Sequence[Document | None]) -> bool | None:
    """Whether the reported masses of all maps lie at one place; None where that cannot be told."""
    maps = _masses(documents)
    if maps is None or len(maps) < 2:
        return None
    return not apart_from_others(documents)


def _masses(documents: Sequence[Document | None]) -> dict[int, list[_Mass]] | None:
    """Masses of the maps with a lump, by the map's place in the list; None where one has no place in the patient."""
    found: dict[int, list[_Mass]] = {}
    for i, document in enumerate(documents):
        listed = [] if document is None else document.get("masses", [])
        if any(one.get("centre_patient_mm") is None for one in listed):
            return None
        if listed:
            found[i] = [_mass(one) for one in listed]
    return found


def _mass(document: Document) -> _Mass:
    patient, here, amplitude = document["centre_patient_mm"], document["centre_mm"], document["amplitude"]
    return _Mass(
        (patient["x"], patient["y"]), (here["x"], here["y"]), document["max_size_mm"] is not None,
        document["reported"], 0.0 if amplitude is None else amplitude["median"],
    )  # fmt: skip


def _common(maps: Mapping[int, Sequence[_Mass]]) -> _Mass | None:
    """A mass at the place where most maps show one, sized by most, then reported by most; None where all are apart."""
    best = max((one for masses in maps.values() for one in masses), key=lambda one: _worth(maps, one), default=None)
    return best if best is not None and _worth(maps, best)[0] > 1 else None


def _worth(maps: Mapping[int, Sequence[_Mass]], common: _Mass) -> tuple[int, int, int, float]:
    """On how many maps a mass is found, sized and reported, and the median of its amplitudes."""
    there = [one for one in (_nearest(masses, common) for masses in maps.values()) if one is not None]
    amplitude = float(np.median([one.amplitude for one in there]))
    return len(there), sum(one.sized for one in there), sum(one.reported for one in there), amplitude


def _nearest(masses: Sequence[_Mass], common: _Mass) -> _Mass | None:
    """The mass nearest to a place, if it lies within `MATCH_MM` of it."""
    near = min(masses, key=common.away_mm, default=None)
    return near if near is not None and near.away_mm(common) <= MATCH_MM else None


def place_of(document: Document | None) -> PatientPlace | None:
    """Where a map's reported mass lies in the patient; None without a lump or landmarks."""
    centre = None if document is None else document["centre_patient_mm"]
    if centre is None:
        return None
    x, y = centre["x"], centre["y"]
    return PatientPlace(np.array([x["median"], y["median"]]), np.diag([x["sd"] ** 2, y["sd"] ** 2]))
