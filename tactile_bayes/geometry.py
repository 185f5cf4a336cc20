"""Rigid transforms, quaternions, the best-fit plane and the patient frame.

Frames: `base` (tracker, paper O), `scanhead` (paper S), `plane` (paper P), `patient` (paper C). A transform is a
(4, 4) matrix named by what it gives and takes: ``p_plane = plane_from_base @ p_base``.
"""

from __future__ import annotations

import math
from typing import Annotated, Final

import numpy as np
from numpy.typing import NDArray

from tactile_bayes.declarations import Meta, Record
from tactile_bayes.errors import BadDataError

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
IndexArray = NDArray[np.intp]
Vector = Annotated[FloatArray, Meta(extra_json_schema={"items": {"type": "number"}})]
"""Field of a record that holds a list of numbers in its files."""
Matrix = Annotated[FloatArray, Meta(extra_json_schema={"items": {"type": "array", "items": {"type": "number"}}})]
"""The same of a list of rows of numbers."""
NOT_RIGID = 1e-6  #: A rotation's R R^T departs from the identity by no more.


def rotation_from_quaternion(quaternion_wxyz: FloatArray) -> FloatArray:
    """(..., 3, 3) rotations of (..., 4) quaternions, scalar first; ``p_outer = R @ p_inner``.

    Quaternions are normalised first: rounding in a device would otherwise scale positions on the head.
    """
    unit = quaternion_wxyz / np.linalg.norm(quaternion_wxyz, axis=-1, keepdims=True)
    w, x, y, z = np.moveaxis(unit, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def quaternion_from_rotation(rotation: FloatArray) -> FloatArray:
    """(..., 4) unit quaternions, scalar first and not negative, of (..., 3, 3) rotations (Bar-Itzhack 2000)."""
    r = np.moveaxis(rotation, (-2, -1), (0, 1))
    none = np.zeros(r.shape[2:])
    gram = np.array(
        [
            [r[0, 0] - r[1, 1] - r[2, 2], none, none, none],
            [r[0, 1] + r[1, 0], r[1, 1] - r[0, 0] - r[2, 2], none, none],
            [r[0, 2] + r[2, 0], r[1, 2] + r[2, 1], r[2, 2] - r[0, 0] - r[1, 1], none],
            [r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1], r[0, 0] + r[1, 1] + r[2, 2]],
        ]
    )
    _, vectors = np.linalg.eigh(np.moveaxis(gram, (0, 1), (-2, -1)))  # reads the lower triangle
    quaternion = vectors[..., [3, 0, 1, 2], -1]
    return np.where(quaternion[..., :1] < 0, -quaternion, quaternion)


def unroll_quaternion_signs(quaternion_wxyz: FloatArray) -> FloatArray:
    """Flip signs so that neighbours lie on one hemisphere: q and -q are one rotation, but not for interpolation."""
    dots = np.einsum("ij,ij->i", quaternion_wxyz[1:], quaternion_wxyz[:-1])
    signs = np.cumprod(np.concatenate([[1.0], np.where(dots < 0, -1.0, 1.0)]))
    return quaternion_wxyz * signs[:, None]


def rigid(rotation: FloatArray, translation_mm: FloatArray) -> FloatArray:
    """(4, 4) transform from a (3, 3) rotation and a (3,) translation in mm."""
    transform = np.eye(4)
    transform[:3, :3] = rotation
    transform[:3, 3] = translation_mm
    return transform


def inverse(transform: FloatArray) -> FloatArray:
    """Inverse of a rigid transform, exact to rounding."""
    rotation = transform[:3, :3]
    return rigid(rotation.T, -rotation.T @ transform[:3, 3])


def apply(transform: FloatArray, points_mm: FloatArray) -> FloatArray:
    """Transform (..., 3) points in mm."""
    moved: FloatArray = points_mm @ transform[:3, :3].T + transform[:3, 3]
    return moved


def check_rigid(transform: FloatArray, *, name: str) -> None:
    """Raise `BadDataError` unless `transform` is a (4, 4) proper rigid motion."""
    if transform.shape != (4, 4) or not np.isfinite(transform).all():
        raise BadDataError(f"{name} must be a finite (4, 4) matrix (shape {transform.shape})")
    rotation = transform[:3, :3]
    departure = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    faults = {
        "its last row is not 0 0 0 1": not np.array_equal(transform[3], [0, 0, 0, 1]),
        f"R R^T departs from 1 by {departure:.1e}": departure > NOT_RIGID,
        "it mirrors": np.linalg.det(rotation) < 0,
    }
    if fault := next((words for words, wrong in faults.items() if wrong), ""):
        what = f"{name} is not a rigid transform ({fault})"
        raise BadDataError(what, way_out="give a proper rotation and a translation in mm, last row 0 0 0 1")


