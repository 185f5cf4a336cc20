"""Many pieces of work, one line each: in this process, in workers or on a cluster, resumed where they stopped."""

from __future__ import annotations

import contextlib
import json
import logging
import os
import signal
import stat
import threading
import time
import zlib
from collections import UserDict, deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import BrokenExecutor, CancelledError, Executor, Future, ThreadPoolExecutor
from contextlib import AbstractContextManager
from functools import partial
from pathlib import Path
from queue import SimpleQueue
from typing import TYPE_CHECKING, Any, Final, Generic, TypeVar

from tactile_bayes import __version__
from tactile_bayes.declarations import EXACT, Record, from_plain, to_plain
from tactile_bayes.errors import BadDataError, UsageError, one_line
from tactile_bayes.findings import first_of
from tactile_bayes.shell import raise_if_interrupted

if TYPE_CHECKING:
    from multiprocessing.connection import Connection
    from multiprocessing.process import BaseProcess

# --- Results of a batch on disk, one line each: an interrupted batch resumes from what it has.
#
# The first line names the settings; each further line is one item's result: JSON and its CRC-32, so that no damaged
# result is taken for a sound one. Memory holds the lines' offsets only, so a store may be larger than memory.

STORE_SCHEMA: Final = "tactile-bayes.batch/2"
_FLUSHED_EVERY_S: Final = 5.0  #: Lines reach the disk at least this often: a loss of power costs no more.

_Coder = Callable[[Any], Any]


def _unchanged(value: Any) -> Any:
    return value


class BatchStore(UserDict[str, Any]):
    """Results by the names of their items, each read from the file on access; open it with `open_store`.

    `descriptor` is that of the open, locked file, `data` holds the offsets of the items' lines; the latest line of a
    name counts. A deleted result is missing in this run, and its line stays in the file. A line half written when the
    program was killed is dropped.
    """

    def __init__(self, descriptor: int, path: Path, *, encode: _Coder, decode: _Coder, read_only: bool = False) -> None:
        super().__init__()
        self.path = path
        self._descriptor, self._encode, self._decode, self._read_only = descriptor, encode, decode, read_only
        self._end = 0
        self._flush_at = time.monotonic() + _FLUSHED_EVERY_S

    def __getitem__(self, name: str) -> Any:
        with open(self._descriptor, "rb", closefd=False) as file:  # writes go to the end all the same
            file.seek(self.data[name])
            return self._decode(_without_checksum(file.readline()[:-1].decode())["value"])

    def add(self, name: str, value: object) -> Any:
        """Append one result and return it as it will be read back."""
        line = json.dumps({"key": name, "value": self._encode(value)}, ensure_ascii=False)
        offset = self._end
        self._append(_with_checksum(line))
        self.data[name] = offset
        return self._decode(json.loads(line)["value"])

    def load(self, header: Mapping[str, Any]) -> None:
        """Index the results of an earlier run, or write the header of a new store; for the errors see `open_store`."""
        header_line = _with_checksum(json.dumps(header, sort_keys=True, ensure_ascii=False))
        with open(self._descriptor, "rb", closefd=False) as file:
            first = file.readline()
            if not first.endswith(b"\n") and header_line.encode().startswith(first):  # none yet, or its beginning
                if not self._read_only:
                    os.ftruncate(self._descriptor, 0)
                    self._append(header_line)
                return
            _check_header(first, header, path=self.path)
            self._end = len(first)
            for number, line in enumerate(file, start=2):
                if not line.endswith(b"\n"):
                    break
                try:
                    record = _without_checksum(line[:-1].decode("utf-8", errors="replace"))
                    name, _ = str(record["key"]), record["value"]
                except (ValueError, KeyError, TypeError, RecursionError):
                    way_out = "remove that line: its item will be run again"
                    raise BadDataError(f"line {number} is damaged", way_out=way_out, path=str(self.path)) from None
                self.data[name] = self._end
                self._end += len(line)
        if not self._read_only:
            os.ftruncate(self._descriptor, self._end)

    def _append(self, line: str) -> None:
        rest = data = memoryview(line.encode() + b"\n")
        try:
            while rest:
                rest = rest[os.write(self._descriptor, rest) :]
            if time.monotonic() >= self._flush_at:
                os.fdatasync(self._descriptor)
                self._flush_at = time.monotonic() + _FLUSHED_EVERY_S
        except OSError as error:
            way_out = "what it holds is kept: free space and run again"
            raise UsageError(f"{self.path} cannot be written ({error.strerror}); {way_out}") from None
        self._end += len(data)


