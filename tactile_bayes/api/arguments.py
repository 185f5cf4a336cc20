"""Arguments of the Python functions: their keywords, and errors in Python's words instead of the command line's."""

from __future__ import annotations

import inspect
import os
import re
from collections.abc import Callable, Collection, Iterable, Sequence
from functools import wraps
from html import escape
from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING, Any, Final, ParamSpec, TypeVar, overload

import numpy as np

from tactile_bayes.declarations import Record, default_of, field_types, meaning_of, names_of
from tactile_bayes.errors import BY_OPTIONS, BadDataError, TactileBayesError, UsageError, suggestion
from tactile_bayes.files.atomic import Format, check_suffix
from tactile_bayes.files.tables import Sheet

if TYPE_CHECKING:
    import pandas

_Given = ParamSpec("_Given")
_Returned = TypeVar("_Returned")
_SETTINGS_FILE: Final = re.compile(r" in --settings FILE\.toml|--settings FILE\.toml ")
_VALUE: Final = r"-?[\d.]+|[a-z]+[A-Z]?[a-z]*\d*(?:-[a-z]+)*(?:\.[a-z]+)?"
_OPTION: Final = re.compile(rf"(?<![\w-])--([a-z]+(?:-[a-z]+)*)(?: ({_VALUE}))?")
_CHOICES: Final = (
    *("method", "normalise", "fidelity", "noise", "background", "scene", "form", "fit", "to", "size_calibration"),
    *("frame_order", "level", "unit", "units", "length_unit", "time_unit", "pose_time_unit", "pose_layout"),
)
_FLAGS: Final = (
    *("as-stated", "force", "same-mass", "register-strokes", "flat-field", "patient-id-from-scan", "invert-rotation"),
)


Renamed = Sequence[tuple[str, str]]  #: Options written as keywords, and a function's own words for them.


def options_as_keywords(text: str, renamed: Renamed = ()) -> str:
    """Replace the command line's options in a text by keywords; commands between backticks stay."""
    parts = text.split("`")
    for i in range(0, len(parts), 2):
        parts[i] = _OPTION.sub(_keyword_for, _SETTINGS_FILE.sub("", parts[i]))
        for words, own in renamed:
            parts[i] = parts[i].replace(words, own)
    return "`".join(parts)


def _keyword_for(match: re.Match[str]) -> str:
    name, value = match[1].replace("-", "_"), match[2]
    if match[1] in _FLAGS:
        return f"{name}=True" + (f" {value}" if value else "")
    if value is None:
        return name
    if value.lstrip("-")[0] in "0123456789.":
        return f"{name}={value}"
    chosen = name in _CHOICES and value not in ("or", "is", "out", "says")
    return f'{name}="{value}"' if chosen else f"{name} {value}"


def door(function: Callable[_Given, _Returned], renamed: Renamed = ()) -> Callable[_Given, _Returned]:
    """Decorate a public function: its errors name keywords, or options where the command line calls it."""

    @wraps(function)
    def called(*args: _Given.args, **keywords: _Given.kwargs) -> _Returned:
        try:
            return function(*args, **keywords)
        except TactileBayesError as error:
            if BY_OPTIONS.get():
                raise
            if isinstance(error, BadDataError):
                error.what = options_as_keywords(error.what, renamed)
                error.way_out = options_as_keywords(error.way_out, renamed)
            else:
                error.args = (options_as_keywords(str(error), renamed),)
            raise

    return called


