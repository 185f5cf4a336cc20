"""Input files of a campaign, and its output folder."""

from __future__ import annotations

import contextlib
import hashlib
import shutil
import time
from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from operator import itemgetter
from pathlib import Path
from typing import Any, Final

from tactile_bayes.batch import CLUSTER_LOST, BatchStore, open_store, run_batch
from tactile_bayes.campaigns.exams import Breasts
from tactile_bayes.campaigns.steps import FILES, STAGED, UNWRITTEN, WAITING, Result, put_in_place, stamp
from tactile_bayes.errors import BadDataError, TactileBayesError, UsageError
from tactile_bayes.files.atomic import sha256, unwritable
from tactile_bayes.files.manifest_csv import EXAMS, GROWTH, JOURNAL, MASSES, Exam
from tactile_bayes.files.reading import sha256_of, version_of
from tactile_bayes.progress import Progress

# --- The output folder of a campaign: its journal, and the files that belong to its steps.

_HEADER: Final = {"campaign": 1}
_BESIDE: Final = "repeatability"  #: The step whose files lie beside the exams.
SITE: Final = "site"  #: Its name: it is of no exam or mass.
_OTHERS: Final = ("pool", "compare", _BESIDE)  #: Steps that are of no single exam.


@contextlib.contextmanager
def open_campaign(folder: Path, *, dry: bool = False) -> Iterator[BatchStore | None]:
    """Open the journal of a folder, which is made if need be; for a dry run read it only, None where there is none.

    A folder of something else, one that another run is using, or one that cannot be made or read is a `UsageError`.
    """
    journal = folder / JOURNAL
    try:
        has_journal, has_files = journal.exists(), folder.is_dir() and any(folder.iterdir())
    except OSError as error:
        raise UsageError(f"{folder} cannot be read ({error.strerror}); choose another folder") from None
    if not has_journal:
        if has_files:
            raise UsageError(f"{folder} holds files, and no campaign; choose a new folder")
        if not folder.absolute().parent.is_dir():
            raise UsageError(f"{folder.parent} is not a directory; create it first")
        if dry:
            yield None
            return
        try:
            folder.mkdir(mode=0o700, exist_ok=True)
        except OSError as error:
            raise unwritable(folder, error) from None
    with open_store(journal, settings=_HEADER, encode=_commit, read_only=dry) as store:
        yield store


def _commit(result: Result) -> Result:
    """Put a result's files in place, before the journal takes it; a `UsageError` where the disk does not take them."""
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
    """True if the files of a step are as it wrote them: by their stamps, and where these differ by their digests."""
    stamps = result.get("stamps", {})
    try:
        return all(
            stamp(folder / name) == stamps.get(name) or sha256(folder / name) == digest
            for name, digest in result["files"].items()
        )
    except (OSError, TactileBayesError):
        return False


def remove_stale_files(
    folder: Path, exams: Sequence[Exam], files_of: Callable[[str, str], Collection[str]], *, unread: Collection[str]
) -> list[str]:
    """Remove files of earlier runs that this one did not make; returns folders of exams that the table does not list.

    `files_of`: names of the files that a step of this run made for an exam or mass; `unread`: exams whose file could
    not be read, which keep their files.
    """
    left = []
    spared = {*unread, *(name for exam in exams if exam.name in unread for name in (exam.of_mass, exam.of_visits))}
    _clear(folder, known=FILES[_BESIDE], made=files_of(_BESIDE, SITE))
    for kind, names, steps in (
        (EXAMS, {exam.name for exam in exams}, tuple(step for step in FILES if step not in _OTHERS)),
        (MASSES, {exam.of_mass for exam in exams}, ("pool",)),
        (GROWTH, {exam.of_visits for exam in exams}, ("compare",)),
    ):
        for name in sorted(path.name for path in (folder / kind).glob("*")):
            if name not in names:
                left.append(f"{kind}/{name}")
            elif name not in spared:
                made = {file for step in steps for file in files_of(step, name)}
                _clear(folder / kind / name, known={file for step in steps for file in FILES[step]}, made=made)
        _remove_if_empty(folder / kind)
    return left


def _clear(place: Path, *, known: Collection[str], made: Collection[str]) -> None:
    """Remove the files of a folder that a step makes and this run did not, and the folder when none is left."""
    for path in place.glob("*"):
        if path.name.startswith(WAITING):  # of a step whose command was ended
            shutil.rmtree(path, ignore_errors=True)
        elif path.name in known and path.name not in made:
            path.unlink(missing_ok=True)
    if not made:
        _remove_if_empty(place)


def _remove_if_empty(folder: Path) -> None:
    with contextlib.suppress(OSError):  # it is not empty, or was never made
        folder.rmdir()


