"""Options that several commands have, and types of values: a finite number, or a number or one of a few words."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    _ParamType = click.ParamType[Any]
else:
    _ParamType = click.ParamType  # takes no parameter before click 8.4


Decorator = Callable[[Callable[..., Any]], Callable[..., Any]]


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


FORCE = click.option("--force", is_flag=True, help="Overwrite existing outputs.")
JSON = click.option("--json", "as_json", is_flag=True, help="Print JSON.")
WORKERS = click.option(
    "--workers", type=click.IntRange(min=0), default=1, show_default=True, help="Number of worker processes."
)


def seed_option(default: int) -> Decorator:
    """``--seed`` with a command's default."""
    return click.option("--seed", type=click.IntRange(min=0), default=default, show_default=True, help="Random seed.")


def scheduler_option(what: str) -> Decorator:
    """``--scheduler``; `what` is sent to it, in words."""
    return click.option("--scheduler", metavar="ADDRESS", help=f"Send {what} to a dask scheduler (extra [cluster]).")
