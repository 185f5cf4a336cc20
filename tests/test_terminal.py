"""What a terminal shows: lines that fit its width, the verdict and the size in bold, cautions coloured; pipes plain."""

from __future__ import annotations

import fcntl
import os
import pty
import re
import struct
import subprocess
import sys
import termios
from contextlib import suppress
from pathlib import Path

import pytest

import tactile_bayes as tb
from tactile_bayes.findings import LEADS
from tactile_bayes.shell import STYLES, fit_terminal, padded, text_width

ESCAPES = re.compile(r"\x1b\[[0-9;]*m")
SENTENCE = "What would narrow it: more exams of this mass, pooled (estimate --pool); the depth of the lump."


def on_a_terminal(*words: str, columns: int, environment: dict[str, str], cwd: Path, **further: str) -> tuple[str, int]:
    """What a command shows on a terminal of that many columns, standard error with it, and its exit code."""
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 50, columns, 0, 0))
    kept = {name: value for name, value in environment.items() if name not in ("COLUMNS", "NO_COLOR")}
    process = subprocess.Popen(
        [sys.executable, "-m", "tactile_bayes", *words],
        stdin=theirs,
        stdout=theirs,
        stderr=theirs,
        cwd=cwd,
        env={**kept, "TERM": "xterm", **further},
    )
    os.close(theirs)
    shown = b""
    with suppress(OSError):  # the terminal is closed
        while part := os.read(ours, 65536):
            shown += part
    os.close(ours)
    return shown.decode().replace("\r\n", "\n"), process.wait()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    tb.demo_map().save(tmp_path / "map.nc")
    return tmp_path


@pytest.mark.parametrize("columns", [40, 60, 80, 120])
def test_a_line_breaks_between_words_and_loses_none(columns):
    lines = fit_terminal(SENTENCE, columns=columns, styles=False).split("\n")
    assert all(len(line) <= columns for line in lines)
    assert " ".join(line.strip() for line in lines) == SENTENCE
    assert all(line.startswith("  ") and line[2] != " " for line in lines[1:])


def test_the_text_of_a_row_stays_in_its_column():
    row = f"skin            curved by -0.7 per m{' along the path' * 5}"
    first, second = fit_terminal(row, columns=80, styles=False).split("\n")
    assert first.startswith("skin            curved")
    assert re.match(r" {16}\S", second)


def test_wide_letters_take_two_columns_and_those_on_others_none():
    assert [text_width(text) for text in ("左乳", "gauche", "e\u0301", "")] == [4, 6, 1, 0]
    assert padded("左乳", 6) == "左乳  "
    row = f"左乳  {'左乳 ' * 20}"
    lines = fit_terminal(row, columns=40, styles=False).split("\n")
    assert all(text_width(line) <= 40 for line in lines)
    assert all(line.startswith(" " * 6) and line[6] == "左" for line in lines[1:])
    assert "".join("".join(lines).split()) == "左乳" * 21


def test_a_number_keeps_its_unit():
    line = "overlapping frames agree to within " + "1.4 % and 3 mm, " * 12
    for columns in range(40, 60):
        shown = fit_terminal(line, columns=columns, styles=False)
        assert not re.search(r"\d\n *(%|mm)", shown)
        assert "\x1f" not in shown


@pytest.mark.parametrize(
    "text",
    ["a" * 200, '{"caution": "' + "a word " * 30 + '"}\n', '[\n  {"a": "' + "b c " * 40 + '"}\n]\n', "short\n\n", ""],
    ids=["one word", "an object", "a list", "short lines", "nothing"],
)
def test_what_has_no_place_to_break_or_is_for_programs_stays(text):
    assert fit_terminal(text, columns=80, styles=True) == text


def test_a_command_that_goes_on_can_be_pasted():
    line = "$ tactile-bayes map demo/scan.mcap -o a_folder_with_a_name/map.nc --figure a_folder_with_a_name/map.png"
    shown = fit_terminal(line, columns=60, styles=False)
    assert all(len(one) <= 60 for one in shown.split("\n"))
    assert shown.replace("\\\n", "").split() == line.split()


def test_a_terminal_without_a_size_gets_the_text_as_it_is():
    assert fit_terminal(SENTENCE, columns=0, styles=True) == SENTENCE


def test_every_lead_of_a_finding_has_a_style():
    assert set(LEADS.values()) <= {lead for leads in STYLES.values() for lead in leads}
    wrapped = fit_terminal(f"CAUTION: {SENTENCE}", columns=40, styles=True)
    assert ESCAPES.sub("", wrapped) == fit_terminal(f"CAUTION: {SENTENCE}", columns=40, styles=False)
    assert all(line.startswith("\x1b[33m") and line.endswith("\x1b[0m") for line in wrapped.split("\n"))


@pytest.mark.long
@pytest.mark.parametrize("columns", [80, 120])
def test_an_estimate_fits_a_terminal_and_its_size_is_bold(columns, folder, child_environment):
    words = ("estimate", "map.nc", "--method", "laplace")
    shown, code = on_a_terminal(*words, columns=columns, environment=child_environment, cwd=folder)
    assert code == 0
    lines = shown.splitlines()
    assert all(len(ESCAPES.sub("", line)) <= columns for line in lines)
    bold = [ESCAPES.sub("", line) for line in lines if line.startswith("\x1b[1m")]
    assert [line.split("  ")[0] for line in bold] == ["largest size"]
    piped = subprocess.run(
        [sys.executable, "-m", "tactile_bayes", *words],
        cwd=folder,
        env=child_environment,
        capture_output=True,
        text=True,
    ).stdout
    assert " ".join(ESCAPES.sub("", shown).split()) == " ".join(piped.split())
    assert "\x1b" not in piped
    assert max(map(len, piped.splitlines())) > 120


@pytest.mark.long
@pytest.mark.parametrize(
    ("words", "paragraph"),
    [
        ((), "  Start with `tactile-bayes demo`; the\n  way through is import, map,\n  estimate, report.\n"),
        (("estimate",), "  Estimate a lump's size from tactile\n  maps, with a credible interval.\n"),
    ],
)
def test_help_fits_a_narrow_terminal(words, paragraph, folder, child_environment):
    """Its lines were made for 50 columns, and each was broken again."""
    shown, code = on_a_terminal(*words, "--help", columns=40, environment=child_environment, cwd=folder)
    assert code == 0
    assert paragraph in shown
    assert all(len(line) <= 40 or " " not in line.strip() for line in shown.splitlines())  # a long word is not cut


def test_no_color_is_plain_and_errors_are_red(folder, child_environment):
    words, named = ("show", "none.nc"), {"environment": child_environment, "cwd": folder, "columns": 80}
    plain, code = on_a_terminal(*words, **named, NO_COLOR="1")
    coloured, _ = on_a_terminal(*words, **named)
    dumb, _ = on_a_terminal(*words, **{**named, "environment": child_environment | {}}, TERM="dumb")
    assert code == 3
    assert plain.startswith("error: none.nc")
    assert dumb == plain
    assert coloured.startswith("\x1b[31merror: none.nc")
    assert ESCAPES.sub("", coloured) == plain


def test_control_characters_of_a_file_name_reach_no_terminal(folder, child_environment):
    shown, code = on_a_terminal("show", "a\x1b[2Jb.nc", columns=80, environment=child_environment, cwd=folder)
    assert code == 3
    assert "\\x1b[2J" in shown
    assert "\x1b[2J" not in shown
