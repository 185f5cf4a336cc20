"""Emulated devices that send a scan as real ones would, over pseudo-terminals or TCP, at the scan's own rate."""

from __future__ import annotations

import contextlib
import fcntl
import math
import os
import re
import select
import socket
import struct
import termios
import time
import tty
from collections.abc import Callable, Iterable, Iterator
from dataclasses import KW_ONLY, dataclass, field
from functools import partial
from typing import Final

import numpy as np

from tactile_bayes.errors import DeviceError
from tactile_bayes.geometry import FloatArray
from tactile_bayes.hardware import head
from tactile_bayes.hardware.ports import reason
from tactile_bayes.hardware.readings import HelloReading, MissingReading, PoseReading, ToolReading, relative_pose
from tactile_bayes.hardware.serial_trackers import encode_record
from tactile_bayes.options import FaultOptions
from tactile_bayes.scans import Scan, TrackerPoses

# --- Emulated devices: a scan's frames and poses as a head or a tracker sends them, with faults on request.

_NS: Final = 1_000_000_000
# A command with arguments ends in CR; what is left are commands of one letter.
_SETTING: Final = re.compile(rb"[A-Za-z][0-9*,][^\r]*\r")
_BREATH_S: Final = 4.0
# Position and rotation of the second tool; it is rotated so that its frame differs from the tracker's.
_REFERENCE_MM: Final = (250.0, -40.0, 30.0)
_REFERENCE_TURN: Final = (0.8, 0.0, 0.6, 0.0)


