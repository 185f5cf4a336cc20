"""Files that appear whole or not at all, readable by their owner only."""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
import tempfile
import zlib
from collections.abc import Iterator
from pathlib import Path

from tactile_bayes.errors import BadDataError, UsageError

_PART = ".part"


def refuse_existing(path: Path, *, force: bool) -> None:
    """Stop before any work is done when the output exists and --force was not given."""
    if path.exists() and not force:
        raise UsageError(f"{path} exists; choose another name or give --force")
    if not path.parent.is_dir():
        raise UsageError(f"{path.parent} is not a directory; create it first")


@contextlib.contextmanager
def atomic_path(path: Path, *, force: bool = False) -> Iterator[Path]:
    """A temporary path beside `path` that becomes `path` when the block ends well.

    The file is created with mode 0600, flushed to disk and renamed over the target, so that a kill at any
    moment leaves the old file or none. If the block raises, the temporary file goes; what a killed process of this
    computer left beside the same target goes with the next write.

    Raises
    ------
    UsageError
        When `path` exists and `force` is false, or its directory does not exist.
    """
    refuse_existing(path, force=force)
    _sweep(path)
    handle, name = tempfile.mkstemp(prefix=f".{path.name}.{_host()}-{os.getpid()}-", suffix=_PART, dir=path.parent)
    os.close(handle)
    partial = Path(name)
    try:
        yield partial
        partial.chmod(0o600)
        with partial.open("rb") as file:
            os.fsync(file.fileno())
        _publish(partial, path, force=force)
    finally:
        partial.unlink(missing_ok=True)


def _host() -> str:
    """This computer, in eight letters: directories may be shared with others."""
    import socket

    return f"{zlib.crc32(socket.gethostname().encode()):08x}"


def _sweep(path: Path) -> None:
    """Remove what processes that are no more left of an earlier write of `path`."""
    pattern = re.compile(rf"{re.escape(f'.{path.name}.{_host()}')}-(\d+)-[^.]*{re.escape(_PART)}")
    for name in os.listdir(path.parent):  # noqa: PTH208 (names only: the directory may be large)
        found = pattern.fullmatch(name)
        if found and not _alive(int(found[1])):
            path.with_name(name).unlink(missing_ok=True)


def _alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):
        return True
    return True


def _publish(partial: Path, path: Path, *, force: bool) -> None:
    if force:
        partial.replace(path)
        return
    try:
        path.hardlink_to(partial)  # fails, rather than overwrites, if somebody made the file meanwhile
    except FileExistsError:
        raise UsageError(f"{path} exists; choose another name or give --force") from None
    except OSError:  # a file system without hard links
        partial.replace(path)


def write_text(path: Path, text: str, *, force: bool = False) -> None:
    """Write `text` as UTF-8, atomically."""
    with atomic_path(path, force=force) as partial:
        partial.write_text(text, encoding="utf-8")


def sha256(path: Path) -> str:
    """Hex digest of a file's bytes.

    Raises
    ------
    BadDataError
        When the file cannot be read.
    """
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise unreadable(path, error) from None


def unreadable(path: Path, error: OSError) -> BadDataError:
    """The one line for a file that cannot be opened."""
    return BadDataError(f"cannot be read ({error.strerror or error})", way_out="check the path", path=str(path))
