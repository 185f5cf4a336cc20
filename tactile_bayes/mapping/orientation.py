"""Orientation of a map on the screen: one rule for every picture."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from tactile_bayes.geometry import FloatArray
from tactile_bayes.mapping.tactile_map import TactileMap

PATIENT_WORDS: Final = "seen facing the patient: head up, patient's left on the right"
PLANE_WORDS: Final = "no landmarks: seen from outside, y (along the head) up, x to the left"
GRID_WORDS: Final = "as the imported file reads: first row on top, x to the right, y down"
_PATIENT_SIDES: Final = {
    "R": "the patient's right",
    "L": "the patient's left",
    "H": "the patient's head",
    "F": "the patient's feet",
}


@dataclass(frozen=True, slots=True)
class Orientation:
    """Which axes of the plane point right and up on the screen.

    Parameters
    ----------
    right, up
        ``"+x"``, ``"-x"``, ``"+y"`` or ``"-y"``. Of the eight pairs only four are used: z, into the tissue, always
        points away from the viewer.
    words
        The orientation in a phrase, for captions.
    notch : (2,) tuple or None
        Unit vector to the sternal notch on the screen (to the right, upwards); None without landmarks.
    """

    right: str
    up: str
    words: str
    notch: tuple[float, float] | None = None

    @property
    def swapped(self) -> bool:
        """Whether y, not x, runs across the screen."""
        return self.right[1] == "y"

    @property
    def edges(self) -> Mapping[str, str]:
        """Labels of the picture's edges: the patient's R, L, H (head), F (feet), or else an axis."""
        if self.notch is not None:
            return {"left": "R", "right": "L", "top": "H", "bottom": "F"}
        return {"left": _opposite(self.right), "right": self.right, "top": self.up, "bottom": _opposite(self.up)}

    def side_words(self, axis: str) -> str:
        """Name a side of the map ("+x", "-x", "+y", "-y"): the patient's with landmarks, else the picture's."""
        screen = {self.right: "right", _opposite(self.right): "left", self.up: "top", _opposite(self.up): "bottom"}
        side = screen[axis]
        words = f"the picture's {side}" if self.notch is None else _PATIENT_SIDES[self.edges[side]]
        return f"{words} ({axis})"

    def screen(self, values: NDArray[Any]) -> NDArray[Any]:
        """The (ny, nx) values of a map as the rows of a picture: row 0 on top, column 0 on the left."""
        across = values if not self.swapped else values.T
        columns = across if self.right[0] == "+" else across[:, ::-1]
        return columns[::-1] if self.up[0] == "+" else columns

    def place(self, tactile_map: TactileMap, centre_mm: tuple[float, float]) -> tuple[float, float]:
        """Position of a point of the plane in the picture, in cells from its left and top edges."""
        axes = {"x": tactile_map.x_mm, "y": tactile_map.y_mm}
        point = dict(zip("xy", centre_mm, strict=True))
        half, cell = tactile_map.recipe.cell_mm / 2, tactile_map.recipe.cell_mm

        def along(axis: str) -> float:
            if axis[0] == "+":
                return float(point[axis[1]] - axes[axis[1]][0] + half) / cell
            return float(axes[axis[1]][-1] + half - point[axis[1]]) / cell

        return along(self.right), along(_opposite(self.up))


def orientation_of(tactile_map: TactileMap) -> Orientation:
    """Orientation in which a map is shown.

    The viewer looks along z, into the tissue, as an examiner does who faces the patient. With landmarks the plane is
    shown by the quarter turn that brings the sternal notch nearest to straight up; the patient's left is then on the
    viewer's right. Without landmarks y, along the scan head, is up, and x runs to the left. A grid that was imported
    has no outside and is shown as its file reads: first row on top, first column on the left.
    """
    if tactile_map.patient_from_plane is not None:
        return _towards(tactile_map.patient_from_plane[1, :2])
    if tactile_map.plane_from_base is not None:
        return Orientation("-x", "+y", PLANE_WORDS)
    return Orientation("+x", "-y", GRID_WORDS)


# What runs to the right when an axis is up and z points away from the viewer.
_RIGHT_OF_UP: Final = {"+y": "-x", "-y": "+x", "+x": "+y", "-x": "-y"}


def _towards(notch: FloatArray) -> Orientation:
    """Quarter turn that brings a direction of the plane nearest to straight up; y up where it has none."""
    length = float(np.hypot(*notch))
    x, y = (float(value) / length for value in notch) if length > 0 else (0.0, 1.0)
    along = {"+y": y, "-y": -y, "+x": x, "-x": -x}
    up = max(along, key=lambda axis: along[axis])
    return Orientation(_RIGHT_OF_UP[up], up, PATIENT_WORDS, (along[_RIGHT_OF_UP[up]], along[up]))


def _opposite(axis: str) -> str:
    return ("-" if axis[0] == "+" else "+") + axis[1]
