"""A scan with part of its frames: every so many-th, or those of its first seconds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tactile_bayes.errors import BadDataError
from tactile_bayes.scan import PressureFrames, Scan


def every_nth(scan: Scan, every: int) -> Scan:
    """The scan with one frame of every `every`, the first one included; all poses stay.

    Raises
    ------
    BadDataError
        When `every` is no whole number from 1 on.
    """
    if isinstance(every, bool) or not isinstance(every, int) or every < 1:
        raise BadDataError(f"every is {every}", way_out="give a whole number from 1 on: 4 uses every fourth frame")
    if every == 1:
        return scan
    return _with_frames(scan, slice(None, None, every))


def first_seconds(scan: Scan, duration_s: float) -> Scan:
    """The scan with the frames of its first `duration_s` seconds; all poses stay.

    Raises
    ------
    BadDataError
        When the duration is not above 0.
    """
    if not duration_s > 0:
        raise BadDataError(f"duration_s is {duration_s}", way_out="give a time above 0 s")
    time_s = scan.frames.time_s
    if not len(time_s):
        return scan
    return _with_frames(scan, slice(0, int(np.searchsorted(time_s, time_s[0] + duration_s, side="right"))))


def _with_frames(scan: Scan, kept: slice) -> Scan:
    frames = PressureFrames(scan.frames.time_s[kept], np.ascontiguousarray(scan.frames.counts[kept]))
    return replace(scan, frames=frames)
