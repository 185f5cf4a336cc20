"""A dask scheduler and its workers as processes of their own, for benchmarks that kill them."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil

WORKERS, WORKER_MB, READY_S = 2, 60.0, 120.0
_UNPROFILED = {"DASK_DISTRIBUTED__WORKER__PROFILE__ENABLED": "False"}
"""As the guide starts workers."""


def start(log: Path, *words: str) -> subprocess.Popen[bytes]:
    """A process of its own with its output in a file."""
    with log.open("ab") as file:
        return subprocess.Popen(
            [sys.executable, *words],
            stdout=file,
            stderr=file,
            start_new_session=True,
            env={**os.environ, **_UNPROFILED},
        )


class Cluster:
    """A scheduler and workers under their nannies, by names: scheduler, worker 1, nanny of worker 1...

    Parameters
    ----------
    folder
        For logs and the workers' files.
    port
        Of the scheduler, on the loopback.

    Attributes
    ----------
    processes
        Those started, by name; the workers themselves after `find_workers`.
    """

    def __init__(self, folder: Path, *, port: int) -> None:
        self.address = f"tcp://127.0.0.1:{port}"
        self.processes: dict[str, psutil.Process] = {}
        self._folder, self._port = folder, port
        self._scheduler: subprocess.Popen[bytes] | None = None
        self._nannies: dict[str, subprocess.Popen[bytes]] = {}

    def start(self) -> None:
        """Start all of it."""
        words = ("--host", "127.0.0.1", "--port", str(self._port), "--no-dashboard")
        self._scheduler = start(self._folder / "scheduler.log", "-m", "distributed.cli.dask_scheduler", *words)
        self.processes["scheduler"] = psutil.Process(self._scheduler.pid)
        for number in range(WORKERS):
            self.start_worker(f"worker {number + 1}")

    def start_worker(self, name: str) -> None:
        """Start a worker with its nanny."""
        words = (self.address, "--nthreads", "1", "--no-dashboard", "--host", "127.0.0.1")
        log = self._folder / f"{name.replace(' ', '')}.log"
        local = ("--local-directory", str(self._folder), "--memory-limit", "2GB")
        self._nannies[name] = start(log, "-m", "distributed.cli.dask_worker", *words, *local)
        self.processes[f"nanny of {name}"] = psutil.Process(self._nannies[name].pid)

    def wait(self) -> None:
        """Wait until the scheduler knows all its workers."""
        from distributed import Client

        end = time.monotonic() + READY_S
        while True:
            try:
                with Client(self.address, timeout=5.0, set_as_default=False) as client:
                    client.wait_for_workers(WORKERS, timeout=READY_S)
                return
            except OSError:  # the scheduler has not begun to listen
                if time.monotonic() > end:
                    raise

    def find_workers(self) -> list[str]:
        """Look up the workers' processes, which their nannies start; returns the names of those that run."""
        names = []
        for name, nanny in self._nannies.items():
            with contextlib.suppress(psutil.Error):
                children = [
                    one for one in psutil.Process(nanny.pid).children() if one.memory_info().rss > WORKER_MB * 1e6
                ]
                if children:
                    self.processes[name] = children[0]
                    names.append(name)
        return names

    def kill(self, name: str) -> None:
        """SIGKILL one of the processes."""
        with contextlib.suppress(psutil.Error):
            self.processes[name].kill()

    def stop(self) -> None:
        """Kill what is left."""
        for process in (self._scheduler, *self._nannies.values()):
            if process is not None:
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(process.pid, signal.SIGKILL)
                process.wait()
