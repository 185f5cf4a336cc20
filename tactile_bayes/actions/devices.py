"""Devices listed, emulated and replayed; scans repaired."""

from __future__ import annotations

import contextlib
import subprocess
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from threading import Thread
from typing import Any

import click
import numpy as np

from tactile_bayes.actions.record import record_action
from tactile_bayes.errors import BadDataError, DeviceError, UsageError
from tactile_bayes.files.provenance import Provenance, hash_inputs
from tactile_bayes.files.scan_mcap import being_recorded, is_recording, read_scan, read_scan_report, write_scan
from tactile_bayes.hardware.emulated import (
    Device,
    EmulatedHead,
    EmulatedNdi,
    EmulatedTracker,
    Emulator,
    Faults,
    Link,
    Playback,
    PtyLink,
    TcpLink,
)
from tactile_bayes.hardware.head import rotation_sense
from tactile_bayes.hardware.ports import list_ports
from tactile_bayes.hardware.reading import ask_for_priority
from tactile_bayes.hardware.readings import Follower, PoseReading, ToolReading
from tactile_bayes.hardware.serial_trackers import TRACKERS, open_tracker, probe
from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.report.map import describe_scan
from tactile_bayes.scans import Scan
from tactile_bayes.shell import own_process


def emulate_action(
    *, kind: str, scan: Path, protocol: str, tcp: str | None, once: bool, speed: float, seed: int, **fault_options: Any
) -> None:
    """Serve a scan as a scan head or a tracker would send it, or as both, at its own rate, with faults on request."""
    roles = ("head", "tracker") if kind == "both" else (kind,)
    faults = Faults(**fault_options)
    stage, loaded = Playback(speed=speed), read_scan(scan)
    spoilt = faults.drop or faults.corrupt or faults.stall or faults.disconnect_s is not None
    if protocol == "ndi" and "tracker" in roles and (spoilt or once):
        raise UsageError(
            "an NDI tracker sends nothing by itself: --drop, --corrupt, --stall, --disconnect and --once have nothing "
            "to act on; leave them out, or emulate another protocol"
        )
    if kind == "head" and (faults.hold > 1 or faults.hide or faults.breathe_mm):
        raise UsageError("--hold, --hide and --breathe are a tracker's; leave them out, or emulate a tracker or both")
    if protocol == "igtlink" and "tracker" in roles and tcp is None:
        raise UsageError("OpenIGTLink is spoken over a network; give --tcp 127.0.0.1:0")
    shared = stage if kind == "both" else None
    devices = [_device(role, loaded, protocol, faults, path=scan, shared=shared) for role in roles]
    emulators = [
        Emulator(
            device,
            _link(tcp, after=number),
            faults=faults,
            rng=np.random.default_rng(seed + number),
            stage=stage,
            leads=number == 0,
        )
        for number, device in enumerate(devices)
    ]
    for role, emulator in zip(roles, emulators, strict=True):
        click.echo(f"{role} {emulator.link.url}" if kind == "both" else emulator.link.url)
    ask_for_priority()  # a real device does not wait for other programs
    others = [Thread(target=one.run, kwargs={"once": once}, daemon=True) for one in emulators[1:]]
    try:
        with contextlib.suppress(KeyboardInterrupt):  # which the other signals are, too
            for other in others:
                other.start()
            emulators[0].run(once=once)
            # its cable was pulled, as asked, or its host has ended: the other may wait for its own host for good
            if not once or emulators[0].left:
                for one in emulators[1:]:
                    one.unplugged = True
            for other in others:
                other.join()
    finally:
        for role, emulator in zip(roles, emulators, strict=True):
            words = f"{emulator.sent} records sent, {emulator.dropped} dropped, {emulator.faulty} spoilt on request"
            if isinstance(emulator.device, EmulatedNdi):
                words = "poses were sent as they were asked for, and not counted"
            click.echo(f"{role}: {words}" if kind == "both" else words, err=True)


def _device(kind: str, scan: Scan, protocol: str, faults: Faults, *, path: Path, shared: Playback | None) -> Device:
    """Make the emulated device; an NDI tracker, which only answers, follows a shared stage itself."""
    if not len(scan.frames if kind == "head" else scan.poses):
        missing = "frames" if kind == "head" else "poses"
        raise BadDataError(f"holds no {missing}", way_out="give another scan", path=str(path))
    if kind == "head":
        return EmulatedHead(scan)
    if protocol == "ndi":
        return EmulatedNdi(scan.poses, faults=faults, elapsed=None if shared is None else lambda: shared.now()[1])
    return EmulatedTracker(scan.poses, protocol=protocol, faults=faults)


