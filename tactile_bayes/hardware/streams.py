"""The recorder's end of a reading process: pipe, bytes with arrival times, losses."""

from __future__ import annotations

import contextlib
import fcntl
import os
import select
import subprocess
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, NamedTuple

from tactile_bayes.hardware import reading
from tactile_bayes.hardware.ports import Port

# Room for six seconds of a head at 200 Hz while the writer waits for the disk.
PIPE_BYTES: Final = 1 << 20
# A reader starts in 20 ms; on a busy computer it may take seconds.
READY_S: Final = 15.0


class Piece(NamedTuple):
    """Bytes of a device with the host's time of reading (monotonic ns)."""

    host_ns: int
    data: bytes


@dataclass(slots=True)
class Stream:
    """A device read by a process of its own.

    Parameters
    ----------
    process
        The reader.
    pipe
        Where its records come out; not blocking.
    overrun_bytes
        Bytes that the reader had to drop because the pipe was full.
    ready
        The reader has begun to read.
    ended
        The device has gone, or the reader has.
    """

    process: subprocess.Popen[bytes]
    pipe: int
    overrun_bytes: int = 0
    ready: bool = False
    ended: bool = False
    cpu_s: float = 0.0
    _rest: bytes = field(default=b"", repr=False)

    def fileno(self) -> int:
        """File descriptor for `select`."""
        return self.pipe

    def wait_until_ready(self, timeout_s: float = READY_S) -> None:
        """Wait until the reader reads: before, a device's data would pile up in a buffer of 4 KiB.

        A reader that takes longer is waited for no more; what it loses is counted. What comes meanwhile is not asked
        for: devices are told to send afterwards.
        """
        end = time.monotonic() + timeout_s
        while not (self.ready or self.ended) and (left := end - time.monotonic()) > 0:
            if select.select([self], [], [], left)[0]:
                self.read()

    def read(self) -> list[Piece]:
        """Read the pieces that have come; sets `ended` after the last."""
        try:
            data = os.read(self.pipe, PIPE_BYTES)
        except BlockingIOError:
            return []
        if not data:
            self.ended = True
            return []
        pieces, place, buffer = [], 0, self._rest + data
        size = reading.RECORD.size
        while len(buffer) - place >= size:
            host_ns, lost, length = reading.RECORD.unpack_from(buffer, place)
            if length == reading.READY:
                self.ready, place = True, place + size
                continue
            if len(buffer) - place - size < length:
                break
            self.overrun_bytes = lost
            start = place + size
            place = start + length
            if length:
                pieces.append(Piece(host_ns, buffer[start:place]))
            else:
                self.ended = True
        self._rest = buffer[place:]
        return pieces

    def stop(self) -> None:
        """Stop the reader; what it has passed on can still be read."""
        with contextlib.suppress(ProcessLookupError):
            self.process.kill()  # it ignores what a terminal or a service manager sends to all of a recording

    def close(self) -> None:
        """Stop the reader, add up its CPU time, and close the pipe."""
        self.stop()
        if self.process.returncode is None:
            _, status, usage = os.wait4(self.process.pid, 0)
            self.process.returncode = os.waitstatus_to_exitcode(status)
            self.cpu_s = usage.ru_utime + usage.ru_stime
        os.close(self.pipe)


def read_in_process(port: Port) -> Stream:
    """Start a process that reads a port."""
    ours, theirs = os.pipe()
    os.set_blocking(ours, False)
    if hasattr(fcntl, "F_SETPIPE_SZ"):
        with contextlib.suppress(OSError):  # a user's pipes may be limited; the rest is only shorter
            fcntl.fcntl(ours, fcntl.F_SETPIPE_SZ, PIPE_BYTES)
    with port.descriptor() as device:
        process = subprocess.Popen(
            [sys.executable, "-I", "-S", str(Path(reading.__file__)), str(device), str(theirs)],
            pass_fds=(device, theirs),
            stdin=subprocess.DEVNULL,
        )
    os.close(theirs)
    return Stream(process, ours)