@contextlib.contextmanager
def open_store(
    path: Path,
    *,
    settings: Mapping[str, Any],
    encode: _Coder = _unchanged,
    decode: _Coder = _unchanged,
    read_only: bool = False,
) -> Iterator[BatchStore]:
    """Open or create a store, readable by its owner only and locked against a second run.

    `encode` and `decode` bring a result into JSON and back. `settings` are all that the results depend on besides the
    items' keys (options, seed, digests of inputs), as plain data; a store of other settings, or one in use, is a
    `UsageError`, another file or a damaged line in its middle a `BadDataError`. JSON keeps floats exactly; tuples come
    back as lists. A `read_only` store is not changed: it may be another user's, or on a read-only disk.
    """
    import fcntl

    access = os.O_RDONLY if read_only else os.O_RDWR | os.O_CREAT | os.O_APPEND
    try:
        descriptor = os.open(path, access | os.O_NONBLOCK | os.O_CLOEXEC, 0o600)
    except OSError as error:
        raise UsageError(f"{path} cannot be opened ({error.strerror}); choose another place") from None
    try:
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            raise UsageError(f"{path} is no regular file; choose another name")
        try:
            fcntl.flock(descriptor, (fcntl.LOCK_SH if read_only else fcntl.LOCK_EX) | fcntl.LOCK_NB)
        except BlockingIOError:
            raise UsageError(f"{path} is in use by another run; wait for it or choose another name") from None
        store = BatchStore(descriptor, path, encode=encode, decode=decode, read_only=read_only)
        store.load({"schema": STORE_SCHEMA, "settings": json.loads(json.dumps(settings))})
        yield store
        if not read_only:
            os.fsync(descriptor)
    finally:
        os.close(descriptor)


def store_path(output: Path) -> Path:
    """Path of the store that keeps the results of a batch until its output is written."""
    return output.with_name(f"{output.name}.unfinished")


@contextlib.contextmanager
def open_store_beside(output: Path | None, kind: Any, *, settings: Mapping[str, Any]) -> Iterator[BatchStore | None]:
    """Open the store beside the output of results of a `kind`, a record or a list of them; None without an output."""
    if output is None:
        yield None
        return
    encode, decode = partial(to_plain, digits=EXACT), partial(from_plain, kind)
    with open_store(store_path(output), settings=settings, encode=encode, decode=decode) as store:
        yield store


def _with_checksum(text: str) -> str:
    """Format a line of a store: the text and its checksum."""
    return f"{text} {zlib.crc32(text.encode()):08x}"


def _without_checksum(line: str) -> Any:
    """Read the text of a store's line; `ValueError` where it is damaged."""
    text = line.rpartition(" ")[0]
    if _with_checksum(text) != line:
        raise ValueError("its checksum does not match")
    return json.loads(text)


def _check_header(first: bytes, header: Mapping[str, Any], *, path: Path) -> None:
    line = first[:-1].decode("utf-8", errors="replace") if first.endswith(b"\n") else ""
    try:
        stored, _ = json.JSONDecoder().raw_decode(line)  # another schema may have another checksum, or none
        schema, settings = stored["schema"], dict(stored["settings"])
    except (ValueError, KeyError, TypeError, RecursionError):
        raise BadDataError("not a store of batch results", way_out="choose another name", path=str(path)) from None
    if schema != header["schema"]:
        fault = f"is a store of schema {schema}, this program writes {header['schema']}"
        way_out = "finish it with the version that began it, or choose another name"
        raise BadDataError(fault, way_out=way_out, path=str(path))
    if _with_checksum(line.rpartition(" ")[0]) != line:
        raise BadDataError("line 1 is damaged", way_out="choose another name", path=str(path))
    new = dict(header["settings"])
    differ = sorted(name for name in settings.keys() | new.keys() if settings.get(name) != new.get(name))
    if differ:
        name = differ[0]
        fault = f"{', '.join(differ)}: {name} was {settings.get(name)!r}, is {new.get(name)!r}"
        way_out = "choose another name, or remove it to begin again"
        raise UsageError(f"{path} holds results of other settings ({fault}); {way_out}")


