"""Atomic writing of files, and checks of output names."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import os
import re
import tempfile
import zlib
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Final, Literal

from tactile_bayes.errors import UsageError
from tactile_bayes.files.reading import open_input, readable, special_kind

# --- Names of files: whether two are one file, and whether one ends as the format that is written to it.

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
    """Refuse a name that promises another format than the one written; any unknown suffix may be given, or none."""
    suffix = path.suffix.lower()
    if suffix in _PROMISED and suffix not in _SUFFIXES[written]:
        fitting = path.with_suffix(_SUFFIXES[written][0]).name
        raise UsageError(f"{path} has the suffix {path.suffix!r}, and {written} is written; name it {fitting}")


def same_file(one: Path, other: Path) -> bool:
    """True when two paths lead to one file, by symbolic or hard links too; neither needs to exist."""
    return _identity(one) == _identity(other)


def refuse_same(
    outputs: Iterable[Path], inputs: Iterable[Path | None], *, role: str = "an input of this command"
) -> None:
    """Refuse an output that is the same file as an input, under any name; `role` is what the file is besides."""
    read = [path for path in inputs if path is not None]
    for path in outputs:
        if any(same_file(path, one) for one in read):
            raise UsageError(f"{path} is {role}; choose another name for the output")


def first_duplicate(paths: Iterable[Path]) -> Path | None:
    """The first path that leads to the file of one before it; None where each is another file."""
    seen = set[tuple[int, int] | str]()
    for path in paths:
        if (identity := _identity(path)) in seen:
            return path
        seen.add(identity)
    return None


def _identity(path: Path) -> tuple[int, int] | str:
    """Device and inode of a file, which all its names share; its real path where it does not exist."""
    try:
        status = path.stat()
    except OSError:  # opening it says what is wrong with it
        return os.path.realpath(path)
    return status.st_dev, status.st_ino


# --- Atomic writing of files, readable by their owner only; every failure to write is one error line.

_PART = ".part"
_LONGEST_STEM = 100
_WAYS_OUT = {
    errno.ENOSPC: "make room, or choose another place",
    errno.EDQUOT: "make room, or choose another place",
    errno.ENAMETOOLONG: "choose a shorter name",
    errno.ENOENT: "create the folder that it is to lie in",
}


def refuse_existing(*paths: Path | None, force: bool) -> None:
    """Raise an error, before any work is done, when one of `paths` (None is no file) exists and --force was not given,
    is a directory or a device (with or without --force), or lies in a directory that does not exist or may not be
    written.
    """
    for path in filter(None, paths):
        try:
            kind = special_kind(path.stat().st_mode)
        except FileNotFoundError:
            pass
        except OSError as error:
            raise unwritable(path, error) from None
        else:
            if kind:
                raise UsageError(f"{path} is {kind}; give the name of a regular file")
            if not force:
                raise UsageError(f"{path} exists; choose another name or give --force")
        folder = _target(path).parent
        if not folder.is_dir():
            raise UsageError(f"{folder} is not a directory; create it first")
        if not os.access(folder, os.W_OK | os.X_OK):
            raise UsageError(f"{folder} may not be written; choose another place")


def _target(path: Path) -> Path:
    """Path to be written; for a symbolic link, the file that it points to."""
    return Path(os.path.realpath(path)) if path.is_symlink() else path


@contextlib.contextmanager
def atomic_path(path: Path, *, force: bool = False) -> Iterator[Path]:
    """Yield a temporary path beside `path`, which becomes `path` when the block ends without an error.

    The file is created with mode 0600, flushed to disk and renamed over the target, so that a kill at any moment leaves
    the old file or none. If the block raises, the temporary file goes; what a killed process of this computer left
    beside the same target goes with the next write. A symbolic link stays, and what it points to is replaced. Nothing
    but the writing belongs inside the block: each `OSError` in it is reported as a failed write.
    """
    refuse_existing(path, force=force)
    target = _target(path)
    try:
        stem = _stem(target)
        _sweep(target, stem)
        handle, name = tempfile.mkstemp(prefix=f"{stem}-{os.getpid()}-", suffix=_PART, dir=target.parent)
        os.close(handle)
        partial = Path(name)
        try:
            yield partial
            partial.chmod(0o600)
            with partial.open("rb") as file:
                os.fsync(file.fileno())
            _publish(partial, target, force=force)
        finally:
            partial.unlink(missing_ok=True)
    except OSError as error:
        raise unwritable(path, error) from None


def _stem(target: Path) -> str:
    """Beginning of a target's temporary names on this computer; short, however long the target's name is."""
    name = os.fsencode(target.name)
    short = target.name if len(name) <= _LONGEST_STEM else f"{zlib.crc32(name):08x}"
    host = zlib.crc32(os.uname().nodename.encode())  # directories may be shared with other computers
    return f".{short}.{host:08x}"


def _sweep(target: Path, stem: str) -> None:
    """Remove temporary files of `target` that ended processes left behind."""
    pattern = re.compile(rf"{re.escape(stem)}-(\d+)-[^.]*{re.escape(_PART)}")
    for name in os.listdir(target.parent):  # noqa: PTH208 (names only: the directory may be large)
        match = pattern.fullmatch(name)
        if match and not _alive(int(match[1])):
            target.with_name(name).unlink(missing_ok=True)


def _alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):
        pass
    return True


def _publish(partial: Path, target: Path, *, force: bool) -> None:
    if force:
        partial.replace(target)
        return
    try:
        target.hardlink_to(partial)  # fails, rather than overwrites, if somebody made the file meanwhile
    except FileExistsError:
        raise UsageError(f"{target} exists; choose another name or give --force") from None
    except OSError:  # a file system without hard links
        partial.replace(target)


def write_text(path: Path, text: str, *, force: bool = False) -> None:
    """Write `text` as UTF-8, atomically."""
    write_bytes(path, text.encode("utf-8"), force=force)


def write_bytes(path: Path, data: bytes, *, force: bool = False) -> None:
    """Write `data` atomically; see `atomic_path` for the errors."""
    with atomic_path(path, force=force) as partial:
        partial.write_bytes(data)


def write_all(files: Mapping[Path, bytes], *, force: bool = False) -> None:
    """Write several files atomically: none appears before the bytes of all are written."""
    with contextlib.ExitStack() as stack:
        for path, data in files.items():
            stack.enter_context(atomic_path(path, force=force)).write_bytes(data)


def unwritable(path: Path, error: OSError) -> UsageError:
    """Error for an output that the system refuses to write."""
    shown = str(path) if len(str(path)) <= 120 else f"{str(path)[:117]}..."
    way_out = _WAYS_OUT.get(error.errno or 0, "choose another place")
    return UsageError(f"{shown} cannot be written ({error.strerror or error}); {way_out}")


def sha256(path: Path) -> str:
    """Hex digest of a file's bytes."""
    with open_input(path) as file, readable(path):
        return hashlib.file_digest(file, "sha256").hexdigest()
