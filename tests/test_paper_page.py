"""docs/paper.md: every figure that it says a command prints is printed by that command today."""

from __future__ import annotations

import itertools
import re
from dataclasses import dataclass
from pathlib import Path

import pytest
from doc_pages import PROGRAM, blocks_of
from in_process import run_here

ROOT = Path(__file__).resolve().parent.parent
PAGE = ROOT / "docs" / "paper.md"
QUICK = ("head", "compare-model", "validate")
"""Commands of a few seconds; the others run in the slow suite."""


@dataclass(frozen=True)
class Row:
    """One line of a table: what the command prints, as the page has it."""

    command: str
    printed: tuple[str, ...]


def rows_of(text: str) -> list[Row]:
    """Rows with a cell that is a command of the program; the cell before it holds what is printed, in code."""
    found = []
    for line in text.splitlines():
        cells = [cell.strip() for cell in line.strip().strip("|").split("|")]
        for before, cell in itertools.pairwise(cells):
            if re.fullmatch(rf"`{PROGRAM} [^`]+`", cell):
                found.append(Row(cell.strip("`"), tuple(re.findall(r"`([^`]+)`", before))))
    return found


def missing(row: Row, stdout: str) -> list[str]:
    """What the page says and the command does not print; runs of blanks count as one."""
    printed = " ".join(stdout.split())
    return [words for words in row.printed if words not in printed]


ROWS = rows_of(PAGE.read_text(encoding="utf-8"))
COMMANDS = sorted({row.command for row in ROWS})


def check(command: str, folder: Path) -> None:
    for block in blocks_of(PAGE):
        if block.file_name:
            (folder / block.file_name).write_text(block.text, encoding="utf-8")
    if "demo/" in command:
        (folder / "demo").symlink_to(ROOT / "tactile_bayes" / "demo")
    if "ball.mcap" in command:
        assert run_here("simulate", "ball.toml", "-o", "ball.mcap", cwd=folder).returncode == 0
    done = run_here(*command.split()[1:], cwd=folder)
    assert done.returncode == 0, done.stderr
    for row in ROWS:
        if row.command == command:
            assert missing(row, done.stdout + done.stderr) == [], command


@pytest.mark.long
@pytest.mark.parametrize("command", [one for one in COMMANDS if one.split()[1] in QUICK])
def test_a_quick_command_prints_what_the_page_says(command: str, tmp_path: Path) -> None:
    check(command, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("command", [one for one in COMMANDS if one.split()[1] not in QUICK])
def test_a_long_command_prints_what_the_page_says(command: str, tmp_path: Path) -> None:
    check(command, tmp_path)


def test_every_row_says_something_and_the_paper_is_covered() -> None:
    assert all(row.printed for row in ROWS), [row for row in ROWS if not row.printed]
    assert len(ROWS) >= 25
    text = PAGE.read_text(encoding="utf-8")
    for number in range(1, 8):
        assert f"Eq {number}" in text
    for words in ("7.5", "< 15", "< 2.6", "< 5 %", "17", "34", "47", "1.04", "Table 1", "Table 2", "39"):
        assert words in text, words


def test_a_wrong_figure_would_be_found() -> None:
    (row,) = rows_of(f"| tables | 4.1 | `mean 8.3` | `{PROGRAM} tables` | why |")
    assert missing(row, "mean   8.3 (of the printed cells 4.1)") == []
    assert missing(row, "mean 8.4") == ["mean 8.3"]
    assert rows_of("| Eq 1 | as printed | `tables` |") == []
