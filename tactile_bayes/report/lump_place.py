"""Place of a lump in the breast, by clock and distance from the nipple, of an estimate and in words."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Final

import numpy as np

from tactile_bayes.findings import Finding
from tactile_bayes.mapping.clock_face import SIDES, ClockPosition, clock_position, clock_text

if TYPE_CHECKING:
    from tactile_bayes.mapping.tactile_map import TactileMap
    from tactile_bayes.posterior.lump.posterior import MapPosterior

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
