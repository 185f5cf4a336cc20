"""The instrument and its scene as files: head, array calibration and landmarks in JSON, a simulated scan in TOML."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from datetime import date
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import numpy as np

from tactile_bayes.declarations import EXACT, Meta, Record, as_dict, described, field, from_plain, names_of, to_plain
from tactile_bayes.errors import BadDataError, in_file
from tactile_bayes.files.atomic import write_text
from tactile_bayes.files.documents import dump_json, load_json, parse_record, parse_toml, read_record
from tactile_bayes.files.reading import TOML_BYTES, read_text
from tactile_bayes.forward import scene as scenes
from tactile_bayes.forward.tissue import DepthRatio, Height, Rib, SceneBody, Seat, SolidLump, Stiffness
from tactile_bayes.geometry import Matrix
from tactile_bayes.scans import ElementCalibration, HeadGeometry, HeadShape, Landmarks, check_pitch


def head_document(head: HeadGeometry) -> dict[str, Any]:
    """Head geometry as plain data; JSON keeps every bit of a double."""
    plain = to_plain(head, digits=EXACT)
    return {name: plain[name] for name in sorted(plain) if name != "checked_on" or head.checked_on}


def write_head(path: Path, head: HeadGeometry, *, force: bool = False) -> None:
    """Write a head as `read_head_geometry` reads it."""
    write_text(path, dump_json({"schema": "tactile-bayes/head/1", **head_document(head)}), force=force)


def calibration_document(calibration: ElementCalibration) -> dict[str, Any]:
    """Element calibration as plain data."""
    return {"saturation_count": int(calibration.saturation_count), **to_plain(calibration, digits=EXACT)}


# --- Heads as JSON: positions of the taxels, or their grid and arc, for `record` and for simulated bodies.

_DEFAULT_RIM_MM: Final = scenes.Head().rim_mm
_METRES: Final = 0.02  #: No array has taxels so close, in mm; in metres many have.
# Taxels further than this from a regular grid on an arc make a head that the models do not have.
_REGULAR_MM: Final = 0.05
_WAY_OUT: Final = (
    "give pitch_mm, and surface_mm or rows, columns and radius_mm (null: flat); scans need scanhead_from_tracker too"
)
Triple = tuple[float, float, float]
Row = tuple[float, float, float, float]
TaxelRow = Annotated[list[Triple], Meta(min_length=1, max_length=256)]
Radius = Annotated[float, Meta(gt=0, le=100_000)]
Rounding = Annotated[float, Meta(ge=0, le=100)]


class HeadFile(Record, kw_only=True):
    """A scan head: where its taxels are, and where the tracker's sensor is on it."""

    schema: Literal["tactile-bayes/head/1"]
    note: str | None = None  #: Anything, for people.
    pitch_mm: scenes.Pitch
    surface_mm: Annotated[list[TaxelRow], Meta(min_length=1, max_length=256)] | None = None
    """(rows, columns, 3) centres of the taxels in `scanhead`: origin at the apex, x across the head, y along it, z into
    the tissue. Or give rows, columns and radius_mm."""
    rows: scenes.Rows | None = None
    columns: scenes.Columns | None = None
    radius_mm: Radius | None = None
    """Radius of the arc across the head, mm, above half its width; null for a flat head."""
    shoulder_mm: Rounding = 0.0  #: Radius of rounded edges cut into the array across the head, mm.
    rim_mm: Rounding | None = None
    """Radius of the rounded edge around the taxels, which presses but senses nothing, mm; for `population`. Default: 3,
    or 0 with shoulder_mm."""
    checked_on: date | None = None  #: Day on which `check` found it right on a scan.
    scanhead_from_tracker: tuple[Row, Row, Row, Row] | None = None
    """(4, 4) transform from the tracker's sensor to the head; `record` needs it."""

    def __post_init__(self) -> None:
        if self.pitch_mm < _METRES:
            raise BadDataError(f"pitch_mm is {self.pitch_mm:g}", way_out="looks like metres, give all lengths in mm")
        if self.surface_mm is not None and len({len(row) for row in self.surface_mm}) > 1:
            raise BadDataError("surface_mm has rows of different lengths", way_out="give every row a taxel each")
        if self.shoulder_mm and self.rim_mm:
            what = f"shoulder_mm is {self.shoulder_mm:g} and rim_mm {self.rim_mm:g}"
            raise BadDataError(what, way_out="give one of them above 0")


def read_head_geometry(path: Path) -> HeadGeometry:
    """Read the places of the taxels and the mounting of the tracker."""
    return head_geometry(load_json(path, way_out=_WAY_OUT), path=path)


def head_geometry(document: object, *, path: Path) -> HeadGeometry:
    """Head of the JSON document of `path`; for the rest see `read_head_geometry`."""
    file = _head_file(document, path)
    with in_file(path):
        if file.scanhead_from_tracker is None:
            raise BadDataError("lacks scanhead_from_tracker", way_out="add the transform from the sensor to the head")
        surface = _head_of(file).surface_mm() if file.surface_mm is None else np.array(file.surface_mm)
        check_pitch(surface, file.pitch_mm)
        day = "" if file.checked_on is None else file.checked_on.isoformat()
        return HeadGeometry(surface, file.pitch_mm, np.array(file.scanhead_from_tracker), day)


