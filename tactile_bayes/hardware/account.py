"""Summary of a recording: what arrived, what was lost, and what makes it unfit for use."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Final

from tactile_bayes.mapping.overlap import Span, overlap_cautions

# The head's clock runs as this computer's, and its frames come as it promised, to within this share or time.
_RATE_SHARE: Final = 0.02
_RATE_LEAST_S: Final = 0.5
_STUCK_POSES: Final = 10


@dataclass(slots=True)
class Report:
    """The account of a recording; numbers are of records unless the name says bytes."""

    frames: int = 0
    frames_lost: int = 0
    frame_counter_restarts: int = 0
    head_dropped: int = 0
    head_clock_steps: int = 0
    head_clock_wraps: int = 0
    tracker_clock_steps: int = 0
    tracker_clock_wraps: int = 0
    poses: int = 0
    poses_repeated: int = 0
    poses_flagged: int = 0
    poses_without_time: int = 0
    head_garbage_bytes: int = 0
    tracker_garbage_bytes: int = 0
    overrun_bytes: int = 0
    first_ns: int = 0
    last_ns: int = 0
    longest_wait_ms: float = 0.0
    ended_by: str = ""
    fault: str = ""
    landmarks: list[str] = field(default_factory=list)
    cautions: list[str] = field(default_factory=list)

    @property
    def duration_s(self) -> float:
        """Time from the first frame to the last by the head's clock, made continuous."""
        return (self.last_ns - self.first_ns) / 1e9


def recording_cautions(report: Report, frames: Span, poses: Span, *, passed_s: float, rate_hz: float) -> list[str]:
    """Cautions before a recording is used, one line each.

    Parameters
    ----------
    report
        Complete but for its cautions.
    frames, poses
        When they were measured, on the head's clock.
    passed_s
        Between the first frame and the last by the host's clock.
    rate_hz
        Frames that the head promised; 0 when it promised none.
    """
    found = [*overlap_cautions(frames, poses), *_rates(report, passed_s, rate_hz), *_counters(report)]
    if report.poses > _STUCK_POSES and report.poses_repeated >= report.poses - 1:
        found.append("every pose is the same: the tracker does not follow the head")
    return found


def _rates(report: Report, passed_s: float, rate_hz: float) -> Iterator[str]:
    """Compare the head's clock with the host's, and its frame rate with the promised one."""
    told_s = report.duration_s
    if abs(told_s - passed_s) > max(_RATE_LEAST_S, _RATE_SHARE * passed_s):
        yield f"the head's clock ran {told_s:.1f} s while {passed_s:.1f} s passed on this computer"
    due, came = told_s * rate_hz, report.frames - 1 + report.frames_lost
    if due > 0 and abs(came - due) > max(_RATE_LEAST_S * rate_hz, _RATE_SHARE * due):
        yield f"the head promised {rate_hz:g} frames per second and measured {came / told_s:.1f}"


def _counters(report: Report) -> Iterator[str]:
    """Count the jumps of clocks and sequence counters."""
    for role, steps in (("head", report.head_clock_steps), ("tracker", report.tracker_clock_steps)):
        if steps:
            yield f"the {role}'s clock stepped {_times(steps)}; this computer's clock was used instead"
    if report.frame_counter_restarts:
        yield f"the head's frame counter restarted or was damaged {_times(report.frame_counter_restarts)}"


def _times(number: int) -> str:
    return "once" if number == 1 else f"{number} times"
