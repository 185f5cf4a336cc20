"""`tradeoff map`: every setting of `map` on the user's own scan, up to the size."""

from __future__ import annotations

from pathlib import Path

import click

from tactile_bayes.commands.options import FORCE, JSON, METAVAR, FigurePath, FilePath, seed_option
from tactile_bayes.commands.tradeoff_options import RUNS, TOLERANCE
from tactile_bayes.declarations import replace

_FILE = FilePath()


@click.command("map")
@click.argument("scan", metavar="SCAN.mcap", type=_FILE)
@TOLERANCE
@RUNS
@click.option("--figure", metavar=METAVAR, type=FigurePath(), help="Draw error against time.")
@seed_option(1)
@JSON
@FORCE
@click.pass_context
def command(
    ctx: click.Context,
    /,
    scan: Path,
    tolerance_mm: float,
    runs: int,
    figure: Path | None,
    seed: int,
    as_json: bool,
    force: bool,
) -> None:
    """Measure what each setting of `map` costs on a scan, and how far it moves the size interval.

    The map is built with several sizes of cells, from a part of the frames, from the first part of the scan, by every
    way to normalise, and estimated by default. Sizes are compared with a long run on the map of all
    frames in cells of 0.5 mm. Times are CPU seconds of this machine; about how long it takes is printed on stderr.

    Where that map has no size there is no reference: what each setting says is printed, exit code 6.

    Example: tactile-bayes tradeoff map scan.mcap --figure cells.png
    """
    import time

    from tactile_bayes.api.settings import Settings
    from tactile_bayes.api.tradeoffs import tradeoff_of_scan
    from tactile_bayes.commands.progress import progress_bar
    from tactile_bayes.commands.tradeoff_options import forecast, show
    from tactile_bayes.files.atomic import refuse_existing
    from tactile_bayes.files.provenance import Provenance, hash_inputs
    from tactile_bayes.files.scan_mcap import read_scan
    from tactile_bayes.studies.estimate_tradeoff import Work

    if figure is not None:
        refuse_existing(figure, force=force)
    read_scan(scan)  # imports and first calls cost nothing afterwards
    begun = time.process_time()
    loaded = read_scan(scan)
    read_s = time.process_time() - begun
    with progress_bar("settings") as progress:
        work = Work(time.process_time, tolerance_mm, runs, forecast, progress)
        ladder = tradeoff_of_scan(loaded, Settings(seed=seed), work)
    ladder = replace(ladder, shared_cpu_s={"reading the scan": read_s})
    kept = {"tolerance_mm": tolerance_mm, "runs": runs}
    provenance = Provenance("tradeoff map", kept, hash_inputs(scan=scan), seed=seed).as_dict()
    title = f"{scan.stem}: what finer cells and more frames buy"
    ctx.exit(show(ladder, what="map", title=title, figure=figure, as_json=as_json, force=force, provenance=provenance))
