"""Reading and writing of netCDF-4 by h5py, within limits."""

from __future__ import annotations

import contextlib
import io
import struct
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path, PurePosixPath
from threading import get_ident
from typing import Any, Final

import h5py
import numpy as np

from tactile_bayes.declarations import Record
from tactile_bayes.errors import BadDataError, in_file
from tactile_bayes.files import reading
from tactile_bayes.files.documents import check_text

# --- Check of an HDF5 file's text heaps before the library opens it: a damaged size makes the library loop forever.

_COLLECTION: Final = b"GCOL\x01\x00\x00\x00"
_OBJECT: Final = struct.Struct("<HHIQ")  # index, references, reserved, size
_ALIGNMENT: Final = 8


def check_heaps(data: bytes, *, way_out: str) -> None:
    """Refuse a file whose global heap has free space of size 0, or heaps inside one another.

    The HDF5 library (seen with 2.0) walks from object to object by their sizes and would stay at that one. HDF5 File
    Format Specification 3.0, III.E, "Disk Format: Level 1E - Global Heap".
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


# --- Files of netCDF-4 by h5py alone: written in memory and stored atomically, read with every size checked first.
#
# A netCDF-4 file is an HDF5 file whose dimensions are dimension scales. A dimension without a variable of its name
# is an empty scale, which netCDF hides. Record 0080 says why neither netCDF4 nor h5netcdf is used here.

_NO_VARIABLE: Final = "This is a netCDF dimension but not a netCDF variable.{:10d}"
_PACKING: Final = {"compression": "gzip", "compression_opts": 4, "shuffle": True, "fletcher32": True}
_DEFLATE, _SHUFFLE, _CHECKSUM = 1, 2, 3  # HDF5's numbers of the filters above
_CHECKSUM_BYTES: Final = 4
_DAMAGED: Final = "not a readable netCDF file"


class Variable(Record):
    """One array of a netCDF file."""

    values: Any  #: Numbers; their type is the variable's.
    dimensions: tuple[str, ...]  #: The name of each axis.
    attributes: Mapping[str, str]  #: Text by name: units, a long name.
    fill: float | None = None  #: The ``_FillValue`` of a variable whose cells may have no value; not for coordinates.


class Contents(Record):
    """Contents of one group of a netCDF file."""

    variables: Mapping[str, Variable]
    """By name; one with the name of its only dimension is that dimension's coordinate."""
    attributes: Mapping[str, str]  #: Text by name.


def grouped_netcdf_bytes(groups: Mapping[str, Contents]) -> bytes:
    """A netCDF-4 file of several groups by name, each with its own dimensions; ``/`` is the root.

    Equal contents give equal bytes under one version of HDF5 and zlib."""
    name = f"memory {get_ident()}"  # HDF5 knows its open files by name, and another thread may be writing
    with h5py.File(name, "w", driver="core", backing_store=False, track_order=True) as file:
        written = 0
        for group, contents in groups.items():
            place = file if group == "/" else file.create_group(group, track_order=True)
            place.attrs.update(contents.attributes)
            scales = _write_dimensions(place, contents.variables, first=written)
            written += len(scales)
            for name, variable in contents.variables.items():
                if name not in scales:
                    array = _write_values(place, name, variable)
                    for axis, dimension in enumerate(variable.dimensions):
                        array.dims[axis].attach_scale(scales[dimension])
        file.flush()
        image: bytes = file.id.get_file_image()
    return image


def _write_dimensions(place: Any, variables: Mapping[str, Variable], *, first: int) -> dict[str, Any]:
    """Write a scale for each dimension, with its coordinate values where it has some, numbered from `first`."""
    lengths: dict[str, int] = {}
    for variable in variables.values():
        lengths |= dict(zip(variable.dimensions, np.shape(variable.values), strict=True))
    scales = {}
    for number, (name, length) in enumerate(lengths.items(), start=first):
        if name in variables:
            scale = _write_values(place, name, variables[name])
            scale.make_scale(name)
        else:
            scale = place.create_dataset(name, shape=(length,), dtype=">f4")
            scale.make_scale(_NO_VARIABLE.format(length))
            scale.flush()
        scale.attrs["_Netcdf4Dimid"] = np.int32(number)
        scales[name] = scale
    return scales


def _write_values(place: Any, name: str, variable: Variable) -> Any:
    written = place.create_dataset(name, data=variable.values, fillvalue=variable.fill, track_order=True, **_PACKING)
    if variable.fill is not None:
        written.attrs["_FillValue"] = np.array([variable.fill], written.dtype)
    written.attrs.update(variable.attributes)
    written.flush()  # else its chunks get their place when its last reference goes, and a profiler may hold one
    return written


MOST: Final = 1e12  #: Largest finite number in an array.


