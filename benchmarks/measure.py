"""CPU seconds and peak memory of a process, from the kernel's own account of it."""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent


@dataclass(frozen=True, slots=True)
class Cost:
    """What one process took.

    Parameters
    ----------
    cpu_s
        User and system time, all threads; unlike the time on the wall it hardly depends on what else runs.
    peak_mb
        Largest resident memory, in 10^6 bytes. This process's own size is a floor, so it imports nothing heavy.
    """

    cpu_s: float
    peak_mb: float


class CommandFailedError(RuntimeError):
    """A measured command did not end well: its cost would mean nothing."""


def environment() -> Mapping[str, str]:
    """This process's variables, with the checkout importable."""
    return dict(os.environ) | {"PYTHONPATH": str(ROOT)}


def run_once(arguments: Sequence[str], *, folder: Path) -> Cost:
    """Run this Python with `arguments` in `folder` and return its cost.

    Raises
    ------
    CommandFailedError
        With the last line of stderr, when the exit code is not 0.
    """
    with tempfile.TemporaryFile() as errors:
        process = subprocess.Popen(
            [sys.executable, *arguments], cwd=folder, env=environment(), stdout=subprocess.DEVNULL, stderr=errors
        )
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)  # it was waited for here, not by subprocess
        if process.returncode != 0:
            errors.seek(0)
            last = errors.read().decode(errors="replace").strip().splitlines()[-1:]
            raise CommandFailedError(f"exit code {process.returncode}: {' '.join(last)}")
    unit = 1 if sys.platform == "darwin" else 1024
    return Cost(usage.ru_utime + usage.ru_stime, usage.ru_maxrss * unit / 1e6)


def measure(arguments: Sequence[str], *, folder: Path, runs: int) -> Cost:
    """Medians over `runs` runs after one that warms the disk's cache."""
    run_once(arguments, folder=folder)
    costs = [run_once(arguments, folder=folder) for _ in range(runs)]
    return Cost(statistics.median(cost.cpu_s for cost in costs), statistics.median(cost.peak_mb for cost in costs))
