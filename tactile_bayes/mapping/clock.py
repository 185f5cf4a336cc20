"""Place of a lump in clinicians' terms: clock position about the nipple, and distance from it."""

from __future__ import annotations

import math
from typing import Final, Literal, get_args

import numpy as np
from scipy.special import ndtri

from tactile_bayes.declarations import Record, rounded
from tactile_bayes.geometry import FloatArray
from tactile_bayes.mapping.map import TactileMap

Side = Literal["left", "right"]
SIDES: Final[tuple[Side, ...]] = get_args(Side)
NIPPLE_SD_MM: Final = 3.0  #: SD of a touched nipple along each axis, unless repeats lie further apart (record 0117).
LEAST_KNOWN_HOURS: Final = 1.5
"""Half width of a direction's 95 % interval (45 degrees) from which the lump counts as behind the nipple."""
_SURE: Final = 0.95
_ON_AXIS_DEG: Final = 15.0
_DEGREES_PER_HOUR: Final = 30.0
_DIGITS: Final = 6  #: Significant digits of a place in files.


class Placed(Record):
    """Hours or mm with their interval; all null where there is no direction."""

    median: float | None
    low: float | None
    high: float | None
    probability: float


class Position(Record):
    """Place of a lump about the nipple with its intervals, as in files."""

    side: Side
    clock_hours: Placed
    distance_mm: Placed
    quadrant: str
    text: str


class ClockPosition(Record):
    """Place of a point about the nipple, seen facing the patient: 12 is towards the head."""

    side: Side
    distance_mm: float  #: From the nipple, along the map's plane.
    distance_sd_mm: float  #: SD of the distance, from the lump's centre and the touch of the nipple.
    angle_deg: float  #: From the head's direction, clockwise, 0 to 360.
    angle_sd_deg: float

    @classmethod
    def of(cls, position: Position | None) -> ClockPosition | None:
        """Clock position from a file's; None for None, and behind the nipple, where files have no direction."""
        if position is None or position.clock_hours.median is None:
            return None
        hours, distance = position.clock_hours, position.distance_mm
        assert hours.median is not None
        assert hours.high is not None
        assert distance.median is not None
        assert distance.high is not None
        hours_sd = (hours.high - hours.median) % 12.0 / _deviations(hours.probability)
        distance_sd = (distance.high - distance.median) / _deviations(distance.probability)
        angle = hours.median * _DEGREES_PER_HOUR % 360.0
        return cls(position.side, distance.median, distance_sd, angle, hours_sd * _DEGREES_PER_HOUR)

    @property
    def hours(self) -> float:
        """Position on the clock face, above 0 and up to 12."""
        return _on_clock(self.angle_deg / _DEGREES_PER_HOUR)

    @property
    def quadrant(self) -> str:
        """Quadrant such as ``"upper outer"``; one word within 15 degrees of upwards, outwards, downwards or inwards."""
        angle = math.radians(self.angle_deg)
        up, across = math.cos(angle), math.sin(angle) * (1.0 if self.side == "left" else -1.0)
        least = math.sin(math.radians(_ON_AXIS_DEG))
        words = ["upper" if up > 0 else "lower"] if abs(up) > least else []
        words += ["outer" if across > 0 else "inner"] if abs(across) > least else []
        return " ".join(words)

    @property
    def direction_known(self) -> bool:
        """False where the lump lies behind the nipple."""
        return _deviations(_SURE) * self.angle_sd_deg < LEAST_KNOWN_HOURS * _DEGREES_PER_HOUR

    def hours_between(self, probability: float) -> tuple[float, float] | None:
        """Ends of the interval of the hours, clockwise; None where the direction is not known."""
        if not self.direction_known:
            return None
        half = _deviations(probability) * self.angle_sd_deg / _DEGREES_PER_HOUR
        return _on_clock(self.hours - half), _on_clock(self.hours + half)

    def distance_between(self, probability: float) -> tuple[float, float]:
        """Ends of the interval of the distance, mm; not below 0."""
        half = _deviations(probability) * self.distance_sd_mm
        return max(0.0, self.distance_mm - half), self.distance_mm + half

    def text(self) -> str:
        """Place in words, such as ``"left breast, 1:30 o'clock, 43 mm from the nipple (upper outer)"``."""
        if not self.direction_known:
            return f"{self.side} breast, behind the nipple ({self.distance_mm:.0f} mm from its middle)"
        return (
            f"{self.side} breast, {clock_text(self.hours)} o'clock, {self.distance_mm:.0f} mm from the nipple "
            f"({self.quadrant})"
        )

    def as_position(self, probability: float) -> Position:
        """The place with its intervals, as in files."""
        ends = self.hours_between(probability)
        hours, low, high = (None, None, None) if ends is None else rounded((self.hours, *ends), _DIGITS)
        distance, near, far = rounded((self.distance_mm, *self.distance_between(probability)), _DIGITS)
        return Position(
            side=self.side,
            clock_hours=Placed(hours, low, high, probability),
            distance_mm=Placed(distance, near, far, probability),
            quadrant=self.quadrant if ends is not None else "behind the nipple",
            text=self.text(),
        )


def clock_position(
    tactile_map: TactileMap, centre_mm: tuple[float, float], *, side: str, covariance_mm2: FloatArray
) -> ClockPosition | None:
    """Clock position of a point of the plane; None without landmarks, a nipple, or a `side` that is a breast's.

    `centre_mm` is x and y in `plane`. The line from xiphoid to sternal notch points up on
    the plane, z away from the viewer: the patient's left is z cross up.
    """
    nipple, patient = tactile_map.nipple_mm, tactile_map.patient_from_plane
    breast = next((name for name in SIDES if name == side), None)
    if nipple is None or patient is None or breast is None:
        return None
    up = patient[1, :2] / np.hypot(*patient[1, :2])
    axes = np.stack([[-up[1], up[0]], up])  # to the viewer's right, upwards
    right, above = (float(value) for value in axes @ (np.array(centre_mm) - nipple[:2]))
    distance = math.hypot(right, above)
    outwards = np.array([right, above]) / distance if distance > 0 else np.array([0.0, 1.0])
    nipple_sd = max(NIPPLE_SD_MM, tactile_map.quality.get("landmark_spread_mm", 0.0))
    covariance = axes @ covariance_mm2 @ axes.T + nipple_sd**2 * np.eye(2)
    sideways = np.array([outwards[1], -outwards[0]])
    sideways_sd = math.sqrt(float(sideways @ covariance @ sideways))
    return ClockPosition(
        side=breast,
        distance_mm=distance,
        distance_sd_mm=math.sqrt(float(outwards @ covariance @ outwards)),
        angle_deg=math.degrees(math.atan2(right, above)) % 360.0,
        angle_sd_deg=math.degrees(math.atan2(sideways_sd, distance)),
    )


def clock_text(hours: float) -> str:
    """Hours to the nearest half: ``"2"``, ``"1:30"``."""
    halves = round(2.0 * hours)
    hour = (halves // 2 - 1) % 12 + 1
    return f"{hour}:30" if halves % 2 else f"{hour}"


def _on_clock(hours: float) -> float:
    """Hours above 0 and up to 12."""
    return 12.0 - (-hours) % 12.0


def _deviations(probability: float) -> float:
    """Half width of an equal-tailed normal interval, in standard deviations."""
    return float(ndtri(0.5 + probability / 2.0))
