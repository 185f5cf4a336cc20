"""`tradeoff estimate`: every method of `estimate` on the user's own map, against a long reference."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from tactile_bayes.commands.figure_path import METAVAR, FigurePath
from tactile_bayes.commands.options import FORCE, JSON, FiniteRange, seed_option
from tactile_bayes.commands.paths import FilePath
from tactile_bayes.presets import FIT_RADIUS_MM

if TYPE_CHECKING:
    from tactile_bayes.posterior.lump.bump import BumpPrior

_FILE = FilePath()


@click.command("estimate")
@click.argument("map_file", metavar="MAP.nc", type=_FILE)
@click.option("--figure", metavar=METAVAR, type=FigurePath(), help="Draw error against time.")
@click.option(
    "--fit-radius-mm",
    type=FiniteRange(min=0.0, min_open=True),
    default=FIT_RADIUS_MM,
    show_default=True,
    help="Radius of the fit window, mm, as in `estimate`.",
)
@click.option("--settings", "settings_file", metavar="FILE.toml", type=_FILE, help="Priors, as in `estimate`.")
@click.option(
    "--tolerance-sd",
    type=FiniteRange(min=0.0, min_open=True),
    default=0.05,
    show_default=True,
    help="Error of an interval end below which more accuracy is not worth its cost.",
)
@click.option("--runs", type=click.IntRange(min=1), default=4, show_default=True, help="Number of runs to average.")
@seed_option(1)
@JSON
@FORCE
def command(
    *,
    map_file: Path,
    figure: Path | None,
    fit_radius_mm: float,
    settings_file: Path | None,
    tolerance_sd: float,
    runs: int,
    seed: int,
    as_json: bool,
    force: bool,
) -> None:
    """Measure what each method of `estimate` costs on a map, and how far its interval ends are off.

    Least squares, the Gaussians about the mode, importance sampling at four accuracies and MCMC of three lengths are
    run on the map under correlated errors, and compared with a reference of 65,536 weighted points. Times are CPU
    seconds of this machine. Where the map shows no bump there is nothing to compare: exit code 6.

    Example: tactile-bayes tradeoff estimate map.nc --figure methods.png
    """
    import time

    from tactile_bayes.commands.progress import progress_bar
    from tactile_bayes.errors import EXIT_NO_ESTIMATE
    from tactile_bayes.files.atomic import refuse_existing
    from tactile_bayes.files.map_nc import read_map
    from tactile_bayes.files.schema import dump_json
    from tactile_bayes.report.tradeoff_estimate import draw_tradeoff, tradeoff_document, tradeoff_text
    from tactile_bayes.studies.estimate_tradeoff import measure

    if figure is not None:
        refuse_existing(figure, force=force)
    tactile_map, priors = read_map(map_file), _priors(settings_file)
    with progress_bar("settings") as progress:
        found = measure(
            tactile_map,
            radius_mm=fit_radius_mm,
            prior=priors,
            clock=time.process_time,
            seed=seed,
            runs=runs,
            progress=progress,
        )
    if isinstance(found, str):
        if figure is not None and tactile_map.covered.any():
            from tactile_bayes.report.map_figure import map_figure

            map_figure(
                tactile_map,
                figure,
                title=f"Tactile map: {map_file.stem}",
                note=f"Nothing to compare: {found}.",
                force=force,
            )
        click.echo(f"Nothing to compare: {found}.")
        raise click.exceptions.Exit(EXIT_NO_ESTIMATE)
    if figure is not None:
        draw_tradeoff(found, figure, tolerance_sd=tolerance_sd, force=force)
    if as_json:
        click.echo(dump_json(tradeoff_document(found, tolerance_sd=tolerance_sd)), nl=False)
    else:
        click.echo(tradeoff_text(found, tolerance_sd=tolerance_sd))


def _priors(path: Path | None) -> BumpPrior:
    """The priors of a settings file; what this command varies itself is refused."""
    from tactile_bayes.errors import UsageError
    from tactile_bayes.files.settings_toml import read_settings
    from tactile_bayes.posterior.lump.bump import BumpPrior

    if path is None:
        return BumpPrior()
    found = read_settings(path)
    prior = found.pop("prior")
    del found["settings_file"]
    for key in found:
        raise UsageError(f"{path}: {key} is not for `tradeoff estimate`, which takes the priors only; leave {key} out")
    return BumpPrior(**(prior or {}))
