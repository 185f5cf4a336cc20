"""Feed of a recording to its live view, through a pipe on which the recorder never waits.

A message is ``kind u8, length u32, payload``; one that does not fit is left out, and the view misses it while the file
does not.
"""

from __future__ import annotations

import fcntl
import json
import os
import select
import struct
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import asdict
from typing import Any, Final, NamedTuple

import numpy as np

from tactile_bayes.geometry import FloatArray
from tactile_bayes.hardware.account import Report
from tactile_bayes.hardware.readings import CountArray, PoseReading
from tactile_bayes.hardware.streams import PIPE_BYTES

FRAME: Final = 1
POSE: Final = 2
REPORT: Final = 3
LANDMARK: Final = 4
_HEADER: Final = struct.Struct("<BI")
_TIMES: Final = struct.Struct("<qq")  # device ns, host ns (monotonic)
_POSE: Final = struct.Struct("<q7d")
_POINT: Final = struct.Struct("<3d")


class SeenFrame(NamedTuple):
    """One frame, with the device's and the host's time of its recording."""

    counts: CountArray
    device_ns: int
    host_ns: int


class SeenPose(NamedTuple):
    """One pose on the head's clock."""

    device_ns: int
    position_mm: tuple[float, ...]
    quaternion_wxyz: tuple[float, ...]


class SeenLandmark(NamedTuple):
    """One landmark, ``sternal_notch``, ``xiphoid`` or ``nipple``, in `base`."""

    name: str
    position_mm: tuple[float, ...]


Seen = SeenFrame | SeenPose | SeenLandmark | dict[str, Any]


class Feed:
    """The recorder's end of the feed; an `Observer`.

    Parameters
    ----------
    pipe
        File descriptor to write to.
    """

    def __init__(self, pipe: int) -> None:
        self._pipe = pipe
        self.missed = 0
        os.set_blocking(pipe, False)
        with suppress(OSError, AttributeError):
            fcntl.fcntl(pipe, fcntl.F_SETPIPE_SZ, PIPE_BYTES)

    def frame(self, counts: CountArray, device_ns: int) -> None:
        """Send a recorded frame."""
        times = _TIMES.pack(device_ns, time.monotonic_ns())
        self._send(FRAME, times + struct.pack("<BB", *counts.shape) + counts.astype("<u2").tobytes())

    def pose(self, pose: PoseReading, device_ns: int) -> None:
        """Send a recorded pose."""
        self._send(POSE, _POSE.pack(device_ns, *pose.position_mm, *pose.quaternion_wxyz))

    def landmark(self, name: str, position_mm: FloatArray) -> None:
        """Send a landmark, touched or read from a file."""
        self._send(LANDMARK, _POINT.pack(*position_mm.tolist()) + name.encode())

    def told(self, report: Report) -> None:
        """Send the account so far."""
        self._send(REPORT, json.dumps(asdict(report)).encode()[: select.PIPE_BUF - _HEADER.size])

    def _send(self, kind: int, payload: bytes) -> None:
        message = _HEADER.pack(kind, len(payload)) + payload
        if len(message) > select.PIPE_BUF:  # could go in by halves
            self.missed += 1
            return
        try:
            os.write(self._pipe, message)
        except BlockingIOError:
            self.missed += 1
        except BrokenPipeError:
            self.missed += 1  # the view was closed; the recording goes on

    def close(self) -> None:
        """Close the feed; the view ends after reading the rest of the pipe."""
        os.close(self._pipe)


class FeedReader:
    """The live view's end of the feed.

    Parameters
    ----------
    pipe
        File descriptor to read from.
    """

    def __init__(self, pipe: int) -> None:
        self.pipe = pipe
        self.ended = False
        self._rest = b""
        os.set_blocking(pipe, False)

    def read(self, wait_s: float) -> list[Seen]:
        """Read what comes within a time; sets `ended` when the recorder has gone.

        It does not return with the first message: taken one by one, frames cost eight times as much.
        """
        time.sleep(wait_s)
        data = b""
        with suppress(BlockingIOError):
            while piece := os.read(self.pipe, PIPE_BYTES):
                data += piece
            self.ended = True
        return list(self._messages(data))

    def _messages(self, data: bytes) -> Iterator[Seen]:
        buffer, place = self._rest + data, 0
        while len(buffer) - place >= _HEADER.size:
            kind, length = _HEADER.unpack_from(buffer, place)
            start = place + _HEADER.size
            if len(buffer) - start < length:
                break
            place = start + length
            yield _decode(kind, buffer[start:place])
        self._rest = buffer[place:]


def _decode(kind: int, payload: bytes) -> Seen:
    if kind == FRAME:
        device_ns, host_ns = _TIMES.unpack_from(payload)
        shape = (payload[_TIMES.size], payload[_TIMES.size + 1])
        counts = np.frombuffer(payload, dtype="<u2", offset=_TIMES.size + 2).reshape(shape)
        return SeenFrame(counts, device_ns, host_ns)
    if kind == POSE:
        device_ns, *values = _POSE.unpack(payload)
        return SeenPose(device_ns, tuple(values[:3]), tuple(values[3:]))
    if kind == LANDMARK:
        return SeenLandmark(payload[_POINT.size :].decode(), _POINT.unpack_from(payload))
    return dict(json.loads(payload))
