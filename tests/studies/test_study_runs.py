"""Studies that run elsewhere or not to their end: a real dask scheduler with two workers, and Ctrl-C."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from subprocess import CompletedProcess

import pytest

from tactile_bayes.errors import EXIT_INTERRUPTED

pytestmark = pytest.mark.slow
Run = Callable[..., "CompletedProcess[str]"]
GRID = "d_mm,depth_ratio,stiffness_ratio\n" + "".join(f"{d},{h},100\n" for d in (10, 15) for h in (0.8, 1, 1.2))


def wait_for(path: Path, text: str, *, seconds: float = 60.0) -> None:
    """Until a growing file holds a text."""
    end = time.monotonic() + seconds
    while not (path.exists() and text in path.read_text()):
        assert time.monotonic() < end, f"{path.name} never said {text!r}"
        time.sleep(0.05)


@contextlib.contextmanager
def dask(environment: dict[str, str], log: Path, *words: str):
    with log.open("w") as out:
        command = [sys.executable, "-m", "distributed.cli.dask_" + words[0], *words[1:]]
        process = subprocess.Popen(command, env=environment, stdout=out, stderr=out, cwd=log.parent)
        try:
            yield
        finally:
            process.terminate()
            process.wait(60)


@pytest.mark.parametrize("model", ["plane-strain", "solid"])
def test_two_workers_of_a_dask_scheduler_make_the_same_table(
    model: str, run_cli: Run, child_environment: dict[str, str], tmp_path: Path
) -> None:
    pytest.importorskip("distributed", reason="the [cluster] extra is not installed")
    (tmp_path / "grid.csv").write_text(GRID)
    words = ("study", "--model", model, "--grid", "grid.csv", "--fineness", 1)
    log = tmp_path / "scheduler.log"
    with contextlib.ExitStack() as stack:
        here = ("--host", "127.0.0.1")
        stack.enter_context(dask(child_environment, log, "scheduler", *here, "--port", "0", "--no-dashboard"))
        wait_for(log, "Scheduler at:")
        address = log.read_text().split("Scheduler at:")[1].split()[0]
        for number in (1, 2):
            out = tmp_path / f"worker{number}.log"
            options = ("--nthreads", "1", "--no-nanny", "--no-dashboard", *here)
            stack.enter_context(dask(child_environment, out, "worker", address, *options))
            wait_for(out, "Registered to:")
        done = run_cli(*words, "--scheduler", address, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout == run_cli(*words, cwd=tmp_path).stdout


def test_a_study_cut_off_by_ctrl_c_keeps_what_it_has(
    run_cli: Run, child_environment: dict[str, str], tmp_path: Path
) -> None:
    (tmp_path / "grid.csv").write_text(GRID)
    words = ("study", "--model", "solid", "--grid", "grid.csv", "-o", "study.csv")
    command = [sys.executable, "-m", "tactile_bayes", *words]
    process = subprocess.Popen(
        command, cwd=tmp_path, env=child_environment, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    store = tmp_path / "study.csv.unfinished"
    wait_for(store, '"key"')
    os.kill(process.pid, signal.SIGINT)
    _, said = process.communicate(timeout=60)
    assert process.returncode == EXIT_INTERRUPTED
    assert "Traceback" not in said
    assert not (tmp_path / "study.csv").exists()
    kept = store.read_text().count('"key"')
    assert 1 <= kept < 6
    done = run_cli(*words, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert not store.exists()
    whole = run_cli("study", "--model", "solid", "--grid", "grid.csv", cwd=tmp_path)
    assert (tmp_path / "study.csv").read_text() == whole.stdout
