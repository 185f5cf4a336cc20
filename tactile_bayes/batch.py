"""Ordered, resumable work over an executor: in this process, over local processes or on a dask cluster.

Everything that repeats (many maps, many cases, many simulated scans) goes through `run_batch`. An item must carry all
that its result depends on, its seed included; then the results are the same wherever and in whatever order they are
made.
"""

from __future__ import annotations

import contextlib
import json
import os
import stat
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import BrokenExecutor, CancelledError, Executor, Future
from dataclasses import dataclass
from pathlib import Path
from queue import SimpleQueue
from typing import Any, Generic, TypeVar

from tactile_bayes import __version__
from tactile_bayes.errors import BadDataError, TactileBayesError, UsageError

Item = TypeVar("Item")
Result = TypeVar("Result")

STORE_SCHEMA = "tactile-bayes.batch/2"
# Items handed to the executor ahead of their results; bounds the memory that waiting items take.
_WINDOW = 1024


@dataclass(frozen=True, slots=True)
class Outcome(Generic[Result]):
    """What became of one item.

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

    An item that raises is reported by its key and one line, and the others go on. Ctrl-C, or any fault of the store,
    cancels what has not begun, keeps what is finished and goes on up.

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
    _run_all(function, todo, executor=executor or InlineExecutor(), keep=keep)
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
    """The outcome as a resumed batch will read it, so that fresh and resumed results are equal."""
    if not outcome.ok:
        return outcome
    try:
        return Outcome(outcome.key, value=store.add(outcome.key, outcome.value))
    except (TypeError, ValueError) as error:  # not JSON, or refused by the store's encoder
        return Outcome(outcome.key, error=_one_line(error))


def _run_all(
    function: Callable[[Item], Result],
    todo: Sequence[tuple[str, Item]],
    *,
    executor: Executor,
    keep: Callable[[Outcome[Result]], None],
) -> None:
    """Submit all items, at most `_WINDOW` ahead, and keep each outcome as it arrives."""
    waiting: dict[Future[tuple[Result | None, str]], str] = {}
    finished: SimpleQueue[Future[tuple[Result | None, str]]] = SimpleQueue()
    try:
        for name, item in todo:
            future = _submit(executor, function, item)
            waiting[future] = name
            future.add_done_callback(finished.put)
            while not finished.empty() or len(waiting) >= _WINDOW:
                done = finished.get()
                keep(_settle(waiting.pop(done), done))
        while waiting:
            done = finished.get()
            keep(_settle(waiting.pop(done), done))
    except BaseException:
        for future in list(waiting):
            future.cancel()
        for future in [future for future in waiting if future.done() and not future.cancelled()]:
            keep(_settle(waiting.pop(future), future))
        raise


def _submit(executor: Executor, function: Callable[[Item], Result], item: Item) -> Future[tuple[Result | None, str]]:
    """The item's future; where the workers are lost, one that says so."""
    try:
        return executor.submit(_attempt, function, item)
    except BrokenExecutor as error:
        lost: Future[tuple[Result | None, str]] = Future()
        lost.set_exception(error)
        return lost


def _attempt(function: Callable[[Item], Result], item: Item) -> tuple[Result | None, str]:
    """Run one item where it is; its fault comes back as text, which every executor can carry."""
    try:
        return function(item), ""
    except Exception as error:
        return None, _one_line(error)


def _settle(name: str, future: Future[tuple[Result | None, str]]) -> Outcome[Result]:
    """The outcome of a finished future; a lost worker or a result that cannot travel is a fault of its item."""
    try:
        value, error = future.result()
    except (Exception, CancelledError) as fault:
        return Outcome(name, error=_one_line(fault))
    return Outcome(name, value=value, error=error)


def _one_line(error: BaseException) -> str:
    text = " ".join(str(error).split())
    if isinstance(error, TactileBayesError) and text:
        return text
    return f"{type(error).__name__}: {text}" if text else type(error).__name__


