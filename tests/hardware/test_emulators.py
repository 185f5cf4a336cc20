"""Emulated devices: started again, ended when everything was read, and playing one scan together."""

from __future__ import annotations

import contextlib
import os
import pty
import re
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
from emulated_devices import serving, short_scan

from tactile_bayes.actions.devices import _link, emulate_action
from tactile_bayes.errors import DeviceError, UsageError
from tactile_bayes.files.provenance import Provenance
from tactile_bayes.files.scan_mcap import write_scan
from tactile_bayes.hardware import head
from tactile_bayes.hardware.emulated import (
    EmulatedHead,
    EmulatedTracker,
    Emulator,
    Faults,
    Link,
    Playback,
    PtyLink,
    TcpLink,
)
from tactile_bayes.hardware.head import HeadParser, encode_command
from tactile_bayes.hardware.ports import Port
from tactile_bayes.hardware.readings import EndReading, FrameReading, PoseReading
from tactile_bayes.hardware.serial_trackers import TRACKERS

SCAN = short_scan(0.2)
START, STOP = encode_command(head.START, every=1), encode_command(head.STOP)


def read_until(port: Port, parser, done) -> list:
    """Readings until ``done(readings)``; fails when nothing comes for a while."""
    found = []
    while not done(found):
        data = port.read_some(5.0)
        assert data, f"nothing more came after {len(found)} readings"
        found += parser.feed(data)
    return found


def poses_of(found) -> list[PoseReading]:
    return [one for one in found if isinstance(one, PoseReading)]


def ended(found) -> bool:
    return bool(found) and isinstance(found[-1], EndReading)


def played_once(link: Link, *, speed: float) -> tuple[Port, threading.Thread]:
    """A port to an emulated head that plays its scan once, and the thread that it runs in."""
    stage = Playback(speed=speed)
    emulator = Emulator(EmulatedHead(SCAN), link, faults=Faults(), rng=np.random.default_rng(1), stage=stage)
    thread = threading.Thread(target=lambda: emulator.run(once=True), daemon=True)
    thread.start()
    return Port(link.url, baud=9600, role="head"), thread


def is_last(pose: PoseReading) -> bool:
    return bool(np.abs(np.array(pose.position_mm) - SCAN.poses.position_mm[-1]).max() < 1e-3)


@pytest.mark.long
@pytest.mark.parametrize("link_of", [PtyLink, lambda: TcpLink("127.0.0.1", 0)], ids=["pty", "tcp"])
def test_a_head_that_has_sent_everything_can_be_started_again(link_of):
    with serving(EmulatedHead(SCAN), link_of()) as emulator:
        port = Port(emulator.link.url, baud=9600, role="head")
        for _ in range(3):
            port.write(START)
            found = read_until(port, HeadParser(), ended)
            assert sum(isinstance(one, FrameReading) for one in found) == len(SCAN.frames)
        port.close()


@pytest.mark.parametrize("protocol", ["fastrak", "liberty", "bird", "open"])
def test_a_tracker_plays_from_each_start(protocol):
    driver, number = TRACKERS[protocol], len(SCAN.poses)
    with serving(EmulatedTracker(SCAN.poses, protocol=protocol), PtyLink()) as emulator:
        port = Port(emulator.link.url, baud=9600, role="tracker")
        for _ in range(2):
            port.write(driver.start)
            # the first play's END may still be in the line when the second starts
            found = poses_of(read_until(port, driver.parser(), lambda found: len(poses_of(found)) >= number))
            np.testing.assert_allclose(found[0].position_mm, SCAN.poses.position_mm[0], atol=0.2)
            np.testing.assert_allclose(found[number - 1].position_mm, SCAN.poses.position_mm[-1], atol=0.2)
        port.close()


@pytest.mark.long
def test_a_server_plays_for_each_host_that_connects():
    with serving(EmulatedTracker(SCAN.poses, protocol="igtlink"), TcpLink("127.0.0.1", 0)) as emulator:
        for _ in range(2):
            port = Port(emulator.link.url, baud=9600, role="tracker")
            # opening a port throws away what has come by then
            found = read_until(port, TRACKERS["igtlink"].parser(), lambda found: found and is_last(found[-1]))
            assert len(found) > 1
            port.close()
            time.sleep(0.05)


@pytest.mark.long
@pytest.mark.parametrize("link_of", [PtyLink, lambda: TcpLink("127.0.0.1", 0)], ids=["pty", "tcp"])
def test_once_ends_when_a_slow_host_has_read_the_last_frame(link_of):
    port, thread = played_once(link_of(), speed=10.0)
    port.write(START)
    time.sleep(1.0)  # the scan is over long before anything is read
    found = read_until(port, HeadParser(), ended)
    assert sum(isinstance(one, FrameReading) for one in found) == len(SCAN.frames)
    port.close()
    thread.join(10.0)
    assert not thread.is_alive()


def test_once_ends_when_its_host_stops_before_the_end():
    """`emulate both --once` waited for ever once `record` had stopped."""
    port, thread = played_once(PtyLink(), speed=1.0)
    for command in (STOP, START, STOP):  # the first STOP is asked before the head is known
        assert thread.is_alive()
        with contextlib.suppress(DeviceError):  # after the last STOP the line may go before the host has flushed it
            port.write(command)
        time.sleep(0.05)
    port.close()
    thread.join(5.0)
    assert not thread.is_alive()


