"""Progress bar on stderr, drawn only on a terminal and only for work that takes a while."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TextIO

from tactile_bayes.printing import raw_stream
from tactile_bayes.progress import Progress, untold

# Work that ends sooner draws nothing.
QUIET_S = 2.0
# Seconds between two drawings.
REDRAW_S = 0.1
_WIDTH = 30


@contextmanager
def progress_bar(
    label: str, *, stream: TextIO | None = None, clock: Callable[[], float] = time.monotonic
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
    """
    out = raw_stream(sys.stderr) if stream is None else stream
    if not out.isatty():
        yield untold
        return
    bar = _Bar(label, out, clock)
    try:
        yield bar.update
    finally:
        bar.erase()


class _Bar:
    """A line that is redrawn."""

    def __init__(self, label: str, out: TextIO, clock: Callable[[], float]) -> None:
        self._label = label
        self._out = out
        self._clock = clock
        self._begun = clock()
        self._next = self._begun + QUIET_S
        self._drawn = 0
        self._first: int | None = None  # what a resumed run had before it began

    def update(self, done: int, total: int, *, left_s: float | None = None) -> None:
        """Redraw the bar at `done` of `total`, at most every so often; `left_s` stands in for what it would reckon."""
        now = self._clock()
        self._first = done if self._first is None else self._first
        if now < self._next or total <= 0:
            return
        self._next = now + REDRAW_S
        filled = _WIDTH * done // total
        left = self._left(now, done, total, left_s)
        line = f"{self._label} [{'#' * filled}{'-' * (_WIDTH - filled)}] {done}/{total}{left}"
        self._out.write("\r" + line.ljust(self._drawn))
        self._out.flush()
        self._drawn = len(line)

    def _left(self, now: float, done: int, total: int, left_s: float | None) -> str:
        new = done - (self._first or 0)
        if new <= 0 or done >= total:
            return ""
        seconds = round((now - self._begun) * (total - done) / new if left_s is None else left_s)
        return f" {seconds // 60}:{seconds % 60:02d} left"

    def erase(self) -> None:
        """Erase the line."""
        if self._drawn:
            self._out.write("\r" + " " * self._drawn + "\r")
            self._out.flush()
