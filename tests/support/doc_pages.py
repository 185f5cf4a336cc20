"""The code blocks of a page of the documents, and a folder in which they run in order, as a reader would run them.

What a block is, its first line (the fence) says:

- ``console``: lines that begin with ``$ `` are commands; the lines below one are what it prints, in part where a line
  is ``...``. A command may end in ``# exits 3``; otherwise it must end well.
- ``sh``: every line is a command.
- ``python``: runs in this process; a page's blocks share their names.
- any language and a file name, such as ``toml protocol.toml``: the block is that file.
- ``console`` or ``sh`` and a word of `NOT_RUN`: the block is checked for what the program understands, but not run.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import click
from in_process import run_here

from tactile_bayes.cli import cli

PROGRAM = "tactile-bayes"
NOT_RUN = {
    "device": "needs a scan head, a tracker or a bladder on a port",
    "by-hand": "needs two terminals and a key; tests/hardware/test_recording_by_hand.py runs it with both",
    "setup": "makes an environment with pip; .ci/run does it",
    "browser": "needs Chromium or WeasyPrint; tests/report/test_exam_page.py prints with one",
    "long": "takes a quarter of a minute of CPU or more; tests of the command run a smaller one",
}
"""Why a block may be left out of the tests."""
_SHELL = re.compile(r"[|<>;&$]|^\w+=")


def check_words(words: tuple[str, ...]) -> None:
    """Raise unless the program would understand the words (files need not exist)."""
    command: click.Command = cli
    rest = list(words)
    while isinstance(command, click.Group) and rest and not rest[0].startswith("-"):
        name = rest.pop(0)
        found = command.get_command(click.Context(command), name)
        if found is None:
            raise click.UsageError(f"no command {name!r}")
        command = found
    if {"-h", "--help", "--version"} & set(rest):
        return
    context = click.Context(command, help_option_names=["-h", "--help"])
    values, left, given = command.make_parser(context).parse_args(rest)
    if left and not isinstance(command, click.Group):
        raise click.UsageError(f"left over: {left}")
    for parameter in command.params:
        if parameter.required and not (parameter in given and values.get(parameter.name)):
            raise click.UsageError(f"{parameter.name} is missing")
        if isinstance(parameter.type, click.Choice) and isinstance(values.get(parameter.name), str):
            parameter.type.convert(values[parameter.name], parameter, context)


@dataclass(frozen=True)
class Command:
    """One command line of a page, with what the page says that it prints."""

    page: Path
    line: int
    text: str
    exit_code: int
    mark: str
    printed: tuple[str, ...] = ()

    @property
    def words(self) -> tuple[str, ...]:
        """As a shell splits the line."""
        return tuple(shlex.split(self.text))

    @property
    def is_program(self) -> bool:
        """Whether it calls the program, and nothing else."""
        return self.words[:1] == (PROGRAM,) and not _SHELL.search(self.text)

    def __str__(self) -> str:
        return f"{self.page.name}:{self.line}"


@dataclass(frozen=True)
class Block:
    """One fenced block of a page."""

    page: Path
    line: int
    language: str
    note: str
    lines: tuple[str, ...]

    @property
    def text(self) -> str:
        """All of its lines."""
        return "".join(f"{line}\n" for line in self.lines)

    @property
    def file_name(self) -> str:
        """The file that this block is; empty where it is none."""
        return self.note if "." in self.note else ""

    def commands(self) -> Iterator[Command]:
        """Its command lines; continued ones are joined."""
        if self.language not in ("console", "sh"):
            return
        assert self.note in ("", *NOT_RUN), f"{self.page.name}:{self.line}: {self.note} is none of {sorted(NOT_RUN)}"
        prompt = "$ " if self.language == "console" else ""
        found: list[tuple[int, str, list[str]]] = []
        goes_on = False
        for number, line in enumerate(self.lines, start=self.line + 1):
            if goes_on:
                found[-1] = (found[-1][0], f"{found[-1][1]} {line.strip().removesuffix(chr(92)).strip()}", [])
            elif line.startswith(prompt) and line.strip():
                found.append((number, line.removeprefix(prompt).removesuffix(chr(92)).strip(), []))
            elif found and line.strip():
                found[-1][2].append(line.rstrip())
                continue
            goes_on = line.endswith(chr(92))
        for number, text, printed in found:
            exits = re.search(r"\s+# exits (\d+)$", text)
            code = int(exits[1]) if exits else 0
            yield Command(self.page, number, text[: exits.start()] if exits else text, code, self.note, tuple(printed))


def blocks_of(page: Path) -> Iterator[Block]:
    """The fenced blocks of a page; directives of the site, such as tables of contents, are none."""
    start, info, lines = 0, "", list[str]()
    for number, line in enumerate(page.read_text(encoding="utf-8").splitlines(), start=1):
        if not line.startswith("```"):
            lines.append(line)
        elif not start:
            start, info, lines = number, line[3:].strip(), []
        else:
            language, _, note = info.partition(" ")
            if not language.startswith("{"):
                yield Block(page, start, language, note, tuple(lines))
            start = 0
    assert not start, f"{page.name}:{start}: the block has no end"


def commands_of(page: Path) -> list[Command]:
    """All command lines of a page."""
    return [command for block in blocks_of(page) for command in block.commands()]


@dataclass
class Reader:
    """Somebody who types what a page says, in a folder of their own.

    Parameters
    ----------
    folder
        Empty at first.
    demos
        Where the demo's folder is kept for the other pages and for other processes of the same test run.
    """

    folder: Path
    demos: Path
    names: dict[str, Any] = field(default_factory=dict)

    def follow(self, page: Path) -> None:
        """Run the page's blocks in order.

        Raises
        ------
        AssertionError
            Naming the page and the line at which something is not as it says.
        """
        for block in blocks_of(page):
            if block.file_name:
                (self.folder / block.file_name).write_text(block.text, encoding="utf-8")
            elif block.language == "python":
                self.run_python(block)
            for command in block.commands():
                if not command.mark:
                    self.look_at(command, *self.run(command))

    def run_python(self, block: Block) -> None:
        """Run a block of Python in the folder."""
        with contextlib.chdir(self.folder):
            exec(compile(block.text, f"{block.page.name}:{block.line}", "exec"), self.names)

    def run(self, command: Command) -> tuple[int, str, str]:
        """Run one command line: its exit code, and what it prints on stdout and stderr."""
        if command.words[:2] == (PROGRAM, "demo"):
            return self._demo(command)
        if command.is_program:
            done = run_here(*command.words[1:], cwd=self.folder)
            return done.returncode, done.stdout, done.stderr
        return self._shell(command.text)

    def look_at(self, command: Command, code: int, out: str, err: str) -> None:
        """Hold what a command did against what the page says of it."""
        assert code == command.exit_code, f"{command}: ended with {code}: {err}"
        missing = not_printed(command.printed, out + err)
        assert not missing, f"{command}: {command.text} does not print {missing!r}, but\n{out}{err}"

    def _shell(self, text: str) -> tuple[int, str, str]:
        """Run a line in bash, with the program on the path and the folder as home."""
        tools = self.demos / "bin"
        tools.mkdir(parents=True, exist_ok=True)
        program = tools / PROGRAM
        program.write_text(f'#!/bin/sh\nexec {shlex.quote(sys.executable)} -m tactile_bayes "$@"\n')
        program.chmod(0o755)
        root = str(Path(__file__).resolve().parents[2])
        environment = dict(os.environ) | {"HOME": str(self.folder), "PYTHONPATH": root}
        environment["PATH"] = f"{tools}{os.pathsep}{environment['PATH']}"
        done = subprocess.run(
            ["bash", "-c", text], cwd=self.folder, env=environment, capture_output=True, text=True, check=False
        )
        return done.returncode, done.stdout, done.stderr

    def _demo(self, command: Command) -> tuple[int, str, str]:
        """The demo, run by the first page that asks for it."""
        kept = self.demos / "_".join(command.words[1:]).replace("/", "_")
        kept.mkdir(parents=True, exist_ok=True)
        printed = kept / "printed.txt"
        with (kept / "lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not printed.exists():
                done = run_here(*command.words[1:], cwd=kept)
                assert done.returncode == 0, f"{command}: {done.stderr}"
                printed.write_text(done.stdout, encoding="utf-8")
        shutil.copytree(kept, self.folder, dirs_exist_ok=True, ignore=shutil.ignore_patterns("lock", "printed.txt"))
        return 0, printed.read_text(encoding="utf-8"), ""


def not_printed(wanted: tuple[str, ...], printed: str) -> str:
    """The first line of a page's output that is not printed after those before it; empty if all are."""
    lines = iter(line.rstrip() for line in printed.splitlines())
    for line in wanted:
        if line.strip() != "..." and line not in lines:
            return line
    return ""