def read_simulated_head(path: Path) -> scenes.Head:
    """Read a head for the solid model, in which taxels form a regular grid on an arc, or on a plane."""
    file = _head_file(load_json(path, way_out=_WAY_OUT), path)
    with in_file(path):
        return _head_of(file)


def _head_file(document: Any, path: Path) -> HeadFile:
    file = parse_record(document, HeadFile, path=path)
    grid = [name for name in ("rows", "columns", "radius_mm") if getattr(file, name) is not None]
    if file.surface_mm is not None and grid:
        what = f"gives both surface_mm and {grid[0]}"
        raise BadDataError(what, way_out="leave out one of the two descriptions", path=str(path))
    if "radius_mm" in document:  # null is a flat head
        grid.append("radius_mm")
    if file.surface_mm is None and (missing := {"rows", "columns", "radius_mm"} - set(grid)):
        raise BadDataError(f"lacks {min(missing)}", way_out=_WAY_OUT, path=str(path))
    return file


def _head_of(file: HeadFile) -> scenes.Head:
    """The head as a grid on an arc, checked as a scene's; it must have its taxels where the file has them."""
    surface_mm = None if file.surface_mm is None else np.array(file.surface_mm)
    grid = file if surface_mm is None else HeadShape.of(surface_mm, file.pitch_mm)
    assert grid.rows is not None
    assert grid.columns is not None
    radius_mm = scenes.FLAT_MM if grid.radius_mm is None else grid.radius_mm
    rim = (0.0 if file.shoulder_mm else _DEFAULT_RIM_MM) if file.rim_mm is None else file.rim_mm
    head = scenes.Head(grid.rows, grid.columns, file.pitch_mm, radius_mm, file.shoulder_mm, rim)
    scenes.Scene(head=head)  # refuses what is no head
    if surface_mm is not None:
        away = (surface_mm - head.surface_mm()).reshape(-1, 3)
        apart = float(np.abs(away - away.mean(axis=0)).max())  # wherever a site puts the origin
        if apart > _REGULAR_MM:
            regular = f"a regular grid of {file.pitch_mm:g} mm on an arc across the head"
            way_out = "the model has such heads only: give rows, columns and radius_mm of the nearest one (null: flat)"
            raise BadDataError(f"surface_mm lies up to {apart:.2g} mm from {regular}", way_out=way_out)
    return head


# --- Instrument files of `record`, as JSON: array calibration and landmarks.

_UNITS: Final = {"gain": "kPa per count", "offset": "kPa", "curvature": "kPa per count squared"}


class ArrayCalibrationFile(Record, eq=False, kw_only=True):
    """Calibration of a pressure array."""

    schema: Literal["tactile-bayes/array-calibration/1"] = "tactile-bayes/array-calibration/1"
    head_id: str  #: The head it was measured on.
    day: date = field(name="date")  #: When it was measured.
    units: dict[str, str] = field(default_factory=_UNITS.copy)
    saturation_count: Annotated[int, Meta(ge=1)]  #: Readings at or above it carry no pressure.
    gain_kpa_per_count: Matrix
    offset_kpa: Matrix
    quality: dict[str, Any] = field(default_factory=dict)  #: Figures of the fit.
    provenance: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        _ = self.calibration  # refuses what is none

    @property
    def calibration(self) -> ElementCalibration:
        """Gains and offsets of the taxels."""
        return ElementCalibration(self.gain_kpa_per_count, self.offset_kpa, self.saturation_count)


LEAST_STERNUM_MM: Final = 10.0  #: From sternal notch to xiphoid: nobody has less.


class LandmarksFile(Record, kw_only=True):
    """Landmarks touched before a scan, in `base`."""

    schema: Literal["tactile-bayes/landmarks/1"]
    sternal_notch_mm: Triple  #: Sternal notch, mm.
    xiphoid_mm: Triple  #: Xiphoid, mm.
    nipple_mm: Triple | None = None  #: Nipple, mm; left out where it was not touched.

    def __post_init__(self) -> None:
        if (apart := math.dist(self.sternal_notch_mm, self.xiphoid_mm)) < LEAST_STERNUM_MM:
            what = f"sternal_notch_mm and xiphoid_mm are {apart:.4g} mm apart"
            raise BadDataError(what, way_out="looks like metres or inches, give mm")


def write_array_calibration(path: Path, content: ArrayCalibrationFile, *, force: bool = False) -> None:
    """Write the calibration of an array."""
    write_text(path, dump_json(to_plain(content, digits=17)), force=force)


def read_array_calibration(path: Path) -> ArrayCalibrationFile:
    """Read the calibration of an array."""
    return read_record(path, ArrayCalibrationFile, way_out="give a file from `tactile-bayes calibrate array`")


