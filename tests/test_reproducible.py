"""Equal inputs give equal bytes, another seed gives others, and a kill leaves the old file or none."""

from __future__ import annotations

import json
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from subprocess import CompletedProcess

import pytest
from in_process import run_here
from posterior_files import write_calibration, write_maps

from tactile_bayes.files.atomic import atomic_path

Run = Callable[..., "CompletedProcess[str]"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("reproducible")
    write_maps(place)
    write_calibration(place / "size.json")
    return place


def outputs(run_cli: Run, folder: Path, place: Path, *options: object) -> dict[str, bytes]:
    """stdout and the three files of one estimate."""
    place.mkdir()
    names = {"-o": place / "p.nc", "--figure": place / "s.png", "--map-figure": place / "m.png"}
    paths = [word for pair in names.items() for word in pair]
    done = run_cli("estimate", "a.nc", "--size-calibration", "size.json", "--json", *paths, *options, cwd=folder)
    assert done.returncode == 0, done.stderr
    return {"json": done.stdout.encode()} | {path.name: path.read_bytes() for path in names.values()}


SLOW_METHODS = [pytest.param(method, marks=pytest.mark.slow) for method in ("optimise", "ensemble")]


@pytest.mark.long
@pytest.mark.parametrize("method", ["laplace", *SLOW_METHODS])
def test_one_seed_gives_the_same_bytes_and_another_does_not(
    run_cli: Run, folder: Path, tmp_path: Path, method: str
) -> None:
    first = outputs(run_cli, folder, tmp_path / "1", "--method", method)
    again = outputs(run_cli, folder, tmp_path / "2", "--method", method)
    other = outputs(run_cli, folder, tmp_path / "3", "--method", method, "--seed", 2)
    assert first == again
    for name in ("json", "p.nc", "s.png"):
        assert first[name] != other[name], name


@pytest.mark.long
def test_calibrations_are_reproducible(tmp_path: Path) -> None:
    rows = [f"{d},{0.02 * d},{0.3 * d + 0.1 * (d % 3)}" for d in range(6, 22)]
    (tmp_path / "t.csv").write_text("\n".join(["d_mm,amplitude,sigma_x_mm", *rows]) + "\n")
    for name, seed in (("1", 1), ("2", 1), ("3", 2)):
        done = run_here("calibrate", "size", "t.csv", "-o", name, "--seed", seed, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
    one, two, three = ((tmp_path / name).read_bytes() for name in "123")
    assert one == two
    assert json.loads(one)["x"]["draws"] != json.loads(three)["x"]["draws"]


WRITE_FOREVER = """
import sys
from pathlib import Path
from tactile_bayes.files.atomic import atomic_path
n = 0
while True:
    n += 1
    with atomic_path(Path("out.txt"), force=True) as partial, partial.open("w") as file:
        for _ in range(2000):
            file.write(f"{n % 10}" * 100 + "\\n")
    print("ready", flush=True)
"""
WRITE_AND_WAIT = """
import time
from pathlib import Path
from tactile_bayes.files.atomic import atomic_path
with atomic_path(Path("out.txt"), force=True) as partial:
    partial.write_text("new")
    print("ready", flush=True)
    time.sleep(60)
"""


def killed(code: str, place: Path, environment: dict[str, str], *, after_s: float, times: int = 1) -> None:
    """Run a writer in `place` and kill it some time after it has said so many times that it is ready."""
    with subprocess.Popen([sys.executable, "-c", code], cwd=place, env=environment, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        for _ in range(times):
            assert process.stdout.readline() == b"ready\n"
        time.sleep(after_s)
        process.kill()
        assert process.wait() == -signal.SIGKILL


@pytest.mark.parametrize("old", [None, "old"])
def test_a_kill_between_writing_and_renaming_leaves_the_old_file_or_none(
    tmp_path: Path, child_environment: dict[str, str], old: str | None
) -> None:
    path = tmp_path / "out.txt"
    if old is not None:
        path.write_text(old)
    killed(WRITE_AND_WAIT, tmp_path, child_environment, after_s=0.0)
    assert (path.read_text() if path.exists() else None) == old


def test_what_a_killed_writer_left_goes_with_the_next_write_and_nothing_else(
    tmp_path: Path, child_environment: dict[str, str]
) -> None:
    killed(WRITE_AND_WAIT, tmp_path, child_environment, after_s=0.0)
    (left,) = tmp_path.glob(".out.txt.*.part")
    host, process = left.name.split(".")[3].split("-")[:2]
    others = [
        left.name.replace("out.txt", "other.txt"),  # of another file
        left.name.replace(f"-{process}-", "-1-"),  # of a process that lives: the system's first
        left.name.replace(host, "00000000"),  # of another computer
        ".out.txt.part",
    ]
    for name in others:
        (tmp_path / name).write_text("not ours")
    with atomic_path(tmp_path / "out.txt") as partial:
        partial.write_text("whole")
        assert not left.exists()
        with atomic_path(tmp_path / "out.txt") as second:
            assert partial.exists()  # ours lives: another write of the same file leaves it alone
            second.write_text("sooner")
        (tmp_path / "out.txt").unlink()
    assert {one.name for one in tmp_path.iterdir()} == {*others, "out.txt"}


@pytest.mark.long
def test_a_kill_at_any_moment_leaves_a_whole_file(tmp_path: Path, child_environment: dict[str, str]) -> None:
    chance = random.Random(96)
    seen = set()
    for times in range(1, 11):  # however long a write takes here, the kills come during different ones
        killed(WRITE_FOREVER, tmp_path, child_environment, times=times, after_s=chance.uniform(0, 0.03))
        lines = (tmp_path / "out.txt").read_text().splitlines()
        assert len(lines) == 2000
        assert len(set(lines)) == 1
        seen.add(lines[0][0])
    assert len(seen) > 1  # the kills came at different times
