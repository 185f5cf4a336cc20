"""`tradeoff`: measure the cost of accuracy on this machine."""

from __future__ import annotations

import importlib
import importlib.util
from typing import Final

import click

# name -> module under tactile_bayes.commands, imported when its command runs
_SUBCOMMANDS: Final = {"forward": "tradeoff_forward", "estimate": "tradeoff_estimate", "map": "tradeoff_map"}


class _Lazy(click.Group):
    """A group that imports a subcommand on first use."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        del ctx
        return [name for name, module in _SUBCOMMANDS.items() if importlib.util.find_spec(_path(module))]

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in self.list_commands(ctx):
            return None
        found = importlib.import_module(_path(_SUBCOMMANDS[cmd_name])).command
        assert isinstance(found, click.Command)
        return found


def _path(module: str) -> str:
    return f"tactile_bayes.commands.{module}"


@click.group("tradeoff", cls=_Lazy)
def command() -> None:
    """Measure what more accuracy costs on this machine, and which of it a case does not need."""
