"""What every test may ask for: the shared data, the program in a process of its own, and hypothesis profiles."""

from __future__ import annotations

import gc
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, settings
from in_process import run_here

ROOT = Path(__file__).resolve().parent.parent

# As the program does, and before a test module imports numpy: its threads would fight with the tests' own processes.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# Bytecode is kept, whatever the shell says: without it every process of a test compiles the package again.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

# The same examples at every run; `HYPOTHESIS_PROFILE=ci` looks at more of them.
settings.register_profile("default", max_examples=10, derandomize=True, deadline=None)
settings.register_profile(
    "ci", max_examples=200, derandomize=True, deadline=None, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "default"))

COLUMNS = "100"
STARTED_S = time.monotonic()

Run = Callable[..., "subprocess.CompletedProcess[str]"]


def pytest_addoption(parser: pytest.Parser) -> None:
    """Options by which a part of the long or slow tests is run, another one each time."""
    parser.addoption("--begin-at", type=int, default=0, metavar="N", help="Begin at a place that N decides.")
    parser.addoption("--budget", type=float, metavar="S", help="Skip tests that would begin after S seconds.")


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Mark the further cases of `long_repeats`, and turn the order round as `--begin-at` asks.

    Neighbours stay together; steps of a prime number visit every place.
    """
    repeated = set[str]()
    for item in items:
        if item.get_closest_marker("long_repeats"):
            test = item.nodeid.partition("[")[0]
            if test in repeated:
                item.add_marker("long")
            repeated.add(test)
    if begin := config.getoption("--begin-at"):
        place = begin * 97 % max(len(items), 1)
        items[:] = items[place:] + items[:place]


def pytest_collection_finish() -> None:
    """Five thousand tests stay to the end: the collector of cycles need not walk them again and again."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(50_000, 20, 50)


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Skip what would begin too late."""
    budget = item.config.getoption("--budget")
    if budget is not None and time.monotonic() - STARTED_S > budget:
        pytest.skip("the time for long tests is spent")


@pytest.fixture(scope="session", autouse=True)
def nothing_waits_for_the_disk() -> Iterator[None]:
    """No test outlives the machine: what it writes need not have reached the disk, which takes 10 ms a file."""
    with pytest.MonkeyPatch.context() as patch:
        for name in ("fsync", "fdatasync"):
            patch.setattr(os, name, lambda _descriptor: None)
        yield


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real data beside the checkout; tests that need it are skipped where it is not there."""
    folder = ROOT.parent / "shared" / "data"
    if not folder.is_dir():
        pytest.skip("the shared data folder is not beside this checkout")
    return folder


@pytest.fixture(scope="session")
def child_environment() -> dict[str, str]:
    """This process's variables, with the checkout importable and text wrapped at one width."""
    return dict(os.environ) | {"PYTHONPATH": str(ROOT), "COLUMNS": COLUMNS, "PYTHONUTF8": "1"}


@pytest.fixture(scope="session")
def run_python(child_environment: dict[str, str]) -> Run:
    """Run this Python in a process of its own: ``run_python("-c", code, cwd=tmp_path)``.

    Returns the `CompletedProcess` with text output, whatever the exit code; ``env`` adds variables.
    """

    def run(
        *args: object, cwd: Path | None = None, env: dict[str, str] | None = None, timeout: float = 300.0
    ) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, *map(str, args)],
            cwd=cwd,
            env=child_environment | (env or {}),
            capture_output=True,
            text=True,
            timeout=timeout,
            check=False,
        )

    return run


@pytest.fixture(scope="session")
def run_cli(run_python: Run) -> Run:
    """Run the program: ``run_cli("map", "scan.mcap", cwd=tmp_path)``; in a process of its own where it gets options."""

    def run(*args: object, cwd: Path | None = None, **options: Any) -> subprocess.CompletedProcess[str]:
        if options:
            return run_python("-m", "tactile_bayes", *args, cwd=cwd, **options)
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("COLUMNS", COLUMNS)
            return run_here(*args, cwd=cwd or Path.cwd())

    return run