class Group:
    """One group of an open netCDF file; each array is checked before it is read, and may unpack to `most_bytes`."""

    def __init__(self, place: Any, *, most_bytes: int, way_out: str) -> None:
        self._place = place
        self._most_bytes = most_bytes
        self._way_out = way_out

    def group(self, name: str) -> Group | None:
        """Subgroup by name; None where there is none."""
        member = self._member(name)
        if not isinstance(member, h5py.Group):
            return None
        return Group(member, most_bytes=self._most_bytes, way_out=self._way_out)

    def attributes(self) -> dict[str, str]:
        """Text attributes by name."""
        texts = {}
        for name, value in self._place.attrs.items():
            one = value.item() if isinstance(value, np.ndarray) and value.size == 1 else value  # a list of one
            if isinstance(one, bytes | str):  # of fixed or variable length
                texts[str(name)] = text = one.decode("utf-8") if isinstance(one, bytes) else one
                check_text(f"attribute {name}", text, way_out=self._way_out)
        return texts

    def dimension(self, name: str) -> int | None:
        """The length of a dimension; None where there is none."""
        dataset = self._dataset(name)
        return None if dataset is None or len(dataset.shape) != 1 else int(dataset.shape[0])

    def variables(self) -> list[str]:
        """Names of the arrays in alphabetical order, without dimensions that have no values."""
        return sorted(name for name in map(str, self._place) if self._array(name) is not None)

    def array(self, name: str, *, kind: str, dimensions: tuple[str, ...]) -> Any:
        """Values of a variable of this type (``f8``, ``i8``, ``u2``) and dimensions; None where there is none."""
        dataset = self._array(name)
        if dataset is None:
            return None
        if dataset.dtype.newbyteorder("=") != np.dtype(kind):
            raise BadDataError(f"variable {name} is {dataset.dtype}, not {np.dtype(kind)}", way_out=self._way_out)
        axes = _dimensions(dataset)
        if axes != dimensions:
            raise BadDataError(f"variable {name} has dimensions {axes}, not {dimensions}", way_out=self._way_out)
        values = np.asarray(self._values(name, dataset), dtype=np.dtype(kind))
        # beyond any quantity here, and sums overflow; whoever reads a variable judges its infinities
        if values.dtype.kind == "f" and (np.abs(values[np.isfinite(values)]) > MOST).any():
            raise BadDataError(f"variable {name} holds values beyond {MOST:g}", way_out=self._way_out)
        return values

    def numbers(self, name: str) -> Any:
        """Values of an array of real numbers of any type and dimensions, see `as_declared`; None for another array."""
        dataset = self._dataset(name)
        return as_declared(self._values(name, dataset), dataset.attrs) if dataset.dtype.kind in "iuf" else None

    def groups(self) -> dict[str, Group]:
        """The groups in this one by their names, in alphabetical order."""
        return {name: group for name in sorted(map(str, self._place)) if (group := self.group(name)) is not None}

    def _values(self, name: str, dataset: Any) -> Any:
        """Values of a dataset, of whose chunks each unpacks to its declared size.

        HDF5 unpacks more for as long as there is memory, takes what is missing from whatever lies in memory, and ends
        the process where a checksum has less than its four bytes.
        """
        created = dataset.id.get_create_plist()
        filters = [created.get_filter(number)[0] for number in range(created.get_nfilters())]
        if len(set(filters)) < len(filters) or not set(filters) <= {_DEFLATE, _SHUFFLE, _CHECKSUM}:
            way_out = "pack it by gzip, with shuffle and checksum or without: h5repack -f GZIP=4"
            raise BadDataError(f"variable {name} is packed by filters {filters}", way_out=way_out)
        chunks = [dataset.id.get_chunk_info(n) for n in range(dataset.id.get_num_chunks())] if dataset.chunks else []
        declared = int(np.prod(dataset.chunks or (0,), dtype=object)) * dataset.dtype.itemsize
        sizes = {
            f"variable {name} unpacks to {{}} bytes": dataset.size * dataset.dtype.itemsize,
            f"a chunk of variable {name} unpacks to {{}} bytes": declared,
            f"a chunk of variable {name} takes {{}} bytes": max((stored.size for stored in chunks), default=0),
        }
        largest = max(sizes, key=lambda what: sizes[what])
        reading.check_limit(sizes[largest], self._most_bytes, what=largest)
        for stored in chunks:
            over = _unpacked_bytes(dataset, stored, filters, most=declared + 1) - declared
            if over:
                what = f"a chunk of variable {name} unpacks to {'more' if over > 0 else 'less'} than it declares"
                raise BadDataError(what, way_out=self._way_out)
        return dataset[...]

    def _member(self, name: str) -> Any:
        """Member of this file by name; links to other places and files are not followed."""
        if not isinstance(self._place.get(name, getlink=True), h5py.HardLink):
            return None
        return self._place[name]

    def _dataset(self, name: str) -> Any:
        """Dataset whose values are in this file; None where there is none."""
        member = self._member(name)
        if not isinstance(member, h5py.Dataset):
            return None
        if member.shape is None or member.external or member.is_virtual:
            raise BadDataError(f"variable {name} has its values in another file", way_out=self._way_out)
        return member

    def _array(self, name: str) -> Any:
        """Dataset with values of its own, which that of a bare dimension has not; None where there is none."""
        dataset = self._dataset(name)
        scale = b"" if dataset is None else dataset.attrs.get("NAME", b"")
        text = scale.decode("utf-8", "replace") if isinstance(scale, bytes) else str(scale)
        return None if text.startswith(_NO_VARIABLE.partition("{")[0]) else dataset


