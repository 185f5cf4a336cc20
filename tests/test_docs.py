"""The documents say what the program does: the reference is fresh, every example parses, marked ones run.

An example is a line beginning with ``$ `` in a fence whose first word is ``console``. With a second word ``run`` it is
also run: all of a page's in order and in one folder. A line may end in ``# exits 3``; otherwise it must end well.
"""

from __future__ import annotations

import importlib.util
import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import click
import pytest

from tactile_bayes import errors
from tactile_bayes.cli import COMMANDS, cli

ROOT = Path(__file__).resolve().parent.parent
DOCS = ROOT / "docs"
PAGES = sorted([*DOCS.glob("*.md"), *ROOT.glob("README.md")])
DECISIONS = sorted((DOCS / "decisions").glob("*.md"))
PROGRAM = "tactile-bayes"

_spec = importlib.util.spec_from_file_location("make_reference", DOCS / "make_reference.py")
assert _spec is not None
assert _spec.loader is not None
make_reference = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(make_reference)


@dataclass(frozen=True)
class Example:
    """One command line of a page."""

    page: Path
    line: int
    words: tuple[str, ...]
    runs: bool
    exit_code: int

    def __str__(self) -> str:
        return f"{self.page.name}:{self.line}"


def examples_of(page: Path) -> Iterator[Example]:
    """The program's command lines on a page; continued lines are joined."""
    fence, joined, start = "", "", 0
    for number, line in enumerate(page.read_text(encoding="utf-8").splitlines(), start=1):
        stripped = line.strip()
        if stripped.startswith("```"):
            fence = "" if fence else stripped[3:] or "text"
        elif fence.split()[:1] == ["console"] and (joined or stripped.startswith("$ ")):
            start = start if joined else number
            joined += " " + stripped.removeprefix("$ ").removesuffix("\\")
            if not stripped.endswith("\\"):
                yield from example(page, start, joined.strip(), runs="run" in fence.split())
                joined = ""


def example(page: Path, line: int, text: str, *, runs: bool) -> Iterator[Example]:
    exits = re.search(r"\s+# exits (\d+)$", text)
    code = int(exits[1]) if exits else 0
    words = shlex.split(text[: exits.start()] if exits else text, comments=True)
    if words and words[0] == PROGRAM:
        yield Example(page, line, tuple(words[1:]), runs, code)
    elif runs:
        raise AssertionError(f"{page.name}:{line}: only {PROGRAM} can be run here ({text})")


EXAMPLES = [found for page in PAGES for found in examples_of(page)]
RUN_PAGES = sorted({found.page for found in EXAMPLES if found.runs})


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


def all_commands() -> list[tuple[tuple[str, ...], click.Command]]:
    return list(make_reference.every_command(cli))


def test_the_reference_is_fresh():
    written = (DOCS / "commands.md").read_text(encoding="utf-8")
    assert written == make_reference.render(cli), "run `make docs`"


def test_every_command_is_documented_with_every_option():
    written = (DOCS / "commands.md").read_text(encoding="utf-8")
    assert {words[0] for words, _ in all_commands()} == set(COMMANDS)
    for words, command in all_commands():
        section = written.split(f"## {PROGRAM} {' '.join(words)}\n")[1].split("\n## ")[0]
        for parameter in command.params:
            assert all(f"`{name}`" in section for name in parameter.opts if name.startswith("-")), parameter.name


def test_every_command_and_option_has_a_help():
    silent = [" ".join(words) for words, command in all_commands() if not command.help]
    silent += [
        f"{' '.join(words)} {parameter.opts[0]}"
        for words, command in all_commands()
        for parameter in command.params
        if isinstance(parameter, click.Option) and not parameter.help
    ]
    assert silent == []


@pytest.mark.parametrize("found", EXAMPLES, ids=str)
def test_an_example_parses(found):
    check_words(found.words)


