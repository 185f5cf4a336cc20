"""Progress of work that is counted: what is done of how much, and the time that is left where somebody knows it."""

from __future__ import annotations

from typing import Protocol


class Progress(Protocol):
    """Called with what is done and how much there is; `left_s` where the caller knows better than by their ratio."""

    def __call__(self, done: int, total: int, /, *, left_s: float | None = None) -> None:
        """Take note."""


def untold(_done: int, _total: int, /, *, left_s: float | None = None) -> None:
    """Progress that nobody watches."""