def read_landmarks(path: Path) -> Landmarks:
    """Read sternal notch and xiphoid in `base`, and the nipple where the file has it."""
    file = read_record(path, LandmarksFile, way_out="give sternal_notch_mm and xiphoid_mm, three numbers each")
    nipple = None if file.nipple_mm is None else np.array(file.nipple_mm)
    return Landmarks(np.array(file.sternal_notch_mm), np.array(file.xiphoid_mm), nipple_mm=nipple)


# --- Scenes of simulated scans, as TOML.

# A lump with one of the first keys is tissue; only a Gaussian one may have the others.
_OF_TISSUE: Final = ("depth_ratio", "stiffness_ratio", "seat", "height_mm")
_OF_BUMPS: Final = ("amplitude", "sigma_x_mm", "sigma_y_mm", "angle_deg")


class LumpTable(scenes.Lump):
    """One lump."""

    height_mm: Height | None = None
    depth_ratio: DepthRatio | None = None
    stiffness_ratio: Stiffness | None = None
    seat: Seat | None = None


class SceneFile(Record):
    """Scene of a simulated scan.

    The TOML document `simulate` reads. Everything may be left out. Units are in the keys; lumps and landmarks lie in
    the scene's plane: origin at the centre of the strokes, x along them (across the head), y along the head, z into the
    tissue.
    """

    scene: scenes.Timing = field(default_factory=scenes.Timing)  #: Length and rates.
    background: scenes.Background = field(default_factory=scenes.Background)
    """Mean pressure away from lumps, against time."""
    body: SceneBody | None = None
    lump: Annotated[tuple[LumpTable, ...], Meta(max_length=100)] = ()
    """Lumps: either Gaussian rises of the normalised pressure (amplitude, sigma), or tissue (d_mm, depth_ratio)."""
    rib: Annotated[
        tuple[Annotated[Rib, described("One rib.")], ...],
        described("Ribs for the solid model: rows of stiff balls along x, across the head.", max_length=10),
    ] = ()
    strokes: scenes.Strokes = field(default_factory=scenes.Strokes)
    """Back and forth across the head, line after line along it."""
    head: scenes.Head = field(default_factory=scenes.Head)  #: A section of a circular cylinder.
    noise: scenes.Noise = field(default_factory=scenes.Noise)  #: Standard deviations of everything random.
    tracker: scenes.Tracker = field(default_factory=scenes.Tracker)
    """Where the tracker's base stands and how its sensor sits in the handle."""
    taxels: scenes.Taxels = field(default_factory=scenes.Taxels)  #: Faulty elements as [row, column] from 0.
    landmarks: scenes.SceneLandmarks = field(default_factory=scenes.SceneLandmarks)
    """Points touched before the scan, in the plane."""


def read_scene(path: Path) -> scenes.Scene:
    """Read a scene; missing keys take their defaults."""
    text = read_text(path, most=TOML_BYTES, way_out="give a scene as TOML")
    with in_file(path):
        return scene_of(parse_toml(text, way_out="see the scene in the documentation"))


def scene_of(document: Mapping[str, Any]) -> scenes.Scene:
    """A scene from plain data as its TOML holds; for the errors see `read_scene`."""
    by_table = as_dict(SceneFile(body=SceneBody()))
    for key in document:
        if owners := [f"[{name}]" for name, table in by_table.items() if isinstance(table, dict) and key in table]:
            raise BadDataError(f"{key} stands in no table", way_out=f"write it below {' or '.join(owners)}")
    file = from_plain(SceneFile, document)
    tables = {name: getattr(file, name) for name in names_of(file)}
    bumps, tissue = _lumps(tables.pop("lump"), document.get("lump", ()))
    timing, ribs = as_dict(tables.pop("scene")), tables.pop("rib")
    return scenes.Scene(**timing, lumps=bumps, solid_lumps=tissue, ribs=ribs, **tables)


def _lumps(
    tables: Sequence[LumpTable], keys_of_lumps: Sequence[Mapping[str, Any]]
) -> tuple[tuple[scenes.Lump, ...], tuple[SolidLump, ...]]:
    """Gaussian lumps and lumps of tissue, told apart by the keys of the file."""
    bumps, tissue = [], []
    for i, (table, keys) in enumerate(zip(tables, keys_of_lumps, strict=True)):
        values = {key: getattr(table, key) for key in keys}
        solid = [key for key in _OF_TISSUE if key in keys]
        both = [key for key in _OF_BUMPS if key in keys]
        if solid and both:
            what = f"lump[{i}] gives {both[0]}, of a bump, and {solid[0]}, of tissue"
            raise BadDataError(what, way_out=f"leave out {', '.join(both)} or {', '.join(solid)}")
        if not solid and not both and "d_mm" in keys:
            way_out = "give depth_ratio for a lump of tissue, or amplitude, sigma_x_mm and sigma_y_mm for a bump"
            raise BadDataError(f"lump[{i}] gives d_mm alone, from which no bump follows", way_out=way_out)
        if not solid:
            bumps.append(scenes.Lump(**values))
            continue
        for key in ("d_mm", "depth_ratio"):
            if key not in keys:
                raise BadDataError(f"lump[{i}] gives no {key}", way_out=f"a lump of tissue with {solid[0]} needs it")
        tissue.append(SolidLump(**values))
    return tuple(bumps), tuple(tissue)
