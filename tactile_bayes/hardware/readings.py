"""Device readings, independent of the protocol: frames, poses, identity and end of transmission."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

CountArray = NDArray[np.uint16]
MM_PER_INCH: Final = 25.4


class FrameReading(NamedTuple):
    """One frame of the array.

    Parameters
    ----------
    counts : (rows, columns) uint16 array
    device_ns
        The head's clock.
    lost
        Frames missing just before this one, by the sequence numbers.
    restarted
        The sequence numbers do not go on from the frame before: the device has restarted, or its counter is damaged.
    """

    counts: CountArray
    device_ns: int
    lost: int = 0
    restarted: bool = False


class PoseReading(NamedTuple):
    """One pose of the tracker's sensor in `base`.

    Parameters
    ----------
    position_mm
        Converted from the device's unit.
    quaternion_wxyz
        Scalar first, as the device gave it: not normalised, sign free.
    device_ns
        The tracker's clock; None when the protocol carries none.
    flags
        What the device said against this pose, for example ``"error W"`` or ``"distortion 12"``.
    station
        Number of the sensor.
    """

    position_mm: tuple[float, float, float]
    quaternion_wxyz: tuple[float, float, float, float]
    device_ns: int | None = None
    flags: tuple[str, ...] = ()
    station: int = 1


class HelloReading(NamedTuple):
    """Identity that a device reports."""

    device_id: str
    rows: int
    columns: int
    saturation_count: int
    rate_hz: float


class EndReading(NamedTuple):
    """End of transmission, with the device's own count of measured and dropped records."""

    sent: int
    dropped: int


Reading = FrameReading | PoseReading | HelloReading | EndReading


class Parser(Protocol):
    """Interface of a protocol's parser."""

    @property
    def garbage_bytes(self) -> int:
        """Number of bytes so far that belong to no valid record."""

    def feed(self, data: bytes) -> list[Reading]:
        """Parse `data`; return the completed readings."""


class RecordParser:
    """Parser of fixed-length records; after garbage it tries again at each next byte.

    A subclass sets `record_bytes` and says what `_record` makes of that many bytes.
    """

    record_bytes: int

    def __init__(self) -> None:
        self.garbage_bytes = 0
        self._rest = b""

    def feed(self, data: bytes) -> list[Reading]:
        """Parse `data`; return the completed poses."""
        buffer, place, size = self._rest + data, 0, self.record_bytes
        found: list[Reading] = []
        while len(buffer) - place >= size:
            pose = self._record(buffer[place : place + size])
            if pose is None:
                place += 1
                self.garbage_bytes += 1
            else:
                found.append(pose)
                place += size
        self._rest = buffer[place:]
        return found

    def _record(self, record: bytes) -> PoseReading | None:
        """Parse one record; None when the bytes are not a record."""
        raise NotImplementedError


def plausible(position_mm: Sequence[float], quaternion_wxyz: Sequence[float]) -> bool:
    """Whether numbers can be a pose: finite, within 25 m, quaternion of unit length within tolerance."""
    if not all(map(math.isfinite, (*position_mm, *quaternion_wxyz))):
        return False
    return max(map(abs, position_mm)) < 25_000 and abs(math.hypot(*quaternion_wxyz) - 1) < 0.009


# More missing records than this are no loss: a silent device ends a recording long before.
MOST_LOST: Final = 100_000


class SequenceCheck:
    """Counts missing records by a 32-bit counter that wraps.

    Parameters
    ----------
    lost, restarts
        Records missing so far; how often the counter went back, or forward by more than `MOST_LOST`.
    """

    def __init__(self) -> None:
        self._expected: int | None = None
        self.lost = 0
        self.restarts = 0

    def missing_before(self, sequence: int) -> int:
        """Number missing just before `sequence`; 0 when the counter restarted or is damaged."""
        expected = sequence if self._expected is None else self._expected
        gap = (sequence - expected) % 2**32
        self._expected = (sequence + 1) % 2**32
        if gap > MOST_LOST:
            self.restarts += 1
            return 0
        self.lost += gap
        return gap
