"""A campaign: from a table of exams to maps, estimates and pooled sizes, step by step, resumable.

Layout of the output folder: ``exams/EXAM/`` (map.nc, estimate.json, posterior.nc, shape.npz, thumbnail.png...) and
``masses/MASS/`` (pooled.json, pooled.nc), the tables and pages beside them (`campaign_report`), and the journal, which
holds for each step its key, the digests of its files and how long it took. The key is the step, the exam or mass, and a
digest of the program's version, the settings and the content of the inputs. A step whose key is in the journal and
whose files are what it made is not run again.
"""

from __future__ import annotations

import hashlib
import json
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from tactile_bayes import __version__
from tactile_bayes.batch import CLUSTER_LOST, BatchStore, run_batch
from tactile_bayes.errors import TactileBayesError
from tactile_bayes.files.manifest_csv import Exam
from tactile_bayes.pipeline.campaign_folder import EXAMS, MASSES, median_seconds, unchanged
from tactile_bayes.pipeline.campaign_match import NamedPlace, named_exams
from tactile_bayes.pipeline.campaign_steps import ESTIMATE, FILES, MAP, SHAPE, Result, Task, run_step
from tactile_bayes.pipeline.settings import Settings
from tactile_bayes.presets import DEFAULT_NORMALISE
from tactile_bayes.records import dataclass

if TYPE_CHECKING:
    from concurrent.futures import Executor

Progress = Callable[[int, int], None]
MATCH_MM: Final = 15.0
"""Default distance for matching a mass by its place: half of what lies between two masses that are told apart."""


