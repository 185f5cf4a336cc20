"""`population`: simulate, map and fit exams of varied bodies: the table for a size calibration."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from tactile_bayes.commands.options import FORCE, MOST_ITEMS, WORKERS, FilePath, scheduler_option, seed_option
from tactile_bayes.declarations import as_dict, names_of
from tactile_bayes.presets import DEFAULT_NORMALISE

if TYPE_CHECKING:
    from tactile_bayes.forward.scene import Head
    from tactile_bayes.studies.population import BodyPrior, ExamPrior, MassRow

_FILE = FilePath()


@click.command("population")
@click.option(
    "-o", "--output", required=True, metavar="TABLE.csv", type=FilePath(writes="CSV"), help="Where to write the table."
)
@click.option(
    "--masses",
    type=click.IntRange(1, MOST_ITEMS),
    default=400,
    show_default=True,
    help="Number of bodies, one lump each.",
)
@click.option(
    "--centred",
    type=click.IntRange(0, MOST_ITEMS),
    default=0,
    show_default=True,
    help="Further bodies whose lump is centred on the gland's surface, as the paper has it.",
)
@click.option("--scans", type=click.IntRange(1, 1000), default=2, show_default=True, help="Number of exams per body.")
@click.option(
    "--normalise",
    type=click.Choice(["gain", "mean"]),
    multiple=True,
    default=[DEFAULT_NORMALISE],
    show_default=True,
    help="Normalisation of the maps, as in `map`; the calibration is for maps made the same way. Give it twice for a "
    "row by each from one scan.",
)
@click.option(
    "--head",
    metavar="HEAD.json",
    type=_FILE,
    help="The head, as for `record`: its taxels or their grid and arc. Default: 16 by 26 taxels 1.5 mm apart, arc of "
    "35 mm.",
)
@click.option(
    "--bodies",
    "bodies_file",
    metavar="BODIES.toml",
    type=_FILE,
    help="Ranges of lumps, bodies and exams, in the tables [bodies] and [exams]. Default: those of the shipped "
    "calibrations.",
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
    head: Path | None,
    bodies_file: Path | None,
    seed: int,
    workers: int,
    scheduler: str | None,
    force: bool,
) -> None:
    """Simulate exams of varied bodies and fit their maps: the table that a size calibration is learned from.

    Each body has a ball of its own size, depth, stiffness and seat, its own moduli and thickness; each exam its own
    pressure, strokes, head yaw, tilt, noise, tracker errors and latency. The solid model makes the scans; maps are
    built and fitted as `map` and `estimate` do it. A mass takes about two seconds. An interrupted run goes on where it
    stopped. `calibrate size` learns Eq 6 from the table, or with --form eq6-residual a calibration of the default's
    kind. The table names its head: a calibration learned from it sizes maps of such a head only.

    Example: tactile-bayes population --head head.json --masses 100 --workers 4 -o population.csv
    """
    from functools import partial

    from tactile_bayes.batch import fault_lines, open_executor, run_batch
    from tactile_bayes.batch_store import open_store
    from tactile_bayes.commands.progress import progress_bar
    from tactile_bayes.declarations import as_dict
    from tactile_bayes.errors import TactileBayesError
    from tactile_bayes.files.atomic import refuse_existing, write_text
    from tactile_bayes.files.documents import read_record
    from tactile_bayes.files.instrument_json import read_simulated_head
    from tactile_bayes.forward.scene import Head
    from tactile_bayes.presets import RESEARCH_USE
    from tactile_bayes.studies.population import BodiesFile, as_settings

    refuse_existing(output, force=force)
    simulated = read_simulated_head(head) if head else Head()
    drawn = read_record(bodies_file, BodiesFile) if bodies_file else BodiesFile()
    bodies, exams = drawn.bodies, drawn.exams
    # results are kept by number: where the centred ones begin decides what a number is
    settings = {
        "scans": scans,
        "seed": seed,
        "first_centred": masses if centred else None,
        "normalise": list(dict.fromkeys(normalise)),
        **as_settings(bodies, exams),
        "head": as_dict(simulated),
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
                bodies=bodies,
                exams=exams,
                head=simulated,
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
    index: int,
    *,
    scans: int,
    seed: int,
    first_centred: int,
    normalise: Sequence[str] = (DEFAULT_NORMALISE,),
    bodies: BodyPrior | None = None,
    exams: ExamPrior | None = None,
    head: Head | None = None,
) -> list[MassRow]:
    """Rows of one mass, in any process.

    Parameters
    ----------
    index
        Number of the mass.
    scans, seed, bodies, exams, head
        As `forward.population.draw_mass`'s.
    first_centred
        From this mass on the lumps are centred on the gland's surface.
    normalise
        As `studies.population.measure_mass`'s.
    """
    import numpy as np

    from tactile_bayes.forward.simulate import simulate
    from tactile_bayes.studies.population import BodyPrior, draw_mass, measure_mass
    from tactile_bayes.studies.population import centred as on_the_boundary

    prior = bodies or BodyPrior()
    prior = on_the_boundary(prior) if index >= first_centred else prior
    scenes = draw_mass(index, scans=scans, seed=seed, bodies=prior, exams=exams, head=head)
    return measure_mass(
        scenes,
        body=index,
        scan=lambda scene: simulate(scene, rng=np.random.default_rng(scene.seed)).scan,
        normalise=normalise,
    )


def _encode(rows: list[MassRow]) -> list[dict[str, Any]]:
    return [as_dict(row) for row in rows]


def _decode(rows: list[dict[str, Any]]) -> list[MassRow]:
    from tactile_bayes.studies.population import MassRow

    return [MassRow(**row) for row in rows]


def table_text(rows: list[MassRow]) -> str:
    """CSV of the rows, with the header of `data_schema/population.table.json`."""
    from tactile_bayes.studies.population import MassRow

    lines = [",".join(names_of(MassRow))]
    return "\n".join(lines + [",".join(map(_cell, as_dict(row).values())) for row in rows]) + "\n"


def _cell(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, bool):
        return "true" if value else "false"
    return str(value) if isinstance(value, int | str) else f"{value:.8g}"
