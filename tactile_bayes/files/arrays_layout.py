"""Layout of a scan's arrays in other programs' files, and the options that describe such arrays or a grid."""

from __future__ import annotations

from typing import Annotated, Any, Final, Literal, NamedTuple

from tactile_bayes.declarations import Meta, Options, field, names_of
from tactile_bayes.errors import UsageError
from tactile_bayes.options import Positive, cli_meta
from tactile_bayes.presets import Normalise

Shape = tuple[str | int, ...]


class ArrayLayout(NamedTuple):
    """One array of a scan."""

    shape: Shape  #: Lengths of its axes; n frames, m poses. Letters are lengths that must agree between arrays.
    meaning: str


LAYOUT: Final[dict[str, ArrayLayout]] = {
    "counts": ArrayLayout(
        ("n", "rows", "columns"), "raw readings, 0 to 65535; rows across the head (x), columns along it (y)"
    ),
    "frame_time_s": ArrayLayout(("n",), "time of each frame"),
    "position_mm": ArrayLayout(("m", 3), "tracker sensor in the tracker's base frame"),
    "quaternion_wxyz": ArrayLayout(("m", 4), "its rotation, scalar first, from the sensor to the base frame"),
    "pose_time_s": ArrayLayout(("m",), "time of each pose, on the frames' clock"),
    "gain_kpa_per_count": ArrayLayout(("rows", "columns"), "pressure in kPa = gain x counts + offset"),
    "offset_kpa": ArrayLayout(("rows", "columns"), "see gain_kpa_per_count"),
    "pitch_mm": ArrayLayout((), "distance between neighbouring elements"),
    "array_from_tracker": ArrayLayout((4, 4), "transform from the tracker sensor to the scan head, mm"),
    "head_surface_mm": ArrayLayout(
        ("rows", "columns", 3), "element centres; origin at the apex of the face, z into the tissue"
    ),
    "landmarks_mm": ArrayLayout((2, 3), "sternal notch and xiphoid in the base frame"),
    "nipple_mm": ArrayLayout((3,), "nipple in the base frame, beside landmarks_mm"),
    "saturation_count": ArrayLayout((), "readings at or above it carry no pressure; 4095 if left out"),
}
"""Each array by its name."""
KNOWN: Final = (*LAYOUT, "frames", "pose_matrix")
"""Names of arrays that are read: the layout's, ``frames`` for counts, ``pose_matrix`` for places and rotations."""
OPTIONAL: Final = ("landmarks_mm", "nipple_mm", "saturation_count")


def in_words(shape: Shape) -> str:
    """Format a shape for the help and the errors: ``"m, 3"``, ``"one number"``."""
    return ", ".join(map(str, shape)) or "one number"


def layout_lines() -> list[str]:
    """A line for each array."""
    left_out = dict.fromkeys(OPTIONAL, ", may be left out")
    return [f"- {name} ({in_words(one.shape)}{left_out.get(name, '')}): {one.meaning}" for name, one in LAYOUT.items()]


# --- Options that describe the arrays, on the command line, in MAP.toml and in Python.

Unit = Literal["counts", "kPa", "Pa", "psi", "mmHg", "N/cm2"]
TimeUnit = Literal["s", "ms", "us", "ns", "min"]
PoseLayout = Literal["wxyz", "xyzw", "euler", "matrix"]
Rate = Annotated[float, Meta(gt=0, le=100_000)]


