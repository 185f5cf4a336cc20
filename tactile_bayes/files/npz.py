"""Arrays in .npz and .npy files, checkpoints of chains and draws for pooling."""

from __future__ import annotations

import hashlib
import io
import math
import os
import zipfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import IO, Any, Final

import numpy as np

from tactile_bayes.declarations import names_of
from tactile_bayes.errors import BadDataError, in_file
from tactile_bayes.files import reading
from tactile_bayes.files.atomic import write_bytes
from tactile_bayes.inference.ensemble import ChainState
from tactile_bayes.size.draws import ShapeDraws

# --- Arrays from an .npz file, without pickle; declared sizes are checked before memory is allocated.

Arrays = dict[str, np.ndarray[Any, np.dtype[Any]]]

_ENCRYPTED: Final = 0x1
_HEADERS: Final = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}


def load_npz(path: Path, *, required: Sequence[str], optional: Sequence[str]) -> Arrays:
    """Read the named arrays of an .npz file; errors, also of a file that is encrypted or too large, name no path."""

    def choose(names: Sequence[str]) -> Sequence[str]:
        if missing := [name for name in required if name not in names]:
            has = ", ".join(sorted(names)[:12]) or "nothing"
            raise BadDataError(f"lacks {', '.join(missing)} (it has {has})", way_out="add the missing arrays")
        return [name for name in (*required, *optional) if name in names]

    return choose_npz(path, choose)


def choose_npz(path: Path, choose: Callable[[Sequence[str]], Iterable[str]]) -> Arrays:
    """Read the arrays that `choose` takes from the names in an .npz file; for the errors see `load_npz`."""
    with reading.open_input(path) as stream:
        start = stream.read(6)
        if not zipfile.is_zipfile(stream):
            fault, way_out = f"is not an .npz file ({reading.beginning(start)})", "save it with numpy.savez_compressed"
            if start.startswith(reading.ZIP_MAGIC[:2]):
                fault, way_out = "is a zip archive that is cut off (no directory at its end)", "copy it again"
            elif start == np.lib.format.MAGIC_PREFIX:
                fault, way_out = "is a single .npy array", "save all arrays in one file with numpy.savez_compressed"
            raise BadDataError(fault, way_out=way_out)
        with reading.decoding("is not a whole .npz file", way_out="copy it again"), zipfile.ZipFile(stream) as archive:
            members = {name.removesuffix(".npy"): archive.getinfo(name) for name in archive.namelist()}
            if members and not any(name.endswith(".npy") for name in archive.namelist()):
                fault = f"is a zip archive without arrays (it has {', '.join(sorted(members)[:3])})"
                raise BadDataError(fault, way_out="save the sheet of a spreadsheet as .csv, arrays with numpy.savez")
            chosen = {name: members[name] for name in choose(list(members))}
            unpacked = sum(member.file_size for member in chosen.values())
            most = reading.unpacked_limit(os.fstat(stream.fileno()).st_size)
            reading.check_limit(unpacked, most, what="its arrays unpack to {} bytes")
            arrays = {}
            for name, member in chosen.items():
                if member.flag_bits & _ENCRYPTED:
                    raise BadDataError(f"{name} is encrypted", way_out="save the file without a password")
                with archive.open(member) as packed:
                    arrays[name] = _array(packed, member.file_size, name)
            return arrays


def load_npy(path: Path) -> Arrays:
    """Read an .npy file: one array, called ``frames``, or the fields of a structured one; see `load_npz`."""
    data = reading.read_bytes(path, most=reading.NETCDF_BYTES)
    array = _array(io.BytesIO(data), len(data), "its array")
    if array.dtype.names is None:
        return {"frames": array}
    return {name: array[name] for name in array.dtype.names}