def _unpacked_bytes(dataset: Any, stored: Any, filters: list[int], *, most: int) -> int:
    """Bytes that a chunk unpacks to, up to `most`; negative where the checksum is cut off."""
    applied = [one for number, one in enumerate(filters) if not stored.filter_mask >> number & 1]
    if _DEFLATE not in applied:
        return int(stored.size) - _CHECKSUM_BYTES * (_CHECKSUM in applied)
    _, packed = dataset.id.read_direct_chunk(stored.chunk_offset)
    before, after = applied[: applied.index(_DEFLATE)], applied[applied.index(_DEFLATE) :]
    if _CHECKSUM in after:
        packed = packed[:-_CHECKSUM_BYTES]
    room = _CHECKSUM_BYTES * (_CHECKSUM in before)
    return len(zlib.decompressobj().decompress(packed, most + room)) - room


def as_declared(values: Any, attributes: Mapping[str, Any]) -> Any:
    """Values as their attributes declare them: NaN for ``_FillValue`` and ``missing_value``, then unpacked by
    ``scale_factor`` and ``add_offset`` (CF conventions 1.11, sections 2.5.1 and 8.1).
    """
    names = ("_FillValue", "missing_value", "scale_factor", "add_offset")
    declared = {name: np.atleast_1d(np.asarray(attributes[name])) for name in names if name in attributes}
    numeric = {name: array for name, array in declared.items() if array.dtype.kind in "iuf" and array.size}
    missing = np.zeros(np.shape(values), dtype=bool)
    for name in names[:2]:
        missing |= np.isin(values, numeric.get(name, np.array([], values.dtype)))
    scale, offset = (float(numeric.get(name, [one])[0]) for name, one in (("scale_factor", 1), ("add_offset", 0)))
    if not missing.any() and (scale, offset) == (1, 0):
        return values
    return np.where(missing, np.nan, values * scale + offset)


def _dimensions(dataset: Any) -> tuple[str, ...]:
    """Name of each axis from the attached scale; a coordinate variable names its own."""
    if dataset.is_scale:
        return (PurePosixPath(dataset.name).name,)
    if not _has_scales(dataset):
        return ("",) * len(dataset.shape)
    return tuple(PurePosixPath(axis[0].name).name if len(axis) else "" for axis in dataset.dims)


def _has_scales(dataset: Any) -> bool:
    """True if the list of scales is of the right type: HDF5 ends the process over another."""
    if "DIMENSION_LIST" not in dataset.attrs:
        return False
    listed = dataset.attrs.get_id("DIMENSION_LIST")
    element = h5py.check_vlen_dtype(listed.dtype)
    is_reference = element is not None and h5py.check_ref_dtype(element) is h5py.Reference
    return bool(is_reference and listed.shape == (len(dataset.shape),))


@contextlib.contextmanager
def open_netcdf(path: Path, *, way_out: str, begins_at: int = 0) -> Iterator[Group]:
    """The root group of a netCDF-4 or HDF5 file, whose first byte is at `begins_at`; every fault in the block becomes a
    `BadDataError` that names `path`."""
    with in_file(path), reading.open_input(path) as stream, reading.decoding(_DAMAGED, way_out=way_out):
        stream.seek(begins_at)
        if stream.read(len(reading.HDF5_MAGIC)) != reading.HDF5_MAGIC:
            raise reading.wrong_kind(path, reading.MAP, what=_DAMAGED, way_out=way_out)
        reading.check_limit(stream.seek(0, io.SEEK_END), reading.NETCDF_BYTES, what="it has {} bytes")
        stream.seek(0)
        data = stream.read()
        check_heaps(data, way_out=way_out)
        with h5py.File(io.BytesIO(data), "r") as file:
            yield Group(file, most_bytes=reading.unpacked_limit(len(data)), way_out=way_out)
