"""Serving of emulated devices over pseudo-terminals or TCP, at the scan's own rate."""

from __future__ import annotations

import contextlib
import fcntl
import os
import select
import socket
import termios
import time
import tty
from dataclasses import KW_ONLY, dataclass, field
from typing import Final

import numpy as np

from tactile_bayes.errors import DeviceError
from tactile_bayes.hardware.emulated import Device, Faults, within

# A device's own buffer: what does not fit is dropped record by record, as firmware does.
BUFFER_BYTES: Final = 256 * 1024
_READ: Final = 4096
_LOOK_S: Final = 0.01
_LOOKS: Final = 25
_IDLE_S: Final = 0.2
# A follower repeats its first record so often while the scan waits, but not so soon after a START: it may begin now.
_HOLD_S: Final = 0.01
_SETTLE_S: Final = 0.5
# How long `--once` waits for a host to read, and to say STOP to a device that does not tell its end.
LINGER_S: Final = 5.0


class PtyLink:
    """A pseudo-terminal, which the host at `url` opens like a serial device."""

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
        """Wait until the terminal's buffers are empty, because they are lost when it closes.

        Only the last of them says how much it holds, so it must have been empty for a while.
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
            reason = error.strerror or str(error)
            raise DeviceError(f"{host}:{port}: cannot listen ({reason}); give another --tcp HOST:PORT") from None
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
        """As `PtyLink.write`."""
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
        """Close the connection at once."""
        if self._host is not None:
            self._host.close()
        self._listener.close()


Link = PtyLink | TcpLink


class Stage:
    """Clock of a scan that devices play together; `speed` is seconds of the scan in a second."""

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
    """Runs an emulated device on a link, with the given faults; records keep their device times.

    Each START of a device that `leads` begins the scan. A device that follows another's stage repeats its first record
    while it streams and the scan has not begun, as a tracker does whose sensor is held still.
    """

    device: Device
    link: Link
    _: KW_ONLY
    faults: Faults
    rng: np.random.Generator
    stage: Stage = field(default_factory=Stage)
    leads: bool = True

    sent = dropped = faulty = 0  #: Records sent, dropped and changed by faults since a START.
    unplugged = False

    def __post_init__(self) -> None:
        self._waiting = bytearray()
        self._starts = self.device.starts
        self._round, self._next, self._finished_at = 0, 0, 0.0
        self._hold_at = time.monotonic() + _SETTLE_S

    def run(self, *, once: bool = False) -> None:
        """Serve until the link breaks, or, with `once`, until a scan has been sent and read."""
        while not self.unplugged:
            self._step()
            if once and self._finished_at and not self._waiting:
                waited = time.monotonic() - self._finished_at > LINGER_S
                if self.device.said_end or self.device.stopped or waited:
                    self.link.finish(LINGER_S)
                    self.unplugged = True

    def _step(self) -> None:
        """Wait for the next event and handle it."""
        writable = [self.link] if self._waiting else []
        readable, _, _ = select.select([self.link], writable, [], self._patience_s())
        if readable:
            self._hear()
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
        self._pass_on()

    def _pass_on(self) -> None:
        if self._waiting and not self.unplugged:
            del self._waiting[: self.link.write(bytes(self._waiting))]

    def _patience_s(self) -> float:
        times = self.device.times_s
        if not self.device.streaming or self._next >= len(times):
            return _IDLE_S
        _, elapsed_s = self.stage.now()
        if elapsed_s is None:
            return _HOLD_S
        return max(0.0, min((float(times[self._next] - times[0]) - elapsed_s) / self.stage.speed, _IDLE_S))

    def _hear(self) -> None:
        was_there = self.link.connected()
        self._waiting += self.device.hear(self.link.read())
        if self.link.connected() and not was_there:
            self.device.greet()
        elif was_there and not self.link.connected():
            self._waiting.clear()

    def _follow_commands(self) -> None:
        """Begin anew at each START, also while streaming; a device that leads starts the others too."""
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
            self._send(self.device.record(self._next), moment)
            self._next += 1
            self._pass_on()  # at once: when this process was late, many are due and must not meet in the buffer
        if self._next >= len(times):
            self._waiting += self.device.end(self.sent, self.dropped)
            self._finished_at = time.monotonic()

    def _send(self, record: bytes, moment_s: float) -> None:
        if not record:
            return
        if within(self.faults.stall, moment_s) or len(self._waiting) + len(record) > BUFFER_BYTES:
            self.dropped += 1
            return
        disturbed = self.faults.disturb(record, self.rng)
        self.faulty += disturbed != record
        self.sent += bool(disturbed)
        self._waiting += disturbed
