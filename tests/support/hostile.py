"""Files made to hurt a reader: bombs that unpack to gigabytes, declared sizes without data, nesting, damage."""

from __future__ import annotations

import io
import json
import struct
import zipfile
import zlib
from pathlib import Path

import numpy as np
import zstandard


def npz_of(members: dict[str, bytes]) -> bytes:
    """An archive of ``NAME.npy`` members."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in members.items():
            archive.writestr(f"{name}.npy", data)
    return buffer.getvalue()


def npy(shape: str, data: bytes = b"", *, dtype: str = "<f8") -> bytes:
    """A version 1.0 .npy file with any header."""
    header = f"{{'descr': '{dtype}', 'fortran_order': False, 'shape': {shape}, }}".encode().ljust(117) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + data


def encrypted_npz() -> bytes:
    """An archive whose member says that it is encrypted."""
    data = bytearray(npz_of({"mean": npy("(2, 2)", bytes(32))}))
    data[6] |= 1
    data[data.index(b"PK\x01\x02") + 8] |= 1
    return bytes(data)


def png(width: int, height: int) -> bytes:
    """A black grey image of any size, packed by the megabyte so that it need never be held."""
    packer, rows = zlib.compressobj(9), []
    block, left = bytes(1_000_000), height * (width + 1)
    while left > 0:
        rows.append(packer.compress(block[: min(left, len(block))]))
        left -= len(block)
    pixels = b"".join(rows) + packer.flush()
    head = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    chunks = ((b"IHDR", head), (b"IDAT", pixels), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data)) for name, data in chunks
    )


def mcap_records(scan: bytes) -> list[tuple[int, bytes]]:
    """The records of an MCAP file: opcode and content."""
    records, at = [], 8
    while at + 9 <= len(scan) - 8:
        opcode, length = struct.unpack_from("<BQ", scan, at)
        records.append((opcode, scan[at + 9 : at + 9 + length]))
        at += 9 + length
    return records


def mcap_of(magic: bytes, records: list[tuple[int, bytes]]) -> bytes:
    """A file of records, its checksum right."""
    out = bytearray(magic)
    for opcode, body in records:
        body = struct.pack("<I", zlib.crc32(out)) if opcode == 15 else body
        out += struct.pack("<BQ", opcode, len(body)) + body
    return bytes(out + magic)


def mcap_chunk(data: bytes, *, packing: bytes = b"zstd") -> bytes:
    """A chunk with these records in it, its checksum right; packed by zstd whatever it says."""
    packed = zstandard.compress(data, 19)
    head = struct.pack("<QQQII", 0, 1, len(data), zlib.crc32(data), len(packing)) + packing
    return head + struct.pack("<Q", len(packed)) + packed


def mcap_with(scan: bytes, *chunks: bytes) -> bytes:
    """A scan with these chunks in the place of its own."""
    records = mcap_records(scan)
    first = next(i for i, (opcode, _) in enumerate(records) if opcode == 6)
    others = records[:first]
    after = [record for record in records[first:] if record[0] in (15, 2)]
    return mcap_of(scan[:8], [*others, *((6, chunk) for chunk in chunks), *after])


def deep_json(levels: int = 100_000) -> str:
    """Lists in lists."""
    return "[" * levels + "]" * levels


def dotted_toml(parts: int = 20_000) -> str:
    """One key of many parts: 40 kB that the parser looks at for 20 s."""
    return ".".join(["a"] * parts) + " = 1\n"


def deflate_bomb(path: Path, megabytes: int) -> None:
    """A map in which one packed chunk unpacks to far more than it declares."""
    import h5py

    with h5py.File(path, "r+") as file:
        packed = zlib.compressobj(9)
        block = bytes(1_000_000)
        data = b"".join(packed.compress(block) for _ in range(megabytes)) + packed.flush()
        file["mean"].id.write_direct_chunk((0, 0), data + bytes(4))


def write_chunk(path: Path, data: bytes, *, skipped: int = 0) -> None:
    """A map in which the first chunk of `mean` is stored as `data`; bits of `skipped` are filters not applied."""
    import h5py

    with h5py.File(path, "r+") as file:
        file["mean"].id.write_direct_chunk((0, 0), data, filter_mask=skipped)


def claim_chunk(path: Path, size: int) -> None:
    """A map that says of the first chunk of `mean` that it is stored in `size` bytes."""
    import h5py

    with h5py.File(path) as file:
        stored = file["mean"].id.get_chunk_info(0)
    there, claimed = (struct.pack("<IIQQQQ", n, 0, 0, 0, 0, stored.byte_offset) for n in (stored.size, size))
    data = path.read_bytes()
    assert data.count(there) == 1
    path.write_bytes(data.replace(there, claimed))


def ragged_calibration(source: Path, *place: str) -> str:
    """A size calibration in which one row of the matrix at `place` is short."""
    document = json.loads(source.read_text())
    matrix = document
    for name in place:
        matrix = matrix[name]
    matrix[0] = matrix[0][:-1]
    return json.dumps(document)


def full_npz() -> bytes:
    """190 bytes that declare 10^12 values."""
    return npz_of({"mean": npy("(1000000, 1000000)"), "spacing_mm": npy("()", np.float64(1).tobytes())})
