"""What `tradeoff estimate` and `tradeoff map` share: options, the forecast on stderr, and the output."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from tactile_bayes.commands.options import FiniteRange

if TYPE_CHECKING:
    from tactile_bayes.studies.cost_ladder import Ladder

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
    from tactile_bayes.files.schema import check_document, dump_json
    from tactile_bayes.report.ladder_document import SCHEMA_FILE, ladder_document
    from tactile_bayes.report.ladder_figure import draw_ladder
    from tactile_bayes.report.ladder_text import ladder_text

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
