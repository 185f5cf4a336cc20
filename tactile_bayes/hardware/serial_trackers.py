"""Trackers on a serial line, and all drivers by name."""

from __future__ import annotations

import math
import re
import struct
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import closing, suppress
from functools import partial
from pathlib import Path
from typing import Final, get_args

from tactile_bayes.declarations import Record
from tactile_bayes.errors import DeviceError, UsageError
from tactile_bayes.hardware import head, readings
from tactile_bayes.hardware.ports import ANSWER_S, SILENT_S, Port, preview
from tactile_bayes.hardware.trackers import ASK_FOR_TDATA, NAME_BYTES, IgtlinkParser, NdiPort, encode_transform
from tactile_bayes.presets import MM_PER_UNIT, TrackerProtocol

# --- Records of Ascension Flock of Birds and miniBIRD trackers, position and quaternion, by the standard transmitter.
#
# A record is seven words of 14 bits, each sent as two bytes of seven; bit 7 marks the first byte of a record and no
# other, so that a lost byte costs one record. In group mode the bird's address follows.

_SCALE_INCH: Final = 36.0
_BIRD_BYTES: Final = 14


def _bird_pose(record: bytes) -> readings.PoseReading | None:
    if not record[0] & 0x80 or any(byte & 0x80 for byte in record[1:]):
        return None
    words = ((record[i] & 0x7F) << 2 | record[i + 1] << 9 for i in range(0, _BIRD_BYTES, 2))  # two bits are not sent
    x, y, z, *quaternion = ((word - 65536 if word & 0x8000 else word) / 32768 for word in words)
    inches = (_SCALE_INCH * x, _SCALE_INCH * y, _SCALE_INCH * z)
    return _pose((*inches, *quaternion), str(record[-1]) if len(record) > _BIRD_BYTES else "")


def encode_bird(numbers: Sequence[float]) -> bytes:
    """Encode a pose, its position in inches and its quaternion, as the device would: truncated to 14 bits."""
    out = bytearray()
    for value, scale in zip(numbers, (*3 * (_SCALE_INCH,), 1, 1, 1, 1), strict=True):
        number = max(-32768, min(32767, math.floor(value / scale * 32768))) & 0xFFFF
        out += bytes([number >> 2 & 0x7F, number >> 9 & 0x7F])
    out[0] |= 0x80
    return bytes(out)


# --- Records of Polhemus FASTRAK, LIBERTY and PATRIOT trackers, in the layouts that the drivers below ask for.
#
# FASTRAK numbers its output items otherwise than LIBERTY and PATRIOT: 11 is a quaternion there, the distortion
# here. Positions are asked for in inches, because that is what both give after a reset; quaternions are scalar
# first. Binary records carry no checksum. FASTRAK's are told from noise by the station, the error byte, the closing
# space and the length of the quaternion; LIBERTY's header has a size, whose tolerance is the closing space: firmware
# may count it or not.
#
# Polhemus, 3SPACE FASTRAK User's Manual, revision G (2012); PATRIOT and LIBERTY user manuals.

FASTRAK: Final = struct.Struct("<7f")  # position, quaternion
FASTRAK_DECIMALS: Final = (2, 2, 2, 4, 4, 4, 4)
_COLUMN: Final = 7
_FASTRAK_BYTES, _FASTRAK_TEXT_BYTES = 3 + FASTRAK.size + 1, 3 + 7 * _COLUMN + 2  #: Binary, and as text.
# Tag, station, command, error, spare, size; then position, quaternion, ms, distortion.
LIBERTY: Final = struct.Struct("<2sBBBBH7fIi")
LIBERTY_HEADER_BYTES: Final = 8
_TAGS: Final = (b"LY", b"PA", b"LU")
_LONGEST_LINE: Final = 512
_WORDS_LIBERTY: Final = 9
_LIBERTY_TEXT: Final = re.compile(rb"([ 0]\d|1[0-6])([A-Za-z ])")  # station, error
_NUMBER: Final = re.compile(rb"[+-]?\d+(\.\d*)?([eE][+-]?\d+)?")


def _fastrak_pose(record: bytes) -> readings.PoseReading | None:
    station, error = record[1] - 48, record[2:3]
    if record[:1] != b"0" or not 1 <= station <= 4 or not (error.isalpha() or error == b" "):
        return None
    if len(record) == _FASTRAK_BYTES:
        values = FASTRAK.unpack_from(record, 3) if record[-1:] == b" " else None
    else:
        values = _columns(record[3:-2]) if record[-2:] == b"\r\n" else None
    return None if values is None else _pose(values, str(station), error)


