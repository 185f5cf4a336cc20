"""A command with groups of files: what follows ``--with`` up to the next option is one group."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import click

WITH: Final = "--with"


class VisitsCommand(click.Command):
    """A command whose option ``--with`` takes several files, as often as it is given.

    The option's value is a pair, the group's number and one file: ``--with a b`` is parsed as
    ``--with 1 a --with 1 b``.
    """

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parse the command line."""
        return super().parse_args(ctx, numbered(args))


def numbered(args: Sequence[str]) -> list[str]:
    """The words with every file after ``--with`` as an option of its own, with the number of its group.

    A ``--with`` that no file follows stays as it is, and click says what it lacks.
    """
    found: list[str] = []
    group, inside, alone = 0, False, False
    for word in args:
        if word == WITH:
            found += [WITH] if alone else []
            group, inside, alone = group + 1, True, True
        elif inside and not (word.startswith("-") and len(word) > 1):
            found += [WITH, str(group), word]
            alone = False
        else:
            found += [WITH, word] if alone else [word]
            inside = alone = False
    return [*found, WITH] if alone else found


def groups_of(later: Sequence[tuple[int, Path]]) -> list[tuple[Path, ...]]:
    """Files of each group, in the order of the groups."""
    found: dict[int, list[Path]] = {}
    for number, path in later:
        found.setdefault(number, []).append(path)
    return [tuple(found[number]) for number in sorted(found)]
