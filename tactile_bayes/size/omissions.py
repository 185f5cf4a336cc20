"""Sources of error that a size leaves out, in words."""

from __future__ import annotations

from typing import Final

SPREAD: Final = "spread between maps of one mass (15 % in the paper): this is one map"
ONE_WIDTH: Final = "a difference between the head's axes: the calibration has one width"


def head(calibration_head: object) -> str:
    """An unknown head as a source left out, where the calibration names its own."""
    return f"whether the map's head is the calibration's ({calibration_head}): the map does not name its head"


def fat_depth(why: str) -> str:
    """The depth of fat as a source left out, where maps do not give it."""
    return f"the depth of the fat, which would narrow the size: {why}"


def by_place(why: str) -> str:
    """The figures by place as a source left out, where maps do not give them."""
    return f"how the lump feels under each part of the head, which would narrow the size: {why}"
