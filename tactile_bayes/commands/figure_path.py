"""Options that name a figure to write."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import click

METAVAR: Final = "FIG.png|.pdf|.svg"


class FigurePath(click.Path):
    """A path whose suffix says how the figure is written; another suffix is refused before any work."""

    def __init__(self) -> None:
        super().__init__(path_type=Path)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """The path, with a suffix that is known."""
        from tactile_bayes.report.figure_file import check_suffix

        path = Path(str(super().convert(value, param, ctx)))
        check_suffix(path)
        return path
