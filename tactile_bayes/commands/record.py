"""`record`: a scan head and a tracker into a scan file."""

from __future__ import annotations

from typing import Any

import click

from tactile_bayes.commands.options import FORCE, FilePath, live_options, takes
from tactile_bayes.declarations import names_of
from tactile_bayes.options import RecordOptions

ON_THE_COMMAND_LINE = names_of(RecordOptions)[2:-4]
"""Between the output with the head's port and the options of the live view."""


@click.command("record")
@click.option(
    "-o", "--output", required=True, metavar="SCAN.mcap", type=FilePath(writes="MCAP"), help="Scan file to write."
)
@click.option("--head", "head_url", required=True, metavar="URL", help="Port of the scan head.")
@takes(RecordOptions, *ON_THE_COMMAND_LINE)
@live_options
@FORCE
@click.pass_context
def command(ctx: click.Context, /, **given: Any) -> None:
    """Record a scan head and a tracker.

    On a terminal, `n` and `x` touch the sternal notch and the xiphoid, space starts, `q` or Ctrl-C stops; with
    --duration or --at-once, or without a terminal, recording starts at once. The file can be read at any moment: a
    kill costs at most the last fraction of a second, and `repair` closes what was cut off.

    Example: tactile-bayes record -o scan.mcap --head /dev/ttyACM0 --tracker /dev/ttyUSB0 --like last.mcap
    """
    from tactile_bayes.actions.record import record_action

    record_action(ctx, **given)
