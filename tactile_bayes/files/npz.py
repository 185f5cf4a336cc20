"""Arrays from an .npz file, without pickle; declared sizes are checked before memory is allocated."""

from __future__ import annotations

import math
import os
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import IO, Any, Final

import numpy as np

from tactile_bayes.errors import BadDataError
from tactile_bayes.files.kinds import ZIP_MAGIC
from tactile_bayes.files.reading import check_limit, decoding, open_input, unpacked_limit

Arrays = dict[str, np.ndarray[Any, np.dtype[Any]]]

_COPY_AGAIN: Final = "copy the file again"
_ENCRYPTED: Final = 0x1
_HEADERS: Final = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}


def load_npz(
    path: Path, *, required: Sequence[str], optional: Sequence[str], shapes: Mapping[str, str] | None = None
) -> Arrays:
    """Read the named arrays of an .npz file.

    Parameters
    ----------
    shapes
        In words, for the error where an array is missing.

    Raises
    ------
    BadDataError
        When the file is no .npz, is cut off, encrypted or damaged, lacks a required array, unpacks to more than its
        limit, or holds an array that only pickle could read. The error names no path.
    """
    with open_input(path) as stream:
        _check_zip(stream)
        with decoding("is not a whole .npz file", way_out="copy it again"), zipfile.ZipFile(stream) as archive:
            members = {name.removesuffix(".npy"): archive.getinfo(name) for name in archive.namelist()}
            missing = [name for name in required if name not in members]
            if missing:
                raise _missing(missing, found=list(members), shapes=shapes or {})
            wanted = {name: members[name] for name in (*required, *optional) if name in members}
            unpacked = sum(member.file_size for member in wanted.values())
            most = unpacked_limit(os.fstat(stream.fileno()).st_size)
            check_limit(unpacked, most, what="its arrays unpack to {} bytes")
            return {name: _member(archive, member, name) for name, member in wanted.items()}


def _check_zip(stream: IO[bytes]) -> None:
    start = stream.read(6)
    if zipfile.is_zipfile(stream):
        return
    if start.startswith(ZIP_MAGIC[:2]):
        raise BadDataError("is a zip archive that is cut off (no directory at its end)", way_out="copy it again")
    if start == np.lib.format.MAGIC_PREFIX:
        raise BadDataError("is a single .npy array", way_out="save all arrays in one file with numpy.savez_compressed")
    raise BadDataError(f"is not an .npz file (it starts with {start!r})", way_out="save it with numpy.savez_compressed")


def _missing(missing: Sequence[str], *, found: Sequence[str], shapes: Mapping[str, str]) -> BadDataError:
    lacks = ", ".join(f"{name} ({shapes[name]})" if name in shapes else name for name in missing)
    see = "; `tactile-bayes import --help` says what they are" if shapes else ""
    has = ", ".join(sorted(found)[:12]) or "nothing"
    grid = " (for a grid of values give --as map)" if "mean" in found else ""
    return BadDataError(f"lacks {lacks} (it has {has})", way_out=f"add the missing arrays{grid}{see}")


def _member(archive: zipfile.ZipFile, member: zipfile.ZipInfo, name: str) -> np.ndarray[Any, np.dtype[Any]]:
    if member.flag_bits & _ENCRYPTED:
        raise BadDataError(f"{name} is encrypted", way_out="save the file without a password")
    with decoding(f"{name} is damaged", way_out=_COPY_AGAIN), archive.open(member) as stream:
        shape, in_columns, dtype = _HEADERS[np.lib.format.read_magic(stream)](stream)
        if dtype.hasobject:
            what = f"{name} holds Python objects, which are never unpickled"
            raise BadDataError(what, way_out="save it as an array of plain numbers")
        size, held = math.prod(shape) * dtype.itemsize, member.file_size - stream.tell()
        if held != size:
            what = f"{name} declares {size:,} bytes (shape {shape}, {dtype}) and holds {held:,}"
            raise BadDataError(what, way_out=_COPY_AGAIN)
        data = bytearray(stream.read())  # up to the end of the member, so that its checksum is looked at
        flat: np.ndarray[Any, np.dtype[Any]] = np.frombuffer(data, dtype=dtype)
        return flat.reshape(shape, order="F" if in_columns else "C")