class Plane(Record, eq=False):
    """A plane fitted to points, with how well it is determined."""

    plane_from_base: FloatArray
    """(4, 4) array: Origin at the centroid, z along the sensor normal (into the tissue), x along the mean head x axis.
    """
    rms_mm: float  #: Root mean square distance of the points from the plane.
    spread_mm: FloatArray  #: (3,) array: Standard deviations of the points along the principal axes, descending.


def principal_axes(points_mm: FloatArray) -> FloatArray:
    """(3, 3) principal axes of (n, 3) points as columns, that of the least spread first."""
    deviations = points_mm - points_mm.mean(axis=0)
    return np.asarray(np.linalg.eigh(deviations.T @ deviations)[1])


def fit_plane(centroid_mm: FloatArray, covariance_mm2: FloatArray, *, head_x: FloatArray, head_z: FloatArray) -> Plane:
    """Best-fit plane from the (3,) mean and (3, 3) covariance of taxel centres in `base` (paper step i).

    Moments can be streamed and added, so the same plane comes from one scan or from its parts. The sign of the normal
    follows `head_z`, because eigenvectors have none; the x axis follows `head_x`, because widths are calibrated per
    axis of the head. Both are (3,) mean directions in `base`. `BadDataError` when the points lie too nearly on a line
    to span a plane, the normal disagrees with the head's, or `head_x` is zero or along the normal.
    """
    variances, axes = np.linalg.eigh(covariance_mm2)
    shortest, middle, longest = np.sqrt(np.maximum(variances, 0.0)).tolist()
    if not middle > 0.05 * longest or not middle > 1e-9:
        what = f"the taxel centres lie on a line (spread {longest:.3g} by {middle:.3g} mm)"
        raise BadDataError(what, way_out="scan with strokes side by side")
    normal = axes[:, 0]
    agreement = float(normal @ head_z) / max(float(np.linalg.norm(head_z)), 1e-300)
    if abs(agreement) < 0.9:
        angle = np.degrees(np.arccos(abs(agreement)))
        what = f"the plane of the motion and the head's face are {angle:.0f} degrees apart"
        raise BadDataError(what, way_out="check the quaternion order (scalar first) and scanhead_from_tracker")
    normal = normal if agreement > 0 else -normal
    x_axis = head_x - (head_x @ normal) * normal
    length, full = math.sqrt(x_axis @ x_axis), float(np.linalg.norm(head_x))
    if not length > 0.1 * full:
        projected = f"projected length {length:.2g} of {full:.2g}"
        what = f"the head's x axis is perpendicular to the plane of motion ({projected})"
        raise BadDataError(what, way_out="check scanhead_from_tracker, and keep the head's direction while scanning")
    x_axis = x_axis / length
    rotation = np.stack([x_axis, np.cross(normal, x_axis), normal])
    return Plane(rigid(rotation, -rotation @ centroid_mm), shortest, np.array([longest, middle, shortest]))


LEAST_APART_MM: Final = 1.0  #: Landmarks at most so far apart are one place.
LEAST_IN_PLANE: Final = 0.1  #: Least share of the line from xiphoid to sternal notch that lies in the plane.


def patient_from_base(sternal_notch_mm: FloatArray, xiphoid_mm: FloatArray, *, normal: FloatArray) -> FloatArray:
    """Transform to the patient frame, from two landmarks and the direction into the body.

    Origin at the xiphoid, y towards the sternal notch, z the part of `normal` (into the body) at right angles to y, x =
    y cross z. The two landmarks of the paper fix only y; z is this program's choice of the third direction.
    `BadDataError` when the landmarks coincide or their line runs along the normal.
    """
    along = sternal_notch_mm - xiphoid_mm
    length = float(np.linalg.norm(along))
    if not length > LEAST_APART_MM:
        what = f"sternal notch and xiphoid are {length:.2f} mm apart"
        raise BadDataError(what, way_out="correct them, or touch both before the scan")
    y_axis = along / length
    z_axis = normal - (normal @ y_axis) * y_axis
    size = float(np.linalg.norm(z_axis))
    if size < LEAST_IN_PLANE:
        what = "the line of the landmarks runs along the plane's normal"
        raise BadDataError(what, way_out="correct them, or touch both anew")
    z_axis = z_axis / size
    rotation = np.stack([np.cross(y_axis, z_axis), y_axis, z_axis])
    return rigid(rotation, -rotation @ xiphoid_mm)


def patient_from_plane(sternal_notch_mm: FloatArray, xiphoid_mm: FloatArray, plane_from_base: FloatArray) -> FloatArray:
    """(4, 4) as `patient_from_base` but from the plane, whose z points into the body; landmarks in `base`."""
    patient = patient_from_base(sternal_notch_mm, xiphoid_mm, normal=plane_from_base[2, :3])
    return np.asarray(patient @ inverse(plane_from_base))