# --- The files of a campaign's exams: their digests, and which of them are the same bytes or the same recording.
#
# A digest is read once: the journal keeps it under the file's name, size, times and inode. The time of the last
# change of the inode cannot be set by a program, so a file that was written to or replaced is read again. Files
# changed within the last seconds are always read, for their times may not yet tell two writes apart.

READ: Final = "read"  #: Step of the journal that holds a file's digest.
_SETTLED_S: Final = 10.0  #: A file that was last changed so long ago has times that tell this content from a later one.


def _digest_key(exam: Exam) -> tuple[str, bool]:
    """Key of the file's digest in the journal, and True if no later content can have the same key.

    A file that changed a moment ago may get other content under its key, and one that cannot be read has none; the tag
    of an object store is safe at once.
    """
    try:
        if exam.address:
            version, changed = version_of(exam.address), 0.0
        else:
            status = exam.path.stat()
            version, changed = stamp(exam.path), max(status.st_mtime, status.st_ctime)
    except (OSError, BadDataError):
        return exam.file, False
    key = f"{READ} {exam.file} {hashlib.sha256(version.encode()).hexdigest()[:32]}"
    return key, changed < time.time() - _SETTLED_S


def _digest(file: tuple[str, Path, str]) -> dict[str, Any]:
    """The digest of a file (its key, its path, and its address in an object store), and how long it took."""
    _, path, address = file
    begun = time.perf_counter()
    digest = sha256_of(address) if address else sha256(path)
    return {"sha256": digest, "seconds": round(time.perf_counter() - begun, 6)}


def read_sources(
    exams: Sequence[Exam], *, store: BatchStore | None, keep: bool, executor: Executor | None, progress: Progress
) -> tuple[dict[Path, str], dict[Path, str]]:
    """SHA-256 of every exam's file by its path, from the journal where the file is as it was then, and faults of files.

    New digests go into the journal (`keep`), or else files in object stores that are not known are passed over. A lost
    cluster is a `TactileBayesError`.
    """
    files = {exam.path: (exam, *_digest_key(exam)) for exam in {exam.path: exam for exam in exams}.values()}
    values: Mapping[str, Any] = {} if store is None else store
    known = {path: values[key]["sha256"] for path, (_, key, settled) in files.items() if settled and key in values}
    digests, faults = known, dict[Path, str]()
    for settled_ones, journal in ((True, store if keep else None), (False, None)):
        waiting = [
            (key, path, exam.address)
            for path, (exam, key, settled) in files.items()
            if settled == settled_ones and path not in known and (keep or not exam.address)
        ]
        outcomes = run_batch(_digest, waiting, key=itemgetter(0), executor=executor, store=journal, progress=progress)
        for (_, path, address), outcome in zip(waiting, outcomes, strict=True):
            if outcome.value is not None:
                digests[path] = outcome.value["sha256"]
            elif outcome.error == CLUSTER_LOST:
                raise TactileBayesError(f"{CLUSTER_LOST}; what is done is kept")
            else:
                faults[path] = outcome.error.removeprefix(f"{address or path}: ")
    return digests, faults


class DuplicateExams:
    """Finds exams with the same content, which only masses of one scan may have, block by block.

    `shared` is the content's name for messages: ``"bytes"`` or ``"recording"``.
    """

    def __init__(self, breasts: Breasts, shared: str) -> None:
        self._breasts, self._shared = breasts, shared
        self._sharing: dict[str, list[Exam]] = defaultdict(list)

    def faults(self, marks: Mapping[Exam, Iterable[str]]) -> dict[str, str]:
        """Faults of these exams and of earlier ones, by name; `marks`: digests of each exam's content.

        Masses of one scan, each with its place, have none.
        """
        new = {mark: None for of_exam in marks.values() for mark in of_exam}
        for exam, of_exam in marks.items():
            for mark in dict.fromkeys(of_exam):
                self._sharing[mark].append(exam)
        return {name: reason for mark in new for name, reason in self._reasons(self._sharing[mark])}

    def _reasons(self, alike: Sequence[Exam]) -> Iterator[tuple[str, str]]:
        one_visit = len({(exam.patient, exam.visit, exam.side) for exam in alike}) == 1
        placed = {one.mass for one in alike if one.centre_mm is not None or self._breasts.exams_with_places(one)}
        if len(alike) == 1 or (one_visit and len(placed) == len(alike)):
            return
        for exam in alike:
            others = [other for other in alike if other is not exam]
            named = ", ".join(f"{other.name} ({other.file})" for other in others[:3])
            way_out = "give each exam its own file, or each mass of a breast its centre_x_mm and centre_y_mm"
            yield exam.name, f"holds the same {self._shared} as {named}; {way_out}"
