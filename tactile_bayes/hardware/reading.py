"""Process that reads one device: it waits, reads, adds time stamps and passes on.

Run as a file, with no package around it, so that it starts in 20 ms and holds nothing that could pause it:
``python reading.py DEVICE_FD PIPE_FD``. Each record on the pipe is ``host time u64 in ns (monotonic), bytes lost so far
u32, length u16, bytes``; a length of 0 says that the device has gone, and the process ends. The first record has the
length `READY` and no bytes: from then on nothing waits in the device's own small buffer.
"""

from __future__ import annotations

import contextlib
import gc
import os
import select
import signal
import struct
import sys
import time

RECORD = struct.Struct("<QIH")
# A record of at most PIPE_BUF bytes goes into the pipe whole or not at all, so a full pipe loses whole records.
MAX_DATA = select.PIPE_BUF - RECORD.size
READY = 0xFFFF
# Ctrl-C, Ctrl-Z, Ctrl-\, `kill`, a closed terminal: the recorder ends in order and needs what is on its way.
ENDING = (signal.SIGINT, signal.SIGTSTP, signal.SIGQUIT, signal.SIGTERM, signal.SIGHUP)
_LOOK_UP_S = 1.0


def read_device(device: int, pipe: int) -> None:
    """Pass on the bytes of `device` until it or the other end of the pipe has gone."""
    parent, lost = os.getppid(), 0
    os.set_blocking(device, False)
    os.set_blocking(pipe, False)
    with contextlib.suppress(BrokenPipeError):
        os.write(pipe, RECORD.pack(time.monotonic_ns(), 0, READY))
    while True:
        ready, _, _ = select.select([device], [], [], _LOOK_UP_S)
        if not ready:
            if os.getppid() != parent:
                return
            continue
        try:
            data = os.read(device, MAX_DATA)
        except BlockingIOError:
            continue
        except OSError:
            data = b""
        record = RECORD.pack(time.monotonic_ns(), lost, len(data)) + data
        try:
            os.write(pipe, record)
        except BlockingIOError:
            lost = (lost + len(data)) % 2**32  # the pipe is full: told with the next record
        except BrokenPipeError:
            return
        if not data:
            return


def ask_for_priority() -> None:
    """Raise this process's priority where the system allows it; a reader sleeps most of the time."""
    try:
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))
    except (AttributeError, OSError):
        with contextlib.suppress(OSError):
            os.nice(-10)


def main() -> None:
    """Run the reader with the garbage collector frozen."""
    for number in ENDING:
        signal.signal(number, signal.SIG_IGN)  # for the recorder
    signal.signal(signal.SIGPIPE, signal.SIG_IGN)
    ask_for_priority()
    gc.freeze()
    gc.disable()
    read_device(int(sys.argv[1]), int(sys.argv[2]))


if __name__ == "__main__":
    main()
