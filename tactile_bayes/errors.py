"""Errors that a user can meet, their exit codes, and the reasons for giving no estimate."""

from __future__ import annotations

import difflib
import math
import numbers
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Literal, get_args

# --- Every error the program can explain in one line, each with the exit code it ends in.

EXIT_DONE = 0
EXIT_FAULT = 1
EXIT_USAGE = 2
EXIT_BAD_DATA = 3
EXIT_DEVICE = 4
EXIT_NOT_CONVERGED = 5
EXIT_NO_ESTIMATE = 6
EXIT_INTERRUPTED = 130
EXIT_READER_GONE = 141

BY_OPTIONS: ContextVar[bool] = ContextVar("by_options", default=False)
"""True while the command line runs: its errors name options, those of Python's functions their keywords."""


class TactileBayesError(Exception):
    """Base of all errors that end in one line on stderr and a documented exit code."""

    exit_code = EXIT_FAULT


class UsageError(TactileBayesError):
    """Options contradict each other or the state of the disk: the output exists, or cannot be written."""

    exit_code = EXIT_USAGE


def check_choice(name: str, value: object, choices: Collection[str]) -> None:
    """Refuse a value that is none of the choices, with a `UsageError` that lists them."""
    if value not in choices:
        raise UsageError(f"{name} is {value!r}; give one of {', '.join(choices)}")


def require(holds: bool, name: str, value: float, rule: str) -> None:
    """Refuse a number that breaks a rule, such as ``be above 0``."""
    if not holds:
        raise BadDataError(f"{name} is {value:g}", way_out=f"it must {rule}")


def check_number(
    name: str,
    value: object,
    least: float | None = None,
    most: float | None = None,
    *,
    whole: bool = False,
    open_ends: bool = False,
) -> None:
    """Refuse a value that is no finite number in the range, or with `open_ends` at its ends, and name the range."""
    if isinstance(value, numbers.Integral if whole else numbers.Real) and not isinstance(value, bool):
        number = float(value)
        inside = (least is None or number >= least) and (most is None or number <= most)
        if inside and not (open_ends and number in (least, most)) and math.isfinite(number):
            return
    value_text = f"{value:g}" if isinstance(value, float) else _shortened(repr(value))
    fault = f"{name} is {value_text}; give {number_words(least, most, _ENDS if open_ends else (), whole=whole)}"
    raise UsageError(fault)


_ENDS = ("min", "max")


def number_words(least: float | None, most: float | None, open_ends: Collection[str], *, whole: bool = False) -> str:
    """The numbers that can be given, in words: ``a number above 0 and below 1``; `open_ends` are of "min" and "max"."""
    above, below = (end in open_ends for end in _ENDS)
    low, high = (None if end is None else f"{end:{'' if whole else 'g'}}" for end in (least, most))
    words = "" if low is None else f" above {low}" if above else f" from {low}"
    if high is not None:
        joint = "" if low is None else " and" if above else " to"
        words += f"{joint} below {high}" if below else f"{' to' if words and not above else ' up to'} {high}"
    elif words and not above:
        words += " on"
    return f"a {'whole ' if whole else ''}number{words}"


def suggestion(name: str, known: Collection[str]) -> str:
    """The way out for an unknown name: the same quantity in a known unit, the nearest known name, or all of them."""
    lower = {one.lower(): one for one in known}
    stem = _without_unit(name)
    in_other_units = [one for one in known if _without_unit(one) == stem]
    if stem != name and in_other_units and name.lower() not in lower:
        return f"give {in_other_units[0]}, in the unit it names"
    near = difflib.get_close_matches(name.lower(), lower, n=1)
    return f"did you mean {lower[near[0]]}?" if near else f"known are {', '.join(known)}"


_UNITS = {"mm", "cm", "m", "um", "in", "kpa", "pa", "mpa", "psi", "s", "ms", "us", "min", "hz", "khz", "deg", "rad"}


def _without_unit(name: str) -> str:
    """The quantity of a name: ``x`` for ``x_cm`` and ``x_mm``."""
    stem, _, unit = name.rpartition("_")
    return stem if stem and unit.lower() in _UNITS else name


_MOST_SHOWN = 1000  # characters of a file's content that an error repeats


def _shortened(text: str) -> str:
    if len(text) <= _MOST_SHOWN:
        return text
    return f"{text[: _MOST_SHOWN // 2]} ... ({len(text)} characters) ... {text[-_MOST_SHOWN // 4 :]}"


class BadDataError(TactileBayesError, ValueError):
    """A file, array or table has invalid content: `what` names the fault and the value, `way_out` the remedy.

    `path` is the file at fault. Code that holds only arrays leaves it out; the reader fills it in (`in_file`).
    """

    exit_code = EXIT_BAD_DATA

    def __init__(self, what: str, *, way_out: str = "", path: str = "") -> None:
        super().__init__(what)
        self.what = what
        self.way_out = way_out
        self.path = path

    def __str__(self) -> str:
        what = _shortened(self.what)
        head = f"{self.path}: {what}" if self.path else what
        text = f"{head}; {_shortened(self.way_out)}" if self.way_out else head
        return "\\n".join(text.splitlines())  # names and values from a file may hold newlines

    def with_path(self, path: object) -> BadDataError:
        """The same error with the path of its file, unless it has one."""
        return type(self)(self.what, way_out=self.way_out, path=self.path or str(path))


@contextmanager
def in_file(path: object) -> Iterator[None]:
    """Name a file in each `BadDataError` of the block that names none."""
    try:
        yield
    except BadDataError as error:
        raise error.with_path(path) from None


class DeviceError(TactileBayesError):
    """A port or a device did not answer as its protocol says."""

    exit_code = EXIT_DEVICE


class NotConvergedError(TactileBayesError):
    """A sampler or solver stopped before its own criteria were met.

    The message names the criterion and how much longer to run; `diagnostics` are the figures at that time, and `advice`
    is the remedy where a longer run would not help.
    """

    exit_code = EXIT_NOT_CONVERGED

    def __init__(self, message: str, *, diagnostics: dict[str, float] | None = None, advice: str = "") -> None:
        super().__init__(message)
        self.diagnostics = diagnostics or {}
        self.advice = advice


def one_line(error: BaseException) -> str:
    """An error in one line, with its class unless it is one of this program's."""
    text = " ".join(str(error).split())
    if isinstance(error, TactileBayesError) and text:
        return text
    return f"{type(error).__name__}: {text}" if text else type(error).__name__


# --- Reasons for giving no number: a sentence, a code for programs, and the remedy.

CANNOT_SHOW = "cannot_show"  #: Code of data that cannot show a lump even where there is one.
Code = Literal["empty", "undetected", "ridge", "cannot_show", "unresolved", "window", "prior", "extrapolated", "method"]
CODES = get_args(Code)
NO_LUMP = ("empty", "undetected", "ridge")
"""Codes of maps that show no lump where one would show; the others but `CANNOT_SHOW` show one without a size."""


@dataclass(frozen=True, slots=True)
class Abstention:
    """The reason for giving no number."""

    code: str  #: One of `CODES`.
    reason: str  #: With the figure and the limit.
    advice: str = ""  #: The remedy at the command line; empty when there is none.
    on_paper: str = ""  #: The same for a reader of the exam's page, who has no command line.
    about_mm: tuple[float, float] | None = None
    """The place on the map that the reason is about; None where it is about no one place."""
