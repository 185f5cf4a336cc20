"""Maps from grids that other programs wrote: tables of text, arrays and images."""

from __future__ import annotations

import csv
import io
import re
import warnings
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import numpy as np

from tactile_bayes.errors import BadDataError, UsageError
from tactile_bayes.files.npz import load_npz
from tactile_bayes.files.reading import CELLS, IMAGE_BYTES, TABLE_BYTES, check_limit, decoding, read_bytes
from tactile_bayes.geometry import FloatArray
from tactile_bayes.mapping.map import MapRecipe, TactileMap

# --- A grid of numbers in a text table, as programs and spreadsheets write it.
#
# Fields are separated by semicolons where the file has one, else by tabs where it has one, else by commas. With
# semicolons or tabs a comma is a decimal comma, as a spreadsheet writes it under the settings of many countries.

_WAY_OUT: Final = "give a table of numbers, such as .csv"
_UTF_16: Final = (b"\xff\xfe", b"\xfe\xff")
_THOUSANDS: Final = re.compile(r"[+-]?[1-9][0-9]{0,2}(,[0-9]{3})+")
_MOST_COUNTED: Final = 8
"""A first row or column of so many numbers that counts 0, 1, 2... or 1, 2, 3... holds labels, whatever its corner."""


def read_table(path: Path) -> FloatArray:
    """Read a table as an (ny, nx) array, NaN where a field is empty."""
    text = _text(path)
    separator = next((one for one in ";\t" if one in text), ",")
    with decoding("is not a table of text", way_out=_WAY_OUT):
        rows = list(csv.reader(io.StringIO(text, newline=""), delimiter=separator))
    rows = _one_block(rows)
    if separator != ",":
        rows = _with_points(rows)
    values = [[_number(field, i, j) for j, field in enumerate(row, 1)] for i, row in enumerate(rows, 1)]
    for number, row in enumerate(values, start=1):
        if len(row) != len(values[0]):
            what = f"row {number} has {len(row)} fields, row 1 has {len(values[0])}"
            raise BadDataError(what, way_out="give every row one length")
    table: FloatArray = np.array(values)
    _refuse_labels(table)
    return table


def _text(path: Path) -> str:
    data = read_bytes(path, most=TABLE_BYTES)
    encoding = "utf-16" if data[:2] in _UTF_16 else "utf-8-sig"
    try:
        return data.decode(encoding)
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        what = f"line {line}: byte 0x{data[error.start]:02x} is not {encoding[:6].upper().rstrip('-')} text"
        raise BadDataError(what, way_out=_WAY_OUT) from None


def _one_block(rows: Sequence[list[str]]) -> list[list[str]]:
    """The rows without blank lines before and after them; blank lines between them separate tables, not rows."""
    held = [number for number, row in enumerate(rows) if len(row) > 1 or any(field.strip() for field in row)]
    if not held:
        raise BadDataError("is empty", way_out=_WAY_OUT)
    gap = next((one for one, after in pairwise(held) if after > one + 1), None)
    if gap is not None:
        raise BadDataError(
            f"has a blank line after row {gap - held[0] + 1}",
            way_out="give one grid, such as one frame or a mean of frames, in a file",
        )
    return list(rows[held[0] : held[-1] + 1])


def _with_points(rows: Sequence[list[str]]) -> list[list[str]]:
    """The rows with decimal points in place of decimal commas."""
    commas = [field.strip() for row in rows for field in row if "," in field]
    if commas and all(_THOUSANDS.fullmatch(field) for field in commas):
        digits = commas[0].replace(",", "")
        what = f"holds {commas[0]!r}, which is {digits} or {commas[0].replace(',', '.', 1)}"
        raise BadDataError(what, way_out="write numbers without commas")
    return [[field.replace(",", ".") if field.count(",") == 1 else field for field in row] for row in rows]


def _number(text: str, row: int, column: int) -> float:
    try:
        return float(text) if text.strip() else np.nan
    except ValueError:
        what = f"row {row}, column {column} holds {text.strip()[:30]!r}"
        raise BadDataError(what, way_out="give numbers only, without a header") from None


