"""NDI Polaris, Vega and Aurora trackers, through the combined API library `ndicapi` (extra ``[ndi]``).

These trackers answer questions and send nothing by themselves. A process of its own asks the tracker for every new
frame and speaks the open framing to this program, so that to everybody else it is a tracker like any other. The library
holds the interpreter while it waits for the line, which is one more reason for a process.
"""

from __future__ import annotations

import importlib
import os
import select
import socket
import subprocess
import sys
import time
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final

from tactile_bayes.errors import DeviceError
from tactile_bayes.hardware import head
from tactile_bayes.hardware.head import PacketParser
from tactile_bayes.hardware.ports import Port
from tactile_bayes.hardware.readings import HelloReading, PoseReading, plausible

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
    """A connected NDI tracker that follows one tool.

    Parameters
    ----------
    api
        The module ``ndicapy``, or one that does the same.
    url
        A serial device, or ``socket://HOST:PORT``.
    rom
        Description of a wireless tool; tools on a wire bring their own.

    Raises
    ------
    DeviceError
        When the tracker does not answer, refuses a command, or has no tool.
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
        """Next pose; None while there is no new one, or the tool is out of sight.

        Raises
        ------
        DeviceError
            When the tracker has not answered several times in a row.
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
    """An NDI tracker in a process of its own, as a port in the open framing.

    Raises
    ------
    DeviceError
        When the extra is missing, or the tracker cannot be set up.
    """

    def __init__(self, url: str, *, rom: Path | None = None) -> None:
        self.url, self.baud, self.role = url, 0, "tracker"
        self._relayed = None
        if find_spec(MODULE) is None:
            raise DeviceError(f"{self.name}: needs the package ndicapi; pip install 'tactile-bayes[ndi]'")
        ours, theirs = socket.socketpair()
        words = [
            sys.executable,
            "-m",
            "tactile_bayes.hardware.ndi",
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
    """Run ``python -m tactile_bayes.hardware.ndi FD URL [ROM]``: prints ``ready``, or what is wrong."""
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
