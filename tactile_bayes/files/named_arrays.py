"""Named arrays of other programs' files (.npz, .npy, .mat, HDF5, netCDF), and the layout's names for them."""

from __future__ import annotations

import io
import math
import struct
import textwrap
import warnings
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import scipy.io

from tactile_bayes.declarations import Record
from tactile_bayes.errors import BadDataError, in_file
from tactile_bayes.files import reading
from tactile_bayes.files.arrays_layout import KNOWN, LAYOUT, OPTIONAL, ArrayMap, Shape, Stated, in_words
from tactile_bayes.files.documents import dump_json, read_toml_record
from tactile_bayes.files.netcdf import Group, as_declared, open_netcdf
from tactile_bayes.files.npz import Arrays, choose_npz, load_npy


class Source(Record, eq=False):
    """Arrays of a scan by the layout's names, with the options that their file states, and notes on guesses."""

    arrays: Arrays
    stated: Stated = Stated()
    notes: tuple[str, ...] = ()
    others: tuple[str, ...] = ()  #: Names in its file that were not read.
    path: str = ""  #: Of a file beside the frames', for errors.
    checked_on: str = ""  #: Day on which its head was found right on a scan, as `HeadGeometry` has it.


class Grid(Record, eq=False):
    """Grid of values, with the spacing and unit that its file states."""

    arrays: Arrays  #: ``mean (ny, nx)`` and, where known, ``count`` and ``variance``.
    spacing_mm: tuple[float, float] | None = None  #: Width and height of a cell, where the file states it.
    resolution_mm: tuple[float, float] | None = None  #: The same by an image's resolution, often of its printing.
    units: str = ""  #: Where the file states it.
    notes: tuple[str, ...] = ()  #: How it was read.
    steps: tuple[float, ...] = ()  #: Between the places of its columns, and of its rows, in the unit that they have.


Choose = Callable[[Sequence[str]], Iterable[str]]  #: Takes the names in a file and returns those to read.
ARRAY_SUFFIXES: Final = (".npz", ".npy", ".mat", ".h5", ".hdf5")
_MAT_5: Final = b"MATLAB 5.0 MAT-file"
_MAT_73: Final = b"MATLAB 7.3 MAT-file"
_ZIP: Final = reading.ZIP_MAGIC[:2]
_NPY: Final = np.lib.format.MAGIC_PREFIX
_KNOWN: Final = (_ZIP, _NPY, _MAT_5, _MAT_73, reading.HDF5_MAGIC, reading.MCAP_MAGIC, b"CDF")
_USER_BLOCK: Final = 512  # bytes before the HDF5 file in a .mat of version 7.3
_LOOKED_AT: Final = _USER_BLOCK + len(reading.HDF5_MAGIC)
_MOST_LEVELS: Final = 8


def read_named(path: Path, choose: Choose) -> Arrays:
    """Read the arrays that `choose` takes from the names in a file, which is known by its first bytes.

    Fields of a structure and members of a group are called ``exam.frames``. Arrays of a .mat have the axes that they
    have in MATLAB.
    """
    start = reading.first_bytes(path, _LOOKED_AT)
    with in_file(path):
        if start.startswith(_ZIP):
            return choose_npz(path, choose)
        if start.startswith(_NPY):
            arrays = load_npy(path)
        elif start.startswith(_MAT_5):
            arrays = _mat_5(path)
        elif start.startswith(_MAT_73):
            return {name: array.T for name, array in _hdf5(path, choose, begins_at=_USER_BLOCK).items()}
        elif start.startswith(reading.HDF5_MAGIC):
            return _hdf5(path, choose)
        elif start.startswith(b"CDF"):
            arrays = _netcdf_3(path)
        else:
            what = f"is not an .npz, .npy, .mat or HDF5 file ({reading.beginning(start[:6])})"
            way_out = "save the arrays with numpy.savez_compressed"
            if start.startswith(reading.MCAP_MAGIC):
                what, way_out = "is a scan", "give it as it is"
            elif path.suffix.lower() == ".mat":
                what, way_out = "is not a .mat of version 5 to 7.3", "save it with save(..., '-v7')"
            raise BadDataError(what, way_out=way_out)
        return {name: arrays[name] for name in choose(list(arrays))}


