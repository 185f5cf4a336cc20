"""A campaign: from a table of exams to maps, estimates, pooled sizes and growth, step by step, resumable.

Layout of the output folder: ``exams/EXAM/`` (map.nc, estimate.json, posterior.nc, shape.npz, exam.html...),
``masses/MASS/`` (pooled.json, pooled.nc) and ``growth/MASS/`` (compare.json, growth.html), the tables and pages beside
them (`campaigns.report`), repeatability.json where it was learned (the sizes by it are ``exams/EXAM/sized.json``), and
the journal, which holds for each step its key, the digests of its files and how long it took. The key is the step, the
exam or mass, and a digest of the program's version, the settings and the content of the inputs. A step whose
key is in the journal and whose files are what it made is not run again.

Exams go through the steps in blocks, in the order of the table, and the results stay in the journal: memory holds the
table of exams, a few hundred bytes for each step, and one block.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from datetime import date
from functools import partial
from operator import attrgetter
from pathlib import Path
from typing import Any, Final, TypeVar

from tactile_bayes.api.repeatability import ExamFolder
from tactile_bayes.api.settings import Settings
from tactile_bayes.batch import CLUSTER_LOST, BatchInterrupted, BatchStore, Outcome, run_batch
from tactile_bayes.campaigns import steps
from tactile_bayes.campaigns.exams import Breasts, Match, Visits, masses_with_visits, stated_days, visit_dates
from tactile_bayes.campaigns.inputs import READ, SITE, DuplicateExams, read_sources, unchanged
from tactile_bayes.declarations import Record, names_of, replace
from tactile_bayes.errors import TactileBayesError
from tactile_bayes.files.atomic import sha256
from tactile_bayes.files.manifest_csv import ESTIMATE, EXAMS, GROWTH, MAP, MASSES, REPEATABILITY, SHAPE, SIZED, Exam
from tactile_bayes.files.provenance import recordings
from tactile_bayes.files.size_json import default_for, read_repeatability, read_size_calibration, size_calibration_path
from tactile_bayes.findings import finding
from tactile_bayes.progress import Progress, no_progress
from tactile_bayes.report.growth_page import Course
from tactile_bayes.size.bodies import BodyCalibration
from tactile_bayes.size.pooling import Repeatability

FEW: Final = 5  #: So many exams or masses are named in a line.


class Fault(Record):
    """Why a step of an exam or a mass gave nothing."""

    step: str
    reason: str


Bar = Callable[[str], AbstractContextManager[Progress]]
_Any = TypeVar("_Any")
_BLOCK: Final = 64  #: Exams that go through the steps together at least; workers wait for the slowest of a block.
_AHEAD_IN_BLOCK: Final = 8  #: Blocks hold so many times what an executor takes ahead.


def no_bar(_label: str) -> AbstractContextManager[Progress]:
    """A context without a progress bar."""
    return nullcontext(no_progress)


@dataclass(eq=False)
class Campaign:
    """A run, or the plan of one, and how far it is: results by step and name, faults by name, counts of steps.

    A plan (`dry`) runs and writes nothing. `bar` gives, for what is counted ("files read", "steps"), a context with a
    callback for those done and those needed.
    """

    exams: Sequence[Exam]
    folder: Path
    settings: steps.CampaignSettings
    store: BatchStore | None
    executor: Executor | None = None
    excised_on: Mapping[tuple[str, str], date | None] = field(default_factory=dict)
    """Day of excision, where it is known, by the patient and mass of each size after excision."""
    dry: bool = False
    bar: Bar = no_bar
    keys: dict[str, dict[str, str]] = field(default_factory=lambda: {step: {} for step in steps.FILES})
    """Key of the result in the journal, by step and name of the exam or mass."""
    faults: dict[str, Fault] = field(default_factory=dict)  #: By the name of the exam or mass.
    kept: Counter[str] = field(default_factory=Counter)
    todo: Counter[str] = field(default_factory=Counter)
    """`kept`, `todo`: Steps done by earlier runs, and steps of this run, by step; for a plan those that it would do."""
    names: dict[str, list[str]] = field(default_factory=lambda: defaultdict(list))
    """By step, the first few exams or masses of `todo`."""
    not_pooled: str = ""  #: Why no mass is; empty where masses are.
    not_compared: str = ""  #: The same of visits; empty too where no mass has several.
    growing: dict[str, Visits] = field(default_factory=dict)  #: Compared visits of each mass, by its name.
    unread: set[str] = field(default_factory=set)  #: Names of the exams whose file could not be read.
    repeatability: Repeatability | None = None  #: Learned from the repeats.
    not_learned: str = ""  #: Why it was not, where masses have repeats.
    _sizes_unknown: bool = False
    _tell: Progress = no_progress
    _needed: Counter[str] = field(default_factory=Counter)  #: By step, still to be run or found done, as far as known.
    _done: int = 0  #: Steps of this run.
    _repeated: set[str] = field(default_factory=set)
    _digests: dict[Path, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._block = max(_BLOCK, _AHEAD_IN_BLOCK * int(getattr(self.executor, "ahead", 0)))
        self.days = stated_days(self.exams)  # of failed exams too
        self._breasts = Breasts(self.exams)
        self._recordings = DuplicateExams(self._breasts, "recording")

    def result(self, step: str, name: str) -> steps.Result:
        """Result of a step of an exam or mass, read from the journal; empty where there is none."""
        key = self.keys[step].get(name)
        return {} if key is None or self.store is None else self.store[key]

    def files(self, step: str, name: str) -> Mapping[str, str]:
        """Digests of the files that a step made of an exam or mass, by their names; empty where it made none."""
        return dict(self.result(step, name).get("files", {}))

    def run(self) -> None:
        """Run what is missing: maps, estimates and figures by blocks, repeatability, sizes by it, pages, pools, growth.

        Where the disk does not take a result (`UsageError`), the cluster is lost (`TactileBayesError`) or on Ctrl-C
        (`BatchInterrupted`), all that is done is kept.
        """
        self._read_sources()
        sound = [exam for exam in self.exams if exam.name not in self.faults]
        self.not_pooled = self.not_compared = self._unpoolable()
        if len({exam.of_mass for exam in self.exams}) == len(self.exams):
            self.not_pooled = "no mass has several exams at one visit"
        masses = 0 if self.not_pooled else len({exam.of_mass for exam in sound})
        learns = steps.count_repeated_masses(sound, self.settings) >= steps.FEWEST_MASSES
        grown = 0 if self.not_compared else len(masses_with_visits(sound, self.days))
        self._needed.update(self._steps(len(sound), masses, learns=learns, compared=grown))
        with self.bar("steps") as self._tell:
            for block in _blocks_of_patients(sound, self._block):
                self._size(block)
            sound = [exam for exam in sound if exam.name not in self._repeated]
            self._learn_repeatability(sound)
            self._make_pages(sound)
            if masses:
                spared = masses - len({exam.of_mass for exam in sound})
                self._needed.subtract(self._steps(0, spared))
                self._pool(sound)
            if grown:
                self.growing = masses_with_visits(self._with_estimate(sound), self.days)
                several = len(masses_with_visits(sound, self.days))
                self._run_masses("compare", self.growing, self._compare_task, masses=several)

    def _steps(self, exams: int, masses: int, *, learns: bool = False, compared: int = 0) -> dict[str, int]:
        """Steps that so many exams and masses take, done or not.

        `masses` are to be pooled, `compared` between visits; where the repeats may teach the spread between exams
        (`learns`), every exam gets its size by it.
        """
        needed = {"map": exams, "estimate": exams, "figures": exams * self.settings.figures, "page": exams}
        needed |= {"pool": masses, "compare": compared}
        needed |= {"repeatability": 1, "size": exams} if learns else {}
        return {**needed, "copy": (2 * exams + masses + compared) * bool(self.settings.copy_to)}

    def _run(self, step: str, tasks: Sequence[steps.Task], *, of: int) -> None:
        """Run one step for those that need it, or plan it.

        Of so many exams or masses those without a task have no inputs: in a plan they will need the step, in a run they
        failed before it. Results of earlier runs are kept where their files are still what they were, else forgotten.
        """
        kept, values = list[steps.Task](), {} if self.store is None else self.store
        for task in tasks:
            if task.key in values and unchanged(task.folder, values[task.key]):
                kept.append(task)
                self.keys[step][task.name] = task.key
            elif task.key in values:
                del values[task.key]
        done, without = {task.key for task in kept}, of - len(tasks)
        missing = [task for task in tasks if task.key not in done]
        self.kept[step] += len(kept)
        self.todo[step] += len(missing) + (without if self.dry else 0)
        self.names[step] += [task.name for task in missing[: FEW - len(self.names[step])]]
        self._needed[step] -= len(kept) + without
        if self.dry:
            return
        for task, outcome in zip(missing, self._outcomes(missing), strict=True):
            if outcome.value is not None:
                self.keys[step][task.name] = task.key
            elif outcome.error == CLUSTER_LOST:
                raise TactileBayesError(f"{CLUSTER_LOST}; what is done is kept")
            else:
                self.faults[task.name] = Fault(step, outcome.error)
        self._done += len(missing)
        self._needed[step] -= len(missing)

    def _outcomes(self, tasks: Sequence[steps.Task]) -> list[Outcome[steps.Result]]:
        before, total = self._done, self._done + self._needed.total()
        try:
            return run_batch(
                steps.run_step,
                tasks,
                key=attrgetter("key"),
                executor=self.executor,
                store=self.store,
                progress=lambda done, _total: self._tell(before + done, total),
            )
        except BatchInterrupted as stop:
            path = None if self.store is None else self.store.path
            raise BatchInterrupted(stop.outcomes, total=total, store=path, before=before) from None

    def _read_sources(self) -> None:
        """Digests of all files: two exams of one file are found before any is mapped."""
        with self.bar("files read") as tell:
            self._digests, faults = read_sources(
                self.exams, store=self.store, keep=not self.dry, executor=self.executor, progress=tell
            )
        for exam in self.exams:
            if exam.path in faults:
                self.faults[exam.name] = Fault(READ, faults[exam.path])
                self.unread.add(exam.name)
        bytes_of = {exam: [self._digests[exam.path]] for exam in self.exams if exam.path in self._digests}
        for name, reason in DuplicateExams(self._breasts, "bytes").faults(bytes_of).items():
            self.faults[name] = Fault(READ, reason)

    def _size(self, exams: Sequence[Exam]) -> None:
        """Maps, estimates and figures of some exams."""
        known = [exam for exam in exams if exam.path in self._digests]  # a plan fetches nothing from a store
        self._run("map", [self._map_task(exam) for exam in known], of=len(exams))
        exams = self._recorded_once(exams)
        mapped = [exam for exam in exams if exam.name in self.keys["map"]]
        mapped = mapped if self.dry else self._with_known_place(mapped)
        self._run("estimate", [self._estimate_task(exam, "estimate") for exam in mapped], of=len(exams))
        if self.settings.figures:
            tasks = [self._estimate_task(exam, "figures") for exam in self._with_estimate(mapped)]
            self._run("figures", tasks, of=len(exams))
        self._copy(EXAMS, [exam.name for exam in exams], made_by=("map", "estimate", "figures"))

    def _with_estimate(self, exams: Sequence[Exam]) -> list[Exam]:
        return [exam for exam in exams if exam.name in self.keys["estimate"]]

    def _recorded_once(self, exams: Sequence[Exam]) -> list[Exam]:
        """The exams whose recording no other exam has, in whatever file; the others are no repeats and fail."""
        marks = {exam: list(recordings(self.result("map", exam.name).get("scans", ()))) for exam in exams}
        faults = self._recordings.faults(marks)
        for name, reason in faults.items():
            self.faults[name] = Fault("map", reason)
        self._repeated |= faults.keys()
        left = [exam for exam in exams if exam.name not in faults]
        spared = self._steps(len(exams) - len(left), 0)
        self._needed.subtract({step: count for step, count in spared.items() if step != "map"})
        return left

    def _copy(self, kind: str, names: Sequence[str], *, made_by: Sequence[str]) -> None:
        """Copy the files that steps made for exams or masses into the object store."""
        if self.settings.copy_to:
            tasks = []
            for name in names:
                files = {file: digest for step in made_by for file, digest in self.files(step, name).items()}
                to = f"{self.settings.copy_to}/{kind}/{name}"
                make = partial(steps.copy_files, self.folder / kind / name, list(files), to=to)
                tasks += [self._task("copy", name, {"to": to, "files": files}, make, kind)] if files else []
            self._run("copy", tasks, of=len(names))

    def _folder_of(self, exam: Exam) -> Path:
        return self.folder / EXAMS / exam.name

    def _task(self, step: str, name: str, key: object, make: Callable[[], steps.Made], kind: str = "") -> steps.Task:
        """A step of an exam or mass; `key` is all that its files depend on."""
        folder = self.folder / (kind or _KINDS.get(step, EXAMS)) / name
        return steps.Task(step, name, folder, steps.digest_of(key), make)

    def _map_task(self, exam: Exam) -> steps.Task:
        arguments: dict[str, Any] = {"expected": self._expected(exam), "normalise": self.settings.normalise}
        digest = self._digests[exam.path]
        make = partial(steps.make_map, exam.path, source_sha256=digest, address=exam.address, **arguments)
        return self._task("map", exam.name, {"scan": digest, **arguments}, make)

    def _estimate_task(self, exam: Exam, step: str) -> steps.Task:
        """Task of the estimate, or of its figures."""
        settings = self.settings.of(exam)
        key = {"map": self._file("map", exam.name, MAP), **self._settings_key(settings, self._normalise(exam))}
        named, match = self._breasts.exams_with_places(exam, of=self.keys["map"]), None
        if named:
            match = Match(exam.mass, tuple(named), self.settings.match_mm)
            places = [[one.mass, one.name, self._file("map", one.name, MAP), one.centre_mm] for one in named]
            key["match"] = {"mass": exam.mass, "most_mm": match.most_mm, "places": places}
        told = any(scan.get("side") for scan in self.result("map", exam.name).get("scans", ()))
        side = "" if told else exam.side or ""
        key |= {"side": side} if side else {}
        make = steps.make_estimate if step == "estimate" else steps.make_figures
        return self._task(step, exam.name, key, partial(make, self._folder_of(exam), settings, match, side))

    def _with_known_place(self, mapped: Sequence[Exam]) -> list[Exam]:
        """The exams except those whose mass is placed on a map that could not be made; these fail."""
        known = []
        for exam in mapped:
            places = self._breasts.exams_with_places(exam)
            if places and not self._breasts.exams_with_places(exam, of=self.keys["map"]):
                named = ", ".join(place.name for place in places if place.mass == exam.mass)
                reason = f"the place of its mass is on the map of {named}, which was not made"
                self.faults[exam.name] = Fault("estimate", reason)
            else:
                known.append(exam)
        return known

    def _settings_key(self, settings: Settings, normalise: str) -> dict[str, Any]:
        """Inputs of an estimate besides its map: settings, and the digests of the files that they name."""
        plain = {name: getattr(settings, name) for name in names_of(settings)}
        name = str(plain.pop("size_calibration") or default_for(normalise))
        settings_file = plain.pop("settings_file")
        repeatability = plain.pop("repeatability")
        if repeatability is not None:
            plain["repeatability"] = repeatability.sha256 or repr(repeatability)
        digest = None if settings_file is None else self._file_digest(settings_file)
        calibration = {"calibration": name, "calibration_sha256": self._calibration_digest(name)}
        return {**plain, "settings_sha256": digest, **calibration}

    def _calibration_digest(self, name: str) -> str:
        path = size_calibration_path(name)
        return "" if path is None else self._file_digest(path)

    def _file_digest(self, path: Path) -> str:
        """Digest of a file that many exams use."""
        if path not in self._digests:
            self._digests[path] = sha256(path)
        return self._digests[path]

    def _learn_repeatability(self, sound: Sequence[Exam]) -> None:
        """Learn the spread between exams from the repeats, and size every exam by it from the draws of its estimate."""
        estimated, needed = self._with_estimate(sound), self._needed
        masses = steps.count_repeated_masses(sound if self.dry else estimated, self.settings)
        if masses < steps.FEWEST_MASSES:
            if masses:
                have = "mass has" if masses == 1 else "masses have"
                self.not_learned = f"{masses} {have} repeated exams, and it takes {steps.FEWEST_MASSES}"
            needed["repeatability"] = needed["size"] = 0
            return
        complete = not self.dry or len(estimated) == len(sound)
        tasks = [self._repeatability_task(estimated)] if complete else []
        self._run("repeatability", tasks, of=1)
        result = self.result("repeatability", SITE)
        if not result and self.dry:
            self._sizes_unknown = True
            self._run("size", [], of=len(sound))
            return
        if not result:
            self.not_learned = self.faults.pop(SITE).reason
        elif steps.NOT_LEARNED in result:
            self.not_learned = result[steps.NOT_LEARNED]
        else:
            self.repeatability = read_repeatability(self.folder / REPEATABILITY)
        again = estimated if self.repeatability else []
        needed["size"] = len(again)
        for block in _blocks(again, self._block):
            tasks = [task for exam in block if (task := self._size_task(exam)) is not None]
            self._run("size", tasks, of=len(tasks) if self.dry else len(block))

    def _make_pages(self, sound: Sequence[Exam]) -> None:
        """The page of every exam that was estimated, with its size by the repeatability where it has one."""
        for block in _blocks(sound, self._block):
            known = [] if self._sizes_unknown else self._with_estimate(block)
            self._run("page", [self._page_task(exam) for exam in known], of=len(block))
            self._copy(EXAMS, [exam.name for exam in block], made_by=("size", "page"))

    def _page_task(self, exam: Exam) -> steps.Task:
        sized = self._file("size", exam.name, SIZED)
        day = "" if exam.day is None else exam.day.isoformat()
        facts = self._expected(exam) | {"replicate": str(exam.replicate), "date": day}
        size = sized or self._file("estimate", exam.name, ESTIMATE)
        key = {"map": self._file("map", exam.name, MAP), "size": size, "told": facts}
        make = partial(steps.make_page, self._folder_of(exam), facts, report=ESTIMATE if sized is None else SIZED)
        return self._task("page", exam.name, key, make)

    def _expected(self, exam: Exam) -> dict[str, str]:
        """Facts of the exam in the table, by column; blank ones are left out."""
        columns = ("patient", "side", "reader", "visit", "mass")
        return {name: value for name in columns if (value := getattr(exam, name)) is not None}

    def _repeatability_task(self, exams: Sequence[Exam]) -> steps.Task:
        files, repeats = [], []
        for exam in exams:
            files.append([exam.name, *(self._file("estimate", exam.name, file) for file in (ESTIMATE, SHAPE))])
            mass = f"{exam.patient} {exam.mass}"
            repeats.append(ExamFolder(exam.name, exam.of_mass, mass, self._folder_of(exam)))
        digest = steps.digest_of([steps.FEWEST_MASSES, files])
        return steps.Task("repeatability", SITE, self.folder, digest, partial(steps.learn_repeatability, repeats))

    def _size_task(self, exam: Exam) -> steps.Task | None:
        """Task of a size by the repeatability; None where the exam has no draws, or another calibration."""
        normalise, name, figures = self._normalise(exam), exam.name, self.settings.figures
        settings = self._by_repeatability(self.settings.of(exam), normalise)
        files = [self._file(step, name, file) for step, file in _POOLED_FROM]
        if settings.repeatability is None or None in files:
            return None
        key = {"files": files, "figures": figures, **self._settings_key(settings, normalise)}
        return self._task("size", name, key, partial(steps.make_size, self._folder_of(exam), settings, figures=figures))

    def _by_repeatability(self, settings: Settings, normalise: str) -> Settings:
        """Settings with the learned repeatability, where it is for the calibration that they lead to."""
        learned = self.repeatability
        if learned is None or self._calibration_digest(settings.calibration_name or default_for(normalise)) != (
            learned.calibration_sha256
        ):
            return settings
        return replace(settings, repeatability=learned)

    def _pool(self, sound: Sequence[Exam]) -> None:
        """Pool every mass at every visit from the exams that were estimated."""
        groups: dict[str, list[Exam]] = defaultdict(list)
        for exam in self._with_estimate(sound):
            groups[exam.of_mass].append(exam)
        self._run_masses("pool", groups, self._pool_task, masses=len({exam.of_mass for exam in sound}))

    def _run_masses(
        self, step: str, inputs: Mapping[str, _Any], task_of: Callable[[str, _Any], steps.Task], *, masses: int
    ) -> None:
        """Run a step for the masses with inputs, out of so many; `inputs`: by name."""
        known = {} if self._sizes_unknown else inputs
        for names in _blocks(list(known), self._block):
            self._run(step, [task_of(name, known[name]) for name in names], of=len(names))
            self._copy(_KINDS[step], names, made_by=(step,))
        for one in (step, "copy") if self.settings.copy_to else (step,):
            self._run(one, [], of=masses - len(known))

    def _unpoolable(self) -> str:
        """Reason why masses cannot be pooled: a calibration not learned over bodies; empty for none."""
        for name in {self.settings.of(exam).size_calibration for exam in self.exams} - {None}:
            path = size_calibration_path(str(name))
            if path is None or not isinstance(read_size_calibration(path), BodyCalibration):
                return f"size calibration {name} is not learned over bodies"
        return ""

    def _pool_task(self, name: str, exams: Sequence[Exam]) -> steps.Task:
        settings, key = self._shared_settings(exams)
        make = partial(steps.make_pool, self.folder / EXAMS, [exam.name for exam in exams], settings)
        return self._task("pool", name, key, make)

    def _shared_settings(self, exams: Sequence[Exam]) -> tuple[Settings, dict[str, Any]]:
        """Settings by which exams are sized together, and the inputs that key the result."""
        normalise = self._normalise(exams[0])
        settings = replace(self.settings.of(exams[0]), centre_mm=self.settings.estimate.centre_mm)
        settings = self._by_repeatability(settings, normalise)
        files = [[exam.name, *(self._file(step, exam.name, file) for step, file in _POOLED_FROM)] for exam in exams]
        return settings, {"exams": files, **self._settings_key(settings, normalise)}

    def _compare_task(self, name: str, visits: Visits) -> steps.Task:
        settings, key = self._shared_settings([exam for exams in visits.values() for exam in exams])
        days = [*visit_dates(visits, self.days).values()]
        dates = tuple("" if day is None else day.isoformat() for day in days)
        first = next(iter(visits.values()))[0]
        course = Course("", "", first.patient, first.side or "", first.mass, tuple(visits), dates if any(dates) else ())
        names, figures = [[exam.name for exam in exams] for exams in visits.values()], self.settings.figures
        excision = self.excised_on.get((first.patient, first.mass)) or date.max
        after = (
            f"visit {number} of {day} is after the excision ({excision}): the mass was taken out before"
            for number, day in zip(course.numbers, days, strict=True)
            if day is not None and day > excision
        )
        findings = [finding("after_excision", words) for words in after]
        key |= {"visits": [len(exams) for exams in names], "figures": figures, "facts": repr((course, findings))}
        make = partial(
            steps.make_growth, self.folder / EXAMS, names, settings, course=course, findings=findings, figures=figures
        )
        return self._task("compare", name, key, make)

    def _file(self, step: str, name: str, file: str) -> str | None:
        return self.files(step, name).get(file)

    def _normalise(self, exam: Exam) -> str:
        return str(self.result("map", exam.name)["normalise"])


_KINDS: Final = {"pool": MASSES, "compare": GROWTH}  #: The folder of a step's masses; other steps are of exams.
_POOLED_FROM: Final = (("map", MAP), ("estimate", ESTIMATE), ("estimate", SHAPE))


def _blocks(items: Sequence[_Any], size: int) -> Iterator[Sequence[_Any]]:
    for start in range(0, len(items), size):
        yield items[start : start + size]


def _blocks_of_patients(exams: Sequence[Exam], size: int) -> Iterator[Sequence[Exam]]:
    """Blocks of at least so many exams; a patient's stay together, for one may name the place of another's mass."""
    start = 0
    for end in range(1, len(exams) + 1):
        if end == len(exams) or (end - start >= size and exams[end].patient != exams[end - 1].patient):
            yield exams[start:end]
            start = end
