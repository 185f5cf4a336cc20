"""Trackers on a serial line, and all drivers by name."""

from __future__ import annotations

import math
import re
import struct
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Final, NamedTuple

from tactile_bayes.declarations import Record
from tactile_bayes.errors import DeviceError, UsageError
from tactile_bayes.hardware import head
from tactile_bayes.hardware.head import DEFAULT_BAUD, HeadParser, encode_command
from tactile_bayes.hardware.ports import ANSWER_S, SILENT_S, Port, shown
from tactile_bayes.hardware.readings import (
    MM_PER_INCH,
    NO_ROTATION,
    HelloReading,
    MissingReading,
    Parser,
    PoseReading,
    Reading,
    RecordParser,
    plausible,
)
from tactile_bayes.hardware.trackers import IgtlinkParser, NdiPort

# --- Parser for Ascension Flock of Birds and miniBIRD trackers, position and quaternion.
#
# A record is seven words of 14 bits, each sent as two bytes of seven; bit 7 marks the first byte of a record and no
# other, so that a lost byte costs one record.

SCALE_INCH: Final = 36.0
_WORDS: Final = 7


class BirdParser(RecordParser):
    """Parser of Flock of Birds records.

    A position's full scale is 36 inches, or 72 with the long scaling, 144 with the extended range transmitter. In group
    mode the bird's address follows each record.
    """

    def __init__(self, *, scale_inch: float = SCALE_INCH, group: bool = False) -> None:
        super().__init__()
        self.record_bytes = 2 * _WORDS + group
        self._scale = scale_inch
        self._group = group

    def _record(self, record: bytes) -> PoseReading | None:
        if not record[0] & 0x80 or any(byte & 0x80 for byte in record[1:]):
            return None
        x, y, z, *turn = (word(record[i], record[i + 1]) for i in range(0, 2 * _WORDS, 2))
        w, i, j, k = (number / 32768 for number in turn)
        step = self._scale / 32768 * MM_PER_INCH
        if not plausible((x * step, y * step, z * step), (w, i, j, k)):
            return None
        return PoseReading((x * step, y * step, z * step), (w, i, j, k), tool=str(record[-1]) if self._group else "")


def word(low: int, high: int) -> int:
    """Decode a signed word from its two bytes of seven bits; the two lowest bits are not sent."""
    number = (low & 0x7F) << 2 | (high & 0x7F) << 9
    return number - 65536 if number & 0x8000 else number


def record_bytes(
    position_inch: Sequence[float], quaternion_wxyz: Sequence[float], *, scale_inch: float = SCALE_INCH
) -> bytes:
    """Encode a pose as the device would: truncated to 14 bits."""
    scaled = [value / scale_inch * 32768 for value in position_inch] + [value * 32768 for value in quaternion_wxyz]
    out = bytearray()
    for value in scaled:
        number = max(-32768, min(32767, math.floor(value))) & 0xFFFF
        out += bytes([number >> 2 & 0x7F, number >> 9 & 0x7F])
    out[0] |= 0x80
    return bytes(out)


# --- Parsers for Polhemus FASTRAK, LIBERTY and PATRIOT trackers.
#
# FASTRAK numbers its output items otherwise than LIBERTY and PATRIOT: 11 is a quaternion there, the distortion
# here. Positions are asked for in inches, because that is what both give after a reset; quaternions are scalar
# first.
#
# References
# ----------
# Polhemus, 3SPACE FASTRAK User's Manual, revision G (2012); PATRIOT and LIBERTY user manuals.

FASTRAK_BINARY: Final = (2, 11, 0)
FASTRAK_ASCII: Final = (2, 11, 1)
LIBERTY_BINARY: Final = (2, 7, 8, 11, 0)
LIBERTY_ASCII: Final = (2, 7, 8, 11, 1)

_FASTRAK_KIND: Final = {2: "position", 4: "euler", 11: "quaternion"}
_LIBERTY_KIND: Final = {
    2: "position",
    3: "position",
    4: "euler",
    5: "euler",
    7: "quaternion",
    8: "time_ms",
    9: "count",
    10: "stylus",
    11: "distortion",
}
_NUMBERS: Final = {"position": 3, "euler": 3, "quaternion": 4}  # others: 1
_TAGS: Final = (b"LY", b"PA", b"LU")
_LIBERTY_HEADER: Final = struct.Struct("<2sBBBBH")
_LONGEST_LINE: Final = 512


