"""`emulate`: a scan served as the bytes of a device."""

from __future__ import annotations

import signal
from pathlib import Path
from typing import TYPE_CHECKING

import click

from tactile_bayes.errors import BadDataError, UsageError

if TYPE_CHECKING:
    from tactile_bayes.hardware.emulated import Device, Faults
    from tactile_bayes.hardware.emulator import Link
    from tactile_bayes.scan import Scan

PROTOCOLS = ("open", "fastrak", "fastrak-ascii", "liberty", "liberty-ascii", "bird", "igtlink", "ndi")
_SHARE = click.FloatRange(0.0, 1.0)


@click.command("emulate")
@click.argument("kind", metavar="head|tracker", type=click.Choice(["head", "tracker"]))
@click.argument("scan", metavar="SCAN.mcap", type=click.Path(path_type=Path))
@click.option("--protocol", type=click.Choice(PROTOCOLS), default="open", show_default=True, help="Of the tracker.")
@click.option("--tcp", metavar="HOST:PORT", help="Listen there (port 0: any); by default a pseudo-terminal is made.")
@click.option("--once", is_flag=True, help="End when the scan has been sent; by default it can be started again.")
@click.option("--speed", type=click.FloatRange(0.01, 100.0), default=1.0, show_default=True, help="Times the own rate.")
@click.option("--drop", type=_SHARE, default=0.0, help="Share of the records that are not sent.")
@click.option("--corrupt", type=_SHARE, default=0.0, help="Share of the records with one bit changed.")
@click.option(
    "--stall", type=(float, float), metavar="AT FOR", help="Send nothing from AT s on for FOR s; what it held is lost."
)
@click.option("--disconnect", type=click.FloatRange(min=0.0), metavar="AT", help="Pull the cable at AT s.")
@click.option(
    "--hold", type=click.IntRange(min=1), default=1, show_default=True, help="Tracker: measure only every n-th pose."
)
@click.option("--seed", type=click.IntRange(min=0), default=1, show_default=True, help="Of the faults.")
def command(
    *,
    kind: str,
    scan: Path,
    protocol: str,
    tcp: str | None,
    once: bool,
    speed: float,
    drop: float,
    corrupt: float,
    stall: tuple[float, float] | None,
    disconnect: float | None,
    hold: int,
    seed: int,
) -> None:
    """Serve a scan as a scan head or a tracker would send it, at its own rate, with faults on request.

    The first line printed is the URL for `record`. The head speaks the open framing of docs/scan-head-protocol.md; so
    does the tracker by default, whose poses then come without rounding.

    Example: tactile-bayes emulate head scan.mcap
    """
    import numpy as np

    from tactile_bayes.files.scan_mcap import read_scan
    from tactile_bayes.hardware.emulated import Faults
    from tactile_bayes.hardware.emulator import Emulator
    from tactile_bayes.hardware.reading import ask_for_priority

    faults = Faults(drop, corrupt, stall, disconnect, hold)
    device = _device(kind, read_scan(scan), protocol, faults, path=scan)
    link = _link(tcp)
    click.echo(link.url)
    ask_for_priority()  # a real device does not wait for this computer's other programs
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        signal.signal(number, _leave)
    emulator = Emulator(device, link, faults=faults, rng=np.random.default_rng(seed), speed=speed)
    try:
        emulator.run(once=once)
    except _LeaveError:
        pass
    finally:
        served = emulator.served
        click.echo(f"{served.sent} records sent, {served.dropped} dropped, {served.faulty} spoilt on request", err=True)


class _LeaveError(Exception):
    """Somebody asked this program to end."""


def _leave(number: int, frame: object) -> None:
    del number, frame
    raise _LeaveError


def _device(kind: str, scan: Scan, protocol: str, faults: Faults, *, path: Path) -> Device:
    from tactile_bayes.hardware.emulated import EmulatedHead, EmulatedTracker

    if kind == "head" and len(scan.frames):
        return EmulatedHead(scan)
    if kind == "tracker" and len(scan.poses) and protocol == "ndi":
        from tactile_bayes.hardware.emulated_ndi import EmulatedNdi

        if faults.drop or faults.corrupt or faults.stall or faults.disconnect_s is not None:
            raise UsageError(
                "an NDI tracker sends nothing by itself: --drop, --corrupt, --stall and --disconnect have nothing to "
                "act on; leave them out, or emulate another protocol"
            )
        return EmulatedNdi(scan.poses, hold=faults.hold)
    if kind == "tracker" and len(scan.poses):
        return EmulatedTracker(scan.poses, protocol=protocol, hold=faults.hold)
    what = "frames" if kind == "head" else "poses"
    raise BadDataError(f"holds no {what}", way_out="give another scan", path=str(path))


def _link(tcp: str | None) -> Link:
    from tactile_bayes.hardware.emulator import PtyLink, TcpLink

    if tcp is None:
        return PtyLink()
    host, colon, port = tcp.rpartition(":")
    if not colon or not port.isdigit() or int(port) > 65535:
        raise UsageError(f"--tcp {tcp!r} is not HOST:PORT; give 127.0.0.1:0 for any free port")
    return TcpLink(host, int(port))
