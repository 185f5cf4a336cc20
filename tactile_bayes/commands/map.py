"""`map`: from scans to a tactile map."""

from __future__ import annotations

import sys
import time
from pathlib import Path

import click

from tactile_bayes.commands.options import FORCE, METAVAR, PRESSURE_WINDOW, FigurePath, FilePath, NumberOr
from tactile_bayes.errors import UsageError
from tactile_bayes.presets import CELL_MM, DEFAULT_NORMALISE, NORMALISE

_FILE = FilePath()


@click.command("map")
@click.argument("scans", metavar="SCAN.mcap...", nargs=-1, required=True, type=_FILE)
@click.option(
    "-o", "--output", required=True, metavar="MAP.nc", type=FilePath(writes="netCDF"), help="Where to write the map."
)
@click.option("--cell-mm", type=float, default=CELL_MM, show_default=True, help="Side of the square cells, mm.")
@PRESSURE_WINDOW
@click.option(
    "--normalise",
    type=click.Choice(NORMALISE),
    default=DEFAULT_NORMALISE,
    show_default=True,
    help="gain: estimate one gain per frame; mean: divide each frame by its mean (the paper); none: keep kPa.",
)
@click.option(
    "--latency-ms",
    type=NumberOr("auto"),
    metavar="MS|auto",
    default="0",
    show_default=True,
    help="Delay of the tracker's time stamps; auto: estimate it from the scan, or refuse.",
)
@click.option(
    "--plane-radius-mm",
    type=NumberOr("auto", "all"),
    metavar="MM|auto|all",
    default="all",
    show_default=True,
    help="Fit the plane to frames within this distance of the mass; auto: those whose array can reach it.",
)
@click.option("--flat-field", is_flag=True, help="Remove the head's own response, measured on frames without a lump.")
@click.option(
    "--register-strokes", is_flag=True, help="Align the strokes with each other, for a lump that moves with the head."
)
@click.option(
    "--every",
    type=click.IntRange(min=1),
    metavar="N",
    default=1,
    show_default=True,
    help="Use one frame of every N: quicker, and noisier; `tradeoff map` measures both.",
)
@click.option("--figure", metavar=METAVAR, type=FigurePath(), help="Draw the map and its coverage.")
@FORCE
@click.option("-v", "--verbose", is_flag=True, help="Print the time of each step on stderr.")
def command(
    scans: tuple[Path, ...],
    output: Path,
    cell_mm: float,
    pressure_window_kpa: tuple[float, float],
    normalise: str,
    latency_ms: float | str,
    plane_radius_mm: float | str,
    flat_field: bool,
    register_strokes: bool,
    every: int,
    figure: Path | None,
    force: bool,
    verbose: bool,
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
    settings = {
        "cell_mm": cell_mm,
        "pressure_window_kpa": list(pressure_window_kpa),
        "normalise": normalise,
        "latency_ms": latency_ms,
        "plane_radius_mm": plane_radius_mm,
        "flat_field": flat_field,
        "register_strokes": register_strokes,
        "every": every,
    }
    clock = _Clock(verbose)
    loaded = [read_scan(path) for path in scans]
    provenance = map_provenance(scans, loaded, settings)
    for later, earlier in repeated_scans([[facts] for facts in provenance.scans]).items():
        raise UsageError(f"{scans[later]} holds the recording of {scans[earlier]}; give each recording once")
    clock.tell("read")
    with progress_bar("frames") as progress:
        tactile_map = build_map(
            loaded,
            cell_mm=cell_mm,
            pressure_window_kpa=pressure_window_kpa,
            normalise=normalise,
            latency_ms=latency_ms,
            plane_radius_mm=None if plane_radius_mm == "all" else plane_radius_mm,
            flat_field=flat_field,
            register_strokes=register_strokes,
            every=every,
            progress=progress,
        )
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
