"""Drivers by name, and what is found on the ports."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Final, NamedTuple

from tactile_bayes.declarations import Record
from tactile_bayes.errors import DeviceError
from tactile_bayes.hardware import head
from tactile_bayes.hardware import serial_trackers as polhemus
from tactile_bayes.hardware.head import DEFAULT_BAUD, HeadParser, encode_command
from tactile_bayes.hardware.igtlink import IgtlinkParser
from tactile_bayes.hardware.ndi import NdiPort
from tactile_bayes.hardware.ports import ANSWER_S, Port, shown
from tactile_bayes.hardware.readings import HelloReading, Parser, PoseReading
from tactile_bayes.hardware.serial_trackers import BirdParser, FastrakParser, LibertyAsciiParser, LibertyParser

# --- Drivers of the devices: setup, start, stop and identification.

_BETWEEN_COMMANDS_S: Final = 0.02
_ASK_AGAIN_S: Final = 0.5


class TrackerDriver(Record):
    """Commands of one tracker protocol."""

    title: str
    """The makers' name, for messages."""
    baud: int
    """Line rate it runs at unless told."""
    parser: Callable[[], Parser]
    """Makes a fresh parser."""
    configure: tuple[bytes, ...] = ()
    """Commands that set records and units, sent one by one."""
    single: bytes = b""
    start: bytes = b""
    stop: bytes = b""
    """`single`, `start`, `stop`: Commands for one record, for a stream of them, and for its end."""
    has_clock: bool = False
    """Its records carry the tracker's own time."""
    hint: str = "check its power, cable and line rate, or give another --tracker-protocol"
    """What to try when nothing comes."""

    def check(self, port: Port) -> PoseReading | HelloReading:
        """Set the tracker up and ask for one record.

        Raises
        ------
        DeviceError
            When none comes that fits the protocol.
        """
        if self.stop:
            port.write(self.stop)
            port.drain()
        for command in self.configure:
            port.write(command)
            time.sleep(_BETWEEN_COMMANDS_S)
        if self.configure:
            port.drain()
        if self.single:
            port.write(self.single)
        parser, came = self.parser(), b""
        end = time.monotonic() + ANSWER_S
        while time.monotonic() < end:
            data = port.read_some(0.1)
            came += data
            for reading in parser.feed(data):
                if isinstance(reading, PoseReading | HelloReading):
                    return reading
        raise DeviceError(
            f"{port.name}: a record of a {self.title} was expected, {shown(came)} came ({len(came)} bytes); {self.hint}"
        )


