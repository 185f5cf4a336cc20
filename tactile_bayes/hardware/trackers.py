"""Trackers with protocols of their own: OpenIGTLink and NDI."""

from __future__ import annotations

import importlib
import os
import re
import select
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final

import numpy as np

from tactile_bayes.errors import DeviceError
from tactile_bayes.geometry import quaternion_from_rotation, rotation_from_quaternion
from tactile_bayes.hardware import head, readings
from tactile_bayes.hardware.ports import Port
from tactile_bayes.shell import own_process

# --- CRC-64 as OpenIGTLink uses it: polynomial of ECMA-182, initial value 0, nothing inverted or reflected.

POLYNOMIAL: Final = 0x42F0E1EBA9EA3693
_BITS: Final = 0xFFFF_FFFF_FFFF_FFFF


def _byte_crc(byte: int) -> int:
    crc = byte << 56
    for _ in range(8):
        crc = (crc << 1 ^ (POLYNOMIAL if crc >> 63 else 0)) & _BITS
    return crc


_TABLE: Final = tuple(map(_byte_crc, range(256)))


def crc64(data: bytes) -> int:
    """CRC-64/ECMA-182; of ``123456789`` it is 0x6C40DF5F0B497347."""
    crc = 0
    for byte in data:
        crc = (crc << 8 ^ _TABLE[crc >> 56 ^ byte]) & _BITS
    return crc


# --- Parser for the poses that OpenIGTLink servers (PLUS, 3D Slicer) send over TCP.
#
# A message is a header of 58 bytes and a body, big-endian, with a CRC-64 of the body. From header version 2 on
# (protocol version 3) the body is an extended header, the content, and metadata: pairs of key and value, of which
# TransformValid and TransformStatus (PLUS, 3D Slicer) say whether the tool is seen. Lengths are in mm.
#
# OpenIGTLink protocol, version 3.0 (2017): header, TRANSFORM, POSITION (QTRANS), TDATA, QTDATA; igtl_qtdata.h for the
# names of the last, which have 20 bytes there and in use, and 32 in the text.

_HEADER: Final = struct.Struct(">H12s20sIIQQ")  # version, type, device, s, fraction, body size, CRC
_EXTENDED: Final = struct.Struct(">HHII")  # its own size, sizes of the metadata's header and body, message number
_PAIR: Final = struct.Struct(">HHI")  # key size, encoding, value size
_MATRIX: Final = struct.Struct(">12f")  # columns of the rotation, position
_QUATERNION: Final = struct.Struct(">7f")  # position, quaternion with its scalar last
NAME_BYTES: Final = 20
_NAMED: Final = NAME_BYTES + 2  # name, kind and a spare byte before the numbers of a tool
# Bytes before the numbers of each tool, and the numbers, by type.
_POSES: Final[dict[bytes, tuple[int, struct.Struct]]] = {
    b"TRANSFORM": (0, _MATRIX),
    b"POSITION": (0, _QUATERNION),
    b"QTRANS": (0, _QUATERNION),
    b"TDATA": (_NAMED, _MATRIX),
    b"QTDATA": (_NAMED, _QUATERNION),
}
_KINDS: Final = tuple(kind + b"\0" for kind in _POSES)
_POSE_HEADER: Final = re.compile(rb"\0[\x01-\x03](?:%b)\0" % b"|".join(_POSES))
_ANY_HEADER: Final = re.compile(rb"\0[\x01-\x03][A-Z][A-Z0-9_]{1,11}\0")
_TURNED_HEADER: Final = re.compile(rb"[\x01-\x03]\0(?:%b)\0" % b"|".join(_POSES))
_LONGEST: Final = 1 << 14  # body of a message with poses
_MOST_LOOKS: Final = 8
# Budget of bytes whose checksums are computed: a constant, and a multiple of the bytes that come (sound messages: one).
_FEWEST_CHECKED: Final = 1 << 15
_CHECKED_SHARE: Final = 4
_MOST_KINDS: Final = 5
_RIGID_SLACK: Final = 0.02
# TransformStatus of a tool in sight; 3D Slicer's UNKNOWN is of a transform of which nobody stated one.
_IN_SIGHT: Final = ("OK", "UNKNOWN")
_COLUMNS: Final = 12  # numbers of a matrix with its position
_NO_WISHES: Final = bytes(36)  # least time between two in ms, and the name of a frame
ASK_FOR_TDATA: Final = _HEADER.pack(1, b"STT_TDATA", b"", 0, 0, len(_NO_WISHES), crc64(_NO_WISHES)) + _NO_WISHES
"""After it a server sends TDATA: as fast as it can, in its own frame."""


