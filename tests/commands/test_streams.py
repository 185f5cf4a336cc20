"""Standard streams that are closed, full, without a buffer or of another encoding."""

from __future__ import annotations

import errno
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from in_process import run_here
from repeated_exams import estimate_document

import tactile_bayes as tb

Run = Callable[..., "subprocess.CompletedProcess[str]"]

# Runs the program with files of up to 4096 bytes, which the system takes in part, as a nearly full disk does.
NEARLY_FULL = """
import resource
resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))
from tactile_bayes.cli import main
main()
"""


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("streams")
    (place / "exam.json").write_text(json.dumps(estimate_document()))
    tb.demo_map().save(place / "map.nc")
    return place


@pytest.fixture
def folder(made: Path, tmp_path: Path) -> Path:
    return shutil.copytree(made, tmp_path, dirs_exist_ok=True)


@pytest.mark.long_repeats
@pytest.mark.parametrize("unbuffered", ["", "1"])
def test_a_nearly_full_disk_never_takes_half_a_result_in_silence(
    unbuffered: str, folder: Path, child_environment: dict[str, str]
) -> None:
    """Without a buffer (PYTHONUNBUFFERED, as in containers) half the report was there and the exit code 0."""
    words = [sys.executable, "-c", NEARLY_FULL, "estimate", "map.nc", "--method", "laplace", "--json"]
    with (folder / "out.txt").open("w") as out:
        done = subprocess.run(
            words,
            cwd=folder,
            env=child_environment | {"PYTHONUNBUFFERED": unbuffered, "PYTHONDONTWRITEBYTECODE": "1"},
            stdout=out,
            stderr=subprocess.PIPE,
            text=True,
        )
    assert (done.returncode, done.stderr.count("\n")) == (2, 1), done.stderr
    assert "the standard output cannot be written (File too large)" in done.stderr


@pytest.mark.long_repeats
@pytest.mark.parametrize("closed", ["<&-", ">&-", "2>&-", "<&- >&- 2>&-"])
def test_closed_streams_change_nothing_but_what_is_seen(
    closed: str, folder: Path, child_environment: dict[str, str]
) -> None:
    line = f'"{sys.executable}" -m tactile_bayes export exam.json --to csv -o out.csv {closed}'
    done = subprocess.run(line, shell=True, cwd=folder, env=child_environment, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    assert (folder / "out.csv").read_text().startswith("record_id,")
    assert ("out.csv" in done.stdout) == (">&-" not in closed.replace("2>&-", ""))


def test_what_is_told_of_the_run_never_goes_into_the_output(folder: Path, child_environment: dict[str, str]) -> None:
    """With stderr closed the lines of -v went to stdout, into the JSON."""
    line = f'"{sys.executable}" -m tactile_bayes estimate map.nc --method laplace -v --json 2>&-'
    done = subprocess.run(line, shell=True, cwd=folder, env=child_environment, capture_output=True, text=True)
    assert json.loads(done.stdout)["schema"].startswith("tactile-bayes")


def test_an_ascii_terminal_gets_escapes_and_no_control_characters(folder: Path, run_cli: Run) -> None:
    """Click wrote past the stream that escapes them where a locale is ASCII."""
    (folder / "exam.json").rename(folder / "ex\x07ü.json")
    ascii_only = {"PYTHONUTF8": "0", "LC_ALL": "C", "PYTHONCOERCECLOCALE": "0", "PYTHONIOENCODING": "ascii"}
    done = run_cli("estimate", "ex\x07ü.json", cwd=folder, env=ascii_only)
    assert (done.returncode, done.stderr.count("\n")) == (3, 1), done.stderr
    assert "\x07" not in done.stderr
    assert r"ex\x07" in done.stderr
    assert done.stderr.isascii()


def test_a_current_folder_that_is_gone_is_one_line(folder: Path, child_environment: dict[str, str]) -> None:
    """It was: error: No such file or directory."""
    program = f'"{sys.executable}" -m tactile_bayes'
    line = f"mkdir gone && cd gone && rmdir ../gone && {program} export exam.json --to csv -o out.csv"
    done = subprocess.run(line, shell=True, cwd=folder, env=child_environment, capture_output=True, text=True)
    assert (done.returncode, done.stderr.splitlines()[-1:]) == (
        2,
        ["error: the current folder is no longer there; change to one that is (cd)"],
    )


def test_a_file_that_may_not_be_read_is_one_line(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Click told it in four lines and as a fault of usage, before the reader could."""
    opened = os.open

    def closed(path: str, flags: int, *more: int, **options: int) -> int:
        if str(path).endswith("map.nc"):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), path)
        return opened(path, flags, *more, **options)

    monkeypatch.setattr(os, "open", closed)
    monkeypatch.setattr(os, "access", lambda path, *_, **__: not str(path).endswith("map.nc"))
    done = run_here("show", "map.nc", cwd=folder)
    assert (done.returncode, done.stderr.count("\n")) == (3, 1), done.stderr
    assert "map.nc: cannot be read (Permission denied)" in done.stderr


def test_a_demo_on_a_full_disk_names_its_own_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It named the program's file, with exit code 1, and left half a scan."""

    def refusing(*_: object) -> int:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(Path, "write_bytes", refusing)
    done = run_here("demo", "-o", "demo", cwd=tmp_path)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert done.stderr.startswith("error: demo/")
    assert "cannot be written (No space left on device); make room" in done.stderr
    assert list((tmp_path / "demo").iterdir()) == []
