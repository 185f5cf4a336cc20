"""Readings of devices, the tool that is followed, and clocks."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from typing import Final, NamedTuple

from tactile_bayes.scans import CountArray

# --- Device readings, independent of the protocol: frames, poses, identity and end of transmission.

Quaternion = tuple[float, float, float, float]
NO_ROTATION: Final = "no rotation"  #: Reason for a missing pose whose numbers are no position with a rotation.


class FrameReading(NamedTuple):
    """One frame of the array."""

    counts: CountArray  #: (rows, columns) uint16 array.
    device_ns: int  #: The head's clock.
    lost: int = 0  #: Frames missing just before this one, by the sequence numbers.
    restarted: bool = False
    """The sequence numbers do not go on from the frame before: the device has restarted, or its counter is damaged."""


class PoseReading(NamedTuple):
    """One pose of the tracker's sensor in `base`."""

    position_mm: tuple[float, float, float]
    quaternion_wxyz: Quaternion  #: Scalar first, as the device gave it: not normalised, sign free.
    device_ns: int | None = None  #: The tracker's clock; None when the protocol carries none.
    flags: tuple[str, ...] = ()
    """The device's objections to this pose, for example ``"error W"`` or ``"distortion 12"``."""
    tool: str = ""  #: Which of the tracker's tools or stations; empty where it names none.


class MissingReading(NamedTuple):
    """The tracker's word that it has no pose of a tool now."""

    why: str  #: In the tracker's words, for example ``"out of volume"``.
    tool: str = ""


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


Reading = FrameReading | PoseReading | MissingReading | HelloReading | EndReading


class Parser:
    """Base of the protocols' parsers: `feed` returns the readings that bytes complete."""

    fault = ""  #: Fault of the last record that could not be read; empty where nothing looked like a record.
    remark = ""  #: Remark on the records that were read; empty where they are as they should be.
    garbage_bytes = 0  #: Number of bytes so far that belong to no valid record.
    _rest = b""  #: Bytes that do not make a whole record yet.

    def feed(self, data: bytes) -> list[Reading]:
        """Parse `data`; return the completed readings."""
        raise NotImplementedError

    def _parts(self, data: bytes, end: bytes, longest: int) -> list[bytes]:
        """The parts of a line that `data` completes, each without its `end`; a longer one is noise, and dropped."""
        *parts, self._rest = (self._rest + data).split(end)
        if len(self._rest) > longest:
            self.garbage_bytes += len(self._rest)
            self._rest = b""
        return parts


class RecordParser(Parser):
    """Parser of records of a fixed length, of which `read` makes poses; after garbage it tries at the next byte."""

    def __init__(self, record_bytes: int, read: Callable[[bytes], PoseReading | None]) -> None:
        self.record_bytes, self._read = record_bytes, read

    def feed(self, data: bytes) -> list[Reading]:
        buffer, index, size = self._rest + data, 0, self.record_bytes
        poses: list[Reading] = []
        while len(buffer) - index >= size:
            pose = self._read(buffer[index : index + size])
            if pose is None:
                index += 1
                self.garbage_bytes += 1
            else:
                poses.append(pose)
                index += size
        self._rest = buffer[index:]
        return poses


def plausible(position_mm: Sequence[float], quaternion_wxyz: Sequence[float]) -> bool:
    """True when numbers can be a pose: finite, within 25 m, quaternion of unit length within tolerance."""
    if not all(map(math.isfinite, (*position_mm, *quaternion_wxyz))):
        return False
    return max(map(abs, position_mm)) < 25_000 and abs(math.hypot(*quaternion_wxyz) - 1) < 0.009


def printable(data: bytes) -> str:
    """Text of a device's bytes, with a question mark for each character that cannot be printed; zeros stay."""
    text = data.decode("utf-8", "replace").strip()
    return "".join(letter if letter.isprintable() or letter == "\0" else "?" for letter in text)