def is_text(path: Path) -> bool:
    """True if neither suffix nor first bytes are those of a file of arrays: it may be a text."""
    return path.suffix.lower() not in ARRAY_SUFFIXES and not reading.first_bytes(path, _LOOKED_AT).startswith(_KNOWN)


AXES: Final = ("x", "y")  #: Places of the columns and rows of a grid, or of each of its cells.


def orient_by_axes(arrays: Arrays) -> tuple[tuple[str, ...], tuple[float, ...]]:
    """Orient grids in place by the arrays `AXES` of their group, else of the file; say how, and the steps of places.

    The axes, which are removed, may be lines or, as MATLAB keeps them, matrices of one row or column. x then rises
    along a row, y from row to row.
    """
    notes, steps = list[str](), set[tuple[float, ...]]()
    tables = {name for name, one in arrays.items() if one.ndim == 2 and min(one.shape) > 1}
    grids = {name for name in tables if name.rpartition(".")[2] not in AXES}
    groups = {name.rpartition(".")[0] for name in grids}
    for prefix in (*(f"{group}." for group in groups if group), ""):  # the file's own come last
        within = {name for name in grids if name.startswith(prefix)}
        x, y = (np.squeeze(arrays.get(prefix + axis, np.empty(0))) for axis in AXES)
        if within and x.ndim == y.ndim == 2 and x.shape == y.shape and x.size:
            x, y = (x[0], y[:, 0]) if x[0, 0] != x[0, -1] else (x[:, 0], y[0])
        x, y = (line if line.ndim == 1 and line.dtype.kind in "iuf" else np.empty(0) for line in (x, y))
        for axis, line in zip(AXES, (x, y), strict=True):
            if line.size:
                del arrays[prefix + axis]
        if x.size or y.size:
            steps.add(tuple(step for key, line in zip(AXES, (x, y), strict=True) if (step := step_of(key, line))))
            notes += _orient(arrays, within, x, y)
            grids -= within
    return tuple(dict.fromkeys(notes)), steps.pop() if len(steps) == 1 else ()


def step_of(name: str, places: np.ndarray) -> float | None:
    """Step between the places of cells, which must be even; None for less than two, or whole ones that count up."""
    with np.errstate(all="ignore"):
        steps = np.diff(places.astype(np.float64))
    if not len(steps):
        return None
    if not np.allclose(steps, steps.mean(), rtol=0.01, atol=0.0):
        what = f"{name} runs in unequal steps ({steps.min():.4g} to {steps.max():.4g})"
        raise BadDataError(what, way_out="a grid has square cells of one side: interpolate it")
    return None if steps[0] == 1 and places[0] >= 0 == places[0] % 1 else abs(float(steps.mean()))


def _orient(arrays: Arrays, grids: Iterable[str], x: np.ndarray, y: np.ndarray) -> list[str]:
    """Orient grids in place by the places of their columns and rows, of which either may be empty, and say how."""
    notes = []
    for key, line in zip(AXES, (x, y), strict=True):
        if len(line) > 1:
            notes.append(f"{key} runs in steps of {abs(float(line[1]) - float(line[0])):g}")
    for name in grids:
        if len(x) != len(y) and arrays[name].shape == (len(x), len(y)):
            arrays[name] = arrays[name].T
            notes.append("rows and columns were swapped: x runs from row to row")
        for axis, key, line in ((1, "x", x), (0, "y", y)):
            if len(line) == arrays[name].shape[axis] and line[0] > line[-1]:
                arrays[name] = np.flip(arrays[name], axis)
                notes.append(f"turned round along {key}, which falls from {line[0]:g} to {line[-1]:g}")
    return notes