def _columns(text: bytes) -> tuple[float, ...] | None:
    """Parse numbers in columns of seven characters, which may touch."""
    cells = [text[i : i + _COLUMN] for i in range(0, len(text), _COLUMN)]
    for cell, decimals in zip(cells, FASTRAK_DECIMALS, strict=True):
        if not re.fullmatch(rb" *[+-]? *\d*\.\d{%d}" % decimals, cell):
            return None
    return tuple(float(cell.replace(b" ", b"")) for cell in cells)


def _liberty_pose(record: bytes) -> readings.PoseReading | None:
    tag, station, command, error, _, size, *values, time_ms, distortion = LIBERTY.unpack_from(record)
    fits = abs(size - LIBERTY.size + LIBERTY_HEADER_BYTES) <= 2
    if tag not in _TAGS or not 1 <= station <= 16 or command not in b"CP" or not fits or record[-1:] != b" ":
        return None
    return _pose(values, str(station), bytes([error]), time_ms, distortion)


class LibertyAsciiParser(readings.Parser):
    """Parser of LIBERTY and PATRIOT text records: station, error, then numbers between spaces."""

    def feed(self, data: bytes) -> list[readings.Reading]:
        poses: list[readings.Reading] = []
        for line in self._parts(data, b"\n", _LONGEST_LINE):
            pose = self._line(line.rstrip(b"\r"))
            if pose is None:
                self.garbage_bytes += len(line) + 1
            else:
                poses.append(pose)
        return poses

    def _line(self, line: bytes) -> readings.PoseReading | None:
        prefix, words = _LIBERTY_TEXT.match(line), line[3:].split()
        if prefix is None or len(words) != _WORDS_LIBERTY or not all(map(_NUMBER.fullmatch, words)):
            return None
        *values, time_ms, distortion = map(float, words)
        if not math.isfinite(time_ms + distortion):
            return None
        return _pose(values, str(int(prefix[1])), prefix[2], int(time_ms), int(distortion))


def _pose(
    values: Sequence[float], tool: str, error: bytes = b" ", time_ms: int | None = None, distortion: int = 0
) -> readings.PoseReading | None:
    """Pose from a position in inches and a quaternion; None for numbers that cannot be one. A space means no error."""
    x, y, z = (number * MM_PER_UNIT["in"] for number in values[:3])
    w, i, j, k = values[3:]
    if not readings.plausible((x, y, z), (w, i, j, k)):
        return None
    flags: tuple[str, ...] = ("" if error == b" " else f"error {error.decode() if error.isalpha() else error[0]}",)
    flags += (f"distortion {distortion}" if distortion else "",)
    device_ns = None if time_ms is None else time_ms * 1_000_000
    return readings.PoseReading((x, y, z), (w, i, j, k), device_ns, tuple(filter(None, flags)), tool)


# --- Records as the devices of these drivers send them.

PROTOCOLS: Final = tuple(name for name in get_args(TrackerProtocol) if name != "ndi")  # which is asked for each pose


def encode_record(protocol: str, pose: readings.ToolReading, number: int) -> bytes:
    """Encode a reading in one of `PROTOCOLS`; empty for a missing pose where the protocol cannot say so."""
    if protocol == "open":
        return head.encode_pose(pose, sequence=number)
    if protocol == "igtlink":
        return encode_transform(pose)
    if not isinstance(pose, readings.PoseReading):
        return b""
    station = int(pose.tool or 1)
    numbers = (*(value / MM_PER_UNIT["in"] for value in pose.position_mm), *pose.quaternion_wxyz)
    time_ms = (pose.device_ns or 0) // 1_000_000 % 2**32
    match protocol:
        case "fastrak":
            return b"0%d " % station + FASTRAK.pack(*numbers) + b" "
        case "fastrak-ascii":
            columns = (f"{value:7.{places}f}" for value, places in zip(numbers, FASTRAK_DECIMALS, strict=True))
            return f"0{station} {''.join(columns)}\r\n".encode()
        case "liberty":
            header = (b"LY", station, ord("C"), ord(" "), 0, LIBERTY.size - LIBERTY_HEADER_BYTES + 1)
            return LIBERTY.pack(*header, *numbers, time_ms, 0) + b" "
        case "liberty-ascii":
            return f"{station:02}  {' '.join(f'{value:.5f}' for value in numbers)} {time_ms} 0\r\n".encode()
        case _:  # of a bird, whose address stands behind it in group mode
            return encode_bird(numbers) + (bytes([station]) if pose.tool else b"")


