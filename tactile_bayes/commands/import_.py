"""`import`: import scans, grids and images from other programs."""

from __future__ import annotations

from inspect import cleandoc
from pathlib import Path
from typing import TYPE_CHECKING

import click

from tactile_bayes.commands.options import FORCE, SESSION, FilePath
from tactile_bayes.files.arrays_layout import layout_lines
from tactile_bayes.presets import NORMALISE, RESEARCH_USE

if TYPE_CHECKING:
    from tactile_bayes.geometry import FloatArray
    from tactile_bayes.mapping.map import TactileMap
    from tactile_bayes.scan import Scan

_LONGEST_UNITS = 20


@click.command("import")
@click.argument("source", metavar="SRC", type=FilePath())
@click.option("-o", "--output", required=True, type=FilePath(), help="File to write: .mcap or .nc.")
@click.option(
    "--as",
    "kind",
    type=click.Choice(["scan", "map"]),
    help="What SRC holds. Default: a map if the output ends in .nc or SRC is a table or an image, otherwise a scan.",
)
@click.option("--spacing-mm", type=float, metavar="H", help="Map: side of the square cells, in mm.")
@click.option(
    "--normalise",
    type=click.Choice(NORMALISE),
    help="Map: how the values are already normalised. Default: none.",
)
@click.option(
    "--units", metavar="TEXT", help="Map: unit of values that are not normalised, such as kPa. Default: unknown."
)
@SESSION
@FORCE
def command(
    *,
    source: Path,
    output: Path,
    kind: str | None,
    spacing_mm: float | None,
    normalise: str | None,
    units: str | None,
    session_file: Path | None,
    force: bool,
) -> None:
    """Import scans, grids and images from other programs.

    SRC is an .npz of raw counts and poses (a scan), a scan file to repair (what is intact is kept), or a grid of
    values (a map): .npz with `mean`, .csv (commas, semicolons or tabs), or a grey .tif, .pgm or .png image. The first
    row of a grid has the lowest y and the first column the lowest x; pictures of the map show the first row on top,
    as the file reads.
    """
    from tactile_bayes.errors import UsageError
    from tactile_bayes.files.atomic import check_suffix, refuse_existing

    refuse_existing(output, force=force)
    kind = kind or _kind_of(source, output)
    check_suffix(output, "MCAP" if kind == "scan" else "netCDF")
    if kind == "scan" and (spacing_mm is not None or normalise is not None or units is not None):
        raise UsageError("--spacing-mm, --normalise and --units are for maps; leave them out or give --as map")
    if kind == "map" and session_file is not None:
        raise UsageError("--session is for scans; leave it out or give --as scan")
    _check_units(units, normalise)
    if kind == "scan":
        lines = _import_scan(source, output, session_file, force=force)
    else:
        lines = _import_map(
            source, output, spacing_mm=spacing_mm, normalise=normalise or "none", units=units or "", force=force
        )
    for line in (f"{output}: {kind}", *lines, RESEARCH_USE):
        click.echo(line)


_HEADING = "Arrays of a scan in an .npz file, in mm, kPa and s, for n frames and m poses:"
_ARRAYS = "\n".join([_HEADING, "", "\b", *layout_lines()])
command.help = f"{cleandoc(command.help or '')}\n\n{_ARRAYS}"


def _kind_of(source: Path, output: Path) -> str:
    """Default kind of output: a map where the output is .nc or the source can only be a grid."""
    as_map = output.suffix.lower() == ".nc" and source.suffix.lower() != ".mcap"
    return "scan" if source.suffix.lower() in (".npz", ".mcap") and not as_map else "map"


def _check_units(units: str | None, normalise: str | None) -> None:
    from tactile_bayes.errors import UsageError

    if units is None:
        return
    if normalise not in (None, "none"):
        raise UsageError(f"--units is for values that were not divided; leave it out or --normalise {normalise}")
    if not (units.isprintable() and 0 < len(units.strip()) <= _LONGEST_UNITS):
        raise UsageError(f"--units {units[:30]!r} is not a unit; give up to {_LONGEST_UNITS} letters, such as kPa")