def _refuse_labels(table: FloatArray) -> None:
    """Refuse numbers of rows and columns, or their places, in the first row and column: they are no readings."""
    row, column = table[0], table[:, 0]
    both = np.isnan(table[0, 0]) and _evenly(row[1:]) and _evenly(column[1:])
    for found, line, where in ((both, row[1:], "row 1 and column 1"), (_counts(row), row, "row 1")):
        if found:
            _refuse(line, where)
    if _counts(column):
        _refuse(column, "column 1")


def _refuse(line: FloatArray, where: str) -> None:
    told = ", ".join(f"{value:g}" for value in line[:3])
    way_out = "save the grid without them (pandas: to_csv(..., header=False, index=False))"
    raise BadDataError(f"{where} count {told}... as labels do", way_out=way_out)


def _evenly(line: FloatArray) -> bool:
    """True when three numbers or more run in equal steps."""
    steps = np.diff(line)
    return len(line) > 2 and bool(steps[0] != 0.0) and bool(np.allclose(steps, steps[0], rtol=1e-6, atol=0.0))


def _counts(line: FloatArray) -> bool:
    return len(line) >= _MOST_COUNTED and line[0] in (0.0, 1.0) and bool((np.diff(line) == 1.0).all())


# --- Import of a grid or an image as a map.
#
# Orientation: arrays keep their order. Column 0 is the lowest x and row 0 the lowest y, so y runs down an image,
# whose row 0 is its top; a lump's angle is positive from x towards y, clockwise on the image. Pictures of such a
# map show it as the file reads, first row on top and first column on the left (see `mapping.convention`). Cell
# centres are placed about the centre of the grid, so x and y run from -(n-1)/2 to (n-1)/2 cells.

IMAGE_SUFFIXES: Final = (".tif", ".tiff", ".pgm", ".png")
TABLE_SUFFIXES: Final = (".csv", ".txt", ".tsv")
# A map divided by its level has a median near 1; farther off than this, it was not divided.
_NORMALISED_MEDIAN: Final = (0.2, 5.0)
_LEAST_SPACING_MM: Final = 0.01
_MOST_KPA: Final = 1000.0
"""Median of a grid in kPa: no examination presses with more, and as Pa it is a light touch."""


def read_grid(path: Path, *, spacing_mm: float | None = None, normalise: str = "none", units: str = "") -> TactileMap:
    """Read a grid of values as a map: an ``.npz`` with ``mean (ny, nx)`` and, if known, ``count``, ``variance`` (NaN
    where count is 1) and ``spacing_mm``; a table of numbers (see `read_table`), an empty field for a cell without data;
    or a grey ``.tif``, ``.pgm`` or ``.png`` image.

    `spacing_mm` is the side of the square cells and may be left out when the ``.npz`` holds it. `normalise` says what
    was done to the values already: ``"mean"`` or ``"gain"`` when 1 is the level far from a lump, ``"none"`` when the
    level is not known. Nothing is divided here. `units` labels values that were not divided.
    """
    suffix = path.suffix.lower()
    try:
        if suffix == ".npz":
            arrays = load_npz(path, required=["mean"], optional=("count", "variance", "spacing_mm"))
            spacing = _spacing(arrays.get("spacing_mm"), given=spacing_mm)
            return _map(arrays, spacing_mm=spacing, normalise=normalise, units=units)
        if suffix in IMAGE_SUFFIXES:
            mean = _image(path)
        elif suffix in TABLE_SUFFIXES:
            mean = read_table(path)
        else:
            known = ", ".join((".npz", *TABLE_SUFFIXES, *IMAGE_SUFFIXES))
            way_out = _CONVERT.get(suffix, f"grids are read from {known}; scans from .npz and .mcap")
            raise BadDataError(f"has the suffix {suffix or 'none'!r}", way_out=way_out)
        return _map({"mean": mean}, spacing_mm=_spacing(None, given=spacing_mm), normalise=normalise, units=units)
    except BadDataError as error:
        raise error.at(path) from None


