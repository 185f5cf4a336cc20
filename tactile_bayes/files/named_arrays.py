"""Arrays by their names from the files of other programs: .npz, .npy, MATLAB's .mat, HDF5 and netCDF."""

from __future__ import annotations

import io
import math
import struct
import warnings
import zlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Final

import numpy as np
import scipy.io

from tactile_bayes.declarations import Record
from tactile_bayes.errors import BadDataError, in_file
from tactile_bayes.files.arrays_layout import Stated
from tactile_bayes.files.netcdf import Group, as_declared, open_netcdf
from tactile_bayes.files.npz import Arrays, choose_npz, load_npy
from tactile_bayes.files.reading import (
    HDF5_MAGIC,
    MCAP_MAGIC,
    NETCDF_BYTES,
    ZIP_MAGIC,
    check_limit,
    decoding,
    first_bytes,
    read_bytes,
    unpacked_limit,
)


class Source(Record, eq=False):
    """Arrays of a scan by names of the layout, with what their file says of them and what was guessed."""

    arrays: Arrays
    stated: Stated = Stated()
    notes: tuple[str, ...] = ()
    others: tuple[str, ...] = ()  #: Names in its file that are none of a scan.
    path: str = ""  #: Of a file beside the frames', for errors.


Choose = Callable[[Sequence[str]], Iterable[str]]
"""Takes the names in a file and returns those to read."""
ARRAY_SUFFIXES: Final = (".npz", ".npy", ".mat", ".h5", ".hdf5")
_MAT_5: Final = b"MATLAB 5.0 MAT-file"
_MAT_73: Final = b"MATLAB 7.3 MAT-file"
_KNOWN: Final = (ZIP_MAGIC[:2], np.lib.format.MAGIC_PREFIX, _MAT_5, _MAT_73, HDF5_MAGIC, MCAP_MAGIC, b"CDF")
_USER_BLOCK: Final = 512  # bytes before the HDF5 file in a .mat of version 7.3
_LOOKED_AT: Final = _USER_BLOCK + len(HDF5_MAGIC)
_COPY_AGAIN: Final = "copy the file again"
_MOST_LEVELS: Final = 8


def read_named(path: Path, choose: Choose) -> Arrays:
    """Read the arrays that `choose` takes from the names in a file, which is known by its first bytes.

    Fields of a structure and members of a group are called ``exam.frames``. Arrays of a .mat have the axes that they
    have in MATLAB.
    """
    start = first_bytes(path, _LOOKED_AT)
    with in_file(path):
        if start.startswith(ZIP_MAGIC[:2]):
            return choose_npz(path, choose)
        if start.startswith(np.lib.format.MAGIC_PREFIX):
            arrays = load_npy(path)
        elif start.startswith(_MAT_5):
            arrays = _mat_5(path)
        elif start.startswith(_MAT_73):
            return {name: array.T for name, array in _hdf5(path, choose, begins_at=_USER_BLOCK).items()}
        elif start.startswith(HDF5_MAGIC):
            return _hdf5(path, choose)
        elif start.startswith(b"CDF"):
            arrays = _netcdf_3(path)
        else:
            raise _of_another_kind(path, start)
        return {name: arrays[name] for name in choose(list(arrays))}


def is_text(path: Path) -> bool:
    """True for a file that is none of arrays by its first bytes and its suffix, and may be a text."""
    return path.suffix.lower() not in ARRAY_SUFFIXES and not first_bytes(path, _LOOKED_AT).startswith(_KNOWN)


def _of_another_kind(path: Path, start: bytes) -> BadDataError:
    if start.startswith(MCAP_MAGIC):
        return BadDataError("is a scan", way_out="give it as it is")
    if path.suffix.lower() == ".mat":
        return BadDataError("is not a .mat of version 5 to 7.3", way_out="save it with save(..., '-v7')")
    what = f"is not an .npz, .npy, .mat or HDF5 file (it starts with {start[:6]!r})"
    return BadDataError(what, way_out="save the arrays with numpy.savez_compressed")


# --- netCDF-3, by scipy.


