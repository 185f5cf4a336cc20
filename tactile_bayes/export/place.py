"""Place of a map in the coordinate system of DICOM and 3D Slicer: L, P, S in mm from the xiphoid.

The program's `patient` frame has x to the patient's right, y from the xiphoid to the sternal notch and z into the body.
L, P, S are -x, z, y. Two landmarks and the normal of the scanned skin define it, no scanner: its origin is the xiphoid,
and its turn about the long axis of the body follows the skin, so that on the side of the breast P leans towards it.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from tactile_bayes.geometry import FloatArray, apply
from tactile_bayes.mapping.orientation import orientation_of
from tactile_bayes.mapping.tactile_map import TactileMap
from tactile_bayes.records import dataclass

LPS_FROM_PATIENT: Final[FloatArray] = np.array(
    [[-1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)


def lps_from_plane(tactile_map: TactileMap) -> FloatArray | None:
    """(4, 4) transform from the map's plane to L, P, S in mm; None without landmarks."""
    if tactile_map.patient_from_plane is None:
        return None
    transform: FloatArray = LPS_FROM_PATIENT @ tactile_map.patient_from_plane
    return transform


def on_plane(transform: FloatArray, point_mm: tuple[float, float]) -> FloatArray:
    """(3,) place of a point of the map's plane."""
    return apply(transform, np.array([*point_mm, 0.0]))


@dataclass(frozen=True, slots=True, eq=False)
class ImagePlane:
    """A map's values as the rows of an image that faces the viewer as every picture of the program does.

    Parameters
    ----------
    values : (rows, columns) array
        Row 0 on top; NaN without data.
    row_direction, column_direction : (3,) arrays or None
        Unit vectors in L, P, S along which the columns and the rows count up; None without a place in the patient.
    corner_mm : (3,) array or None
        Centre of the first value of the first row.
    """

    values: FloatArray
    row_direction: FloatArray | None = None
    column_direction: FloatArray | None = None
    corner_mm: FloatArray | None = None


def image_plane(tactile_map: TactileMap, *, placed: bool) -> ImagePlane:
    """Image of a map's means, with its place in the patient if `placed` and there are landmarks."""
    view = orientation_of(tactile_map)
    values = np.where(tactile_map.covered, tactile_map.mean, np.nan)
    shown = np.ascontiguousarray(view.screen(values))
    transform = lps_from_plane(tactile_map)
    if transform is None or not placed:
        return ImagePlane(shown)
    axes = {"x": (tactile_map.x_mm, transform[:3, 0]), "y": (tactile_map.y_mm, transform[:3, 1])}
    corner, directions = {}, []
    for towards, sign in ((view.right, 1.0), (view.up, -1.0)):
        centres, axis = axes[towards[1]]
        forward = (sign if towards[0] == "+" else -sign) > 0
        corner[towards[1]] = float(centres[0] if forward else centres[-1])
        directions.append(axis if forward else -axis)
    return ImagePlane(shown, *directions, on_plane(transform, (corner["x"], corner["y"])))
