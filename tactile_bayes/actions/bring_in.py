"""Scans, grids and images of other programs, as `import` brings them in."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, Final

import click
import numpy as np

from tactile_bayes.commands.options import is_folder
from tactile_bayes.declarations import Record, as_dict, names_of, replace
from tactile_bayes.errors import EXIT_DONE, BadDataError, TactileBayesError, UsageError, one_line
from tactile_bayes.files import imports
from tactile_bayes.files.arrays_layout import ArrayMap, GridOptions, Stated
from tactile_bayes.files.atomic import check_suffix, refuse_existing, refuse_same
from tactile_bayes.files.documents import read_session
from tactile_bayes.files.grids import import_grid
from tactile_bayes.files.map_nc import write_map
from tactile_bayes.files.named_arrays import ARRAY_SUFFIXES, Source, array_template, read_array_map
from tactile_bayes.files.provenance import Provenance, hash_inputs
from tactile_bayes.files.scan_mcap import read_scan_report, touched_landmarks, write_scan
from tactile_bayes.findings import LEADS, finding_lines
from tactile_bayes.mapping.arrangement import check_scan
from tactile_bayes.mapping.convention import corrected
from tactile_bayes.mapping.plausibility import MOST_SPAN_MM
from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.report.map import describe_scan
from tactile_bayes.scans import Scan
from tactile_bayes.shell import progress_bar

_LEAST_SPAN_MM: Final = 15.0  #: Range of the places along their longest axis: a stroke is longer.
_LEVERS_MM: Final = (10, 300)  #: Lengths of lever arms; 0 is that of poses of the head.
_SCAN_FILES: Final[Mapping[str, Callable[[Path, ArrayMap, Mapping[str, str]], Source]]] = {
    "poses": lambda path, arrays, _: imports.pose_source(path, arrays),
    "head_geometry": lambda path, *_: imports.head_source(path),
    "array_calibration": lambda path, *_: imports.calibration_source(path),
    "landmarks": lambda path, _, facts: imports.landmark_source(touched_landmarks(path, facts)),
}
"""Readers of files beside the frames', by option; a later one stands for an earlier."""


class ImportRequest(Record):
    """Options of an import besides its sources and output."""

    kind: str | None
    grid: GridOptions
    corrections: tuple[str, ...]
    session_file: Path | None
    arrays: ArrayMap
    scan_files: dict[str, Path]  #: Files that complete a scan, by the option that names them.
    force: bool

    @property
    def scan_options(self) -> list[str]:
        """The options of this call that only scans have."""
        landmarks = self.scan_files.get("landmarks")
        values = {"session": self.session_file, "correct": self.corrections, "landmarks": landmarks}
        return [*(f"--{name}" for name, value in values.items() if value), *self.array_options]

    @property
    def array_options(self) -> list[str]:
        """The options of this call that only scans from arrays or tables have."""
        return _flags([*(name for name in self.scan_files if name != "landmarks"), *self.arrays.given])


def _flags(names: Iterable[str]) -> list[str]:
    return [f"--{name.replace('_', '-')}" for name in names]


def import_action(
    *, sources: tuple[Path, ...], output: Path | None, template: bool, columns: Path | None, **options: Any
) -> int:
    """Import scans, grids and images from other programs."""
    if template:
        for source in sources or (None,):
            click.echo(array_template(source), nl=False)
        return EXIT_DONE
    if not sources or output is None:
        raise UsageError(f"Missing {'option -o' if sources else 'argument SRC'}; `import --help` has examples")
    stated = Stated(**{name: options.pop(name) for name in names_of(Stated)})
    arrays = replace(ArrayMap() if columns is None else read_array_map(columns), **stated.given)
    scan_files = {name: path for name in _SCAN_FILES if (path := options.pop(name)) is not None}
    grid = GridOptions(**{name: options.pop(name) for name in names_of(GridOptions)})
    request = ImportRequest(**options, grid=grid, arrays=arrays, scan_files=scan_files)
    if len(sources) == 1 and not is_folder(output):
        lines, exit_code = _import(sources[0], output, request), EXIT_DONE
    else:
        lines, exit_code = _import_each(sources, output, request)
    click.echo("\n".join([*lines, RESEARCH_USE]))
    return exit_code


def _import_each(sources: tuple[Path, ...], folder: Path, request: ImportRequest) -> tuple[list[str], int]:
    """Import each source into the folder: lines to print, and the exit code of the first that failed."""
    suffix = {source: ".mcap" if _kind(source, None, request) == "scan" else ".nc" for source in sources}
    targets = {source: folder / f"{source.name.partition('.')[0]}{suffix[source]}" for source in sources}
    if len(set(targets.values())) < len(sources):
        raise UsageError(f"two of the files would become one in {folder}; import them into different folders")
    refuse_same(targets.values(), sources)
    if folder.suffix.lower() in (".mcap", ".nc") and not folder.exists():
        files = "1 file goes" if len(sources) == 1 else f"{len(sources)} files go"
        raise UsageError(f"{files} into a folder, and {folder} names a file; give a folder")
    is_new = not folder.exists()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"{folder} is no folder and cannot be made ({error.strerror})") from None
    lines, exit_code = [], EXIT_DONE
    for source, target in targets.items():
        try:
            lines += _import(source, target, request)
        except TactileBayesError as error:
            line = one_line(error)
            click.echo(f"error: {line}" if str(source) in line else f"error: {source}: {line}", err=True)
            exit_code = exit_code or error.exit_code
    if is_new and not lines:
        folder.rmdir()
    return lines, exit_code