# --- The tool that is followed, relative to a reference tool where there is one.

# Longest time between a tool's pose and the reference's; a patient breathes 1 mm in this time at most.
REFERENCE_NS: Final = 50_000_000
_MOST_WORDS: Final = 16  #: Different words that are counted, of tools and of reasons; a device may make up more.
ToolReading = PoseReading | MissingReading


def tally(counted: Counter[str], word: str) -> None:
    """Count a word that a device sent; beyond `_MOST_WORDS` different ones it counts as ``others``."""
    counted[word if word in counted or len(counted) < _MOST_WORDS else "others"] += 1


class Follower:
    """Selects the readings of one tool from those of all tools of a tracker.

    Without a `tool` it follows the first one seen. With a `reference`, poses are relative to that tool's: fixed to the
    body, it takes breathing out. Its pose of the same moment is used, whichever of the two is sent first; where records
    carry no time, each pose of the reference serves one pose of the tool.
    """

    def __init__(self, tool: str | None = None, reference: str | None = None, *, inverse: bool = False) -> None:
        self.tool, self.reference = tool, reference
        self.other_tools: Counter[str] = Counter()  #: Number of readings of tools that are not followed.
        self._inverse = inverse
        self._waiting: tuple[PoseReading, int] | None = None  # a pose of the tool, with its arrival
        self._latest: tuple[PoseReading, int] | None = None  # the reference's latest pose, with its arrival
        self._unused = False  # no pose of the tool has been related to the latest one yet

    def take(self, reading: ToolReading, host_ns: int) -> Iterator[tuple[ToolReading, int]]:
        """Yield the readings of the tool that this reading completes, each with its arrival time."""
        if self.tool is None:
            self.tool = reading.tool
        if isinstance(reading, PoseReading) and self._inverse:
            reading = reading._replace(quaternion_wxyz=_conjugate(reading.quaternion_wxyz))
        if reading.tool == self.tool:
            yield from self._release()
            if self.reference is None or isinstance(reading, MissingReading):
                yield reading, host_ns
                return
            self._waiting, latest = (reading, host_ns), self._latest
            if latest is not None and (self._unused or latest[0].device_ns == reading.device_ns is not None):
                yield from self._release()
                self._unused = False
        elif reading.tool == self.reference:
            self._latest = (reading, host_ns) if isinstance(reading, PoseReading) else None
            self._unused = self._latest is not None and self._waiting is None
            yield from self._release()
        else:
            tally(self.other_tools, reading.tool)

    def _release(self) -> Iterator[tuple[ToolReading, int]]:
        if self._waiting is None:
            return
        (pose, host_ns), latest = self._waiting, self._latest
        self._waiting = None
        if latest is None or abs(host_ns - latest[1]) > REFERENCE_NS:
            yield MissingReading(f"no pose of {self.reference}", pose.tool), host_ns
        else:
            yield relative_pose(pose, latest[0]), host_ns


def relative_pose(pose: PoseReading, reference: PoseReading) -> PoseReading:
    """Convert a pose to the frame of a reference tool; the reference's flags are added to the pose's own."""
    size = math.hypot(*reference.quaternion_wxyz)
    w, i, j, k = (part / size for part in _conjugate(reference.quaternion_wxyz))
    x, y, z = (a - b for a, b in zip(pose.position_mm, reference.position_mm, strict=True))
    _, x, y, z = _product(_product((w, i, j, k), (0.0, x, y, z)), (w, -i, -j, -k))
    rotation = _product((w, i, j, k), pose.quaternion_wxyz)
    return pose._replace(position_mm=(x, y, z), quaternion_wxyz=rotation, flags=(*pose.flags, *reference.flags))


def _conjugate(quaternion_wxyz: Quaternion) -> Quaternion:
    w, i, j, k = quaternion_wxyz
    return w, -i, -j, -k


def _product(a: Quaternion, b: Quaternion) -> Quaternion:
    return (
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    )


