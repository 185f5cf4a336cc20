"""The exit codes that no other test brings about: interrupted, and the table of all of them."""

from __future__ import annotations

import signal
import subprocess
import sys
from contextlib import suppress
from importlib import import_module
from pathlib import Path

import pytest
from in_process import run_here

from tactile_bayes import errors
from tactile_bayes.__main__ import main as start
from tactile_bayes.cli import GROUPS, main
from tactile_bayes.shell import interrupt_on_signals
from tests.conftest import ROOT

INTERRUPTED = """
import os, signal, sys, threading
from tactile_bayes.cli import main
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background job is born with it ignored
signal.signal(signal.SIGHUP, signal.SIG_DFL)  # so is what nohup starts
sys.argv = ["tactile-bayes", "calibrate", "size", {table!r}, "-o", {output!r}]
threading.Timer({after}, lambda: os.kill(os.getpid(), {number})).start()
main()
"""


def interrupt(output: Path, *, after: float, number: int = signal.SIGINT) -> subprocess.CompletedProcess[str]:
    table = str(ROOT / "tactile_bayes" / "demo" / "phantoms.csv")
    code = INTERRUPTED.format(table=table, output=str(output), after=after, number=int(number))
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, cwd=ROOT)


@pytest.mark.long
def test_ctrl_c_ends_with_130_one_line_and_nothing_left(tmp_path: Path) -> None:
    """A calibration takes seconds; Ctrl-C comes while it imports and while it samples."""
    for after in (0.3, 2.5, 3.5):
        done = interrupt(tmp_path / "size.json", after=after)
        if after > 0.3 and done.returncode == errors.EXIT_DONE:  # a machine that was faster than the signal
            (tmp_path / "size.json").unlink()
            continue
        assert done.returncode == errors.EXIT_INTERRUPTED
        assert done.stderr.splitlines()[-1] == "interrupted"
        assert "Traceback" not in done.stderr
        assert done.stdout == ""
        assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_signal_to_end_ends_as_ctrl_c_does(number: signal.Signals, tmp_path: Path) -> None:
    """`kill`, `timeout`, a batch system and a closed terminal; the process died of them without a line."""
    done = interrupt(tmp_path / "size.json", after=0.3, number=number)
    assert done.returncode == errors.EXIT_INTERRUPTED
    assert done.stderr.split() == ["interrupted"]
    assert list(tmp_path.iterdir()) == []


def test_an_interruption_that_an_import_swallows_ends_the_command(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Compiled modules do, while they are imported: the command went on to its end."""

    def swallow(name: str) -> object:
        with suppress(KeyboardInterrupt):
            signal.raise_signal(signal.SIGTERM)
        return import_module(name)

    monkeypatch.setattr("tactile_bayes.commands.options.import_module", swallow)
    done = run_here("devices", cwd=tmp_path)
    assert (done.returncode, done.stdout, done.stderr.split()) == (errors.EXIT_INTERRUPTED, "", ["interrupted"])


def test_ctrl_c_once_the_command_has_ended_leaves_its_exit_code() -> None:
    """A second one soon after the first ended `record` with -2."""
    code = (
        "import atexit, os, signal, sys\n"
        "from tactile_bayes.cli import main\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "atexit.register(lambda: os.kill(os.getpid(), signal.SIGINT))\n"
        "sys.argv = ['tactile-bayes', '--version']\n"
        "main()\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, cwd=ROOT)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize("before", [signal.default_int_handler, signal.SIG_IGN])
def test_ctrl_c_while_the_program_is_loaded_prints_no_traceback(monkeypatch: pytest.MonkeyPatch, before) -> None:
    """In the first 0.15 s of every command it did; where the signal is ignored, it stays so."""
    found, kept = [], signal.signal(signal.SIGINT, before)
    monkeypatch.setattr("tactile_bayes.cli.main", lambda: found.append(signal.getsignal(signal.SIGINT)))
    try:
        start()
    finally:
        signal.signal(signal.SIGINT, kept)
    assert found == [signal.SIG_IGN if before is signal.SIG_IGN else signal.SIG_DFL]


def test_what_nohup_ignores_stays_ignored() -> None:
    before = {number: signal.signal(number, signal.SIG_IGN) for number in (signal.SIGTERM, signal.SIGHUP)}
    try:
        with interrupt_on_signals():
            assert all(signal.getsignal(number) is signal.SIG_IGN for number in before)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (
            ("plan", "--map-sd", "nan"),
            "Invalid value for '--map-sd': 'nan' is not a number from 0 to 3; see `tactile-bayes plan --help`",
        ),
        (("calibrate", "size"), "Missing argument 'TABLE.csv'; see `tactile-bayes calibrate size --help`"),
        (
            ("plan", "--trials", "7"),
            "Invalid value for '--trials': '7' is not a whole number from 50 to 1000000; "
            "see `tactile-bayes plan --help`",
        ),
        (
            ("map", "scan.mcap", "-o", "-"),
            "Invalid value for '-o' / '--output': '-' (standard input or output) is not taken; "
            "give the name of a file or folder; see `tactile-bayes map --help`",
        ),
        (
            ("estimate", ""),
            "Invalid value for 'MAP.nc...': the path is empty; give the name of a file or folder; "
            "see `tactile-bayes estimate --help`",
        ),
        (
            ("campaign", "run", "exams.csv", "-o", "out", "--repeatability", ""),
            "Invalid value for '--repeatability': the path is empty; give the name of a file or folder; "
            "see `tactile-bayes campaign run --help`",
        ),
        (("mapp",), "No such command 'mapp'; did you mean map? See `tactile-bayes --help`"),
        (
            ("exam.mcap",),
            "No such command 'exam.mcap'; the command stands first: `tactile-bayes show FILE` says what a file is; "
            "see `tactile-bayes --help`",
        ),
        (
            ("plan", "--maps", "1,3"),
            "Invalid value for '--maps': '1,3' is not a whole number from 1 to 1000; repeat the option for each of "
            "several; see `tactile-bayes plan --help`",
        ),
    ],
)
def test_a_usage_error_is_one_line_without_the_usage(words: tuple[str, ...], said: str, tmp_path: Path) -> None:
    """They came with two lines of usage before the line that says what is wrong."""
    done = run_here(*words, cwd=tmp_path)
    assert (done.returncode, done.stdout, done.stderr) == (errors.EXIT_USAGE, "", f"error: {said}\n")


def test_windows_is_told_what_to_do_instead(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first command ended in a traceback: Windows has no SIGHUP."""
    monkeypatch.setattr(sys, "platform", "win32")
    with pytest.raises(SystemExit, match=r"Windows is not supported; .* in WSL"):
        main()


def test_no_words_at_all_are_answered_by_the_help(tmp_path: Path) -> None:
    done = run_here(cwd=tmp_path)
    assert all(f"{title}:\n" in done.stdout + done.stderr for title in GROUPS)


def test_every_error_has_a_documented_code() -> None:
    page = (ROOT / "docs" / "exit-codes.md").read_text(encoding="utf-8")
    codes = {value for name, value in vars(errors).items() if name.startswith("EXIT_")}
    kinds = {error.exit_code for error in errors.TactileBayesError.__subclasses__()}
    assert codes == {0, 1, 2, 3, 4, 5, 6, 130, 141}
    assert kinds <= codes
    for code in codes:
        assert f"| {code} |" in page
