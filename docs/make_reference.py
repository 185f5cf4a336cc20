"""Write schemas, docs/commands.md and docs/columns-and-keys.md from the program: `python docs/make_reference.py`."""

from __future__ import annotations

import inspect
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click

from tactile_bayes.errors import number_words

ROOT = Path(__file__).resolve().parent.parent
COMMANDS_PAGE = ROOT / "docs" / "commands.md"
SCHEMAS_PAGE = ROOT / "docs" / "columns-and-keys.md"
PROGRAM = "tactile-bayes"

HEAD = """\
# Command reference

Generated from the program by `python docs/make_reference.py`; a test holds the two together. What the exit codes
mean is in [exit codes](exit-codes.md), how to complete words in the shell in
[complete with Tab](guides/complete-with-tab.md). Every command also takes `-h` or `--help`.
"""


def every_command(group: click.Group, words: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], click.Command]]:
    """All commands below a group with the words that call them, in the order of the help, each group first."""
    context = click.Context(group)
    for name in group.list_commands(context):
        command = group.get_command(context, name)
        assert command is not None, name
        yield (*words, name), command
        if isinstance(command, click.Group):
            yield from every_command(command, (*words, name))


def render(group: click.Group) -> str:
    """The whole page."""
    sections = [HEAD, _contents(group)]
    sections += [_section(words, command) for words, command in every_command(group)]
    return "\n".join(sections)


def _contents(group: click.Group) -> str:
    names = [" ".join((PROGRAM, *words)) for words, _ in every_command(group)]
    return "".join(f"- [{name}](#{name.replace(' ', '-')})\n" for name in names)


def _section(words: tuple[str, ...], command: click.Command) -> str:
    call = " ".join((PROGRAM, *words))
    context = click.Context(command, info_name=call)
    usage = " ".join([call, *command.collect_usage_pieces(context)])
    help_text = inspect.cleandoc(command.help or "").replace("\b\n", "").split("\f")[0].strip()
    parts = [f"## {call}\n", f"```text\n{usage}\n```\n", f"{help_text}\n"]
    rows = [_row(parameter) for parameter in command.params if isinstance(parameter, click.Option)]
    if rows:
        parts.append("| option | value | default | meaning |\n|---|---|---|---|\n" + "".join(rows))
    return "\n".join(parts)


def _row(option: click.Option) -> str:
    facts = option.to_info_dict()
    names = ", ".join(f"`{name}`" for name in (*facts["opts"], *facts["secondary_opts"]))
    cells = (names, _value(option, facts), _default(facts), facts["help"] or "")
    return "| " + " | ".join(cell.replace("|", "\\|").replace("\n", " ") for cell in cells) + " |\n"


def _value(option: click.Option, facts: dict[str, Any]) -> str:
    if facts["is_flag"] or facts["count"]:
        return ""
    kind = option.type
    text = option.metavar
    if not text and isinstance(kind, click.Choice):
        text = " or ".join(map(str, kind.choices))
    elif not text and isinstance(kind, click.FloatRange | click.IntRange):
        open_ends = [end for end in ("min", "max") if getattr(kind, f"{end}_open")]
        text = number_words(kind.min, kind.max, open_ends, whole=isinstance(kind, click.IntRange)).removeprefix("a ")
    text = text or facts["type"]["name"].upper()
    return f"{text}, repeatable" if facts["multiple"] else text


def _default(facts: dict[str, Any]) -> str:
    if facts["required"]:
        return "required"
    value = facts["default"]
    if value is None or value is False or value == () or callable(value):
        return ""
    return " ".join(map(str, value)) if isinstance(value, tuple | list) else str(value)


def pages() -> dict[Path, str]:
    """What each generated schema and page has to hold."""
    sys.path[:0] = [str(ROOT), str(ROOT / "docs")]
    from make_schema_page import render_schemas
    from make_schemas import schemas

    from tactile_bayes.cli import cli

    generated = schemas()
    return {**generated, COMMANDS_PAGE: render(cli), SCHEMAS_PAGE: render_schemas(generated)}


def main() -> None:
    """Write the pages, or say with ``--check`` whether they are up to date."""
    if "--check" in sys.argv[1:]:
        sys.exit(0 if all(path.is_file() and path.read_text("utf-8") == text for path, text in pages().items()) else 1)
    for path, text in pages().items():
        path.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
