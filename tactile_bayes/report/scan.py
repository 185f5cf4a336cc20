"""A scan in a few lines."""

from __future__ import annotations

import numpy as np

from tactile_bayes.geometry import FloatArray
from tactile_bayes.mapping.select import intervals, missing_records
from tactile_bayes.scans import Scan


def describe_scan(scan: Scan) -> list[str]:
    """Summary of a scan in a few lines."""
    times, poses = scan.frames.time_s, scan.poses
    span = float(times[-1] - times[0]) if len(times) else 0.0
    saturated = int((scan.frames.counts >= scan.element_calibration.saturation_count).sum())
    duplicates = int((np.diff(poses.time_s) == 0).sum())
    marks = [] if scan.landmarks is None else [name.replace("_", " ") for name in scan.landmarks.points()]
    return [
        f"{len(times)} frames of {scan.head.shape[0]} x {scan.head.shape[1]} taxels in {span:.3f} s, {_rate(times)}",
        f"{len(poses)} poses, {_rate(poses.time_s)}",
        f"dropped frames {missing_records(times)}, dropped poses {missing_records(poses.time_s)}, "
        f"duplicate pose stamps {duplicates}, saturated readings {saturated}",
        f"landmarks: {' and '.join(', '.join(marks).rsplit(', ', 1)) or 'not touched'}",
    ]


def _rate(times: FloatArray) -> str:
    steps, usual = intervals([times])
    return f"{1 / usual:.1f} Hz" if len(steps) else "no rate"