# --- Continuous device times, and the tracker's times on the head's clock.

_WINDOW_NS: Final = 2_000_000_000
_S: Final = 1_000_000_000
# Files hold times as signed 64-bit ns. A clock that has counted for longer than this (146 years) loses whole periods.
LATEST_NS: Final = 1 << 62
AHEAD_NS: Final = 2 * _S  #: A record cannot be measured this much later than it arrives: its clock has stepped forward.
_SLIP_NS: Final = _S // 4  #: How well a wrap must agree with the time that passed on this computer.
MOST_STEPS: Final = 20  #: After this many steps the device's clock is not used any more.
STILL_NS: Final = _S // 10
# Periods of counters that wrap: 2^16 ms, 2^31 and 2^32 of ns, us and ms, 2^24 us, and clocks of a minute to a day.
WRAPS_NS: Final = tuple(
    sorted(
        [bits * unit for unit in (1, 1_000, 1_000_000) for bits in (1 << 31, 1 << 32)]
        + [(1 << 24) * 1_000, (1 << 16) * 1_000_000]
        + [seconds * _S for seconds in (60, 100, 1_000, 3_600, 86_400)]
    )
)


class ArrivalClock:
    """Offset of a device's clock from the host's, estimated from the arrival of its records.

    A record arrives at ``device time + offset + delay`` with a delay that is never negative: the least difference of
    the last seconds is the offset, and the rest is delay. It follows clocks that drift apart.
    """

    def __init__(self) -> None:
        self.begun_ns: int | None = None  #: Arrival with which this window of estimates began; None before any.
        self._last = self._now = 0

    @property
    def offset_ns(self) -> int:
        """Host time of device time 0."""
        return min(self._last, self._now)

    def observe(self, device_ns: int, host_ns: int) -> None:
        difference = host_ns - device_ns
        if self.begun_ns is None:
            self.begun_ns, self._last, self._now = host_ns, difference, difference
        elif host_ns - self.begun_ns > _WINDOW_NS:
            self.begun_ns, self._last, self._now = host_ns, self._now, difference
        else:
            self._now = min(self._now, difference)


class ClockTime(NamedTuple):
    """Time at which a record was measured, by the device's clock made continuous."""

    time_ns: int  #: 0 or more, never below the time before, below 2^63.
    event: str = ""  #: Step of the clock at this record, in words; empty where there was none.