class IgtlinkParser(readings.Parser):
    """Parser of messages with poses; it skips others, whatever their size.

    The header has no checksum, so a spoilt size may cover messages that follow. Where a message is skipped or not yet
    complete, a complete message with poses inside it shows that its size was wrong. A checksum of 0 counts as none.
    Servers send an exact identity for a tool out of sight.
    """

    def __init__(self) -> None:
        self._checks = 0
        self._over = 0  # bytes still to come of a message without poses
        self._others: set[str] = set()

    def feed(self, data: bytes) -> list[readings.Reading]:
        buffer, index = self._rest + data, 0
        all_readings: list[readings.Reading] = []
        self._checks = _FEWEST_CHECKED + _CHECKED_SHARE * len(data)
        while len(buffer) - index >= _HEADER.size:
            if self._checks < 0:  # headers after headers: an attack on this program's time
                self.garbage_bytes, self._over, index = self.garbage_bytes + len(buffer) - index, 0, len(buffer)
                break
            found: list[readings.Reading] = []
            size = self._message(buffer, index, found) if _POSE_HEADER.match(buffer, index) else -1
            if size < 0:
                size = self._pass_over(buffer, index)
            elif size:
                self._over = 0
            else:  # the message is not complete
                size = self._next_message(buffer, index) - index
                self.garbage_bytes += size
                if not size:
                    break
            index += size
            all_readings += found
        self._rest = buffer[index:]
        return all_readings

    def _message(self, buffer: bytes, index: int, found: list[readings.Reading]) -> int:
        """Size of a message with poses, which are added to `found`; 0 while incomplete, -1 for no message."""
        size: int
        version, kind, device, seconds, fraction, size, crc = _HEADER.unpack_from(buffer, index)
        kind, tool, end = kind.rstrip(b"\0"), _name(device), index + _HEADER.size + size
        if kind not in _POSES:
            return -1  # something stands in the padding
        if size > _LONGEST or (version == 1 and not _fits(kind, size)):
            self.fault = f"{kind.decode()} of {tool!r} has a body of {size} bytes"
            return -1
        if end > len(buffer):
            return 0
        body = buffer[index + _HEADER.size : end]
        self._checks -= size
        if crc and (computed := crc64(body)) != crc:
            self.fault = f"{kind.decode()} of {tool!r} has the checksum {crc:016x}, its body gives {computed:016x}"
            return -1
        content, facts = _parts(body, version, kind)
        if content is None:
            self.fault = f"{kind.decode()} of {tool!r}, header version {version}, has a body of {size} bytes"
            return -1
        if not crc:
            self.remark = "records carry no checksum (CRC 0), so damaged ones pass for poses"
        device_ns = seconds * 1_000_000_000 + (fraction * 1_000_000_000 >> 32) or None
        prefix, numbers = _POSES[kind]
        for start in range(0, len(content), prefix + numbers.size):
            name = _name(content[start : start + NAME_BYTES]) if prefix else tool
            values = numbers.unpack_from(content, start + prefix)
            found.append(self._reading(values, tool=name, unseen=_unseen(facts), device_ns=device_ns))
        return end - index

    def _reading(self, values: tuple[float, ...], *, tool: str, unseen: str, device_ns: int | None) -> readings.Reading:
        x, y, z = values[-3:] if len(values) == _COLUMNS else values[:3]
        quaternion = _quaternion_of_matrix(values[:-3]) if len(values) == _COLUMNS else (values[6], *values[3:6])
        if unseen:
            return readings.MissingReading(unseen, tool)
        if quaternion is None or not readings.plausible((x, y, z), quaternion):
            self.fault = f"what {tool!r} sends is no rotation and place in mm: {' '.join(f'{v:g}' for v in values)}"
            return readings.MissingReading(readings.NO_ROTATION, tool)
        if (x, y, z, *map(abs, quaternion)) == (0, 0, 0, 1, 0, 0, 0):
            return readings.MissingReading("identity sent", tool)
        w, i, j, k = quaternion
        return readings.PoseReading((x, y, z), (w, i, j, k), device_ns, tool=tool)

    def _next_message(self, buffer: bytes, index: int) -> int:
        """Index of the first complete message with poses after `index`; `index` itself without one."""
        inside = index
        for _ in range(_MOST_LOOKS):
            inside = _find_header(buffer, inside + 1)
            if inside < 0 or inside + _HEADER.size > len(buffer):
                break
            if self._message(buffer, inside, []) > 0:
                return inside
        return index

    def _pass_over(self, buffer: bytes, index: int) -> int:
        """Bytes to skip before a message with poses may begin; counts those that belong to no message."""
        if not self._over and (header := _ANY_HEADER.match(buffer, index)):
            kind, size = header[0][2:-1], _HEADER.unpack_from(buffer, index)[5]
            if kind not in _POSES:
                self._over = _HEADER.size + size
                if kind.decode() not in self._others and len(self._others) < _MOST_KINDS:
                    self._others.add(kind.decode())
                    pose_types = ", ".join(pose.decode() for pose in _POSES)
                    self.fault = f"{', '.join(sorted(self._others))} came, but no {pose_types}"
        if self._over:
            begin = _find_header(buffer, index + 1)
        else:
            header_match = _ANY_HEADER.search(buffer, index + 1)
            begin = header_match.start() if header_match else -1
        skipped = (begin if begin >= 0 else max(index + 1, len(buffer) - _HEADER.size + 1)) - index
        if self._over:
            skipped = min(skipped, self._over)
            self._over -= skipped
        else:
            self.garbage_bytes += skipped
            if _TURNED_HEADER.match(buffer, index):
                self.fault = "its numbers are little-endian; OpenIGTLink is big-endian"
        return skipped