class FastrakParser(RecordParser):
    """Parser of FASTRAK records, ASCII or binary; their fixed layout finds the next record after garbage.

    Binary records carry no checksum: the station, the error byte, the closing space and the length of the quaternion
    tell a record from noise.
    """

    def __init__(self, items: Sequence[int] = FASTRAK_BINARY, *, binary: bool = True) -> None:
        super().__init__()
        self._items = tuple(items)
        self._binary = binary
        numbers = sum(_NUMBERS[_FASTRAK_KIND[item]] for item in items if item in _FASTRAK_KIND)
        ends = {0: 1, 1: 2}
        self.record_bytes = 3 + numbers * (4 if binary else 7) + sum(ends.get(item, 0) for item in items)

    def _record(self, record: bytes) -> PoseReading | None:
        station, error = record[1] - 48, record[2:3]
        if record[:1] != b"0" or not 1 <= station <= 4 or not (error.isalpha() or error == b" "):
            return None
        values = self._values(record)
        if values is None:
            return None
        flags = () if error == b" " else (f"error {error.decode()}",)
        return pose_from_items(values, flags=flags, tool=str(station))

    def _values(self, record: bytes) -> dict[str, tuple[float, ...]] | None:
        values, place = {}, 3
        for item in self._items:
            kind = _FASTRAK_KIND.get(item)
            if kind is None:
                end = b" " if item == 0 else b"\r\n"
                if record[place : place + len(end)] != end:
                    return None
                place += len(end)
                continue
            numbers, width = _NUMBERS[kind], 4 if self._binary else 7
            part = record[place : place + numbers * width]
            parsed = struct.unpack(f"<{numbers}f", part) if self._binary else _columns(part, decimals=_DECIMALS[kind])
            if parsed is None:
                return None
            values[kind] = parsed
            place += numbers * width
        return values


_DECIMALS: Final = {"position": 2, "euler": 2, "quaternion": 4}


def _columns(text: bytes, *, decimals: int) -> tuple[float, ...] | None:
    """Parse numbers in columns of seven characters, which may touch."""
    pattern = rb" *[+-]? *\d*\.\d{%d}" % decimals
    cells = [text[i : i + 7] for i in range(0, len(text), 7)]
    if not all(re.fullmatch(pattern, cell) for cell in cells):
        return None
    try:
        return tuple(float(cell.replace(b" ", b"")) for cell in cells)
    except ValueError:
        return None


class LibertyParser(RecordParser):
    """Parser of LIBERTY, PATRIOT and Latus binary records, by their list of items.

    The header's size is a check with a tolerance of the closing space, which firmware may or may not count.
    """

    def __init__(self, items: Sequence[int] = LIBERTY_BINARY) -> None:
        super().__init__()
        self._kinds = [_LIBERTY_KIND[item] for item in items if item in _LIBERTY_KIND]
        letters = {"time_ms": "I", "count": "I", "stylus": "I", "distortion": "i"}
        self._body = struct.Struct("<" + "".join(letters.get(k, f"{_NUMBERS.get(k, 1)}f") for k in self._kinds))
        self._tail = b"".join({0: b" ", 1: b"\r\n"}.get(item, b"") for item in items)
        self.record_bytes = _LIBERTY_HEADER.size + self._body.size + len(self._tail)

    def _record(self, record: bytes) -> PoseReading | None:
        tag, station, command, error, _, size = _LIBERTY_HEADER.unpack_from(record)
        fits = abs(size - self._body.size) <= max(2, len(self._tail))
        if tag not in _TAGS or not 1 <= station <= 16 or command not in b"CP" or not fits:
            return None
        if not record.endswith(self._tail):
            return None
        raw, values = iter(self._body.unpack_from(record, _LIBERTY_HEADER.size)), {}
        for kind in self._kinds:
            values[kind] = tuple(next(raw) for _ in range(_NUMBERS.get(kind, 1)))
        flags = () if error == 0x20 else (f"error {chr(error) if 0x20 < error < 0x7F else error}",)
        return pose_from_items(values, flags=flags, tool=str(station))


