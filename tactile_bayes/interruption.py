"""Signals that end a command in order, as Ctrl-C does."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Iterator
from typing import Any

_asked = False


@contextlib.contextmanager
def ended_in_order() -> Iterator[None]:
    """Let SIGTERM (`kill`, `timeout`, a batch system) and SIGHUP (a closed terminal) interrupt as Ctrl-C does.

    What is ignored stays so: `nohup` ignores SIGHUP.
    """
    global _asked
    _asked = False
    before: dict[int, Any] = {}
    with contextlib.suppress(ValueError):  # called in a thread, which gets no signals
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            if signal.getsignal(number) in (signal.SIG_DFL, signal.default_int_handler):
                before[number] = signal.signal(number, _interrupt)
    try:
        yield
    finally:
        _asked = False
        for changed, handler in before.items():
            signal.signal(changed, handler)


def raise_if_asked() -> None:
    """Raise the interruption again where code of others let it go, as compiled modules do while they are imported.

    Raises
    ------
    KeyboardInterrupt
        When a signal has come in the block of `ended_in_order`.
    """
    if _asked:
        raise KeyboardInterrupt


def _interrupt(number: int, frame: object) -> None:
    del number, frame
    global _asked
    _asked = True
    raise KeyboardInterrupt