def takes(
    *records: type[Record], without: Collection[str] = (), renamed: Renamed = ()
) -> Callable[[Callable[_Given, _Returned]], Callable[_Given, _Returned]]:
    """Decorate a public function as `door` does; its further keywords are the fields of these records.

    Help and completion show each with its default. Their numbers of numpy are passed on as Python's. A keyword that was
    left out is not passed on: the record that the function makes of the others has the default.
    """
    fields = {name: default_of(record, name) for record in records for name in names_of(record) if name not in without}

    def decorate(function: Callable[_Given, _Returned]) -> Callable[_Given, _Returned]:
        parameters = [one for one in inspect.signature(function).parameters.values() if one.kind is not one.VAR_KEYWORD]
        names, call = [*(parameter.name for parameter in parameters), *fields], door(function, renamed)

        @wraps(function)
        def called(*args: _Given.args, **keywords: _Given.kwargs) -> _Returned:
            for name in keywords:
                if name not in names:
                    raise TypeError(f"{function.__name__} has no keyword {name!r}; {suggestion(name, names)}")
                if name in fields:
                    keywords[name] = plain(keywords[name])
            return call(*args, **keywords)

        called.__doc__ = _with_options(function.__doc__ or "", records, fields)
        options = (inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=fields[name]) for name in fields)
        called.__signature__ = inspect.Signature([*parameters, *options])  # type: ignore[attr-defined]
        return called

    return decorate


def _with_options(doc: str, records: Sequence[type[Record]], names: Collection[str]) -> str:
    """The docstring with the meaning of each option of the records that it names, below its entry for them."""
    lines = []
    for record in (one for one in records if f"{one.__name__}`" in doc):
        for name, kind in field_types(record).items():
            if name in names and (meaning := options_as_keywords(meaning_of(kind))):
                text = fill(meaning.rstrip("."), 100, initial_indent=" " * 8, subsequent_indent=" " * 8)
                lines.append(f"\n    {name}\n{text}.")
    before, stars, entry = doc.partition("\n    **")
    entry, gap, after = entry.partition("\n\n")
    return f"{before}{stars}{entry}{''.join(lines)}{gap}{after}"


def list_of(name: str, value: Any, kind: str) -> Sequence[Any]:
    """Convert an iterable other than a text to a list; `kind` names its items in the error."""
    if isinstance(value, str | bytes) or not isinstance(value, Iterable):
        raise UsageError(f"{name} is {value!r}; give a list of {kind}")
    return list(value)


def plain(value: Any) -> Any:
    """Convert numbers of numpy, also in a tuple, list or array, to Python's; return anything else as it is."""
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, np.ndarray):
        return tuple(value.tolist()) if value.ndim else value.item()
    if isinstance(value, tuple):
        return tuple(map(plain, value))
    return [plain(one) for one in value] if isinstance(value, list) else value


class TextResult(Record, eq=False):
    """Base of results that a notebook shows as their text."""

    @property
    def text(self) -> str:
        """The result in words."""
        raise NotImplementedError

    def _repr_html_(self) -> str:
        return f"<pre>{escape(self.text)}</pre>"


# --- Paths as texts or `Path`, tables as files or DataFrames.

PathLike = str | os.PathLike[str]


@overload
def path_of(path: PathLike) -> Path: ...


@overload
def path_of(path: None) -> None: ...


def path_of(path: PathLike | None) -> Path | None:
    """Convert a text or path to a path, with ``~`` as the home folder; None stays None."""
    if path is None:
        return None
    if not isinstance(path, str | os.PathLike):
        raise UsageError(f"a path is wanted, not {type(path).__name__}; give it as text or pathlib.Path")
    if not os.fspath(path):
        raise UsageError("the path is empty; give the name of a file or folder")
    return Path(os.path.expanduser(path))  # noqa: PTH111 (~x may be a file)


def required_path(path: PathLike, name: str) -> Path:
    """Convert to the path of an input, which may not be None."""
    if path is None:
        raise UsageError(f"{name} is None; give a path")
    return path_of(path)


def output_path(given: PathLike, kind: Format) -> Path:
    """Convert to the path of an output, which may not have the suffix of another format than the one written."""
    path = required_path(given, "the path")
    check_suffix(path, kind)
    return path


def dataframe(data: Any, columns: list[str] | None = None) -> pandas.DataFrame:
    """Make a pandas DataFrame; pandas is loaded here only."""
    import pandas

    return pandas.DataFrame(data, columns=columns)


def table_of(table: PathLike | pandas.DataFrame, name: str) -> Path | Sheet:
    """Return a path as it is, and a DataFrame as CSV text."""
    if hasattr(table, "to_csv"):
        return Sheet(Path(f"{name} (DataFrame)"), table.to_csv(index=False))
    return required_path(table, name)