def _find_header(buffer: bytes, start: int) -> int:
    """Index of the first header of a message with poses, -1 without; in images `bytes.find` is the quickest."""
    first = -1
    for kind in _KINDS:
        at = buffer.find(kind, start + 2, None if first < 0 else first + _HEADER.size)
        while at >= 0 and not _POSE_HEADER.match(buffer, at - 2):
            at = buffer.find(kind, at + 1, None if first < 0 else first + _HEADER.size)
        if at >= 0 and (first < 0 or at - 2 < first):
            first = at - 2
    return first


def _name(data: bytes) -> str:
    """Text of a padded name."""
    return readings.printable(data.partition(b"\0")[0])


def _fits(kind: bytes, size: int) -> bool:
    head, numbers = _POSES[kind]
    return size % (head + numbers.size) == 0 if head else size == numbers.size


def _parts(body: bytes, version: int, kind: bytes) -> tuple[bytes | None, dict[str, str]]:
    """Content and metadata of a body; no content where its size does not fit its kind."""
    if version > 1 and len(body) >= _EXTENDED.size:
        size, header_bytes, data_bytes, _ = _EXTENDED.unpack_from(body)
        end = len(body) - header_bytes - data_bytes
        if size >= _EXTENDED.size and end >= size and _fits(kind, end - size):
            return body[size:end], _metadata(body[end : end + header_bytes], body[end + header_bytes :])
    return (body if _fits(kind, len(body)) else None), {}


