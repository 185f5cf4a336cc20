"""Stages of a campaign: one step for many exams or masses, from the journal where it is done, otherwise run."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Sequence
from concurrent.futures import Executor
from typing import Final

from tactile_bayes.batch import CLUSTER_LOST, BatchInterrupted, Outcome, run_batch
from tactile_bayes.batch_store import BatchStore
from tactile_bayes.campaign.inputs import StepResults, unchanged
from tactile_bayes.campaign.settings import CampaignSettings
from tactile_bayes.campaign.steps import FILES, Result, Task, run_step
from tactile_bayes.declarations import Record, field
from tactile_bayes.errors import TactileBayesError
from tactile_bayes.progress import Progress, untold

FEW: Final = 5
"""So many exams are named in a line."""


class Fault(Record):
    """Why a step of an exam or a mass gave nothing."""

    step: str
    reason: str


class CampaignState(Record, eq=False):
    """How far a campaign is: results by step and name, faults by name, counts of steps."""

    results: dict[str, StepResults]
    """By step, then by the name of the exam or mass."""
    faults: dict[str, Fault] = field(default_factory=dict)
    """By the name of the exam or mass."""
    kept: dict[str, int] = field(default_factory=lambda: defaultdict(int))
    todo: dict[str, int] = field(default_factory=lambda: defaultdict(int))
    """`kept`, `todo`: Steps done by earlier runs, and steps of this run, by step; for a plan those that it would do."""
    names: dict[str, list[str]] = field(default_factory=lambda: defaultdict(list))
    """By step, the first few exams or masses of `todo`."""

    def of(self, step: str, name: str) -> Result | None:
        """Result of a step of an exam or mass; None where there is none."""
        return self.results[step].get(name)


class Stages:
    """Runs steps, or plans them.

    `needed` counts by step how many are still to be run or found done, as far as is known; `tell` is called with the
    steps of this run that are done, and those it does altogether.
    """

    def __init__(
        self,
        *,
        store: BatchStore | None,
        executor: Executor | None = None,
        dry: bool = False,
    ) -> None:
        values = {} if store is None else store.values
        results = {step: StepResults(values) for step in FILES}
        self.found = CampaignState(results)
        self.needed: Counter[str] = Counter()
        self.tell: Progress = untold
        self._store, self._executor, self._dry = store, executor, dry
        self._done = 0

    def run(self, step: str, tasks: Sequence[Task], *, without: int = 0) -> None:
        """Run one step for those that need it.

        `without` is how many more have no inputs: in a plan they will need the step, in a run they failed before it.
        """
        kept = self._kept(tasks)
        for task in kept:
            self.found.results[step].add(task.name, task.key)
        done = {task.key for task in kept}
        missing = [task for task in tasks if task.key not in done]
        self.found.kept[step] += len(kept)
        self.found.todo[step] += len(missing) + (without if self._dry else 0)
        self.found.names[step] += [task.name for task in missing[: FEW - len(self.found.names[step])]]
        self.needed[step] -= len(kept) + without
        if self._dry:
            return
        for task, outcome in zip(missing, self._run(step, missing), strict=True):
            if outcome.value is not None:
                self.found.results[step].add(task.name, task.key)
            elif outcome.error == CLUSTER_LOST:
                raise TactileBayesError(f"{CLUSTER_LOST}; what is done is kept")
            else:
                self.found.faults[task.name] = Fault(step, outcome.error)

    def _run(self, step: str, tasks: Sequence[Task]) -> list[Outcome[Result]]:
        before, total = self._done, self._done + self.needed.total()

        def tell(done: int, _total: int) -> None:
            self.tell(before + done, total)

        try:
            outcomes = run_batch(run_step, tasks, key=_key, executor=self._executor, store=self._store, progress=tell)
        except BatchInterrupted as stop:
            path = None if self._store is None else self._store.path
            raise BatchInterrupted(stop.outcomes, total=total, store=path, before=before) from None
        self._done += len(tasks)
        self.needed[step] -= len(tasks)
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


def steps_needed(
    exams: int, masses: int, *, settings: CampaignSettings, learns: bool, compared: int = 0
) -> dict[str, int]:
    """Steps that so many exams and masses take, done or not.

    `masses` are to be pooled, `compared` between visits; where the repeats may teach the spread between exams
    (`learns`), every exam gets its size by it.
    """
    needed = {"map": exams, "estimate": exams, "figures": exams * settings.figures, "pool": masses, "compare": compared}
    needed |= {"repeatability": 1, "size": exams} if learns else {}
    return {**needed, "copy": (exams + masses + compared) * bool(settings.copy_to)}


def _key(task: Task) -> str:
    return task.key
