"""Scans and maps in Python: read, simulate, build, make of arrays."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tactile_bayes.api.arguments import (
    PathLike,
    dataframe,
    door,
    list_of,
    output_path,
    path_of,
    plain,
    required_path,
    table_of,
    takes,
)
from tactile_bayes.declarations import EXACT, Record, as_dict, from_plain, replace, to_plain
from tactile_bayes.errors import UsageError, check_choice, check_number
from tactile_bayes.files import imports, scan_mcap
from tactile_bayes.files.arrays_layout import ArrayMap, GridOptions, Stated
from tactile_bayes.files.atomic import sha256
from tactile_bayes.files.documents import read_session
from tactile_bayes.files.grids import GRID_SUFFIXES, grid_map, import_grid
from tactile_bayes.files.instrument import head_geometry, read_scene, scene_of
from tactile_bayes.files.map_nc import read_map_and_scans, write_map
from tactile_bayes.files.named_arrays import Grid, Source, read_array_map, step_of
from tactile_bayes.files.provenance import Provenance, repeated_scans, scan_facts
from tactile_bayes.files.scan_text import kind_of_column, read_poses
from tactile_bayes.findings import Finding, finding_lines
from tactile_bayes.forward.scene import SimulatedScan
from tactile_bayes.geometry import FloatArray
from tactile_bayes.mapping.arrangement import ArrangementCheck, check_scan
from tactile_bayes.mapping.build import build_map as build
from tactile_bayes.mapping.cells import MAX_POSE_GAP_MS
from tactile_bayes.mapping.convention import corrected
from tactile_bayes.mapping.map import TactileMap
from tactile_bayes.options import MapOptions
from tactile_bayes.presets import CORRECTIONS, PRESSURE_WINDOW_KPA, RESEARCH_USE
from tactile_bayes.progress import Progress, no_progress
from tactile_bayes.report.map import map_figure
from tactile_bayes.scans import ElementCalibration, HeadGeometry, Landmarks, Scan, TrackerPoses

if TYPE_CHECKING:
    import pandas
    from matplotlib.figure import Figure


# --- Scans and tactile maps: read, simulate, build, show.

_DEMO = Path(__file__).resolve().parents[1] / "demo" / "scan.mcap"


class Map(Record, eq=False):
    """A tactile map: mean normalised pressure in square cells of the best-fit plane."""

    tactile_map: TactileMap  #: Arrays, recipe and quality.
    path: Path | None = None  #: The file that it was read from; None for a map that is in none.
    scans: tuple[dict[str, str], ...] = ()  #: The scans that it was made from, as `Provenance.scans` has them.

    @property
    def mean(self) -> FloatArray:
        """(ny, nx) mean normalised pressure; NaN in cells without readings."""
        return np.where(self.tactile_map.covered, self.tactile_map.mean, np.nan)

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Findings against sizes from this map, cautions first."""
        return self.tactile_map.findings

    @property
    def x_mm(self) -> FloatArray:
        """(nx,) centres of the cells across the head."""
        return self.tactile_map.x_mm

    @property
    def y_mm(self) -> FloatArray:
        """(ny,) centres of the cells along the head."""
        return self.tactile_map.y_mm

    def to_dataframe(self) -> pandas.DataFrame:
        """One row for each cell with data: x_mm, y_mm, mean, variance, count."""
        tactile_map = self.tactile_map
        rows, columns = np.nonzero(tactile_map.covered)
        centres = {"x_mm": tactile_map.x_mm[columns], "y_mm": tactile_map.y_mm[rows]}
        values = {name: getattr(tactile_map, name)[rows, columns] for name in ("mean", "variance", "count")}
        return dataframe({**centres, **values})

    @door
    def plot(self, path: PathLike | None = None, *, force: bool = False) -> Figure:
        """Draw the map beside its coverage; with a path also write it as PNG, PDF or SVG."""
        return map_figure(self.tactile_map, path_of(path), force=force)

    @door
    def save(self, path: PathLike, *, force: bool = False) -> None:
        """Write the map as `tactile-bayes map` does, for `estimate` and other programs.

        Raises
        ------
        UsageError
            When the file exists and `force` is false.
        """
        provenance = Provenance("map", {"called_from": "Python", **as_dict(self.tactile_map.recipe)}, scans=self.scans)
        write_map(output_path(path, "netCDF"), self.tactile_map, provenance=provenance, force=force)

    def __repr__(self) -> str:
        tactile_map = self.tactile_map
        ny, nx = tactile_map.mean.shape
        covered = int(tactile_map.covered.sum())
        recipe = tactile_map.recipe
        cells = f"{nx} x {ny} cells of {recipe.cell_mm:g} mm, {covered} with data, {recipe.value_words}"
        return f"<Map {' '.join([*finding_lines(tactile_map.findings, paper=True), cells])}>"

    def _repr_html_(self) -> str:
        return f"<p>{escape(repr(self))}</p><p><small>{escape(RESEARCH_USE)}</small></p>"


