"""Ordered, resumable work over an executor: in this process, over local processes or on a dask cluster.

Everything that repeats (many maps, many cases, many simulated scans) goes through `run_batch`. An item must carry all
that its result depends on, its seed included; then, on one machine and its libraries, the results are the same in
whatever order and by however many processes they are made.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, CancelledError, Executor, Future
from dataclasses import dataclass
from pathlib import Path
from queue import SimpleQueue
from typing import Any, Generic, TypeVar

from tactile_bayes.batch_store import BatchStore
from tactile_bayes.errors import BadDataError, one_line
from tactile_bayes.executors import InlineExecutor, LocalWorkers
from tactile_bayes.interruption import raise_if_asked

Item = TypeVar("Item")
Result = TypeVar("Result")

# Items handed to the executor ahead of their results; bounds the memory that waiting items take.
_WINDOW = 1024
# Items named in a line on a fault they share.
_LISTED = 3


DIED_TWICE = (
    "its process ended twice without an answer (killed, perhaps for lack of memory); run it again with fewer --workers"
)
DIED_OFTEN = "several workers of the cluster ended over it (killed, perhaps for lack of memory); give them more memory"
CLUSTER_LOST = "the dask scheduler was lost before an answer came; start it again and run what is missing"


@dataclass(frozen=True, slots=True)
class Outcome(Generic[Result]):
    """The outcome of one item: its result, or its error.

    Parameters
    ----------
    key
        The item's name.
    value
        The function's result; None when it failed.
    error
        Why it failed, in one line; empty when it did not.
    """

    key: str
    value: Result | None = None
    error: str = ""

    @property
    def ok(self) -> bool:
        """Whether there is a result."""
        return not self.error


class BatchInterrupted(KeyboardInterrupt):
    """Ctrl-C during a batch, with the outcomes that were finished.

    Parameters
    ----------
    outcomes
        Of the finished items, in their order.
    total
        How many items there were.
    store
        Where the results are kept for the next run; None where nothing keeps them.
    before
        Items done by earlier batches of the same run, for the message.
    """

    def __init__(self, outcomes: Sequence[Outcome[Any]], *, total: int, store: Path | None, before: int = 0) -> None:
        self.outcomes = list(outcomes)
        kept = "" if store is None else f"; {store} keeps them, run again to go on"
        super().__init__(f"{before + len(self.outcomes)} of {total} done{kept}")


def fault_lines(outcomes: Iterable[Outcome[Any]]) -> list[str]:
    """One line per distinct error, with the names of its items; many items are counted instead."""
    names: dict[str, list[str]] = {}
    for one in outcomes:
        if not one.ok:
            names.setdefault(one.error, []).append(one.key)
    return [f"{_listed(keys)}: {error}" for error, keys in names.items()]


def _listed(names: Sequence[str]) -> str:
    more = len(names) - _LISTED
    return ", ".join(names[:_LISTED]) + (f" and {more} more" if more > 0 else "")


def run_batch(
    function: Callable[[Item], Result],
    items: Iterable[Item],
    *,
    key: Callable[[Item], str],
    executor: Executor | None = None,
    store: BatchStore | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> list[Outcome[Result]]:
    """Apply `function` to every item and return the outcomes in the order of the items.

    An item that raises is reported by its key and one line, and the others go on, also where a worker process was
    killed: the items it may have held are run again, and one whose process ends twice is at fault. Ctrl-C, or any fault
    of the store, cancels what has not begun, keeps what is finished and goes on up.

    Parameters
    ----------
    function
        Must be importable by name in another process (a module's function or a `functools.partial` of one).
    items
        Picklable, each with the seed it needs.
    key
        The unique name of an item.
    executor
        From `open_executor`; None runs the items here, one by one.
    store
        Where results are kept as they come. Items it already has are not run again; failed ones are.
    progress
        Called with (done, total) once at the start and after each item.

    Raises
    ------
    BadDataError
        When two items have the same key.
    BatchInterrupted
        On Ctrl-C, with the outcomes so far.
    """
    work = dict(_named(items, key))
    kept = {} if store is None else store.values
    outcomes: dict[str, Outcome[Result]] = {name: Outcome(name, value=kept[name]) for name in work if name in kept}

    def keep(outcome: Outcome[Result]) -> None:
        outcomes[outcome.key] = outcome if store is None else _stored(outcome, store)
        if progress is not None:
            progress(len(outcomes), len(work))

    if progress is not None:
        progress(len(outcomes), len(work))
    todo = [(name, item) for name, item in work.items() if name not in outcomes]
    try:
        _Run(function, todo, executor=executor or InlineExecutor(), keep=keep).run()
    except KeyboardInterrupt:
        done = [outcomes[name] for name in work if name in outcomes]
        raise BatchInterrupted(done, total=len(work), store=None if store is None else store.path) from None
    return [outcomes[name] for name in work]


def _named(items: Iterable[Item], key: Callable[[Item], str]) -> Iterator[tuple[str, Item]]:
    seen: set[str] = set()
    for item in items:
        name = key(item)
        if name in seen:
            raise BadDataError(f"two items of the batch are called {name!r}", way_out="give each its own name")
        seen.add(name)
        yield name, item


def _stored(outcome: Outcome[Result], store: BatchStore) -> Outcome[Result]:
    """Convert an outcome to what a resumed batch will read, so that fresh and resumed results are equal."""
    if not outcome.ok:
        return outcome
    try:
        return Outcome(outcome.key, value=store.add(outcome.key, outcome.value))
    except (TypeError, ValueError) as error:  # not JSON, or refused by the store's encoder
        return Outcome(outcome.key, error=one_line(error))


class _Run(Generic[Item, Result]):
    """A running batch: submits a few items ahead of their results, and stores each outcome as it arrives.

    An item whose worker process was lost is run again at the end, alone: if its process ends again, it is at fault.
    """

    def __init__(
        self,
        function: Callable[[Item], Result],
        todo: Iterable[tuple[str, Item]],
        *,
        executor: Executor,
        keep: Callable[[Outcome[Result]], None],
    ) -> None:
        self._function, self._executor, self._keep = function, executor, keep
        self._workers = executor if isinstance(executor, LocalWorkers) else None
        self._rest: deque[tuple[str, Item]] = deque(todo)
        self._suspects: deque[tuple[str, Item]] = deque()
        self._waiting: dict[Future[tuple[Result | None, str]], tuple[str, Item]] = {}
        self._finished: SimpleQueue[Future[tuple[Result | None, str]]] = SimpleQueue()
        self._alone = False

    def run(self) -> None:
        """Run all items; on the way out of an interruption or a fault keep what is finished."""
        try:
            while self._rest or self._suspects or self._waiting:
                raise_if_asked()
                self._hand_out()
                self._take()
        except BaseException:
            self._abandon()
            raise

    def _hand_out(self) -> None:
        """Submit what may run now: an item suspected of killing its worker alone, otherwise the next few."""
        if not self._waiting and not self._rest:
            self._alone = True
            self._submit(self._suspects.popleft())
        ahead: int = getattr(self._executor, "ahead", _WINDOW)
        while self._rest and len(self._waiting) < ahead:
            self._submit(self._rest.popleft())
            if not self._finished.empty():
                return

    def _submit(self, work: tuple[str, Item]) -> None:
        future = self._executor.submit(_attempt, self._function, work[1])
        self._waiting[future] = work
        future.add_done_callback(self._finished.put)

    def _take(self) -> None:
        """Wait for one result."""
        done = self._finished.get()
        work = self._waiting.pop(done)
        if self._workers is None or done.cancelled() or not isinstance(done.exception(), BrokenExecutor):
            outcome = _settle(work[0], done)
            self._keep(outcome)
            if outcome.error == CLUSTER_LOST:
                self._give_up()
            return
        if self._alone:
            self._keep(Outcome(work[0], error=DIED_TWICE))
        else:
            self._suspects.append(work)

    def _give_up(self) -> None:
        """End without the cluster: keep what has come, and hand out nothing more, for nobody would answer."""
        for future, (name, _) in list(self._waiting.items()):
            done = future.done()
            future.cancel()
            self._keep(_settle(name, future) if done else Outcome(name, error=CLUSTER_LOST))
        for name, _ in self._rest:
            self._keep(Outcome(name, error=CLUSTER_LOST))
        self._waiting.clear()
        self._rest.clear()

    def _abandon(self) -> None:
        """Cancel pending items, keep finished ones, and do not wait for running ones."""
        for future in list(self._waiting):
            future.cancel()
        for future in [one for one in self._waiting if one.done() and not one.cancelled()]:
            name, _ = self._waiting.pop(future)
            if not isinstance(future.exception(), BrokenExecutor):
                self._keep(_settle(name, future))
        if self._workers is not None:
            self._workers.stop()


def _attempt(function: Callable[[Item], Result], item: Item) -> tuple[Result | None, str]:
    """Run one item; return its error as text, which every executor can send back."""
    try:
        return function(item), ""
    except Exception as error:
        return None, one_line(error)


def _settle(name: str, future: Future[tuple[Result | None, str]]) -> Outcome[Result]:
    """Read the outcome of a finished future; a lost worker or a result that cannot be sent is the item's error."""
    try:
        value, error = future.result()
    except CancelledError:
        return Outcome(name, error=CLUSTER_LOST)
    except Exception as fault:
        killed = type(fault).__name__ == "KilledWorker"  # dask's, after several workers ended over the item
        return Outcome(name, error=DIED_OFTEN if killed else one_line(fault))
    return Outcome(name, value=value, error=error)
