"""What every test may ask for: the shared data, the program in a process of its own, and hypothesis profiles."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

ROOT = Path(__file__).resolve().parent.parent

# As the program does, and before a test module imports numpy: its threads would fight with the tests' own processes.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# The same examples at every run; `HYPOTHESIS_PROFILE=ci` looks at more of them.
settings.register_profile("default", max_examples=20, derandomize=True, deadline=None)
settings.register_profile(
    "ci", max_examples=200, derandomize=True, deadline=None, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "default"))

Run = Callable[..., "subprocess.CompletedProcess[str]"]


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
    return dict(os.environ) | {"PYTHONPATH": str(ROOT), "COLUMNS": "100", "PYTHONUTF8": "1"}


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
    """Run the program in a process of its own: ``run_cli("map", "scan.mcap", cwd=tmp_path)``; see `run_python`."""
    return lambda *args, **options: run_python("-m", "tactile_bayes", *args, **options)