@door
def read_scan(path: PathLike) -> Scan:
    """Read a scan file (``.mcap``).

    Raises
    ------
    BadDataError
        When the file is no scan, or is damaged.
    """
    return scan_mcap.read_scan(required_path(path, "path"))


@door
def read_map(path: PathLike) -> Map:
    """Read a map (``.nc``).

    Raises
    ------
    BadDataError
        When the file is no map, or is damaged.
    """
    source = required_path(path, "path")
    tactile_map, scans = read_map_and_scans(source)
    return Map(tactile_map, source, scans=scans)


@takes(MapOptions)
def build_map(
    scans: Any, *, max_pose_gap_ms: float = MAX_POSE_GAP_MS, progress: Progress = no_progress, **options: Any
) -> Map:
    """Build one map from a scan, or from several scans of one examination.

    Parameters
    ----------
    scans
        A scan, a simulated scan, a path, or a sequence of them.
    max_pose_gap_ms
        Frames between two distinct poses further apart are left out.
    progress
        Called with the numbers of frames done and in all.
    **options
        As of `tactile_bayes.options.MapOptions`: cell_mm, pressure_window_kpa, normalise...

    Raises
    ------
    BadDataError
        When a file is no scan, or no frame is left.
    UsageError
        When an option is out of range, or a recording is given twice.
    """
    sources = [scans] if isinstance(scans, str | Path) or not isinstance(scans, Sequence) else list(scans)
    loaded = [as_scan(source) for source in sources]
    digests = (sha256(path_of(one)) if isinstance(one, str | Path) else "" for one in sources)
    facts = [scan_facts(scan, digest) for scan, digest in zip(loaded, digests, strict=True)]
    for later, earlier in repeated_scans([[fact] for fact in facts]).items():
        raise UsageError(
            f"scan {later + 1} is the recording of scan {earlier + 1}, whose frames would count twice; give it once"
        )
    return Map(build(loaded, max_pose_gap_ms=max_pose_gap_ms, progress=progress, **options), scans=tuple(facts))


@door
def check(scan: Any, *, pressure_window_kpa: tuple[float, float] = PRESSURE_WINDOW_KPA) -> ArrangementCheck:
    """Compare a scan's stated array, lever arm and quaternions with other arrangements.

    Parameters
    ----------
    scan
        A scan, a simulated scan, or a path.
    pressure_window_kpa
        Frames with a mean pressure outside are left out.

    Returns
    -------
    ArrangementCheck
        `words` says what its frames agree with, `lines()` in full; `too_short` where they are too few.

    Raises
    ------
    BadDataError
        When the file is no scan, or no frame is left.
    UsageError
        When it is no scan, or the window is wrong.
    """
    window = MapOptions(pressure_window_kpa=plain(pressure_window_kpa)).pressure_window_kpa
    return check_scan(as_scan(scan), pressure_window_kpa=window)