class LibertyAsciiParser:
    """Parser of LIBERTY and PATRIOT text records: station, error, then numbers between spaces."""

    fault = remark = ""

    def __init__(self, items: Sequence[int] = LIBERTY_ASCII) -> None:
        self.garbage_bytes = 0
        self._kinds = [_LIBERTY_KIND[item] for item in items if item in _LIBERTY_KIND]
        self._rest = b""

    def feed(self, data: bytes) -> list[Reading]:
        """Parse `data`; return the completed poses."""
        *lines, self._rest = (self._rest + data).split(b"\n")
        if len(self._rest) > _LONGEST_LINE:
            self.garbage_bytes += len(self._rest)
            self._rest = b""
        found: list[Reading] = []
        for line in lines:
            pose = self._line(line.rstrip(b"\r"))
            if pose is None:
                self.garbage_bytes += len(line) + 1
            else:
                found.append(pose)
        return found

    def _line(self, line: bytes) -> PoseReading | None:
        station, error, words = line[:2], line[2:3], line[3:].split()
        if not re.fullmatch(rb"[ 0]\d|1[0-6]", station) or not (error.isalpha() or error == b" "):
            return None
        if len(words) != sum(_NUMBERS.get(kind, 1) for kind in self._kinds):
            return None
        if not all(re.fullmatch(rb"[+-]?\d+(\.\d*)?([eE][+-]?\d+)?", word) for word in words):
            return None
        numbers = iter(float(word) for word in words)
        values = {kind: tuple(next(numbers) for _ in range(_NUMBERS.get(kind, 1))) for kind in self._kinds}
        flags = () if error == b" " else (f"error {error.decode()}",)
        return pose_from_items(values, flags=flags, tool=str(int(station)))


def pose_from_items(
    values: Mapping[str, tuple[float, ...]], *, flags: tuple[str, ...], tool: str
) -> PoseReading | None:
    """Pose from a record's items in inches; None for items that cannot be a pose."""
    position = [number * MM_PER_INCH for number in values["position"]]
    quaternion = values.get("quaternion") or quaternion_from_euler(*values["euler"])
    if not plausible(position, quaternion):
        return None
    distortion = int(values.get("distortion", (0,))[0])
    flags += (f"distortion {distortion}",) if distortion else ()
    x, y, z = position
    w, i, j, k = quaternion
    time_ms = values.get("time_ms")
    return PoseReading((x, y, z), (w, i, j, k), None if time_ms is None else int(time_ms[0]) * 1_000_000, flags, tool)


def quaternion_from_euler(azimuth_deg: float, elevation_deg: float, roll_deg: float) -> tuple[float, ...]:
    """Scalar-first quaternion of azimuth about z, then elevation about the new y, then roll about the new x."""
    half = [math.radians(angle) / 2 for angle in (azimuth_deg, elevation_deg, roll_deg)]
    (ca, ce, cr), (sa, se, sr) = map(math.cos, half), map(math.sin, half)
    return (
        ca * ce * cr + sa * se * sr,
        ca * ce * sr - sa * se * cr,
        ca * se * cr + sa * ce * sr,
        sa * ce * cr - ca * se * sr,
    )


# --- Drivers of the devices: setup, start, stop and identification.

_BETWEEN_COMMANDS_S: Final = 0.02
_ASK_AGAIN_S: Final = 0.5
# After the first record, for those of other tools.
_LISTEN_S: Final = 0.25
_MOST_TOOLS: Final = 64
_MOST_KEPT: Final = 65536
# A board may restart when its port is opened: so long it is waited for, and so long while it says things.
_RESTART_S: Final = 4.0
_BOOT_S: Final = 12.0


