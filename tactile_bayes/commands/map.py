"""`map`: from scans to a tactile map."""

from __future__ import annotations

from typing import Any

import click

from tactile_bayes.commands.options import FORCE, METAVAR, FigurePath, FilePath, takes
from tactile_bayes.declarations import names_of
from tactile_bayes.options import MapOptions

_FILE = FilePath()


@click.command("map")
@click.argument("scans", metavar="SCAN.mcap...", nargs=-1, required=True, type=_FILE)
@click.option(
    "-o", "--output", required=True, metavar="MAP.nc", type=FilePath(writes="netCDF"), help="Where to write the map."
)
@takes(MapOptions, *names_of(MapOptions))
@click.option("--figure", metavar=METAVAR, type=FigurePath(), help="Draw the map and its coverage.")
@FORCE
@click.option("-v", "--verbose", is_flag=True, help="Print the time of each step on stderr.")
def command(**given: Any) -> None:
    """Build a tactile map from one scan, or one common map from several scans of the same examination.

    The plane of the motion is fitted, frames outside the pressure window are left out, the rest are normalised,
    projected on the plane and averaged in cells. What was left out is printed with its reason. From frames that feel
    no lump it takes how the pressure is spread over the head, which tells `estimate` how deep the fat is.

    Example: tactile-bayes map scan.mcap -o map.nc --figure map.png
    """
    from tactile_bayes.actions.maps import map_action

    map_action(**given)