def _link(tcp: str | None, *, after: int) -> Link:
    """Make a device's link; `after` is the number of earlier devices, added to its port."""
    if tcp is None:
        return PtyLink()
    host, colon, port = tcp.rpartition(":")
    number = int(port) + after if port.isdigit() and int(port) else 0
    if not colon or not port.isdigit() or number > 65535:
        raise UsageError(f"--tcp {tcp!r} is not HOST:PORT; give 127.0.0.1:0 for any free port")
    return TcpLink(host or "127.0.0.1", number)  # a patient's scan: other computers only where an address is given


def devices_action(
    *, url: str | None, pivot_url: str | None, tracker_protocol: str, tool: str | None, duration: float
) -> None:
    """List the serial ports and the devices that are probably on them."""
    if url is not None and pivot_url is not None:
        raise UsageError("--probe asks a device who it is, --pivot turns a tracker; give one of them")
    if url is not None:
        click.echo(f"{url}: {probe(url)}")
    elif pivot_url is not None:
        _pivot(pivot_url, tracker_protocol, tool, duration)
    else:
        none = "no serial ports; other URLs: socket://HOST:PORT, rfc2217://HOST:PORT, a pseudo-terminal's path"
        click.echo("\n".join(list_ports() or [none]))


def _pivot(url: str, protocol: str, tool: str | None, duration_s: float) -> None:
    driver = TRACKERS[protocol]
    with contextlib.closing(open_tracker(protocol, url)) as port:
        answer = driver.check(port, tool=tool)
        click.echo("turn it", err=True)
        port.write(driver.start)
        parser, follower, end = answer.parser(), Follower(answer.tool), time.monotonic() + duration_s
        poses = []
        while time.monotonic() < end:
            readings = [one for one in parser.feed(port.read_some(0.1)) if isinstance(one, ToolReading)]
            followed = [one for reading in readings for one, _ in follower.take(reading, 0)]
            poses += [one for one in followed if isinstance(one, PoseReading) and not one.flags]
        port.write(driver.stop)
    positions = np.array([pose.position_mm for pose in poses]).reshape(-1, 3)
    sense = rotation_sense(positions, np.array([pose.quaternion_wxyz for pose in poses]).reshape(-1, 4))
    click.echo(f"{len(poses)} poses, turned by {sense.turn_deg:.0f} degrees: {sense}")


def replay_action(*, scan: Path, output: Path | None, speed: float, **record_options: Any) -> int:
    """Replay a scan through emulated devices, recorder and live view, as if it were being recorded."""
    original = read_scan(scan)
    with tempfile.TemporaryDirectory() as folder, _emulated(scan, speed, poses=bool(len(original.poses))) as urls:
        options = {"like": scan, "clock": "shared", "at_once": True, "accept_calibration": True}
        options |= {"replayed": dict(original.session), "replay_speed": speed}
        options |= record_options | {f"{role}_url": url for role, url in urls.items()} | {"tracker_protocol": "open"}
        if original.landmarks is not None:
            options["landmarks"] = scan
        return record_action(output or Path(folder) / "replayed.mcap", **options)


@contextlib.contextmanager
def _emulated(scan: Path, speed: float, *, poses: bool) -> Iterator[dict[str, str]]:
    """Start a process of emulated devices that play one scan together; yields their URLs by role."""
    words = ["emulate", "both" if poses else "head", str(scan), "--speed", str(speed)]
    process = subprocess.Popen(
        own_process("tactile_bayes", *words),
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        start_new_session=True,  # Ctrl-C and the signal of `timeout` are for the recorder: a device goes on meanwhile
    )
    assert process.stdout is not None
    try:
        lines = [process.stdout.readline().split() for _ in range(1 + poses)]
        if not all(lines):
            raise DeviceError(f"the emulated devices did not start; try `tactile-bayes {' '.join(words[:3])}`")
        yield {role: line[-1] for role, line in zip(("head", "tracker"), lines, strict=False)}
    finally:
        process.terminate()
        process.wait()
        process.stdout.close()


def repair_action(*, scan: Path, output: Path | None, force: bool) -> None:
    """Repair a scan that was cut off or damaged: keep what is intact, report what is lost."""
    if output is None and is_recording(scan):
        raise being_recorded(scan)
    file = read_scan_report(scan)
    if file.complete and output is None:
        click.echo(f"{scan}: is whole, nothing to repair")
        return
    settings = {"was": dict(file.provenance), "lost": list(file.lost)}
    provenance = Provenance("repair", settings, inputs=hash_inputs(scan=scan))
    target = output or scan
    write_scan(target, file.scan, provenance=provenance, truth=file.truth, force=force or output is None)
    for line in (f"{target}: scan", *describe_scan(file.scan), *(f"lost: {one}" for one in file.lost), RESEARCH_USE):
        click.echo(line)
