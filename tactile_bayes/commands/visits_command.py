"""A command with groups of files: what follows ``--with`` up to the next option is one group."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import click

from tactile_bayes.errors import UsageError

WITH: Final = "--with"


class VisitsCommand(click.Command):
    """A command whose option ``--with`` takes several files, as often as it is given.

    The option's value is a pair, the group's number and one file: ``--with a b`` is parsed as
    ``--with 1 a --with 1 b``.
    """

    def make_parser(self, ctx: click.Context) -> Any:
        """Make the parser of the command line."""
        parser = super().make_parser(ctx)
        parse = parser.parse_args
        parser.parse_args = lambda args: parse(numbered(args, strict=not ctx.resilient_parsing))  # type: ignore[method-assign]
        return parser


def numbered(args: Sequence[str], *, strict: bool = True) -> list[str]:
    """The words with every file after ``--with`` as an option of its own, with the number of its group.

    Parameters
    ----------
    strict
        Refuse a ``--with`` that no file follows; a shell that completes words leaves it out.

    Raises
    ------
    UsageError
        When no file follows a ``--with``, and `strict`.
    """
    found: list[str] = []
    group, files = 0, -1  # files of the group so far; -1 outside one
    for word in [*args, ""]:
        if files >= 0 and word and not word.startswith("-"):
            found += [WITH, str(group), word]
            files += 1
            continue
        if files == 0 and strict:
            raise UsageError(f"{WITH} names no map; give the maps of a later visit after it")
        group, files = (group + 1, 0) if word == WITH else (group, -1)
        found += [word] if word not in (WITH, "") else []
    return found


def groups_of(later: Sequence[tuple[int, Path]]) -> list[tuple[Path, ...]]:
    """Files of each group, in the order of the groups."""
    found: dict[int, list[Path]] = {}
    for number, path in later:
        found.setdefault(number, []).append(path)
    return [tuple(found[number]) for number in sorted(found)]