def _array(stream: IO[bytes], length: int, name: str) -> np.ndarray[Any, np.dtype[Any]]:
    with reading.decoding(f"{name} is damaged"):
        shape, in_columns, dtype = _HEADERS[np.lib.format.read_magic(stream)](stream)
        if dtype.hasobject:
            what = f"{name} holds Python objects, which are never unpickled"
            raise BadDataError(what, way_out="save it as an array of plain numbers")
        size, bytes_held = math.prod(shape) * dtype.itemsize, length - stream.tell()
        if bytes_held != size:
            what = f"{name} declares {size:,} bytes (shape {shape}, {dtype}) and holds {bytes_held:,}"
            raise BadDataError(what, way_out=reading.COPY_AGAIN)
        data = bytearray(stream.read())  # up to the end of the member, so that its checksum is looked at
        flat: np.ndarray[Any, np.dtype[Any]] = np.frombuffer(data, dtype=dtype)
        return flat.reshape(shape, order="F" if in_columns else "C")


# --- Checkpoints of `estimate --method ensemble`: plain arrays in an .npz, with a hash of the map and settings.

SCHEMA = "tactile-bayes/checkpoint/2"
SHAPES = {"chain": 4, "log_density": 2, "accepted": 1, "twister": 2, "cursor": 2}


class CheckpointFile:
    """A checkpoint file, made when it does not exist and rewritten after each block of steps.

    `context` is a text that the chain depends on, such as the calibration's hash; with another it is refused.
    """

    def __init__(self, path: Path, *, context: str = "") -> None:
        self.path, self.context = path, context

    def load(self, key: str) -> ChainState | None:
        """Read the state; None when there is no file, an error when it is of another map, calibration or setting."""
        if not self.path.exists():
            return None
        with in_file(self.path):
            try:
                arrays = load_npz(self.path, required=["schema", "key", "sha256", *SHAPES], optional=())
            except BadDataError as error:
                raise BadDataError(f"is no checkpoint: {error.what}", way_out="name another file") from None
            if str(arrays["schema"]) != SCHEMA or any(arrays[name].ndim != n for name, n in SHAPES.items()):
                raise BadDataError(f"is no checkpoint of schema {SCHEMA}", way_out="name another file")
            if str(arrays["sha256"]) != _digest(arrays):
                raise BadDataError("is damaged: its checksum does not match", way_out="remove it")
            if str(arrays["key"]) != f"{key}:{self.context}":
                what = "is a checkpoint of another map, calibration or setting"
                way_out = "give the same map and options (only max_steps may differ), or name another file"
                raise BadDataError(what, way_out=way_out)
        return ChainState(**{name: arrays[name] for name in SHAPES})

    def save(self, key: str, state: ChainState) -> None:
        arrays: dict[str, Any] = {"schema": np.array(SCHEMA), "key": np.array(f"{key}:{self.context}")}
        arrays |= {name: getattr(state, name) for name in SHAPES}
        buffer = io.BytesIO()
        np.savez(buffer, sha256=np.array(_digest(arrays)), **arrays)
        write_bytes(self.path, buffer.getvalue(), force=True)


def _digest(arrays: Mapping[str, np.ndarray[Any, Any]]) -> str:
    """Checksum of the key and the state, so that no changed number is read as valid."""
    digest = hashlib.sha256()
    for name in ("key", *SHAPES):
        array = np.ascontiguousarray(arrays[name])
        digest.update(f"{name} {array.dtype.str} {array.shape};".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()


# --- Draws of a map for pooling, as plain arrays in an .npz; equal draws give equal bytes.

_DRAWS: Final = ("log_amplitude", "log_width", "q", "r")


def write_shape(path: Path, shape: ShapeDraws, *, force: bool = False) -> None:
    """Write the draws atomically; fields that are None are left out."""
    values = {name: value for name in names_of(shape) if (value := getattr(shape, name)) is not None}
    out = io.BytesIO()
    np.savez_compressed(out, **values)
    write_bytes(path, out.getvalue(), force=force)


def read_shape(path: Path) -> ShapeDraws:
    """Read what `write_shape` wrote."""
    with in_file(path):
        arrays = load_npz(path, required=_DRAWS, optional=names_of(ShapeDraws))
        if len({arrays[name].shape for name in _DRAWS}) > 1:
            raise BadDataError("holds draws of several lengths", way_out="estimate the map again")
        values: dict[str, Any] = dict(arrays)
        for name in set(arrays) - {*_DRAWS, "labels"}:  # a number, or a few
            values[name] = float(arrays[name]) if arrays[name].ndim == 0 else tuple(arrays[name].tolist())
        return ShapeDraws(**values)
