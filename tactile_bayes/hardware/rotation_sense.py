"""Test of a tracker's rotation convention (sensor to base, or inverse) by turning it about a fixed point."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from tactile_bayes.errors import BadDataError
from tactile_bayes.geometry import FloatArray, rotation_from_quaternion

LEAST_TURN_DEG: Final = 20.0
# How many times worse the wrong sense must fit before the right one is believed.
CLEAR: Final = 3.0


@dataclass(frozen=True, slots=True)
class RotationSense:
    """Fit of a fixed point under each sense of rotation, and the angle that the sensor was turned by.

    Parameters
    ----------
    as_given_mm, inverted_mm
        Root mean square distance of the point from its mean.
    turn_deg
        Largest rotation between two poses.
    """

    as_given_mm: float
    inverted_mm: float
    turn_deg: float

    def __str__(self) -> str:
        figures = f"the point stays within {self.as_given_mm:.2f} mm as given, {self.inverted_mm:.2f} mm inverted"
        if self.inverted_mm > CLEAR * self.as_given_mm:
            return f"{figures}: record as it is"
        if self.as_given_mm > CLEAR * self.inverted_mm:
            return f"{figures}: record with --invert-rotation"
        return f"{figures}: not clear; hold the point fixed and turn further, about two axes"


def rotation_sense(position_mm: FloatArray, quaternion_wxyz: FloatArray) -> RotationSense:
    """Fit a point that is fixed both in `base` and on the sensor, with the rotations as given and inverted.

    Parameters
    ----------
    position_mm : (n, 3) array
    quaternion_wxyz : (n, 4) array

    Raises
    ------
    BadDataError
        When the sensor was hardly turned: then both fit.

    Notes
    -----
    The point is at t on the sensor and at c in `base` with ``p + R t = c`` for every pose: six unknowns, least squares.
    """
    if len(position_mm) < 10:
        raise BadDataError(f"{len(position_mm)} poses are too few", way_out="turn the sensor for some seconds")
    rotation = rotation_from_quaternion(quaternion_wxyz)
    traces = np.einsum("nij,ij->n", rotation, rotation[0])
    turn = float(np.degrees(np.arccos(np.clip((traces - 1) / 2, -1, 1)).max()))
    if turn < LEAST_TURN_DEG:
        raise BadDataError(
            f"the sensor was turned by {turn:.0f} degrees only", way_out=f"turn it by {LEAST_TURN_DEG:g} or more"
        )
    inverse = rotation.transpose(0, 2, 1)
    return RotationSense(_spread_mm(position_mm, rotation), _spread_mm(position_mm, inverse), turn)


def _spread_mm(position_mm: FloatArray, rotation: FloatArray) -> float:
    minus = np.broadcast_to(-np.eye(3), rotation.shape)
    matrix = np.concatenate([rotation, minus], axis=2).reshape(-1, 6)
    wanted = -position_mm.reshape(-1)
    solution = np.linalg.lstsq(matrix, wanted, rcond=None)[0]
    rest = (matrix @ solution - wanted).reshape(-1, 3)
    return float(np.sqrt((rest**2).sum(axis=1).mean()))