def _import_scan(source: Path, output: Path, session_file: Path | None, *, force: bool) -> list[str]:
    from tactile_bayes.files.documents import with_session
    from tactile_bayes.files.provenance import Provenance, hash_inputs
    from tactile_bayes.files.scan_mcap import read_scan_report, read_truth, write_scan

    lost: tuple[str, ...] = ()
    truth = None
    if source.suffix.lower() == ".mcap":
        file = read_scan_report(source)
        scan, lost, truth = file.scan, file.lost, read_truth(source)
    else:
        from tactile_bayes.files.imports import read_arrays

        scan = read_arrays(source)
    files = {"source": source} | ({"session": session_file} if session_file else {})
    provenance = Provenance("import", {"as": "scan", "lost": list(lost)}, inputs=hash_inputs(**files))
    write_scan(output, with_session(scan, session_file), provenance=provenance, truth=truth, force=force)
    return [*describe_scan(scan), *(f"lost: {line}" for line in lost)]


def _import_map(
    source: Path, output: Path, *, spacing_mm: float | None, normalise: str, units: str, force: bool
) -> list[str]:
    from tactile_bayes.files.imports import read_grid
    from tactile_bayes.files.map_nc import write_map
    from tactile_bayes.files.provenance import Provenance, hash_inputs

    tactile_map = read_grid(source, spacing_mm=spacing_mm, normalise=normalise, units=units)
    settings = {"as": "map", "spacing_mm": tactile_map.recipe.cell_mm, "normalise": normalise, "units": units}
    provenance = Provenance("import", settings, inputs=hash_inputs(source=source))
    write_map(output, tactile_map, provenance=provenance, force=force)
    return _describe_map(tactile_map)


def _describe_map(tactile_map: TactileMap) -> list[str]:
    import numpy as np

    ny, nx = tactile_map.mean.shape
    covered = int(tactile_map.covered.sum())
    low, high = np.nanmin(tactile_map.mean), np.nanmax(tactile_map.mean)
    level = "unknown" if tactile_map.background is None else f"{tactile_map.background:g}"
    return [
        f"{ny} x {nx} cells of {tactile_map.recipe.cell_mm:g} mm, {covered} with data",
        f"values {low:.4g} to {high:.4g}{_unit(tactile_map)}, background level {level} "
        f"(normalise {tactile_map.recipe.normalise})",
    ]


def _unit(tactile_map: TactileMap) -> str:
    """Unit of the values, to follow them; empty where they were divided by a level."""
    unit = tactile_map.recipe.value_unit
    return "" if unit == "1" else f" {unit or '(unit unknown: give --units)'}"


def describe_scan(scan: Scan) -> list[str]:
    """Summary of a scan in a few lines."""
    times, poses = scan.frames.time_s, scan.poses
    span = float(times[-1] - times[0]) if len(times) else 0.0
    calibration = scan.element_calibration
    saturated = int((scan.frames.counts >= calibration.saturation_count).sum())
    marks = [] if scan.landmarks is None else [name.replace("_", " ") for name in scan.landmarks.points()]
    return [
        f"{len(times)} frames of {scan.head.shape[0]} x {scan.head.shape[1]} taxels in {span:.3f} s, {_rate(times)}",
        f"{len(poses)} poses, {_rate(poses.time_s)}",
        f"dropped frames {_dropped(times)}, dropped poses {_dropped(poses.time_s)}, "
        f"duplicate pose stamps {_duplicates(poses.time_s)}, saturated readings {saturated}",
        f"landmarks: {' and '.join(', '.join(marks).rsplit(', ', 1)) or 'not touched'}",
    ]


def _rate(times: FloatArray) -> str:
    import numpy as np

    steps = np.diff(times)
    steps = steps[steps > 0]
    return f"{1 / np.median(steps):.1f} Hz" if len(steps) else "no rate"


def _dropped(times: FloatArray) -> int:
    """Number of records missing, by the median period."""
    import numpy as np

    steps = np.diff(times)
    if not (steps > 0).any():
        return 0
    periods = np.rint(steps / np.median(steps[steps > 0]))
    return int(np.clip(periods - 1, 0, None).sum())


def _duplicates(times: FloatArray) -> int:
    import numpy as np

    return int((np.diff(times) == 0).sum())
