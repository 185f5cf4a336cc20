"""`population`: simulate, map and fit exams of varied bodies: the table for a size calibration."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from tactile_bayes.commands.options import FORCE, WORKERS, scheduler_option, seed_option
from tactile_bayes.commands.paths import FilePath
from tactile_bayes.presets import DEFAULT_NORMALISE

if TYPE_CHECKING:
    from tactile_bayes.studies.population import MassRow

_FILE = FilePath()


@click.command("population")
@click.option("-o", "--output", required=True, metavar="TABLE.csv", type=_FILE, help="Where to write the table.")
@click.option(
    "--masses", type=click.IntRange(min=1), default=400, show_default=True, help="Number of bodies, one lump each."
)
@click.option(
    "--centred",
    type=click.IntRange(min=0),
    default=0,
    show_default=True,
    help="Further bodies whose lump is centred on the gland's surface, as the paper has it.",
)
@click.option("--scans", type=click.IntRange(min=1), default=2, show_default=True, help="Number of exams per body.")
@click.option(
    "--normalise",
    type=click.Choice(["gain", "mean"]),
    multiple=True,
    default=[DEFAULT_NORMALISE],
    show_default=True,
    help="Normalisation of the maps, as in `map`; the calibration is for maps made the same way. Give it twice for a "
    "row by each from one scan.",
)
@seed_option(7)
@WORKERS
@scheduler_option("the masses")
@FORCE
def command(
    output: Path,
    masses: int,
    centred: int,
    scans: int,
    normalise: tuple[str, ...],
    seed: int,
    workers: int,
    scheduler: str | None,
    force: bool,
) -> None:
    """Simulate exams of varied bodies and fit their maps: the table that a size calibration is learned from.

    Each body has a ball of its own size, depth, stiffness and seat, its own moduli and thickness; each exam its own
    pressure, strokes, head yaw, tilt, noise, tracker errors and latency. The solid model makes the scans; maps are
    built and fitted as `map` and `estimate` do it. A mass takes about two seconds. An interrupted run goes on where it
    stopped. `calibrate size` learns Eq 6 from the table, or with
    --form gaussian-process a calibration of the default's kind.

    Example: tactile-bayes population --masses 100 --workers 4 -o population.csv
    """
    from functools import partial

    from tactile_bayes.batch import fault_lines, open_store, run_batch
    from tactile_bayes.commands.progress import progress_bar
    from tactile_bayes.errors import TactileBayesError
    from tactile_bayes.executors import open_executor
    from tactile_bayes.files.atomic import refuse_existing, write_text
    from tactile_bayes.forward.population import BodyPrior, ExamPrior, as_settings
    from tactile_bayes.presets import RESEARCH_USE

    refuse_existing(output, force=force)
    # results are kept by number: where the centred ones begin decides what a number is
    settings = {
        "scans": scans,
        "seed": seed,
        "first_centred": masses if centred else None,
        "normalise": list(dict.fromkeys(normalise)),
        **as_settings(BodyPrior(), ExamPrior()),
    }
    kept = output.with_name(f"{output.name}.unfinished")
    with (
        open_executor(workers=workers, cluster=scheduler) as executor,
        open_store(kept, settings=settings, encode=_encode, decode=_decode) as store,
        progress_bar("masses") as progress,
    ):
        outcomes = run_batch(
            partial(
                rows_of_mass,
                scans=scans,
                seed=seed,
                first_centred=masses,
                normalise=tuple(dict.fromkeys(normalise)),
            ),
            range(masses + centred),
            key=str,
            executor=executor,
            store=store,
            progress=progress,
        )
    rows = [row for outcome in outcomes for row in outcome.value or []]
    write_text(output, table_text(rows), force=force)
    failed = [outcome for outcome in outcomes if not outcome.ok]
    for line in fault_lines(failed):
        click.echo(f"could not be simulated: mass {line}", err=True)
    if not failed:
        kept.unlink(missing_ok=True)
    found = sum(row.detected for row in rows)
    done = len(outcomes) - len(failed)
    click.echo(f"{output}: {done} masses, {len(rows)} exams, a lump found in {found}, seed {seed}")
    click.echo(RESEARCH_USE)
    if failed:
        raise TactileBayesError(
            f"{len(failed)} of {len(outcomes)} masses are missing; {kept} keeps the others: run again"
        )


def rows_of_mass(
    index: int, *, scans: int, seed: int, first_centred: int, normalise: Sequence[str] = (DEFAULT_NORMALISE,)
) -> list[MassRow]:
    """Rows of one mass, in any process."""
    import numpy as np

    from tactile_bayes.forward.population import BodyPrior, draw_mass
    from tactile_bayes.forward.population import centred as on_the_boundary
    from tactile_bayes.forward.simulate import simulate
    from tactile_bayes.studies.population import measure_mass

    bodies = on_the_boundary(BodyPrior()) if index >= first_centred else BodyPrior()
    scenes = draw_mass(index, scans=scans, seed=seed, bodies=bodies)
    return measure_mass(
        scenes,
        body=index,
        scan=lambda scene: simulate(scene, rng=np.random.default_rng(scene.seed)).scan,
        normalise=normalise,
    )


def _encode(rows: list[MassRow]) -> list[dict[str, Any]]:
    from dataclasses import asdict

    return [asdict(row) for row in rows]


def _decode(rows: list[dict[str, Any]]) -> list[MassRow]:
    from tactile_bayes.studies.population import MassRow

    return [MassRow(**row) for row in rows]


def table_text(rows: list[MassRow]) -> str:
    """CSV of the rows, with the header of `data_schema/population.table.json`."""
    from dataclasses import astuple, fields

    from tactile_bayes.studies.population import MassRow

    lines = [",".join(field.name for field in fields(MassRow))]
    return "\n".join(lines + [",".join(map(_cell, astuple(row))) for row in rows]) + "\n"


def _cell(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, bool):
        return "true" if value else "false"
    return str(value) if isinstance(value, int | str) else f"{value:.8g}"
