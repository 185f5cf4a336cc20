"""`devices`: list serial ports and check which way a tracker's rotations go."""

from __future__ import annotations

import time

import click

from tactile_bayes.commands.emulate import PROTOCOLS
from tactile_bayes.commands.options import FiniteRange


@click.command("devices")
@click.option(
    "--probe",
    "url",
    metavar="URL",
    help="Identify the device on this port, by asking in each protocol; this writes to it.",
)
@click.option(
    "--pivot", "pivot_url", metavar="URL", help="Check for inverse rotations: turn this tracker about a fixed point."
)
@click.option(
    "--tracker-protocol",
    type=click.Choice(PROTOCOLS),
    default="fastrak",
    show_default=True,
    help="Protocol of the tracker to rotate.",
)
@click.option(
    "--duration",
    type=FiniteRange(min=0.2),
    default=10.0,
    show_default=True,
    metavar="S",
    help="How long to rotate it, s.",
)
def command(*, url: str | None, pivot_url: str | None, tracker_protocol: str, duration: float) -> None:
    """List the serial ports and the devices that are probably on them.

    With --pivot, hold the head's apex on one point and turn the handle about it: the right sense of the rotations keeps
    the point where it is, the wrong one does not.

    Example: tactile-bayes devices
    """
    if url:
        from tactile_bayes.hardware.drivers import probe

        click.echo(f"{url}: {probe(url)}")
    elif pivot_url:
        _pivot(pivot_url, tracker_protocol, duration)
    else:
        _list()


def _list() -> None:
    from tactile_bayes.hardware.drivers import list_ports

    ports = list_ports()
    for port in ports:
        click.echo(f"{port.url}  {port.description}: {port.guess}")
    if not ports:
        click.echo("no serial ports; other URLs: socket://HOST:PORT, rfc2217://HOST:PORT, a pseudo-terminal's path")


def _pivot(url: str, protocol: str, duration_s: float) -> None:
    import numpy as np

    from tactile_bayes.hardware.bladder import rotation_sense
    from tactile_bayes.hardware.drivers import TRACKERS, open_tracker
    from tactile_bayes.hardware.readings import PoseReading

    driver = TRACKERS[protocol]
    port = open_tracker(protocol, url)
    try:
        driver.check(port)
        click.echo("turn it", err=True)
        port.write(driver.start)
        parser, poses, end = driver.parser(), [], time.monotonic() + duration_s
        while time.monotonic() < end:
            found = parser.feed(port.read_some(0.1))
            poses += [one for one in found if isinstance(one, PoseReading) and not one.flags]
        port.write(driver.stop)
    finally:
        port.close()
    sense = rotation_sense(
        np.array([pose.position_mm for pose in poses]).reshape(-1, 3),
        np.array([pose.quaternion_wxyz for pose in poses]).reshape(-1, 4),
    )
    click.echo(f"{len(poses)} poses, turned by {sense.turn_deg:.0f} degrees: {sense}")