def _netcdf_3(path: Path) -> Arrays:
    data = reading.read_bytes(path, most=reading.NETCDF_BYTES)
    with (
        reading.decoding("is not a whole netCDF-3 file"),
        warnings.catch_warnings(action="ignore"),
        scipy.io.netcdf_file(io.BytesIO(data), "r", mmap=False) as file,
    ):
        real = {name: one for name, one in file.variables.items() if one.data.dtype.kind in "iuf"}
        return {name: as_declared(np.array(one.data), vars(one)["_attributes"]) for name, one in real.items()}


def _hdf5(path: Path, choose: Choose, *, begins_at: int = 0) -> Arrays:
    """Arrays of an HDF5 file; MATLAB's of version 7.3 is one."""
    with open_netcdf(path, way_out=reading.COPY_AGAIN, begins_at=begins_at) as root:
        members = dict(_members(root, "", levels=_MOST_LEVELS))
        return {name: np.asarray(members[name].numbers(name.rpartition(".")[2])) for name in choose(list(members))}


def _members(group: Group, prefix: str, *, levels: int) -> Iterator[tuple[str, Group]]:
    """Each array's name with its group; MATLAB's own groups (``#refs#``) are left out."""
    yield from ((f"{prefix}{name}", group) for name in group.variables())
    for name, inner in group.groups().items() if levels else ():
        if not name.startswith("#"):
            yield from _members(inner, f"{prefix}{name}.", levels=levels - 1)


# --- MATLAB's files up to version 7: every size is checked before an array is made of it.
#
# MAT-File Format (MathWorks), "Level 5 MAT-File Format": a header of 128 bytes, then elements, each with its type and
# length before it; a matrix holds its flags, dimensions and name, then its numbers or, of a structure, its fields as
# matrices. SciPy's reader ends the process over some damaged files.

_HEADER: Final = 128
_MATRIX, _COMPRESSED = 14, 15
_TYPES: Final = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
"""Types of numbers in an element."""
_STRUCT, _OPAQUE = 2, 17
_NUMERIC: Final = range(6, 16)  # classes of matrices from double to uint64
_COMPLEX: Final = 0x800
_NO_NUMBERS: Final = np.array(None, dtype=object)

Element = tuple[int, bytes]


def _mat_5(path: Path) -> Arrays:
    """Read all arrays; fields of a structure are called ``exam.frames``, what holds no numbers is an object."""
    data = reading.read_bytes(path, most=reading.NETCDF_BYTES)
    order = "<" if data[126:128] == b"IM" else ">"
    most = reading.unpacked_limit(len(data))
    arrays: Arrays = {}
    with reading.decoding("is not a whole .mat file"):
        for kind, element in _elements(data[_HEADER:], order):
            parts = [(kind, element)]
            if kind == _COMPRESSED:
                unpacked = zlib.decompressobj().decompress(element, most + 1)
                reading.check_limit(len(unpacked), most, what="its arrays unpack to {} bytes or more")
                most -= len(unpacked)
                parts = list(_elements(unpacked, order))
            for inner, content in parts:
                if inner == _MATRIX:
                    arrays |= dict(_matrix_arrays(content, order, "", _MOST_LEVELS))
    return arrays


def _elements(data: bytes, order: str) -> Iterator[Element]:
    """Type and content of each element; one of up to four bytes is stored in its tag."""
    at = 0
    while at + 8 <= len(data):
        kind, length = struct.unpack_from(f"{order}II", data, at)
        if kind >> 16:
            kind, length, start, end = kind & 0xFFFF, kind >> 16, at + 4, at + 8
        else:
            start = at + 8
            end = start + length + (-length % 8 if kind != _COMPRESSED else 0)
        if length > len(data) - start:
            raise BadDataError("ends within an array", way_out=reading.COPY_AGAIN)
        yield kind, data[start : start + length]
        at = end


