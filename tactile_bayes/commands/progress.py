"""Progress on stderr: a bar on a terminal for work that takes a while, lines in a log where a command asks for them."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TextIO

from tactile_bayes.progress import Progress, untold
from tactile_bayes.shell import raw_stream

# Work that ends sooner draws nothing.
QUIET_S = 2.0
# Seconds between two drawings.
REDRAW_S = 0.1
_WIDTH = 30


@contextmanager
def progress_bar(
    label: str,
    *,
    stream: TextIO | None = None,
    clock: Callable[[], float] = time.monotonic,
    log_every_s: float | None = None,
    time_left: bool = True,
) -> Iterator[Progress]:
    """Give a ``progress(done, total)`` callback; the bar is erased when the block ends.

    Parameters
    ----------
    label
        What is being counted, in a word or two.
    stream
        Where to draw; stderr by default, so that output can be piped.
    clock
        Seconds from anywhere.
    log_every_s
        Where the stream is no terminal: a line so often, from then on. Default: none.
    time_left
        Whether the time left is told, for work whose parts take equally long.
    """
    out = raw_stream(sys.stderr) if stream is None else stream
    if not out.isatty() and log_every_s is None:
        yield untold
        return
    teller = _Teller(label, out, clock, log_every_s=None if out.isatty() else log_every_s, time_left=time_left)
    try:
        yield teller.update
    finally:
        teller.erase()


class _Teller:
    """Tells of work: a line of a log every so often, or else a bar that is redrawn."""

    def __init__(
        self, label: str, out: TextIO, clock: Callable[[], float], *, log_every_s: float | None, time_left: bool
    ) -> None:
        self._label, self._out, self._clock, self._time_left = label, out, clock, time_left
        self._bar = log_every_s is None
        quiet_s, self._every_s = (QUIET_S, REDRAW_S) if log_every_s is None else (log_every_s, log_every_s)
        self._begun = clock()
        self._next = self._begun + quiet_s
        self._first: int | None = None  # what a resumed run had before it began
        self._drawn = 0

    def update(self, done: int, total: int) -> None:
        """Tell `done` of `total`, at most every so often."""
        now = self._clock()
        self._first = done if self._first is None else self._first
        if now < self._next or total <= 0:
            return
        self._next = now + self._every_s
        left = self._left(now, done, total)
        if self._bar:
            filled = _WIDTH * done // total
            line = f"{self._label} [{'#' * filled}{'-' * (_WIDTH - filled)}] {done}/{total}{left}"
            self._out.write("\r" + line.ljust(self._drawn))
            self._drawn = len(line)
        else:
            self._out.write(f"{self._label}: {done} of {total} done{',' if left else ''}{left}\n")
        self._out.flush()

    def _left(self, now: float, done: int, total: int) -> str:
        """The time left, after a blank; empty where it is not known."""
        new = done - (self._first or 0)
        if not self._time_left or new <= 0 or done >= total:
            return ""
        return f" {duration(round((now - self._begun) * (total - done) / new))} left"

    def erase(self) -> None:
        """Erase the bar."""
        if self._drawn:
            self._out.write("\r" + " " * self._drawn + "\r")
            self._out.flush()


def duration(seconds: int) -> str:
    """Minutes and seconds, with hours where there are any: 4:07, 2:42:05."""
    hours, rest = divmod(seconds, 3600)
    short = f"{rest // 60:02d}:{rest % 60:02d}"
    return f"{hours}:{short}" if hours else short.removeprefix("0")
