"""Devices that send a scan as real ones would."""

from __future__ import annotations

import math
import re
import struct
import time
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from typing import Final

import numpy as np

from tactile_bayes.geometry import FloatArray
from tactile_bayes.hardware import head
from tactile_bayes.hardware.head import Packet, PacketParser
from tactile_bayes.hardware.readings import (
    HelloReading,
    MissingReading,
    PoseReading,
    ToolReading,
    pose_from_relative,
)
from tactile_bayes.hardware.serial_trackers import encoded
from tactile_bayes.options import FaultOptions
from tactile_bayes.scans import Scan, TrackerPoses

# --- Emulated devices: a scan's frames and poses as a head or a tracker sends them, with faults on request.
#
# They are devices like any other: nothing in the recorder knows of them.

_NS: Final = 1_000_000_000
# A command with arguments ends in CR; what is left are commands of one letter.
_SETTING: Final = re.compile(rb"[A-Za-z][0-9*,][^\r]*\r")
_BREATH_S: Final = 4.0
# Where the second tool is, turned against the tracker so that its frame is another one.
_REFERENCE_MM: Final = (250.0, -40.0, 30.0)
_REFERENCE_TURN: Final = (0.8, 0.0, 0.6, 0.0)


class Faults(FaultOptions):
    """Faults of an emulated device, and what they do to its records."""

    def disturb(self, record: bytes, rng: np.random.Generator) -> bytes:
        """Apply the faults to a record: unchanged, one bit changed, or dropped."""
        if self.drop and rng.random() < self.drop:
            return b""
        if not self.corrupt or rng.random() >= self.corrupt:
            return record
        bit = int(rng.integers(8 * len(record)))
        changed = bytearray(record)
        changed[bit // 8] ^= 1 << bit % 8
        return bytes(changed)


def within(span: tuple[float, float] | None, time_s: float) -> bool:
    """True at the times of a fault, given by its begin and its length."""
    return span is not None and span[0] <= time_s < span[0] + span[1]


class Device:
    """An emulated device: it answers commands and sends records at their times; most wait for a command."""

    times_s: FloatArray  #: Times of the records after the start, never falling.
    starts = 0  #: Number of START commands so far; each begins the scan anew.
    streaming = False  #: True when the device sends, or will when the scan begins.
    stopped = False  #: True when the host's last command about sending was STOP.
    said_end = False  #: True when the device has told the host that everything was sent.
    open_framing = False  #: True for a device of the open framing, which has a last message.

    def start(self) -> None:
        """Begin to send."""
        self.starts += 1
        self.streaming, self.stopped, self.said_end = True, False, False

    def stop(self) -> None:
        """Stop sending."""
        self.streaming, self.stopped = False, True

    def greet(self) -> None:
        """React to a new connection."""

    def hear(self, data: bytes) -> bytes:
        """Process commands and return the answer."""
        raise NotImplementedError

    def _obeyed(self, packets: Iterable[Packet]) -> Iterator[Packet]:
        """Commands in the open framing, those to start and stop carried out."""
        for packet in packets:
            if packet.kind == head.START:
                self.start()
            elif packet.kind == head.STOP:
                self.stop()
            yield packet

    def record(self, index: int) -> bytes:
        """Bytes of one record; empty for a record left out."""
        raise NotImplementedError

    def end(self, sent: int, dropped: int) -> bytes:
        """Last message, after which the device no longer streams; empty where there is none."""
        self.streaming, self.said_end = False, self.open_framing
        return head.encode_end(sent, dropped) if self.open_framing else b""


class EmulatedHead(Device):
    """An emulated head in the open framing that sends a scan's frames at their own times."""

    open_framing = True

    def __init__(self, scan: Scan) -> None:
        self.times_s = scan.frames.time_s
        self._scan = scan
        self._every = 1
        self._commands = PacketParser()

    def hello(self) -> HelloReading:
        """Identity of the scan's head and array."""
        steps = np.diff(self.times_s)
        rate = 1 / float(np.median(steps)) if len(steps) and np.median(steps) > 0 else 0.0
        saturation = self._scan.element_calibration.saturation_count
        name = self._scan.session.get("head_id", "emulated")
        return HelloReading(name, *self._scan.head.shape, saturation, rate)

    def hear(self, data: bytes) -> bytes:
        answer = b""
        for packet in self._obeyed(self._commands.packets(data)):
            if packet.kind == head.START:
                self._every = max(1, packet.payload[0] if packet.payload else 1)
            if packet.kind in (head.ASK, head.START):
                answer += head.encode_hello(self.hello())
        return answer

    def record(self, index: int) -> bytes:
        if index % self._every:
            return b""
        device_us = round(self.times_s[index] * 1e6)
        return head.encode_frame(self._scan.frames.counts[index], sequence=index, device_us=device_us)


def played_tools(poses: TrackerPoses, faults: Faults, index: int, *, names: tuple[str, str]) -> list[ToolReading]:
    """What a tracker knows at the n-th time of a scan, of a second tool first, with the faults that are a tracker's.

    `names` are those of the tool and of the second one, which is fixed to the body and there where that breathes.
    """
    measured = index - index % max(1, faults.hold)  # the values of the latest measurement, at its own time
    x, y, z = poses.position_mm[measured].tolist()
    w, i, j, k = poses.quaternion_wxyz[measured].tolist()
    seconds, rest = divmod(float(poses.time_s[index]), 1.0)
    pose = PoseReading((x, y, z), (w, i, j, k), int(seconds) * _NS + round(rest * _NS))
    time_s = float(poses.time_s[index] - poses.time_s[0])
    bases = []
    if faults.breathe_mm:
        x, y, z = _REFERENCE_MM
        y += faults.breathe_mm / 2 * math.sin(2 * math.pi * time_s / _BREATH_S)
        bases = [PoseReading((x, y, z), _REFERENCE_TURN, pose.device_ns, tool=names[1])]
        pose = pose_from_relative(pose, bases[0])._replace(tool=names[0])
    if within(faults.hide, time_s):
        return [*bases, MissingReading("out of sight", pose.tool)]
    return [*bases, pose]


class EmulatedTracker(Device):
    """An emulated tracker of one of `serial_trackers.PROTOCOLS`, with a tracker's faults."""

    def __init__(self, poses: TrackerPoses, *, protocol: str, faults: Faults | None = None) -> None:
        self.times_s = poses.time_s
        self._protocol, self.open_framing = protocol, protocol == "open"
        self._commands = PacketParser()
        self._faults = faults or Faults()
        names = ("Probe", "Reference") if protocol in ("open", "igtlink") else ("1", "2")
        self._tools = partial(played_tools, poses, self._faults, names=names)

    def greet(self) -> None:
        """Start sending in OpenIGTLink, whose servers send to whoever connects."""
        if self._protocol == "igtlink":
            self.start()

    def hear(self, data: bytes) -> bytes:
        answer = b""
        if self.open_framing:
            for packet in self._obeyed(self._commands.packets(data)):
                if packet.kind == head.ASK:
                    answer += head.encode_hello(HelloReading("emulated tracker", 0, 0, 0, 0.0))
                    answer += self.record(0) if self._faults.breathe_mm else b""
            return answer
        for letter in _SETTING.sub(b"", data).decode("latin-1"):
            if letter in "PB" and len(self.times_s):
                self.stop()
                answer += self.record(0)
            elif letter in "C@":
                self.start()
            elif letter == "c":
                self.stop()
        return answer

    def record(self, index: int) -> bytes:
        return b"".join(encoded(self._protocol, one, index) for one in self._tools(index))


# --- Emulated NDI tracker: the commands of the combined API that a host needs to follow one tool.
#
# A command is ``NAME:arguments`` and a CRC-16 in hexadecimal, or ``NAME arguments`` without, and a carriage return;
# so is an answer. ``BX`` is answered in binary. References: NDI Combined API guide; CRC-16/ARC.

HANDLE: Final = 0x0A
_VALID, _MISSING = 0x01, 0x02
_PORT_STATUS: Final = 0x31  # a tool in the port, initialised and enabled
_OUT_OF_VOLUME: Final = 0x40
_START: Final = 0xA5C4
_BAD_CRC, _UNKNOWN, _NOT_NOW = 0x04, 0x01, 0x0C
_POLYNOMIAL: Final = 0xA001
_LISTED: Final = {1: "to be freed", 2: "plugged in", 3: "initialised", 4: "enabled"}
"""States of ports that PHSR asks for by numbers; by others it asks for all."""
_LEADS_TO: Final = {"PVWR": "plugged in", "PINIT": "initialised", "PENA": "enabled", "PHF": "none"}
"""The state of a tool's port after a command."""
_LONGEST: Final = 4096


def crc16(data: bytes) -> int:
    """CRC-16/ARC; of ``123456789`` it is 0xBB3D."""
    crc = 0
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (_POLYNOMIAL if crc & 1 else 0)
    return crc


class EmulatedNdi(Device):
    """NDI tracker that answers with the poses of the present time, counted from TSTART; it never sends unasked.

    Of the faults it has those that are a tracker's. `elapsed` gives the seconds of the scan
    that other devices play too, None while it waits: by default it begins with TSTART.
    """

    _port = "plugged in"

    def __init__(
        self, poses: TrackerPoses, *, faults: Faults | None = None, elapsed: Callable[[], float | None] | None = None
    ) -> None:
        self.times_s = poses.time_s
        self._elapsed = elapsed
        faults = faults or Faults()
        self._tools = partial(played_tools, poses, faults, names=("", ""))
        self._handles = (HANDLE + 1, HANDLE) if faults.breathe_mm else (HANDLE,)
        self._asked = 0
        self._begun: float | None = None
        self._rest = b""

    def hear(self, data: bytes) -> bytes:
        *lines, rest = (self._rest + data).split(b"\r")
        self._rest = rest[-_LONGEST:]
        return b"".join(self._answer(line) for line in lines)

    def _answer(self, line: bytes) -> bytes:
        name, colon, rest = line.partition(b":")
        if colon:
            body, told = line[:-4], line[-4:]
            if told != b"%04X" % crc16(body):
                return _text(f"ERROR{_BAD_CRC:02X}")
            rest = body[len(name) + 1 :]
        else:
            name, _, rest = line.partition(b" ")
        if name == b"BX":
            return self._poses_now()
        done = self._do(name.decode("latin-1"), rest.decode("latin-1"))
        return _text(f"ERROR{_UNKNOWN:02X}" if done is None else done)

    def _do(self, name: str, rest: str) -> str | None:
        """Answer to one command; None for an unknown one."""
        match name:
            case "INIT" | "COMM" | "TSTOP":
                self._begun = None if name != "COMM" else self._begun
            case "TSTART":
                self._begun = time.monotonic()
            case "VER":
                return "Emulated NDI tracker\nfor tests"
            case "PHSR":
                listed = _LISTED.get(int(rest or "0", 16), "any")
                handles = self._handles if self._port == listed or (self._port != "none" and listed == "any") else ()
                return f"{len(handles):02X}{''.join(f'{one:02X}{_PORT_STATUS:03X}' for one in sorted(handles))}"
            case "PHRQ":
                self._port, self._asked = "asked for", self._asked + 1
                return f"{HANDLE + self._asked - 1:02X}"
            case _ if name in _LEADS_TO:
                self._port = _LEADS_TO[name]
            case _:
                return None
        return "OKAY"

    def _poses_now(self) -> bytes:
        if self._begun is None or self._port != "enabled":
            return _text(f"ERROR{_NOT_NOW:02X}")
        elapsed = time.monotonic() - self._begun if self._elapsed is None else self._elapsed() or 0.0
        index = int(np.searchsorted(self.times_s - self.times_s[0], elapsed, side="right")) - 1
        put_away = elapsed > self.times_s[-1] - self.times_s[0] + 0.1
        frame = index + 1 + (round(1000 * elapsed) if put_away else 0)
        body = bytes([len(self._handles)])
        for handle, one in zip(self._handles, self._tools(index), strict=True):
            if put_away or isinstance(one, MissingReading):
                status = _PORT_STATUS | (0 if put_away else _OUT_OF_VOLUME)
                body += struct.pack("<BBII", handle, _MISSING, status, frame)
            else:
                numbers = (*one.quaternion_wxyz, *one.position_mm, 0.1)
                body += struct.pack("<BB8fII", handle, _VALID, *numbers, _PORT_STATUS, frame)
        header = struct.pack("<HH", _START, len(body))
        return header + crc16(header).to_bytes(2, "little") + body + crc16(body).to_bytes(2, "little")


def _text(words: str) -> bytes:
    return b"%b%04X\r" % (words.encode(), crc16(words.encode()))
