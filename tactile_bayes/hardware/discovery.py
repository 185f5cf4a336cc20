"""Detection of serial ports and of the devices on them."""

from __future__ import annotations

from typing import Final, NamedTuple

from tactile_bayes.errors import DeviceError
from tactile_bayes.hardware.drivers import TRACKERS, check_head
from tactile_bayes.hardware.head import DEFAULT_BAUD
from tactile_bayes.hardware.ports import Port

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