def as_scan(source: Any) -> Scan:
    """Return the scan of a path, a `Scan` or a simulated scan; refuse anything else."""
    scan = read_scan(source) if isinstance(source, str | Path) else getattr(source, "scan", source)
    if not isinstance(scan, Scan):
        kind = type(source).__name__
        raise UsageError(f"a scan is wanted, not {kind}; read one with read_scan, or make one of arrays with tb.scan")
    return scan


@door
def simulate(
    scene: PathLike | Mapping[str, Any],
    *,
    seed: int | None = None,
    fidelity: str | None = None,
    head: str | None = None,
) -> SimulatedScan:
    """Make a scan with known truth from a scene.

    Parameters
    ----------
    scene
        Path of a TOML file, or what stands in it: ``{"lump": [{"d_mm": 15, "depth_ratio": 1}]}``.
    seed
        Random seed. Default: the scene's.
    fidelity, head
        As of `tactile-bayes simulate`.

    Returns
    -------
    SimulatedScan
        `scan`, and `truth` as plain data.

    Raises
    ------
    BadDataError
        Naming the key of the scene, its value and the way out.
    UsageError
        When the scene is neither, or the seed is wrong.
    """
    from tactile_bayes.forward.simulate import simulate as run

    parsed = (
        scene_of(to_plain(dict(scene), digits=EXACT))
        if isinstance(scene, Mapping)
        else read_scene(required_path(scene, "scene"))
    )
    scan_seed = parsed.seed if seed is None else seed
    check_number("seed", scan_seed, 0, whole=True)
    return run(parsed, rng=np.random.default_rng(scan_seed), fidelity=fidelity, head=head)


def demo_scan() -> Scan:
    """Return the scan that comes with the program: a simulated lump of 15 mm."""
    return read_scan(_DEMO)


def demo_map() -> Map:
    """Return the map of `demo_scan`."""
    return build_map(_DEMO)


@takes(GridOptions)
def map_of(given: Any, **stated: Any) -> Map:
    """Make a map of values in rows and columns, for `estimate`.

    Parameters
    ----------
    given
        (ny, nx) values, the lowest y and x first, NaN where there is none, also of pandas or xarray; or the path of a
        file that `tactile-bayes import` takes as a map. Without `stated` also a map as it is: a `Map`, a `TactileMap`,
        or the path of a map.
    **stated
        As of `tactile_bayes.files.arrays_layout.GridOptions`: spacing_mm, normalise, level, units, no_value, array.

    Returns
    -------
    Map
        For `estimate`; its `findings` hold what was fitted.

    Raises
    ------
    BadDataError
        When values are wrong: numbers that stand for no value, another level than stated, a damaged file.
    UsageError
        When it is none of these, its own places are mirrored or turned, or an argument is wrong.
    """
    if isinstance(given, Map | TactileMap):
        if stated:
            raise UsageError(f"{next(iter(stated))} is for values and files of values; a map has its own, leave it out")
        return given if isinstance(given, Map) else Map(given)
    path = path_of(given) if isinstance(given, str | Path) else None
    if path is not None and not stated and path.suffix.lower() not in GRID_SUFFIXES:
        return read_map(path)
    if path is None and (not stated or not hasattr(given, "__array__")):
        way_out = "build one with build_map, give a path, or map_of(numpy.array(...), spacing_mm=...)"
        if isinstance(given, list | tuple) and not stated and not any(isinstance(one, list | tuple) for one in given):
            way_out = "give one map after the other, or pool the maps of one mass with pool"
        raise UsageError(f"a map is wanted, not {type(given).__name__}; {way_out}")
    marks = stated.get("no_value", ())
    marks = [marks] if isinstance(marks, str) or not isinstance(marks, Iterable) else marks
    no_value = tuple(mark if isinstance(mark, str) else repr(plain(mark)) for mark in marks)
    options = GridOptions(**stated | {"no_value": no_value})
    if path is not None:
        return Map(import_grid(path, options)[0])
    steps = _own_steps(given)
    values = given.filled(np.nan) if isinstance(given, np.ma.MaskedArray) else np.asarray(given)
    return Map(grid_map(Grid({"mean": values}, steps=steps), options)[0])