def _kind(source: Path, output: Path | None, request: ImportRequest) -> str:
    """Scan or map: by ``--as``, the output's suffix, options that only scans have, or the source's suffix."""
    if request.kind is not None:
        return request.kind
    suffix, written = source.suffix.lower(), "" if output is None else output.suffix.lower()
    arrays = written != ".nc" and (request.scan_options or suffix in ARRAY_SUFFIXES)
    return "scan" if arrays or ".mcap" in (suffix, written) else "map"


def _import(source: Path, output: Path, request: ImportRequest) -> list[str]:
    refuse_existing(output, force=request.force)
    kind = _kind(source, output, request)
    check_suffix(output, "MCAP" if kind == "scan" else "netCDF")
    if source.suffix.lower() == ".mcap" and request.array_options:
        flags = " and ".join(request.array_options)
        raise UsageError(f"{flags}: for arrays and tables; {source} is a scan already: leave out")
    if kind == "scan" and request.grid != GridOptions():
        changed = [name for name, value in as_dict(request.grid).items() if value != getattr(GridOptions(), name)]
        raise UsageError(f"{' and '.join(_flags(changed))}: for maps only; leave out or give --as map")
    if kind == "map" and request.scan_options:
        unit = " (a map's unit is --units)" if request.arrays.unit else ""
        raise UsageError(f"{' and '.join(request.scan_options)}: for scans only; leave out or give --as scan{unit}")
    lines = _import_scan(source, output, request) if kind == "scan" else _import_map(source, output, request)
    return [f"{output}: {kind}", *lines]


def _import_scan(source: Path, output: Path, request: ImportRequest) -> list[str]:
    lost: tuple[str, ...] = ()
    notes: list[str] = []
    truth, facts = None, read_session(request.session_file)
    if source.suffix.lower() == ".mcap":
        file = read_scan_report(source)
        scan, lost, truth = file.scan, file.lost, file.truth
        if landmarks := request.scan_files.get("landmarks"):
            scan = replace(scan, landmarks=touched_landmarks(landmarks, {**scan.session, **facts}))
    else:
        parts = [
            replace(_SCAN_FILES[name](path, request.arrays, facts), path=str(path))
            for name, path in request.scan_files.items()
        ]
        scan, notes = imports.import_arrays(source, request.arrays, parts)
        notes.insert(0, _lengths(scan))
    settings = {"as": "scan", "lost": list(lost), "correct": list(request.corrections), **request.arrays.given}
    scan = corrected(replace(scan, session={**scan.session, **facts}), request.corrections)
    inputs = hash_inputs(source=source, session=request.session_file, **request.scan_files)
    write_scan(output, scan, provenance=Provenance("import", settings, inputs), truth=truth, force=request.force)
    return [*describe_scan(scan), *notes, *_arrangement_lines(scan)]


def _lengths(scan: Scan) -> str:
    """Lengths of a scan in a line, by which a wrong unit shows."""
    lever = float(np.linalg.norm(scan.head.scanhead_from_tracker[:3, 3]))
    sides = np.ptp(scan.poses.position_mm, axis=0)
    moved = " x ".join(f"{side:.0f}" for side in sides)
    turned = "" if np.ptp(scan.poses.quaternion_wxyz, axis=0).any() else " without turning"
    line = f"the sensor lies {lever:.3g} mm from the head, and moved by {moved} mm{turned}"
    if sides.max() > MOST_SPAN_MM:
        odd = "no breast is so large"
    elif sides.max() < _LEAST_SPAN_MM:
        odd = "no breast is so small"
    elif lever and not _LEVERS_MM[0] <= lever <= _LEVERS_MM[1]:
        odd = f"most sensors lie {_LEVERS_MM[0]} to {_LEVERS_MM[1]} mm from it"
    else:
        return line
    return f"{LEADS['check']}{line}: {odd}; check their unit"


def _arrangement_lines(scan: Scan) -> list[str]:
    """Findings of the scan's frames, a line each; a caution where no map can be made of it."""
    try:
        check = check_scan(scan, thorough=False)
    except BadDataError as error:
        return [*finding_lines(scan.findings), f"{LEADS['caution']}no map can be made of it: {error}"]
    return [*finding_lines(check.doubts), *(finding_lines(check.findings_of(scan)) or [check.words])]


def _import_map(source: Path, output: Path, request: ImportRequest) -> list[str]:
    with progress_bar("steps", time_left=False) as progress:
        tactile_map, notes = import_grid(source, request.grid, progress=progress)
        settings = {"as": "map", **as_dict(request.grid), "spacing_mm": tactile_map.recipe.cell_mm, "notes": notes}
        provenance = Provenance("import", settings, inputs=hash_inputs(source=source))
        write_map(output, tactile_map, provenance=provenance, force=request.force)
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
