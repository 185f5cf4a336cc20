"""What a produced file holds, as text and arrays that can be compared; other programs than ours read the files."""

from __future__ import annotations

import hashlib
from pathlib import Path

import netCDF4
import nrrd
import numpy as np
import pydicom
from google.protobuf.json_format import MessageToDict
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from PIL import Image

Arrays = dict[str, np.ndarray]


def digest(data: bytes) -> str:
    """A short hash of bytes that are compared as a whole; short enough to be none of `DIGESTS`."""
    return f"{len(data)} bytes, sha256 {hashlib.sha256(data).hexdigest()[:32]}"


def netcdf(path: Path) -> tuple[str, Arrays]:
    """Groups, variables and attributes of a netCDF file as text, and its values."""
    lines, arrays = list[str](), Arrays()

    def look_at(where: str, one: netCDF4.Dataset | netCDF4.Variable) -> None:
        lines.extend(f"{where} @{name} = {one.getncattr(name)!r}" for name in sorted(one.ncattrs()))
        if isinstance(one, netCDF4.Variable):
            lines.append(f"{where} {one.dtype} {one.dimensions} {one.shape}")
            arrays[where] = np.asarray(one[...])
        else:
            for name, inner in sorted([*one.variables.items(), *one.groups.items()]):
                look_at(f"{where}/{name}", inner)

    with netCDF4.Dataset(path) as whole:
        whole.set_auto_mask(False)
        look_at("", whole)
    return "\n".join(lines), arrays


def mcap(path: Path) -> str:
    """Metadata, attachments and messages of a scan file."""
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        lines = [f"metadata {one.name} {dict(sorted(one.metadata.items()))}" for one in reader.iter_metadata()]
        lines += [f"attachment {one.name}\n{one.data.decode()}" for one in reader.iter_attachments()]
        for _, channel, message, decoded in reader.iter_decoded_messages():
            lines.append(f"{channel.topic} {message.log_time} {message.publish_time} {MessageToDict(decoded)}")
    return "\n".join(lines)


def dicom(path: Path) -> str:
    """All elements of a DICOM file; what is bytes is a digest."""
    data = pydicom.dcmread(path)
    return "\n".join([str(data), *(digest(one.value) for one in data.iterall() if isinstance(one.value, bytes))])


def readable(path: Path) -> tuple[str, Arrays]:
    """A produced file as text and arrays."""
    try:
        match path.suffix:
            case ".nc":
                return netcdf(path)
            case ".npz":
                with np.load(path) as arrays:
                    return "", dict(arrays)
            case ".nrrd":
                values, header = nrrd.read(str(path))
                return "\n".join(f"{key}: {value}" for key, value in header.items()), {"values": values}
            case ".mcap":
                return mcap(path), {}
            case ".dcm":
                return dicom(path), {}
            case ".png":
                with Image.open(path) as image:
                    return f"{image.mode} {image.size} {sorted(image.info.items())} {digest(image.tobytes())}", {}
        return path.read_text(encoding="utf-8"), {}
    except Exception as fault:  # the damaged file of the page on faults; another one is a defect
        return f"not readable: {type(fault).__name__}: {digest(path.read_bytes())}", {}
