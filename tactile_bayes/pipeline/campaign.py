"""A campaign: from a table of exams to maps, estimates and pooled sizes, step by step, resumable.

Layout of the output folder: ``exams/EXAM/`` (map.nc, estimate.json, posterior.nc, shape.npz, thumbnail.png...) and
``masses/MASS/`` (pooled.json, pooled.nc), the tables and pages beside them (`campaign_report`), and the journal, which
holds for each step its key, the digests of its files and how long it took. The key is the step, the exam or mass, and a
digest of the program's version, the settings and the content of the inputs. A step whose key is in the journal and
whose files are what it made is not run again.

Exams go through the steps in blocks, in the order of the table, and the results stay in the journal: memory holds the
table of exams, a few hundred bytes for each step, and one block.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeVar

from tactile_bayes.batch import CLUSTER_LOST, BatchInterrupted, Outcome, run_batch
from tactile_bayes.batch_store import BatchStore
from tactile_bayes.errors import TactileBayesError
from tactile_bayes.files.manifest_csv import Exam
from tactile_bayes.pipeline.campaign_copies import copy_tasks
from tactile_bayes.pipeline.campaign_folder import EXAMS, MASSES, StepResults, median_seconds, unchanged
from tactile_bayes.pipeline.campaign_inputs import READ, read_sources, same_bytes
from tactile_bayes.pipeline.campaign_steps import ESTIMATE, FILES, MAP, SHAPE, Result, Task, digest_of, run_step
from tactile_bayes.pipeline.settings import Settings
from tactile_bayes.presets import DEFAULT_NORMALISE
from tactile_bayes.records import dataclass

if TYPE_CHECKING:
    from concurrent.futures import Executor

Progress = Callable[[int, int], None]
Bar = Callable[[str], AbstractContextManager[Progress]]
_Any = TypeVar("_Any")
_BLOCK: Final = 64
"""Exams that go through the steps together at least; workers wait for the slowest of a block."""
_AHEAD_IN_BLOCK: Final = 16
"""Blocks hold so many times what an executor takes ahead."""


@dataclass(frozen=True, slots=True)
class CampaignSettings:
    """Settings of all exams.

    Parameters
    ----------
    estimate
        As of `estimate`; a row of the table may replace place, known values and calibration.
    normalise
        As of `map`.
    figures
        Whether the figures of `estimate` are drawn for each exam.
    copy_to
        Address of a folder in an object store that gets a copy of every file; empty for none.
    """

    estimate: Settings = field(default_factory=Settings)
    normalise: str = DEFAULT_NORMALISE
    figures: bool = False
    copy_to: str = ""

    def of(self, exam: Exam) -> Settings:
        """Settings of one exam's estimate."""
        given: dict[str, Any] = {
            "centre_mm": exam.centre_mm,
            "calibration": exam.calibration,
            "known": exam.known or None,
        }
        return replace(self.estimate, **{name: value for name, value in given.items() if value is not None})


@dataclass(frozen=True, slots=True)
class Fault:
    """Why a step of an exam or a mass gave nothing."""

    step: str
    reason: str


@dataclass(frozen=True, slots=True, eq=False)
class CampaignState:
    """How far a campaign is: results by step and name, faults by name, counts and times of steps.

    Parameters
    ----------
    results
        By step, then by the name of the exam or mass.
    faults
        By the name of the exam or mass.
    kept, todo
        Steps done by earlier runs, and steps of this run, by step; for a plan those that it would do.
    seconds
        Median time that one of each step took so far.
    """

    results: dict[str, StepResults]
    faults: dict[str, Fault] = field(default_factory=dict)
    kept: dict[str, int] = field(default_factory=lambda: defaultdict(int))
    todo: dict[str, int] = field(default_factory=lambda: defaultdict(int))
    seconds: dict[str, float] = field(default_factory=dict)

    def of(self, step: str, name: str) -> Result | None:
        """Result of a step of an exam or mass; None where there is none."""
        return self.results[step].get(name)


