"""`map`: from scans to a tactile map."""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import Any

import click

from tactile_bayes.commands.options import FORCE, METAVAR, FigurePath, FilePath, takes
from tactile_bayes.declarations import EXACT, names_of, to_plain
from tactile_bayes.errors import UsageError
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
def command(
    scans: tuple[Path, ...],
    output: Path,
    figure: Path | None,
    force: bool,
    verbose: bool,
    **options: Any,
) -> None:
    """Build a tactile map from one scan, or one common map from several scans of the same examination.

    The plane of the motion is fitted, frames outside the pressure window are left out, the rest are normalised,
    projected on the plane and averaged in cells. What was left out is printed with its reason. From frames that feel
    no lump it takes how the pressure is spread over the head, which tells `estimate` how deep the fat is.

    Example: tactile-bayes map scan.mcap -o map.nc --figure map.png
    """
    from tactile_bayes.api.maps import map_provenance
    from tactile_bayes.commands.progress import progress_bar
    from tactile_bayes.files.map_nc import write_map
    from tactile_bayes.files.provenance import repeated_scans
    from tactile_bayes.files.scan_mcap import read_scan
    from tactile_bayes.mapping import build_map
    from tactile_bayes.report.map_text import map_text

    _check_paths(scans, output, figure, force=force)
    settings = to_plain(MapOptions(**options), digits=EXACT)
    clock = _Clock(verbose)
    loaded = [read_scan(path) for path in scans]
    provenance = map_provenance(scans, loaded, settings)
    for later, earlier in repeated_scans([[facts] for facts in provenance.scans]).items():
        raise UsageError(f"{scans[later]} holds the recording of {scans[earlier]}; give each recording once")
    clock.tell("read")
    with progress_bar("frames") as progress:
        tactile_map = build_map(loaded, **options, progress=progress)
    clock.tell("map")
    write_map(output, tactile_map, provenance=provenance, force=force)
    try:
        if figure:
            from tactile_bayes.report.figure_file import named_exam
            from tactile_bayes.report.map_figure import map_figure

            title = f"Tactile map: {named_exam(output.stem, provenance.scans)}"
            map_figure(tactile_map, figure, title=title, force=force)
        clock.tell("write")
    finally:  # the map is written, whatever becomes of the figure
        click.echo(map_text(tactile_map), nl=False)


def _check_paths(scans: tuple[Path, ...], output: Path, figure: Path | None, *, force: bool) -> None:
    """Raise an error, before any work, for an output that cannot be written or a scan given twice."""
    from tactile_bayes.files.atomic import given_twice, refuse_existing

    if twice := given_twice(scans):
        raise UsageError(f"{twice} is given twice; its frames would count twice: give each scan once")
    for path in [output, *([figure] if figure else [])]:
        refuse_existing(path, force=force)


class _Clock:
    """Prints the time of each step, if requested."""

    def __init__(self, verbose: bool) -> None:
        self._verbose = verbose
        self._last = time.perf_counter()

    def tell(self, step: str) -> None:
        now = time.perf_counter()
        if self._verbose:
            print(f"{step}: {now - self._last:.3f} s", file=sys.stderr)
        self._last = now
