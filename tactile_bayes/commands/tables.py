"""`tables`: recompute Tables 1 and 2 of the paper."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from tactile_bayes.commands.options import JSON, WORKERS, FiniteRange, head_option

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from tactile_bayes.forward.contact import Head
    from tactile_bayes.studies.paper_tables import Agreement

    ByHead = Mapping[Head, Sequence[Agreement]]

_ABOVE_0 = FiniteRange(min=0.0, min_open=True)


@click.command("tables")
@click.option(
    "--seat",
    default="centred",
    show_default=True,
    metavar="centred|resting|0..2",
    help="How far the lump stands out of the gland.",
)
@click.option("--head-radius-mm", type=_ABOVE_0, default=35.0, show_default=True, help="Radius of the head's arc, mm.")
@click.option(
    "--shoulder-mm", type=FiniteRange(min=0.0), default=3.0, show_default=True, help="Radius of the shoulders, mm."
)
@head_option("Default: shoulders-inside.")
@click.option("--heads", "search", is_flag=True, help="Compute the tables for many heads, and name the nearest one.")
@WORKERS
@JSON
def command(
    *, seat: str, head_radius_mm: float, shoulder_mm: float, head: str | None, search: bool, workers: int, as_json: bool
) -> None:
    """Recompute Tables 1 and 2 of the paper beside the printed figures.

    The empirical model (Eqs 1 to 4) is fitted to frames of the elastic plane-strain model and compared with it: on the
    frame centred on the lump, on all frames, and on the map; for ten lumps, and for the four phantoms of section 2.3.
    The paper does not give its head. Beside the head that is asked for stands the one that comes nearest to the
    printed tables, of those that --heads computes.

    Example: tactile-bayes tables --seat resting --heads
    """
    import json

    from tactile_bayes.forward.body import parse_seat
    from tactile_bayes.forward.contact import Head
    from tactile_bayes.presets import RESEARCH_USE, SHOULDERS_INSIDE
    from tactile_bayes.report.tables_text import heads_text, tables_document, tables_text
    from tactile_bayes.studies.paper_tables import NEAREST_HEADS, TRIED_HEADS

    at = parse_seat(seat)
    asked = Head(radius_mm=head_radius_mm, shoulder_mm=shoulder_mm, shoulders=head or SHOULDERS_INSIDE)
    nearest = NEAREST_HEADS.get(at)
    heads = list(dict.fromkeys([asked, *([nearest] if nearest else []), *(TRIED_HEADS if search else ())]))
    found, phantoms = run_tables(at, heads=heads, workers=workers)
    if as_json:
        click.echo(json.dumps(tables_document(found, phantoms, seat=at), indent=2))
        return
    beside = found[nearest] if nearest and nearest != asked else None
    click.echo(tables_text(found[asked], phantoms[asked], head=asked, nearest=nearest, beside=beside))
    if search:
        click.echo(heads_text(found))
    click.echo(RESEARCH_USE)


def run_tables(seat: float, *, heads: Sequence[Head], workers: int) -> tuple[ByHead, ByHead]:
    """Agreement of both models over the cases of the tables, and over the phantoms, under each head."""
    from functools import partial

    from tactile_bayes.batch import open_executor, run_batch
    from tactile_bayes.commands.progress import progress_bar
    from tactile_bayes.commands.study import fit_line
    from tactile_bayes.errors import TactileBayesError
    from tactile_bayes.studies.paper import StudySettings
    from tactile_bayes.studies.paper_tables import compare_heads, phantom_scenes, table_scenes

    scenes = table_scenes(seat) + phantom_scenes(seat)
    work = partial(compare_heads, settings=StudySettings(), heads=heads, fit=fit_line)
    with open_executor(workers=workers) as executor, progress_bar("lumps") as progress:
        outcomes = run_batch(work, scenes, key=lambda scene: scene.name, executor=executor, progress=progress)
    for outcome in outcomes:
        if outcome.value is None:
            raise TactileBayesError(f"{outcome.key}: {outcome.error}")
    found = [outcome.value for outcome in outcomes if outcome.value is not None]
    count = len(table_scenes(seat))
    by_head = {head: [per_scene[i] for per_scene in found] for i, head in enumerate(heads)}
    return (
        {head: rows[:count] for head, rows in by_head.items()},
        {head: rows[count:] for head, rows in by_head.items()},
    )