def _netcdf_3(path: Path) -> Arrays:
    data = read_bytes(path, most=NETCDF_BYTES)
    with (
        decoding("is not a whole netCDF-3 file", way_out=_COPY_AGAIN),
        warnings.catch_warnings(action="ignore"),
        scipy.io.netcdf_file(io.BytesIO(data), "r", mmap=False) as file,
    ):
        real = {name: one for name, one in file.variables.items() if one.data.dtype.kind in "iuf"}
        return {name: as_declared(np.array(one.data), vars(one)["_attributes"]) for name, one in real.items()}


# --- HDF5, which MATLAB's version 7.3 is.


def _hdf5(path: Path, choose: Choose, *, begins_at: int = 0) -> Arrays:
    with open_netcdf(path, way_out=_COPY_AGAIN, begins_at=begins_at) as root:
        held = dict(_members(root, "", levels=_MOST_LEVELS))
        return {name: np.asarray(held[name].numbers(name.rpartition(".")[2])) for name in choose(list(held))}


def _members(group: Group, prefix: str, *, levels: int) -> Iterator[tuple[str, Group]]:
    """Each array's name with its group; MATLAB's own groups (``#refs#``) are left out."""
    yield from ((f"{prefix}{name}", group) for name in group.variables())
    for name in group.groups() if levels else ():
        inner = group.group(name)
        if inner is not None and not name.startswith("#"):
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
    data = read_bytes(path, most=NETCDF_BYTES)
    order = "<" if data[126:128] == b"IM" else ">"
    most = unpacked_limit(len(data))
    found: Arrays = {}
    with decoding("is not a whole .mat file", way_out=_COPY_AGAIN):
        for kind, element in _elements(data[_HEADER:], order):
            parts = [(kind, element)]
            if kind == _COMPRESSED:
                unpacked = zlib.decompressobj().decompress(element, most + 1)
                check_limit(len(unpacked), most, what="its arrays unpack to {} bytes or more")
                most -= len(unpacked)
                parts = list(_elements(unpacked, order))
            for inner, content in parts:
                if inner == _MATRIX:
                    found |= dict(_arrays(content, order, "", _MOST_LEVELS))
    return found


def _elements(data: bytes, order: str) -> Iterator[Element]:
    """Type and content of each element; one of up to four bytes stands within its tag."""
    at = 0
    while at + 8 <= len(data):
        kind, length = struct.unpack_from(f"{order}II", data, at)
        if kind >> 16:
            kind, length, start, end = kind & 0xFFFF, kind >> 16, at + 4, at + 8
        else:
            start = at + 8
            end = start + length + (-length % 8 if kind != _COMPRESSED else 0)
        if length > len(data) - start:
            raise BadDataError("ends within an array", way_out=_COPY_AGAIN)
        yield kind, data[start : start + length]
        at = end


def _arrays(matrix: bytes, order: str, name: str, levels: int) -> Iterator[tuple[str, np.ndarray]]:
    """The arrays of a matrix by their names; `name` is a field's, whose own is empty."""
    elements = _elements(matrix, order)
    flags = int(_numbers(next(elements), order)[0])
    kind = flags & 0xFF
    shape = () if kind == _OPAQUE else tuple(int(one) for one in _numbers(next(elements), order))
    own = next(elements)[1].decode("ascii")
    name = name or own
    if kind == _STRUCT and math.prod(shape) == 1 and levels:
        width = int(_numbers(next(elements), order)[0])
        texts = next(elements)[1]
        names = [texts[i : i + width].split(b"\0")[0].decode("ascii") for i in range(0, len(texts), max(width, 1))]
        for field, (of_field, content) in zip(names, elements, strict=False):
            if of_field == _MATRIX and content:
                yield from _arrays(content, order, f"{name}.{field}", levels - 1)
    elif kind in _NUMERIC and not flags & _COMPLEX:
        values = _numbers(next(elements), order)
        if min(shape, default=0) < 0 or math.prod(shape) != len(values):
            raise BadDataError(f"{name} has {len(values)} numbers for a shape of {shape}", way_out=_COPY_AGAIN)
        yield name, values.reshape(shape, order="F")
    elif name:
        yield name, _NO_NUMBERS


def _numbers(element: Element, order: str) -> np.ndarray:
    kind, content = element
    if kind not in _TYPES:
        raise BadDataError(f"holds numbers of type {kind}", way_out=_COPY_AGAIN)
    return np.frombuffer(content, dtype=f"{order}{_TYPES[kind]}")
