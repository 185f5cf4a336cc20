"""Several files of one command are all there or none is; JSON in which a key stands twice is refused."""

from __future__ import annotations

import errno
import json
import os
from pathlib import Path
from typing import Any

import pytest
from in_process import run_here
from repeated_exams import estimate_document

from tactile_bayes.errors import BadDataError, UsageError
from tactile_bayes.files.atomic import write_all
from tactile_bayes.files.documents import parse_json


@pytest.fixture
def full_disk(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The disk is full for files whose names hold one of these words."""
    words: list[str] = []
    write = Path.write_bytes

    def refusing(path: Path, data: Any) -> int:
        if any(word in path.name for word in words):
            write(path, bytes(data)[:7])  # what a full disk still took
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return write(path, data)

    monkeypatch.setattr(Path, "write_bytes", refusing)
    return words


def test_a_full_disk_leaves_the_old_files_and_no_new_one(tmp_path: Path, full_disk: list[str]) -> None:
    old, new, last = (tmp_path / name for name in ("old.txt", "new.txt", "last.txt"))
    old.write_text("mine")
    full_disk.append("last")
    with pytest.raises(UsageError, match=r"last.txt cannot be written \(No space left on device\); make room"):
        write_all({new: b"1", old: b"2", last: b"3"}, force=True)
    assert [path.name for path in tmp_path.iterdir()] == ["old.txt"]
    assert old.read_text() == "mine"
    full_disk.clear()
    write_all({new: b"1", old: b"2", last: b"3"}, force=True)
    assert [path.read_bytes() for path in (new, old, last)] == [b"1", b"2", b"3"]
    assert new.stat().st_mode & 0o777 == 0o600


@pytest.mark.parametrize(
    ("words", "refused"),
    [
        (("export", "exam.json", "--to", "csv", "-o", "r.csv", "--dictionary", "d.csv"), "d.csv"),
        (("export", "exam.json", "--to", "csv", "-o", "r.csv", "--dictionary", "d.csv"), "r.csv"),
        (("report", "exam.json", "-o", "page.html", "--pdf", "page.pdf"), "page.pdf"),
        (("report", "exam.json", "-o", "page.html", "--pdf", "page.pdf"), "page.html"),
    ],
)
def test_a_command_of_two_files_writes_both_or_none(
    tmp_path: Path, full_disk: list[str], monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...], refused: str
) -> None:
    monkeypatch.setattr("tactile_bayes.report.pages.find_printer", lambda: str.encode)
    (tmp_path / "exam.json").write_text(json.dumps(estimate_document()))
    full_disk.append(refused)
    done = run_here(*words, cwd=tmp_path)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert f"{refused} cannot be written (No space left on device)" in done.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["exam.json"]
    full_disk.clear()
    assert run_here(*words, cwd=tmp_path).returncode == 0
    assert len(list(tmp_path.iterdir())) == 3


@pytest.mark.parametrize(
    ("text", "key"),
    [
        ('{"patient_id": "1", "patient_id": "2"}', "patient_id"),
        ('[{"a": 1}, {"b": {"c": 1, "d": 2, "c": 1}}]', "c"),
        ('{"' + "x" * 99 + '": 1, "' + "x" * 99 + '": 1}', "x" * 40),
    ],
)
def test_a_key_that_stands_twice_is_refused(text: str, key: str) -> None:
    with pytest.raises(BadDataError, match=f"holds the key '{key}' twice in one object"):
        parse_json(text)
    assert parse_json('[{"a": 1}, {"a": 1, "b": {"a": 2}}]') == [{"a": 1}, {"a": 1, "b": {"a": 2}}]


def test_a_worklist_with_two_patients_is_refused_either_way(tmp_path: Path) -> None:
    (tmp_path / "exam.json").write_text(json.dumps(estimate_document()))
    (tmp_path / "two.json").write_text('[{"patient_id": "1"}, {"patient_id": "2"}]')
    (tmp_path / "twice.json").write_text('{"patient_id": "1", "patient_id": "2"}')
    for name, told in (("two", "holds 2 worklist items; give one"), ("twice", "holds the key 'patient_id' twice")):
        words = ("export", "exam.json", "--to", "fhir", "-o", "out.json", "--worklist", f"{name}.json")
        done = run_here(*words, cwd=tmp_path)
        assert (done.returncode, done.stderr.count("\n")) == (3, 1)
        assert f"{name}.json: {told}" in done.stderr
        assert not (tmp_path / "out.json").exists()
