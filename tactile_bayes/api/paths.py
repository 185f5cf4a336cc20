"""Conversion of paths that Python callers give as str or Path."""

from __future__ import annotations

import os
from pathlib import Path
from typing import overload

from tactile_bayes.errors import UsageError

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
