"""The options of one recording, and what a file records of them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tactile_bayes.hardware.readings import HelloReading


@dataclass(frozen=True, slots=True, kw_only=True)
class Request:
    """The options of one recording, as they were given."""

    output: Path
    head_url: str
    tracker_url: str | None
    tracker_protocol: str
    head_baud: int
    tracker_baud: int | None
    tracker_rom: Path | None
    every: int
    duration_s: float | None
    at_once: bool
    clock: str
    invert_rotation: bool
    like: Path | None
    head_geometry: Path | None
    array_calibration: Path | None
    uncalibrated: bool
    accept_calibration: bool
    calibration_days: float
    landmarks: Path | None
    side: str | None
    posture: str | None
    lubricant: str | None
    examiner: str | None
    subject: str | None
    live: bool
    serve: str | None
    size_calibration: str
    force: bool

    def session(self, hello: HelloReading) -> dict[str, str]:
        """Plain text facts for the file."""
        facts = {name: getattr(self, name) for name in ("side", "posture", "lubricant", "examiner", "subject")}
        tracker = self.tracker_protocol if self.tracker_url else "none"
        devices = {"source": "recorded", "head_id": hello.device_id[:64], "tracker_id": tracker}
        more = {"clock": self.clock, "rotation": "inverted"} if self.invert_rotation else {"clock": self.clock}
        return devices | more | {name: value for name, value in facts.items() if value}

    def settings(self, hello: HelloReading) -> dict[str, Any]:
        """For the provenance."""
        return {
            "tracker_protocol": self.tracker_protocol if self.tracker_url else None,
            "rate_hz": hello.rate_hz / self.every,
            "every": self.every,
            "clock": self.clock,
            "invert_rotation": self.invert_rotation,
            "calibrated": not self.uncalibrated,
        }
