"""Emulated devices: a scan's frames and poses as the bytes of a head or a tracker, faults on request.

They are devices like any other: nothing in the recorder knows of them.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np

from tactile_bayes.geometry import rotation_from_quaternion
from tactile_bayes.hardware import head
from tactile_bayes.hardware.bird import SCALE_INCH, record_bytes
from tactile_bayes.hardware.framing import PacketParser
from tactile_bayes.hardware.igtlink import encode_transform
from tactile_bayes.hardware.readings import MM_PER_INCH, HelloReading, PoseReading
from tactile_bayes.scan import Scan, TrackerPoses

_NS: Final = 1_000_000_000
# A command with arguments ends in CR; what is left are commands of one letter.
_SETTING: Final = re.compile(rb"[A-Za-z][0-9*,][^\r]*\r")


@dataclass(frozen=True, slots=True)
class Faults:
    """What an emulated device does wrong.

    Parameters
    ----------
    drop, corrupt
        Share of the records that are not sent, or sent with one bit changed.
    stall
        From this time of the scan on, for this long, nothing is sent; what was measured then is lost. In s.
    disconnect_s
        The cable is pulled at this time of the scan.
    hold
        Only every n-th pose is measured anew, those between repeat it.
    """

    drop: float = 0.0
    corrupt: float = 0.0
    stall: tuple[float, float] | None = None
    disconnect_s: float | None = None
    hold: int = 1

    def stalls(self, time_s: float) -> bool:
        """Whether nothing is sent at a time of the scan."""
        return self.stall is not None and self.stall[0] <= time_s < self.stall[0] + self.stall[1]

    def disturb(self, record: bytes, rng: np.random.Generator) -> bytes:
        """The record as it is sent: as it is, with one bit changed, or not at all."""
        if self.drop and rng.random() < self.drop:
            return b""
        if not self.corrupt or rng.random() >= self.corrupt:
            return record
        bit = int(rng.integers(8 * len(record)))
        changed = bytearray(record)
        changed[bit // 8] ^= 1 << bit % 8
        return bytes(changed)


class Device(Protocol):
    """An emulated device: commands in, answers out, and records at their times."""

    @property
    def times_s(self) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
        """When each record is due after the start, never falling."""

    @property
    def streaming(self) -> bool:
        """Whether it sends, or will when the scan begins."""

    @property
    def starts(self) -> int:
        """How often it was told to send; each time is a new beginning."""

    @property
    def stopped(self) -> bool:
        """Whether the host was the last to say something about sending, and said stop."""

    @property
    def said_end(self) -> bool:
        """Whether its protocol tells the host that it has sent everything, and it did."""

    def greet(self) -> None:
        """A host has connected."""

    def hear(self, data: bytes) -> bytes:
        """Take commands; the answer."""

    def record(self, index: int) -> bytes:
        """The bytes of one record; empty for one that this device leaves out."""

    def end(self, sent: int, dropped: int) -> bytes:
        """What it says after its last record; it does not stream from then on."""


class _Sender:
    """What every device that streams remembers of its commands."""

    def __init__(self) -> None:
        self.starts = 0
        self.streaming = self.stopped = self.said_end = False

    def start(self) -> None:
        """The host wants records."""
        self.starts += 1
        self.streaming, self.stopped, self.said_end = True, False, False

    def stop(self) -> None:
        """The host wants none."""
        self.streaming, self.stopped = False, True

    def greet(self) -> None:
        """Most devices wait for a command."""


class EmulatedHead(_Sender):
    """A head in the open framing.

    Parameters
    ----------
    scan
        Its frames are sent at their own times.
    """

    def __init__(self, scan: Scan) -> None:
        super().__init__()
        self.times_s = scan.frames.time_s
        self._scan = scan
        self._every = 1
        self._commands = PacketParser()

    def hello(self) -> HelloReading:
        """Who it says it is: the scan's head and array."""
        steps = np.diff(self.times_s)
        rate = 1 / float(np.median(steps)) if len(steps) and np.median(steps) > 0 else 0.0
        saturation = self._scan.element_calibration.saturation_count
        name = self._scan.session.get("head_id", "emulated")
        return HelloReading(name, *self._scan.head.shape, saturation, rate)

    def hear(self, data: bytes) -> bytes:
        """ASK, START and STOP."""
        answer = b""
        for packet in self._commands.feed(data):
            if packet.kind == head.ASK:
                answer += head.encode_hello(self.hello())
            elif packet.kind == head.START:
                self._every = max(1, packet.payload[0] if packet.payload else 1)
                self.start()
                answer += head.encode_hello(self.hello())
            elif packet.kind == head.STOP:
                self.stop()
        return answer

    def record(self, index: int) -> bytes:
        """A FRAME."""
        if index % self._every:
            return b""
        device_us = round(self.times_s[index] * 1e6)
        return head.encode_frame(self._scan.frames.counts[index], sequence=index, device_us=device_us)

    def end(self, sent: int, dropped: int) -> bytes:
        """An END."""
        self.streaming, self.said_end = False, True
        return head.encode_end(sent, dropped)


