"""Conversion of paths that Python callers give as str or Path."""

from __future__ import annotations

import os
from pathlib import Path
from typing import overload

PathLike = str | os.PathLike[str]


@overload
def path_of(given: PathLike) -> Path: ...


@overload
def path_of(given: None) -> None: ...


def path_of(given: PathLike | None) -> Path | None:
    """Convert to a path, with ``~`` as the home folder; None stays None."""
    return None if given is None else Path(given).expanduser()
