"""Recordings from scripts: the same recorder as `tactile-bayes record`, started at once."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from tactile_bayes.api.arguments import check_keywords, door
from tactile_bayes.api.maps import PathLike, path_of
from tactile_bayes.commands.record import Request, command, make_recording
from tactile_bayes.errors import DeviceError, UsageError, check_number

if TYPE_CHECKING:
    from tactile_bayes.hardware.recorder import Report

_PATHS = ("like", "head_geometry", "array_calibration", "landmarks", "tracker_rom", "session_file")
_RENAMED = {"head": "head_url", "tracker": "tracker_url", "session": "session_file"}


@door
def record(output: PathLike, *, head: str, duration_s: float, **options: Any) -> Report:
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
    **options
        As of `tactile-bayes record`, by default as there: tracker, tracker_protocol, like, head_geometry,
        array_calibration, session, side, subject, force...

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
    words = ["-o", str(path_of(output)), "--head", head]
    context = command.make_context("record", words)
    defaults = context.params
    given = {_RENAMED.get(name, name): value for name, value in options.items()}
    check_keywords("record", given, sorted(set(defaults) - {"output", "head_url", "duration_s"}))
    check_number("duration_s", duration_s, 0, open_ends=True)
    given |= {name: path_of(given[name]) for name in _PATHS if name in given}
    given = {name: _converted(context, name, value) for name, value in given.items()}
    given |= {"output": path_of(output), "head_url": head, "duration_s": duration_s, "at_once": True}
    arguments: dict[str, Any] = {**defaults, **given}
    report, _ = make_recording(Request(**arguments))
    if report.fault:
        raise DeviceError(report.fault)
    return report


def _converted(context: click.Context, name: str, value: Any) -> Any:
    """An option's value, checked as the command line checks it."""
    option = next((one for one in context.command.params if one.name == name), None)
    if option is None or value is None:
        return value
    try:
        made = option.type_cast_value(context, value)
    except click.ClickException as error:
        raise UsageError(f"{name} is {value!r}: {error.format_message().rstrip('.')}") from None
    if isinstance(value, float) and made != value:
        raise UsageError(f"{name} is {value:g}; give a whole number")
    return made
