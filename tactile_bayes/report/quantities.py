"""The quantities of an estimate and where its lump lies."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from tactile_bayes.findings import Finding
from tactile_bayes.geometry import FloatArray, apply
from tactile_bayes.inference.draws import Quantity, nine_digits, summarise
from tactile_bayes.mapping.map import TactileMap
from tactile_bayes.mapping.places import SIDES, ClockPosition, clock_position, clock_text
from tactile_bayes.posterior.result import Estimate
from tactile_bayes.size.draws import EXTREMES, SIZES, SizePosterior

if TYPE_CHECKING:
    from tactile_bayes.posterior.draw import MapPosterior


# --- Summaries of an estimate's draws, by name.

ANOTHER_EXAM = "another_exam"
"""Prefix of the sizes' quantities if another exam of the mass may come out apart, see `SizePosterior.another_exam`."""
WIDTHS = ("amplitude", "sigma_x_mm", "sigma_y_mm", "background", "noise_sd")


def leading(told: Mapping[str, Any]) -> Mapping[str, Any]:
    """What holds the sizes that lead, of an estimate's JSON object or one of its masses (record 0130).

    Until a site's repeatability is known these are the sizes for exams as far apart as patients' (`another_exam`); with
    it, or a stated spread, there is one interval.
    """
    another = told.get(ANOTHER_EXAM)
    return told if another is None else another


def leading_size(size: SizePosterior) -> SizePosterior:
    """The posterior of a size that leads; see `leading`."""
    return size if size.another_exam is None else size.another_exam


def estimate_quantities(estimate: Estimate, tactile_map: TactileMap, *, probability: float) -> dict[str, Quantity]:
    """Summaries of all quantities that an estimate has draws of, by name; empty without an estimate."""
    if estimate.map_posterior is None or estimate.draws is None:
        return {}
    posterior = estimate.map_posterior
    draws: dict[str, FloatArray] = {name: getattr(posterior, name) for name in WIDTHS}
    draws |= {"centre_mm.x": posterior.x_mm, "centre_mm.y": posterior.y_mm}
    if tactile_map.patient_from_plane is not None:
        on_plane = np.stack([posterior.x_mm, posterior.y_mm, np.zeros_like(posterior.x_mm)], axis=-1)
        in_patient = apply(tactile_map.patient_from_plane, on_plane)
        draws |= {"centre_patient_mm.x": in_patient[..., 0], "centre_patient_mm.y": in_patient[..., 1]}
    if estimate.diagnostics is not None and estimate.diagnostics.noise.rotated:
        draws["angle_deg"] = np.degrees(posterior.angle_rad)
    labels, worth = estimate.draws.labels, estimate.draws.effective_draws
    found = {
        name: summarise(d, probability=probability, effective_draws=worth, replicates=labels)
        for name, d in draws.items()
    }
    if estimate.size is not None:
        found |= {name: estimate.size.summarise(name, probability=probability) for name in SIZES}
        another = estimate.size.another_exam
        if another is not None:
            of_another = {name: another.summarise(name, probability=probability) for name in EXTREMES}
            found |= {f"{ANOTHER_EXAM}.{name}": quantity for name, quantity in of_another.items()}
    return found


def xiphoid_mm(quantities: Mapping[str, Quantity]) -> tuple[float, float] | None:
    """Place of the lump, mm from the xiphoid to the patient's right and up; None without landmarks or a lump."""
    if "centre_patient_mm.x" not in quantities:
        return None
    return quantities["centre_patient_mm.x"].median, quantities["centre_patient_mm.y"].median


def another_exam(size: SizePosterior | None, quantities: Mapping[str, Quantity]) -> dict[str, Any] | None:
    """The spread between exams of a mass as a share of its size, and both sizes with it; None where it is not told."""
    if size is None or size.another_exam is None:
        return None
    sizes = {name: quantities[f"{ANOTHER_EXAM}.{name}"].as_dict() for name in EXTREMES}
    share = {name: nine_digits(value) for name, value in size.another_exam.variance_share.items()}
    spread = nine_digits(size.another_exam.figures["between_map_sd"])
    return {"between_map_sd": spread, **sizes, "variance_share": share}


# --- Place of a lump in the breast, by clock and distance from the nipple, of an estimate and in words.

MIDDLE_MM: Final = 20.0
"""So far from the xiphoid a lump is on that side of the body, whatever is wrong with the landmarks' direction."""


def side_of(scans: Sequence[Mapping[str, str]]) -> str:
    """Which breast the scans say they are of, as `Provenance.scans` has them; empty where they do not agree."""
    sides = {scan.get("side", "") for scan in scans}
    return sides.pop() if len(sides) == 1 else ""


def lump_place(
    posterior: MapPosterior | None, tactile_map: TactileMap, scans: Sequence[Mapping[str, str]]
) -> ClockPosition | None:
    """Place of the measured lump about the nipple; None without a lump, landmarks, a nipple or a breast's side."""
    if posterior is None:
        return None
    x_mm, y_mm = posterior.x_mm.ravel(), posterior.y_mm.ravel()
    return clock_position(
        tactile_map,
        (float(np.median(x_mm)), float(np.median(y_mm))),
        side=side_of(scans),
        covariance_mm2=np.cov(x_mm, y_mm),
    )


def place_line(place: ClockPosition, probability: float) -> str:
    """The place with its intervals, as a line of a full report."""
    hours, (near, far) = place.hours_between(probability), place.distance_between(probability)
    clock = "" if hours is None else f" {clock_text(hours[0])} to {clock_text(hours[1])} o'clock and"
    return f"Place: {place.text()}; {100 * probability:g} % interval{clock} {near:.0f} to {far:.0f} mm."


def from_xiphoid(x_mm: float, y_mm: float) -> str:
    """A place in the patient's axes, in words."""
    across = f"{abs(x_mm):.0f} mm to the patient's {'right' if x_mm >= 0 else 'left'}"
    return f"{across} of the xiphoid and {abs(y_mm):.0f} mm {'above' if y_mm >= 0 else 'below'} it"


def side_findings(side: str, patient_mm: tuple[float, float] | None) -> tuple[Finding, ...]:
    """Caution where the landmarks put a lump on the other side of the body than the scans say; empty where they do not.

    Parameters
    ----------
    side
        As `side_of` gives it.
    patient_mm
        From the xiphoid to the patient's right and up; None without landmarks or a lump.
    """
    if side not in SIDES or patient_mm is None or abs(patient_mm[0]) < MIDDLE_MM:
        return ()
    other = "right" if patient_mm[0] > 0 else "left"
    if other == side:
        return ()
    place = f"the landmarks put the lump {abs(patient_mm[0]):.0f} mm to the patient's {other} of the xiphoid"
    return (Finding("side", f"the scan says {side} breast, and {place}: side or landmarks are wrong"),)


# --- Masses of a map that may be one lump: whether they touch, and how long they are together.

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
