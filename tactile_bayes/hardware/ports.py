"""Ports and the processes that read them."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import re
import select
import socket
import subprocess
import sys
import termios
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import serial
from serial.tools.list_ports import comports

from tactile_bayes.errors import DeviceError
from tactile_bayes.hardware import reading

# --- Ports by URL: a serial device, a socket, or another program's terminal.

ANSWER_S = 2.5  #: How long a device may take to answer.
SILENT_S: Final = 3.0  #: Without a byte for so long a device has gone.
_SHOWN_BYTES: Final = 12
_SOCKET_BYTES: Final = 65536
_MOST_DRAINED: Final = 4096
# Longest wait of one read. It is never changed: with rfc2217 each change would be negotiated.
_READ_S: Final = 0.01
# Errors of a call on a device that has vanished; a terminal's own error is no OSError.
GONE: Final = (OSError, serial.SerialException, termios.error)
# In "[Errno 111] Connection refused" and "(25, 'Inappropriate ioctl for device')".
_ERROR_NUMBER: Final = re.compile(r"(?:\[Errno |\()(\d+)[\],]")
_NETWORK: Final = ("socket://", "rfc2217://")  #: Beginnings of URLs that name a host and a port.


class Port:
    """A port by its URL: ``/dev/ttyUSB0``, ``socket://host:port``, ``rfc2217://host:port`` or pyserial's ``loop://``.

    `role`, ``head`` or ``tracker``, is for messages.
    """

    def __init__(self, url: str, *, baud: int, role: str) -> None:
        self.url = url
        self.baud = baud
        self.role = role
        self._serial = _open(url, baud, role)
        self._is_socket = url.startswith("socket://")
        self._relayed: socket.socket | None = None

    @property
    def name(self) -> str:
        """Name for messages."""
        return f"{self.role} {self.url}"

    @property
    def has_line_rate(self) -> bool:
        """True when the line has a baud rate: sockets have none."""
        return not self.url.startswith(("socket://", "rfc2217://", "loop://"))

    @property
    def remedy(self) -> str:
        """Advice for when the device has gone."""
        return "check its cable" if self.has_line_rate else "check that its program runs"

    def write(self, data: bytes) -> None:
        """Send bytes; `DeviceError` if the device has gone."""
        try:
            self._serial.write(data)
            self._serial.flush()
        except GONE as error:
            raise DeviceError(f"{self.name}: cannot be written to ({reason(error)}); {self.remedy}") from None

    def read_some(self, timeout_s: float) -> bytes:
        """Return the first bytes that come within the time; empty when nothing came."""
        end = time.monotonic() + timeout_s
        try:
            while True:
                data: bytes = self._serial.read(1)
                if data:
                    return data + self._waiting()
                if time.monotonic() >= end:
                    return b""
        except GONE as error:
            raise DeviceError(f"{self.name}: cannot be read ({reason(error)}); {self.remedy}") from None

    def _waiting(self) -> bytes:
        """Read the bytes that have come already."""
        if not self._is_socket:
            return bytes(self._serial.read(self._serial.in_waiting))
        number = self._serial.fileno()  # pyserial does not count a socket's bytes, and loses those before its end
        return os.read(number, _SOCKET_BYTES) if select.select([number], [], [], 0)[0] else b""

    def drain(self) -> bytes:
        """Read until the line is quiet, at most 2 s; returns the first bytes."""
        end, received = time.monotonic() + 2.0, b""
        while time.monotonic() < end and (data := self.read_some(0.05)):
            received += data[: _MOST_DRAINED - len(received)]
        return received

    @contextlib.contextmanager
    def descriptor(self) -> Iterator[int]:
        """File descriptor that a reading process can inherit.

        A port without one (rfc2217, loop) is read by a thread here that passes its bytes on; under load a thread may be
        late where a process is not.
        """
        number = None
        with contextlib.suppress(AttributeError, OSError, TypeError):
            number = int(self._serial.fileno())
        if number is not None:
            yield number
            return
        self._relayed, far = socket.socketpair()
        threading.Thread(target=_relay, args=(self._serial, self._relayed), daemon=True).start()
        with far:
            yield far.fileno()

    def close(self) -> None:
        """Close the port; no error if the device has gone already."""
        with contextlib.suppress(*GONE):
            self._serial.close()
        if self._relayed is not None:
            self._relayed.close()


def _open(url: str, baud: int, role: str) -> Any:
    if url.startswith(_NETWORK):
        scheme, _, address = url.partition("://")
        number = re.search(r":(\d+)(?:[/?].*)?$", address)
        if number is None or int(number[1]) > 65535:
            raise DeviceError(f"{role} {url}: not a port (no port number up to 65535); give {scheme}://HOST:PORT")
    try:
        port = serial.serial_for_url(url, baudrate=baud, timeout=_READ_S, do_not_open=True)
        if "://" not in url:
            port.exclusive = True  # two programs that read one port get half of it each
        if not url.startswith(("socket://", "loop://")):
            port.rts = False  # high holds a Flock of Birds in reset
        port.open()
    except ValueError as error:
        fault = f"{role} {url}: not a port ({error}); give /dev/ttyUSB0, socket://HOST:PORT or rfc2217://HOST:PORT"
        raise DeviceError(fault) from None
    except GONE as error:
        fault = f"{role} {url}: cannot be opened ({reason(error)}); `tactile-bayes devices` lists what is there"
        raise DeviceError(fault) from None
    return port


def _relay(port: Any, sink: socket.socket) -> None:
    with contextlib.suppress(*GONE, TypeError):
        while True:
            data = port.read(1)
            if data:
                sink.sendall(data + port.read(port.in_waiting))


def reason(error: Exception) -> str:
    """The system's error text, also where pyserial wraps it in a text of its own."""
    number = error.args[0] if isinstance(error, termios.error) else getattr(error, "errno", None)
    if not isinstance(number, int):
        wrapped = _ERROR_NUMBER.search(str(error))
        number = int(wrapped[1]) if wrapped else 0
    if number in (errno.EAGAIN, errno.EBUSY):  # of the lock on a port
        return "another program has it open"
    # a resolver's numbers are below 0, and its words stand behind them
    return os.strerror(number) if number > 0 else str(error).split("] ")[-1].split(": ")[-1].strip("[]()'\" ")