def _own_steps(given: Any) -> tuple[float, ...]:
    """Steps of the own places of values of pandas or xarray, which are refused if these are turned or mirrored."""
    names = tuple(map(str, getattr(given, "dims", ())))
    if names == ("x", "y"):
        raise UsageError("the values are (x, y) by their dims; give (y, x): values.transpose('y', 'x')")
    axes = [given.index, given.columns] if hasattr(given, "columns") else [given[name] for name in names]
    pairs = zip(("rows", "columns"), map(np.asarray, axes), strict=False)
    numbered = [(axis, places) for axis, places in pairs if places.dtype.kind in "iuf"]
    for axis, places in numbered:
        if (np.diff(places) < 0).any():
            first, last = places[0], places[-1]
            raise UsageError(f"the {axis}' own places go from {first:g} to {last:g}; give the lowest first")
    return tuple(step for axis, places in numbered if (step := step_of(f"the {axis}' own place", places)))


# --- A scan of arrays that Python holds, as `import` makes one of a file.


@takes(Stated, renamed=(("head_geometry", "head"), ("array_calibration", "calibration")))
def scan(
    frames: Any,
    time: Any = None,
    poses: Any = None,
    *,
    head: Any = None,
    calibration: Any = None,
    landmarks: Any = None,
    columns: PathLike | Mapping[str, Any] | None = None,
    correct: tuple[str, ...] = (),
    session: PathLike | None = None,
    **stated: Any,
) -> Scan:
    """Make a scan of arrays, or of a file of arrays, for `build_map`.

    Parameters
    ----------
    frames
        (n, rows, columns) readings, rows across the head; (n, rows x columns) is folded as the head is. Or the path of
        a file that `tactile-bayes import` reads; `time` and `poses` may then stand in it.
    time
        (n,) times of the frames, s, or `rate_hz` in its place.
    poses
        Of the tracker's sensor in its base: ``(time, matrices)`` with (m, 4, 4) homogeneous matrices, ``(time,
        position, quaternion)`` with mm and the scalar first, or (m, 8) numbers in that order. Or a table of the
        tracker's, as `--poses` takes: its path, or a DataFrame with named columns.
    head
        Path of a HEAD.json, what stands in it, or the head of another scan: ``pitch_mm``, ``surface_mm`` or ``rows``,
        ``columns`` and ``radius_mm``, and ``scanhead_from_tracker``.
    calibration
        Of raw counts: a path, the calibration of another scan, or gain (kPa a count) and offset (kPa).
    landmarks
        A path, the landmarks of another scan, or (2, 3) sternal notch and xiphoid in mm, with the nipple (3, 3).
    columns, correct, session
        As `--columns`, `--correct` and `--session` of `tactile-bayes import`.
    **stated
        As of `tactile_bayes.files.arrays_layout.Stated`: unit, saturation, rate_hz, frame_shape, time_unit...

    Returns
    -------
    Scan
        ``session["imported_as"]`` says what was guessed.

    Raises
    ------
    BadDataError
        Naming the array, its value and the way out.
    UsageError
        When an argument is wrong.
    """
    corrections = tuple(list_of("correct", correct, "corrections"))
    for name in corrections:
        check_choice("a correction", name, CORRECTIONS)
    columns = {} if columns is None else columns
    if isinstance(columns, Mapping):
        named = from_plain(ArrayMap, dict(columns), where="columns")
    else:
        named = read_array_map(path_of(columns))
    layout = replace(named, **{name: value for name, value in stated.items() if value is not None})
    times = Source({} if time is None else {"frame_time_s": _array(time)})
    if time is not None and layout.time_unit is None:
        layout = replace(layout, time_unit="s")  # whatever unit a file has
    facts = read_session(path_of(session))
    others = [times, _poses(poses, layout), _head(head), _calibration(calibration), _landmarks(landmarks, facts)]
    if isinstance(frames, str | Path):
        imported, _ = imports.import_arrays(path_of(frames), layout, others)
    else:
        arrays = {"frames": _array(frames)}
        if not arrays["frames"].ndim:
            raise UsageError(f"frames is {type(frames).__name__}; give (n, rows, columns) numbers, or a path")
        imported, _ = imports.combine_sources([Source(arrays), *others], layout)
    for line in finding_lines(imported.findings):
        warnings.warn(line, stacklevel=4)
    return corrected(replace(imported, session={**imported.session, **facts}), corrections)


