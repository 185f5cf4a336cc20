"""`tradeoff estimate`: every setting of `estimate` on the user's own map, against a long reference."""

from __future__ import annotations

from pathlib import Path

import click

from tactile_bayes.api.settings import Settings
from tactile_bayes.commands.options import (
    FORCE,
    JSON,
    METAVAR,
    FigurePath,
    FilePath,
    also_read,
    settings_of,
    takes,
)
from tactile_bayes.commands.tradeoff_options import CALIBRATION, RUNS, TOLERANCE

_FILE = FilePath()


@click.command("estimate")
@click.argument("maps", metavar="MAP.nc...", nargs=-1, required=True, type=_FILE)
@CALIBRATION
@takes(Settings, "centre_mm")
@takes(Settings, "settings_file", help="Settings, as in `estimate`.")
@TOLERANCE
@RUNS
@click.option("--figure", metavar=METAVAR, type=FigurePath(), help="Draw error against time.")
@takes(Settings, "seed")
@JSON
@FORCE
@click.pass_context
def command(
    ctx: click.Context,
    /,
    maps: tuple[Path, ...],
    size_calibration: str | None,
    centre_mm: tuple[float, float] | None,
    settings_file: Path | None,
    tolerance_mm: float,
    runs: int,
    figure: Path | None,
    seed: int,
    as_json: bool,
    force: bool,
) -> None:
    """Measure what each setting of `estimate` costs on a map, and how far its size interval is off.

    Whole estimates, from the map to the size, by every method, at several accuracies, noise fields and fit windows, are
    compared with a long run of the default's posterior, by importance sampling or, where that cannot be trusted, MCMC.
    With several maps, all of one mass, the settings are tried on the first, and the sizes by one map, two and so on are
    shown. Times are CPU seconds of this machine; about how long it takes is printed on stderr.

    Where the map has no size by default there is no reference: what each setting says is printed, exit code 6.

    Example: tactile-bayes tradeoff estimate map.nc --figure methods.png
    """
    import time

    from tactile_bayes.api.tradeoffs import pooled_rows, tradeoff_of_map
    from tactile_bayes.commands.progress import progress_bar
    from tactile_bayes.commands.tradeoff_options import forecast, fresh_cpu_s, show
    from tactile_bayes.declarations import replace
    from tactile_bayes.errors import UsageError
    from tactile_bayes.files.atomic import given_twice, refuse_existing
    from tactile_bayes.files.provenance import Provenance, hash_inputs
    from tactile_bayes.files.shipped import size_calibration_path
    from tactile_bayes.studies.estimate_tradeoff import Work

    if size_calibration is not None:
        also_read(size_calibration_path(size_calibration))
    if figure is not None:
        refuse_existing(figure, force=force)
    if twice := given_twice(maps):
        raise UsageError(f"{twice} is given twice; give each map once")
    settings = settings_of(
        settings_file=settings_file, size_calibration=size_calibration, centre_mm=centre_mm, seed=seed
    )
    if len(maps) > 1 and centre_mm is not None:
        raise UsageError("--centre-mm is a place on one map; give one map")
    with progress_bar("settings") as progress:
        work = Work(time.process_time, tolerance_mm, runs, forecast, progress)
        _, ladder = tradeoff_of_map(maps[0], settings, work)
        if len(maps) > 1:
            ladder = replace(ladder, pooled=pooled_rows(maps, settings, clock=time.process_time))
    cold = fresh_cpu_s(["estimate", str(maps[0]), *_said(size_calibration, centre_mm, settings_file)])
    if cold is not None:
        shared = {"start of the program and reading the map": max(cold - ladder.default.seconds, 0.0)}
        ladder = replace(ladder, shared_cpu_s=shared)
    inputs = hash_inputs(**{f"map_{number}": path for number, path in enumerate(maps, start=1)})
    kept = {"size_calibration": size_calibration, "tolerance_mm": tolerance_mm, "runs": runs}
    provenance = Provenance("tradeoff estimate", kept, inputs, seed=seed).as_dict()
    title = f"{maps[0].stem}: what more time for `estimate` buys"
    ctx.exit(
        show(ladder, what="estimate", title=title, figure=figure, as_json=as_json, force=force, provenance=provenance)
    )


def _said(calibration: str | None, centre_mm: tuple[float, float] | None, settings_file: Path | None) -> list[str]:
    """The options of an `estimate` that does the same as the default row."""
    words = [] if calibration is None else ["--size-calibration", calibration]
    words += [] if centre_mm is None else ["--centre-mm", *map(repr, centre_mm)]
    return words + ([] if settings_file is None else ["--settings", str(settings_file)])
