"""The masses of a map as plain data, and in sentences."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from tactile_bayes.geometry import apply
from tactile_bayes.inference.summary import Quantity, nine_digits
from tactile_bayes.mapping.tactile_map import TactileMap
from tactile_bayes.posterior.abstention import chance_text
from tactile_bayes.posterior.result import Mass
from tactile_bayes.report.lump_place import lump_place
from tactile_bayes.report.quantities import ANOTHER_EXAM, another_exam, estimate_quantities, leading
from tactile_bayes.report.touching import together_words, touching_masses
from tactile_bayes.size.draws import SIZES

MassDocument = Mapping[str, Any]


def masses_document(
    masses: Sequence[Mass],
    tactile_map: TactileMap,
    *,
    probability: float,
    quantities: Mapping[str, Quantity],
    reason: str,
    scans: Sequence[Mapping[str, str]] = (),
) -> list[dict[str, Any]]:
    """JSON objects of a map's masses, numbered in their order; see data_schema/estimate.schema.json.

    Parameters
    ----------
    quantities, reason
        Of the reported mass, as the estimate has them.
    scans
        The scans at the beginning, which say which breast it is.
    """
    found = []
    for number, mass in enumerate(masses, start=1):
        own = quantities if mass.reported else estimate_quantities(mass.estimate, tactile_map, probability=probability)
        place = lump_place(mass.estimate.map_posterior, tactile_map, scans)
        why = reason if mass.reported else mass.estimate.reason
        position = None if place is None else place.as_dict(probability)
        found.append({"number": number, **_mass(mass, tactile_map, own, why), "position": position})
    return found


def _mass(mass: Mass, tactile_map: TactileMap, quantities: Mapping[str, Quantity], reason: str) -> dict[str, Any]:
    estimate = mass.estimate

    def one(name: str) -> dict[str, Any] | None:
        return quantities[name].as_dict() if name in quantities else None

    patient = patient_mm(tactile_map, mass.x_mm, mass.y_mm)
    return {
        "reported": mass.reported,
        "centre_mm": {"x": nine_digits(mass.x_mm), "y": nine_digits(mass.y_mm)},
        "centre_patient_mm": None if patient is None else {"x": nine_digits(patient[0]), "y": nine_digits(patient[1])},
        "detected_probability": nine_digits(mass.probability),
        "amplitude": one("amplitude"),
        **{name: one(name) for name in SIZES},
        "angle_deg": one("angle_deg"),
        ANOTHER_EXAM: another_exam(estimate.size, quantities),
        "reason": reason if estimate.size is None else "",
        "reason_code": estimate.code,
        "advice": estimate.advice,
    }


def patient_mm(tactile_map: TactileMap, x_mm: float, y_mm: float) -> tuple[float, float] | None:
    """A place on the map in mm from the xiphoid, to the patient's right and up; None without landmarks."""
    if tactile_map.patient_from_plane is None:
        return None
    x, y, _ = apply(tactile_map.patient_from_plane, np.array([x_mm, y_mm, 0.0]))
    return float(x), float(y)


def others(masses: Sequence[MassDocument]) -> list[MassDocument]:
    """The masses besides the reported one."""
    return [one for one in masses if not one["reported"]]


def mass_lines(masses: Sequence[MassDocument]) -> list[str]:
    """One line per mass besides the reported one: place, size or why there is none, probability."""
    here = next((one for one in masses if one["reported"]), None)
    return [f"Mass {one['number']} {mass_words(one, here)}." for one in others(masses)]


def mass_words(mass: MassDocument, here: MassDocument | None) -> str:
    """A mass's place, its distance from the reported one, its size or why it has none, and its probability."""
    x, y = (mass["centre_mm"][axis] for axis in "xy")
    place = f"at ({x:.1f}, {y:.1f}) mm"
    if here is not None:
        away = np.hypot(x - here["centre_mm"]["x"], y - here["centre_mm"]["y"])
        place += f", {away:.0f} mm from mass {here['number']}"
    if mass.get("position") is not None:
        place += f" ({mass['position']['text']})"
    size = leading(mass)["max_size_mm"]
    if size is None:
        told = f"no size: {mass['reason']}"
    else:
        share = f"{100 * size['probability']:g} %"
        told = f"largest size {size['median']:.1f} mm ({share} interval {size['low']:.1f} to {size['high']:.1f} mm)"
    if here is not None:
        for pair in touching_masses([here, mass]):
            told += f"; may be one lump with mass {here['number']}, {together_words(pair)}"
    return f"{place}: {told}; probability of a lump {chance_text(mass['detected_probability'])}"


def numbered(masses: Sequence[MassDocument]) -> str:
    """Which of the masses is reported, in words; empty where it is the only one."""
    here = next((one for one in masses if one["reported"]), None)
    return "" if here is None or len(masses) == 1 else f"Mass {here['number']} of {len(masses)}"
