"""`emulate`: serve a scan as a device would send it."""

from __future__ import annotations

import contextlib
import signal
from pathlib import Path
from typing import TYPE_CHECKING

import click

from tactile_bayes.commands.options import SPEED, FilePath, FiniteRange
from tactile_bayes.errors import BadDataError, UsageError

if TYPE_CHECKING:
    from collections.abc import Callable

    from tactile_bayes.hardware.emulated import Device, Faults
    from tactile_bayes.hardware.emulator import Emulator, Link, Served, Stage
    from tactile_bayes.scan import Scan

PROTOCOLS = ("open", "fastrak", "fastrak-ascii", "liberty", "liberty-ascii", "bird", "igtlink", "ndi")
_SHARE = FiniteRange(0.0, 1.0)


@click.command("emulate")
@click.argument("kind", metavar="head|tracker|both", type=click.Choice(["head", "tracker", "both"]))
@click.argument("scan", metavar="SCAN.mcap", type=FilePath())
@click.option(
    "--protocol", type=click.Choice(PROTOCOLS), default="open", show_default=True, help="Protocol of the tracker."
)
@click.option(
    "--tcp",
    metavar="HOST:PORT",
    help="Listen there (port 0: any; both: the tracker on the next port); without HOST for this computer only. "
    "Default: a pseudo-terminal.",
)
@click.option(
    "--once", is_flag=True, help="End when the scan has been sent and read. Default: wait for the next start."
)
@SPEED
@click.option("--drop", type=_SHARE, default=0.0, help="Share of the records that are not sent.")
@click.option("--corrupt", type=_SHARE, default=0.0, help="Share of the records with one bit changed.")
@click.option(
    "--stall",
    type=(FiniteRange(min=0.0), FiniteRange(min=0.0)),
    metavar="AT FOR",
    help="Send nothing for FOR s from AT s on; those records are lost.",
)
@click.option("--disconnect", type=FiniteRange(min=0.0), metavar="AT", help="Disconnect at AT s.")
@click.option(
    "--hold", type=click.IntRange(min=1), default=1, show_default=True, help="Tracker: measure only every n-th pose."
)
@click.option("--seed", type=click.IntRange(min=0), default=1, show_default=True, help="Random seed of the faults.")
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
    """Serve a scan as a scan head or a tracker would send it, or as both, at its own rate, with faults on request.

    Prints the URL for `record`; with both, a line "head URL" and a line "tracker URL". Each START plays the scan from
    its beginning. With both, the head's START begins the scan for the two devices, and until then the tracker repeats
    its first pose: frames and poses belong together however long `record` waits for a key. A tracker emulated alone
    plays from its own START, which `record` sends again when it starts; one that needs no START (igtlink, ndi) plays
    from when a host connects. The head speaks the open framing of docs/scan-head-protocol.md; so does the tracker by
    default, whose poses then come without rounding.

    Example: tactile-bayes emulate both scan.mcap
    """
    from tactile_bayes.files.scan_mcap import read_scan
    from tactile_bayes.hardware.emulated import Faults
    from tactile_bayes.hardware.emulator import Stage
    from tactile_bayes.hardware.reading import ask_for_priority

    roles = ("head", "tracker") if kind == "both" else (kind,)
    faults, stage, data = Faults(drop, corrupt, stall, disconnect, hold), Stage(speed=speed), read_scan(scan)
    if protocol == "ndi" and "tracker" in roles:
        _refuse_for_ndi(faults, once=once)
    held = stage if kind == "both" else None
    devices = [_device(role, data, protocol, faults, path=scan, held=held) for role in roles]
    links = [_link(tcp, after=number) for number in range(len(roles))]
    for role, link in zip(roles, links, strict=True):
        click.echo(f"{role} {link.url}" if kind == "both" else link.url)
    ask_for_priority()  # a real device does not wait for this computer's other programs
    emulators = [
        _emulator(device, link, faults, stage, leads=number == 0, seed=seed + number)
        for number, (device, link) in enumerate(zip(devices, links, strict=True))
    ]
    try:
        _serve(emulators, once=once)
    finally:
        for role, emulator in zip(roles, emulators, strict=True):
            click.echo(_account(role if kind == "both" else "", emulator.served), err=True)


def _emulator(device: Device, link: Link, faults: Faults, stage: Stage, *, leads: bool, seed: int) -> Emulator:
    import numpy as np

    from tactile_bayes.hardware.emulator import Emulator

    return Emulator(device, link, faults=faults, rng=np.random.default_rng(seed), stage=stage, leads=leads)


def _serve(emulators: list[Emulator], *, once: bool) -> None:
    """Run the first emulator here and the others in threads, until all have ended or a signal comes."""
    from threading import Thread

    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        signal.signal(number, _leave)
    others = [Thread(target=one.run, kwargs={"once": once}, daemon=True) for one in emulators[1:]]
    with contextlib.suppress(_LeaveError):
        for other in others:
            other.start()
        emulators[0].run(once=once)
        for other in others:
            other.join()


def _account(role: str, served: Served) -> str:
    words = f"{served.sent} records sent, {served.dropped} dropped, {served.faulty} spoilt on request"
    return f"{role}: {words}" if role else words


class _LeaveError(Exception):
    """A signal asked this program to end."""


def _leave(number: int, frame: object) -> None:
    del number, frame
    raise _LeaveError


def _device(kind: str, scan: Scan, protocol: str, faults: Faults, *, path: Path, held: Stage | None) -> Device:
    """Make the emulated device; an NDI tracker, which only answers, follows a shared stage itself."""
    from tactile_bayes.hardware.emulated import EmulatedHead, EmulatedTracker

    if kind == "head" and len(scan.frames):
        return EmulatedHead(scan)
    if kind == "tracker" and len(scan.poses) and protocol == "ndi":
        from tactile_bayes.hardware.emulated import EmulatedNdi

        elapsed: Callable[[], float | None] | None = None if held is None else lambda: held.now()[1]
        return EmulatedNdi(scan.poses, hold=faults.hold, elapsed=elapsed)
    if kind == "tracker" and len(scan.poses):
        return EmulatedTracker(scan.poses, protocol=protocol, hold=faults.hold)
    what = "frames" if kind == "head" else "poses"
    raise BadDataError(f"holds no {what}", way_out="give another scan", path=str(path))


def _refuse_for_ndi(faults: Faults, *, once: bool) -> None:
    if faults.drop or faults.corrupt or faults.stall or faults.disconnect_s is not None or once:
        raise UsageError(
            "an NDI tracker sends nothing by itself: --drop, --corrupt, --stall, --disconnect and --once have nothing "
            "to act on; leave them out, or emulate another protocol"
        )


def _link(tcp: str | None, *, after: int) -> Link:
    """Make a device's link; the one `after` others listens on a port that many numbers higher."""
    from tactile_bayes.hardware.emulator import PtyLink, TcpLink

    if tcp is None:
        return PtyLink()
    host, colon, port = tcp.rpartition(":")
    number = int(port) + after if port.isdigit() and int(port) else 0
    if not colon or not port.isdigit() or number > 65535:
        raise UsageError(f"--tcp {tcp!r} is not HOST:PORT; give 127.0.0.1:0 for any free port")
    return TcpLink(host or "127.0.0.1", number)  # a patient's scan: other computers only where an address is given
