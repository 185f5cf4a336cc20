"""The quantities of an estimate and where its lump lies."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import Final

import numpy as np

from tactile_bayes.declarations import Record, rounded
from tactile_bayes.files.reports import AnotherExam, Interval, MassReport, Place, Touching
from tactile_bayes.findings import Finding
from tactile_bayes.geometry import FloatArray, apply
from tactile_bayes.inference.draws import Quantity, summarise
from tactile_bayes.mapping.map import TactileMap
from tactile_bayes.mapping.places import SIDES, ClockPosition, Position, clock_position, clock_text
from tactile_bayes.posterior.draw import MapPosterior
from tactile_bayes.posterior.result import Estimate
from tactile_bayes.size.draws import EXTREMES, SIZES, SizePosterior

# --- Summaries of an estimate's draws, by name.

WIDTHS = ("amplitude", "sigma_x_mm", "sigma_y_mm", "background", "noise_sd")


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
    return found


def another_exam(size: SizePosterior | None, *, probability: float) -> AnotherExam | None:
    """The spread between exams of a mass as a share of its size, and both sizes with it; None where it is not told."""
    another = None if size is None else size.another_exam
    if another is None:
        return None
    largest, smallest = (another.summarise(name, probability=probability).rounded for name in EXTREMES)
    shares = rounded(dict(another.variance_share))
    return AnotherExam(rounded(another.figures["between_map_sd"]), largest, smallest, shares)


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


def place_line(place: Position) -> str:
    """The place with its intervals, as a line of a full report."""
    hours, distance = place.clock_hours, place.distance_mm
    clock = ""
    if hours.low is not None and hours.high is not None:
        clock = f" {clock_text(hours.low)} to {clock_text(hours.high)} o'clock and"
    ends = f"{distance.low:.0f} to {distance.high:.0f} mm"
    return f"Place: {place.text}; {100 * distance.probability:g} % interval{clock} {ends}."


def from_xiphoid(x_mm: float, y_mm: float) -> str:
    """A place in the patient's axes, in words."""
    across = f"{abs(x_mm):.0f} mm to the patient's {'right' if x_mm >= 0 else 'left'}"
    return f"{across} of the xiphoid and {abs(y_mm):.0f} mm {'above' if y_mm >= 0 else 'below'} it"


def side_findings(side: str, patient_mm: tuple[float, float] | None) -> tuple[Finding, ...]:
    """Caution where the landmarks put a lump on the other side of the body than the scans say; empty where they do not.

    `side`: as `side_of` gives it; `patient_mm`: from the xiphoid to the patient's right and up; None without landmarks
    or a lump.
    """
    if side not in SIDES or patient_mm is None or abs(patient_mm[0]) < MIDDLE_MM:
        return ()
    other = "right" if patient_mm[0] > 0 else "left"
    if other == side:
        return ()
    place = f"the landmarks put the lump {abs(patient_mm[0]):.0f} mm to the patient's {other} of the xiphoid"
    return (Finding("side", f"the scan says {side} breast, and {place}: side or landmarks are wrong"),)


# --- Masses of a map that may be one lump: whether they touch, and how long they are together.


class SizedPlace(Record):
    """A mass with its place and size, as far as it takes to tell whether it touches another."""

    number: int
    centre_mm: Place
    max_size_mm: Quantity | None


def touching_masses(masses: Sequence[MassReport | SizedPlace]) -> tuple[Touching, ...]:
    """Pairs of sized masses whose outlines may touch.

    Both lie in one body, so their errors go together: ends of the length are made of the same ends of both sizes. A
    pair touches where the upper ends of its radii reach over the distance of the centres.
    """
    found = []
    for one, other in combinations(masses, 2):
        size, beside = one.max_size_mm, other.max_size_mm
        if size is None or beside is None:
            continue
        apart = float(np.hypot(one.centre_mm.x - other.centre_mm.x, one.centre_mm.y - other.centre_mm.y))
        if apart <= (size.high + beside.high) / 2:
            ends = zip((size.median, size.low, size.high), (beside.median, beside.low, beside.high), strict=True)
            # one may lie within the other's outline
            median, low, high = (rounded(max(apart + (a + b) / 2, a, b)) for a, b in ends)
            length = Interval(median, low, high, size.probability)
            found.append(Touching((one.number, other.number), rounded(apart), length))
    return tuple(found)


def together_words(pair: Touching) -> str:
    """How long two masses are together."""
    length = pair.together_mm
    return f"together {length.median:.1f} mm long ({length.low:.1f} to {length.high:.1f})"


def touching_findings(pairs: Sequence[Touching]) -> list[Finding]:
    """Which masses may be one lump."""
    return [
        Finding("touching", "masses {} and {} may be one lump: ".format(*one.masses) + together_words(one))
        for one in pairs
    ]
