"""Sources of error that a size leaves out, in words."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

SPREAD: Final = "spread between maps of one mass (15 % in the paper): this is one map"
ONE_WIDTH: Final = "a difference between the head's axes: the calibration has one width"


def head(calibration_head: object) -> str:
    """An unknown head as a source left out, where the calibration names its own."""
    return f"whether the map's head is the calibration's ({calibration_head}): the map does not name its head"


def fat_depth(why: str, *, other_sd: float = 0.0) -> str:
    """The depth of fat as a source left out, where maps do not give it.

    Parameters
    ----------
    why
    other_sd
        What the interval allows because the body is unlike the calibration's, as the SD of ln d.
    """
    left_out = f"the depth of the fat, which would narrow the size: {why}"
    return f"{left_out}; for such a body the interval allows {100 * other_sd:.0f} % (SD) more" if other_sd else left_out


def bodies(ranges: Mapping[str, tuple[float, float]]) -> str:
    """Bodies unlike those that a calibration was learned over as a source left out; these by their columns."""
    words = {
        "stiffness_ratio": "lumps {:.3g} to {:.3g} times as stiff as fat",
        "gland_ratio": "gland {:.3g} to {:.3g} times",
        "fat_kpa": "fat of {:.3g} to {:.3g} kPa",
    }
    parts = [text.format(*ranges[name]) for name, text in words.items() if name in ranges]
    return (
        f"bodies unlike the calibration's ({', '.join(parts)}, even layers, tissue that does not stiffen where it is "
        "pressed), whose sizes may lie outside the interval"
    )
