"""Sentences about a size, shared by the reports of one map and of several."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

SIZE_DECIMALS = 1
"""At most, whatever the Monte-Carlo error: sizes are compared with excisions, which are measured in mm."""
SOURCES = {
    "map": "the map",
    "between_maps": "spread between maps of one mass",
    "calibration": "the calibration's coefficients",
    "residual": "the scatter about Eq 6",
    "body": "properties of the body that no map shows",
    "shape": "whether the lump is round or oval",
}


def range_cautions(outside: Sequence[str]) -> list[str]:
    """The first lines of a report of a size outside its calibration's range."""
    return [f"CAUTION: outside the calibration's range: {text}." for text in outside]


def decimals(mc_error: float, *, most: int = 3) -> int:
    """Decimal places that the Monte-Carlo error of an interval's end supports."""
    if not mc_error > 0:
        return most
    return min(most, max(0, -math.floor(math.log10(2.0 * mc_error))))


def ends_text(name: str, mc_error: float, sd: float) -> str:
    """Monte-Carlo error of the ends of intervals, in SDs and mm."""
    return f"{name} {mc_error / sd:.3f} SD ({mc_error:.2g} mm)" if sd > 0 else f"{name} {mc_error:.2g} mm"


def shape_text(figures: Mapping[str, float]) -> str:
    """Whether an oval lump was called for, and what it would make of the largest size."""
    probability = figures["oval_probability"]
    longer = 100 * math.expm1(figures["oval_half_log_ratio"])
    if probability < 0.5:
        return f"Sized as round; an oval lump (probability {probability:.2f}) would be {longer:.0f} % longer."
    return f"Oval (probability {probability:.2f}): {longer:.0f} % longer than a round lump of the same mean size."