class Faults(FaultOptions):
    """Faults of an emulated device, applied to its records."""

    def disturb(self, record: bytes, rng: np.random.Generator) -> bytes:
        """Return the record unchanged, with one bit flipped, or empty where it is dropped."""
        if self.drop and rng.random() < self.drop:
            return b""
        if not self.corrupt or rng.random() >= self.corrupt:
            return record
        bit = int(rng.integers(8 * len(record)))
        changed = bytearray(record)
        changed[bit // 8] ^= 1 << bit % 8
        return bytes(changed)


def is_during(span: tuple[float, float] | None, time_s: float) -> bool:
    """True during a fault, whose `span` is its begin and its length in s."""
    return span is not None and span[0] <= time_s < span[0] + span[1]


class Device:
    """An emulated device: it answers commands and sends records at their times, most devices after a command."""

    times_s: FloatArray  #: Times of the records after the start, never falling.
    starts = 0  #: Number of START commands so far; each begins the scan anew.
    streaming = False  #: True when the device sends, or will when the scan begins.
    stopped = False  #: True when the host's last command about sending was STOP.
    end_sent = False  #: True when the device has sent its last message, which says that everything was sent.
    open_framing = False  #: True for a device of the open framing, which has a last message.

    def start(self) -> None:
        self.starts += 1
        self.streaming, self.stopped, self.end_sent = True, False, False

    def stop(self) -> None:
        self.streaming, self.stopped = False, True

    def greet(self) -> None:
        """React to a new connection."""

    def respond(self, data: bytes) -> bytes:
        """Process commands and return the answer."""
        raise NotImplementedError

    def _obey(self, packets: Iterable[head.Packet]) -> Iterator[head.Packet]:
        """Carry out START and STOP among commands in the open framing; yields every command."""
        for packet in packets:
            if packet.kind == head.START:
                self.start()
            elif packet.kind == head.STOP:
                self.stop()
            yield packet

    def record(self, index: int) -> bytes:
        """Bytes of one record; empty for a record that is not sent."""
        raise NotImplementedError

    def end(self, sent: int, dropped: int) -> bytes:
        """End the stream and return the last message; empty where the protocol has none."""
        self.streaming, self.end_sent = False, self.open_framing
        return head.encode_end(sent, dropped) if self.open_framing else b""


class EmulatedHead(Device):
    """An emulated head in the open framing that sends a scan's frames at their own times."""

    open_framing = True

    def __init__(self, scan: Scan) -> None:
        self.times_s = scan.frames.time_s
        self._scan = scan
        self._every = 1
        self._commands = head.PacketParser()

    def hello(self) -> HelloReading:
        """Identity of the scan's head and array."""
        steps = np.diff(self.times_s)
        rate = 1 / float(np.median(steps)) if len(steps) and np.median(steps) > 0 else 0.0
        saturation = self._scan.element_calibration.saturation_count
        name = self._scan.session.get("head_id", "emulated")
        return HelloReading(name, *self._scan.head.shape, saturation, rate)

    def respond(self, data: bytes) -> bytes:
        answer = b""
        for packet in self._obey(self._commands.packets(data)):
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


def tool_readings(poses: TrackerPoses, faults: Faults, index: int, *, names: tuple[str, str]) -> list[ToolReading]:
    """Readings of a tracker's tools at the n-th time of a scan, with the faults that a tracker can have.

    `names` are those of the tool and of a reference fixed to the body. The reference comes first, and only where the
    body breathes.
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
        tracker = relative_pose(PoseReading((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)), bases[0])
        pose = relative_pose(pose, tracker)._replace(tool=names[0])
    if is_during(faults.hide, time_s):
        return [*bases, MissingReading("out of sight", pose.tool)]
    return [*bases, pose]


class EmulatedTracker(Device):
    """An emulated tracker of one of `serial_trackers.PROTOCOLS`, with a tracker's faults."""

    def __init__(self, poses: TrackerPoses, *, protocol: str, faults: Faults | None = None) -> None:
        self.times_s = poses.time_s
        self._protocol, self.open_framing = protocol, protocol == "open"
        self._commands = head.PacketParser()
        self._faults = faults or Faults()
        names = ("Probe", "Reference") if protocol in ("open", "igtlink") else ("1", "2")
        self._tools = partial(tool_readings, poses, self._faults, names=names)

    def greet(self) -> None:
        """Start sending in OpenIGTLink, whose servers send to whoever connects."""
        if self._protocol == "igtlink":
            self.start()

    def respond(self, data: bytes) -> bytes:
        answer = b""
        if self.open_framing:
            for packet in self._obey(self._commands.packets(data)):
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
        return b"".join(encode_record(self._protocol, tool, index) for tool in self._tools(index))


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
"""States of ports by the number in PHSR; another number asks for all ports."""
_STATE_AFTER: Final = {"PVWR": "plugged in", "PINIT": "initialised", "PENA": "enabled", "PHF": "none"}
"""State of a tool's port after a command."""
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
    """Emulated NDI tracker: it answers with the poses of the present time, counted from TSTART; it sends nothing else.

    It has only the faults that a tracker can have. `elapsed` returns the seconds of a scan that other devices play too,
    None while that waits; by default the scan begins with TSTART.
    """

    _port = "plugged in"

    def __init__(
        self, poses: TrackerPoses, *, faults: Faults | None = None, elapsed: Callable[[], float | None] | None = None
    ) -> None:
        self.times_s = poses.time_s
        self._elapsed = elapsed
        faults = faults or Faults()
        self._tools = partial(tool_readings, poses, faults, names=("", ""))
        self._handles = (HANDLE + 1, HANDLE) if faults.breathe_mm else (HANDLE,)
        self._asked = 0
        self._begun: float | None = None
        self._rest = b""

    def respond(self, data: bytes) -> bytes:
        *lines, rest = (self._rest + data).split(b"\r")
        self._rest = rest[-_LONGEST:]
        return b"".join(self._answer(line) for line in lines)

    def _answer(self, line: bytes) -> bytes:
        name, colon, rest = line.partition(b":")
        if colon:
            body, checksum = line[:-4], line[-4:]
            if checksum != b"%04X" % crc16(body):
                return _encode_answer(f"ERROR{_BAD_CRC:02X}")
            rest = body[len(name) + 1 :]
        else:
            name, _, rest = line.partition(b" ")
        if name == b"BX":
            return self._poses_now()
        done = self._carry_out(name.decode("latin-1"), rest.decode("latin-1"))
        return _encode_answer(f"ERROR{_UNKNOWN:02X}" if done is None else done)

    def _carry_out(self, name: str, rest: str) -> str | None:
        """Carry out one command and return the answer; None for an unknown command."""
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
                return f"{len(handles):02X}{''.join(f'{handle:02X}{_PORT_STATUS:03X}' for handle in sorted(handles))}"
            case "PHRQ":
                self._port, self._asked = "asked for", self._asked + 1
                return f"{HANDLE + self._asked - 1:02X}"
            case _ if name in _STATE_AFTER:
                self._port = _STATE_AFTER[name]
            case _:
                return None
        return "OKAY"

    def _poses_now(self) -> bytes:
        if self._begun is None or self._port != "enabled":
            return _encode_answer(f"ERROR{_NOT_NOW:02X}")
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


def _encode_answer(words: str) -> bytes:
    return b"%b%04X\r" % (words.encode(), crc16(words.encode()))


# --- Serving of emulated devices over pseudo-terminals or TCP.

# A device's buffer: records that do not fit are dropped, as firmware does.
BUFFER_BYTES: Final = 256 * 1024
_READ: Final = 4096
_LOOK_S: Final = 0.01
_LOOKS: Final = 25
_IDLE_S: Final = 0.2
# A device that follows repeats its first record this often while the scan waits, but not so soon after a START: the
# scan may be about to begin.
_HOLD_S: Final = 0.01
_SETTLE_S: Final = 0.5
# How long `--once` waits for a host to read, and to send STOP to a device whose protocol has no last message.
LINGER_S: Final = 5.0


class PtyLink:
    """A pseudo-terminal; the host opens its `url` like a serial device."""

    def __init__(self) -> None:
        self._near, self._far = os.openpty()
        tty.setraw(self._far)
        os.set_blocking(self._near, False)
        self.url = os.ttyname(self._far)

    def fileno(self) -> int:
        """File descriptor to wait on; ready for reading when a command has come."""
        return self._near

    def connected(self) -> bool:
        """Return True: a pseudo-terminal does not show whether it is open."""
        return True

    def read(self) -> bytes:
        """Read bytes from the host; empty when none have come."""
        with contextlib.suppress(BlockingIOError):
            return os.read(self._near, _READ)
        return b""

    def write(self, data: bytes) -> int:
        """Send as much as fits; return the number of bytes."""
        with contextlib.suppress(BlockingIOError):
            return os.write(self._near, data)
        return 0

    def finish(self, patience_s: float) -> None:
        """Wait until the terminal's buffers are empty, because closing it loses them.

        Only the last buffer says how much it holds, so it must stay empty for a while.
        """
        end, left, empty = time.monotonic() + patience_s, bytearray(4), 0
        while time.monotonic() < end and empty < _LOOKS:
            time.sleep(_LOOK_S)
            fcntl.ioctl(self._far, termios.FIONREAD, left)
            empty = 0 if any(left) else empty + 1
        self.close()

    def close(self) -> None:
        """Close both ends, so that the host sees the device disappear."""
        os.close(self._near)
        os.close(self._far)


class TcpLink:
    """A listening socket at `url` that accepts one host at a time."""

    def __init__(self, host: str, port: int) -> None:
        try:
            self._listener = socket.create_server((host, port))
        except OSError as error:
            raise DeviceError(f"{host}:{port}: cannot listen ({reason(error)}); give another --tcp HOST:PORT") from None
        self._host: socket.socket | None = None
        name, number = self._listener.getsockname()[:2]
        self.url = f"socket://{name}:{number}"

    def fileno(self) -> int:
        """File descriptor of the host's socket, or of the listener without a host."""
        return (self._host or self._listener).fileno()

    def connected(self) -> bool:
        """True when a host may be listening."""
        return self._host is not None

    def read(self) -> bytes:
        """Read bytes from the host; accepts a new host when there is none."""
        if self._host is None:
            self._host, _ = self._listener.accept()
            self._host.setblocking(False)
            self._host.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            return b""
        try:
            data = self._host.recv(_READ)
        except BlockingIOError:
            return b""
        except OSError:
            data = b""
        if not data:
            self._host.close()
            self._host = None
        return data

    def write(self, data: bytes) -> int:
        if self._host is None:
            return len(data)
        try:
            return self._host.send(data)
        except BlockingIOError:
            return 0
        except OSError:
            return len(data)

    def finish(self, patience_s: float) -> None:
        """End the sending side and read the rest: closing with unread bytes loses what is still on its way."""
        if self._host is not None:
            with contextlib.suppress(OSError):
                self._host.shutdown(socket.SHUT_WR)
                self._host.settimeout(patience_s)
                while self._host.recv(_READ):
                    pass
        self.close()

    def close(self) -> None:
        if self._host is not None:
            self._host.close()
        self._listener.close()


Link = PtyLink | TcpLink


class Playback:
    """Clock of a scan that several devices play together; `speed` is seconds of the scan in a second."""

    def __init__(self, *, speed: float = 1.0) -> None:
        self.speed = speed
        self._begun: tuple[int, float | None] = (0, None)  # one value: devices look from threads of their own

    def begin(self) -> None:
        """Start playing from the beginning."""
        self._begun = (self._begun[0] + 1, time.monotonic())

    def end(self) -> None:
        """Return to the beginning and wait."""
        self._begun = (self._begun[0], None)

    def now(self) -> tuple[int, float | None]:
        """Number of starts, and time of the scan in s since the last; None while waiting."""
        number, begun = self._begun
        return number, None if begun is None else (time.monotonic() - begun) * self.speed


@dataclass
class Emulator:
    """Runs an emulated device on a link, with faults; records keep their device times.

    Each START of a device that `leads` begins the scan. A device that follows repeats its first record while it streams
    and the scan has not begun, as a tracker does whose sensor is held still.
    """

    device: Device
    link: Link
    _: KW_ONLY
    faults: Faults
    rng: np.random.Generator
    stage: Playback = field(default_factory=Playback)
    leads: bool = True

    sent = dropped = faulty = 0  #: Records sent, dropped and changed by faults since a START.
    unplugged = False
    left = False  #: Whether the host reads no more: it has stopped the device, or has gone.

    def __post_init__(self) -> None:
        self._waiting = bytearray()
        self._starts = self.device.starts
        self._round, self._next, self._finished_at = 0, 0, 0.0
        self._hold_at = time.monotonic() + _SETTLE_S

    def run(self, *, once: bool = False) -> None:
        """Serve until the link breaks, or, with `once`, until a scan has been sent and read, or was stopped."""
        while not self.unplugged:
            self._step()
            self.left = self.device.starts > 0 and (self.device.stopped or not self.link.connected())
            all_sent = self.device.end_sent and not self._waiting
            at_end = self._finished_at and (all_sent or time.monotonic() - self._finished_at > LINGER_S)
            if once and (self.left or at_end):
                self.link.finish(0.0 if self.left else LINGER_S)
                self.unplugged = True

    def _step(self) -> None:
        writable = [self.link] if self._waiting else []
        readable, _, _ = select.select([self.link], writable, [], self._wait_s())
        if readable:
            self._read_commands()
        self._follow_commands()
        number, elapsed_s = self.stage.now()
        if self.device.streaming and self.link.connected():
            if number != self._round and elapsed_s is not None:
                self._round, self._next, self._finished_at = number, 0, 0.0
                self.sent = self.dropped = self.faulty = 0
            if elapsed_s is not None:
                self._send_due(elapsed_s)
            elif not self.leads and time.monotonic() > self._hold_at:
                self._hold_at = time.monotonic() + _HOLD_S
                self._waiting += self.device.record(0)
        self._send_waiting()

    def _send_waiting(self) -> None:
        if self._waiting and not self.unplugged:
            written = self.link.write(bytes(self._waiting))
            del self._waiting[:written]
            if written and self._finished_at:  # somebody reads
                self._finished_at = time.monotonic()

    def _wait_s(self) -> float:
        """Longest wait for a command before the next record is due."""
        times = self.device.times_s
        if not self.device.streaming or self._next >= len(times):
            return _IDLE_S
        _, elapsed_s = self.stage.now()
        if elapsed_s is None:
            return _HOLD_S
        return max(0.0, min((float(times[self._next] - times[0]) - elapsed_s) / self.stage.speed, _IDLE_S))

    def _read_commands(self) -> None:
        was_there = self.link.connected()
        self._waiting += self.device.respond(self.link.read())
        if self.link.connected() and not was_there:
            self.device.greet()
        elif was_there and not self.link.connected():
            self._waiting.clear()

    def _follow_commands(self) -> None:
        """Begin again at each START, also while streaming; a device that leads starts the others too."""
        if self.device.starts != self._starts:
            self._starts, self._hold_at = self.device.starts, time.monotonic() + _SETTLE_S
            if self.leads:
                self.stage.begin()
        elif self.leads and (self.device.stopped or not self.link.connected()):
            self.stage.end()

    def _send_due(self, elapsed_s: float) -> None:
        times = self.device.times_s
        if self._next >= len(times):
            return
        while self._next < len(times) and times[self._next] - times[0] <= elapsed_s:
            moment = float(times[self._next] - times[0])
            if self.faults.disconnect_s is not None and moment >= self.faults.disconnect_s:
                with contextlib.suppress(OSError):
                    self.link.write(bytes(self._waiting))
                self.unplugged = True
                self.link.close()
                return
            record = self.device.record(self._next)
            if is_during(self.faults.stall, moment) or len(self._waiting) + len(record) > BUFFER_BYTES:
                self.dropped += bool(record)
            elif record:
                disturbed = self.faults.disturb(record, self.rng)
                self.faulty += disturbed != record
                self.sent += bool(disturbed)
                self._waiting += disturbed
            self._next += 1
            self._send_waiting()  # at once: when this process was late, many are due and must not meet in the buffer
        if self._next >= len(times):
            self._waiting += self.device.end(self.sent, self.dropped)
            self._finished_at = time.monotonic()
