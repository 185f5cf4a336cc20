"""The arrays of a scan in an .npz file, in words: for the help of `import` and its errors."""

from __future__ import annotations

from typing import Final

Shape = tuple[str | int, ...]
LAYOUT: Final[dict[str, tuple[Shape, str]]] = {
    "counts": (("n", "rows", "columns"), "raw readings, 0 to 65535; rows across the head (x), columns along it (y)"),
    "frame_time_s": (("n",), "time of each frame"),
    "position_mm": (("m", 3), "tracker sensor in the tracker's base frame"),
    "quaternion_wxyz": (("m", 4), "its rotation, scalar first, from the sensor to the base frame"),
    "pose_time_s": (("m",), "time of each pose, on the frames' clock"),
    "gain_kpa_per_count": (("rows", "columns"), "pressure in kPa = gain x counts + offset"),
    "offset_kpa": (("rows", "columns"), "see gain_kpa_per_count"),
    "pitch_mm": ((), "distance between neighbouring elements"),
    "array_from_tracker": ((4, 4), "transform from the tracker sensor to the scan head, mm"),
    "head_surface_mm": (("rows", "columns", 3), "element centres; origin at the apex of the face, z into the tissue"),
    "landmarks_mm": ((2, 3), "sternal notch and xiphoid in the base frame"),
    "saturation_count": ((), "readings at or above it carry no pressure; 4095 if left out"),
}
"""Shape and meaning of each array; n frames, m poses. Letters are lengths that must agree between arrays."""
OPTIONAL: Final = ("landmarks_mm", "saturation_count")


def in_words(shape: Shape) -> str:
    """A shape as the help and the errors name it: ``"m, 3"``, ``"one number"``."""
    return ", ".join(map(str, shape)) or "one number"


def layout_lines() -> list[str]:
    """A line for each array."""
    left_out = dict.fromkeys(OPTIONAL, ", may be left out")
    return [f"- {name} ({in_words(shape)}{left_out.get(name, '')}): {what}" for name, (shape, what) in LAYOUT.items()]