def preview(data: bytes) -> str:
    """Beginning of received bytes for a message: as text if printable, else as hex."""
    if not data:
        return "nothing"
    part = data[:_SHOWN_BYTES]
    more = "..." if len(data) > _SHOWN_BYTES else ""
    if all(0x20 <= byte < 0x7F or byte in b"\r\n" for byte in part):
        return repr(part.decode()) + more
    return part.hex(" ") + more


# --- The system's serial ports, and a guess at the devices on them.

_TRACKER_MAKERS: Final = {0x0F44: "Polhemus"}  #: USB vendors, by what they make.
_CONTROLLERS: Final = {
    0x2341: "Arduino",
    0x16C0: "Teensy",
    0x2E8A: "Raspberry Pi Pico",
    0x0483: "ST",
    0x303A: "Espressif",
    0x1366: "SEGGER",
    0x239A: "Adafruit",
}
_ADAPTERS: Final = {0x0403: "FTDI", 0x10C4: "Silicon Labs", 0x067B: "Prolific", 0x1A86: "WCH"}


def list_ports() -> list[str]:
    """The system's ports in order, each with its description and a guess from its USB ids; opens none of them."""
    ports = sorted(comports(), key=lambda port: (port.device, port.description or ""))
    return [f"{one.device}  {one.description or ''}: {guess_device(one.vid, one.product or '')}" for one in ports]


def guess_device(vendor: int | None, product: str) -> str:
    """Guess the device on a port from its USB vendor and product name."""
    if vendor in _TRACKER_MAKERS:
        return f"tracker ({_TRACKER_MAKERS[vendor]})"
    if vendor in _CONTROLLERS or "head" in product.lower():
        return f"scan head, perhaps ({_CONTROLLERS.get(vendor or 0, product)})"
    return f"tracker on a serial adapter, perhaps ({_ADAPTERS[vendor]})" if vendor in _ADAPTERS else "unknown"


# --- The recorder's end of a reading process: pipe, bytes with arrival times, losses.

PIPE_BYTES: Final = 1 << 20  #: Room for six seconds of a head at 200 Hz while the writer waits for the disk.
READY_S: Final = 15.0  #: A reader starts in 20 ms; on a busy computer it may take seconds.


@dataclass(slots=True)
class Stream:
    """Stream of a device that is read by a process of its own."""

    process: subprocess.Popen[bytes]
    pipe: int  #: Pipe with the process's records; not blocking.
    overrun_bytes: int = 0  #: Bytes that the reader had to drop because the pipe was full.
    ready: bool = False  #: The reader has begun to read.
    ended: bool = False  #: The device has gone, or the reader has.
    _rest: bytes = field(default=b"", repr=False)

    def fileno(self) -> int:
        return self.pipe

    def wait_until_ready(self) -> None:
        """Wait until the reader reads: before, a device's data would pile up in a buffer of 4 KiB.

        After `READY_S` the recording begins without it, and bytes that it loses are counted. Devices are told to send
        only afterwards, so that what comes meanwhile may be dropped.
        """
        end = time.monotonic() + READY_S
        while not (self.ready or self.ended) and (remaining_s := end - time.monotonic()) > 0:
            if select.select([self], [], [], remaining_s)[0]:
                self.read()

    def read(self, most: int = PIPE_BYTES) -> list[tuple[int, bytes]]:
        """Read at most `most` bytes as pieces of data with host times (monotonic ns); sets `ended` after the last."""
        try:
            data = os.read(self.pipe, most)
        except BlockingIOError:
            return []
        if not data:
            self.ended = True
            return []
        pieces, index, buffer = [], 0, self._rest + data
        size = reading.RECORD.size
        while len(buffer) - index >= size:
            host_ns, lost, length = reading.RECORD.unpack_from(buffer, index)
            if length == reading.READY:
                self.ready, index = True, index + size
                continue
            if len(buffer) - index - size < length:
                break
            self.overrun_bytes = lost
            start = index + size
            index = start + length
            if length:
                pieces.append((host_ns, buffer[start:index]))
            else:
                self.ended = True
        self._rest = buffer[index:]
        return pieces

    def stop(self) -> None:
        """Stop the reader; what it has passed on can still be read."""
        with contextlib.suppress(ProcessLookupError):
            self.process.kill()  # it ignores what a terminal or a service manager sends to all of a recording

    def close(self) -> None:
        """Stop the reader and close the pipe."""
        self.stop()
        self.process.wait()
        os.close(self.pipe)


def read_in_process(port: Port) -> Stream:
    """Start a process that reads a port."""
    ours, theirs = os.pipe()
    os.set_blocking(ours, False)
    with contextlib.suppress(OSError, AttributeError):  # macOS has no such size, and a user may be limited
        fcntl.fcntl(ours, fcntl.F_SETPIPE_SZ, PIPE_BYTES)
    with port.descriptor() as device:
        process = subprocess.Popen(
            [sys.executable, "-I", "-S", str(Path(reading.__file__)), str(device), str(theirs)],
            pass_fds=(device, theirs),
            stdin=subprocess.DEVNULL,
        )
    os.close(theirs)
    return Stream(process, ours)
