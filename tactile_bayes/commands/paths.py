"""Paths on the command line: an output may be neither an input nor another output of the same command."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Final

import click

from tactile_bayes.errors import UsageError
from tactile_bayes.files.file_names import Format, check_suffix, same_file

WRITTEN: Final = frozenset(
    {"output", "figure", "map_figure", "fit_figure", "figures", "html", "pdf", "trace", "rank", "corner", "dictionary"}
)
"""The options that name what a command writes; every other path is read."""
_SEEN: Final = "tactile_bayes.paths"


class FilePath(click.Path):
    """Path that is checked against the other paths of the call before the command runs.

    Symbolic and hard links to one file are that file.

    Parameters
    ----------
    addresses
        Whether the address of an object store may stand instead; it stays a text.
    writes
        Format of the output that it names; a suffix of another one is refused.
    """

    def __init__(self, *, addresses: bool = False, writes: Format | None = None) -> None:
        super().__init__(path_type=Path, readable=False)  # its reader says it in one line
        self._addresses, self._writes = addresses, writes

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Record and return the path.

        Raises
        ------
        UsageError
            When it is written and another argument of the command reads or writes it, or it has the suffix of another
            format.
        """
        if self._addresses and "://" in str(value):
            return str(value)
        path = Path(os.fsdecode(super().convert(value, param, ctx)))
        if ctx is not None and param is not None:
            written = param.name in WRITTEN
            seen: list[tuple[Path, bool]] = ctx.meta.setdefault(_SEEN, [])
            for other, other_written in seen:
                if written and other_written:
                    refuse_same([path], [other], what="two outputs of this command")
                elif written or other_written:
                    refuse_same([path], [other])
            seen.append((path, written))
        if self._writes is not None:
            check_suffix(path, self._writes)
        return path


def also_read(*paths: Path | None) -> None:
    """Refuse the call if it would overwrite one of these further inputs.

    Raises
    ------
    UsageError
        When one of its outputs is one of them.
    """
    context = click.get_current_context(silent=True)
    seen: list[tuple[Path, bool]] = [] if context is None else context.meta.get(_SEEN, [])
    refuse_same([path for path, written in seen if written], [path for path in paths if path is not None])


def refuse_same(
    outputs: Iterable[Path | None], inputs: Iterable[Path], *, what: str = "an input of this command"
) -> None:
    """Refuse an output that is the same file as an input, under any name.

    Parameters
    ----------
    outputs
        None where there is none.
    what
        What the file is besides, for the error.
    """
    read = list(inputs)
    for path in outputs:
        if path is not None and any(same_file(path, one) for one in read):
            raise UsageError(f"{path} is {what}; choose another name for the output")