def _array(values: Any) -> Any:
    """Convert to an array: masked values become NaN, dates s since 1970."""
    if isinstance(values, np.ma.MaskedArray):
        return np.ma.filled(values.astype(np.float64), np.nan)
    array = np.asarray(values)
    if array.dtype.kind in "Mm":
        return array.astype(f"{array.dtype.kind}8[ns]").astype(np.int64) / 1e9
    return array


def _poses(poses: Any, stated: ArrayMap) -> Source:
    """Convert times, positions and rotations in any form that `scan` takes."""
    if poses is None:
        return Source({})
    if isinstance(poses, str | Path):
        return imports.pose_source(path_of(poses), stated)
    if isinstance(poses, TrackerPoses):
        poses = poses.time_s, poses.position_mm, poses.quaternion_wxyz
    elif any(kind_of_column(str(name)) for name in getattr(poses, "columns", ())):
        return read_poses(table_of(poses, "poses"), stated)
    elif not isinstance(poses, tuple | list) or len(poses) not in (2, 3):
        numbers = _array(poses)
        if numbers.ndim != 2 or numbers.shape[1] != 8:
            raise UsageError(
                f"poses is {type(poses).__name__} of shape {numbers.shape}; give (time, matrices), (time, position, "
                "quaternion) or (m, 8) numbers"
            )
        poses = numbers[:, 0], numbers[:, 1:4], numbers[:, 4:]
    names = ("pose_time_s", "pose_matrix") if len(poses) == 2 else ("pose_time_s", "position_mm", "quaternion_wxyz")
    return Source({name: _array(value) for name, value in zip(names, poses, strict=True)})


def _head(head: Any) -> Source:
    if isinstance(head, Mapping):
        document = {"schema": "tactile-bayes/head/1", **to_plain(dict(head), digits=EXACT)}
        return imports.head_source(head_geometry(document, path=Path("head")))
    return _source_of("head", head, HeadGeometry, imports.head_source)


def _calibration(calibration: Any) -> Source:
    if isinstance(calibration, tuple | list) and len(calibration) == 2:
        return Source({"gain_kpa_per_count": _array(calibration[0]), "offset_kpa": _array(calibration[1])})
    part = "element_calibration"
    return _source_of("calibration", calibration, ElementCalibration, imports.calibration_source, part=part)


def _landmarks(landmarks: Any, facts: Mapping[str, str]) -> Source:
    if isinstance(landmarks, str | Path):
        landmarks = scan_mcap.touched_landmarks(path_of(landmarks), facts)
    elif isinstance(landmarks, Scan | SimulatedScan):
        landmarks = scan_mcap.touched_landmarks(as_scan(landmarks), facts)
    points = None if landmarks is None or isinstance(landmarks, Landmarks) else _array(landmarks)
    if points is not None and points.shape in ((2, 3), (3, 3)):
        return Source({"landmarks_mm": points[:2], **({"nipple_mm": points[2]} if len(points) == 3 else {})})
    return _source_of("landmarks", landmarks, Landmarks, imports.landmark_source)


def _source_of(name: str, source: Any, kind: type, make: Callable[[Any], Source], *, part: str = "") -> Source:
    """Convert a path, a record, or the scan that holds such a record as `part`; None is an empty source."""
    if source is None:
        return Source({})
    if isinstance(source, str | Path):
        return make(path_of(source))
    record = getattr(as_scan(source), part or name) if isinstance(source, Scan | SimulatedScan) else source
    if not isinstance(record, kind):
        raise UsageError(f"{name} is {type(record).__name__}; give a path, or that of another scan")
    return make(record)
