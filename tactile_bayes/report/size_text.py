"""Sentences about a size, shared by the reports of one map and of several."""

from __future__ import annotations

import math
from collections.abc import Mapping

SIZE_DECIMALS = 1
"""At most, whatever the Monte-Carlo error: sizes are compared with excisions, which are measured in mm."""
SOURCES = {
    "map": "the map",
    "between_maps": "spread between maps of one mass",
    "calibration": "the calibration's coefficients",
    "residual": "the scatter about Eq 6",
    "body": "properties of the body that no map shows",
    "site": "the correction by the site's phantoms",
    "shape": "whether the lump is round or oval",
}


def exams_label(spread: float | None) -> str:
    """What an interval supposes: how far exams of one mass are apart, as a share of its size; None for not at all."""
    return f"if exams differ by {100 * spread:.0f} %" if spread is not None else "if exams do not differ"


def two_intervals_text(this: float | None, another: float) -> str:
    """What the intervals of a size suppose, the leading one first; `this` is None for no spread between exams."""
    alike = "no spread" if this is None else f"{100 * this:.0f} %"
    return (
        f"The intervals of the sizes suppose that exams of one mass differ by {100 * another:.0f} %, as those of "
        f"patients did in the paper; the narrower one supposes {alike}, as those of simulated bodies do: what exams "
        "that repeat so well can buy. `calibrate repeatability` learns a site's own spread; then there is one interval."
    )


def site_interval_text(repeatability: str) -> str:
    """What the interval of a size supposes where the site's repeatability is known, from `Repeatability.words`."""
    return f"The interval is for any exam of the mass: {repeatability}."


def decimals(mc_error: float, *, most: int = 3) -> int:
    """Decimal places that the Monte-Carlo error of an interval's end supports."""
    if not mc_error > 0:
        return most
    return min(most, max(0, -math.floor(math.log10(2.0 * mc_error))))


def table_head(probability: float) -> str:
    """The first line of a table of medians and intervals."""
    return f"{'':28}{'median':>9}   {100 * probability:g} % interval (equal-tailed)"


def table_row(label: str, median: float, ends: tuple[float, float], *, unit: str, places: int) -> str:
    """Row of that table: label, median and interval with a number of decimal places."""
    interval = f"{ends[0]:.{places}f} to {ends[1]:.{places}f} {unit}".rstrip()
    return f"{label:28}{median:>9.{places}f}   {interval}"


def ends_text(name: str, mc_error: float, sd: float) -> str:
    """Monte-Carlo error of the ends of intervals, in SDs and mm."""
    return f"{name} {mc_error / sd:.3f} SD ({mc_error:.2g} mm)" if sd > 0 else f"{name} {mc_error:.2g} mm"


def shape_text(figures: Mapping[str, float]) -> str:
    """Whether the lump is sized as round or oval, and the difference that makes to the largest size."""
    lead = "Irregular outline. " if figures.get("irregular_outline") else ""
    probability = figures["oval_probability"]
    longer = 100 * math.expm1(figures["oval_half_log_ratio"])
    if probability < 0.005:
        text = "Sized as round; an oval lump is improbable (below 0.005)."
    elif probability < 0.5:
        text = f"Sized as round; an oval lump (probability {probability:.2f}) would be {longer:.0f} % longer."
    else:
        text = f"Oval (probability {probability:.2f}): {longer:.0f} % longer than a round lump of the same mean size."
    return lead + text
