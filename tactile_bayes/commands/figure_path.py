"""Options that name a figure to write."""

from __future__ import annotations

from typing import Any, Final

import click

from tactile_bayes.commands.paths import FilePath

METAVAR: Final = "FIG.png|.pdf|.svg"


class FigurePath(FilePath):
    """Path of a figure; an unknown suffix is refused before any work."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Check the suffix and return the path."""
        from tactile_bayes.report.figure_file import check_suffix

        path = super().convert(value, param, ctx)
        check_suffix(path)
        return path