def test_examples_in_the_help_parse():
    for words, command in all_commands():
        for text in re.findall(rf"{PROGRAM} [^\n`]+", command.help or ""):
            try:
                check_words(tuple(shlex.split(text.strip().removesuffix("."))[1:]))
            except click.ClickException as error:
                pytest.fail(f"help of {' '.join(words)}: {text!r}: {error.format_message()}")


@pytest.mark.parametrize("words", ["nothing", "map --no-such-option", "map scan.mcap", "map a -o b --normalise twice"])
def test_a_wrong_example_would_be_found(words):
    with pytest.raises(click.UsageError):
        check_words(tuple(words.split()))


def test_examples_are_found_with_their_marks(tmp_path):
    page = tmp_path / "page.md"
    page.write_text(
        "```console run\n$ tactile-bayes map a.mcap \\\n    -o b.nc  # exits 3\nsome output\n```\n"
        "```sh\n$ tactile-bayes no\n```\n```console\n$ cat b\n$ tactile-bayes show b.nc\n```\n"
    )
    found = list(examples_of(page))
    assert [(one.line, one.words, one.runs, one.exit_code) for one in found] == [
        (2, ("map", "a.mcap", "-o", "b.nc"), True, 3),
        (11, ("show", "b.nc"), False, 0),
    ]


@pytest.mark.parametrize("page", RUN_PAGES, ids=lambda page: page.name)
def test_the_marked_examples_of_a_page_run(page, run_cli, tmp_path):
    for found in (one for one in EXAMPLES if one.page == page and one.runs):
        ended = run_cli(*found.words, cwd=tmp_path)
        assert ended.returncode == found.exit_code, f"{found}: {ended.stderr}"


@pytest.mark.parametrize("page", [*PAGES, *DECISIONS], ids=lambda page: page.name)
def test_links_lead_somewhere(page):
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    links = [link for link in re.findall(r"\]\(([^)\s]+)\)", text) if not re.match(r"[a-z]+:|#", link)]
    assert [link for link in links if not (page.parent / link.split("#")[0]).exists()] == []


def test_the_exit_codes_are_those_of_the_program():
    rows = re.findall(r"^\| (\d+) \|", (DOCS / "exit-codes.md").read_text(encoding="utf-8"), flags=re.MULTILINE)
    codes = {value for name, value in vars(errors).items() if name.startswith("EXIT_")}
    assert {int(row) for row in rows} == codes | {errors.TactileBayesError.exit_code}


@pytest.mark.parametrize("page", DECISIONS, ids=lambda page: page.name)
def test_a_decision_record_has_its_four_parts(page):
    text = page.read_text(encoding="utf-8")
    assert re.match(rf"# {page.name[:4]} \S", text)
    parts = re.findall(r"^## (.+)$", text, flags=re.MULTILINE)
    assert parts == ["Context", "Decision", "Figures", "Consequences"]


def test_decision_records_are_numbered_once():
    numbers = [page.name[:4] for page in DECISIONS]
    assert len(set(numbers)) == len(numbers)
    assert numbers[0] == "0001"


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_is_documented_and_prints_a_script(shell, run_cli):
    assert f"_TACTILE_BAYES_COMPLETE={shell}_source {PROGRAM}" in (DOCS / "completion.md").read_text(encoding="utf-8")
    printed = run_cli(env={"_TACTILE_BAYES_COMPLETE": f"{shell}_source"})
    assert printed.returncode == 0, printed.stderr
    assert f"_TACTILE_BAYES_COMPLETE={shell}_complete" in printed.stdout


@pytest.mark.parametrize(
    ("words", "wanted"),
    [
        (f"{PROGRAM} est", "estimate"),
        (f"{PROGRAM} map --norm", "--normalise"),
        (f"{PROGRAM} map --normalise ga", "gain"),
    ],
)
def test_tab_completes_commands_options_and_choices(words, wanted, run_cli):
    asked = {"_TACTILE_BAYES_COMPLETE": "bash_complete", "COMP_WORDS": words, "COMP_CWORD": str(len(words.split()) - 1)}
    completed = run_cli(env=asked)
    assert completed.returncode == 0, completed.stderr
    assert completed.stdout.split() == [f"plain,{wanted}"]
