"""Options that take a finite number, or a number or one of a few words."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    _ParamType = click.ParamType[Any]
else:
    _ParamType = click.ParamType  # takes no parameter before click 8.4


class WholeOrAuto(click.IntRange):
    """A whole number, or None for "auto"."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """The number, or None."""
        return None if value == "auto" else super().convert(value, param, ctx)


class FiniteRange(click.FloatRange):
    """A number in a range; nan and infinity, which pass comparisons or stand at their ends, are refused."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """The number."""
        number = super().convert(value, param, ctx)
        if not math.isfinite(number):
            self.fail(f"{value!r} is not a finite number", param, ctx)
        return number


class NumberOr(_ParamType):
    """A number, or one of the words given.

    Parameters
    ----------
    words
        Taken as they are, in small letters.
    """

    name = "number"

    def __init__(self, *words: str) -> None:
        self.words = words

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float | str:
        """The number, or the word."""
        if isinstance(value, int | float):
            return float(value)
        if value in self.words:
            return str(value)
        try:
            return float(value)
        except ValueError:
            self.fail(f"{value!r} is not a number, nor {' nor '.join(map(repr, self.words))}", param, ctx)
