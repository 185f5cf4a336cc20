"""Damage to a file: flipped bits, cuts, splices, wrong lengths, awkward words; with its checksums made right again."""

from __future__ import annotations

import io
import random
import struct
import zipfile
import zlib
from collections.abc import Callable, Sequence

Mutation = Callable[[random.Random, bytearray, Sequence[bytes]], bytearray]

_WORDS = (
    b"\x00", b"\xff" * 8, b"\x1b[2J", b"\xed\xa0\x80", b"\xef\xbb\xbf", b"1e999", b"-1e999", b"NaN", b"Infinity",
    b"null", b"true", b'"\\ud800"', b"9" * 5000, b"[" * 3000, b"{" * 300, b'{"a":' * 1500, b"a." * 3000, b"0x", b"-",
    b"''", b'"', b"1_000", b"\r", b"\n", b"\n\n", b",", b",,,,", b";", b"\t", b"=", b"]", b"}", b"[[", b"]]", b"1,000",
    b"0", b"-0.0", b"1e-320", b"schema", b"2026-13-40", b"\xf0\x9f\x92\xa9", b"\\u0000", b"\\", b"#", b"P5", b"P2",
    b"PK\x01\x02",
)  # fmt: skip
_NUMBERS = (0, 1, -1, 2**7, 2**8 - 1, 2**15, 2**16 - 1, 2**31 - 1, 2**31, 2**32 - 1, 2**40, 2**62, 2**63 - 1, 2**64 - 1)


def mutate(rng: random.Random, seeds: Sequence[bytes], kind: str) -> bytes:
    """One damaged file.

    Parameters
    ----------
    seeds
        Valid files of the format; one is damaged, others lend pieces.
    kind
        The format's name: formats with checksums are damaged inside as well, and their checksums made right.
    """
    seed = rng.choice(seeds)
    inside = {"mcap": _inside_mcap, "npz": _inside_zip, "checkpoint": _inside_zip, "png": _inside_png}
    repack = next((found for name, found in inside.items() if kind.startswith(name)), None)
    if repack is not None and rng.random() < 0.6:
        return repack(rng, seed, seeds)
    return bytes(_damaged(rng, bytearray(seed), seeds))


def _damaged(rng: random.Random, data: bytearray, seeds: Sequence[bytes]) -> bytearray:
    for _ in range(rng.choice((1, 1, 1, 2, 3, 8))):
        data = rng.choice(_MUTATIONS)(rng, data, seeds)
    return data


def _flip(rng: random.Random, data: bytearray, seeds: Sequence[bytes]) -> bytearray:
    del seeds
    if data:
        data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    return data


def _byte(rng: random.Random, data: bytearray, seeds: Sequence[bytes]) -> bytearray:
    del seeds
    if data:
        data[rng.randrange(len(data))] = rng.randrange(256)
    return data


def _cut(rng: random.Random, data: bytearray, seeds: Sequence[bytes]) -> bytearray:
    del seeds
    return data[: rng.randrange(len(data) + 1)]


def _leave_out(rng: random.Random, data: bytearray, seeds: Sequence[bytes]) -> bytearray:
    del seeds
    start = rng.randrange(len(data) + 1)
    return data[:start] + data[start + rng.choice((1, 2, 8, 100, 1000)) :]


def _double(rng: random.Random, data: bytearray, seeds: Sequence[bytes]) -> bytearray:
    del seeds
    start = rng.randrange(len(data) + 1)
    piece = data[start : start + rng.choice((1, 4, 30, 300))]
    return data[:start] + piece * rng.choice((2, 3, 50)) + data[start:]


def _splice(rng: random.Random, data: bytearray, seeds: Sequence[bytes]) -> bytearray:
    other = rng.choice(seeds)
    start, end = sorted(rng.randrange(len(other) + 1) for _ in range(2))
    at = rng.randrange(len(data) + 1)
    return data[:at] + other[start : min(end, start + 4000)] + data[at + rng.choice((0, end - start)) :]