# --- Drivers of the devices: setup, start, stop and identification.

_BETWEEN_COMMANDS_S: Final = 0.02
_ASK_AGAIN_S: Final = 0.5
_LISTEN_S: Final = 0.25  #: After the first record, for those of other tools.
_MOST_TOOLS: Final = 64
_MOST_KEPT: Final = 65536
# A board may restart when its port is opened: the longest wait without a byte, and in all.
_RESTART_S: Final = 4.0
_BOOT_S: Final = 12.0


class TrackerAnswer:
    """Answer of a tracker before a recording, read as records of one form; `parser` makes a parser of that form."""

    def __init__(self, parser: Callable[[], readings.Parser]) -> None:
        self.parser, self.parsed = parser, parser()
        self.hello: readings.HelloReading | None = None
        self.tools: dict[str, str] = {}  #: By tool: why it has no pose now; empty where it has one.
        self.tool = ""
        self.reference: str | None = None
        """`tool`, `reference`: Names of the tools to follow, in full."""

    @property
    def came(self) -> bool:
        """True when a record came."""
        return bool(self.tools or self.hello)

    @property
    def unseen(self) -> str:
        """The followed tools that have no pose now, in words; empty where all have one."""
        followed = [name for name in (self.tool, self.reference) if name is not None and self.tools.get(name)]
        return ", ".join(f"{name} ({self.tools[name]})" for name in followed)

    def feed(self, data: bytes) -> None:
        """Parse `data`."""
        for reading in self.parsed.feed(data):
            if isinstance(reading, readings.HelloReading):
                self.hello = reading
            elif isinstance(reading, readings.PoseReading | readings.MissingReading) and len(self.tools) < _MOST_TOOLS:
                why = reading.why if isinstance(reading, readings.MissingReading) else ""
                self.tools[reading.tool] = self.tools.get(reading.tool, why) and why


class TrackerDriver(Record):
    """Commands of one tracker protocol."""

    title: str  #: Name of the device, for messages.
    baud: int  #: Default line rate.
    parser: Callable[[], readings.Parser]  #: Makes a parser of its records.
    configure: tuple[bytes, ...] = ()  #: Commands that set the form of records and the units, sent one by one.
    single: bytes = b""
    start: bytes = b""
    stop: bytes = b""  #: `single`, `start`, `stop`: Commands for one record, for a stream of them, and for its end.
    late: bytes = b""  #: Command to send where nothing comes without it.
    several: tuple[bytes, ...] = ()  #: Commands that add the tool to each record, sent where a tool is named.
    other_parser: Callable[[], readings.Parser] | None = None  #: Of the other form that the device may be set to.
    silent_s: float = SILENT_S  #: Silence after which the device has gone; a server may send nothing of a hidden tool.
    hint: str = "check its power, cable and line rate"  #: Advice when nothing comes.

    def check(self, port: Port, *, tool: str | None = None, reference: str | None = None) -> TrackerAnswer:
        """Configure the tracker, ask it for records and choose the tools to follow.

        `DeviceError` if no record fits the protocol, or none is of a tool that is named; `UsageError` if several tools
        send and none is named.
        """
        unasked = b""
        if self.stop:
            port.write(self.stop)
            unasked = port.drain()
        for command in (*self.configure, *(self.several if tool or reference else ())):
            port.write(command)
            time.sleep(_BETWEEN_COMMANDS_S)
        if self.configure:
            unasked += port.drain()
        port.write(self.single)
        # read in each form for `_LISTEN_S` after the first record; the form with the least garbage counts
        answers = [TrackerAnswer(parser) for parser in (self.parser, self.other_parser) if parser is not None]
        received, answered_at, late, begun = b"", 0.0, self.late, time.monotonic()
        while (now := time.monotonic()) < begun + ANSWER_S:
            if late and not answered_at and now > begun + ANSWER_S / 3:
                port.write(late)
                late = b""
            all_seen = all(name is None or _tools_named(answers[0].tools, name) for name in (tool, reference))
            if answered_at and now - answered_at > _LISTEN_S and all_seen:
                break
            data = port.read_some(_LISTEN_S / 2)
            received += data[: _MOST_KEPT - len(received)]
            for answer in answers:
                answer.feed(data)
            answers.sort(key=lambda answer: (not answer.came, answer.parsed.garbage_bytes))
            answered_at = answered_at or (time.monotonic() if answers[0].came else 0.0)
        answer = answers[0]
        if not answer.came or (answer.tools and set(answer.tools.values()) == {readings.NO_ROTATION}):
            words = self._fault_words(answer.parsed, unasked, received, rate=port.has_line_rate)
            raise DeviceError(f"{port.name}: {words}")
        if answer.hello is not None and answer.hello.rows:
            raise DeviceError(f"{port.name}: {answer.hello.device_id!r} is a scan head; give the tracker's port")
        answer.tool, answer.reference = _choose_tools(answer.tools, tool, reference, port)
        return answer

    def _fault_words(self, parser: readings.Parser, unasked: bytes, received: bytes, *, rate: bool) -> str:
        """Words on the bytes that came instead of a record."""
        expected = f"a record of {self.title} was expected"
        if parser.fault:
            return f"{expected}; {parser.fault}"
        if not received:
            before_words = f" (before it was asked: {preview(unasked)})" if unasked else ""
            return f"{expected}, nothing came{before_words}; {self.hint}"
        fault = f"{expected}, {preview(received)} came ({len(received)} bytes)"
        for name, driver in TRACKERS.items():
            parser = driver.parser()
            if parser.feed(unasked + received) and parser.garbage_bytes < len(unasked + received) / 2:
                return f"{fault}: these are records of {driver.title}; give --tracker-protocol {name}"
        return f"{fault}; give another --tracker-protocol{', or its line rate' if rate else ''}"


