"""Progress of work that is counted: what is done of how much."""

from __future__ import annotations

from collections.abc import Callable

Progress = Callable[[int, int], None]  #: Called with what is done and how much there is.


def no_progress(_done: int, _total: int) -> None:
    """Progress that nobody watches."""
