"""Options of the trade-offs, and the CPU time of a command in a process of its own."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from tactile_bayes.commands.options import FiniteRange

if TYPE_CHECKING:
    from tactile_bayes.studies.estimate_tradeoff import Ladder


# --- CPU time of this program in a process of its own: what a user who types one command waits for.

TIMES = 2


def fresh_cpu_s(words: Sequence[str]) -> float | None:
    """Least CPU seconds of a command in a fresh process; None where the system does not tell them.

    Parameters
    ----------
    words
        Of the command, without the program's name.
    """
    spent = []
    for _ in range(TIMES):
        before = os.times()
        subprocess.run(
            [sys.executable, "-m", "tactile_bayes", *words],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            check=False,
        )
        after = os.times()
        spent.append(after.children_user - before.children_user + after.children_system - before.children_system)
    least = min(spent)
    return least if least > 0 else None


# --- What `tradeoff estimate` and `tradeoff map` share: options, the forecast on stderr, and the output.

TOLERANCE = click.option(
    "--tolerance-mm",
    type=FiniteRange(min=0.0, min_open=True),
    default=0.2,
    show_default=True,
    help="Error of the size interval's ends below which more accuracy is not worth its cost.",
)
RUNS = click.option(
    "--runs",
    type=click.IntRange(1, 1000),
    default=3,
    show_default=True,
    help="Number of runs of each setting: the least time counts, errors are averaged.",
)
CALIBRATION = click.option(
    "--size-calibration",
    metavar="solid|solid-mean|plane-strain|none|SIZE.json",
    help="Calibration from widths to sizes, as in `estimate`.",
)


def forecast(seconds: float) -> None:
    """Say on stderr how long it will take."""
    click.echo(f"about {max(round(seconds), 1)} s of CPU to go", err=True)


def show(
    ladder: Ladder,
    *,
    what: str,
    title: str,
    figure: Path | None,
    as_json: bool,
    force: bool,
    provenance: Mapping[str, Any],
) -> int:
    """Draw and print; the exit code."""
    from tactile_bayes.errors import EXIT_DONE, EXIT_NO_ESTIMATE
    from tactile_bayes.files.documents import check_document, dump_json
    from tactile_bayes.report.tradeoff import SCHEMA_FILE, draw_ladder, ladder_document, ladder_text

    try:
        if figure is not None:
            draw_ladder(ladder, figure, title=title, force=force)
    finally:  # what was measured is not lost with the figure
        if as_json:
            document = ladder_document(ladder, what=what, provenance=provenance)
            check_document(document, SCHEMA_FILE, path=Path("the report"))
            click.echo(dump_json(document), nl=False)
        else:
            click.echo(ladder_text(ladder))
    return EXIT_NO_ESTIMATE if ladder.reference.answer is None else EXIT_DONE
