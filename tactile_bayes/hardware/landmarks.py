"""Touching of landmarks with the head's apex: the mean of several poses, and their spread."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from tactile_bayes.geometry import FloatArray, inverse, rotation_from_quaternion
from tactile_bayes.hardware.readings import PoseReading

SAMPLES: Final = 60
# A hand at rest on bone; more says that the head slipped while it touched.
STEADY_MM: Final = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class Touch:
    """A touched landmark.

    Parameters
    ----------
    name
        ``sternal_notch``, ``xiphoid`` or ``nipple``.
    position_mm : (3,) array
        Mean in `base`.
    spread_mm
        Standard deviation of the samples about it (root of the sum over axes).
    samples
        How many there were.
    """

    name: str
    position_mm: FloatArray
    spread_mm: float
    samples: int

    @property
    def steady(self) -> bool:
        """Whether the head was held still enough."""
        return self.spread_mm <= STEADY_MM

    def __str__(self) -> str:
        x, y, z = self.position_mm
        words = "" if self.steady else "; the head moved, touch it again"
        return (
            f"{self.name.replace('_', ' ')} at {x:.1f} {y:.1f} {z:.1f} mm, spread {self.spread_mm:.2f} mm over "
            f"{self.samples} samples{words}"
        )


class LandmarkTouch:
    """Collects the next poses to average one landmark.

    Parameters
    ----------
    name
        Of the landmark.
    scanhead_from_tracker : (4, 4) array
        The apex of the head touches, the tracker sits in the handle.
    samples
        How many to average.
    """

    def __init__(self, name: str, *, scanhead_from_tracker: FloatArray, samples: int = SAMPLES) -> None:
        self.name = name
        self._apex_mm = inverse(scanhead_from_tracker)[:3, 3]
        self._wanted = samples
        self._points: list[FloatArray] = []

    def add(self, pose: PoseReading) -> Touch | None:
        """Add one pose; returns the landmark when there are enough. Poses that the tracker flags are skipped."""
        if pose.flags:
            return None
        rotation = rotation_from_quaternion(np.array(pose.quaternion_wxyz))
        self._points.append(np.array(pose.position_mm) + rotation @ self._apex_mm)
        if len(self._points) < self._wanted:
            return None
        points = np.array(self._points)
        spread = float(np.sqrt(points.var(axis=0, ddof=1).sum())) if len(points) > 1 else 0.0
        return Touch(self.name, points.mean(axis=0), spread, len(points))