class Answer(NamedTuple):
    """What a tracker answered before a recording."""

    parser: Callable[[], Parser]  #: Makes the parser that its records need.
    hello: HelloReading | None
    tools: Mapping[str, str]  #: Why a tool has no pose just now, by its name; empty where it has one.
    remark: str  #: What is to be known of its records.
    tool: str
    """`tool`, `reference`: Names of the tools to follow, in full."""
    reference: str | None

    @property
    def unseen(self) -> str:
        """The tools followed that are not seen just now, in words; empty where all are."""
        followed = [name for name in (self.tool, self.reference) if name is not None and self.tools.get(name)]
        return ", ".join(f"{name} ({self.tools[name]})" for name in followed)


class TrackerDriver(Record):
    """Commands of one tracker protocol."""

    title: str  #: The makers' name, for messages.
    baud: int  #: Line rate it runs at unless told.
    parser: Callable[[], Parser]  #: Makes a fresh parser.
    configure: tuple[bytes, ...] = ()  #: Commands that set records and units, sent one by one.
    single: bytes = b""
    start: bytes = b""
    stop: bytes = b""
    """`single`, `start`, `stop`: Commands for one record, for a stream of them, and for its end."""
    several: tuple[bytes, ...] = ()  #: Commands after which records say whose they are, where a tool is named.
    other_parser: Callable[[], Parser] | None = None  #: Of records in the other form that the device may be set to.
    has_clock: bool = False  #: Its records carry the tracker's own time.
    silent_s: float = SILENT_S  #: After so long without a byte it has gone; a server may send nothing of a hidden tool.
    hint: str = "check its power, cable and line rate"
    """Advice when nothing comes."""

    def check(self, port: Port, *, tool: str | None = None, reference: str | None = None) -> Answer:
        """Set the tracker up, ask for records and choose the tools to follow.

        Raises
        ------
        DeviceError
            When no record comes that fits the protocol, or none of a tool that is asked for.
        UsageError
            When it sends several tools and none was chosen.
        """
        before = self._prepare(port, several=bool(tool or reference))
        best, came = self._listen(port, tool, reference)
        if not best.answered or (best.tools and set(best.tools.values()) == {NO_ROTATION}):
            raise DeviceError(f"{port.name}: {self._unfit(best.parser, before, came, rate=port.has_line_rate)}")
        followed = _chosen(best.tools, tool, reference, port)
        return Answer(best.maker, best.hello, best.tools, best.parser.remark, *followed)

    def _prepare(self, port: Port, *, several: bool) -> bytes:
        """Set the tracker up; returns what came before it was asked for records."""
        came = b""
        if self.stop:
            port.write(self.stop)
            came = port.drain()
        for command in (*self.configure, *(self.several if several else ())):
            port.write(command)
            time.sleep(_BETWEEN_COMMANDS_S)
        return came + port.drain() if self.configure else came

    def _listen(self, port: Port, *wanted: str | None) -> tuple[_Try, bytes]:
        """Ask for records and read them in the form that fits best, for a while after the first of the tools wanted."""
        port.write(self.single)
        makers = [self.parser, *([self.other_parser] if self.other_parser else [])]
        tries, came, heard, end = [_Try(maker, maker()) for maker in makers], b"", 0.0, time.monotonic() + ANSWER_S
        while (now := time.monotonic()) < end:
            if heard and now - heard > _LISTEN_S and all(map(tries[0].has, wanted)):
                break
            data = port.read_some(_LISTEN_S / 2)
            came += data[: _MOST_KEPT - len(came)]
            for one in tries:
                one.feed(data)
            tries.sort(key=lambda one: (not one.answered, one.parser.garbage_bytes))
            heard = heard or (time.monotonic() if tries[0].answered else 0.0)
        return tries[0], came

    def _unfit(self, parser: Parser, before: bytes, came: bytes, *, rate: bool) -> str:
        """What came in place of a record."""
        wanted = f"a record of {self.title} was expected"
        if parser.fault:
            return f"{wanted}; {parser.fault}"
        if not came:
            before_words = f" (before it was asked: {shown(before)})" if before else ""
            return f"{wanted}, nothing came{before_words}; {self.hint}"
        what = f"{wanted}, {shown(came)} came ({len(came)} bytes)"
        for name, driver in TRACKERS.items():
            if sum(isinstance(one, PoseReading | HelloReading) for one in driver.parser().feed(before + came)) > 1:
                return f"{what}: these are records of {driver.title}; give --tracker-protocol {name}"
        return f"{what}; give another --tracker-protocol{', or its line rate' if rate else ''}"