def _word(rng: random.Random, data: bytearray, seeds: Sequence[bytes]) -> bytearray:
    del seeds
    at, word = rng.randrange(len(data) + 1), rng.choice(_WORDS)
    return data[:at] + word + data[at + rng.choice((0, 1, len(word))) :]


def _length(rng: random.Random, data: bytearray, seeds: Sequence[bytes]) -> bytearray:
    """Write a number where a length may be, in either order of bytes, or one near the number there."""
    del seeds
    size = rng.choice((1, 2, 4, 8))
    if len(data) < size:
        return data
    at = rng.randrange(len(data) - size + 1)
    order = rng.choice(("little", "big"))
    here = int.from_bytes(data[at : at + size], order)
    number = rng.choice((*_NUMBERS, here + 1, here - 1, 2 * here, here << 16))
    data[at : at + size] = (number % 2 ** (8 * size)).to_bytes(size, order)
    return data


_MUTATIONS: Sequence[Mutation] = (
    _flip,
    _byte,
    _cut,
    _leave_out,
    _double,
    _splice,
    _word,
    _word,
    _length,
    _length,
    _length,
)
_RECORD = struct.Struct("<BQ")


def _inside_mcap(rng: random.Random, seed: bytes, seeds: Sequence[bytes]) -> bytes:
    """Damage the records of one chunk, or one record outside them; lengths and checksums fit again."""
    import zstandard

    records, at = [], 8
    while at + _RECORD.size <= len(seed) - 8:
        opcode, length = _RECORD.unpack_from(seed, at)
        records.append((opcode, seed[at + _RECORD.size : at + _RECORD.size + length]))
        at += _RECORD.size + length
    chosen = rng.randrange(len(records))
    opcode, body = records[chosen]
    if opcode == 6:
        start_end, (_, _, words) = body[:16], struct.unpack_from("<QII", body, 16)
        packed = body[32 + words + 8 :]
        data = bytes(_damaged(rng, bytearray(zstandard.decompress(packed)), seeds))
        packing = rng.choice((b"zstd", b"zstd", b"", b"lz4", b"rot13"))
        packed = zstandard.compress(data) if packing == b"zstd" else data
        head = struct.pack("<QII", len(data), zlib.crc32(data), len(packing)) + packing
        body = start_end + head + struct.pack("<Q", len(packed)) + packed
    else:
        body = bytes(_damaged(rng, bytearray(body), seeds))
    records[chosen] = (opcode, body)
    out = bytearray(seed[:8])
    for opcode, body in records:
        if opcode == 15:
            body = struct.pack("<I", zlib.crc32(out))
        out += _RECORD.pack(opcode, len(body)) + body
    return bytes(out + seed[-8:])


def _inside_zip(rng: random.Random, seed: bytes, seeds: Sequence[bytes]) -> bytes:
    """Damage one member, mostly its header; the archive around it is whole."""
    out = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(seed)) as old, zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as new:
        chosen = rng.choice(old.namelist())
        for name in old.namelist():
            data = old.read(name)
            if name == chosen:
                cut = 128 if rng.random() < 0.7 else len(data)
                data = bytes(_damaged(rng, bytearray(data[:cut]), seeds)) + data[cut:]
            new.writestr(name, data)
    return out.getvalue()


def _inside_png(rng: random.Random, seed: bytes, seeds: Sequence[bytes]) -> bytes:
    """Damage one chunk; lengths and checksums fit again."""
    chunks, at = [], 8
    while at + 12 <= len(seed):
        length = int.from_bytes(seed[at : at + 4], "big")
        chunks.append((seed[at + 4 : at + 8], seed[at + 8 : at + 8 + length]))
        at += 12 + length
    chosen = rng.randrange(len(chunks))
    out = bytearray(seed[:8])
    for number, (name, data) in enumerate(chunks):
        body = bytes(_damaged(rng, bytearray(data), seeds)) if number == chosen else data
        out += len(body).to_bytes(4, "big") + name + body + zlib.crc32(name + body).to_bytes(4, "big")
    return bytes(out)