_FROM_ARRAYS = "`tactile-bayes import --help` says which arrays a scan has; a grid has one, mean"
_CONVERT = {
    ".mat": f"read it with scipy.io.loadmat and save its arrays with numpy.savez_compressed as .npz; {_FROM_ARRAYS}",
    **dict.fromkeys(
        (".h5", ".hdf5"), f"read it with h5py and save its arrays with numpy.savez_compressed as .npz; {_FROM_ARRAYS}"
    ),
    ".npy": f"save it with numpy.savez_compressed as .npz; {_FROM_ARRAYS}",
    **dict.fromkeys((".xlsx", ".xls", ".ods", ".dat"), "save the grid as .csv"),
}


def _spacing(held: np.ndarray[Any, Any] | None, *, given: float | None) -> float:
    if held is None:
        if given is None:
            raise UsageError("a grid needs --spacing-mm, the side of its square cells in mm")
        value = float(given)
    else:
        values = np.atleast_1d(held)
        if values.dtype.kind not in "iuf" or values.ndim != 1 or len(values) not in (1, 2):
            raise BadDataError(f"spacing_mm is {values.dtype} of shape {values.shape}", way_out="it must be one number")
        if len(values) == 2 and values[0] != values[1]:
            raise BadDataError(
                f"spacing_mm is {values[0]:g} by {values[1]:g}", way_out="resample to square cells first"
            )
        value = float(values[0])
        if given is not None and not np.isclose(given, value, rtol=1e-9, atol=0.0):
            raise UsageError(
                f"--spacing-mm is {given:g}, but the file says spacing_mm = {value:g}; leave the option out"
            )
    if not 0 < value < 1000:
        raise BadDataError(f"the spacing is {value:g} mm", way_out="it must be positive, in mm")
    if value < _LEAST_SPACING_MM:
        raise BadDataError(f"the spacing is {value:g} mm", way_out="looks like metres, give mm")
    return value


def _map(arrays: dict[str, np.ndarray[Any, Any]], *, spacing_mm: float, normalise: str, units: str) -> TactileMap:
    mean = _numbers(arrays["mean"], name="mean")
    if mean.ndim != 2 or 0 in mean.shape:
        raise BadDataError(f"mean has shape {mean.shape}", way_out="it must be (ny, nx)")
    count = _count(arrays.get("count"), mean)
    variance = _variance(arrays.get("variance"), count)
    _check_level(mean[count > 0], normalise=normalise, units=units)
    return TactileMap(
        mean=np.where(count > 0, mean, np.nan),
        variance=variance,
        count=count,
        x_mm=_centres(mean.shape[1], spacing_mm),
        y_mm=_centres(mean.shape[0], spacing_mm),
        recipe=MapRecipe(source="grid", normalise=normalise, cell_mm=spacing_mm, units=units),
        background=None if normalise == "none" else 1.0,
        frame_count=0,
    )


def _centres(n: int, spacing_mm: float) -> FloatArray:
    return np.asarray((np.arange(n) - (n - 1) / 2) * spacing_mm, dtype=np.float64)


def _numbers(array: np.ndarray[Any, Any], *, name: str) -> FloatArray:
    if array.dtype.kind not in "iuf":
        raise BadDataError(f"{name} is {array.dtype}", way_out="give real numbers")
    values: FloatArray = np.asarray(array, dtype=np.float64)
    if np.isinf(values).any():
        index = tuple(int(i) for i in np.argwhere(np.isinf(values))[0])
        raise BadDataError(f"{name} is infinite at {index}", way_out="mark cells without data by NaN")
    return values


