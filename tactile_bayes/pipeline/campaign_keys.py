"""What tells a campaign that something changed: digests of plain data, and stamps of files."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

from tactile_bayes import __version__


def digest_of(key: object) -> str:
    """Digest of plain data and the program's version."""
    text = json.dumps([__version__, key], sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()


def stamp(path: Path) -> str:
    """Size, times and inode of a file, which differ when it was written to or replaced."""
    known = path.stat()
    return f"{known.st_size} {known.st_mtime_ns} {known.st_ctime_ns} {known.st_ino}"
