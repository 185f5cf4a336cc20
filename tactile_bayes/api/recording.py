"""Recordings from scripts: the same recorder as `tactile-bayes record`, started at once."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from tactile_bayes.actions.record import Request, make_recording
from tactile_bayes.api.arguments import PathLike, door, path_of, plain, takes
from tactile_bayes.errors import DeviceError, check_number
from tactile_bayes.hardware.recorder import Report
from tactile_bayes.options import RecordOptions

_PATHS = ("like", "head_geometry", "array_calibration", "landmarks")
_NAMED = ("output", "head_url", "duration_s", "tracker_url", "session_file")  #: Keywords of their own.


@door
@takes(RecordOptions, without=_NAMED)
def record(
    output: PathLike,
    *,
    head: str,
    duration_s: float,
    tracker: str | None = None,
    session: PathLike | None = None,
    **options: Any,
) -> Report:
    """Record a scan head and a tracker into a scan file for some seconds, starting now.

    Call it from the main thread: Ctrl-C ends the recording in order.

    Parameters
    ----------
    output
        Scan file to write (``.mcap``).
    head
        Port of the scan head.
    duration_s
        By the head's clock.
    tracker
        Port of the tracker; without, there are no poses.
    session
        File of facts of the exam.
    **options
        As of `tactile_bayes.options.RecordOptions`, by default as of `tactile-bayes record`:
        tracker_protocol, like, head_geometry, array_calibration, side, subject, force...

    Returns
    -------
    Report
        Frames, poses, what was lost, and cautions.

    Raises
    ------
    DeviceError
        When a port cannot be opened, or a device stopped answering; what came before is in the file.
    UsageError
        When options contradict each other, or the file exists and `force` is false.
    """
    given = {name: plain(value) for name, value in options.items()}
    check_number("duration_s", duration_s, 0, open_ends=True)
    given |= {name: path_of(given[name]) for name in _PATHS if name in given}
    roms = given.get("tracker_rom", ())
    given["tracker_rom"] = tuple(map(path_of, [roms] if isinstance(roms, str | Path) else roms))
    given |= {"output": path_of(output), "head_url": head, "duration_s": duration_s, "at_once": True}
    given |= {"tracker_url": tracker, "session_file": path_of(session)}
    report, _ = make_recording(Request(**given))
    if report.fault:
        raise DeviceError(report.fault)
    return report
