"""A campaign's folders that may not be read or written: one line, and a dry run that only looks."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest
from campaign_files import JOURNAL, thinned, write
from in_process import run_here

from tactile_bayes.campaigns.inputs import open_campaign
from tactile_bayes.errors import UsageError

DRY = ("campaign", "run", "exams.csv", "-o", "out", "--dry-run")


@pytest.fixture
def begun(tmp_path: Path) -> Path:
    """A campaign of one scan that was begun, with a line that a kill cut off."""
    (tmp_path / "scans").mkdir()
    write(tmp_path / "scans" / "a.mcap", thinned(0, 3, subject="07", side="left"))
    assert run_here("campaign", "init", "scans", "-o", "exams.csv", cwd=tmp_path).returncode == 0
    with open_campaign(tmp_path / "out"):
        pass
    with (tmp_path / "out" / JOURNAL).open("a") as journal:
        journal.write('{"key": "map 07')
    return tmp_path


def refuse_writing(monkeypatch: pytest.MonkeyPatch) -> None:
    """As a folder that is read-only to this user; root may write everywhere."""
    opened = os.open

    def refusing(path: object, flags: int, *more: int, **options: int) -> int:
        if JOURNAL in str(path) and flags & (os.O_RDWR | os.O_WRONLY | os.O_CREAT):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
        return opened(path, flags, *more, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(os, "open", refusing)


def test_a_dry_run_needs_no_leave_to_write(begun: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    refuse_writing(monkeypatch)
    done = run_here(*DRY, cwd=begun)
    assert done.returncode == 0, done.stderr
    assert "map: 1 to do, 0 done" in done.stdout
    refused = run_here(*DRY[:-1], cwd=begun)
    assert (refused.returncode, refused.stderr.count("\n")) == (2, 1)
    assert f"out/{JOURNAL} cannot be opened (Permission denied); choose another place" in refused.stderr
    nowhere = run_here("campaign", "run", "exams.csv", "-o", "no/out", "--dry-run", cwd=begun)
    assert (nowhere.returncode, nowhere.stderr) == (2, "error: no is not a directory; create it first\n")


def test_a_dry_run_leaves_a_journal_as_it_is(begun: Path) -> None:
    """It cut off the line that a kill had left half written."""
    before = (begun / "out" / JOURNAL).read_bytes()
    assert run_here(*DRY, cwd=begun).returncode == 0
    assert (begun / "out" / JOURNAL).read_bytes() == before
    (begun / "out" / JOURNAL).write_bytes(before[:9])  # killed while it wrote the header
    assert run_here(*DRY, cwd=begun).returncode == 0
    assert (begun / "out" / JOURNAL).read_bytes() == before[:9]


def test_a_dry_run_looks_at_no_journal_that_is_being_written(begun: Path) -> None:
    with (
        open_campaign(begun / "out"),
        pytest.raises(UsageError, match="is in use by another run"),
        open_campaign(begun / "out", dry=True),
    ):
        pass


def closed(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    """Let nobody list a folder; root may list every one."""
    listed = os.scandir

    def refusing(path: str) -> object:
        if Path(path).name == name:
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))
        return listed(path)

    monkeypatch.setattr(os, "scandir", refusing)


def test_a_folder_of_scans_that_cannot_be_read_is_reported(begun: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its exams were missing from the table without a word."""
    (begun / "scans" / "day 2").mkdir()
    closed(monkeypatch, "day 2")
    done = run_here("campaign", "init", "scans", "-o", "new.csv", cwd=begun)
    assert done.returncode == 0, done.stderr
    assert "left out: scans/day 2: cannot be read (Permission denied)" in done.stderr


def test_a_closed_folder_is_not_one_without_scans(begun: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    closed(monkeypatch, "scans")
    done = run_here("campaign", "init", "scans", "-o", "new.csv", cwd=begun)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert "scans cannot be read (Permission denied); give a folder that can" in done.stderr


def test_an_output_folder_that_cannot_be_read_is_one_line(begun: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    exists = Path.exists

    def refusing(path: Path, **options: bool) -> bool:
        if path.name == JOURNAL:
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))
        return exists(path, **options)

    monkeypatch.setattr(Path, "exists", refusing)
    done = run_here(*DRY, cwd=begun)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert "out cannot be read (Permission denied); choose another folder" in done.stderr
