"""Options shared by several commands, and value types: finite numbers, numbers or words."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import click

from tactile_bayes.commands.paths import FilePath
from tactile_bayes.errors import number_words
from tactile_bayes.presets import PRESSURE_WINDOW_KPA

if TYPE_CHECKING:
    _ParamType = click.ParamType[Any]
else:
    _ParamType = click.ParamType  # takes no parameter before click 8.4


Decorator = Callable[[Callable[..., Any]], Callable[..., Any]]


class WholeOrAuto(click.IntRange):
    """A whole number, or None for "auto"."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Convert to the number, or to None."""
        return None if value == "auto" else super().convert(value, param, ctx)


class FiniteRange(click.FloatRange):
    """A finite number in a range; nan and infinity are refused."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Convert to the number."""
        with contextlib.suppress(click.BadParameter):
            number = super().convert(value, param, ctx)
            if math.isfinite(number):
                return number
        text, share = str(value), ""
        with contextlib.suppress(ValueError):
            part = float(text.removesuffix("%").strip()) / 100
            if self.max == 1 and 0 < part < 1:
                share = f"; for {text.removesuffix('%').strip()} % give {part:g}"
        words = number_words(self.min, self.max, open_ends=self.min_open or self.max_open)
        return self.fail(f"{text!r} is not {words}{share}", param, ctx)

    def _describe_range(self) -> str:
        """The range as help shows it; empty without ends."""
        return "" if self.min is None and self.max is None else super()._describe_range()


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
        """Convert to the number, or return the word."""
        if isinstance(value, int | float):
            return float(value)
        if value in self.words:
            return str(value)
        try:
            return float(value)
        except ValueError:
            self.fail(f"{value!r} is not a number, nor {' nor '.join(map(repr, self.words))}", param, ctx)


MOST_ITEMS = 1_000_000
"""Of a batch: memory holds a name and an outcome for each."""
FORCE = click.option("--force", is_flag=True, help="Overwrite existing outputs.")
SESSION = click.option(
    "--session",
    "session_file",
    type=FilePath(),
    metavar="SESSION.toml",
    help="Facts of the exam for the scan: subject, side, posture, examiner, visit and more, in plain text.",
)
JSON = click.option("--json", "as_json", is_flag=True, help="Print JSON.")
PRESSURE_WINDOW = click.option(
    "--pressure-window-kpa",
    type=(float, float),
    metavar="LOW HIGH",
    default=PRESSURE_WINDOW_KPA,
    show_default=True,
    help="Leave out frames whose mean pressure lies outside.",
)
SPEED = click.option(
    "--speed",
    type=FiniteRange(0.01, 100.0),
    default=1.0,
    show_default=True,
    help="Playback speed; 1 is real time.",
)
WORKERS = click.option(
    "--workers", type=click.IntRange(min=0), default=1, show_default=True, help="Number of worker processes."
)


def live_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """``--live``, ``--serve`` and ``--size-calibration``: the live view of a recording."""
    live = click.option("--live", is_flag=True, help="Draw the map on the terminal while it grows.")
    serve = click.option(
        "--serve", metavar="HOST:PORT", help="Show the map in a browser on this computer, with a tone for the pressure."
    )
    size_calibration = click.option(
        "--size-calibration",
        default="solid-mean",
        show_default=True,
        metavar="solid-mean|plane-strain|none|SIZE.json",
        help="Size calibration of the live view, whose frames are divided by their means.",
    )
    return live(serve(size_calibration(command)))


def seed_option(default: int) -> Decorator:
    """``--seed`` with a command's default."""
    return click.option("--seed", type=click.IntRange(min=0), default=default, show_default=True, help="Random seed.")


def scheduler_option(what: str) -> Decorator:
    """``--scheduler``; `what` names the work that is sent to it."""
    return click.option("--scheduler", metavar="ADDRESS", help=f"Send {what} to a dask scheduler (extra [cluster]).")
