"""Sources of error that a size leaves out, in words."""

from __future__ import annotations

from typing import Final

SPREAD: Final = "spread between maps of one mass (15 % in the paper): this is one map"
ONE_WIDTH: Final = "a difference between the head's axes: the calibration has one width"


def fat_depth(why: str) -> str:
    """The depth of fat as a source left out, where maps do not give it."""
    return f"the depth of the fat, which would narrow the size: {why}"
