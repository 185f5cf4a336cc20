"""Options that have moved to a settings file: using one prints where it is now."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import click

from tactile_bayes.errors import UsageError


class MovedOptions(click.Command):
    """A command with options that have moved.

    Parameters
    ----------
    moved
        What to give instead, by option.
    """

    def __init__(self, *args: Any, moved: Mapping[str, str], **more: Any) -> None:
        super().__init__(*args, **more)
        self._moved = moved

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parse the command line.

        Raises
        ------
        UsageError
            When it has an option that has moved.
        """
        try:
            return super().parse_args(ctx, args)
        except click.NoSuchOption as error:
            if error.option_name in self._moved:
                raise UsageError(f"{error.option_name} has moved; {self._moved[error.option_name]}") from None
            raise
