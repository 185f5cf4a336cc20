"""Scans, grids and images of other programs, as `import` brings them in."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import click
import numpy as np

from tactile_bayes.actions.show import describe_scan
from tactile_bayes.declarations import Record, as_dict, names_of, replace
from tactile_bayes.errors import EXIT_DONE, BadDataError, TactileBayesError, UsageError, one_line
from tactile_bayes.files.arrays_layout import ArrayMap, GridOptions, Stated
from tactile_bayes.files.atomic import check_suffix, refuse_existing, refuse_same
from tactile_bayes.files.documents import with_session
from tactile_bayes.files.grids import import_grid
from tactile_bayes.files.imports import calibration_source, head_source, import_arrays, landmark_source, pose_source
from tactile_bayes.files.map_nc import write_map
from tactile_bayes.files.named_arrays import ARRAY_SUFFIXES, array_template, read_array_map
from tactile_bayes.files.provenance import Provenance, hash_inputs
from tactile_bayes.files.scan_mcap import read_scan_report, write_scan
from tactile_bayes.findings import LEADS, finding_lines
from tactile_bayes.mapping.arrangement import check_scan, corrected
from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.scans import Scan
from tactile_bayes.shell import progress_bar

_BESIDE: Final = {"head_geometry": head_source, "array_calibration": calibration_source, "landmarks": landmark_source}


class ImportRequest(Record):
    """What the call asks for, besides its files."""

    kind: str | None
    grid: GridOptions
    corrections: tuple[str, ...]
    session_file: Path | None
    arrays: ArrayMap
    beside: dict[str, Path]  #: Files that complete a scan, by the option that names them.
    force: bool

    @property
    def of_a_scan(self) -> list[str]:
        """Options that were given and that only scans have."""
        given = {"session": self.session_file, "correct": self.corrections}
        return [*(f"--{name}" for name, value in given.items() if value), *self.of_arrays]

    @property
    def of_arrays(self) -> list[str]:
        """Options that were given and that only scans from arrays or tables have."""
        return [f"--{name.replace('_', '-')}" for name in (*self.beside, *self.arrays.given)]


def import_action(
    *, sources: tuple[Path, ...], output: Path | None, template: bool, columns: Path | None, **given: Any
) -> int:
    """Import scans, grids and images from other programs."""
    if template:
        for source in sources or (None,):
            click.echo(array_template(source), nl=False)
        return EXIT_DONE
    if not sources or output is None:
        raise UsageError(f"Missing {'option -o' if sources else 'argument SRC'}; `import --help` has examples")
    stated = Stated(**{name: given.pop(name) for name in names_of(Stated)})
    arrays = replace(ArrayMap() if columns is None else read_array_map(columns), **stated.given)
    beside = {name: path for name in ("poses", *_BESIDE) if (path := given.pop(name)) is not None}
    grid = GridOptions(**{name: given.pop(name) for name in names_of(GridOptions)})
    wanted = ImportRequest(**given, grid=grid, arrays=arrays, beside=beside)
    if len(sources) == 1 and not output.is_dir():
        lines, failed = _import(sources[0], output, wanted), EXIT_DONE
    else:
        lines, failed = _import_each(sources, output, wanted)
    click.echo("\n".join([*lines, RESEARCH_USE]))
    return failed


def _import_each(sources: tuple[Path, ...], folder: Path, wanted: ImportRequest) -> tuple[list[str], int]:
    """Bring each in by itself: what was done, and the code of the first that failed."""
    suffix = {source: ".mcap" if _kind(source, None, wanted) == "scan" else ".nc" for source in sources}
    targets = {source: folder / f"{source.name.partition('.')[0]}{suffix[source]}" for source in sources}
    if len(set(targets.values())) < len(sources):
        raise UsageError(f"two of the files would become one in {folder}; import them into different folders")
    refuse_same(targets.values(), sources)
    if folder.suffix.lower() in (".mcap", ".nc") and not folder.exists():
        raise UsageError(f"{len(sources)} files go into a folder, and {folder} names a file; give a folder")
    made = not folder.exists()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"{folder} is no folder and cannot be made ({error.strerror})") from None
    lines, failed = [], 0
    for source, target in targets.items():
        try:
            lines += _import(source, target, wanted)
        except TactileBayesError as error:
            line = one_line(error)
            click.echo(line if str(source) in line else f"{source}: {line}", err=True)
            failed = failed or error.exit_code
    if made and not lines:
        folder.rmdir()
    return lines, failed


def _kind(source: Path, output: Path | None, wanted: ImportRequest) -> str:
    """Scan or map: as asked, by the output's suffix, by options that only scans have, else by the source's."""
    if wanted.kind is not None:
        return wanted.kind
    given, suffix = source.suffix.lower(), "" if output is None else output.suffix.lower()
    arrays = suffix != ".nc" and (wanted.of_a_scan or given in ARRAY_SUFFIXES)
    return "scan" if arrays or ".mcap" in (given, suffix) else "map"


def _import(source: Path, output: Path, wanted: ImportRequest) -> list[str]:
    refuse_existing(output, force=wanted.force)
    kind = _kind(source, output, wanted)
    check_suffix(output, "MCAP" if kind == "scan" else "netCDF")
    if source.suffix.lower() == ".mcap" and wanted.of_arrays:
        given = " and ".join(wanted.of_arrays)
        raise UsageError(f"{given}: for arrays and tables; {source} is a scan already: leave out")
    if kind == "scan" and wanted.grid != GridOptions():
        changed = [name for name, value in as_dict(wanted.grid).items() if value != getattr(GridOptions(), name)]
        given = " and ".join(f"--{name.replace('_', '-')}" for name in changed)
        raise UsageError(f"{given}: for maps only; leave out or give --as map")
    if kind == "map" and wanted.of_a_scan:
        unit = " (a map's unit is --units)" if wanted.arrays.unit else ""
        raise UsageError(f"{' and '.join(wanted.of_a_scan)}: for scans only; leave out or give --as scan{unit}")
    lines = _import_scan(source, output, wanted) if kind == "scan" else _import_map(source, output, wanted)
    return [f"{output}: {kind}", *lines]


def _import_scan(source: Path, output: Path, wanted: ImportRequest) -> list[str]:
    lost: tuple[str, ...] = ()
    notes: list[str] = []
    truth = None
    if source.suffix.lower() == ".mcap":
        file = read_scan_report(source)
        scan, lost, truth = file.scan, file.lost, file.truth
    else:
        files = wanted.beside.items()
        beside = [pose_source(path, wanted.arrays) if name == "poses" else _BESIDE[name](path) for name, path in files]
        scan, notes = import_arrays(source, wanted.arrays, beside)
    settings = {"as": "scan", "lost": list(lost), "correct": list(wanted.corrections), **wanted.arrays.given}
    scan = corrected(with_session(scan, wanted.session_file), wanted.corrections)
    inputs = hash_inputs(source=source, session=wanted.session_file, **wanted.beside)
    write_scan(output, scan, provenance=Provenance("import", settings, inputs), truth=truth, force=wanted.force)
    return [*describe_scan(scan), *notes, *(f"lost: {line}" for line in lost), *_arrangement_lines(scan)]


def _arrangement_lines(scan: Scan) -> list[str]:
    """What its frames say of the scan; one that no map could be made of is imported all the same."""
    try:
        check = check_scan(scan, thorough=False)
    except BadDataError as error:
        return [f"{LEADS['caution']}no map can be made of it: {error}"]
    return [*finding_lines(check.doubts), *(finding_lines(check.findings_of(scan)) or [check.words])]


def _import_map(source: Path, output: Path, wanted: ImportRequest) -> list[str]:
    with progress_bar("steps", time_left=False) as progress:
        tactile_map, notes = import_grid(source, wanted.grid, progress=progress)
        asked = {**as_dict(wanted.grid), "spacing_mm": tactile_map.recipe.cell_mm}
        provenance = Provenance("import", {"as": "map", **asked, "notes": notes}, inputs=hash_inputs(source=source))
        write_map(output, tactile_map, provenance=provenance, force=wanted.force)
    ny, nx = tactile_map.mean.shape
    low, high = np.nanmin(tactile_map.mean), np.nanmax(tactile_map.mean)
    unit = tactile_map.recipe.value_unit
    unit = "" if unit == "1" else f" {unit or '(unit unknown: give --units)'}"
    level = "unknown" if tactile_map.background is None else f"{tactile_map.background:g}"
    return [
        f"{ny} x {nx} cells of {tactile_map.recipe.cell_mm:g} mm, {int(tactile_map.covered.sum())} with data",
        f"values {low:.4g} to {high:.4g}{unit}, background level {level} (normalise {tactile_map.recipe.normalise})",
        *notes,
        *finding_lines(tactile_map.findings),
    ]
