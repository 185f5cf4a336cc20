"""What `record` needs beside the devices: the instrument's description, keys, signals."""

from __future__ import annotations

import contextlib
import os
import select
import signal
import sys
from datetime import date
from types import TracebackType
from typing import TYPE_CHECKING, Any

import click

from tactile_bayes.errors import UsageError
from tactile_bayes.presets import PRESSURE_RANGE_KPA

if TYPE_CHECKING:
    from tactile_bayes.commands.record import Request
    from tactile_bayes.files.provenance import Provenance
    from tactile_bayes.geometry import FloatArray
    from tactile_bayes.hardware.recorder import Recorder
    from tactile_bayes.scan import ElementCalibration, HeadGeometry, Landmarks

_NOMINAL_FULL_SCALE = 4095


def instrument_of(request: Request) -> tuple[HeadGeometry, ElementCalibration, Landmarks | None]:
    """Geometry, calibration and landmarks from the files that were given.

    Raises
    ------
    UsageError
        When one is missing or given twice.
    """
    from tactile_bayes.files.instrument_json import read_head_geometry
    from tactile_bayes.files.scan_mcap import read_scan

    like = read_scan(request.like) if request.like else None
    if request.head_geometry:
        head = read_head_geometry(request.head_geometry)
    elif like is not None:
        head = like.head
    else:
        raise UsageError("the head's geometry is missing; give --head-geometry HEAD.json or --like SCAN.mcap")
    return head, _calibration(request, head, like), _landmarks(request)


def _calibration(request: Request, head: HeadGeometry, like: Any) -> ElementCalibration:
    import numpy as np

    from tactile_bayes.files.instrument_json import read_array_calibration
    from tactile_bayes.scan import ElementCalibration

    if request.uncalibrated:
        gain = np.full(head.shape, PRESSURE_RANGE_KPA[1] / _NOMINAL_FULL_SCALE)
        return ElementCalibration(gain, np.zeros(head.shape), saturation_count=_NOMINAL_FULL_SCALE)
    if request.array_calibration:
        return read_array_calibration(request.array_calibration).calibration
    if like is not None:
        return like.element_calibration  # type: ignore[no-any-return]
    raise UsageError("the array's calibration is missing; give --array-calibration, --like or --uncalibrated")


def refuse_calibration(request: Request, *, head_id: str, today: date) -> None:
    """Raise `UsageError` when the array's calibration is stale or another head's, unless it was accepted."""
    from tactile_bayes.files.instrument_json import read_array_calibration

    if not request.array_calibration or request.uncalibrated or request.accept_calibration:
        return
    found = read_array_calibration(request.array_calibration)
    age = (today - found.day).days
    if found.head_id != head_id:
        raise UsageError(
            f"{request.array_calibration} was measured on head {found.head_id!r}, this is {head_id!r}; calibrate this "
            "head, or give --accept-calibration"
        )
    if not 0 <= age <= request.calibration_days:
        raise UsageError(
            f"{request.array_calibration} is of {found.day}, {age} days ago (at most {request.calibration_days:g}); "
            "calibrate again, or give --accept-calibration"
        )


def _landmarks(request: Request) -> Landmarks | None:
    from tactile_bayes.files.instrument_json import read_landmarks
    from tactile_bayes.files.scan_mcap import read_scan

    if request.landmarks is None:
        return None
    if request.landmarks.suffix.lower() != ".mcap":
        return read_landmarks(request.landmarks)
    found = read_scan(request.landmarks).landmarks
    if found is None:
        raise UsageError(f"{request.landmarks} holds no landmarks; give a scan whose landmarks were touched")
    return found


def provenance_of(request: Request, settings: dict[str, Any]) -> Provenance:
    """What made the file; ports are not in it."""
    from tactile_bayes.files.provenance import Provenance, hash_inputs

    names = ("like", "head_geometry", "array_calibration", "landmarks")
    inputs = {name: path for name in names if (path := getattr(request, name)) is not None}
    return Provenance("record", settings, hash_inputs(**inputs))


class Stopper:
    """Turns Ctrl-C, SIGTERM and SIGHUP into an orderly end."""

    def __init__(self, recorder: Recorder) -> None:
        self._recorder = recorder
        self._why = ""
        self._before: dict[int, Any] = {}

    @property
    def interrupted(self) -> bool:
        """Whether a signal came."""
        return bool(self._why)

    def look(self) -> None:
        """Stop the recorder if a signal came."""
        if self._why:
            self._recorder.stop(self._why)

    def _note(self, number: int, frame: object) -> None:
        del frame
        self._why = "Ctrl-C" if number == signal.SIGINT else signal.Signals(number).name

    def __enter__(self) -> Stopper:
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            self._before[number] = signal.signal(number, self._note)
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)


class Keys:
    """The keys of a terminal: landmarks, start, stop. Without a terminal there are none, and nothing waits."""

    def __init__(self, recorder: Recorder, scanhead_from_tracker: FloatArray, *, wait: bool) -> None:
        self._recorder = recorder
        self._lever = scanhead_from_tracker
        self._terminal = sys.stdin.isatty()
        self.waiting = wait and self._terminal
        self._settings: list[Any] = []
        self._told = 0

    def __enter__(self) -> Keys:
        if self._terminal:
            import termios
            import tty

            self._settings = termios.tcgetattr(sys.stdin)
            tty.setcbreak(sys.stdin)
        if self.waiting:
            click.echo("n sternal notch, x xiphoid, space start, q stop", err=True)
            self._recorder.listen()
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if self._terminal:
            import termios

            with contextlib.suppress(termios.error):  # the terminal was closed
                termios.tcsetattr(sys.stdin, termios.TCSADRAIN, self._settings)

    def look(self) -> None:
        """Do what the keys say that were pressed since, and tell of landmarks."""
        for text in self._recorder.report.landmarks[self._told :]:
            click.echo(text, err=True)
            self._told += 1
        if not self._terminal or not select.select([sys.stdin], [], [], 0)[0]:
            return
        keys = b""
        with contextlib.suppress(OSError):  # a closed terminal is at its end, or fails
            keys = os.read(sys.stdin.fileno(), 64)
        if not keys:
            self._recorder.stop("a closed terminal")
        for key in keys.decode("latin-1"):
            self._press(key)

    def _press(self, key: str) -> None:
        from tactile_bayes.hardware.landmarks import LandmarkTouch

        names = {"n": "sternal_notch", "x": "xiphoid"}
        if key in names:
            self._recorder.touch(LandmarkTouch(names[key], scanhead_from_tracker=self._lever))
        elif key == " " and self.waiting:
            self.waiting = False
            self._recorder.start()
            click.echo("recording", err=True)
        elif key == "q":
            self._recorder.stop("q")
