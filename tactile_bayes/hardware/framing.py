"""The open framing of scan heads: COBS between zero bytes, version, type, sequence, device time, checksum.

A packet is ``version u8, type u8, sequence u32, device time u64 in microseconds, payload, CRC-32 u32``, little-endian.
On the wire it is COBS-encoded, with a zero byte before and after it, so that a damaged delimiter costs nothing more
than the packet it belongs to. The byte layout for firmware authors is in docs/scan-head-protocol.md.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from typing import Final, NamedTuple

from tactile_bayes.errors import BadDataError

VERSION: Final = 1
HEADER: Final = struct.Struct("<BBIQ")
CRC_BYTES: Final = 4
# Between two zero bytes; the longest packet a head may send. More without a zero is line noise, and is let go.
MAX_PACKET_BYTES: Final = 16 * 1024
_LONGEST: Final = MAX_PACKET_BYTES + MAX_PACKET_BYTES // 254 + 1


class Packet(NamedTuple):
    """One valid packet.

    Parameters
    ----------
    kind
        Packet type.
    sequence
        Counts the packets of this kind, modulo 2^32.
    device_us
        The device's clock in microseconds, modulo 2^64.
    payload
        What is left.
    """

    kind: int
    sequence: int
    device_us: int
    payload: bytes


def cobs_encode(data: bytes) -> bytes:
    """Consistent overhead byte stuffing (Cheshire & Baker 1999): the same data without a zero byte.

    Every zero becomes the distance to the next one; runs of 254 bytes without a zero get a code of their own.
    """
    out = bytearray()
    rest = b"\0"
    for block in data.split(b"\0"):
        rest = block
        while len(rest) >= 254:
            out.append(255)
            out += rest[:254]
            rest = rest[254:]
        out.append(len(rest) + 1)
        out += rest
    if len(out) > 1 and not rest and data[-1:] != b"\0":
        del out[-1]  # a full run at the end says by itself where it ends
    return bytes(out)


def cobs_decode(data: bytes) -> bytes | None:
    """Undo `cobs_encode`; None for an invalid code.

    A code byte stands where a zero was, so most of the work is to put the zeros back in place.
    """
    out = bytearray(data)
    place, end = 0, len(data)
    full = []  # codes of 255: no zero was there, the byte goes
    while place < end:
        code = data[place]
        if code == 0:
            return None
        out[place] = 0
        place += code
        if code == 255:
            full.append(place)
    if place != end or not end:
        return None
    for place in reversed(full):
        if place < end:
            del out[place]
    return bytes(out[1:])


def encode_packet(kind: int, payload: bytes, *, sequence: int, device_us: int) -> bytes:
    """Encode one packet for the wire, with a zero byte before and after it.

    Parameters
    ----------
    sequence, device_us
        Taken modulo 2^32 and 2^64, as counters in firmware wrap.

    Raises
    ------
    BadDataError
        When the payload is longer than a packet may be.
    """
    body = HEADER.pack(VERSION, kind, sequence % 2**32, device_us % 2**64) + payload
    if len(body) + CRC_BYTES > MAX_PACKET_BYTES:
        raise BadDataError(f"a payload of {len(payload)} bytes", way_out=f"a packet holds {MAX_PACKET_BYTES}")
    return b"\0" + cobs_encode(body + zlib.crc32(body).to_bytes(CRC_BYTES, "little")) + b"\0"


@dataclass(slots=True)
class FramingCounts:
    """Counts of a stream's packets and bytes.

    Parameters
    ----------
    packets
        Packets whose checksum held.
    damaged
        Stretches between zero bytes that are no packet: a checksum that fails, codes that make no sense, noise.
    damaged_bytes
        Their length.
    foreign
        Packets of another version of the framing.
    """

    packets: int = 0
    damaged: int = 0
    damaged_bytes: int = 0
    foreign: int = 0


class PacketParser:
    """Parser of packets from a stream; skips and counts garbage."""

    def __init__(self) -> None:
        self.counts = FramingCounts()
        self._rest = b""

    def feed(self, data: bytes) -> list[Packet]:
        """Parse `data`; return the packets completed by it."""
        *parts, self._rest = (self._rest + data).split(b"\0")
        if len(self._rest) > _LONGEST:
            self._damage(self._rest)
            self._rest = b""
        packets = []
        for part in parts:
            if not part:
                continue
            packet = self._decode(part)
            if packet is not None:
                packets.append(packet)
        return packets

    def _decode(self, part: bytes) -> Packet | None:
        body = cobs_decode(part) if len(part) <= _LONGEST else None
        if body is None or len(body) < HEADER.size + CRC_BYTES:
            self._damage(part)
            return None
        if zlib.crc32(body) != _RESIDUE:
            self._damage(part)
            return None
        version, kind, sequence, device_us = HEADER.unpack_from(body)
        if version != VERSION:
            self.counts.foreign += 1
            return None
        self.counts.packets += 1
        return Packet(kind, sequence, device_us, body[HEADER.size : -CRC_BYTES])

    def _damage(self, part: bytes) -> None:
        self.counts.damaged += 1
        self.counts.damaged_bytes += len(part)


# CRC-32 of any data followed by its own CRC-32, little-endian, is this number.
_RESIDUE: Final = zlib.crc32(zlib.crc32(b"").to_bytes(CRC_BYTES, "little"))
