"""Serve an emulated device over a pseudo-terminal or TCP, at the scan's own rate."""

from __future__ import annotations

import contextlib
import os
import select
import socket
import time
import tty
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np

from tactile_bayes.errors import DeviceError
from tactile_bayes.hardware.emulated import Device, Faults

# A device's own buffer: what does not fit is dropped record by record, as firmware does.
BUFFER_BYTES: Final = 256 * 1024
_READ: Final = 4096
_IDLE_S: Final = 0.2


class Link(Protocol):
    """The device's end of a line."""

    @property
    def url(self) -> str:
        """What a host opens."""

    def fileno(self) -> int:
        """To wait on; for reading it is ready when a command or a caller has come."""

    def connected(self) -> bool:
        """Whether anybody may be listening."""

    def read(self) -> bytes:
        """Bytes from the host, or nothing."""

    def write(self, data: bytes) -> int:
        """Send what fits; how many bytes that was."""

    def close(self) -> None:
        """Pull the cable."""


class PtyLink:
    """A pseudo-terminal: the host opens it like a serial device."""

    def __init__(self) -> None:
        self._near, self._far = os.openpty()
        tty.setraw(self._far)
        os.set_blocking(self._near, False)
        self.url = os.ttyname(self._far)

    def fileno(self) -> int:
        """The device's end."""
        return self._near

    def connected(self) -> bool:
        """A terminal does not tell."""
        return True

    def read(self) -> bytes:
        """Bytes from the host."""
        try:
            return os.read(self._near, _READ)
        except BlockingIOError:
            return b""

    def write(self, data: bytes) -> int:
        """Into the terminal's buffer, as far as it has room."""
        try:
            return os.write(self._near, data)
        except BlockingIOError:
            return 0

    def close(self) -> None:
        """Both ends go: the host sees the end of the device."""
        os.close(self._near)
        os.close(self._far)


class TcpLink:
    """A listening socket that takes one host at a time."""

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
        """The host's socket, or the listener's while nobody is there."""
        return (self._host or self._listener).fileno()

    def connected(self) -> bool:
        """Whether a host is there."""
        return self._host is not None

    def read(self) -> bytes:
        """Bytes from the host; takes a new host when there is none."""
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
        """Into the socket's buffer, as far as it has room."""
        if self._host is None:
            return len(data)
        try:
            return self._host.send(data)
        except BlockingIOError:
            return 0
        except OSError:
            return len(data)

    def close(self) -> None:
        """Close both sockets."""
        if self._host is not None:
            self._host.close()
        self._listener.close()


@dataclass(slots=True)
class Served:
    """What was sent, in records."""

    sent: int = 0
    dropped: int = 0
    faulty: int = 0


class Emulator:
    """Runs a device on a link.

    Parameters
    ----------
    device, link
        What is emulated, and where.
    faults, rng
        What goes wrong, and the numbers that decide when.
    speed
        Seconds of the scan in a second; records keep their device times.
    clock
        Seconds from anywhere.
    """

    def __init__(
        self,
        device: Device,
        link: Link,
        *,
        faults: Faults,
        rng: np.random.Generator,
        speed: float = 1.0,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._device, self._link = device, link
        self._faults, self._rng = faults, rng
        self._speed, self._clock = speed, clock
        self._waiting = bytearray()
        self._begun: float | None = None
        self._next = 0
        self.served = Served()
        self.unplugged = False

    def run(self, *, once: bool = False) -> Served:
        """Serve until the cable is pulled, or, with `once`, until a scan has been sent."""
        while not self.unplugged:
            finished = self._step()
            if once and finished and not self._waiting:
                break
        return self.served

    def _step(self) -> bool:
        """Wait for what comes first, deal with it; True when the scan has been sent."""
        writable = [self._link] if self._waiting else []
        readable, _, _ = select.select([self._link], writable, [], self._patience_s())
        if readable:
            self._hear()
        self._follow_device()
        if self._begun is not None:
            self._send_due((self._clock() - self._begun) * self._speed)
        self._pass_on()
        return self._begun is None and self._next > 0

    def _pass_on(self) -> None:
        if self._waiting and not self.unplugged:
            del self._waiting[: self._link.write(bytes(self._waiting))]

    def _patience_s(self) -> float:
        if self._begun is None or self._next >= len(self._device.times_s):
            return _IDLE_S
        due = self._begun + float(self._device.times_s[self._next] - self._device.times_s[0]) / self._speed
        return max(0.0, min(due - self._clock(), _IDLE_S))

    def _hear(self) -> None:
        was_there = self._link.connected()
        answer = self._device.hear(self._link.read())
        self._waiting += answer
        if was_there and not self._link.connected():
            self._begun = None
            self._waiting.clear()

    def _follow_device(self) -> None:
        """Begin with the first record when the device begins to stream, stop when it stops."""
        streaming = self._device.streaming and self._link.connected()
        if streaming and self._begun is None and not (self._next and self._next >= len(self._device.times_s)):
            self._begun, self._next, self.served = self._clock(), 0, Served()
        elif not streaming and self._begun is not None:
            self._begun, self._next = None, 0

    def _send_due(self, elapsed_s: float) -> None:
        times = self._device.times_s
        while self._next < len(times) and times[self._next] - times[0] <= elapsed_s:
            moment = float(times[self._next] - times[0])
            if self._faults.disconnect_s is not None and moment >= self._faults.disconnect_s:
                self._unplug()
                return
            self._send(self._device.record(self._next), moment)
            self._next += 1
            self._pass_on()  # at once: when this process was late, many are due and must not meet in the buffer
        if self._next >= len(times):
            self._waiting += self._device.end(self.served.sent, self.served.dropped)
            self._begun = None

    def _send(self, record: bytes, moment_s: float) -> None:
        if not record:
            return
        if self._faults.stalls(moment_s) or len(self._waiting) + len(record) > BUFFER_BYTES:
            self.served.dropped += 1
            return
        disturbed = self._faults.disturb(record, self._rng)
        self.served.faulty += disturbed != record
        self.served.sent += bool(disturbed)
        self._waiting += disturbed

    def _unplug(self) -> None:
        with contextlib.suppress(OSError):
            self._link.write(bytes(self._waiting))
        self._begun, self.unplugged = None, True
        self._link.close()