def _count(held: np.ndarray[Any, Any] | None, mean: FloatArray) -> np.ndarray[tuple[int, ...], np.dtype[np.int64]]:
    """Readings per cell: 1 where there is a value, unless the file has counts."""
    if held is None:
        count = np.isfinite(mean).astype(np.int64)
    else:
        values = _numbers(held, name="count")
        _check_same_shape(values, mean, name="count")
        bad = np.argwhere((values < 0) | (values != np.floor(values)) | np.isnan(values))
        if len(bad):
            index = tuple(int(i) for i in bad[0])
            raise BadDataError(f"count is {values[index]:g} at {index}", way_out="give whole numbers from 0 up")
        count = values.astype(np.int64)
        gap = np.argwhere((count > 0) & np.isnan(mean))
        if len(gap):
            index = tuple(int(i) for i in gap[0])
            raise BadDataError(f"mean is NaN at {index}, where count is {count[index]}", way_out="set count to 0 there")
    if not count.any():
        raise BadDataError("no cell holds data", way_out="give at least one finite value")
    return count


def _variance(held: np.ndarray[Any, Any] | None, count: np.ndarray[tuple[int, ...], np.dtype[np.int64]]) -> FloatArray:
    """Variance within a cell: 0 in a grid without variances, NaN where there is no data.

    It may also be NaN where a cell has a single reading: a sample variance, numpy's with ddof=1, does not exist there.
    """
    if held is None:
        return np.where(count > 0, 0.0, np.nan)
    variance = _numbers(held, name="variance")
    _check_same_shape(variance, count, name="variance")
    bad = np.argwhere((count > 0) & ~(variance >= 0) & ~((count == 1) & np.isnan(variance)))
    if len(bad):
        index = tuple(int(i) for i in bad[0])
        raise BadDataError(
            f"variance is {variance[index]:g} at {index}, where count is {count[index]}",
            way_out="it must not be negative, and NaN (not known) only where count is 0 or 1",
        )
    return np.where(count > 0, variance, np.nan)


def _check_same_shape(array: FloatArray, mean: np.ndarray[Any, Any], *, name: str) -> None:
    if array.shape != mean.shape:
        raise BadDataError(f"{name} has shape {array.shape}", way_out=f"it must be {mean.shape}, as mean")


def _check_level(values: FloatArray, *, normalise: str, units: str) -> None:
    """Refuse values that cannot be what the caller declares: divided by their level, or in kPa."""
    median = float(np.median(values))
    if units.strip().lower() == "kpa" and median > _MOST_KPA:
        raise BadDataError(
            f"the median value is {median:.4g} kPa", way_out="looks like Pa, give --units Pa, or divide by 1000"
        )
    low, high = _NORMALISED_MEDIAN
    if normalise != "none" and not low <= median <= high:
        raise BadDataError(
            f"the median value is {median:.4g}, not near 1 as --normalise {normalise} says",
            way_out="divide by the level first, or give --normalise none",
        )


def _image(path: Path) -> FloatArray:
    from PIL import Image, UnidentifiedImageError

    data = read_bytes(path, most=IMAGE_BYTES)  # from memory: a chunk cannot claim more than there is
    with (
        decoding("cannot be decoded", way_out="save it again as TIFF, PGM or PNG"),
        warnings.catch_warnings(action="ignore"),  # damage is told by the errors
    ):
        Image.MAX_IMAGE_PIXELS = None  # the limit below is the one that can be raised
        try:
            image = Image.open(io.BytesIO(data), formats=("TIFF", "PPM", "PNG"))
        except UnidentifiedImageError:
            raise BadDataError("is not an image", way_out="give a grey TIFF, PGM or PNG") from None
        check_limit(image.width * image.height, CELLS, what="it has {} pixels")
        pages, mode = getattr(image, "n_frames", 1), image.mode
        pixels = np.asarray(image)
    if pages > 1:
        raise BadDataError(f"holds {pages} images", way_out="give one")
    if pixels.ndim == 3 and (pixels[..., :3] == pixels[..., :1]).all():
        pixels = pixels[..., 0]  # grey, saved as colour
    if pixels.ndim != 2 or mode in ("P", "1"):
        raise BadDataError(f"is a colour image (mode {mode})", way_out="save one channel of intensities")
    return pixels.astype(np.float64)