@dataclass(frozen=True, slots=True)
class CampaignSettings:
    """Settings of all exams.

    Parameters
    ----------
    estimate
        As of `estimate`; a row of the table may replace place, known values and calibration.
    normalise
        As of `map`.
    match_mm
        Within this distance a mass is that which another exam of the breast names by its place.
    figures
        Whether the figures of `estimate` are drawn for each exam.
    """

    estimate: Settings = field(default_factory=Settings)
    normalise: str = DEFAULT_NORMALISE
    figures: bool = False
    match_mm: float = MATCH_MM

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

    results: dict[str, dict[str, Result]] = field(default_factory=lambda: {step: {} for step in FILES})
    faults: dict[str, Fault] = field(default_factory=dict)
    kept: dict[str, int] = field(default_factory=dict)
    todo: dict[str, int] = field(default_factory=dict)
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
    progress
        Called with steps of this run that are done, and those known to be needed.

    Attributes
    ----------
    found
        Results, faults and counts, filled by `run`.
    not_pooled
        Why no mass is pooled; empty where masses are.
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
        progress: Progress | None = None,
    ) -> None:
        self.exams, self.folder, self.settings = exams, folder, settings
        self.found = CampaignState(seconds=median_seconds({} if store is None else store.values))
        self.not_pooled = ""
        self._store, self._executor, self._dry, self._progress = store, executor, dry, progress
        self._done, self._total = 0, len(exams) * (3 if settings.figures else 2)
        self._digests: dict[Path, str] = {}
        self._calibrations: dict[str, str] = {}

    def run(self) -> CampaignState:
        """Run what is missing: maps, then estimates, figures, and pooled sizes.

        Raises
        ------
        UsageError
            When the disk does not take a result; all that is done is kept.
        TactileBayesError
            When the cluster was lost; all that is done is kept.
        BatchInterrupted
            On Ctrl-C; what is done is kept.
        """
        self._hash_sources()
        self._refuse_same_files()
        sound = [exam for exam in self.exams if exam.name not in self.found.faults]
        self._stage("map", [self._map_task(exam) for exam in sound])
        mapped = [exam for exam in sound if self.found.of("map", exam.name)]
        if not self._dry:
            mapped = self._placed(mapped)
        unmapped = 0 if not self._dry else len(sound) - len(mapped)
        self._stage("estimate", [self._estimate_task(exam, "estimate") for exam in mapped], unknown=unmapped)
        estimated = [exam for exam in mapped if self.found.of("estimate", exam.name)]
        waiting = 0 if not self._dry else len(sound) - len(estimated)
        if self.settings.figures:
            tasks = [self._estimate_task(exam, "figures") for exam in estimated]
            self._stage("figures", tasks, unknown=waiting)
        self._pool(sound, estimated)
        return self.found

    def _hash_sources(self) -> None:
        of_path: dict[Path, list[Exam]] = defaultdict(list)
        for exam in self.exams:
            of_path[exam.path].append(exam)
        outcomes = run_batch(_digest_of, of_path, key=str, executor=self._executor)
        for (path, exams), outcome in zip(of_path.items(), outcomes, strict=True):
            if outcome.value is not None:
                self._digests[path] = outcome.value
                continue
            for exam in exams:
                self.found.faults[exam.name] = Fault("read", outcome.error.removeprefix(f"{path}: "))

    def _refuse_same_files(self) -> None:
        """Exams of one file are faults, but for the masses of one scan, each with its place."""
        same = defaultdict(list)
        for exam in self.exams:
            if exam.path in self._digests:
                same[self._digests[exam.path]].append(exam)
        for exams in same.values():
            breasts = {(exam.patient, exam.visit, exam.side) for exam in exams}
            placed = {one.mass for one in exams if one.centre_mm is not None or named_exams(one, self.exams)}
            if len(exams) == 1 or (len(breasts) == 1 and len(placed) == len(exams)):
                continue
            for exam in exams:
                others = [other for other in exams if other is not exam]
                named = ", ".join(f"{other.name} ({other.file})" for other in others[:3])
                way_out = "give each exam its own file, or each mass of a breast its centre_x_mm and centre_y_mm"
                self.found.faults[exam.name] = Fault("read", f"holds the same bytes as {named}; {way_out}")

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
        places = self._places(exam)
        if places:
            key["match"] = {"mass": exam.mass, "most_mm": self.settings.match_mm, "places": self._places_key(places)}
        return Task(
            step=step,
            name=exam.name,
            folder=folder,
            digest=digest_of(key),
            settings=settings,
            mass=exam.mass,
            places=places,
            match_mm=self.settings.match_mm,
        )

    def _placed(self, mapped: Sequence[Exam]) -> list[Exam]:
        """The exams without those whose mass is named by a place on a map that could not be made."""
        lost = [exam for exam in mapped if named_exams(exam, self.exams) and not self._places(exam)]
        for exam in lost:
            named = ", ".join(one.name for one in named_exams(exam, self.exams) if one.mass == exam.mass)
            reason = f"the place of its mass is on the map of {named}, which was not made"
            self.found.faults[exam.name] = Fault("estimate", reason)
        return [exam for exam in mapped if exam not in lost]

    def _places(self, exam: Exam) -> tuple[NamedPlace, ...]:
        """Places of the breast's masses that other exams name, where this one names none."""
        mapped = [one for one in self.exams if self.found.of("map", one.name)]
        return tuple(
            NamedPlace(one.mass, one.name, self.folder / EXAMS / one.name / MAP, one.centre_mm)
            for one in named_exams(exam, mapped)
            if one.centre_mm is not None
        )

    def _places_key(self, places: Sequence[NamedPlace]) -> list[Any]:
        made = self.found.results["map"]
        return [[one.mass, one.exam, made[one.exam]["files"][MAP], one.centre_mm] for one in places]

    def _settings_key(self, settings: Settings, normalise: str) -> dict[str, Any]:
        """All that an estimate depends on besides its map: settings, and the digests of the files that they name."""
        from tactile_bayes.files.shipped import default_for

        plain = {one.name: getattr(settings, one.name) for one in fields(settings)}
        name = str(plain.pop("calibration") or default_for(normalise))
        file = plain.pop("settings_file")
        used = {"settings_sha256": None if file is None else _digest_of(file), "calibration": name}
        return {**plain, **used, "calibration_sha256": self._calibration_digest(name)}

    def _calibration_digest(self, name: str) -> str:
        from tactile_bayes.files.shipped import size_calibration_path

        if name not in self._calibrations:
            path = size_calibration_path(name)
            self._calibrations[name] = "" if path is None else _digest_of(path)
        return self._calibrations[name]

    def _pool(self, sound: Sequence[Exam], estimated: Sequence[Exam]) -> None:
        """Pool every mass at every visit from the exams that were estimated, where some mass has several."""
        groups: dict[str, list[Exam]] = defaultdict(list)
        for exam in estimated:
            groups[exam.of_mass].append(exam)
        if len({exam.of_mass for exam in self.exams}) == len(self.exams):
            self.not_pooled = "no mass has several exams at one visit"
            return
        self.not_pooled = self._why_not_pooled()
        if self.not_pooled:
            return
        unknown = len({exam.of_mass for exam in sound} - set(groups)) if self._dry else 0
        self._total += len(groups)
        self._stage("pool", [self._pool_task(name, exams) for name, exams in groups.items()], unknown=unknown)

    def _why_not_pooled(self) -> str:
        """Why the calibration cannot pool; empty where it can."""
        from tactile_bayes.files.shipped import size_calibration_path
        from tactile_bayes.files.size_json import read_size_calibration
        from tactile_bayes.size.body_calibration import BodyCalibration

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

    def _stage(self, step: str, tasks: Sequence[Task], *, unknown: int = 0) -> None:
        """Run one step for all that need it; `unknown` is how many more a plan has whose inputs are not there yet."""
        kept = self._kept(tasks)
        self.found.kept[step] = len(kept)
        self.found.todo[step] = len(tasks) - len(kept) + unknown
        for task in tasks:
            if task.key in kept:
                self.found.results[step][task.name] = kept[task.key]
        missing = [task for task in tasks if task.key not in kept]
        if self._dry:
            return
        self._total -= len(kept)
        outcomes = run_batch(
            run_step, missing, key=_key, executor=self._executor, store=self._store, progress=self._tell
        )
        self._done += len(missing)
        for task, outcome in zip(missing, outcomes, strict=True):
            if outcome.value is not None:
                self.found.results[step][task.name] = outcome.value
            elif outcome.error == CLUSTER_LOST:
                raise TactileBayesError(f"{CLUSTER_LOST}; what is done is kept")
            else:
                self.found.faults[task.name] = Fault(step, outcome.error)

    def _kept(self, tasks: Sequence[Task]) -> dict[str, Result]:
        """Results of earlier runs whose files are still what they were; others are forgotten."""
        if self._store is None:
            return {}
        values = self._store.values
        for task in tasks:
            if task.key in values and not unchanged(task.folder, values[task.key]["files"]):
                del values[task.key]
        return {task.key: values[task.key] for task in tasks if task.key in values}

    def _tell(self, done: int, total: int) -> None:
        del total
        if self._progress is not None:
            self._progress(self._done + done, self._total)


_POOLED_FROM: Final = (("map", MAP), ("estimate", ESTIMATE), ("estimate", SHAPE))


def digest_of(key: object) -> str:
    """Digest of plain data and the program's version."""
    text = json.dumps([__version__, key], sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()


def _key(task: Task) -> str:
    return task.key


def _digest_of(path: Path) -> str:
    from tactile_bayes.files.atomic import sha256

    return sha256(path)
