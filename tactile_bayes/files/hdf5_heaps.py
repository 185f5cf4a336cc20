"""Check of an HDF5 file's text heaps before the library opens it: a damaged size makes the library loop forever."""

from __future__ import annotations

import struct
from typing import Final

from tactile_bayes.errors import BadDataError

_COLLECTION: Final = b"GCOL\x01\x00\x00\x00"
_OBJECT: Final = struct.Struct("<HHIQ")  # index, references, reserved, size
_ALIGNMENT: Final = 8


def check_heaps(data: bytes, *, way_out: str) -> None:
    """Refuse a file whose global heap has free space of size 0.

    The HDF5 library (seen with 2.0) walks from object to object by their sizes and would stay at that one.

    Raises
    ------
    BadDataError
        When there is such a heap, or when heaps lie inside one another.

    References
    ----------
    HDF5 File Format Specification 3.0, III.E, "Disk Format: Level 1E - Global Heap".
    """
    steps = len(data) // _OBJECT.size  # as many objects as the file can hold
    start = data.find(_COLLECTION)
    while start >= 0:
        at = start + len(_COLLECTION)
        end = min(len(data), start + int.from_bytes(data[at : at + 8], "little"))
        at += 8
        while at + _OBJECT.size <= end:
            index, _, _, size = _OBJECT.unpack_from(data, at)
            steps -= 1
            if steps < 0 or (index == 0 and size == 0):
                raise BadDataError("not a readable netCDF file (a damaged heap)", way_out=way_out)
            at += size if index == 0 else _OBJECT.size + -(-size // _ALIGNMENT) * _ALIGNMENT
        start = data.find(_COLLECTION, start + 1)
