"""Text of a recording's account."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tactile_bayes.presets import RESEARCH_USE

if TYPE_CHECKING:
    from tactile_bayes.hardware.account import Report


def record_text(report: Report, *, output: str) -> str:
    """Summary of a recording and its losses in a few lines."""
    rate = (report.frames - 1) / report.duration_s if report.frames > 1 and report.duration_s > 0 else 0.0
    dropped = f" (the head dropped {report.head_dropped})" if report.head_dropped else ""
    lines = [
        f"{output}: scan, ended by {report.ended_by}",
        f"{report.frames} frames in {report.duration_s:.3f} s, {rate:.1f} Hz; {report.poses} poses",
        f"frames lost {report.frames_lost}{dropped}",
        f"poses repeated {report.poses_repeated}, flagged {report.poses_flagged}",
        *report.landmarks,
    ]
    odd = {
        "times the head's counter of time wrapped": report.head_clock_wraps,
        "times the tracker's counter of time wrapped": report.tracker_clock_wraps,
        "poses without a time, left out": report.poses_without_time,
        "bytes from the head that made no sense": report.head_garbage_bytes,
        "bytes from the tracker that made no sense": report.tracker_garbage_bytes,
        "bytes this computer came too late for": report.overrun_bytes,
    }
    lines += [f"{words}: {number}" for words, number in odd.items() if number]
    lines += [f"caution: {text}" for text in report.cautions]
    return "\n".join([*lines, RESEARCH_USE]) + "\n"
