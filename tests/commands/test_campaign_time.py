"""What a campaign tells of the time it takes: by the journal for a plan, and by its own pace for what is left."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from concurrent.futures import Executor, Future
from pathlib import Path
from typing import Any

import pytest

from tactile_bayes.commands.campaign import _time_words
from tactile_bayes.pipeline import campaign_stages
from tactile_bayes.pipeline.campaign_folder import StepResults
from tactile_bayes.pipeline.campaign_stages import CampaignState, Stages
from tactile_bayes.pipeline.campaign_steps import FILES, Task
from tactile_bayes.pipeline.campaign_time import USUAL_S, Pace, mean_seconds

EXAMS, MASSES = 20, 10
TAKES = {"map": 0.08, "estimate": 0.5, "size": 0.06, "repeatability": 0.3, "pool": 0.15}
COUNT = {"map": EXAMS, "estimate": EXAMS, "repeatability": 1, "size": EXAMS, "pool": MASSES}
WARM = 2.0
"""What the first of a kind of step takes more, in maps, for the libraries it loads."""


class Clock:
    """A clock that the steps move."""

    def __init__(self, takes: dict[str, float]) -> None:
        self.now, self._takes, self._seen = 0.0, takes, set[str]()

    def run_step(self, task: Task) -> dict[str, Any]:
        self.now += self._takes[task.step] + (0.0 if task.step in self._seen else WARM * self._takes["map"])
        self._seen.add(task.step)
        return {"files": {}, "seconds": self._takes[task.step]}


Told = list[tuple[float, int, int, float | None]]


def campaign(takes: dict[str, float], monkeypatch: pytest.MonkeyPatch, *, executor: Executor | None = None) -> Told:
    """Run the steps of 20 exams; what was told when, with the seconds that were left in truth in place of the time."""
    clock, told = Clock(takes), Told()
    monkeypatch.setattr(campaign_stages, "run_step", clock.run_step)
    stages = Stages(store=None, executor=executor, clock=lambda: clock.now)
    stages.needed.update(COUNT)
    stages.tell = lambda done, total, /, *, left_s=None: told.append((clock.now, done, total, left_s))
    for step, count in COUNT.items():
        stages.run(step, [Task(step, f"exam{i}", Path(), str(i)) for i in range(count)])
    return [(clock.now - at, done, total, left) for at, done, total, left in told]


@pytest.mark.parametrize("slow", [1.0, 15.0], ids=["idle", "busy"])
@pytest.mark.parametrize("estimate_s", [0.4, 0.5, 1.1], ids=["cheap", "laplace", "importance"])
def test_the_time_left_is_right_within_a_factor_of_two_from_the_second_map_on(
    estimate_s: float, slow: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    takes = {step: slow * seconds for step, seconds in {**TAKES, "estimate": estimate_s}.items()}
    told = campaign(takes, monkeypatch)
    counted = [(left / true, done) for true, done, _, left in told if left is not None and true > slow]
    assert min(done for _, done in counted) == 2
    assert all(0.5 < ratio < 2.0 for ratio, _ in counted), counted
    assert told[-1][1:] == (71, 71, 0.0)


def test_steps_counted_alike_would_be_wrong_by_more_than_two(monkeypatch: pytest.MonkeyPatch) -> None:
    """Negative control: what the bar makes of done and total alone."""
    told = campaign(TAKES, monkeypatch)
    whole = told[0][0]
    ratios = [(whole - true) * (total - done) / done / true for true, done, total, _ in told if 10 <= done <= 25]
    assert min(ratios) < 0.5


def test_workers_share_the_time_that_is_left(monkeypatch: pytest.MonkeyPatch) -> None:
    class Pairs(Executor):
        """Two at a time: the second of each pair is done when the first is."""

        def submit(self, fn: Callable[..., Any], /, *args: Any, **_: Any) -> Future[Any]:
            future: Future[Any] = Future()
            future.set_result(({"files": {}, "seconds": 1.0}, ""))
            if next(self.turn) % 2 == 0:
                fn(*args)
            return future

        turn = itertools.count()

    told = campaign(TAKES, monkeypatch, executor=Pairs())
    true, _, _, left = told[10 + 2]  # after ten maps; each stage tells once before it begins
    assert left is not None
    assert 0.5 < left / true < 2.0


def test_a_plan_sums_means_for_times_have_tails() -> None:
    journal = {f"estimate {i} x": {"seconds": seconds} for i, seconds in enumerate((1.0, 1.0, 1.0, 17.0))}
    journal["read a"] = {"seconds": 0.1}
    assert mean_seconds(journal) == {"estimate": 5.0, "read": pytest.approx(0.1)}


@pytest.mark.parametrize(
    ("seconds", "workers", "on_cluster", "words"),
    [
        ({"map": 1.0, "estimate": 5.0}, 1, False, "About 1 min by the times measured here."),
        ({"map": 1.0, "estimate": 5.0}, 2, False, "About 30 s by the times measured here."),
        ({"map": 1.0, "estimate": 5.0}, 1, True, "About 1 min of one worker by the times measured here."),
        (
            {"map": 1.0},
            1,
            False,
            "About 10 s by the times measured here, and more for estimate, which was not run here yet.",
        ),
        ({"pool": 1.0}, 1, False, "How long is not known: no map, estimate was run here yet."),
    ],
)
def test_a_plan_says_what_it_knows(seconds: dict[str, float], workers: int, on_cluster: bool, words: str) -> None:
    found = CampaignState({step: StepResults({}) for step in FILES}, seconds=seconds)
    found.todo.update({"map": 10, "estimate": 10, "pool": 0})
    assert _time_words(found, workers, on_cluster=on_cluster) == words


def test_steps_that_took_no_time_earlier_tell_nothing() -> None:
    clock = iter((0.0, 1.0))
    pace = Pace({"map": 0.0, "read": 0.1}, lambda: next(clock))
    pace.note("map", 1)
    pace.note("map", 2)
    assert pace.left({"map": 3}) == pytest.approx(3.0)


def test_every_step_has_a_usual_time() -> None:
    assert USUAL_S.keys() == FILES.keys()
