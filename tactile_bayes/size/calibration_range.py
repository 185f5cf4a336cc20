"""Distance of a map's amplitude and width from the range that a size calibration was learned on.

Bodies simulated beyond the ranges of the table decide what follows (docs/decisions/0069): not far outside, intervals
hold and the size is given with a caution; farther out nothing is known of them, and there is no size.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from tactile_bayes.abstention import Abstention

FARTHEST = {"amplitude": 2.0, "sigma_mm": 1.2}
"""Sizes are given up to this multiple of the largest value in the table, and down to its smallest over it."""
UNLIKE_ON_PAPER = "nothing by this exam: the lump is unlike those that sizes were learned from"
UNITS = {"amplitude": "", "sigma_mm": " mm"}
Domain = Mapping[str, tuple[float, float]]


def outside_domain(domain: Domain, amplitude: float, sigma_mm: float) -> list[str]:
    """Quantities outside their ranges in a table, in words."""
    return _beyond(domain, amplitude, sigma_mm, factors=dict.fromkeys(FARTHEST, 1.0))


def too_far(domain: Domain, amplitude: float, sigma_mm: float) -> list[str]:
    """Quantities so far outside that no size is given, in words."""
    return _beyond(domain, amplitude, sigma_mm, factors=FARTHEST)


def beyond_lumps(domain: Domain, largest_mm: float) -> list[str]:
    """A size beyond the lumps of a table, in words; empty within. There it is the form that speaks, not the table."""
    low, high = domain.get("d_mm", (0.0, float("inf")))
    if not (largest_mm < low or largest_mm > high):
        return []
    return [f"largest size {largest_mm:.3g} mm (the table's lumps: {low:.3g} to {high:.3g} mm)"]


def extrapolated(far: Sequence[str]) -> Abstention:
    """Reason for no size: the map is too far outside the calibration's table to know the size's error."""
    advice = (
        "learn a calibration whose table holds such lumps (`population`, `calibrate size`), or give "
        "--size-calibration none for amplitude and widths"
    )
    reason = f"too far outside the calibration's range for a size: {'; '.join(far)}"
    return Abstention("extrapolated", reason, advice, UNLIKE_ON_PAPER)


def _beyond(domain: Domain, amplitude: float, sigma_mm: float, *, factors: Mapping[str, float]) -> list[str]:
    found = []
    for name, value in (("amplitude", amplitude), ("sigma_mm", sigma_mm)):
        (low, high), factor, unit = domain[name], factors[name], UNITS[name]
        if not low / factor <= value <= high * factor:
            found.append(f"{name.removesuffix('_mm')} {value:.3g}{unit} (table: {low:.3g} to {high:.3g}{unit})")
    return found