@pytest.mark.parametrize("link_of", [PtyLink, lambda: TcpLink("127.0.0.1", 0)], ids=["pty", "tcp"])
def test_once_ends_when_its_host_has_gone_without_a_stop(monkeypatch, link_of):
    """After a `record` that was killed the rest of the scan waited in the emulator's buffer for good."""
    monkeypatch.setattr("tactile_bayes.hardware.emulated.LINGER_S", 0.2)
    port, thread = played_once(link_of(), speed=10.0)
    port.write(START)
    time.sleep(0.05)
    port.close()
    thread.join(5.0)
    assert not thread.is_alive()


def test_an_emulated_network_tracker_needs_a_network_port(tmp_path):
    """On a pseudo-terminal it sent nothing, and `record` advised to start its stream."""
    write_scan(tmp_path / "scan.mcap", SCAN, provenance=Provenance("test", {}))
    given = {"scan": tmp_path / "scan.mcap", "once": True, "speed": 1.0, "seed": 1}
    with pytest.raises(UsageError, match="network; give --tcp 127"):
        emulate_action(kind="both", protocol="igtlink", tcp=None, **given)


def test_a_head_in_the_trackers_place_is_refused():
    """It was recorded to the end of the exam, which had no pose then."""
    with serving(EmulatedHead(SCAN), PtyLink()) as emulator:
        port = Port(emulator.link.url, baud=9600, role="tracker")
        with pytest.raises(DeviceError, match="is a scan head; give the tracker's port"):
            TRACKERS["open"].check(port)
        port.close()


def test_a_tracker_waits_for_the_head_with_its_first_pose(monkeypatch):
    monkeypatch.setattr("tactile_bayes.hardware.emulated._SETTLE_S", 0.05)
    stage, driver = Playback(), TRACKERS["liberty"]
    tracker = EmulatedTracker(SCAN.poses, protocol="liberty")
    with (
        serving(EmulatedHead(SCAN), PtyLink(), stage=stage) as leader,
        serving(tracker, PtyLink(), stage=stage, leads=False) as follower,
    ):
        poses, frames = (Port(one.link.url, baud=9600, role="x") for one in (follower, leader))
        poses.write(driver.start)
        parser = driver.parser()
        held = read_until(poses, parser, lambda found: len(found) >= 5)
        assert {one.position_mm for one in held} == {held[0].position_mm}
        frames.write(START)
        played = read_until(poses, parser, lambda found: any(one.device_ns > 0 for one in found))
        assert len(read_until(frames, HeadParser(), ended)) == len(SCAN.frames) + 2  # and HELLO and END
        played += read_until(
            poses, parser, lambda found: found and found[-1].device_ns >= SCAN.poses.time_s[-1] * 1e9 - 1e6
        )
        assert len({one.position_mm for one in played}) == len(SCAN.poses)
        assert all(isinstance(one, PoseReading) for one in played)
        poses.close()
        frames.close()


@pytest.mark.long
def test_a_replay_in_a_terminal_starts_at_once(tmp_path, child_environment):
    write_scan(tmp_path / "scan.mcap", SCAN, provenance=Provenance("test", {}))
    near, far = pty.openpty()
    done = subprocess.run(
        [sys.executable, "-m", "tactile_bayes", "replay", "scan.mcap", "-o", "again.mcap"],
        cwd=tmp_path,
        env=child_environment,
        stdin=far,
        capture_output=True,
        text=True,
        timeout=60,
    )
    os.close(near)
    os.close(far)
    assert done.returncode == 0, done.stderr
    assert re.search(r"again.mcap: scan, ended by the head stopped\n40 frames", done.stdout)


@pytest.mark.parametrize(
    ("given", "host"), [(":0", "127.0.0.1"), ("127.0.0.1:0", "127.0.0.1"), ("0.0.0.0:0", "0.0.0.0")]
)
def test_a_port_without_an_address_is_for_this_computer_only(given: str, host: str) -> None:
    link = _link(given, after=0)
    try:
        assert link.url.startswith(f"socket://{host}:")
    finally:
        link.close()


def test_a_head_whose_cable_is_pulled_on_request_ends_the_tracker_too(tmp_path, monkeypatch):
    """`emulate both --disconnect 2` never ended: the tracker, told to stop meanwhile, came to no record."""

    def serve(emulator: Emulator, *, once: bool) -> None:
        while not (emulator.leads or once or emulator.unplugged):
            time.sleep(0.01)

    write_scan(tmp_path / "scan.mcap", short_scan(0.2), provenance=Provenance("test", {}))
    monkeypatch.setattr(Emulator, "run", serve)
    given = {"kind": "both", "scan": tmp_path / "scan.mcap", "protocol": "open", "tcp": None, "speed": 1.0, "seed": 1}
    thread = threading.Thread(target=emulate_action, kwargs={**given, "once": False}, daemon=True)
    thread.start()
    thread.join(5.0)
    assert not thread.is_alive()
