"""Sequence metafiles (``.mha``, ``.igs.mha``): frames as an image of three axes, with a transform and a time for each.

PLUS writes them: a header of ``Key = value`` lines, among them ``Seq_Frame0000_ProbeToTrackerTransform`` with the 16
numbers of a matrix in mm, its ``...TransformStatus`` (OK or INVALID) and ``Seq_Frame0000_Timestamp`` in s, then after
``ElementDataFile = LOCAL`` the numbers, packed by zlib where ``CompressedData`` is True.
"""

from __future__ import annotations

import re
import zlib
from pathlib import Path
from typing import Final

import numpy as np

from tactile_bayes.declarations import replace
from tactile_bayes.errors import BadDataError, in_file
from tactile_bayes.files.arrays_layout import Stated
from tactile_bayes.files.named_arrays import Source
from tactile_bayes.files.npz import Arrays
from tactile_bayes.files.reading import NETCDF_BYTES, check_limit, decoding, read_bytes, unpacked_limit
from tactile_bayes.files.scan_text import choose_tool, visible_poses
from tactile_bayes.geometry import FloatArray

_LAST_KEY: Final = re.compile(rb"^ElementDataFile *= *(.*?)\r?\n", re.MULTILINE)
_LINE: Final = re.compile(r"^\s*(\w+)\s*=\s*(.*?)\s*$", re.MULTILINE)
_OF_FRAME: Final = re.compile(r"Seq_Frame(\d+)_(\w+)")
_TYPES: Final = {
    "MET_UCHAR": "u1",
    "MET_CHAR": "i1",
    "MET_USHORT": "u2",
    "MET_SHORT": "i2",
    "MET_UINT": "u4",
    "MET_INT": "i4",
    "MET_FLOAT": "f4",
    "MET_DOUBLE": "f8",
}


def is_sequence(path: Path) -> bool:
    """True for the name of a metafile with its data in it."""
    return path.suffix.lower() == ".mha"


def read_sequence(path: Path, stated: Stated, *, frames: bool) -> Source:
    """Read the poses, and with `frames` the images and their times; see `files.scan_text.read_poses`."""
    data = read_bytes(path, most=NETCDF_BYTES)
    with in_file(path):
        last = _LAST_KEY.search(data)
        if last is None or last[1] != b"LOCAL":
            raise BadDataError("has no numbers behind a line ElementDataFile = LOCAL", way_out="save it as one .mha")
        with decoding("is no metafile"):
            keys = dict(_LINE.findall(data[: last.end()].decode("utf-8")))
        poses = _poses(keys, stated)
        return replace(poses, arrays={**poses.arrays, **_frames(keys, data[last.end() :])}) if frames else poses


def _values_per_frame(keys: dict[str, str], name: str, number: int) -> list[str]:
    """A key's value for each frame; empty where the frame has none."""
    return [keys.get(f"Seq_Frame{i:04d}_{name}", "") for i in range(number)]


def _numbers(texts: list[str], width: int) -> FloatArray:
    """(n, width) numbers, NaN where a frame has none."""
    rows = [text.split() for text in texts]
    with decoding("holds a transform or a time that is no number"):
        return np.array([[float(one) for one in row] if len(row) == width else [np.nan] * width for row in rows])


def _poses(keys: dict[str, str], stated: Stated) -> Source:
    frame_keys = [one for key in keys if (one := _OF_FRAME.fullmatch(key))]
    frame_count = len({frame_key[1] for frame_key in frame_keys})
    tools = dict.fromkeys(one[2] for one in frame_keys if one[2].endswith("Transform"))
    if not tools:
        raise BadDataError("has no transforms of frames", way_out="give poses that were recorded with the frames")
    tool = choose_tool([name.removesuffix("Transform") for name in tools], stated, place="its transforms")
    status = _values_per_frame(keys, f"{tool}TransformStatus", frame_count)
    reasons = ["" if one in ("OK", "") else f"with status {one}" for one in status]
    time = _numbers(_values_per_frame(keys, "Timestamp", frame_count), 1)[:, 0]
    if not np.isfinite(time).all():
        raise BadDataError("has frames without a time", way_out="give the times, Seq_Frame0000_Timestamp")
    matrices = _numbers(_values_per_frame(keys, f"{tool}Transform", frame_count), 16)
    return visible_poses(time, matrices, reasons, f"poses by {tool}Transform", layout="matrix", pose_time_unit="s")


def _frames(keys: dict[str, str], data: bytes) -> Arrays:
    """(n, rows, columns) numbers and their times; the first axis of a metafile runs along a row."""
    with decoding("is no metafile"):
        shape = tuple(int(one) for one in reversed(keys["DimSize"].split()))
        kind = np.dtype(_TYPES[keys["ElementType"]])
    if keys.get("BinaryDataByteOrderMSB", keys.get("ElementByteOrderMSB", "False")) == "True":
        kind = kind.newbyteorder(">")
    shape = shape[:1] + tuple(one for one in shape[1:] if one > 1) if len(shape) > 3 else shape  # slices of one image
    size = int(np.prod(shape, dtype=object)) * kind.itemsize
    check_limit(size, unpacked_limit(len(data)), what="its frames unpack to {} bytes")
    if keys.get("CompressedData", "False") == "True":
        with decoding("is not whole"):
            data = zlib.decompressobj().decompress(data, size + 1)
    if len(shape) != 3 or len(data) != size or min(shape) < 1:
        what = f"has DimSize {keys['DimSize']} of {kind} and {len(data)} bytes"
        raise BadDataError(what, way_out="give columns, rows and frames, unpacked or packed by zlib")
    time = _numbers(_values_per_frame(keys, "Timestamp", shape[0]), 1)[:, 0]
    return {"frames": np.frombuffer(data, dtype=kind).reshape(shape), "frame_time_s": time}
