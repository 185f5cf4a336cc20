"""`replay`: play a scan through emulated devices and the recorder."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import click

from tactile_bayes.commands.options import FORCE, SPEED, FilePath, live_options
from tactile_bayes.errors import DeviceError

_FILE = FilePath()


@click.command("replay")
@click.argument("scan", metavar="SCAN.mcap", type=_FILE)
@click.option("-o", "--output", metavar="OUT.mcap", type=FilePath(writes="MCAP"), help="Save what is recorded.")
@live_options
@SPEED
@FORCE
@click.pass_context
def command(
    ctx: click.Context,
    scan: Path,
    output: Path | None,
    live: bool,
    serve: str | None,
    size_calibration: str,
    speed: float,
    force: bool,
) -> None:
    """Replay a scan through emulated devices, recorder and live view, as if it were being recorded.

    Example: tactile-bayes replay scan.mcap --live
    """
    from tactile_bayes.commands import record
    from tactile_bayes.files.atomic import refuse_existing
    from tactile_bayes.files.scan_mcap import read_scan

    if output is not None:
        refuse_existing(output, force=force)
    found = read_scan(scan)
    with tempfile.TemporaryDirectory() as folder, _emulated(scan, speed, poses=bool(len(found.poses))) as urls:
        options = {"like": scan, "clock": "shared", "at_once": True, "live": live, "serve": serve, "force": force}
        options |= {"output": output or Path(folder) / "replayed.mcap", "size_calibration": size_calibration}
        options |= {f"{role}_url": url for role, url in urls.items()} | {"tracker_protocol": "open"}
        if found.landmarks is not None:
            options["landmarks"] = scan
        ctx.invoke(record.command, **options)


@contextmanager
def _emulated(scan: Path, speed: float, *, poses: bool) -> Iterator[dict[str, str]]:
    """Start emulated devices that play one scan together, in one process; gives their URLs by role."""
    words = ["emulate", "both" if poses else "head", str(scan), "--speed", str(speed)]
    process = subprocess.Popen(
        [sys.executable, "-m", "tactile_bayes", *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        start_new_session=True,  # Ctrl-C and what `timeout` sends are for the recorder: a device goes on meanwhile
    )
    assert process.stdout is not None
    try:
        told = [process.stdout.readline().split() for _ in range(1 + poses)]
        if not all(told):
            raise DeviceError(f"the emulated devices did not start; try `tactile-bayes {' '.join(words[:3])}`")
        yield {role: line[-1] for role, line in zip(("head", "tracker"), told, strict=False)}
    finally:
        process.terminate()
        process.wait()
        process.stdout.close()
