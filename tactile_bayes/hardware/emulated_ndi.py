"""Emulated NDI tracker: the commands of the combined API that a host needs to follow one tool.

A command is ``NAME:arguments`` and a CRC-16 in hexadecimal, or ``NAME arguments`` without, and a carriage return; so is
an answer. ``BX`` is answered in binary. References: NDI Combined API guide; CRC-16/ARC.
"""

from __future__ import annotations

import struct
import time
from collections.abc import Callable
from typing import Final

import numpy as np

from tactile_bayes.scan import TrackerPoses

HANDLE: Final = 0x0A
_VALID, _MISSING = 0x01, 0x02
_PORT_STATUS: Final = 0x31  # a tool in the port, initialised and enabled
_START: Final = 0xA5C4
_BAD_CRC, _UNKNOWN, _NOT_NOW = 0x04, 0x01, 0x0C
_POLYNOMIAL: Final = 0xA001
_LONGEST: Final = 4096


def crc16(data: bytes) -> int:
    """CRC-16/ARC; of ``123456789`` it is 0xBB3D."""
    crc = 0
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (_POLYNOMIAL if crc & 1 else 0)
    return crc


class EmulatedNdi:
    """NDI tracker that answers with the pose of the present time, counted from TSTART; it never sends unasked.

    Parameters
    ----------
    poses
        What it measures, one frame each.
    hold
        Only every n-th is measured anew.
    wireless
        The tool has to be described by the host first.
    clock
        Seconds from anywhere.
    elapsed
        Seconds of the scan that other devices play too, None while it waits; by default the scan begins with TSTART.
    """

    starts = 0
    streaming = stopped = said_end = False

    def __init__(
        self,
        poses: TrackerPoses,
        *,
        hold: int = 1,
        wireless: bool = False,
        clock: Callable[[], float] = time.monotonic,
        elapsed: Callable[[], float | None] | None = None,
    ) -> None:
        self.times_s = poses.time_s
        self._elapsed = elapsed
        self.described = b""
        self._poses, self._hold, self._clock = poses, max(1, hold), clock
        self._begun: float | None = None
        self._port = "none" if wireless else "plugged in"
        self._rest = b""

    def hear(self, data: bytes) -> bytes:
        """Process commands and return the answers."""
        *lines, rest = (self._rest + data).split(b"\r")
        self._rest = rest[-_LONGEST:]
        return b"".join(self._answer(line) for line in lines)

    def greet(self) -> None:
        """Do nothing on a connection."""

    def record(self, index: int) -> bytes:
        """Return nothing: records are sent on request only."""
        del index
        return b""

    def end(self, sent: int, dropped: int) -> bytes:
        """Return nothing: there is no last message."""
        del sent, dropped
        return b""

    def _answer(self, line: bytes) -> bytes:
        name, colon, rest = line.partition(b":")
        if colon:
            body, told = line[:-4], line[-4:]
            if told != b"%04X" % crc16(body):
                return _text(f"ERROR{_BAD_CRC:02X}")
            rest = body[len(name) + 1 :]
        else:
            name, _, rest = line.partition(b" ")
        if name == b"BX":
            return self._poses_now()
        done = self._do(name.decode("latin-1"), rest.decode("latin-1"))
        return _text(f"ERROR{_UNKNOWN:02X}" if done is None else done)

    def _do(self, name: str, rest: str) -> str | None:
        """Answer to one command; None for an unknown one."""
        match name:
            case "INIT" | "COMM" | "TSTOP":
                self._begun = None if name != "COMM" else self._begun
            case "TSTART":
                self._begun = self._clock()
            case "VER":
                return "Emulated NDI tracker\nfor tests"
            case "PHSR":
                return self._handles(int(rest or "0", 16))
            case "PHRQ":
                self._port = "asked for"
                return f"{HANDLE:02X}"
            case "PVWR":
                self.described += bytes.fromhex(rest[6:])
                self._port = "plugged in"
            case "PINIT":
                self._port = "initialised"
            case "PENA":
                self._port = "enabled"
            case "PHF":
                self._port = "none"
            case _:
                return None
        return "OKAY"

    def _handles(self, kind: int) -> str:
        wanted = {0: None, 1: "to be freed", 2: "plugged in", 3: "initialised", 4: "enabled"}.get(kind)
        listed = self._port != "none" if wanted is None else self._port == wanted
        return f"01{HANDLE:02X}{_PORT_STATUS:03X}" if listed else "00"

    def _poses_now(self) -> bytes:
        if self._begun is None or self._port != "enabled":
            return _text(f"ERROR{_NOT_NOW:02X}")
        elapsed = self._clock() - self._begun if self._elapsed is None else self._elapsed() or 0.0
        index = int(np.searchsorted(self.times_s - self.times_s[0], elapsed, side="right")) - 1
        index -= index % self._hold
        if elapsed > self.times_s[-1] - self.times_s[0] + 0.1:  # the tool is put away
            body = struct.pack("<BBBII", 1, HANDLE, _MISSING, _PORT_STATUS, len(self.times_s) + 1)
        else:
            numbers = (*self._poses.quaternion_wxyz[index], *self._poses.position_mm[index], 0.1)
            body = struct.pack("<BBB8fII", 1, HANDLE, _VALID, *map(float, numbers), _PORT_STATUS, index + 1)
        header = struct.pack("<HH", _START, len(body))
        return header + crc16(header).to_bytes(2, "little") + body + crc16(body).to_bytes(2, "little")


def _text(words: str) -> bytes:
    return b"%b%04X\r" % (words.encode(), crc16(words.encode()))
