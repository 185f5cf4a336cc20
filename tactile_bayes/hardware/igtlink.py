"""OpenIGTLink: messages, their checksum, the tracker's driver."""

from __future__ import annotations

import struct
from functools import cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from tactile_bayes.geometry import quaternion_from_rotation
from tactile_bayes.hardware.readings import PoseReading, Reading

# --- CRC-64 as OpenIGTLink uses it: polynomial of ECMA-182, initial value 0, nothing inverted or reflected.
#
# The CRC of a message is the message as a polynomial over GF(2), times x^64, modulo the polynomial. That is linear:
# a long message is folded in halves, all pairs of 64-bit words at once, with tables for the multiplication by x^(64
# k).

Words = NDArray[np.uint64]

POLYNOMIAL: Final = 0x42F0E1EBA9EA3693
_BITS: Final = 0xFFFF_FFFF_FFFF_FFFF
# Shorter messages cost less byte by byte than numpy's calls do.
_SHORT: Final = 2048


def _byte_table() -> tuple[int, ...]:
    """CRC of each single byte."""
    table = []
    for byte in range(256):
        crc = byte << 56
        for _ in range(8):
            crc = (crc << 1 ^ (POLYNOMIAL if crc >> 63 else 0)) & _BITS
        table.append(crc)
    return tuple(table)


_TABLE: Final = _byte_table()


def crc64(data: bytes) -> int:
    """CRC-64/ECMA-182; of ``123456789`` it is 0x6C40DF5F0B497347."""
    return _bytewise(data) if len(data) < _SHORT else _folded(data)


def _bytewise(data: bytes) -> int:
    crc = 0
    for byte in data:
        crc = (crc << 8 ^ _TABLE[crc >> 56 ^ byte]) & _BITS
    return crc


def _folded(data: bytes) -> int:
    """As `crc64`, in numpy; leading zeros do not change a CRC."""
    levels = max(0, (-(-len(data) // 8) - 1).bit_length())
    whole = data.rjust(8 << levels, b"\0")
    words = np.frombuffer(whole, dtype=">u8").astype(np.uint64)
    for level in range(levels):
        words = _times_power(words[0::2], level) ^ words[1::2]
    return int(_times_power(words, 0)[0])


def _times_power(words: Words, level: int) -> Words:
    """Each word times x^(64 2^level), modulo the polynomial."""
    tables, places = _tables(level), np.ascontiguousarray(words, dtype="<u8").view(np.uint8).reshape(-1, 8)
    product: Words = tables[0][places[:, 0]]
    for number in range(1, 8):
        product ^= tables[number][places[:, number]]
    return product.reshape(words.shape)


@cache
def _tables(level: int) -> Words:
    """(8, 256) products of a byte, in each of its eight places in a word, and x^(64 2^level)."""
    if level:
        return _times_power(_tables(level - 1), level - 1)
    single = [[(byte << 8 * place).to_bytes(8, "big") for byte in range(256)] for place in range(8)]
    return np.array([[_bytewise(word) for word in row] for row in single], dtype=np.uint64)


# --- Parser for OpenIGTLink TRANSFORM messages, as PlusServer and 3D Slicer send them over TCP.
#
# A message is a header of 58 bytes and a body, big-endian, with a CRC-64 of the body. A transform's body is the 3 x
# 4 matrix column by column, float32, in mm.

_HEADER: Final = struct.Struct(">H12s20sIIQQ")  # version, type, device, s, fraction, body size, CRC
_BODY: Final = struct.Struct(">12f")
_KIND_AT: Final = 2
_TRANSFORM: Final = b"TRANSFORM\0\0\0"
_LONGEST: Final = 1 << 20
_RIGID_SLACK: Final = 0.02


class IgtlinkParser:
    """Parser of one device name's TRANSFORM messages (any device's, when empty); skips other messages.

    The header has no checksum: a spoilt size may claim a megabyte of what follows. While a message waits for its end, a
    whole transform inside it shows that the size was wrong.
    """

    def __init__(self, *, device: str = "") -> None:
        self.garbage_bytes = 0
        self._device = device.encode()
        self._rest = b""

    def feed(self, data: bytes) -> list[Reading]:
        """Parse `data`; return the completed poses."""
        buffer, place = self._rest + data, 0
        found: list[Reading] = []
        while len(buffer) - place >= _HEADER.size:
            version, kind, device, seconds, fraction, size, crc = _HEADER.unpack_from(buffer, place)
            if not 1 <= version <= 3 or size > _LONGEST or not kind.rstrip(b"\0").isalnum():
                place += 1
                self.garbage_bytes += 1
                continue
            end = place + _HEADER.size + size
            if end > len(buffer):
                inside = _whole_transform(buffer, place + 1)
                if inside < 0:
                    break
                self.garbage_bytes += inside - place
                place = inside
                continue
            body = buffer[place + _HEADER.size : end]
            if crc64(body) != crc:
                place += 1
                self.garbage_bytes += 1
                continue
            place = end
            wanted = not self._device or device.rstrip(b"\0") == self._device
            if kind == _TRANSFORM and size == _BODY.size and wanted:
                found += _pose(body, seconds, fraction)
        self._rest = buffer[place:]
        return found


def _whole_transform(buffer: bytes, start: int) -> int:
    """Index of the first valid transform from `start` on; -1 without one."""
    place = buffer.find(_TRANSFORM, start + _KIND_AT)
    while place >= 0:
        begin = place - _KIND_AT
        end = begin + _HEADER.size + _BODY.size
        if end > len(buffer):
            return -1
        version, _, _, _, _, size, crc = _HEADER.unpack_from(buffer, begin)
        if 1 <= version <= 3 and size == _BODY.size and crc64(buffer[end - size : end]) == crc:
            return begin
        place = buffer.find(_TRANSFORM, place + 1)
    return -1


def _pose(body: bytes, seconds: int, fraction: int) -> list[Reading]:
    columns = np.array(_BODY.unpack(body), dtype=np.float64).reshape(4, 3)
    rotation, position = columns[:3].T, columns[3]
    if (
        not np.isfinite(columns).all()
        or np.abs(position).max() > 25_000
        or np.abs(rotation @ rotation.T - np.eye(3)).max() > _RIGID_SLACK
    ):
        return []
    w, i, j, k = (float(value) for value in quaternion_from_rotation(rotation))
    x, y, z = (float(value) for value in position)
    device_ns = seconds * 1_000_000_000 + (fraction * 1_000_000_000 >> 32)
    return [PoseReading((x, y, z), (w, i, j, k), device_ns)]


def encode_transform(pose: PoseReading, rotation: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> bytes:
    """Encode a pose with its rotation matrix as a message."""
    body = _BODY.pack(*rotation.T.ravel(), *pose.position_mm)
    seconds, rest_ns = divmod(pose.device_ns or 0, 1_000_000_000)
    fraction = -(-(rest_ns << 32) // 1_000_000_000)  # rounded up, so that whole nanoseconds come back
    return _HEADER.pack(1, b"TRANSFORM", b"Tracker", seconds, fraction, len(body), crc64(body)) + body
