"""Ports over the network by RFC 2217, tried with pyserial's own server on the loopback."""

from __future__ import annotations

import socket
import time

import numpy as np
import pytest
from emulated_devices import serving, short_scan
from rfc2217_server import rfc2217

from tactile_bayes.errors import DeviceError
from tactile_bayes.files.provenance import Provenance
from tactile_bayes.files.scan_mcap import read_scan, write_scan
from tactile_bayes.hardware.emulated import EmulatedHead, EmulatedTracker, PtyLink
from tactile_bayes.hardware.serial_trackers import TRACKERS, open_tracker

# pyserial 3.5 starts its thread in an old way.
pytestmark = pytest.mark.filterwarnings("ignore:set(Daemon|Name):DeprecationWarning")


@pytest.mark.long
def test_a_scan_recorded_over_the_network_is_the_scan(run_cli, tmp_path):
    scan = short_scan(2.0)
    write_scan(tmp_path / "source.mcap", scan, provenance=Provenance("test", {}))
    lines = [PtyLink(), PtyLink()]
    with (
        serving(EmulatedHead(scan), lines[0]),
        serving(EmulatedTracker(scan.poses, protocol="open"), lines[1]),
        rfc2217(lines[0].url) as head,
        rfc2217(lines[1].url) as tracker,
    ):
        words = ["--head", head, "--tracker", tracker, "--tracker-protocol", "open", "--clock", "shared"]
        done = run_cli("record", "-o", "a.mcap", *words, "--like", "source.mcap", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    found = read_scan(tmp_path / "a.mcap")
    np.testing.assert_array_equal(found.frames.counts, scan.frames.counts)
    np.testing.assert_array_equal(found.poses.position_mm, scan.poses.position_mm)
    np.testing.assert_array_equal(found.poses.quaternion_wxyz, scan.poses.quaternion_wxyz)


@pytest.mark.long
def test_bytes_that_telnet_would_take_for_its_own_come_through():
    """255 begins a command of the protocol underneath: poses full of it must not."""
    scan = short_scan(0.5)
    line = PtyLink()
    with serving(EmulatedTracker(scan.poses, protocol="fastrak"), line), rfc2217(line.url) as url:
        port = open_tracker("fastrak", url)
        assert TRACKERS["fastrak"].check(port).tools == {"1": ""}
        port.write(TRACKERS["fastrak"].start)
        parser, found, end = TRACKERS["fastrak"].parser(), [], time.monotonic() + 20.0
        while len(found) < len(scan.poses) and time.monotonic() < end:
            found += parser.feed(port.read_some(0.1))
        port.close()
    assert len(found) == len(scan.poses)
    assert parser.garbage_bytes == 0


@pytest.mark.long
def test_settings_are_not_negotiated_again_for_every_read(monkeypatch):
    line = PtyLink()
    with serving(EmulatedTracker(short_scan(0.2).poses, protocol="fastrak"), line), rfc2217(line.url) as url:
        port = open_tracker("fastrak", url)
        asked = []
        monkeypatch.setattr(port._serial, "_reconfigure_port", lambda: asked.append(1))
        for _ in range(5):
            port.read_some(0.01)
        assert not asked
        port.close()


# pyserial 3.5 forgets the socket it gives up.
@pytest.mark.long
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_server_that_does_not_speak_it_is_one_line():
    with socket.create_server(("127.0.0.1", 0)) as listener:
        url = f"rfc2217://127.0.0.1:{listener.getsockname()[1]}"
        with pytest.raises(DeviceError, match=r"tracker rfc2217://.* cannot be opened") as error:
            open_tracker("fastrak", url)  # nobody accepts, but the system does
    assert "\n" not in str(error.value)
