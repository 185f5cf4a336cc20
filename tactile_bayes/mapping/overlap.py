"""Overlap in time of a scan's poses and frames, and cautions where it is poor."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from tactile_bayes.findings import Finding
from tactile_bayes.geometry import FloatArray
from tactile_bayes.scan import Scan

# Shorter mismatches and gaps cost a few frames at most.
TOLERATED_S: Final = 0.1
# Frames are missing where an interval is this many times the mean.
_LONG_INTERVALS: Final = 5.0


@dataclass(slots=True)
class Span:
    """Range of the times at which a device's records were measured.

    Parameters
    ----------
    number
        Records so far.
    first_s, last_s
        Times of the first and the last.
    gap_s, gap_at_s
        Longest interval between two records, and when it began.
    """

    number: int = 0
    first_s: float = 0.0
    last_s: float = 0.0
    gap_s: float = 0.0
    gap_at_s: float = 0.0

    def add(self, time_s: float) -> None:
        """Add the next record's time, which must not be below the one before."""
        if not self.number:
            self.first_s = time_s
        elif time_s - self.last_s > self.gap_s:
            self.gap_s, self.gap_at_s = time_s - self.last_s, self.last_s
        self.number, self.last_s = self.number + 1, time_s

    @classmethod
    def of(cls, time_s: FloatArray) -> Span:
        """Span of (n,) times that never fall."""
        if not len(time_s):
            return cls()
        steps = np.diff(time_s)
        longest = int(steps.argmax()) if len(steps) else 0
        gap_s = float(steps[longest]) if len(steps) else 0.0
        return cls(len(time_s), float(time_s[0]), float(time_s[-1]), gap_s, float(time_s[longest]))


def apart(frames: Span, poses: Span) -> bool:
    """Whether no frame was measured between the first pose and the last."""
    if not frames.number or not poses.number:
        return True
    return poses.last_s < frames.first_s or poses.first_s > frames.last_s


def overlap_cautions(frames: Span, poses: Span) -> list[str]:
    """Cautions about the times, one line each; empty when every frame has poses around it.

    A scan without frames, or without poses, has no times to compare.
    """
    found = _frame_gaps(frames)
    if not frames.number or not poses.number:
        return found
    if apart(frames, poses):
        when = f"{poses.first_s:.2f} to {poses.last_s:.2f} s, frames {frames.first_s:.2f} to {frames.last_s:.2f} s"
        return [*found, f"no frame has a pose: poses cover {when}"]
    late_s, early_s = poses.first_s - frames.first_s, frames.last_s - poses.last_s
    if late_s > TOLERATED_S:
        found.append(f"poses start {late_s:.1f} s after the frames")
    if early_s > TOLERATED_S:
        found.append(f"poses end {early_s:.1f} s before the frames")
    if poses.gap_s > TOLERATED_S:
        found.append(f"no pose for {poses.gap_s:.2f} s from {poses.gap_at_s:.2f} s on (longest gap)")
    return found


def scan_findings(scan: Scan) -> tuple[Finding, ...]:
    """What its file and recorder say against a scan, and its times."""
    return with_times(scan.findings, Span.of(scan.frames.time_s), Span.of(scan.poses.time_s))


def with_times(findings: Sequence[Finding], frames: Span, poses: Span) -> tuple[Finding, ...]:
    """Findings of a scan's file, and of its times where its recorder did not note them."""
    found = overlap_cautions(frames, poses)
    told = [one for one in findings if one.text not in found]
    return (*told, *(Finding("times_apart", text) for text in found))


def _frame_gaps(frames: Span) -> list[str]:
    usual_s = (frames.last_s - frames.first_s) / max(1, frames.number - 1)
    if frames.gap_s <= max(TOLERATED_S, _LONG_INTERVALS * usual_s):
        return []
    return [f"no frame for {frames.gap_s:.2f} s from {frames.gap_at_s:.2f} s on (longest gap)"]
