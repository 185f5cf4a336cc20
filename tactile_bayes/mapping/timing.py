"""Regularity of frames and poses: rates, jitter, repeats, gaps and missing records."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tactile_bayes.geometry import FloatArray
from tactile_bayes.mapping.poses import distinct_poses
from tactile_bayes.scan import Scan

# An interval longer than this many usual ones holds frames that never came.
_GAP_INTERVALS = 1.5


def timing_figures(scans: Sequence[Scan]) -> dict[str, float]:
    """Figures for a map's report, over all scans.

    Returns
    -------
    dict
        ``frame_rate_hz``, ``frame_jitter_ms`` (spread of the intervals without gaps), ``frames_missing``,
        ``frames_repeated`` (two of one time), ``pose_rate_hz`` and ``pose_jitter_ms`` of distinct poses,
        ``pose_repeats`` (samples told again) and ``pose_gap_ms`` (the longest between distinct poses). Rates of scans
        with less than two records are left out.
    """
    frames = [scan.frames.time_s for scan in scans]
    fresh = [distinct_poses(scan.poses) for scan in scans]
    poses = [one.time_s for one in fresh]
    gaps = [np.diff(time).max(initial=0.0) for time in poses]
    return {
        **_regularity("frame", frames),
        **_regularity("pose", poses),
        "frames_missing": float(sum(_missing(time) for time in frames)),
        "frames_repeated": float(sum(int((np.diff(time) == 0).sum()) for time in frames)),
        "pose_repeats": float(sum(len(scan.poses) - len(one) for scan, one in zip(scans, fresh, strict=True))),
        "pose_gap_ms": 1000.0 * float(max(gaps, default=0.0)),
    }


def _regularity(name: str, times: list[FloatArray]) -> dict[str, float]:
    """Rate, and standard deviation of the intervals that contain no gap."""
    steps = np.concatenate([np.diff(time) for time in times])
    steps = steps[steps > 0]
    if not len(steps):
        return {}
    usual = float(np.median(steps))
    regular = steps[steps < _GAP_INTERVALS * usual]
    return {f"{name}_rate_hz": 1.0 / usual, f"{name}_jitter_ms": 1000.0 * float(regular.std())}


def _missing(time_s: FloatArray) -> int:
    """Number of frames missing in the gaps."""
    steps = np.diff(time_s)
    steps = steps[steps > 0]
    if not len(steps):
        return 0
    usual = float(np.median(steps))
    return int(np.rint(steps[steps >= _GAP_INTERVALS * usual] / usual - 1).sum())
