"""The smallest lump that a map without one would have shown, in a sentence."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def smallest_text(smallest: Mapping[str, Any]) -> str:
    """What would have shown, by depth, where the map is best and where it is worst; without a full stop.

    Parameters
    ----------
    smallest
        As `SmallestLumps.as_dict` has it.
    """
    ends = zip(smallest["depths_mm"], smallest["best_mm"], smallest["worst_mm"], strict=True)
    told = [f"{_ends(best, worst)} at a depth of {depth:g} mm" for depth, best, worst in ends]
    share = f"{100 * smallest['probability']:g} %"
    return f"A ball would have shown with {share} from a diameter on of {'; '.join(told)} (of its middle), by its place"


def _ends(best: float | None, worst: float | None) -> str:
    """Diameters at the best place and at the worst."""
    if best is None:
        return "more than 30 mm"
    if worst is None:
        return f"{best:.3g} to more than 30 mm"
    return f"{best:.3g} mm" if best == worst else f"{best:.3g} to {worst:.3g} mm"
