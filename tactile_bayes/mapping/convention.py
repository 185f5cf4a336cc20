"""In which order and sense a tracker tells its rotations: what the motion of the head says about it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tactile_bayes.geometry import FloatArray, inverse, rotation_from_quaternion
from tactile_bayes.mapping.frames import SelectedFrames
from tactile_bayes.mapping.poses import distinct_poses

# What a file may hold instead of (w, x, y, z) from the sensor to the base: how to read it.
CONVENTIONS = {
    "scalar first": ((0, 1, 2, 3), 1.0),
    "scalar last": ((3, 0, 1, 2), 1.0),
    "scalar first, of the inverse rotation": ((0, 1, 2, 3), -1.0),
    "scalar last, of the inverse rotation": ((3, 0, 1, 2), -1.0),
}
# A head slides along its face: the mean normal of the face and the normal of the motion agree at least so well.
AGREEMENT = 0.9


def convention_agreement(selections: Sequence[SelectedFrames]) -> dict[str, float]:
    """|sensor normal . normal of the motion| under each of `CONVENTIONS`; below `AGREEMENT` it cannot be the right one.

    The motion's normal is that of the places of the head's apex, which need the rotation for the lever arm; the
    sensor's normal is the mean of the face's, so that rotations that contradict each other count against.
    """
    return {name: _agreement(selections, *how) for name, how in CONVENTIONS.items()}


def _agreement(selections: Sequence[SelectedFrames], order: tuple[int, ...], sign: float) -> float:
    normals, places = [], []
    for part in selections:
        poses = distinct_poses(part.scan.poses)
        if not len(poses):
            continue
        quaternion = poses.quaternion_wxyz[:, list(order)] * [1.0, sign, sign, sign]
        rotation = rotation_from_quaternion(quaternion)
        lever = inverse(part.scan.head.scanhead_from_tracker)
        normals.append(rotation @ lever[:3, 2])
        places.append(poses.position_mm + rotation @ lever[:3, 3])
    normal: FloatArray = np.concatenate(normals).mean(axis=0)
    place = np.concatenate(places)
    _, axes = np.linalg.eigh(np.atleast_2d(np.cov(place.T)))
    return float(abs(normal @ axes[:, 0]))


def hint(selections: Sequence[SelectedFrames]) -> str:
    """What to say when the head seems not to slide along its face: the convention that would make it."""
    agreement = convention_agreement(selections)
    best = max(agreement, key=lambda name: agreement[name])
    if best == "scalar first" or agreement[best] < AGREEMENT:
        return "check the quaternion order (scalar first) and scanhead_from_tracker"
    return f"the quaternions seem to be {best} (agreement {agreement[best]:.2f} of 1); convert them to scalar first"