def _matrix_arrays(matrix: bytes, order: str, name: str, levels: int) -> Iterator[tuple[str, np.ndarray]]:
    """Arrays of a matrix by their names; the matrix of a field is nameless, and gets the field's `name`."""
    elements = _elements(matrix, order)
    flags = int(_numbers(next(elements), order)[0])
    kind = flags & 0xFF
    shape = () if kind == _OPAQUE else tuple(int(number) for number in _numbers(next(elements), order))
    name_in_file = next(elements)[1].decode("ascii")
    name = name or name_in_file
    if kind == _STRUCT and math.prod(shape) == 1 and levels:
        width = int(_numbers(next(elements), order)[0])
        texts = next(elements)[1]
        names = [texts[i : i + width].split(b"\0")[0].decode("ascii") for i in range(0, len(texts), max(width, 1))]
        for field, (of_field, content) in zip(names, elements, strict=False):
            if of_field == _MATRIX and content:
                yield from _matrix_arrays(content, order, f"{name}.{field}", levels - 1)
    elif kind in _NUMERIC and not flags & _COMPLEX:
        values = _numbers(next(elements), order)
        if min(shape, default=0) < 0 or math.prod(shape) != len(values):
            raise BadDataError(f"{name} has {len(values)} numbers for a shape of {shape}", way_out=reading.COPY_AGAIN)
        yield name, values.reshape(shape, order="F")
    elif name:
        yield name, _NO_NUMBERS


def _numbers(element: Element, order: str) -> np.ndarray:
    kind, content = element
    if kind not in _TYPES:
        raise BadDataError(f"holds numbers of type {kind}", way_out=reading.COPY_AGAIN)
    return np.frombuffer(content, dtype=f"{order}{_TYPES[kind]}")


# --- MAP.toml, a file's names for the arrays of a scan, and a template of it.

_HEADING: Final = """\
# Names of a scan's arrays in {path}, for
#   tactile-bayes import SRC --columns MAP.toml -o SCAN.mcap
# Complete it, and leave out what another file gives: --head-geometry,
# --array-calibration, --landmarks, --poses.

# unit = "kPa"        # of frames that are pressures (or Pa, psi, mmHg, N/cm2)
# time_unit = "ms"    # of the frames' times, where it is not s (or us, min)
# length_unit = "cm"  # of the places, where it is not mm (or m, inch)
"""
_LINE_LENGTH: Final = 79  #: A comment that a terminal breaks is none any more when it is copied.
_VALUES: Final = """
[values]
# pitch_mm = 1.5  # numbers that no file has
"""


def read_array_map(path: Path) -> ArrayMap:
    """Read a MAP.toml; for the errors see `files.documents.read_record`."""
    return read_toml_record(path, ArrayMap, way_out="`tactile-bayes import SRC --template` prints one")


def array_template(path: Path | None) -> str:
    """Template of a MAP.toml; with a file it lists the file's arrays and guesses which is which."""
    shapes = {} if path is None else {name: one.shape for name, one in read_named(path, list).items()}
    shape_lines = [f"#   {name}: {' x '.join(map(str, shape)) or 'one value'}" for name, shape in shapes.items()]
    lines = [
        _HEADING.format(path=path or "a file"),
        *(["# The file has:", *shape_lines, ""] if shape_lines else []),
        "[arrays]",
    ]
    words = {name: f"{in_words(one.shape)}: {one.meaning}" for name, one in LAYOUT.items()}
    words |= {name: f"may be left out; {words[name]}" for name in OPTIONAL}
    words["pose_matrix"] = "m, 4, 4: in place of position_mm and quaternion_wxyz"
    guesses = _guess_names(shapes)
    for name, meaning in words.items():
        if name in shapes:
            lines.append(f"# {name}: found under this name")
        elif name == "counts" and "frames" in shapes:
            lines.append("# counts: found as frames")
        else:
            entry = f"{name} = {dump_json(guesses[name]).strip()}  # guessed" if name in guesses else f'# {name} = ""'
            lines.append(entry)
        lines += textwrap.wrap(meaning, _LINE_LENGTH, initial_indent="#   ", subsequent_indent="#   ")
    return "\n".join([*lines, _VALUES])