def _tools_named(tools: Iterable[str], name: str) -> list[str]:
    """Tools that a name stands for: the full name, or the name without its frame (ProbeToTracker) or part number."""
    for full_name in (name, name[:NAME_BYTES]):  # servers cut names
        if full_name in tools:
            return [full_name]
    return [tool for tool in tools if re.match(rf"{re.escape(name)}(To[A-Z]|-)", tool)]


def _choose_tools(
    tools: Mapping[str, str], tool: str | None, reference: str | None, port: Port
) -> tuple[str, str | None]:
    """Full names of the tool to follow and of the reference."""
    listed = ", ".join(f"{name!r}{f' (no pose: {why})' if why else ''}" for name, why in sorted(tools.items()))
    full_names: list[str | None] = []
    for name, option in ((tool, "--tool"), (reference, "--reference")):
        matches = [] if name is None else _tools_named(tools, name)
        if name is not None and len(matches) != 1:
            none = f"no pose of a tool {name!r} comes (is it in sight?)"
            fault = f"{len(matches)} tools are called {name!r}" if matches else none
            sent = listed or "one without a name"
            raise DeviceError(f"{port.name}: {fault}; it sends {sent}: give {option} one of them")
        full_names.append(matches[0] if matches else None)
    followed, fixed = full_names
    candidates = [name for name in tools if name != fixed]
    if followed is None and len(candidates) > 1:
        raise UsageError(
            f"{port.name} sends several tools: {listed}; name the one on the head with --tool, and one that is fixed "
            "to the body with --reference"
        )
    if followed is None and fixed is not None and not candidates:
        raise UsageError(f"{port.name} sends only the reference, {fixed!r}; is the tool on the head in sight?")
    if followed is not None and followed == fixed:
        raise UsageError(f"{port.name}: the tool and its reference are both {fixed!r}; give two tools")
    return next(iter(candidates), "") if followed is None else followed, fixed


def _open_framing(title: str, baud: int) -> TrackerDriver:
    ask, start, stop = (head.encode_command(one) for one in (head.ASK, head.START, head.STOP))
    return TrackerDriver(title, baud, head.HeadParser, (), ask, start, stop)


def _fastrak(words: str, form: bytes, closing: bytes, parser: Callable[[], readings.Parser]) -> TrackerDriver:
    """Driver of a FASTRAK in one form of records; no command sets the items for all stations, so each is set."""
    items = [b"O%d,2,11,%b\r" % (station, closing) for station in range(1, 5)]
    return TrackerDriver(f"a Polhemus FASTRAK ({words})", 115_200, parser, (b"U", *items, form), b"P", b"C", b"c")


def _liberty(words: str, form: bytes, closing: bytes, parser: Callable[[], readings.Parser]) -> TrackerDriver:
    """Driver of a LIBERTY or PATRIOT in one form of records."""
    title = f"a Polhemus LIBERTY or PATRIOT ({words})"
    commands = (b"U0\r", form, b"O*,2,7,8,11,%b\r" % closing, b"Q0\r")
    return TrackerDriver(title, 115_200, parser, commands, b"P", b"C\r", b"P")


