"""A serial port served over TCP by pyserial's own server of RFC 2217, for the tests of `rfc2217://`."""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections.abc import Iterator

import serial
import serial.rfc2217


class _Pty(serial.Serial):
    """A pseudo-terminal has no modem lines, which the server asks for."""

    cts = dsr = ri = cd = False

    def _update_dtr_state(self) -> None:
        """There is no such line."""

    _update_rts_state = _update_dtr_state


@contextlib.contextmanager
def rfc2217(path: str) -> Iterator[str]:
    """Serve the serial device at `path` to one host at a time; the URL."""
    listener = socket.create_server(("127.0.0.1", 0))
    stop = threading.Event()
    thread = threading.Thread(target=_serve, args=(listener, path, stop), daemon=True)
    thread.start()
    host, port = listener.getsockname()
    try:
        yield f"rfc2217://{host}:{port}"
    finally:
        stop.set()
        listener.close()
        thread.join(5.0)
        assert not thread.is_alive()


def _serve(listener: socket.socket, path: str, stop: threading.Event) -> None:
    listener.settimeout(0.1)
    while not stop.is_set():
        try:
            host, _ = listener.accept()
        except TimeoutError:
            continue
        except OSError:
            return
        with host, _Pty(path, 115200, timeout=0) as device:
            host.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            manager = serial.rfc2217.PortManager(device, _Connection(host))
            back = threading.Thread(target=_send_back, args=(device, host, manager, stop), daemon=True)
            back.start()
            with contextlib.suppress(OSError):
                while not stop.is_set():
                    host.settimeout(0.1)
                    try:
                        data = host.recv(4096)
                    except TimeoutError:
                        continue
                    if not data:
                        break
                    device.write(b"".join(manager.filter(data)))
            host.close()
            back.join(5.0)


class _Connection:
    """What the server writes its negotiation to."""

    def __init__(self, host: socket.socket) -> None:
        self.write = host.sendall


def _send_back(
    device: serial.Serial, host: socket.socket, manager: serial.rfc2217.PortManager, stop: threading.Event
) -> None:
    with contextlib.suppress(OSError, serial.SerialException):
        while not stop.is_set() and host.fileno() >= 0:
            data = device.read(4096)
            if data:
                host.sendall(b"".join(manager.escape(data)))
            else:
                time.sleep(0.001)
