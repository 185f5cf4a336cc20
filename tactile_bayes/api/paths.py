"""Conversion of paths that Python callers give as str or Path."""

from __future__ import annotations

import os
from pathlib import Path
from typing import overload

from tactile_bayes.errors import UsageError
from tactile_bayes.files.file_names import Format, check_suffix

PathLike = str | os.PathLike[str]


@overload
def path_of(given: PathLike) -> Path: ...


@overload
def path_of(given: None) -> None: ...


def path_of(given: PathLike | None) -> Path | None:
    """Convert to a path, with ``~`` as the home folder; None stays None.

    Raises
    ------
    UsageError
        When it is neither text nor a path.
    """
    if given is None:
        return None
    if not isinstance(given, str | os.PathLike):
        raise UsageError(f"a path is wanted, not {type(given).__name__}; give it as text or pathlib.Path")
    return Path(given).expanduser()


def required_path(given: PathLike, name: str) -> Path:
    """Convert to the path of an input.

    Raises
    ------
    UsageError
        As `path_of`, and when it is None.
    """
    if given is None:
        raise UsageError(f"{name} is None; give the path of a file")
    return path_of(given)


def output_path(given: PathLike, written: Format) -> Path:
    """Convert to the path of an output.

    Raises
    ------
    UsageError
        As `path_of`, and when it has the suffix of another format than the one written.
    """
    path = required_path(given, "the path")
    check_suffix(path, written)
    return path
