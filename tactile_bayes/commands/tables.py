"""`tables`: Tables 1 and 2 of the paper, computed again."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from tactile_bayes.commands.head_option import head_option
from tactile_bayes.commands.options import JSON, WORKERS

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from tactile_bayes.forward.plane.tables import Agreement


@click.command("tables")
@click.option(
    "--seat",
    default="centred",
    show_default=True,
    metavar="centred|resting|0..2",
    help="How far the lump stands out of the gland.",
)
@head_option("Default: shoulders-inside.")
@WORKERS
@JSON
def command(*, seat: str, head: str | None, workers: int, as_json: bool) -> None:
    """Recompute Tables 1 and 2 of the paper beside the printed figures.

    The empirical model (Eqs 1 to 4) is fitted to frames of the elastic plane-strain model and compared with it: on the
    frame centred on the lump, on all frames, and on the map; for ten lumps, and for the four phantoms of section 2.3.

    Example: tactile-bayes tables --seat resting
    """
    import json

    from tactile_bayes.forward.body import parse_seat
    from tactile_bayes.presets import RESEARCH_USE, SHOULDERS_INSIDE

    head = head or SHOULDERS_INSIDE
    found, phantoms = run_tables(parse_seat(seat), head=head, workers=workers)
    if as_json:
        click.echo(json.dumps(tables_document(found, phantoms, seat=parse_seat(seat), head=head), indent=2))
        return
    click.echo(tables_text(found, phantoms))
    click.echo(f"head: {head}")
    click.echo(RESEARCH_USE)


def run_tables(seat: float, *, head: str, workers: int) -> tuple[list[Agreement], list[Agreement]]:
    """Agreement of both models over the cases of the tables, and over the phantoms."""
    from functools import partial

    from tactile_bayes.batch import run_batch
    from tactile_bayes.commands.progress import progress_bar
    from tactile_bayes.commands.study import fit_line
    from tactile_bayes.errors import TactileBayesError
    from tactile_bayes.executors import open_executor
    from tactile_bayes.forward.contact import Head
    from tactile_bayes.forward.plane.study import StudySettings
    from tactile_bayes.forward.plane.tables import compare, phantom_scenes, table_scenes

    scenes = table_scenes(seat) + phantom_scenes(seat)
    work = partial(compare, settings=StudySettings(Head(shoulders=head)), fit=fit_line)
    with open_executor(workers=workers) as executor, progress_bar("lumps") as progress:
        outcomes = run_batch(work, scenes, key=lambda scene: scene.name, executor=executor, progress=progress)
    for outcome in outcomes:
        if outcome.value is None:
            raise TactileBayesError(f"{outcome.key}: {outcome.error}")
    found = [outcome.value for outcome in outcomes if outcome.value is not None]
    count = len(table_scenes(seat))
    return found[:count], found[count:]


def tables_text(found: Sequence[Agreement], phantoms: Sequence[Agreement]) -> str:
    """Both tables, the widths and amplitudes, and the phantoms."""
    from tactile_bayes.forward.plane.tables import DEFINITION, PRINTED_FRAMES, PRINTED_MAPS

    lines = [DEFINITION, ""]
    lines += _table("Table 1: frame centred on the lump, MSD %", found, "centred_frame", PRINTED_FRAMES)
    lines += _table("The same of frames divided by their means, MSD %", found, "normalised_frame", None)
    lines += _table("All frames of the map, MSD % (printed average 4.3)", found, "all_frames", None)
    lines += _table("Table 2: map, MSD %", found, "map", PRINTED_MAPS)
    lines += _table("Map, strict MSD %", found, "map_strict", None)
    lines += _others(found)
    lines += ["Eq 5 fitted to both maps (background 1); the elastic model first:"]
    lines += [f"{'lump':<24}{'a':>16}{'sigma, mm':>18}{'frame %':>10}{'map %':>8}{'strict %':>10}"]
    for one in [*found, *phantoms]:
        amplitudes = f"{one.elastic.amplitude:.3f} {one.empirical.amplitude:.3f}"
        widths = f"{one.elastic.sigma_mm:.2f} {one.empirical.sigma_mm:.2f}"
        shares = f"{100 * one.centred_frame:>10.1f}{100 * one.map:>8.1f}{100 * one.map_strict:>10.1f}"
        lines.append(f"{one.scene.name:<24}{amplitudes:>16}{widths:>18}{shares}")
    return "\n".join(lines)


def _others(found: Sequence[Agreement]) -> list[str]:
    """What other definitions would give: means over the cases with the least and the largest."""
    from tactile_bayes.forward.plane.tables import OTHER_DEFINITIONS

    lines = [
        "Other definitions, %: mean over the cases (least to largest); printed 4.0 to 4.3 and 2.2 to 2.7",
        f"{'':<37}{'frame':>21}{'frame over its mean':>21}{'map':>21}",
    ]
    for i, name in enumerate(OTHER_DEFINITIONS):
        cells = []
        for of in range(3):
            shares = [100 * one.others[i][of] for one in found]
            cells.append(f"{sum(shares) / len(shares):.1f} ({min(shares):.1f} to {max(shares):.1f})")
        lines.append(f"{name:<37}" + "".join(f"{cell:>21}" for cell in cells))
    return [*lines, ""]


def _table(
    title: str, found: Sequence[Agreement], name: str, printed: Mapping[float, Sequence[float]] | None
) -> list[str]:
    """One table with diameters across; the printed figures in brackets."""
    from tactile_bayes.forward.plane.tables import TABLE_DIAMETERS_MM

    lines = [title, f"{'h/d':>5}" + "".join(f"{f'd {d:g} mm':>14}" for d in TABLE_DIAMETERS_MM)]
    for depth in dict.fromkeys(one.scene.depth_ratio for one in found):
        row = [100 * getattr(one, name) for one in found if one.scene.depth_ratio == depth]
        beside = [""] * len(row) if printed is None else [f" ({value:.1f})" for value in printed[depth]]
        lines.append(f"{depth:>5g}" + "".join(f"{f'{v:.1f}{p}':>14}" for v, p in zip(row, beside, strict=True)))
    mean = sum(100 * getattr(one, name) for one in found) / len(found)
    if printed is not None:
        cells = [value for row in printed.values() for value in row]
        return [*lines, f"mean {mean:.1f} (of the printed cells {sum(cells) / len(cells):.1f})", ""]
    return [*lines, f"mean {mean:.1f}", ""]


def tables_document(
    found: Sequence[Agreement], phantoms: Sequence[Agreement], *, seat: float, head: str
) -> dict[str, object]:
    """The same as plain data, shares instead of percent."""
    from dataclasses import asdict

    from tactile_bayes.forward.plane.tables import DEFINITION, OTHER_DEFINITIONS, PRINTED_FRAMES, PRINTED_MAPS

    return {
        "schema": "tactile-bayes/tables/1",
        "definition": DEFINITION,
        "other_definitions": list(OTHER_DEFINITIONS),
        "seat": seat,
        "head": head,
        "printed_percent": {
            "frames": {f"{h:g}": list(row) for h, row in PRINTED_FRAMES.items()},
            "maps": {f"{h:g}": list(row) for h, row in PRINTED_MAPS.items()},
        },
        "cases": [asdict(one) for one in found],
        "phantoms": [asdict(one) for one in phantoms],
    }