class _Try:
    """One form of a protocol's records, tried on what comes."""

    def __init__(self, maker: Callable[[], Parser], parser: Parser) -> None:
        self.maker, self.parser = maker, parser
        self.hello: HelloReading | None = None
        self.tools: dict[str, str] = {}

    @property
    def answered(self) -> bool:
        """True when a record came."""
        return bool(self.tools or self.hello)

    def has(self, name: str | None) -> bool:
        """True when a tool has come, or none is asked for."""
        return name is None or bool(_called(self.tools, name))

    def feed(self, data: bytes) -> None:
        """Parse `data`."""
        for reading in self.parser.feed(data):
            if isinstance(reading, HelloReading):
                self.hello = reading
            elif isinstance(reading, PoseReading | MissingReading) and len(self.tools) < _MOST_TOOLS:
                why = reading.why if isinstance(reading, MissingReading) else ""
                self.tools[reading.tool] = self.tools.get(reading.tool, why) and why


def _called(tools: Iterable[str], name: str) -> list[str]:
    """Tools by a name: in full, or without the frame they are given in (ProbeToTracker) or the part number."""
    return [name] if name in tools else [one for one in tools if re.match(rf"{re.escape(name)}(To[A-Z]|-)", one)]


def _chosen(tools: Mapping[str, str], tool: str | None, reference: str | None, port: Port) -> tuple[str, str | None]:
    """Full names of the tool to follow and of the reference."""
    listed = ", ".join(f"{name!r}{f' (no pose: {why})' if why else ''}" for name, why in sorted(tools.items()))
    full: list[str | None] = []
    for name, option in ((tool, "--tool"), (reference, "--reference")):
        found = [] if name is None else _called(tools, name)
        if name is not None and len(found) != 1:
            what = f"{len(found)} tools are called {name!r}" if found else f"no pose of a tool {name!r} comes"
            raise DeviceError(
                f"{port.name}: {what}; it sends {listed or 'one without a name'}: give {option} one of them"
            )
        full.append(found[0] if found else None)
    left = [name for name in tools if name != full[1]]
    if full[0] is None and len(left) > 1:
        raise UsageError(
            f"{port.name} sends several tools: {listed}; name the one on the head with --tool, and one that is fixed "
            "to the body with --reference"
        )
    followed = full[0] if full[0] is not None else (left[0] if left else "")
    if followed == full[1] or (reference is not None and not left):
        raise UsageError(f"{port.name}: the tool and its reference are both {full[1]!r}; give two tools")
    return followed, full[1]


def _fastrak_items(items: bytes) -> tuple[bytes, ...]:
    """Commands that set the items of each station's records: the command knows no station for all."""
    return tuple(b"O%d,%b\r" % (station, items) for station in range(1, 5))


