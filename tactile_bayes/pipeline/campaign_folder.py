"""The output folder of a campaign: its journal, and the files that belong to its steps."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Final

from tactile_bayes.batch_store import BatchStore, open_store
from tactile_bayes.errors import TactileBayesError, UsageError
from tactile_bayes.files.atomic import sha256, unwritable
from tactile_bayes.files.campaign_names import EXAMS, GROWTH, JOURNAL, MASSES
from tactile_bayes.files.manifest_csv import Exam
from tactile_bayes.pipeline.campaign_keys import stamp
from tactile_bayes.pipeline.campaign_staging import STAGED, clear_staged, put_in_place
from tactile_bayes.pipeline.campaign_steps import FILES, UNWRITTEN, Result

_HEADER: Final = {"campaign": 1}
_BESIDE: Final = ("repeatability",)
"""Steps whose files lie beside the exams."""
_OTHERS: Final = ("pool", "compare", *_BESIDE)
"""Steps that are of no single exam."""


@contextlib.contextmanager
def open_campaign(folder: Path, *, dry: bool = False) -> Iterator[BatchStore | None]:
    """Open the journal of a folder, which is made if need be; for a dry run read it only, None where there is none.

    Raises
    ------
    UsageError
        When the folder holds something else, another run is using it, or it cannot be made or read.
    """
    journal = folder / JOURNAL
    try:
        begun, used = journal.exists(), folder.is_dir() and any(folder.iterdir())
    except OSError as error:
        raise UsageError(f"{folder} cannot be read ({error.strerror}); choose another folder") from None
    if not begun:
        if used:
            raise UsageError(f"{folder} holds files, and no campaign; choose a new folder")
        if dry:
            yield None
            return
        _make(folder)
    with open_store(journal, settings=_HEADER, encode=_taken, read_only=dry) as store:
        yield store


def _make(folder: Path) -> None:
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
    except OSError as error:
        raise unwritable(folder, error) from None


def _taken(result: Result) -> Result:
    """Put a result's files in place for the journal; the campaign stops where the disk does not take them."""
    fault = result.get(UNWRITTEN)
    if fault is None:
        try:
            return put_in_place(result)
        except FileNotFoundError:
            fault = f"a worker's files are not in {result[STAGED]['folder']}: do all machines see this folder?"
        except OSError as error:
            fault = str(error)
    raise UsageError(f"{fault}; what is done is kept: run again to go on")


def unchanged(folder: Path, result: Result) -> bool:
    """Whether the files of a step are still what it wrote: by their stamps, and where these differ by their digests."""
    stamps = result.get("stamps", {})
    return all(_same(folder / name, digest, stamps.get(name)) for name, digest in result["files"].items())


def _same(path: Path, digest: str, stamped: str | None) -> bool:
    try:
        return stamp(path) == stamped or sha256(path) == digest
    except (OSError, TactileBayesError):
        return False


class StepResults(Mapping[str, Result]):
    """Results of one step by the names of the exams or masses, read from the journal when they are asked for."""

    def __init__(self, values: Mapping[str, Result]) -> None:
        self._values = values
        self._keys: dict[str, str] = {}

    def add(self, name: str, key: str) -> None:
        """Note under which key the journal holds a result."""
        self._keys[name] = key

    def __getitem__(self, name: str) -> Result:
        return self._values[self._keys[name]]

    def __contains__(self, name: object) -> bool:
        return name in self._keys

    def __iter__(self) -> Iterator[str]:
        return iter(self._keys)

    def __len__(self) -> int:
        return len(self._keys)


def tidy(
    folder: Path, exams: Sequence[Exam], results: Mapping[str, Mapping[str, Result]], *, unread: Collection[str] = ()
) -> list[str]:
    """Remove files of earlier runs that this one would not make, and name the folders of exams no longer listed.

    Parameters
    ----------
    folder
        Of the campaign.
    results
        By step, then by the name of the exam or mass.
    unread
        Exams whose file could not be read: a disk that is away costs nothing that is done.
    """
    left = []
    spared = {*unread, *(name for exam in exams if exam.name in unread for name in (exam.of_mass, exam.of_visits))}
    for step in _BESIDE:
        made = {file for result in results[step].values() for file in result["files"]}
        _clear(folder, known=FILES[step], made=made)
    for kind, names, steps in (
        (EXAMS, {exam.name for exam in exams}, tuple(step for step in results if step not in _OTHERS)),
        (MASSES, {exam.of_mass for exam in exams}, ("pool",)),
        (GROWTH, {exam.of_visits for exam in exams}, ("compare",)),
    ):
        for name in sorted(_names_in(folder / kind)):
            if name not in names:
                left.append(f"{kind}/{name}")
            if name not in names or name in spared:
                continue
            made = {file for step in steps if name in results[step] for file in results[step][name]["files"]}
            _clear(folder / kind / name, known={file for step in steps for file in FILES[step]}, made=made)
        _remove_if_empty(folder / kind)
    return left


def _names_in(folder: Path) -> list[str]:
    try:
        return os.listdir(folder)  # noqa: PTH208 (names only: the directory may be large)
    except OSError:
        return []


def _clear(place: Path, *, known: Collection[str], made: Collection[str]) -> None:
    """Remove the files of a folder that a step makes and this run did not, and the folder when none is left."""
    names = _names_in(place)
    clear_staged(place, names)
    for name in names:
        if name in known and name not in made:
            (place / name).unlink(missing_ok=True)
    if not made:
        _remove_if_empty(place)


def _remove_if_empty(folder: Path) -> None:
    with contextlib.suppress(OSError):  # it is not empty, or was never made
        folder.rmdir()