def _metadata(header: bytes, data: bytes) -> dict[str, str]:
    """Pairs of key and value; pairs that are cut off are left out."""
    pairs, index = {}, 0
    for key_bytes, _, value_bytes in _PAIR.iter_unpack(header[2 : 2 + (len(header) - 2) // _PAIR.size * _PAIR.size]):
        value_at = index + key_bytes
        pairs[data[index:value_at].decode("latin-1")] = data[value_at : value_at + value_bytes].decode("latin-1")
        index = value_at + value_bytes
    return pairs


def _unseen(facts: Mapping[str, str]) -> str:
    """Why a tool has no pose, by a message's metadata; empty where it has a pose."""
    status = facts.get("TransformStatus", "OK").strip("\0 ").upper().removeprefix("TOOL_")
    if re.fullmatch("SWITCH[0-9]_IS_ON", status):
        return ""  # of the tool's own button; PLUS then says that the transform is not valid
    if status not in _IN_SIGHT:
        return status.lower().replace("_", " ") if status.replace("_", "").isalpha() else "unknown status"
    return "invalid" if facts.get("TransformValid", "").strip("\0 ").lower() in ("false", "0", "no") else ""


def _quaternion_of_matrix(columns: tuple[float, ...]) -> tuple[float, ...] | None:
    """Quaternion, scalar first, of a rotation matrix given by columns; None for another matrix."""
    rotation = np.array(columns, dtype=np.float64).reshape(3, 3).T
    if not np.isfinite(rotation).all() or np.abs(rotation @ rotation.T - np.eye(3)).max() > _RIGID_SLACK:
        return None
    return tuple(map(float, quaternion_from_rotation(rotation))) if np.linalg.det(rotation) > 0 else None


def encode_transform(pose: readings.ToolReading) -> bytes:
    """Encode a pose as a TRANSFORM message of header version 1; a missing pose is an identity."""
    if isinstance(pose, readings.PoseReading):
        rotation = rotation_from_quaternion(np.array(pose.quaternion_wxyz))
        body, device_ns = _MATRIX.pack(*rotation.T.ravel(), *pose.position_mm), pose.device_ns or 0
    else:
        body, device_ns = _MATRIX.pack(*np.eye(3).ravel(), 0, 0, 0), 0
    seconds, rest_ns = divmod(device_ns, 1_000_000_000)
    fraction = -(-(rest_ns << 32) // 1_000_000_000)  # rounded up, so that whole nanoseconds come back
    name = (pose.tool or "Tracker").encode()
    return _HEADER.pack(1, b"TRANSFORM", name, seconds, fraction, len(body), crc64(body)) + body


# --- NDI Polaris, Vega and Aurora trackers, through the combined API library `ndicapi` (extra ``[ndi]``).
#
# These trackers answer questions and send nothing by themselves. A separate process asks the tracker for every new
# frame and speaks the open framing to this program, which then treats it as any other tracker. The library holds the
# interpreter while it waits for the line, which is one more reason for a process.

MODULE: Final = "ndicapy"  #: The module that the package ``ndicapi`` installs.
NETWORK_PORT: Final = 8765
# From the start of the process: a reset, the change of the line rate and a tool's description take seconds.
READY_S: Final = 30.0
_ASK_EVERY_S: Final = 0.002
_LOOK_S: Final = 0.01
_PATIENCE: Final = 5  #: A reply may be spoilt on the line; this many in a row mean that the tracker has gone.
_WIRELESS: Final = "PHRQ:*********1****"
_TRANSFORMS: Final = 0x0001  # without 0x0800: a tool outside the volume that was characterised is missing
_PART_NUMBER: Final = 0x0004
_OUT_OF_VOLUME: Final = 0x40  #: Of a port's status.
_PARTLY_OUT: Final = 0x80


class NdiTracker:
    """A connected NDI tracker with its tools, through the module ``ndicapy`` or a stand-in with the same functions.

    `url` is a serial device or ``socket://HOST:PORT``. `roms` describe wireless tools, which are named by these files;
    tools on a wire bring their own and are named by port handle and part number, such as ``0A-8700339``.
    """

    def __init__(self, api: Any, url: str, *, roms: Sequence[Path] = ()) -> None:
        self._api, wired = api, not url.startswith("socket://")
        self._line = "cable" if wired else "address"
        if wired:
            self._device = api.ndiOpen(url)
        else:
            host, _, port = url.removeprefix("socket://").rpartition(":")
            self._device = api.ndiOpenNetwork(host or port, int(port) if host else NETWORK_PORT)
        if self._device is None:
            raise DeviceError(f"cannot be opened; check its {self._line}, or whether another program has it")
        try:
            self._command("INIT:")
        except DeviceError:
            if not wired:
                raise
            with suppress(OSError):  # of a device that is no NDI tracker: the next line says so
                api.ndiRESET(self._device)  # it still has an earlier session's line rate
            self._command("INIT:")
        if wired:
            self._command("COMM:%d%03d%d", api.NDI_115200, api.NDI_8N1, api.NDI_NOHANDSHAKE)
        self.name = self._command("VER:4").splitlines()[0].strip()[:48] or "NDI tracker"
        for handle in self._handles(1):  # of an earlier session
            self._command("PHF:%02X", handle)
        described = {}
        for rom in roms:
            self._command(_WIRELESS)
            handle = api.ndiGetPHRQHandle(self._device)
            if api.ndiPVWRFromFile(self._device, handle, str(rom)) != 0:
                fault = f"the tool's description {rom} was refused by the tracker"
                raise DeviceError(f"{fault}; check that it is the tool's .rom file")
            described[handle] = rom.stem
        for handle in self._handles(2):
            self._command("PINIT:%02X", handle)
        for handle in self._handles(3):
            self._command("PENA:%02X%s", handle, "D")
        self.tools = {handle: described.get(handle) or self._tool_name(handle) for handle in self._handles(4)}
        if not self.tools:
            raise DeviceError("it has no tool; plug one in, or give --tracker-rom TOOL.rom for a wireless one")
        self._command("TSTART:")
        self._frame: int | None = None
        self._failures = 0

    def _command(self, text: str, *values: object) -> str:
        name = text.partition(":")[0]
        try:
            reply = self._api.ndiCommand(self._device, text, *values)
        except OSError as error:  # the library's way to say so for some of its own errors
            raise DeviceError(f"{name} failed ({error}); check its power, {self._line} and tool") from None
        number = self._api.ndiGetError(self._device)
        if number != self._api.NDI_OKAY:
            words = self._api.ndiErrorString(number)
            raise DeviceError(f"{name} failed ({words}); check its power, {self._line} and tool")
        return reply if isinstance(reply, str) else ""

    def _handles(self, kind: int) -> list[int]:
        """Handles of ports in a state: 1 to be freed, 2 to be initialised, 3 to be enabled, 4 enabled."""
        self._command(f"PHSR:{kind:02X}")
        number = self._api.ndiGetPHSRNumberOfHandles(self._device)
        return [self._api.ndiGetPHSRHandle(self._device, one) for one in range(number)]

    def _tool_name(self, handle: int) -> str:
        part = ""
        with suppress(DeviceError):  # a tracker of before this command
            part = re.sub(r"[^A-Za-z0-9.]", "", self._command(f"PHINF:{handle:02X}{_PART_NUMBER:04X}"))
        return f"{handle:02X}-{part}" if part else f"{handle:02X}"

    def measure(self) -> list[readings.ToolReading]:
        """Next reading of each tool; none without a new frame. Several failures in a row are a `DeviceError`."""
        try:
            self._command(f"BX:{_TRANSFORMS:04X}")
        except DeviceError:
            self._failures += 1
            if self._failures >= _PATIENCE:
                raise
            return []
        self._failures = 0
        frame = max(self._api.ndiGetBXFrame(self._device, bytes([handle])) for handle in self.tools)
        if frame == self._frame:
            return []
        self._frame = frame
        return [self._reading(handle) for handle in self.tools]

    def _reading(self, handle: int) -> readings.ToolReading:
        port, tool = bytes([handle]), self.tools[handle]
        transform = self._api.ndiGetBXTransform(self._device, port)
        status = self._api.ndiGetBXPortStatus(self._device, port)
        if isinstance(transform, str):
            out = transform == "MISSING" and status & _OUT_OF_VOLUME
            return readings.MissingReading("out of volume" if out else transform.lower(), tool)
        w, i, j, k, x, y, z = (float(value) for value in transform[:7])
        if not readings.plausible((x, y, z), (w, i, j, k)):
            return readings.MissingReading(readings.NO_ROTATION, tool)
        flags = ("partly out of volume",) if status & _PARTLY_OUT else ()
        return readings.PoseReading((x, y, z), (w, i, j, k), None, flags, tool)


def serve(tracker: NdiTracker, line: socket.socket) -> None:
    """Serve the tracker in the open framing until the other end closes."""
    commands, sending, number = head.PacketParser(), False, 0
    not_yet = [readings.MissingReading("not measured yet", tool) for tool in tracker.tools.values()]
    latest: dict[str, readings.ToolReading] = {one.tool: one for one in not_yet}
    line.setblocking(False)
    while True:
        wire = b""
        if select.select([line], [], [], _ASK_EVERY_S)[0]:
            data = line.recv(4096)
            if not data:
                return
            for packet in commands.packets(data):
                if packet.kind == head.ASK:
                    wire = head.encode_hello(readings.HelloReading(tracker.name, 0, 0, 0, 0.0))
                    wire += b"".join(head.encode_pose(one, sequence=0) for one in latest.values())
                elif packet.kind in (head.START, head.STOP):
                    sending = packet.kind == head.START
        measured, now_ns = tracker.measure(), time.monotonic_ns()
        latest |= {reading.tool: reading for reading in measured}
        for reading in measured if sending else ():
            timed = reading._replace(device_ns=now_ns) if isinstance(reading, readings.PoseReading) else reading
            wire += head.encode_pose(timed, sequence=number)
            number += 1
        if wire:
            line.sendall(wire)


class NdiPort(Port):
    """An NDI tracker in a process of its own, as a port in the open framing."""

    def __init__(self, url: str, *, roms: Sequence[Path] = ()) -> None:
        self.url, self.baud, self.role, self._is_socket = url, 0, "tracker", True
        self._relayed = None
        if find_spec(MODULE) is None:
            raise DeviceError(f"{self.name}: needs the package ndicapi; pip install 'tactile-bayes[ndi]'")
        ours, theirs = socket.socketpair()
        command = own_process(__name__, str(theirs.fileno()), url, *map(str, roms))
        self._process = subprocess.Popen(
            command,
            pass_fds=[theirs.fileno()],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            start_new_session=True,
        )
        theirs.close()
        self._serial = _SocketLine(fileno=ours.detach())
        pipe = self._process.stdout
        assert pipe is not None
        answer = pipe.readline().decode().strip() if select.select([pipe], [], [], READY_S)[0] else ""
        if answer != "ready":
            self.close()
            raise DeviceError(f"{self.name}: {answer or 'the tracker said nothing; check its power'}")

    def close(self) -> None:
        """Close the line, on which the process ends."""
        super().close()
        if self._process.stdout is not None:
            self._process.stdout.close()
        self._process.terminate()
        self._process.wait()


class _SocketLine(socket.socket):
    """A socket with the methods of a serial port that `Port` uses."""

    write = socket.socket.sendall

    def read(self, size: int) -> bytes:
        return self.recv(size) if size > 0 and select.select([self], [], [], _LOOK_S)[0] else b""

    def flush(self) -> None:
        """Do nothing: a socket has no buffer to flush here."""


def main(arguments: list[str]) -> int:
    """Run ``python -m tactile_bayes.hardware.trackers FD URL [ROM...]``: prints ``ready``, or what is wrong."""
    line = socket.socket(fileno=int(arguments[0]))
    try:
        tracker = NdiTracker(importlib.import_module(MODULE), arguments[1], roms=[*map(Path, arguments[2:])])
    except DeviceError as error:
        os.write(sys.stdout.fileno(), f"{error}\n".encode())
        return error.exit_code
    os.write(sys.stdout.fileno(), b"ready\n")
    os.close(sys.stdout.fileno())
    try:
        serve(tracker, line)
    except (DeviceError, OSError):
        return 1  # the line closes, and the recording says that the tracker has gone
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
