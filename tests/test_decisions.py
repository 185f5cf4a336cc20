"""Decision records hold together: status, links both ways, a line on their subject's page, commands that exist."""

from __future__ import annotations

import re
import shlex
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import pytest
from doc_pages import PROGRAM, check_words

ROOT = Path(__file__).resolve().parent.parent
FOLDER = ROOT / "docs" / "decisions"
MOST_LINES = 60
KEYS = {"status", "subject", "command", "replaces", "changes", "changed_by"}
PARTS = ["Decision", "Why", "Rejected", "Consequences"]
BOTH_WAYS = [("replaces", "replaced_by"), ("changes", "changed_by")]


@dataclass(frozen=True)
class Decision:
    """A record: its keys and its text."""

    path: Path

    @property
    def number(self) -> str:
        return self.path.name[:4]

    @cached_property
    def _halves(self) -> tuple[str, str]:
        front, text = self.path.read_text(encoding="utf-8").removeprefix("---\n").split("\n---\n", 1)
        return front, text

    @cached_property
    def keys(self) -> dict[str, str]:
        return dict(line.split(": ", 1) for line in self._halves[0].splitlines())

    @property
    def text(self) -> str:
        return self._halves[1]

    @property
    def title(self) -> str:
        return self.text.splitlines()[0].removeprefix(f"# {self.number} ")

    @property
    def in_force(self) -> bool:
        return self.keys["status"] == "in force"

    def numbers(self, key: str) -> set[str]:
        if key == "replaced_by":
            return set(re.findall(r"replaced by (\d{4})", self.keys["status"]))
        return set(self.keys.get(key, '""').strip('"').split())


RECORDS = {one.number: one for one in map(Decision, sorted(FOLDER.glob("[0-9]*.md")))}
SUBJECTS = sorted({one.keys["subject"] for one in RECORDS.values()})
COMMANDS = sorted({one.keys["command"] for one in RECORDS.values() if "command" in one.keys})


def listed(subject: str) -> dict[str, list[tuple[str, str]]]:
    """Number and rest of each line of a subject's page, by the heading above it."""
    sections = re.split(r"^## ", (FOLDER / f"{subject}.md").read_text(encoding="utf-8"), flags=re.MULTILINE)[1:]
    return {part.splitlines()[0]: re.findall(r"^- \[?(\d{4})(.*)$", part, flags=re.MULTILINE) for part in sections}


WITHOUT_RECORD = {
    number
    for subject in SUBJECTS
    for lines in listed(subject).values()
    for number, rest in lines
    if rest.startswith(", without a record")
}
"""Numbers whose record went: what they decided is said where the code is described."""


def missing(command: str) -> str:
    """What of a record's command does not exist; empty where it could be run."""
    words = shlex.split(command)
    if words[0] == PROGRAM:
        check_words(tuple(words[1:]))
        return ""
    if words[0] == "make":
        targets = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), flags=re.MULTILINE)
        return ", ".join(set(words[1:]) - set(targets))
    if words[0] == "pytest":
        return ", ".join(word for word in words[1:] if not (ROOT / word).exists())
    if words[0] == "python" and words[1].endswith(".py"):
        return "" if (ROOT / words[1]).exists() else words[1]
    assert words[:2] == ["python", "-m"], command
    module = ROOT / words[2].replace(".", "/")
    files = [module.with_suffix(".py"), *([module / f"{words[3]}.py"] if len(words) > 3 else [])]
    return "" if any(file.exists() for file in files) else " ".join(words[2:4])


@pytest.mark.parametrize("record", RECORDS.values(), ids=lambda record: record.number)
def test_a_record_says_what_it_decides_and_whether_it_holds(record: Decision) -> None:
    lines = record.path.read_text(encoding="utf-8").splitlines()
    assert len(lines) <= MOST_LINES
    assert set(record.keys) <= KEYS
    assert record.text.startswith(f"# {record.number} ")
    assert re.fullmatch(r"in force|withdrawn|replaced by \d{4}", record.keys["status"])
    parts = re.findall(r"^\*\*(\w+)\.\*\*", record.text, flags=re.MULTILINE)
    if record.in_force:
        assert parts[:2] == PARTS[:2]
        assert parts == [part for part in PARTS if part in parts]
    else:
        assert parts == [record.keys["status"].split()[0].capitalize()]
        assert "command" not in record.keys


@pytest.mark.parametrize(("forth", "back"), BOTH_WAYS)
def test_links_between_records_go_both_ways(forth: str, back: str) -> None:
    said = {(one.number, other) for one in RECORDS.values() for other in one.numbers(forth)}
    answered = {(other, one.number) for one in RECORDS.values() for other in one.numbers(back)}
    assert said == answered
    assert all(other < number for number, other in said)


@pytest.mark.parametrize("subject", SUBJECTS)
def test_a_subject_lists_each_of_its_records_once(subject: str) -> None:
    sections = listed(subject)
    mine = [one for one in RECORDS.values() if one.keys["subject"] == subject]
    for heading, wanted in [
        ("In force", {one.number for one in mine if one.in_force}),
        ("No longer in force", {one.number for one in mine if not one.in_force}),
    ]:
        lines = [(number, rest) for number, rest in sections.get(heading, []) if number not in WITHOUT_RECORD]
        assert sorted(number for number, _ in lines) == sorted(wanted)
        for number, rest in lines:
            assert f"({RECORDS[number].path.name})" in rest
            assert RECORDS[number].title in rest
            assert all(f"[{other}]" in rest for other in RECORDS[number].numbers("replaced_by"))
    assert f"decisions/{subject}.md" in (ROOT / "docs" / "decisions.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("command", COMMANDS)
def test_a_command_that_measures_a_decision_exists(command: str) -> None:
    assert missing(command) == ""


@pytest.mark.parametrize(
    "command", ["make nothing", "python -m benchmarks.nothing", "python -m validation nothing", "python tests/no.py"]
)
def test_a_command_that_is_gone_would_be_found(command: str) -> None:
    assert missing(command)


def test_a_number_that_is_cited_has_a_record() -> None:
    """In the records, the documents and the code; so have files and benchmarks that a record in force names."""
    cited = re.compile(r"(?:records? |decisions/|\()(0[01]\d\d)\b")
    files = [*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md")]
    files += [
        path for room in ("tactile_bayes", "benchmarks", "validation", "tests") for path in (ROOT / room).rglob("*.py")
    ]
    found = {(number, path.name) for path in files for number in cited.findall(path.read_text(encoding="utf-8"))}
    assert {(number, name) for number, name in found if number not in RECORDS} == set()


def test_files_and_benchmarks_that_a_record_names_exist() -> None:
    gone = []
    for record in RECORDS.values():
        for name in re.findall(r"`((?:tests|docs|benchmarks|validation|tactile_bayes)/[\w./]+)`", record.text):
            gone += [(record.number, name)] if not (ROOT / name).exists() else []
        for room, name, rest in re.findall(r"`(benchmarks|validation)\.(\w+)[^`]*`([^.]*)", record.text):
            file = ROOT / room / f"{name}.py"
            gone += [(record.number, name)] if "at commit" not in rest and not file.exists() else []
    assert gone == []


def test_numbers_are_used_once() -> None:
    assert len(RECORDS) == len(list(FOLDER.glob("[0-9]*.md")))
    assert not WITHOUT_RECORD & set(RECORDS)
    assert min(RECORDS) == "0001"