# --- Executors for batches: this process, local worker processes or a dask cluster.


class LocalWorkers(Executor):
    """Local worker processes, spawned and not forked: libraries with threads do not survive a fork.

    A worker leaves Ctrl-C to its parent and ends when the parent does, even if that was killed. Each has a pipe of its
    own, so that one that is killed while it sends its result does not block the others: its item comes back with
    `BrokenExecutor`, and another process takes its place. `concurrent.futures` has one pipe for all and waits for ever.
    """

    def __init__(self, workers: int) -> None:
        self._workers = workers
        self._threads = ThreadPoolExecutor(workers)  # one for each process: it hands over items and waits for results
        self._local = threading.local()
        self._lock = threading.Lock()
        self._running: dict[BaseProcess, Connection] = {}
        self._stopped = False

    @property
    def ahead(self) -> int:
        """Number of items to submit ahead."""
        return 2 * self._workers

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """The future of ``fn(*args, **kwargs)`` in one of the processes."""
        return self._threads.submit(self._run_item, fn, args, kwargs)

    def _run_item(self, fn: Callable[..., Any], args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        """Run an item in this thread's process, which is started if it has none."""
        if getattr(self._local, "process", None) not in self._running:
            self._local.process = self._start()
        process = self._local.process
        pipe = self._running[process]
        try:
            pipe.send((fn, args, kwargs))
            succeeded, value = pipe.recv()
        except (EOFError, OSError):
            with self._lock:
                self._running.pop(process, None)
            pipe.close()
            raise BrokenExecutor("the item's process ended without an answer") from None
        if not succeeded:
            raise value
        return value

    def _start(self) -> BaseProcess:
        import multiprocessing

        context = multiprocessing.get_context("spawn")
        ours, theirs = context.Pipe()
        process = context.Process(target=_serve_items, args=(theirs,), daemon=True)
        with self._lock:
            if self._stopped:
                raise BrokenExecutor("the processes were stopped")
            process.start()
            self._running[process] = ours
        theirs.close()
        return process

    def stop(self) -> None:
        """Kill all processes now; their running items are lost."""
        with self._lock:
            self._stopped = True
            for process in self._running:
                process.kill()
        self._threads.shutdown(wait=False, cancel_futures=True)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Let the processes end when their items are done."""
        self._threads.shutdown(wait=wait, cancel_futures=cancel_futures)
        if wait:
            for process, pipe in self._running.items():
                pipe.close()
                process.join()


def _serve_items(pipe: Connection) -> None:
    """Run items from a pipe until its other end is closed or the parent ends, even if killed; Ctrl-C is ignored."""
    import multiprocessing

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    assert parent is not None

    def end_with_parent() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=end_with_parent, daemon=True).start()
    while True:
        try:
            fn, args, kwargs = pipe.recv()
            answer = True, fn(*args, **kwargs)
        except EOFError:
            return
        except Exception as error:
            answer = False, error
        try:
            pipe.send(answer)
        except OSError:
            return
        except Exception as error:  # it cannot be pickled
            pipe.send((False, TypeError(one_line(error))))


class InlineExecutor(Executor):
    """Runs each item in this process when it is submitted."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """The finished future of ``fn(*args, **kwargs)``; Ctrl-C is not caught."""
        future: Future[Any] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


def open_executor(*, workers: int = 1, cluster: str | None = None) -> AbstractContextManager[Executor]:
    """Open an executor over a dask cluster if its address is given, else over `workers` processes of this machine.

    Killed processes are replaced; 0 or 1 `workers` run in this process, with the same results.
    """
    if cluster:
        return cluster_executor(cluster)
    if workers < 0:
        raise UsageError(f"workers is {workers}; give 0 or 1 for this process, more for that many processes")
    return InlineExecutor() if workers <= 1 else LocalWorkers(workers)


@contextlib.contextmanager
def cluster_executor(address: str, *, timeout_s: float = 10.0) -> Iterator[Executor]:
    """Executor over the workers of a running dask scheduler, for example ``tcp://10.0.0.5:8786``.

    The workers must have this version of the program installed: another one could give other results.
    """
    try:
        from distributed import Client
    except ImportError:
        way_out = "install it with pip install 'tactile-bayes[cluster]'"
        raise UsageError(f"a cluster needs the package distributed; {way_out}") from None
    for name in list(logging.root.manager.loggerDict):  # silent on stderr: the outcomes hold the errors
        if name.partition(".")[0] == "distributed":
            logging.getLogger(name).setLevel(logging.CRITICAL + 1)
    with contextlib.ExitStack() as stack:
        try:
            client = stack.enter_context(Client(address, timeout=timeout_s, set_as_default=False))
        except (OSError, ValueError) as error:
            way_out = "start one with `dask scheduler` and give the address it prints"
            raise UsageError(f"no dask scheduler answers at {address} ({one_line(error)}); {way_out}") from None
        _check_workers(client, address)
        executor = stack.enter_context(client.get_executor(pure=False))
        # no worker waits, and the scheduler holds few items
        executor.ahead = max(16, 4 * sum(client.nthreads().values()))
        yield executor


def _check_workers(client: Any, address: str) -> None:
    try:
        versions = client.run(_worker_version)
    except ImportError as error:
        fault = f"a worker of {address} cannot import this program ({one_line(error)})"
        raise UsageError(f"{fault}; install it there") from None
    if not versions:
        raise UsageError(f"the scheduler at {address} has no workers; start one with `dask worker {address}`")
    for worker, version in versions.items():
        if version != __version__:
            fault = f"worker {worker} has version {version}, this program is {__version__}"
            raise UsageError(f"{fault}; install the same version")


def _worker_version() -> str:
    return __version__


# --- Ordered, resumable work over an executor: in this process, over local processes or on a dask cluster.
#
# Everything that repeats (many maps, many cases, many simulated scans) goes through `run_batch`. An item must carry
# all that its result depends on, its seed included; then, on one machine and its libraries, the results do not depend
# on the order or on the number of processes.

Item = TypeVar("Item")
Result = TypeVar("Result")

_WINDOW = 1024  #: Most items submitted ahead of their results; bounds the memory of waiting items.
_LISTED = 3  #: Most items named in the line of an error they share.

DIED_TWICE = (
    "its process ended twice without an answer (killed, perhaps for lack of memory); run it again with fewer --workers"
)
DIED_OFTEN = "several workers of the cluster ended over it (killed, perhaps for lack of memory); give them more memory"
CLUSTER_LOST = "the dask scheduler was lost before an answer came; start it again and run what is missing"


class Outcome(Record, Generic[Result]):
    """The outcome of one item: its result, or its error."""

    key: str  #: The item's name.
    value: Result | None = None  #: The function's result; None when it failed.
    error: str = ""  #: Why it failed, in one line; empty when it did not.

    @property
    def ok(self) -> bool:
        return not self.error


class BatchInterrupted(KeyboardInterrupt):
    """Ctrl-C during a batch, with the finished outcomes.

    `store` is the path that keeps the results for the next run, `before` the number of items done by earlier batches
    of the same run.
    """

    def __init__(self, outcomes: Sequence[Outcome[Any]], *, total: int, store: Path | None, before: int = 0) -> None:
        self.outcomes = list(outcomes)
        resume = "" if store is None else f"; {store} keeps them, run again to go on"
        super().__init__(f"{before + len(self.outcomes)} of {total} done{resume}")


def fault_lines(outcomes: Iterable[Outcome[Any]]) -> list[str]:
    """One line per distinct error, with the names of its first items and the number of the others."""
    names: dict[str, list[str]] = {}
    for outcome in outcomes:
        if not outcome.ok:
            names.setdefault(outcome.error, []).append(outcome.key)
    return [f"{first_of(keys, _LISTED)}: {error}" for error, keys in names.items()]


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

    An item that raises is reported by its key and one line, and the others go on. Where a worker process was killed,
    the items it may have held are run again; one whose process ends twice has failed. Ctrl-C, or any fault of the
    store, cancels the items that have not begun, keeps the finished results and is raised again.

    The function must be importable by name in another process, an item picklable, with the seed it needs and a unique
    key. Without an executor the items are run here, one by one. Items whose results are in the store are not run again;
    failed ones are. `progress` is called with (done, total) once at the start and after each item.
    """
    work: dict[str, Item] = {}
    for item in items:
        if (name := key(item)) in work:
            raise BadDataError(f"two items of the batch are called {name!r}", way_out="give each its own name")
        work[name] = item
    stored = {} if store is None else store
    outcomes: dict[str, Outcome[Result]] = {name: Outcome(name, value=stored[name]) for name in work if name in stored}

    def keep(outcome: Outcome[Result]) -> None:
        if store is not None and outcome.ok:  # as a resumed batch reads it: fresh and resumed results are equal
            try:
                outcome = Outcome(outcome.key, value=store.add(outcome.key, outcome.value))
            except (TypeError, ValueError) as error:  # not JSON, or refused by the store's encoder
                outcome = Outcome(outcome.key, error=one_line(error))
        outcomes[outcome.key] = outcome
        if progress is not None:
            progress(len(outcomes), len(work))

    if progress is not None:
        progress(len(outcomes), len(work))
    todo = [(name, item) for name, item in work.items() if name not in outcomes]
    try:
        _run(function, todo, executor=executor or InlineExecutor(), keep=keep)
    except KeyboardInterrupt:
        done = [outcomes[name] for name in work if name in outcomes]
        raise BatchInterrupted(done, total=len(work), store=None if store is None else store.path) from None
    return [outcomes[name] for name in work]


def _run(
    function: Callable[[Item], Result],
    todo: Iterable[tuple[str, Item]],
    *,
    executor: Executor,
    keep: Callable[[Outcome[Result]], None],
) -> None:
    """Run all items: submit a few ahead of their results, and keep each outcome as it arrives.

    An item whose worker process was lost is run again at the end, alone: if its process ends again, it has failed. At
    an interruption or a fault the finished results are kept, and running items are not waited for.
    """
    workers = executor if isinstance(executor, LocalWorkers) else None
    ahead: int = getattr(executor, "ahead", _WINDOW)
    rest, suspects = deque(todo), deque[tuple[str, Item]]()
    waiting: dict[Future[Outcome[Result]], tuple[str, Item]] = {}
    finished: SimpleQueue[Future[Outcome[Result]]] = SimpleQueue()

    def submit(work: tuple[str, Item]) -> None:
        future = executor.submit(_attempt, function, work[0], work[1])
        waiting[future] = work
        future.add_done_callback(finished.put)

    try:
        while rest or suspects or waiting:
            raise_if_interrupted()
            if alone := not waiting and not rest:
                submit(suspects.popleft())
            while rest and len(waiting) < ahead:
                submit(rest.popleft())
                if not finished.empty():
                    break
            future = finished.get()
            name, _ = work = waiting.pop(future)
            if workers is not None and not future.cancelled() and isinstance(future.exception(), BrokenExecutor):
                if alone:
                    keep(Outcome(name, error=DIED_TWICE))
                else:
                    suspects.append(work)
                continue
            outcome = _outcome_of(name, future)
            keep(outcome)
            if outcome.error == CLUSTER_LOST:  # no more answers come: keep the results so far, submit nothing
                for pending, (name, _) in waiting.items():
                    answered = pending.done()
                    pending.cancel()
                    keep(_outcome_of(name, pending) if answered else Outcome(name, error=CLUSTER_LOST))
                for name, _ in rest:
                    keep(Outcome(name, error=CLUSTER_LOST))
                return
    except BaseException:
        for future in waiting:
            future.cancel()
        for future, (name, _) in waiting.items():
            if future.done() and not future.cancelled() and not isinstance(future.exception(), BrokenExecutor):
                keep(_outcome_of(name, future))
        if workers is not None:
            workers.stop()
        raise


def _attempt(function: Callable[[Item], Result], name: str, item: Item) -> Outcome[Result]:
    """Run one item; an error becomes text, which every executor can send back."""
    try:
        return Outcome(name, function(item))
    except Exception as error:
        return Outcome(name, error=one_line(error))


def _outcome_of(name: str, future: Future[Outcome[Result]]) -> Outcome[Result]:
    """The outcome of a finished future; a lost worker or a result that cannot be sent is the item's error."""
    try:
        return future.result()
    except CancelledError:
        return Outcome(name, error=CLUSTER_LOST)
    except Exception as fault:
        killed = type(fault).__name__ == "KilledWorker"  # dask's, after several workers ended over the item
        return Outcome(name, error=DIED_OFTEN if killed else one_line(fault))