_PLAIN_WORDS: Final[Mapping[str, tuple[str, ...]]] = {
    "counts": ("pressure", "pressures", "readings"),
    "position_mm": ("position", "positions", "pos", "xyz", "translation"),
    "quaternion_wxyz": ("quaternion", "quaternions", "quat", "quats"),
    "pose_matrix": ("transforms", "matrices", "pose_matrices"),
    "frame_time_s": ("frame_time", "frame_times", "time", "times", "t", "timestamps"),
    "pose_time_s": ("pose_time", "pose_times", "tracker_time", "tracker_times", "time", "times", "t", "timestamps"),
    "array_from_tracker": ("scanhead_from_tracker", "head_from_tracker", "lever_arm"),
    "head_surface_mm": ("surface_mm", "head_surface"),
    "pitch_mm": ("pitch",),
}
"""Plain words for arrays; times are told apart by the group that they stand in."""
_TIMES_BESIDE: Final = {"frame_time_s": ("counts", "frames"), "pose_time_s": ("position_mm", "pose_matrix")}


def plain_names(
    names: Sequence[str], known: Mapping[str, str], values: Mapping[str, Any] | None = None
) -> dict[str, str]:
    """Layout's name -> the file's, for arrays that the file calls by a plain word, beside `known` ones and `values`."""
    matches: dict[str, str] = {}
    for layout_name, words in _PLAIN_WORDS.items():
        equivalents = {layout_name, "frames"} if layout_name == "counts" else {layout_name}
        if equivalents & {*known, *(values or {})}:
            continue
        names_used = {*known.values(), *matches.values()}
        words = (*words, *equivalents)  # within a group
        candidates = [name for name in names if name.rpartition(".")[2].lower() in words and name not in names_used]
        exact = [name for name in candidates if name.rpartition(".")[2] in words]
        candidates = exact or candidates  # t, where there is a T too
        if layout_name in _TIMES_BESIDE:
            by_layout = {**known, **matches}
            timed = (by_layout[name] for name in _TIMES_BESIDE[layout_name] if name in by_layout)
            group = next(timed, "").rpartition(".")[0]
            candidates = [name for name in candidates if name.rpartition(".")[0] == group] or candidates
            if layout_name == "pose_time_s" and not group:  # beside the frames, `time` is theirs
                candidates = [name for name in candidates if name.lower() not in _PLAIN_WORDS["frame_time_s"]]
        if len(candidates) == 1:
            matches[layout_name] = candidates[0]
    return matches


def _guess_names(shapes: Mapping[str, Shape]) -> dict[str, str]:
    """Layout's name -> the file's, for arrays called by a plain word or the only ones of their shape."""
    unclaimed = [name for name in shapes if name not in KNOWN]
    shapes_unclaimed = {name: tuple(one for one in shapes[name] if one != 1) for name in unclaimed}

    def of(fits: Callable[[Shape], bool]) -> list[str]:
        return [name for name, shape in shapes_unclaimed.items() if fits(shape)]

    candidates = {
        "array_from_tracker": of(lambda s: s == (4, 4)),
        "head_surface_mm": of(lambda s: len(s) == 3 and s[-1] == 3),
        "pose_matrix": of(lambda s: len(s) == 3 and (4, 4) in (s[:2], s[1:])),
        "counts": of(lambda s: len(s) == 3 and s[-1] != 3 and (4, 4) not in (s[:2], s[1:])),
        "position_mm": of(lambda s: len(s) == 2 and s[1] == 3),
        "quaternion_wxyz": of(lambda s: len(s) == 2 and s[1] == 4 and s[0] != 4),
    }
    for layout_name, places in _TIMES_BESIDE.items():
        only = [shapes_unclaimed[candidates[name][0]] for name in places if len(candidates.get(name, ())) == 1]
        only += [shapes[name] for name in places if shapes.get(name)]
        ends = {max(shape[0], shape[-1], key=int) for shape in only}  # either may be that of time
        candidates[layout_name] = of(lambda s, ends=ends: len(s) == 1 and s[0] in ends)  # type: ignore[misc]
    by_shape = {
        layout_name: names[0]
        for layout_name, names in candidates.items()
        if layout_name not in shapes and len(names) == 1
    }
    return by_shape | plain_names(list(shapes), {name: name for name in KNOWN if name in shapes})
