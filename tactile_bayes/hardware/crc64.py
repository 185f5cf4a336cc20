"""CRC-64 as OpenIGTLink uses it: polynomial of ECMA-182, initial value 0, nothing inverted or reflected.

The CRC of a message is the message as a polynomial over GF(2), times x^64, modulo the polynomial. That is linear: a
long message is folded in halves, all pairs of 64-bit words at once, with tables for the multiplication by x^(64 k).
"""

from __future__ import annotations

from functools import cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

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
