"""Emulated devices in a thread of the test, for recordings in processes of their own."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from tactile_bayes.forward.scene import Lump, Scene, Strokes
from tactile_bayes.forward.simulate import simulate
from tactile_bayes.hardware.emulated import (
    Device,
    EmulatedHead,
    EmulatedTracker,
    Emulator,
    Faults,
    Link,
    Playback,
    PtyLink,
    TcpLink,
)
from tactile_bayes.scans import Scan


def short_scan(duration_s: float = 1.0, *, seed: int = 3) -> Scan:
    """A scan with a lump, long enough to map."""
    strokes = Strokes(lines=2, spacing_mm=8.0, half_length_mm=20.0)
    scene = Scene(duration_s=duration_s, lumps=(Lump(),), strokes=strokes)
    return simulate(scene, rng=np.random.default_rng(seed)).scan


@contextmanager
def serving(
    device: Device, link: Link, faults: Faults | None = None, *, stage: Playback | None = None, leads: bool = True
) -> Iterator[Emulator]:
    """Serve a device until the block ends; the emulator's link says where."""
    rng = np.random.default_rng(1)
    emulator = Emulator(device, link, faults=faults or Faults(), rng=rng, stage=stage or Playback(), leads=leads)
    thread = threading.Thread(target=emulator.run, daemon=True)
    thread.start()
    try:
        yield emulator
    finally:
        was_unplugged, emulator.unplugged = emulator.unplugged, True
        thread.join(5.0)
        assert not thread.is_alive()
        if not was_unplugged:
            link.close()


@contextmanager
def head_and_tracker(
    scan: Scan,
    *,
    head_faults: Faults | None = None,
    tracker_faults: Faults | None = None,
    protocol: str = "open",
    tcp: bool = False,
    speed: float = 1.0,
) -> Iterator[list[str]]:
    """Both devices of a scan; the words that tell `record` about them."""
    links: list[Link] = [TcpLink("127.0.0.1", 0), TcpLink("127.0.0.1", 0)] if tcp else [PtyLink(), PtyLink()]
    stage = Playback(speed=speed)
    tracker = EmulatedTracker(scan.poses, protocol=protocol, faults=tracker_faults)
    with (
        serving(EmulatedHead(scan), links[0], head_faults, stage=stage),
        serving(tracker, links[1], tracker_faults, stage=stage, leads=False),
    ):
        yield ["--head", links[0].url, "--tracker", links[1].url, "--tracker-protocol", protocol]


def wait_for_bytes(path: Path, size: int) -> None:
    """Until a recording has written that much."""
    for _ in range(6000):
        if path.exists() and path.stat().st_size >= size:
            return
        time.sleep(0.01)
    raise AssertionError(f"{path} did not grow")
