"""Executors for batches: this process, local worker processes or a dask cluster."""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import BrokenExecutor, Executor, Future, ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

from tactile_bayes import __version__
from tactile_bayes.errors import UsageError, one_line

if TYPE_CHECKING:
    from multiprocessing.connection import Connection
    from multiprocessing.process import BaseProcess


class LocalWorkers(Executor):
    """Local worker processes, spawned and not forked: libraries with threads do not survive a fork.

    A worker leaves Ctrl-C to its parent and ends when the parent does, even if that was killed. Each has a pipe of its
    own, so that one that is killed in the middle of handing over its result holds up nobody: its item comes back with
    `BrokenExecutor`, and another process takes its place. `concurrent.futures` has one pipe for all and waits for ever.

    Parameters
    ----------
    workers
        How many processes; they start when there is work for them.
    """

    def __init__(self, workers: int) -> None:
        self._workers = workers
        self._threads = ThreadPoolExecutor(workers)  # one for each process: it hands over items and waits for results
        self._own = threading.local()
        self._lock = threading.Lock()
        self._running: dict[BaseProcess, Connection] = {}
        self._stopped = False

    @property
    def ahead(self) -> int:
        """Number of items to submit ahead."""
        return 2 * self._workers

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """The future of ``fn(*args, **kwargs)`` in one of the processes."""
        return self._threads.submit(self._ask, fn, args, kwargs)

    def _ask(self, fn: Callable[..., Any], args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        """Have this thread's process run an item."""
        if getattr(self._own, "process", None) not in self._running:
            self._own.process = self._start()
        process = self._own.process
        line = self._running[process]
        try:
            line.send((fn, args, kwargs))
            done, value = line.recv()
        except (EOFError, OSError):
            with self._lock:
                self._running.pop(process, None)
            line.close()
            raise BrokenExecutor("the item's process ended without an answer") from None
        if not done:
            raise value
        return value

    def _start(self) -> BaseProcess:
        import multiprocessing

        context = multiprocessing.get_context("spawn")
        ours, theirs = context.Pipe()
        process = context.Process(target=_work, args=(theirs,), daemon=True)
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
            for process, line in self._running.items():
                line.close()
                process.join()


def _work(line: Connection) -> None:
    """Run items from a pipe until its other end is closed."""
    prepare_worker()
    while True:
        try:
            fn, args, kwargs = line.recv()
            answer = True, fn(*args, **kwargs)
        except EOFError:
            return
        except Exception as error:
            answer = False, error
        try:
            line.send(answer)
        except OSError:
            return
        except Exception as error:  # it cannot be pickled
            line.send((False, TypeError(one_line(error))))


def prepare_worker() -> None:
    """Set up a worker process: ignore Ctrl-C, and end when the parent process does, even if that was killed."""
    import multiprocessing
    import signal

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()

    def end_with_parent() -> None:
        if parent is not None:
            parent.join()
        os._exit(1)

    if parent is not None:
        threading.Thread(target=end_with_parent, daemon=True).start()


class ClusterWorkers(Executor):
    """Workers of a dask cluster.

    Parameters
    ----------
    cluster
        From ``Client.get_executor``.
    threads
        How many items the cluster runs at a time.
    """

    def __init__(self, cluster: Executor, threads: int) -> None:
        self._cluster = cluster
        self.ahead = max(16, 4 * threads)
        """Number of items to submit ahead: no worker waits, and the scheduler holds few at any time."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """The future of ``fn(*args, **kwargs)`` on one of the workers."""
        return self._cluster.submit(fn, *args, **kwargs)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Let the items end, or cancel them."""
        self._cluster.shutdown(wait=wait and not cancel_futures)


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
    """Open the executor that ``--workers`` and ``--cluster`` ask for: a cluster if an address is given, else local."""
    chosen = local_executor(workers) if cluster is None else cluster_executor(cluster)
    with chosen as executor:
        yield executor


def local_executor(workers: int) -> Executor:
    """Executor over `workers` processes of this machine; 0 or 1 runs in this process, with the same results.

    Processes that are killed are replaced; see `LocalWorkers`.
    """
    if workers < 0:
        raise UsageError(f"workers is {workers}; give 0 or 1 for this process, more for that many processes")
    return InlineExecutor() if workers <= 1 else LocalWorkers(workers)


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
    _silence("distributed")
    with contextlib.ExitStack() as stack:
        try:
            client = stack.enter_context(Client(address, timeout=timeout_s, set_as_default=False))
        except (OSError, ValueError) as error:
            raise UsageError(
                f"no dask scheduler answers at {address} ({one_line(error)}); start one with `dask scheduler` and "
                "give the address it prints"
            ) from None
        _check_workers(client, address)
        workers = stack.enter_context(client.get_executor(pure=False))
        yield ClusterWorkers(workers, sum(client.nthreads().values()))


def _silence(library: str) -> None:
    """Stop a library's log on stderr; the outcomes repeat what matters of it in one line."""
    import logging

    for name in list(logging.root.manager.loggerDict):
        if name == library or name.startswith(f"{library}."):
            logging.getLogger(name).setLevel(logging.CRITICAL + 1)


def _check_workers(client: Any, address: str) -> None:
    try:
        versions = client.run(_worker_version)
    except ImportError as error:
        raise UsageError(
            f"a worker of {address} cannot import this program ({one_line(error)}); install it there"
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
