"""A map as NRRD, in the patient's place (3D Slicer)."""

from __future__ import annotations

import io
import warnings
from typing import Any, Final

import numpy as np

from tactile_bayes.declarations import Record
from tactile_bayes.errors import BadDataError
from tactile_bayes.exports.exam import MapFile, required
from tactile_bayes.findings import finding_lines
from tactile_bayes.geometry import FloatArray, apply
from tactile_bayes.mapping.map import TactileMap
from tactile_bayes.mapping.places import orientation_of
from tactile_bayes.presets import RESEARCH_USE

# --- Place of a map in the coordinate system of DICOM and 3D Slicer: L, P, S in mm from the xiphoid.
#
# The program's `patient` frame has x to the patient's right, y from the xiphoid to the sternal notch and z into the
# body. L, P, S are -x, z, y. Two landmarks and the normal of the scanned skin define it, no scanner: its origin is
# the xiphoid, and its turn about the long axis of the body follows the skin, so that on the side of the breast P
# leans towards it.

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


class ImagePlane(Record, eq=False):
    """A map's values as the rows of an image that faces the viewer as every picture of the program does."""

    values: FloatArray
    """(rows, columns) array: Row 0 on top; NaN without data."""
    row_direction: FloatArray
    column_direction: FloatArray
    """`row_direction`, `column_direction` (3,) arrays: Unit vectors in L, P, S: along a row, and down a column."""
    corner_mm: FloatArray
    """(3,) array: Centre of the first value of the first row."""


def image_plane(tactile_map: TactileMap, transform: FloatArray) -> ImagePlane:
    """Image of a map's means, placed by a (4, 4) transform from its plane."""
    view = orientation_of(tactile_map)
    values = np.where(tactile_map.covered, tactile_map.mean, np.nan)
    axes = {"x": (tactile_map.x_mm, transform[:3, 0]), "y": (tactile_map.y_mm, transform[:3, 1])}
    corner, directions = dict[str, float](), list[FloatArray]()
    for towards, sign in ((view.right, 1.0), (view.up, -1.0)):
        centres, axis = axes[towards[1]]
        step = sign if towards[0] == "+" else -sign
        corner[towards[1]] = float(centres[0] if step > 0 else centres[-1])
        directions.append(step * axis)
    shown = np.ascontiguousarray(view.screen(values))
    along, down = directions
    return ImagePlane(shown, along, down, on_plane(transform, (corner["x"], corner["y"])))


# --- Maps as NRRD, the format of 3D Slicer: one slice in the patient's frame.


def nrrd_bytes(source: MapFile) -> bytes:
    """A map as the bytes of a NRRD file: float32 values (nx, ny, 1), NaN where there are none.

    The axes are the plane's, in ``left-posterior-superior`` and mm; the slice is as thick as a cell is wide.
    """
    nrrd = required("nrrd")
    one = source.tactile_map
    transform = lps_from_plane(one)
    if transform is None:
        raise BadDataError(
            "has no landmarks, so its place in the patient is not known",
            way_out="3D Slicer takes maps of scans in which sternal notch and xiphoid were touched",
            path=str(source.path),
        )
    values = np.where(one.covered, one.mean, np.nan).T[:, :, None].astype("<f4")
    header: dict[str, Any] = {
        "space": "left-posterior-superior",
        "kinds": ["domain", "domain", "domain"],
        "space units": ["mm", "mm", "mm"],
        "space directions": transform[:3, :3].T * one.recipe.cell_mm,
        "space origin": on_plane(transform, (float(one.x_mm[0]), float(one.y_mm[0]))),
        "encoding": "gzip",
        "content": "tactile map",
        "tactile_bayes_values": one.recipe.value_words.encode("ascii", "replace").decode(),
        "tactile_bayes_map_sha256": source.digest,
        "tactile_bayes_findings": " ".join(finding_lines(one.findings, paper=True)).encode("ascii", "replace").decode(),
        "tactile_bayes_research_use": RESEARCH_USE,
    }
    return _written(nrrd, values, header)


def _written(nrrd: Any, values: Any, header: dict[str, Any]) -> bytes:
    """Bytes of the file without the comment lines of the library, one of which has the time of day."""
    buffer = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # the library asks for the time in an old way
        nrrd.write(buffer, values, header, index_order="F", compression_level=9)
    head, _, data = buffer.getvalue().partition(b"\n\n")
    kept = [line for line in head.split(b"\n") if not line.startswith(b"#")]
    return b"\n".join(kept) + b"\n\n" + data
