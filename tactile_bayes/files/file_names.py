"""Names of files: whether two are one file, and whether one ends as the format that is written to it."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path
from typing import Final, Literal

from tactile_bayes.errors import UsageError

Format = Literal["netCDF", "MCAP", "JSON", "CSV", "HTML", "PDF", "NRRD"]

# Suffixes by which a name promises a format; the first is the one advised. A netCDF file is an HDF5 file too.
_SUFFIXES: Final[dict[str, tuple[str, ...]]] = {
    "netCDF": (".nc", ".nc4", ".cdf", ".h5", ".hdf5"),
    "MCAP": (".mcap",),
    "JSON": (".json",),
    "CSV": (".csv",),
    "HTML": (".html", ".htm"),
    "PDF": (".pdf",),
    "NRRD": (".nrrd",),
    "a format that this file is not written in": (
        *(".dcm", ".mat", ".npy", ".npz", ".ods", ".parquet", ".toml", ".tsv", ".xls", ".xlsx", ".xml", ".zip"),
        *(".bmp", ".gif", ".jpeg", ".jpg", ".pgm", ".png", ".svg", ".tif", ".tiff"),
    ),
}
_PROMISED: Final = frozenset(suffix for known in _SUFFIXES.values() for suffix in known)


def check_suffix(path: Path, written: Format) -> None:
    """Refuse a name that promises another format than the one written; any unknown suffix may be given, or none.

    Raises
    ------
    UsageError
        Naming the suffix, the format and a name that fits.
    """
    suffix = path.suffix.lower()
    if suffix in _PROMISED and suffix not in _SUFFIXES[written]:
        fitting = path.with_suffix(_SUFFIXES[written][0]).name
        raise UsageError(f"{path} has the suffix {path.suffix!r}, and {written} is written; name it {fitting}")


def same_file(one: Path, other: Path) -> bool:
    """Whether two paths lead to one file, by symbolic or hard links too; neither needs to exist."""
    return _identity(one) == _identity(other)


def given_twice(paths: Iterable[Path]) -> Path | None:
    """The first path that leads to the file of one before it; None where each is another file."""
    seen = set[tuple[int, int] | str]()
    for path in paths:
        if (identity := _identity(path)) in seen:
            return path
        seen.add(identity)
    return None


def _identity(path: Path) -> tuple[int, int] | str:
    """What all names of a file have in common; where it does not exist, the name that it would have."""
    try:
        found = path.stat()
    except OSError:  # opening it says what is wrong with it
        return os.path.realpath(path)
    return found.st_dev, found.st_ino
