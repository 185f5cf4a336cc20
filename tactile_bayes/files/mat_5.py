"""MATLAB's files up to version 7: every size is checked before an array is made of it.

MAT-File Format (MathWorks), "Level 5 MAT-File Format": a header of 128 bytes, then elements, each with its type and
length before it; a matrix holds its flags, dimensions and name, then its numbers or, of a structure, its fields as
matrices. SciPy's reader ends the process over some damaged files.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import numpy as np

from tactile_bayes.errors import BadDataError
from tactile_bayes.files.npz import Arrays
from tactile_bayes.files.reading import NETCDF_BYTES, check_limit, decoding, read_bytes, unpacked_limit

MAT_5: Final = b"MATLAB 5.0 MAT-file"
_HEADER: Final = 128
_MATRIX, _COMPRESSED = 14, 15
_TYPES: Final = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
"""Types of numbers in an element."""
_STRUCT, _OPAQUE = 2, 17
_NUMERIC: Final = range(6, 16)  # classes of matrices from double to uint64
_COMPLEX: Final = 0x800
_MOST_LEVELS: Final = 8
_COPY_AGAIN: Final = "copy the file again"
_NO_NUMBERS: Final = np.array(None, dtype=object)

Element = tuple[int, bytes]


def load_mat_5(path: Path) -> Arrays:
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
