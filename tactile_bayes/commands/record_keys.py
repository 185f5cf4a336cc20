"""Control of a recording by signals and terminal keys."""

from __future__ import annotations

import contextlib
import os
import select
import signal
import sys
from types import TracebackType
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from tactile_bayes.geometry import FloatArray
    from tactile_bayes.hardware.recorder import Recorder


class Stopper:
    """Ends a recording in order on Ctrl-C, SIGTERM or SIGHUP."""

    def __init__(self, recorder: Recorder) -> None:
        self._recorder = recorder
        self._why = ""
        self._before: dict[int, Any] = {}

    @property
    def interrupted(self) -> bool:
        """Whether a signal has come."""
        return bool(self._why)

    def look(self) -> None:
        """Stop the recorder if a signal has come."""
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
    """Keys of a terminal for landmarks, start and stop; without a terminal there are none."""

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
            click.echo("n sternal notch, x xiphoid, p nipple, space start, q stop", err=True)
            self._recorder.listen()
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if self._terminal:
            import termios

            with contextlib.suppress(termios.error):  # the terminal was closed
                termios.tcsetattr(sys.stdin, termios.TCSADRAIN, self._settings)

    def look(self) -> None:
        """Act on the keys pressed since the last call, and report landmarks."""
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

        names = {"n": "sternal_notch", "x": "xiphoid", "p": "nipple"}
        if key in names:
            self._recorder.touch(LandmarkTouch(names[key], scanhead_from_tracker=self._lever))
        elif key == " " and self.waiting:
            self.waiting = False
            self._recorder.start()
            click.echo("recording", err=True)
        elif key == "q":
            self._recorder.stop("q")
