"""Frames that are kept with a map: a group of its netCDF file."""

from __future__ import annotations

from typing import Final

import numpy as np

from tactile_bayes.errors import BadDataError
from tactile_bayes.files.netcdf import Contents, Group, Variable
from tactile_bayes.mapping.frame_sample import STEP, FrameSample

FRAMES_GROUP: Final = "frames"
# field of the frames -> (variable, type, dimensions, attributes)
_FIELDS: dict[str, tuple[str, str, tuple[str, ...], dict[str, str]]] = {
    "steps": (
        "pressure",
        "u2",
        ("frame", "block"),
        {"units": "1", "long_name": "mean pressure of a block of 2 x 2 taxels over 20 ms, over the mean of the frame"},
    ),
    "plane_from_head": (
        "plane_from_head",
        "f8",
        ("frame", "row", "column"),
        {"long_name": "rows x and y of p_plane = plane_from_head p_scanhead (mm)"},
    ),
    "place_mm": (
        "place",
        "f8",
        ("block", "axis"),
        {"units": "mm", "long_name": "centre of the block of taxels in scanhead"},
    ),
}


def frame_contents(frames: FrameSample) -> Contents:
    """The group of a map's frames."""
    variables = {
        name: Variable(
            np.asarray(getattr(frames, field), kind),
            dimensions,
            attributes,
            scale=STEP if field == "steps" else None,
        )
        for field, (name, kind, dimensions, attributes) in _FIELDS.items()
    }
    return Contents(variables, {"title": "Some of the map's frames, averaged"})


def read_frames(file: Group, *, way_out: str) -> FrameSample | None:
    """The frames of a map's file; None where it has none.

    Raises
    ------
    BadDataError
        When a variable is missing, or its numbers cannot be those of frames.
    """
    group = file.group(FRAMES_GROUP)
    if group is None:
        return None
    arrays = {}
    for field, (name, kind, dimensions, _) in _FIELDS.items():
        arrays[field] = group.array(name, kind=kind, dimensions=dimensions)
        if arrays[field] is None:
            raise BadDataError(f"variable {FRAMES_GROUP}/{name} is missing", way_out=way_out)
    return FrameSample(arrays.pop("steps") * STEP, **arrays)