class EmulatedTracker(_Sender):
    """A tracker of one of the makers, or in the open framing.

    Parameters
    ----------
    poses
        Sent at their own times.
    protocol
        A name of `PROTOCOLS`.
    hold
        Only every n-th pose is measured anew.
    """

    def __init__(self, poses: TrackerPoses, *, protocol: str, hold: int = 1) -> None:
        super().__init__()
        self.times_s = poses.time_s
        self._poses = poses
        self._protocol = protocol
        self._commands = PacketParser()
        self._hold = max(1, hold)
        self._encode = PROTOCOLS[protocol]

    def pose(self, index: int) -> PoseReading:
        """The pose that is sent as the n-th: with its own time, but measured when one was last measured."""
        measured = index - index % self._hold
        x, y, z = (float(value) for value in self._poses.position_mm[measured])
        w, i, j, k = (float(value) for value in self._poses.quaternion_wxyz[measured])
        time_s = float(self.times_s[index])
        whole = int(time_s)
        return PoseReading((x, y, z), (w, i, j, k), whole * _NS + round((time_s - whole) * _NS))

    def greet(self) -> None:
        """An OpenIGTLink server sends to whoever connects."""
        if self._protocol == "igtlink":
            self.start()

    def hear(self, data: bytes) -> bytes:
        """Start, stop, and one record when asked; settings are taken for granted."""
        if self._protocol == "open":
            return self._hear_open(data)
        answer = b""
        for letter in _SETTING.sub(b"", data).decode("latin-1"):
            if letter in "PB" and len(self.times_s):
                self.stop()
                answer += self.record(0)
            elif letter in "C@":
                self.start()
            elif letter == "c":
                self.stop()
        return answer

    def _hear_open(self, data: bytes) -> bytes:
        answer = b""
        for packet in self._commands.feed(data):
            if packet.kind == head.ASK:
                answer += head.encode_hello(HelloReading("emulated tracker", 0, 0, 0, 0.0))
            elif packet.kind == head.START:
                self.start()
            elif packet.kind == head.STOP:
                self.stop()
        return answer

    def record(self, index: int) -> bytes:
        """One record of the protocol."""
        return self._encode(self.pose(index), index)

    def end(self, sent: int, dropped: int) -> bytes:
        """An END in the open framing; trackers say nothing."""
        self.streaming, self.said_end = False, self._protocol == "open"
        return head.encode_end(sent, dropped) if self.said_end else b""


def _inches(pose: PoseReading) -> tuple[float, float, float]:
    x, y, z = pose.position_mm
    return (x / MM_PER_INCH, y / MM_PER_INCH, z / MM_PER_INCH)


def _time_ms(pose: PoseReading) -> int:
    return (pose.device_ns or 0) // 1_000_000 % 2**32


def _fastrak(pose: PoseReading, _: int) -> bytes:
    return b"01 " + struct.pack("<7f", *_inches(pose), *pose.quaternion_wxyz) + b" "


def _fastrak_ascii(pose: PoseReading, _: int) -> bytes:
    place = "".join(f"{value:7.2f}" for value in _inches(pose))
    turn = "".join(f"{value:7.4f}" for value in pose.quaternion_wxyz)
    return f"01 {place}{turn}\r\n".encode()


def _liberty(pose: PoseReading, _: int) -> bytes:
    body = struct.pack("<7fIi", *_inches(pose), *pose.quaternion_wxyz, _time_ms(pose), 0)
    return struct.pack("<2sBBBBH", b"LY", 1, ord("C"), ord(" "), 0, len(body) + 1) + body + b" "


def _liberty_ascii(pose: PoseReading, _: int) -> bytes:
    numbers = [f"{value:.5f}" for value in (*_inches(pose), *pose.quaternion_wxyz)]
    return f"01  {' '.join(numbers)} {_time_ms(pose)} 0\r\n".encode()


def _bird(pose: PoseReading, _: int) -> bytes:
    return record_bytes(_inches(pose), pose.quaternion_wxyz, scale_inch=SCALE_INCH)


def _open(pose: PoseReading, sequence: int) -> bytes:
    return head.encode_pose(pose, sequence=sequence)


def _igtlink(pose: PoseReading, _: int) -> bytes:
    return encode_transform(pose, rotation_from_quaternion(np.array(pose.quaternion_wxyz)))


PROTOCOLS: Final[dict[str, Callable[[PoseReading, int], bytes]]] = {
    "fastrak": _fastrak,
    "fastrak-ascii": _fastrak_ascii,
    "liberty": _liberty,
    "liberty-ascii": _liberty_ascii,
    "bird": _bird,
    "open": _open,
    "igtlink": _igtlink,
}