class DeviceClock:
    """Continuous time from one device's time stamps, through wraps and restarts of its counter.

    A counter that wraps is unwrapped when its period is one of `WRAPS_NS` and agrees with the host's clock. Any other
    step, back or forward, is replaced by the time that passed on the host since, by `ArrivalClock`; from there the
    device's clock goes on. A clock that stands still for `STILL_NS`, or steps again and again, is replaced by the
    host's for good. Devices whose clocks count from one zero share an `arrival`.
    """

    def __init__(self, *, arrival: ArrivalClock | None = None) -> None:
        self.arrival = ArrivalClock() if arrival is None else arrival
        self.wraps = self.steps = 0
        self._trusted = True
        self._shift_ns = 0
        self._raw_ns: int | None = None
        self._host_ns = self._moved_ns = self._last_ns = 0

    def read(self, raw_ns: int, host_ns: int) -> ClockTime:
        """Time of a record stamped `raw_ns` that arrived at `host_ns`."""
        moment = self._first(raw_ns) if self._raw_ns is None else self._next(raw_ns, host_ns, self._raw_ns)
        if self._raw_ns is None or moment.time_ns > self._last_ns:
            self._moved_ns = host_ns
        self._raw_ns, self._host_ns, self._last_ns = raw_ns, host_ns, moment.time_ns
        self.arrival.observe(moment.time_ns, host_ns)
        return moment

    def _first(self, raw_ns: int) -> ClockTime:
        time_ns = raw_ns % LATEST_NS
        self._shift_ns = time_ns - raw_ns
        if time_ns == raw_ns:
            return ClockTime(time_ns)
        self.steps += 1
        return ClockTime(time_ns, f"the clock begins at {raw_ns / 1e9:.0f} s, taken as {time_ns / 1e9:.3f} s")

    def _next(self, raw_ns: int, host_ns: int, before_ns: int) -> ClockTime:
        time_ns = raw_ns + self._shift_ns
        if not self._trusted:
            return ClockTime(self._host_time(host_ns))
        if time_ns < self._last_ns:
            period_ns = wrap_period(before_ns, raw_ns, passed_ns=host_ns - self._host_ns)
            if period_ns is None:
                return self._step(raw_ns, host_ns, f"stepped back by {(before_ns - raw_ns) / 1e9:.3f} s")
            self.wraps += 1
            self._shift_ns += period_ns
            event = f"the clock wrapped after {period_ns / 1e9:.6f} s"
            return ClockTime(max(self._last_ns, raw_ns + self._shift_ns), event)
        if time_ns == self._last_ns and host_ns - self._moved_ns > STILL_NS:
            self._trusted = False
            return self._step(raw_ns, host_ns, "stood still")
        ahead_ns = time_ns + self.arrival.offset_ns - host_ns
        if ahead_ns > AHEAD_NS:
            return self._step(raw_ns, host_ns, f"stepped forward by {ahead_ns / 1e9:.3f} s")
        return ClockTime(time_ns)

    def _step(self, raw_ns: int, host_ns: int, event: str) -> ClockTime:
        time_ns = self._host_time(host_ns)
        self.steps += 1
        self._shift_ns = time_ns - raw_ns
        self._trusted = self._trusted and self.steps < MOST_STEPS
        stands_in = "is used for the step" if self._trusted else "is used from here on"
        return ClockTime(time_ns, f"the clock {event}, to {raw_ns / 1e9:.3f} s; this computer's clock {stands_in}")

    def _host_time(self, host_ns: int) -> int:
        """Time by the host's clock, never below the time before."""
        return max(self._last_ns, host_ns - self.arrival.offset_ns)


def wrap_period(before_ns: int, after_ns: int, *, passed_ns: int) -> int | None:
    """Period of `WRAPS_NS` that explains a counter's restart by the time passed, if any."""
    fits = (ns for ns in WRAPS_NS if before_ns < ns and abs(after_ns + ns - before_ns - passed_ns) < _SLIP_NS)
    return next(fits, None)


class PoseClock:
    """Converts the time of each pose to the head's clock, never running backwards.

    `shared`: both devices count from one zero (they are synchronised by wire, or one program emulates both), and the
    tracker's own time is taken as it is. Otherwise poses are placed by when they and the frames arrive; what is then
    left is the tracker's constant latency, which ``map --latency-ms`` takes away.
    """

    def __init__(self, *, shared: bool) -> None:
        self.head = DeviceClock()
        self.tracker = DeviceClock(arrival=self.head.arrival if shared else None)
        self._shared = shared
        self._last_ns = 0

    def time_of(self, device_ns: int | None, host_ns: int) -> ClockTime | None:
        """Time of a pose on the head's clock; None before the first frame, or when it would be negative."""
        if self._shared:
            return None if device_ns is None else self._in_order(self.tracker.read(device_ns, host_ns))
        if self.head.arrival.begun_ns is None:
            return None
        moment = ClockTime(host_ns)
        if device_ns is not None:
            measured = self.tracker.read(device_ns, host_ns)
            moment = ClockTime(measured.time_ns + self.tracker.arrival.offset_ns, measured.event)
        return self._in_order(moment._replace(time_ns=moment.time_ns - self.head.arrival.offset_ns))

    def _in_order(self, moment: ClockTime) -> ClockTime | None:
        if moment.time_ns < 0:
            return None
        self._last_ns = max(self._last_ns, moment.time_ns)
        return moment._replace(time_ns=self._last_ns)
