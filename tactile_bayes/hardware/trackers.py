"""Trackers: NDI, OpenIGTLink."""

from __future__ import annotations

import importlib
import os
import select
import socket
import struct
import subprocess
import sys
import time
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from tactile_bayes.errors import DeviceError
from tactile_bayes.geometry import quaternion_from_rotation
from tactile_bayes.hardware import head
from tactile_bayes.hardware.head import PacketParser
from tactile_bayes.hardware.ports import Port
from tactile_bayes.hardware.readings import HelloReading, PoseReading, Reading, plausible

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


# --- NDI Polaris, Vega and Aurora trackers, through the combined API library `ndicapi` (extra ``[ndi]``).
#
# These trackers answer questions and send nothing by themselves. A process of its own asks the tracker for every
# new frame and speaks the open framing to this program, so that to everybody else it is a tracker like any other.
# The library holds the interpreter while it waits for the line, which is one more reason for a process.

# The module that the package ``ndicapi`` installs.
MODULE: Final = "ndicapy"
NETWORK_PORT: Final = 8765
# From the start of the process: a reset, the change of the line rate and a tool's description take seconds.
READY_S: Final = 30.0
_ASK_EVERY_S: Final = 0.002
_LOOK_S: Final = 0.01
# A reply may be spoilt on the line; so many in a row are a tracker that has gone.
_PATIENCE: Final = 5
_WIRELESS: Final = "PHRQ:*********1****"
_TRANSFORMS: Final = 0x0001  # without 0x0800: a tool outside the volume that was characterised is missing


class NdiTracker:
    """A connected NDI tracker that follows one tool, through the module ``ndicapy`` or one that does the same.

    `url` is a serial device or ``socket://HOST:PORT``. `rom` describes a wireless tool; tools on a wire bring their
    own.
    """

    def __init__(self, api: Any, url: str, *, rom: Path | None = None) -> None:
        self._api, self._url = api, url
        self._device = self._open()
        self._begin()
        self.name = self._command("VER:4").splitlines()[0].strip()[:48] or "NDI tracker"
        self.handle = self._tool(rom)
        self._command("TSTART:")
        self._frame: int | None = None
        self._failures = 0

    def _open(self) -> Any:
        if self._url.startswith("socket://"):
            host, _, port = self._url.removeprefix("socket://").rpartition(":")
            device = self._api.ndiOpenNetwork(host or port, int(port) if host else NETWORK_PORT)
        else:
            device = self._api.ndiOpen(self._url)
        if device is None:
            raise DeviceError("cannot be opened; check its cable, or whether another program has it")
        return device

    def _begin(self) -> None:
        """Send INIT, after a reset where the tracker still has an earlier session's line rate."""
        wired = not self._url.startswith("socket://")
        try:
            self._command("INIT:")
        except DeviceError:
            if not wired:
                raise
            self._api.ndiRESET(self._device)
            self._command("INIT:")
        if wired:
            self._command("COMM:%d%03d%d", self._api.NDI_115200, self._api.NDI_8N1, self._api.NDI_NOHANDSHAKE)

    def _command(self, text: str, *values: object) -> str:
        reply = self._api.ndiCommand(self._device, text, *values)
        number = self._api.ndiGetError(self._device)
        if number != self._api.NDI_OKAY:
            words = self._api.ndiErrorString(number)
            raise DeviceError(f"{text.partition(':')[0]} failed ({words}); check its power, cable and tool")
        return reply if isinstance(reply, str) else ""

    def _handles(self, kind: int) -> list[int]:
        """Port handles of a kind: 1 to be freed, 2 to be initialised, 3 to be enabled, 4 enabled."""
        self._command(f"PHSR:{kind:02X}")
        number = self._api.ndiGetPHSRNumberOfHandles(self._device)
        return [self._api.ndiGetPHSRHandle(self._device, one) for one in range(number)]

    def _tool(self, rom: Path | None) -> int:
        """Initialise and enable the tools; return the handle of the one to follow."""
        for handle in self._handles(1):
            self._command("PHF:%02X", handle)
        if rom is not None:
            self._command(_WIRELESS)
            handle = self._api.ndiGetPHRQHandle(self._device)
            if self._api.ndiPVWRFromFile(self._device, handle, str(rom)) != 0:
                raise DeviceError(
                    f"the tool's description {rom} was refused by the tracker; check that it is the tool's .rom file"
                )
        for handle in self._handles(2):
            self._command("PINIT:%02X", handle)
        for handle in self._handles(3):
            self._command("PENA:%02X%s", handle, "D")
        enabled = self._handles(4)
        if not enabled:
            raise DeviceError("it has no tool; plug one in, or give --tracker-rom TOOL.rom for a wireless one")
        return enabled[0]

    def pose(self) -> PoseReading | None:
        """Next pose; None while there is no new one, or the tool is out of sight. Several silences in a row are a
        DeviceError.
        """
        try:
            self._command(f"BX:{_TRANSFORMS:04X}")
        except DeviceError:
            self._failures += 1
            if self._failures >= _PATIENCE:
                raise
            return None
        self._failures = 0
        port = bytes([self.handle])
        frame = self._api.ndiGetBXFrame(self._device, port)
        found = self._api.ndiGetBXTransform(self._device, port)
        if frame == self._frame or isinstance(found, str):
            return None
        self._frame = frame
        w, i, j, k, x, y, z = (float(value) for value in found[:7])
        return PoseReading((x, y, z), (w, i, j, k)) if plausible((x, y, z), (w, i, j, k)) else None