TRACKERS: Final[dict[str, TrackerDriver]] = {
    "fastrak": TrackerDriver(
        "Polhemus FASTRAK (binary)", 115_200, FastrakParser, (b"U", b"O1,2,11,0\r", b"f"), b"P", b"C", b"c"
    ),
    "fastrak-ascii": TrackerDriver(
        "Polhemus FASTRAK (ASCII)",
        115_200,
        lambda: FastrakParser(polhemus.FASTRAK_ASCII, binary=False),
        (b"U", b"O1,2,11,1\r", b"F"),
        b"P",
        b"C",
        b"c",
    ),
    "liberty": TrackerDriver(
        "Polhemus LIBERTY or PATRIOT (binary)",
        115_200,
        LibertyParser,
        (b"U0\r", b"F1\r", b"O1,2,7,8,11,0\r", b"Q0\r"),
        b"P",
        b"C\r",
        b"P",
        has_clock=True,
    ),
    "liberty-ascii": TrackerDriver(
        "Polhemus LIBERTY or PATRIOT (ASCII)",
        115_200,
        LibertyAsciiParser,
        (b"U0\r", b"F0\r", b"O1,2,7,8,11,1\r", b"Q0\r"),
        b"P",
        b"C\r",
        b"P",
        has_clock=True,
    ),
    "bird": TrackerDriver("Ascension Flock of Birds", 115_200, BirdParser, (b"]",), b"B", b"@", b"B"),
    "open": TrackerDriver(
        "tracker in the open framing",
        head.DEFAULT_BAUD,
        HeadParser,
        (),
        encode_command(head.ASK),
        encode_command(head.START),
        encode_command(head.STOP),
        has_clock=True,
    ),
    "igtlink": TrackerDriver(
        "OpenIGTLink server (PLUS, 3D Slicer)",
        0,
        IgtlinkParser,
        has_clock=True,
        hint="give socket://HOST:18944 and start its stream",
    ),
    "ndi": TrackerDriver(
        "NDI Polaris, Vega or Aurora",
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
    """Open the port of a tracker.

    Parameters
    ----------
    baud
        None for the protocol's own.
    rom
        Description of a wireless NDI tool.

    Raises
    ------
    DeviceError
        When it cannot be opened.
    """
    if protocol == "ndi":
        return NdiPort(url, rom=rom)
    return Port(url, baud=baud or TRACKERS[protocol].baud or 9600, role="tracker")


def check_head(port: Port, *, every: int = 1) -> HelloReading:
    """Ask a head for its identity, and refuse a line too slow for its frames.

    Raises
    ------
    DeviceError
        When no HELLO comes, or when the line rate is too low.
    """
    port.write(encode_command(head.STOP))
    port.drain()
    parser, came, end = HeadParser(), b"", time.monotonic() + ANSWER_S
    while time.monotonic() < end and parser.hello is None:
        port.write(encode_command(head.ASK))  # again and again: one may get lost
        data = port.read_some(_ASK_AGAIN_S)
        came += data
        parser.feed(data)
    if parser.hello is None:
        raise DeviceError(
            f"{port.name}: a HELLO packet was expected, {shown(came)} came ({len(came)} bytes); check its power and "
            "cable, and the layout in docs/scan-head-protocol.md"
        )
    if port.has_line_rate:
        head.check_link_rate(parser.hello, baud=port.baud, every=every, port=port.name)
    return parser.hello


# --- Detection of serial ports and of the devices on them.

# USB vendors, by what they make.
_TRACKER_MAKERS: Final = {0x0F44: "Polhemus"}
_CONTROLLERS: Final = {
    0x2341: "Arduino",
    0x16C0: "Teensy",
    0x2E8A: "Raspberry Pi Pico",
    0x0483: "ST",
    0x303A: "Espressif",
    0x1366: "SEGGER",
    0x239A: "Adafruit",
}
_ADAPTERS: Final = {0x0403: "FTDI", 0x10C4: "Silicon Labs", 0x067B: "Prolific", 0x1A86: "WCH"}


class FoundPort(NamedTuple):
    """A port: its URL, the system's description, the device probably on it."""

    url: str
    description: str
    guess: str


def list_ports() -> list[FoundPort]:
    """List the system's ports, in order, with a guess from their USB ids; opens none of them."""
    from serial.tools.list_ports import comports

    found = [FoundPort(port.device, port.description or "", guess(port.vid, port.product or "")) for port in comports()]
    return sorted(found)


def guess(vendor: int | None, product: str) -> str:
    """Guess the device on a port from its USB vendor and product name."""
    if vendor in _TRACKER_MAKERS:
        return f"tracker ({_TRACKER_MAKERS[vendor]})"
    if vendor in _CONTROLLERS or "head" in product.lower():
        return f"scan head, perhaps ({_CONTROLLERS.get(vendor or 0, product)})"
    if vendor in _ADAPTERS:
        return f"tracker on a serial adapter, perhaps ({_ADAPTERS[vendor]})"
    return "unknown"


def probe(url: str) -> str:
    """Identify the device on a port by trying each protocol; this writes to the port.

    Raises
    ------
    DeviceError
        When the port cannot be opened.
    """
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
        else:
            return f"{driver.title}: --tracker-protocol {name}"
        finally:
            port.close()
    return "nothing that answers"
