"""How large a lump would be if it were soft, hard, centred on the gland's surface or resting on it: data and text."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from tactile_bayes.inference.summary import Quantity, nine_digits
from tactile_bayes.size.draws import SizePosterior

LEAST_CHANGE = 0.02
"""Of the size, from which a pair of suppositions is worth a line."""
PAIRS = (
    ("the lump soft", "soft", "hard", " ({:g} times as stiff as fat)", " ({:g} times)"),
    ("it centred on the gland's surface", "centred", "resting", "", " on the gland"),
)
"""Of suppositions, with the words of the first, and what follows each, a value in it."""


def supposed_document(size: SizePosterior | None, largest: Quantity | None) -> dict[str, Any] | None:
    """The property that is supposed, its value, and the largest size with it, by name; None without a size."""
    if size is None or largest is None:
        return None
    ends = {"median": largest.median, "low": largest.low, "high": largest.high}
    return {
        label: {
            "property": one.name,
            "value": one.value,
            "max_size_mm": {
                **{name: nine_digits(one.moved(end, median_mm=largest.median)) for name, end in ends.items()},
                "probability": largest.probability,
            },
        }
        for label, one in size.supposing.items()
    }


def supposed_lines(supposed: Mapping[str, Any] | None, median_mm: float, *, places: int) -> list[str]:
    """A line for each pair of suppositions that moves the largest size."""
    found = []
    for words, first, second, *follow in PAIRS:
        pair = _pair(supposed, median_mm, (first, second))
        if pair:
            values = [after.format(one["value"]) for after, one in zip(follow, pair, strict=True)]
            sizes = [_size(one["max_size_mm"], places) for one in pair]
            found.append(f"Were {words}{values[0]}: {sizes[0]}; {second}{values[1]}: {sizes[1]}.")
    return found


def supposed_line(supposed: Mapping[str, Any] | None, median_mm: float, *, places: int) -> list[str]:
    """A soft lump's size and a hard one's in a few words, for a short report; empty where they hardly differ.

    A lump softer than the calibration's may lie above the interval, and nothing on its map says so: the line does.
    """
    pair = _pair(supposed, median_mm, ("soft", "hard"))
    if not pair:
        return []
    (soft, soft_ratio), (hard, hard_ratio) = ((one["max_size_mm"]["median"], one["value"]) for one in pair)
    words = (
        f"No map shows stiffness: were the lump soft ({soft_ratio:g} times fat), {soft:.{places}f} mm; "
        f"hard ({hard_ratio:g} times), {hard:.{places}f} mm"
    )
    return [f"{words}; softer still, larger." if soft > hard else f"{words}."]


def _pair(supposed: Mapping[str, Any] | None, median_mm: float, names: tuple[str, str]) -> list[Mapping[str, Any]]:
    """Two suppositions, where one of them at least moves the largest size; empty otherwise."""
    pair = [] if supposed is None else [supposed[name] for name in names if name in supposed]
    moves = any(abs(one["max_size_mm"]["median"] / median_mm - 1) >= LEAST_CHANGE for one in pair)
    return pair if moves and len(pair) == 2 else []


def _size(size: Mapping[str, float], places: int) -> str:
    return "{median:.{0}f} mm ({low:.{0}f} to {high:.{0}f})".format(places, **size)
