"""Sentences about other rises of a map."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from tactile_bayes.posterior.result import Rise


def rise_lines(rises: Sequence[Rise]) -> list[str]:
    """A line for each other rise: where it stands, how likely it is a lump, and how to measure it."""
    return [
        f"Another rise stands at ({rise.x_mm:.1f}, {rise.y_mm:.1f}) mm{_away(rise)}: probability of a lump "
        f"{rise.probability:.3f}, amplitude {rise.amplitude:.2g}. To measure it: --centre-mm {rise.x_mm:.1f} "
        f"{rise.y_mm:.1f}."
        for rise in rises
    ]


def _away(rise: Rise) -> str:
    return "" if rise.distance_mm is None else f", {rise.distance_mm:.0f} mm from this lump"
