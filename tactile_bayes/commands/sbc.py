"""`sbc`: simulation-based calibration of a map's posterior."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from tactile_bayes.commands.options import (
    FORCE,
    JSON,
    METAVAR,
    MOST_ITEMS,
    WORKERS,
    FigurePath,
    FilePath,
    WholeOrAuto,
    scheduler_option,
    seed_option,
)
from tactile_bayes.declarations import as_dict
from tactile_bayes.presets import MOST_FIELD_COSINES, Method

if TYPE_CHECKING:
    from tactile_bayes.batch import Outcome
    from tactile_bayes.batch_store import BatchStore
    from tactile_bayes.size.bodies import BodyCalibration
    from tactile_bayes.studies.sbc import MapRanks


@click.command("sbc")
@click.option("--maps", type=click.IntRange(1, MOST_ITEMS), default=200, show_default=True, help="Maps to simulate.")
@click.option(
    "--method",
    type=click.Choice(["laplace", "importance", "ensemble"]),
    default="importance",
    show_default=True,
    help="Method of the posterior draws, as in `estimate`; ensemble takes about 20 times as long.",
)
@click.option(
    "--field-cosines",
    type=WholeOrAuto(min=6, max=MOST_FIELD_COSINES),
    metavar="N|auto",
    default="auto",
    show_default=True,
    help="Basis functions of the noise field, as field_cosines of `estimate`.",
)
@seed_option(1)
@WORKERS
@scheduler_option("the maps")
@click.option(
    "-o",
    "--output",
    metavar="TABLE.csv",
    type=FilePath(writes="CSV"),
    help="Write truths and ranks; an interrupted run resumes from it.",
)
@click.option("--figure", metavar=METAVAR, type=FigurePath(), help="Draw the ECDFs of the ranks with their bands.")
@JSON
@FORCE
def command(
    maps: int,
    method: Method,
    field_cosines: int | None,
    seed: int,
    workers: int,
    scheduler: str | None,
    output: Path | None,
    figure: Path | None,
    as_json: bool,
    force: bool,
) -> None:
    """Check the posterior against itself: simulation-based calibration and coverage.

    Maps are drawn from the model's own prior (bump, level, slope, correlated errors) and estimated under correlated
    errors, without rotation. Where the posterior is right, the rank of each true value among the draws is uniform and
    an interval covers it as often as it states. This tests the program, not whether breasts are like its model. Maps
    without an estimate are counted and left out, and so are those on which another rise than the drawn one was
    measured; their number is compared with what the estimates' probabilities predict. The size is that of a round
    lump by the shipped calibration. With -o an interrupted run goes on where it stopped.

    Example: tactile-bayes sbc --maps 300 --workers 2 -o sbc.csv --figure sbc.png
    """
    from time import monotonic

    from tactile_bayes.batch import BatchInterrupted
    from tactile_bayes.errors import TactileBayesError
    from tactile_bayes.files.atomic import refuse_existing, write_text
    from tactile_bayes.files.documents import dump_json
    from tactile_bayes.report.sbc import sbc_document, sbc_figure, sbc_text, table_text

    for path in (output, figure):
        if path is not None:
            refuse_existing(path, force=force)
    begun = monotonic()

    def report(found: list[MapRanks], speed: float | None) -> None:
        document = sbc_document(found, method=method, seed=seed, maps_per_s=speed, cosines=field_cosines)
        click.echo(dump_json(document) if as_json else sbc_text(document), nl=False)

    try:
        outcomes, made = _run(maps, method, seed, field_cosines, workers=workers, scheduler=scheduler, output=output)
    except BatchInterrupted as stop:
        if output is None:  # else the next run goes on
            report([one.value for one in stop.outcomes if one.value is not None], None)
        raise
    speed = made / (monotonic() - begun) if made else None
    found = [outcome.value for outcome in outcomes if outcome.value is not None]
    if output is not None:
        write_text(output, table_text(found), force=force)
    failed = _finish(outcomes, output)
    try:
        if figure is not None:
            sbc_figure(found, figure, force=force)
    finally:  # what was computed is not lost with the figure
        report(found, speed)
    if failed:
        raise TactileBayesError(f"{failed} of {len(outcomes)} maps are missing from this report")


def _run(
    maps: int,
    method: Method,
    seed: int,
    cosines: int | None,
    *,
    workers: int,
    scheduler: str | None,
    output: Path | None,
) -> tuple[list[Outcome[MapRanks]], int]:
    """Outcomes of all maps, and the number that this run made."""
    from functools import partial

    from tactile_bayes.batch import open_executor, run_batch
    from tactile_bayes.commands.progress import progress_bar
    from tactile_bayes.files.shipped import DEFAULT
    from tactile_bayes.studies.sbc import settings

    with (
        open_executor(workers=workers, cluster=scheduler) as executor,
        _open_kept(output, settings(method, seed, size=DEFAULT, cosines=cosines)) as store,
        progress_bar("maps") as progress,
    ):
        had = 0 if store is None else len(store.values)
        outcomes = run_batch(
            partial(ranks_of_map, method=method, seed=seed, cosines=cosines),
            range(maps),
            key=str,
            executor=executor,
            store=store,
            progress=progress,
        )
    return outcomes, max(maps - had, 0)


def ranks_of_map(index: int, *, method: Method, seed: int, cosines: int | None) -> MapRanks:
    """Ranks of one map, in any process."""
    from tactile_bayes.studies import sbc

    return sbc.ranks_of_map(index, method=method, seed=seed, calibration=_shipped(), cosines=cosines)


@cache
def _shipped() -> BodyCalibration:
    from tactile_bayes.files.shipped import DEFAULT, size_calibration_path
    from tactile_bayes.files.size_json import read_size_calibration
    from tactile_bayes.size.bodies import BodyCalibration

    path = size_calibration_path(DEFAULT)
    calibration = None if path is None else read_size_calibration(path)
    assert isinstance(calibration, BodyCalibration)
    return calibration


def _kept(output: Path) -> Path:
    return output.with_name(f"{output.name}.unfinished")


@contextmanager
def _open_kept(output: Path | None, settings: dict[str, Any]) -> Iterator[BatchStore | None]:
    """Open the store of results beside the output; None without an output."""
    from tactile_bayes.batch_store import open_store

    if output is None:
        yield None
        return
    with open_store(_kept(output), settings=settings, encode=_encode, decode=_decode) as store:
        yield store


def _finish(outcomes: list[Outcome[MapRanks]], output: Path | None) -> int:
    """Report maps that failed; if none did, remove the stored results."""
    from tactile_bayes.batch import fault_lines

    failed = [outcome for outcome in outcomes if not outcome.ok]
    for line in fault_lines(failed):
        click.echo(f"could not be estimated: map {line}", err=True)
    if output is not None and not failed:
        _kept(output).unlink(missing_ok=True)
    return len(failed)


def _encode(one: MapRanks) -> dict[str, Any]:
    return as_dict(one)


def _decode(value: dict[str, Any]) -> MapRanks:
    from tactile_bayes.studies.sbc import MapRanks, Truth

    ranks = None if value["ranks"] is None else tuple(value["ranks"])
    return MapRanks(value["index"], Truth(**value["truth"]), ranks, value["outcome"], value["probability"])