TRACKERS: Final[dict[str, TrackerDriver]] = {
    "fastrak": TrackerDriver(
        "a Polhemus FASTRAK (binary)",
        115_200,
        FastrakParser,
        (b"U", *_fastrak_items(b"2,11,0"), b"f"),
        b"P",
        b"C",
        b"c",
    ),
    "fastrak-ascii": TrackerDriver(
        "a Polhemus FASTRAK (ASCII)",
        115_200,
        lambda: FastrakParser(FASTRAK_ASCII, binary=False),
        (b"U", *_fastrak_items(b"2,11,1"), b"F"),
        b"P",
        b"C",
        b"c",
    ),
    "liberty": TrackerDriver(
        "a Polhemus LIBERTY or PATRIOT (binary)",
        115_200,
        LibertyParser,
        (b"U0\r", b"F1\r", b"O*,2,7,8,11,0\r", b"Q0\r"),
        b"P",
        b"C\r",
        b"P",
        has_clock=True,
    ),
    "liberty-ascii": TrackerDriver(
        "a Polhemus LIBERTY or PATRIOT (ASCII)",
        115_200,
        LibertyAsciiParser,
        (b"U0\r", b"F0\r", b"O*,2,7,8,11,1\r", b"Q0\r"),
        b"P",
        b"C\r",
        b"P",
        has_clock=True,
    ),
    "bird": TrackerDriver(
        "an Ascension Flock of Birds",
        115_200,
        BirdParser,
        (b"]",),
        b"BB",  # two: only the second shows whether an address ended the first
        b"@",
        b"B",
        several=(b"P\x23\x01",),  # group mode
        other_parser=lambda: BirdParser(group=True),
    ),
    "open": TrackerDriver(
        "a tracker in the open framing",
        head.DEFAULT_BAUD,
        HeadParser,
        (),
        encode_command(head.ASK),
        encode_command(head.START),
        encode_command(head.STOP),
        has_clock=True,
    ),
    "igtlink": TrackerDriver(
        "an OpenIGTLink server (PLUS, 3D Slicer)",
        0,
        IgtlinkParser,
        has_clock=True,
        silent_s=30.0,
        hint="start its stream, with a tool in sight",
    ),
    "ndi": TrackerDriver(
        "an NDI Polaris, Vega or Aurora",
        0,
        HeadParser,
        (),
        encode_command(head.ASK),
        encode_command(head.START),
        encode_command(head.STOP),
        has_clock=True,
    ),
}


def open_tracker(protocol: str, url: str, *, baud: int | None = None, rom: Path | None = None) -> Port:
    """Open the port of a tracker, at the protocol's own rate where none is given; `rom` describes a wireless
    NDI tool.
    """
    if protocol == "ndi":
        return NdiPort(url, rom=rom)
    return Port(url, baud=baud or TRACKERS[protocol].baud or 9600, role="tracker")


def check_head(port: Port, *, every: int = 1) -> HelloReading:
    """Ask a head for its identity, and refuse a line too slow for its frames."""
    port.write(encode_command(head.STOP))
    came, parser, begun = port.drain(), HeadParser(), time.monotonic()
    heard = begun
    while parser.hello is None and time.monotonic() < min(heard + _RESTART_S, begun + _BOOT_S):
        port.write(encode_command(head.ASK))  # again and again: one may get lost, and a board may restart meanwhile
        data = port.read_some(_ASK_AGAIN_S)
        heard = time.monotonic() if data else heard
        came += data[: _MOST_KEPT - len(came)]
        parser.feed(data)
    if parser.hello is None:
        raise DeviceError(f"{port.name}: a HELLO packet was expected, {_no_hello(parser, came, port)}")
    if port.has_line_rate:
        head.check_link_rate(parser.hello, baud=port.baud, every=every, port=port.name)
    return parser.hello


def _no_hello(parser: HeadParser, came: bytes, port: Port) -> str:
    """What came in place of a HELLO."""
    if parser.fault:
        return f"but {parser.fault}; the layout is in docs/scan-head-protocol.md"
    if not came:
        return f"nothing came; check its power and {'cable' if port.has_line_rate else 'its server'}"
    for driver in TRACKERS.values():
        if any(isinstance(one, PoseReading) for one in driver.parser().feed(came)):
            return f"records of {driver.title} came; give the port of the head"
    return f"{shown(came)} came ({len(came)} bytes); give its line rate with --head-baud, or the head's port"


def probe(url: str) -> str:
    """Identify the device on a port by trying each protocol; this writes to the port."""
    port = Port(url, baud=DEFAULT_BAUD, role="device")
    try:
        hello = check_head(port)
    except DeviceError:
        pass
    else:
        kind = f"scan head {hello.device_id!r}, {hello.rows} x {hello.columns} taxels, {hello.rate_hz:g} Hz"
        return kind if hello.rows else f"tracker {hello.device_id!r} in the open framing"
    finally:
        port.close()
    for name in ("fastrak", "liberty", "bird"):
        driver = TRACKERS[name]
        port = Port(url, baud=driver.baud, role="device")
        try:
            driver.check(port)
        except DeviceError:
            continue
        except UsageError as error:  # several tools
            return f"{driver.title}: --tracker-protocol {name}; {error}"
        else:
            return f"{driver.title}: --tracker-protocol {name}"
        finally:
            port.close()
    return "nothing that answers"
