"""A campaign's settings, keys of work done, and files that are put in place."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any, Final

from tactile_bayes import __version__
from tactile_bayes.api.settings import Settings
from tactile_bayes.declarations import Record, field, replace
from tactile_bayes.files.atomic import sha256
from tactile_bayes.files.manifest_csv import Exam
from tactile_bayes.presets import DEFAULT_NORMALISE, MATCH_MM

# --- What tells a campaign that something changed: digests of plain data, and stamps of files.


def digest_of(key: object) -> str:
    """Digest of plain data and the program's version."""
    text = json.dumps([__version__, key], sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()


def stamp(path: Path) -> str:
    """Size, times and inode of a file, which differ when it was written to or replaced."""
    known = path.stat()
    return f"{known.st_size} {known.st_mtime_ns} {known.st_ctime_ns} {known.st_ino}"


# --- Settings of all exams of a campaign.


class CampaignSettings(Record):
    """Settings of all exams."""

    estimate: Settings = field(default_factory=Settings)
    """As of `estimate`; a row of the table may replace place, known values and calibration."""
    normalise: str = DEFAULT_NORMALISE  #: As of `map`.
    figures: bool = False  #: Whether the figures of `estimate` are drawn for each exam.
    match_mm: float = MATCH_MM
    """Within this distance a mass is that which another exam of the breast names by its place."""
    own_repeatability: bool = True
    """Whether the spread between exams is learned from the campaign's own repeats, where enough masses have them and
    the estimate's settings do not say it.
    """
    copy_to: str = ""
    """Address of a folder in an object store that gets a copy of every file; empty for none."""

    def of(self, exam: Exam) -> Settings:
        """Settings of one exam's estimate."""
        given: dict[str, Any] = {
            "centre_mm": exam.centre_mm,
            "size_calibration": exam.calibration,
            "known": exam.known or None,
        }
        return replace(self.estimate, **{name: value for name, value in given.items() if value is not None})


# --- The way of a step's files to their place: a worker writes them beside it, and the command puts them there.
#
# A worker of a cluster may end a step after the command that asked for it was killed, while another command goes on
# in the same folder with other settings. So workers write into a folder named by the step's key, and nothing but
# the command that holds the journal changes what tables and later steps read.

STAGED: Final = "staged"
"""Key of a result whose files wait beside their place: the folder they are in, and the names that have no file."""
_PREFIX: Final = ".new-"
_DIGITS: Final = 16

Writes = dict[str, Callable[[Path], object]]


def write_staged(folder: Path, writes: Writes, *, step: str, digest: str, names: Collection[str]) -> dict[str, Any]:
    """Write a step's files beside their place; returns their digests and where they are.

    `digest` is of all that the step's files depend on: equal files have equal folders. `names` are of all files that
    the step may write; those of earlier runs are removed when the others are put in place.
    """
    staged = folder / f"{_PREFIX}{step}-{digest[:_DIGITS]}"
    try:
        if writes:
            staged.mkdir(mode=0o700, parents=True, exist_ok=True)
        for name, write in writes.items():
            write(staged / name)
        files = {name: sha256(staged / name) for name in writes}
    except BaseException:
        shutil.rmtree(staged, ignore_errors=True)
        raise
    return {"files": files, STAGED: {"folder": str(staged), "without": [name for name in names if name not in writes]}}


def put_in_place(result: Mapping[str, Any]) -> dict[str, Any]:
    """Move the files of a result to their place, and remove those of earlier runs; returns it with their stamps."""
    if STAGED not in result:
        return dict(result)
    staged = Path(result[STAGED]["folder"])
    folder = staged.parent
    for name in result["files"]:
        (staged / name).replace(folder / name)
    for name in result[STAGED]["without"]:
        (folder / name).unlink(missing_ok=True)
    shutil.rmtree(staged, ignore_errors=True)
    stamps = {name: stamp(folder / name) for name in result["files"]}
    placed = {"files": result["files"], "stamps": stamps}
    return {**placed, **{name: value for name, value in result.items() if name not in (*placed, STAGED)}}


def clear_staged(folder: Path, names: Collection[str]) -> None:
    """Remove what steps of ended commands left beside their place; `names` are those in the folder."""
    for name in names:
        if name.startswith(_PREFIX):
            shutil.rmtree(folder / name, ignore_errors=True)
