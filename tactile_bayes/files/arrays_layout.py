"""Layout of a scan's arrays in an .npz file, for the help of `import`, its errors and docs/formats.md."""

from __future__ import annotations

from typing import Final, NamedTuple

Shape = tuple[str | int, ...]


class ArrayLayout(NamedTuple):
    """One array of a scan in an .npz file."""

    shape: Shape
    """Lengths of its axes; n frames, m poses. Letters are lengths that must agree between arrays."""
    meaning: str
    kind: str = "real"  #: Numbers it may have: ``integer`` or ``real``.
    unit: str = "1"  #: Of its numbers; ``1`` where they have none.
    frame: str = ""
    """Coordinate frame of places and directions, or the clock of times; empty where there is none."""


LAYOUT: Final[dict[str, ArrayLayout]] = {
    "counts": ArrayLayout(
        ("n", "rows", "columns"), "raw readings, 0 to 65535; rows across the head (x), columns along it (y)", "integer"
    ),
    "frame_time_s": ArrayLayout(("n",), "time of each frame", unit="s", frame="the frames' clock"),
    "position_mm": ArrayLayout(("m", 3), "tracker sensor in the tracker's base frame", unit="mm", frame="base"),
    "quaternion_wxyz": ArrayLayout(
        ("m", 4), "its rotation, scalar first, from the sensor to the base frame", frame="base from sensor"
    ),
    "pose_time_s": ArrayLayout(("m",), "time of each pose, on the frames' clock", unit="s", frame="the frames' clock"),
    "gain_kpa_per_count": ArrayLayout(
        ("rows", "columns"), "pressure in kPa = gain x counts + offset", unit="kPa/count"
    ),
    "offset_kpa": ArrayLayout(("rows", "columns"), "see gain_kpa_per_count", unit="kPa"),
    "pitch_mm": ArrayLayout((), "distance between neighbouring elements", unit="mm"),
    "array_from_tracker": ArrayLayout(
        (4, 4), "transform from the tracker sensor to the scan head, mm", unit="mm", frame="scanhead from sensor"
    ),
    "head_surface_mm": ArrayLayout(
        ("rows", "columns", 3),
        "element centres; origin at the apex of the face, z into the tissue",
        unit="mm",
        frame="scanhead",
    ),
    "landmarks_mm": ArrayLayout((2, 3), "sternal notch and xiphoid in the base frame", unit="mm", frame="base"),
    "nipple_mm": ArrayLayout((3,), "nipple in the base frame, beside landmarks_mm", unit="mm", frame="base"),
    "saturation_count": ArrayLayout((), "readings at or above it carry no pressure; 4095 if left out"),
}
"""Each array by its name."""
OPTIONAL: Final = ("landmarks_mm", "nipple_mm", "saturation_count")


def in_words(shape: Shape) -> str:
    """Format a shape for the help and the errors: ``"m, 3"``, ``"one number"``."""
    return ", ".join(map(str, shape)) or "one number"


def layout_lines() -> list[str]:
    """A line for each array."""
    left_out = dict.fromkeys(OPTIONAL, ", may be left out")
    return [f"- {name} ({in_words(one.shape)}{left_out.get(name, '')}): {one.meaning}" for name, one in LAYOUT.items()]
