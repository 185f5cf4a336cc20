"""Options of the commands on devices: `record`, `devices`, `emulate`, `replay`, `repair`."""

from __future__ import annotations

from typing import get_args

import click

from tactile_bayes.commands import options
from tactile_bayes.declarations import names_of
from tactile_bayes.options import FaultOptions, RecordOptions
from tactile_bayes.presets import TrackerProtocol

_FILE = options.FilePath()
_RECORDING = names_of(RecordOptions)[2:-1]  #: Between the output with the head's port and `FORCE`.
PROTOCOLS = get_args(TrackerProtocol)


@options.command("record", "record.record_action")
@options.output_option("SCAN.mcap", "MCAP", "Scan file to write.", required=True)
@click.option("--head", "head_url", required=True, metavar="URL", help="Port of the scan head.")
@options.record_options(RecordOptions, *_RECORDING)
@options.FORCE
def record_command() -> None:
    """Record a scan head and a tracker.

    On a terminal, `n` and `x` touch the sternal notch and the xiphoid, space starts, `q` or Ctrl-C stops; with
    --duration or --at-once, or without a terminal, recording starts at once. The file can be read at any moment: a
    kill costs at most the last fraction of a second, and `repair` closes what was cut off.

    Example: tactile-bayes record -o scan.mcap --head /dev/ttyACM0 --tracker /dev/ttyUSB0 --like last.mcap
    """


@options.command("emulate", "devices.emulate_action")
@click.argument("kind", metavar="head|tracker|both", type=click.Choice(["head", "tracker", "both"]))
@click.argument("scan", metavar="SCAN.mcap", type=_FILE)
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
    "--once",
    is_flag=True,
    help="End when the scan has been sent and read, or its recording has stopped. Default: wait for the next start.",
)
@options.SPEED
@options.record_options(FaultOptions, "drop", "corrupt", "stall", "disconnect_s", show_default=False)
@options.record_options(FaultOptions, "hold")
@options.record_options(FaultOptions, "hide", "breathe_mm", show_default=False)
@click.option("--seed", type=options.WholeRange(min=0), default=1, show_default=True, help="Random seed of the faults.")
def emulate_command() -> None:
    """Serve a scan as a scan head or a tracker would send it, or as both, at its own rate, with faults on request.

    Prints the URL for `record`; with both, a line "head URL" and a line "tracker URL". Each START plays the scan from
    its beginning. With both, the head's START begins the scan for the two devices, and until then the tracker repeats
    its first pose: frames and poses belong together however long `record` waits for a key. A tracker emulated alone
    plays from its own START, which `record` sends again when it starts; one that needs no START (igtlink, ndi) plays
    from when a host connects. The head speaks the open framing of docs/scan-head-protocol.md; so does the tracker by
    default, whose poses then come without rounding.

    Example: tactile-bayes emulate both scan.mcap
    """


@options.command("devices", "devices.devices_action")
@click.option(
    "--probe",
    "url",
    metavar="URL",
    help="Identify the device on this port, by asking in each protocol; this writes to it.",
)
@click.option(
    "--pivot", "pivot_url", metavar="URL", help="Check for inverse rotations: turn this tracker about a fixed point."
)
@options.record_options(
    RecordOptions,
    "tracker_protocol",
    metavar="PROTOCOL",
    help=f"Protocol of the tracker to rotate: {', '.join(PROTOCOLS)}.",
)
@options.record_options(RecordOptions, "tool")
@options.number_option("--duration", options.FiniteRange(min=0.2), 10.0, "Time to rotate it, s.", metavar="S")
def devices_command() -> None:
    """List the serial ports and the devices that are probably on them.

    With --pivot, hold the head's apex on one point and turn the handle about it: the right sense of the rotations keeps
    the point where it is, the wrong one does not.

    Example: tactile-bayes devices
    """


@options.command("replay", "devices.replay_action")
@click.argument("scan", metavar="SCAN.mcap", type=_FILE)
@options.output_option("OUT.mcap", "MCAP", "Save what is recorded.")
@options.record_options(RecordOptions, "live", "serve", "size_calibration")
@options.SPEED
@options.FORCE
def replay_command() -> None:
    """Replay a scan through emulated devices, recorder and live view, as if it were being recorded.

    Example: tactile-bayes replay scan.mcap --live
    """


@options.command("repair", "devices.repair_action")
@click.argument("scan", metavar="SCAN.mcap", type=_FILE)
@options.output_option("OUT.mcap", "MCAP", "Write to this file instead of replacing SCAN.mcap.")
@options.FORCE
def repair_command() -> None:
    """Repair a scan that was cut off or damaged: keep what is intact, report what is lost.

    The file is replaced when the new one is whole, unless -o is given. A file that is whole already is left alone.

    Example: tactile-bayes repair scan.mcap
    """
