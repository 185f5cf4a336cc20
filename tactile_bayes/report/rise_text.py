"""Sentences about other rises of a map."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from tactile_bayes.posterior.result import Rise


def rise_lines(rises: Sequence[Rise]) -> list[str]:
    """One line per other rise: place, probability of a lump, and the option that measures it."""
    return [
        f"Another rise stands at ({rise.x_mm:.1f}, {rise.y_mm:.1f}) mm{away_text(rise)}: probability of a lump "
        f"{rise.probability:.3f}, amplitude {rise.amplitude:.2g}. To measure it: --centre-mm {rise.x_mm:.1f} "
        f"{rise.y_mm:.1f}."
        for rise in rises
    ]


def away_text(rise: Rise) -> str:
    """Distance of a rise from the measured lump, to follow its place; empty without a lump."""
    return "" if rise.distance_mm is None else f", {rise.distance_mm:.0f} mm from this lump"
