"""`estimate`: estimate sizes from tactile maps."""

from __future__ import annotations

from typing import Any

import click

from tactile_bayes.api.settings import Settings
from tactile_bayes.commands.options import FORCE, METAVAR, FigurePath, FilePath, scheduler_option, takes

_FILE = FilePath()


@click.command("estimate")
@click.argument("maps", metavar="MAP.nc...", nargs=-1, required=True, type=_FILE)
@takes(Settings, "size_calibration", "method", "seed", "interval")
@click.option(
    "-o",
    "--output",
    metavar="POST.nc",
    type=FilePath(writes="netCDF"),
    help="Write all draws (netCDF that arviz opens).",
)
@click.option("--json", "as_json", is_flag=True, help="Print JSON: one object, or a list for several maps.")
@click.option(
    "--figure", metavar=METAVAR, type=FigurePath(), help="Draw the size posterior, or the map where there is no size."
)
@click.option(
    "--map-figure",
    metavar=METAVAR,
    type=FigurePath(),
    help="Draw the map with the lump's size, or with the places looked at.",
)
@click.option(
    "--fit-figure",
    metavar=METAVAR,
    type=FigurePath(),
    help="Draw data, fit and residual of the fit window, or the map where there is no estimate.",
)
@takes(Settings, "centre_mm", "scene", "settings_file", "accuracy_sd", "known", "repeatability")
@click.option("--pool", is_flag=True, help="Pool the maps, all of one mass, into one size.")
@click.option(
    "--workers",
    type=click.IntRange(min=1),
    default=1,
    show_default=True,
    help="Number of worker processes, for several maps.",
)
@scheduler_option("several maps")
@FORCE
@click.option(
    "-v", "--verbose", is_flag=True, help="Print the full report instead of 12 lines, and the time taken on stderr."
)
@click.pass_context
def command(ctx: click.Context, /, **given: Any) -> None:
    """Estimate a lump's size from tactile maps, with a credible interval.

    Every posterior draw of the map's Gaussian (Eq 7) goes through a size calibration with a draw of its coefficients
    and of what no map shows. Where the map shows no lump that can be measured there is no number: the reason is
    printed and the exit code is 6. With --pool the maps are repeats of one mass, and their spread is learned. Where a
    map tells how deep the fat under the head is, sizes are for that depth; where not, the report says so.

    Example: tactile-bayes estimate map.nc --figure size.png
    """
    from tactile_bayes.actions.estimate import estimate_action

    estimate_action(ctx, **given)