class BatchStore:
    """Results on disk, one line each, so that an interrupted batch resumes from what it has.

    Open it with `open_store`. The first line names the settings; each further line is one item's result. A line is
    JSON and its CRC-32, so that no damaged result is taken for a sound one. A line half written when the program was
    killed is dropped.

    Parameters
    ----------
    descriptor
        Of the open, locked file.
    path
        For messages.
    encode, decode
        To and from what JSON can hold.
    """

    def __init__(
        self,
        descriptor: int,
        path: Path,
        *,
        encode: Callable[[Any], Any],
        decode: Callable[[Any], Any],
    ) -> None:
        self._descriptor = descriptor
        self.path = path
        self._encode = encode
        self._decode = decode
        self.values: dict[str, Any] = {}

    def add(self, name: str, value: object) -> Any:
        """Append one result and return it as it will be read back."""
        line = json.dumps({"key": name, "value": self._encode(value)}, ensure_ascii=False)
        self._append(_sealed(line))
        self.values[name] = self._decode(json.loads(line)["value"])
        return self.values[name]

    def load(self, header: Mapping[str, Any]) -> None:
        """Read what an earlier run left, or write the header of a new store; see `open_store` for the errors."""
        text = _read_all(self._descriptor)
        whole = text[: text.rfind(b"\n") + 1]
        first = _sealed(json.dumps(header, sort_keys=True, ensure_ascii=False))
        if not whole and first.encode().startswith(text):
            os.ftruncate(self._descriptor, 0)
            self._append(first)
            return
        lines = whole.decode("utf-8", errors="replace").split("\n")[:-1]
        _check_header(lines[0] if lines else "", header, path=self.path)
        for number, line in enumerate(lines[1:], start=2):
            name, value = _parse_line(line, number=number, path=self.path)
            self.values[name] = self._decode(value)
        os.ftruncate(self._descriptor, len(whole))

    def _append(self, line: str) -> None:
        rest = memoryview(line.encode() + b"\n")
        try:
            while rest:
                rest = rest[os.write(self._descriptor, rest) :]
        except OSError as error:
            raise UsageError(
                f"{self.path} cannot be written ({error.strerror}); what it holds is kept: free space and run again"
            ) from None


@contextlib.contextmanager
def open_store(
    path: Path,
    *,
    settings: Mapping[str, Any],
    encode: Callable[[Any], Any] = lambda value: value,
    decode: Callable[[Any], Any] = lambda value: value,
) -> Iterator[BatchStore]:
    """Open or create a store, readable by its owner only and locked against a second run.

    Parameters
    ----------
    settings
        All that the results depend on besides the items' keys (options, seed, digests of inputs), as plain data.
    encode, decode
        How a result becomes plain data, and back. JSON keeps floats exactly; tuples come back as lists.

    Raises
    ------
    UsageError
        When the store was made with other settings, is in use or cannot be opened.
    BadDataError
        When the file is something else, or a line in its middle is damaged.
    """
    flags = os.O_RDWR | os.O_CREAT | os.O_APPEND | os.O_NONBLOCK | os.O_CLOEXEC
    try:
        descriptor = os.open(path, flags, 0o600)
    except OSError as error:
        raise UsageError(f"{path} cannot be opened ({error.strerror}); choose another place") from None
    try:
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            raise UsageError(f"{path} is no regular file; choose another name")
        _lock(descriptor, path)
        store = BatchStore(descriptor, path, encode=encode, decode=decode)
        store.load({"schema": STORE_SCHEMA, "settings": json.loads(json.dumps(settings))})
        yield store
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _lock(descriptor: int, path: Path) -> None:
    import fcntl

    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise UsageError(f"{path} is in use by another run; wait for it or choose another name") from None


def _read_all(descriptor: int) -> bytes:
    os.lseek(descriptor, 0, os.SEEK_SET)
    with open(descriptor, "rb", closefd=False) as file:
        return file.read()


def _sealed(text: str) -> str:
    """A line of a store: the text and its checksum."""
    return f"{text} {zlib.crc32(text.encode()):08x}"


def _unsealed(line: str) -> Any:
    """What a line holds; `ValueError` where it is damaged."""
    text = line.rpartition(" ")[0]
    if _sealed(text) != line:
        raise ValueError("its checksum does not match")
    return json.loads(text)