TRACKERS: Final[dict[str, TrackerDriver]] = {
    "fastrak": _fastrak("binary", b"f", b"0", partial(readings.RecordParser, _FASTRAK_BYTES, _fastrak_pose)),
    "fastrak-ascii": _fastrak("ASCII", b"F", b"1", partial(readings.RecordParser, _FASTRAK_TEXT_BYTES, _fastrak_pose)),
    "liberty": _liberty("binary", b"F1\r", b"0", partial(readings.RecordParser, LIBERTY.size + 1, _liberty_pose)),
    "liberty-ascii": _liberty("ASCII", b"F0\r", b"1", LibertyAsciiParser),
    "bird": TrackerDriver(
        "an Ascension Flock of Birds",
        115_200,
        partial(readings.RecordParser, _BIRD_BYTES, _bird_pose),
        (b"]",),
        b"BB",  # two: only the second shows whether an address ended the first
        b"@",
        b"B",
        several=(b"P\x23\x01",),  # group mode
        other_parser=partial(readings.RecordParser, _BIRD_BYTES + 1, _bird_pose),
    ),
    "open": _open_framing("a tracker in the open framing", head.DEFAULT_BAUD),
    "igtlink": TrackerDriver(
        "an OpenIGTLink server (PLUS, 3D Slicer)",
        0,
        IgtlinkParser,
        late=ASK_FOR_TDATA,
        silent_s=30.0,
        hint="start its stream, with a tool in sight",
    ),
    "ndi": _open_framing("an NDI Polaris, Vega or Aurora", 0),
}


def open_tracker(protocol: str, url: str, *, baud: int | None = None, roms: Sequence[Path] = ()) -> Port:
    """Open the port of a tracker, by default at the protocol's rate; `roms` describe wireless NDI tools."""
    if protocol == "ndi":
        return NdiPort(url, roms=roms)
    return Port(url, baud=baud or TRACKERS[protocol].baud or 9600, role="tracker")


def check_head(port: Port, *, every: int = 1) -> readings.HelloReading:
    """Ask a head for its identity, and refuse a line too slow for its frames."""
    port.write(head.encode_command(head.STOP))
    received, parser, begun = port.drain(), head.HeadParser(), time.monotonic()
    heard_at = begun
    while parser.hello is None and time.monotonic() < min(heard_at + _RESTART_S, begun + _BOOT_S):
        # repeated: a question may get lost, and a board may restart meanwhile
        port.write(head.encode_command(head.ASK))
        data = port.read_some(_ASK_AGAIN_S)
        heard_at = time.monotonic() if data else heard_at
        received += data[: _MOST_KEPT - len(received)]
        parser.feed(data)
    if parser.hello is None:
        raise DeviceError(f"{port.name}: a HELLO packet was expected, {_no_hello(parser, received, port)}")
    if port.has_line_rate:
        head.check_link_rate(parser.hello, baud=port.baud, every=every, port=port.name)
    return parser.hello


def _no_hello(parser: head.HeadParser, received: bytes, port: Port) -> str:
    """Words on the bytes that came instead of a HELLO."""
    if parser.fault:
        return f"but {parser.fault}; the layout is in docs/scan-head-protocol.md"
    if not received:
        line = "cable" if port.has_line_rate else "its server"
        return f"nothing came; check its power and {line}, and that this is the head's port"
    for driver in TRACKERS.values():
        if any(isinstance(reading, readings.PoseReading) for reading in driver.parser().feed(received)):
            return f"records of {driver.title} came; give the port of the head"
    return f"{preview(received)} came ({len(received)} bytes); give its line rate with --head-baud, or the head's port"


def probe(url: str) -> str:
    """Identify the device on a port by trying each protocol; this writes to the port."""
    with closing(Port(url, baud=head.DEFAULT_BAUD, role="device")) as port, suppress(DeviceError):
        hello = check_head(port)
        kind = f"scan head {hello.device_id!r}, {hello.rows} x {hello.columns} taxels, {hello.rate_hz:g} Hz"
        return kind if hello.rows else f"tracker {hello.device_id!r} in the open framing"
    for name in ("fastrak", "liberty", "bird"):
        driver, several = TRACKERS[name], ""
        with closing(Port(url, baud=driver.baud, role="device")) as port, suppress(DeviceError):
            try:
                driver.check(port)
            except UsageError as error:
                several = f"; {error}"
            return f"{driver.title}: --tracker-protocol {name}{several}"
    return "nothing that answers"