def serve(tracker: NdiTracker, line: socket.socket) -> None:
    """Serve the tracker in the open framing until the other end closes."""
    commands, sending, number = PacketParser(), False, 0
    line.setblocking(False)
    while True:
        if select.select([line], [], [], _ASK_EVERY_S)[0]:
            data = line.recv(4096)
            if not data:
                return
            for packet in commands.feed(data):
                if packet.kind == head.ASK:
                    line.sendall(head.encode_hello(HelloReading(tracker.name, 0, 0, 0, 0.0)))
                elif packet.kind in (head.START, head.STOP):
                    sending = packet.kind == head.START
        pose = tracker.pose()
        if pose is not None and sending:
            line.sendall(head.encode_pose(pose._replace(device_ns=time.monotonic_ns()), sequence=number))
            number += 1


class NdiPort(Port):
    """An NDI tracker in a process of its own, as a port in the open framing."""

    def __init__(self, url: str, *, rom: Path | None = None) -> None:
        self.url, self.baud, self.role = url, 0, "tracker"
        self._relayed = None
        if find_spec(MODULE) is None:
            raise DeviceError(f"{self.name}: needs the package ndicapi; pip install 'tactile-bayes[ndi]'")
        ours, theirs = socket.socketpair()
        words = [
            sys.executable,
            "-m",
            "tactile_bayes.hardware.trackers",
            str(theirs.fileno()),
            url,
            *([str(rom)] if rom else []),
        ]
        self._process = subprocess.Popen(
            words, pass_fds=[theirs.fileno()], stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, start_new_session=True
        )
        theirs.close()
        self._serial = _SocketLine(ours)
        try:
            self._wait_until_ready()
        except DeviceError:
            self.close()
            raise

    def _wait_until_ready(self) -> None:
        pipe = self._process.stdout
        assert pipe is not None
        told = pipe.readline().decode().strip() if select.select([pipe], [], [], READY_S)[0] else ""
        if told != "ready":
            raise DeviceError(f"{self.name}: {told or 'the tracker said nothing; check its power and cable'}")

    def close(self) -> None:
        """Close the line, on which the process ends."""
        super().close()
        if self._process.stdout is not None:
            self._process.stdout.close()
        self._process.terminate()
        self._process.wait()


class _SocketLine:
    """The part of a serial port that `Port` uses, over a socket."""

    def __init__(self, line: socket.socket) -> None:
        self._line = line

    def fileno(self) -> int:
        return self._line.fileno()

    @property
    def in_waiting(self) -> int:
        return 4096 if select.select([self._line], [], [], 0)[0] else 0

    def read(self, size: int) -> bytes:
        if size <= 0 or not select.select([self._line], [], [], _LOOK_S)[0]:
            return b""
        return self._line.recv(size)

    def write(self, data: bytes) -> None:
        self._line.sendall(data)

    def flush(self) -> None:
        """Do nothing: a socket has no buffer to flush here."""

    def close(self) -> None:
        self._line.close()


def _say(words: str) -> None:
    """Print one line to the parent process."""
    os.write(sys.stdout.fileno(), f"{words}\n".encode())


def main(words: list[str]) -> int:
    """Run ``python -m tactile_bayes.hardware.trackers FD URL [ROM]``: prints ``ready``, or what is wrong."""
    line = socket.socket(fileno=int(words[0]))
    try:
        tracker = NdiTracker(importlib.import_module(MODULE), words[1], rom=Path(words[2]) if len(words) > 2 else None)
    except DeviceError as error:
        _say(str(error))
        return error.exit_code
    _say("ready")
    os.close(sys.stdout.fileno())
    try:
        serve(tracker, line)
    except (DeviceError, OSError):
        return 1  # the line closes, and the recording says that the tracker has gone
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