def _check_header(line: str, wanted: Mapping[str, Any], *, path: Path) -> None:
    try:
        found, _ = json.JSONDecoder().raw_decode(line)  # that of another schema may have another checksum, or none
        schema, settings = found["schema"], dict(found["settings"])
    except (ValueError, KeyError, TypeError, RecursionError):
        raise BadDataError("not a store of batch results", way_out="choose another name", path=str(path)) from None
    if schema != wanted["schema"]:
        raise BadDataError(
            f"is a store of schema {schema}, this program writes {wanted['schema']}",
            way_out="finish it with the version that began it, or choose another name",
            path=str(path),
        )
    if _sealed(line.rpartition(" ")[0]) != line:
        raise BadDataError("line 1 is damaged", way_out="choose another name", path=str(path))
    new = dict(wanted["settings"])
    differ = sorted(name for name in settings.keys() | new.keys() if settings.get(name) != new.get(name))
    if differ:
        name = differ[0]
        raise UsageError(
            f"{path} holds results of other settings ({', '.join(differ)}: {name} was {settings.get(name)!r}, "
            f"is {new.get(name)!r}); choose another name, or remove it to begin again"
        )


def _parse_line(line: str, *, number: int, path: Path) -> tuple[str, Any]:
    try:
        record = _unsealed(line)
        return str(record["key"]), record["value"]
    except (ValueError, KeyError, TypeError, RecursionError):
        raise BadDataError(
            f"line {number} is damaged", way_out="remove that line: its item will be run again", path=str(path)
        ) from None


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


@contextlib.contextmanager
def open_executor(*, workers: int = 1, cluster: str | None = None) -> Iterator[Executor]:
    """What ``--workers`` and ``--cluster`` mean: a cluster when an address is given, else local processes."""
    chosen = local_executor(workers) if cluster is None else cluster_executor(cluster)
    with chosen as executor:
        yield executor


def local_executor(workers: int) -> Executor:
    """Executor over `workers` processes of this machine; 0 or 1 runs in this process, with the same results.

    Processes are spawned, not forked: libraries with threads of their own do not survive a fork. A worker leaves
    Ctrl-C to its parent and ends when the parent does, even if that was killed.
    """
    if workers < 0:
        raise UsageError(f"workers is {workers}; give 0 or 1 for this process, more for that many processes")
    if workers <= 1:
        return InlineExecutor()
    import multiprocessing
    from concurrent.futures import ProcessPoolExecutor

    context = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(workers, mp_context=context, initializer=prepare_worker)


def prepare_worker() -> None:
    """In a worker: leave Ctrl-C to the parent, and end when the parent does, even if that was killed."""
    import multiprocessing
    import signal
    import threading

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()

    def end_with_parent() -> None:
        if parent is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=end_with_parent, daemon=True).start()


@contextlib.contextmanager
def cluster_executor(address: str, *, timeout_s: float = 10.0) -> Iterator[Executor]:
    """Executor over the workers of a running dask scheduler, for example ``tcp://10.0.0.5:8786``.

    The workers must have this version of the program installed: another one could give other results.

    Raises
    ------
    UsageError
        When the extra is not installed, the scheduler does not answer, or its workers do not fit.
    """
    try:
        from distributed import Client
    except ImportError:
        raise UsageError(
            "a cluster needs the package distributed; install it with pip install 'tactile-bayes[cluster]'"
        ) from None
    with contextlib.ExitStack() as stack:
        try:
            client = stack.enter_context(Client(address, timeout=timeout_s, set_as_default=False))
        except (OSError, ValueError) as error:
            raise UsageError(
                f"no dask scheduler answers at {address} ({_one_line(error)}); start one with `dask scheduler` and "
                "give the address it prints"
            ) from None
        _check_workers(client, address)
        yield stack.enter_context(client.get_executor(pure=False))


def _check_workers(client: Any, address: str) -> None:
    try:
        versions = client.run(_worker_version)
    except ImportError as error:
        raise UsageError(
            f"a worker of {address} cannot import this program ({_one_line(error)}); install it there"
        ) from None
    if not versions:
        raise UsageError(f"the scheduler at {address} has no workers; start one with `dask worker {address}`")
    for worker, version in versions.items():
        if version != __version__:
            raise UsageError(
                f"worker {worker} has version {version}, this program is {__version__}; install the same version"
            )


def _worker_version() -> str:
    return __version__
