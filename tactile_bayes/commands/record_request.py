"""Options of one recording, and the part of them that the file stores."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tactile_bayes.hardware.readings import HelloReading


@dataclass(frozen=True, slots=True, kw_only=True)
class Request:
    """Options of one recording, as given."""

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
    session_file: Path | None
    live: bool
    serve: str | None
    size_calibration: str
    force: bool

    def facts(self) -> dict[str, str]:
        """Session facts as text: from the file, overridden by options.

        Raises
        ------
        BadDataError
            When the file cannot be read, or a fact is not as `scan_session.schema.json` has it.
        """
        from tactile_bayes.files.schema import check_document
        from tactile_bayes.files.session_toml import SCHEMA, read_session

        facts = read_session(self.session_file) if self.session_file else {}
        options = {name: getattr(self, name) for name in ("side", "posture", "lubricant", "examiner", "subject")}
        facts |= {name: value for name, value in options.items() if value}
        check_document(facts, SCHEMA, path=self.output)
        return facts

    def session(self, hello: HelloReading, facts: dict[str, str]) -> dict[str, str]:
        """Session as the file stores it: devices, clock and facts."""
        tracker = self.tracker_protocol if self.tracker_url else "none"
        devices = {"source": "recorded", "head_id": hello.device_id[:64], "tracker_id": tracker, "clock": self.clock}
        return devices | ({"rotation": "inverted"} if self.invert_rotation else {}) | facts

    def settings(self, hello: HelloReading) -> dict[str, Any]:
        """Settings for the provenance."""
        return {
            "tracker_protocol": self.tracker_protocol if self.tracker_url else None,
            "rate_hz": hello.rate_hz / self.every,
            "every": self.every,
            "clock": self.clock,
            "invert_rotation": self.invert_rotation,
            "calibrated": not self.uncalibrated,
        }
