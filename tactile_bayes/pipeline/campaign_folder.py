"""The output folder of a campaign: its journal, and the files that belong to its steps."""

from __future__ import annotations

import contextlib
import statistics
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from tactile_bayes.batch_store import BatchStore, open_store
from tactile_bayes.errors import TactileBayesError, UsageError
from tactile_bayes.files.atomic import sha256, unwritable
from tactile_bayes.files.manifest_csv import Exam
from tactile_bayes.pipeline.campaign_steps import FILES, UNWRITTEN, Result

JOURNAL: Final = "campaign.journal"
EXAMS, MASSES = "exams", "masses"
_HEADER: Final = {"campaign": 1}
_OF_EXAMS: Final = tuple(name for step, names in FILES.items() if step != "pool" for name in names)


@contextlib.contextmanager
def open_campaign(folder: Path, *, dry: bool = False) -> Iterator[BatchStore | None]:
    """Open the journal of a folder, which is made if need be; None for a dry run in a folder without one.

    Raises
    ------
    UsageError
        When the folder holds something else, another run is using it, or it cannot be made.
    """
    journal = folder / JOURNAL
    if not journal.exists():
        if folder.is_dir() and any(folder.iterdir()):
            raise UsageError(f"{folder} holds files, and no campaign; choose a new folder")
        if dry:
            yield None
            return
        _make(folder)
    with open_store(journal, settings=_HEADER, encode=_taken) as store:
        yield store


def _make(folder: Path) -> None:
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
    except OSError as error:
        raise unwritable(folder, error) from None


def _taken(result: Result) -> Result:
    """Stop the campaign where the disk did not take a result; others go into the journal."""
    if UNWRITTEN in result:
        raise UsageError(f"{result[UNWRITTEN]}; what is done is kept: run again to go on")
    return result


def unchanged(folder: Path, files: Mapping[str, str]) -> bool:
    """Whether the files of a step, by name with their digests, are still what it wrote."""
    try:
        return all(sha256(folder / name) == digest for name, digest in files.items())
    except TactileBayesError:
        return False


def median_seconds(values: Mapping[str, Any]) -> dict[str, float]:
    """Median seconds of each step, from results of any run."""
    taken = defaultdict(list)
    for key, value in values.items():
        taken[key.split(" ")[0]].append(value["seconds"])
    return {step: statistics.median(times) for step, times in taken.items()}


def tidy(folder: Path, exams: Sequence[Exam], results: Mapping[str, Mapping[str, Result]]) -> list[str]:
    """Remove files of earlier runs that this one would not make, and name the folders of exams no longer listed.

    Parameters
    ----------
    folder
        Of the campaign.
    results
        By step, then by the name of the exam or mass.
    """
    made: dict[Path, set[str]] = {folder / EXAMS / exam.name: set() for exam in exams}
    made |= {folder / MASSES / exam.of_mass: set() for exam in exams}
    for step, found in results.items():
        place = folder / (MASSES if step == "pool" else EXAMS)
        for name, result in found.items():
            made[place / name] |= set(result["files"])
    for place, kept in made.items():
        for name in FILES["pool"] if place.parent.name == MASSES else _OF_EXAMS:
            if name not in kept:
                (place / name).unlink(missing_ok=True)
        _remove_if_empty(place)
    for name in (EXAMS, MASSES):
        _remove_if_empty(folder / name)
    there = [one for name in (EXAMS, MASSES) for one in sorted((folder / name).glob("*"))]
    return [f"{one.parent.name}/{one.name}" for one in there if one not in made]


def _remove_if_empty(folder: Path) -> None:
    with contextlib.suppress(OSError):  # it is not empty, or was never made
        folder.rmdir()