class Stated(Options, kw_only=True):
    """Options that describe a scan's arrays; the rest is taken from their file, or guessed and printed."""

    unit: Annotated[
        Unit | None,
        "Scan: unit of the frames; counts are raw, others need no calibration. Default: the file's, else counts.",
    ] = None
    saturation: Annotated[
        Positive | None, "Scan: reading from which on a taxel carries no pressure, in the frames' unit."
    ] = None
    frame_shape: Annotated[
        tuple[Annotated[int, Meta(ge=1)], Annotated[int, Meta(ge=1)]] | None,
        cli_meta("ROWS COLUMNS"),
        "Scan: rows (across the head) and columns of frames that are one row of numbers. Default: the head's.",
    ] = None
    frame_order: Annotated[
        Literal["rows", "columns"] | None,
        "Scan: order of the numbers in such a row: along the array's rows, or its columns. Default: rows.",
    ] = None
    skip_columns: Annotated[
        Annotated[int, Meta(ge=0)] | None,
        "Scan: columns of a table of frames before its readings. Default: by the header.",
    ] = None
    decimal: Annotated[
        Literal["point", "comma"] | None,
        "Scan: decimal sign of tables. Default: by their numbers, where these are clear.",
    ] = None
    rate_hz: Annotated[Rate | None, cli_meta("HZ"), "Scan: frames a second, where they have no times."] = None
    time_unit: Annotated[TimeUnit | None, "Scan: unit of the frames' times. Default: the file's, else s."] = None
    pose_layout: Annotated[
        PoseLayout | None,
        "Scan: rotations of the poses: quaternions with the scalar first or last, azimuth, elevation and roll, or rows "
        "of a 4 x 4 matrix. Default: by the names of the columns, else wxyz.",
    ] = None
    length_unit: Annotated[
        Literal["mm", "cm", "m", "inch"] | None, "Scan: unit of the poses' positions. Default: the file's, else mm."
    ] = None
    pose_time_unit: Annotated[TimeUnit | None, "Scan: unit of the poses' times. Default: the file's, else s."] = None
    pose_rate_hz: Annotated[
        Rate | None, cli_meta("HZ"), "Scan: poses a second, where they have frame numbers or no times."
    ] = None
    pose_offset_s: Annotated[
        Annotated[float, Meta(ge=-1e10, le=1e10)] | None,
        cli_meta("S"),
        "Scan: added to the poses' times, for the frames' clock. Default: 0.",
    ] = None
    pose_good: Annotated[
        str | None, "Scan: value of the poses' status where the tool is seen. Default: OK, Enabled and the like."
    ] = None
    tool: Annotated[
        str | None, cli_meta("NAME"), "Scan: tool or station of the poses' file to take, where it has several."
    ] = None

    @property
    def given(self) -> dict[str, Any]:
        """Options that are set, by name."""
        return {name: value for name in names_of(self) if (value := getattr(self, name)) not in (None, {})}


class ArrayMap(Stated, kw_only=True):
    """What a file calls the arrays of a scan, and what is stated of them: the TOML of `import --columns`."""

    arrays: Annotated[dict[str, str], 'Name in the file by the name here: counts = "P".'] = field(default_factory=dict)
    values: Annotated[dict[str, Any], "Arrays that the file lacks, such as pitch_mm = 1.5."] = field(
        default_factory=dict
    )


# --- Options that describe a grid.

_LONGEST_UNITS: Final = 20


class GridOptions(Options, kw_only=True):
    """Options that describe a grid of values, which becomes a map."""

    spacing_mm: Annotated[float | None, cli_meta("H"), "Map: side of the square cells, in mm."] = None
    cell_mm: Annotated[
        Positive | None,
        cli_meta("H"),
        "Map: average finer cells into cells of up to this side. Default: 1 where they are finer than 0.5.",
    ] = None
    normalise: Annotated[Normalise, "Map: normalisation of the values in SRC."] = "none"
    level: Annotated[
        Positive | Literal["fit"] | None,
        cli_meta("L|fit"),
        "Map: divide values such as kPa by their level beside the lump: a number, or fit, to take it from the map.",
    ] = None
    units: Annotated[
        str | None, cli_meta("TEXT"), "Map: unit of values that are not normalised, such as kPa. Default: unknown."
    ] = None
    no_value: Annotated[
        tuple[str, ...],
        cli_meta("V"),
        "Map: a number or text that stands for no value, such as -9999; none: every number is a value.",
    ] = ()
    array: Annotated[str | None, cli_meta("NAME"), "Map: array of SRC to take, where it holds several."] = None

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, value in (("units", self.units), ("level", self.level)):
            if value is not None and self.normalise != "none":
                fault = f"--{name} is for values that were not divided; leave it out or --normalise {self.normalise}"
                raise UsageError(fault)
        if self.units is not None and not (self.units.isprintable() and 0 < len(self.units.strip()) <= _LONGEST_UNITS):
            what = f"--units {self.units[:30]!r} is not a unit"
            raise UsageError(f"{what}; give up to {_LONGEST_UNITS} letters, such as kPa")