class Campaign:
    """A run, or the plan of one.

    Parameters
    ----------
    exams
        As `read_manifest` gives them.
    folder
        Of the output.
    settings
        Of all exams.
    store
        From `open_campaign`.
    executor
        As `run_batch`'s.
    dry
        Plan only: nothing is run and nothing written.
    bar
        Gives, for what is counted ("files read", "steps"), a context with a callback for those done and those needed.

    Attributes
    ----------
    found
        Results, faults and counts, filled by `run`.
    not_pooled
        Why no mass is pooled; empty where masses are.
    unread
        Names of the exams whose file could not be read.
    """

    def __init__(
        self,
        exams: Sequence[Exam],
        folder: Path,
        settings: CampaignSettings,
        *,
        store: BatchStore | None,
        executor: Executor | None = None,
        dry: bool = False,
        bar: Bar | None = None,
    ) -> None:
        self.exams, self.folder, self.settings = exams, folder, settings
        values = {} if store is None else store.values
        results = {step: StepResults(values) for step in FILES}
        self.found = CampaignState(results, seconds=median_seconds(values))
        self.not_pooled = ""
        self.unread: set[str] = set()
        self._store, self._executor, self._dry = store, executor, dry
        self._bar: Bar = _no_bar if bar is None else bar
        self._tell: Progress = _untold
        self._done, self._total = 0, 0
        self._block = max(_BLOCK, _AHEAD_IN_BLOCK * int(getattr(executor, "ahead", 0)))
        self._digests: dict[Path, str] = {}
        self._calibrations: dict[str, str] = {}

    def run(self) -> CampaignState:
        """Run what is missing: maps, estimates and figures of exams, block by block, then pooled sizes.

        Raises
        ------
        UsageError
            When the disk does not take a result; all that is done is kept.
        TactileBayesError
            When the cluster was lost; all that is done is kept.
        BatchInterrupted
            On Ctrl-C; what is done is kept.
        """
        self._read_sources()
        sound = [exam for exam in self.exams if exam.name not in self.found.faults]
        self.not_pooled = self._why_not_pooled()
        masses = 0 if self.not_pooled else len({exam.of_mass for exam in sound})
        per_exam = 2 + self.settings.figures + bool(self.settings.copy_to)
        self._total = len(sound) * per_exam + masses * (2 if self.settings.copy_to else 1)
        with self._bar("steps") as self._tell:
            for block in _blocks(sound, self._block):
                self._size(block)
            if masses:
                self._pool(sound)
        return self.found

    def _read_sources(self) -> None:
        """Digests of all files: two exams of one file are found before any is mapped."""
        with self._bar("files read") as tell:
            sources = read_sources(
                self.exams, store=self._store, keep=not self._dry, executor=self._executor, progress=tell
            )
        self._digests = sources.digests
        for exam in self.exams:
            if exam.path in sources.faults:
                self.found.faults[exam.name] = Fault(READ, sources.faults[exam.path])
                self.unread.add(exam.name)
        for name, reason in same_bytes(self.exams, self._digests).items():
            self.found.faults[name] = Fault(READ, reason)

    def _size(self, exams: Sequence[Exam]) -> None:
        """Maps, estimates and figures of some exams."""
        known = [exam for exam in exams if exam.path in self._digests]  # a plan fetches nothing from a store
        self._stage("map", [self._map_task(exam) for exam in known], without=len(exams) - len(known))
        mapped = [exam for exam in exams if exam.name in self.found.results["map"]]
        unmapped = len(exams) - len(mapped)
        self._stage("estimate", [self._estimate_task(exam, "estimate") for exam in mapped], without=unmapped)
        if self.settings.figures:
            estimated = [exam for exam in mapped if exam.name in self.found.results["estimate"]]
            tasks = [self._estimate_task(exam, "figures") for exam in estimated]
            self._stage("figures", tasks, without=len(exams) - len(estimated))
        self._copy(EXAMS, [exam.name for exam in exams])

    def _copy(self, kind: str, names: Sequence[str]) -> None:
        """Copy the files of exams or masses into the object store."""
        if self.settings.copy_to:
            tasks = copy_tasks(self.folder / kind, names, self.found.results, to=f"{self.settings.copy_to}/{kind}")
            self._stage("copy", tasks, without=len(names) - len(tasks))

    def _map_task(self, exam: Exam) -> Task:
        digest = self._digests[exam.path]
        columns = ("patient", "side", "reader", "visit", "mass")
        expected = {name: value for name in columns if (value := getattr(exam, name)) is not None}
        key = {"scan": digest, "expected": expected, "normalise": self.settings.normalise}
        return Task(
            step="map",
            name=exam.name,
            folder=self.folder / EXAMS / exam.name,
            digest=digest_of(key),
            source=exam.path,
            source_sha256=digest,
            address=exam.address,
            expected=expected,
            normalise=self.settings.normalise,
        )

    def _estimate_task(self, exam: Exam, step: str) -> Task:
        """Task of the estimate, or of its figures."""
        made = self.found.of("map", exam.name)
        assert made is not None
        settings = self.settings.of(exam)
        key = {"map": made["files"][MAP], **self._settings_key(settings, made["normalise"])}
        folder = self.folder / EXAMS / exam.name
        return Task(step=step, name=exam.name, folder=folder, digest=digest_of(key), settings=settings)

    def _settings_key(self, settings: Settings, normalise: str) -> dict[str, Any]:
        """All that an estimate depends on besides its map: settings, and the digests of the files that they name."""
        from tactile_bayes.files.shipped import default_for

        plain = {one.name: getattr(settings, one.name) for one in fields(settings)}
        name = str(plain.pop("calibration") or default_for(normalise))
        file = plain.pop("settings_file")
        used = {"settings_sha256": None if file is None else self._file_digest(file), "calibration": name}
        return {**plain, **used, "calibration_sha256": self._calibration_digest(name)}

    def _calibration_digest(self, name: str) -> str:
        from tactile_bayes.files.shipped import size_calibration_path

        if name not in self._calibrations:
            path = size_calibration_path(name)
            self._calibrations[name] = "" if path is None else self._file_digest(path)
        return self._calibrations[name]

    def _file_digest(self, path: Path) -> str:
        """Digest of a file that many exams use."""
        from tactile_bayes.files.atomic import sha256

        if path not in self._digests:
            self._digests[path] = sha256(path)
        return self._digests[path]

    def _pool(self, sound: Sequence[Exam]) -> None:
        """Pool every mass at every visit from the exams that were estimated."""
        groups: dict[str, list[Exam]] = defaultdict(list)
        for exam in sound:
            if exam.name in self.found.results["estimate"]:
                groups[exam.of_mass].append(exam)
        unknown = len({exam.of_mass for exam in sound}) - len(groups)
        for names in _blocks(list(groups), self._block):
            self._stage("pool", [self._pool_task(name, groups[name]) for name in names])
            self._copy(MASSES, names)
        self._stage("pool", [], without=unknown)
        if self.settings.copy_to:
            self._stage("copy", [], without=unknown)

    def _why_not_pooled(self) -> str:
        """Why no mass is pooled; empty where some mass has several exams and the calibration can pool them."""
        from tactile_bayes.files.shipped import size_calibration_path
        from tactile_bayes.files.size_json import read_size_calibration
        from tactile_bayes.size.body_calibration import BodyCalibration

        if len({exam.of_mass for exam in self.exams}) == len(self.exams):
            return "no mass has several exams at one visit"
        for name in {self.settings.of(exam).calibration for exam in self.exams} - {None}:
            path = size_calibration_path(str(name))
            if path is None or not isinstance(read_size_calibration(path), BodyCalibration):
                return f"size calibration {name} is not learned over bodies"
        return ""

    def _pool_task(self, name: str, exams: Sequence[Exam]) -> Task:
        first = self.found.of("map", exams[0].name)
        assert first is not None
        settings = replace(self.settings.of(exams[0]), centre_mm=self.settings.estimate.centre_mm)
        files = [[exam.name, *(self._file(step, exam, file) for step, file in _POOLED_FROM)] for exam in exams]
        key = {"exams": files, **self._settings_key(settings, first["normalise"])}
        members = tuple((exam.name, self.folder / EXAMS / exam.name) for exam in exams)
        folder = self.folder / MASSES / name
        return Task(step="pool", name=name, folder=folder, digest=digest_of(key), settings=settings, members=members)

    def _file(self, step: str, exam: Exam, file: str) -> str | None:
        result = self.found.of(step, exam.name)
        return None if result is None else result["files"].get(file)

    def _stage(self, step: str, tasks: Sequence[Task], *, without: int = 0) -> None:
        """Run one step for those that need it.

        Parameters
        ----------
        without
            How many more have no inputs: in a plan they will need the step, in a run they failed before it.
        """
        kept = self._kept(tasks)
        for task in kept:
            self.found.results[step].add(task.name, task.key)
        missing = [task for task in tasks if task.name not in self.found.results[step]]
        self.found.kept[step] += len(kept)
        self.found.todo[step] += len(missing) + (without if self._dry else 0)
        self._total -= len(kept) + without
        if self._dry:
            return
        for task, outcome in zip(missing, self._run(missing), strict=True):
            if outcome.value is not None:
                self.found.results[step].add(task.name, task.key)
            elif outcome.error == CLUSTER_LOST:
                raise TactileBayesError(f"{CLUSTER_LOST}; what is done is kept")
            else:
                self.found.faults[task.name] = Fault(step, outcome.error)

    def _run(self, tasks: Sequence[Task]) -> list[Outcome[Result]]:
        before = self._done

        def tell(done: int, _total: int) -> None:
            self._tell(before + done, self._total)

        try:
            outcomes = run_batch(run_step, tasks, key=_key, executor=self._executor, store=self._store, progress=tell)
        except BatchInterrupted as stop:
            path = None if self._store is None else self._store.path
            raise BatchInterrupted(stop.outcomes, total=self._total, store=path, before=before) from None
        self._done += len(tasks)
        return outcomes

    def _kept(self, tasks: Sequence[Task]) -> list[Task]:
        """Tasks done by earlier runs whose files are still what they were; the results of others are forgotten."""
        if self._store is None:
            return []
        values = self._store.values
        known = [task for task in tasks if task.key in values]
        for task in known:
            if not unchanged(task.folder, values[task.key]):
                values.forget(task.key)
        return [task for task in known if task.key in values]


_POOLED_FROM: Final = (("map", MAP), ("estimate", ESTIMATE), ("estimate", SHAPE))


def _blocks(items: Sequence[_Any], size: int) -> Iterator[Sequence[_Any]]:
    for start in range(0, len(items), size):
        yield items[start : start + size]


def _untold(_done: int, _total: int) -> None:
    """Progress that nobody watches."""


def _no_bar(_label: str) -> AbstractContextManager[Progress]:
    return nullcontext(_untold)


def _key(task: Task) -> str:
    return task.key
