"""Progress of counted work: how many items of how many are done."""

from __future__ import annotations

from collections.abc import Callable

Progress = Callable[[int, int], None]  #: Called with the number done and the total.


def no_progress(_done: int, _total: int) -> None:
    """Report no progress."""
