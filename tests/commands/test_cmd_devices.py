"""`devices` and `replay`, and the sense of a tracker's rotations."""

from __future__ import annotations

import os
import signal
import subprocess
import sys

import numpy as np
import pytest
from emulated_devices import serving, short_scan, wait_for_bytes

from tactile_bayes.declarations import replace
from tactile_bayes.errors import BadDataError
from tactile_bayes.files.provenance import Provenance
from tactile_bayes.files.scan_mcap import read_scan, write_scan
from tactile_bayes.forward.scene import rotation_from_vector
from tactile_bayes.geometry import quaternion_from_rotation
from tactile_bayes.hardware.emulated import EmulatedHead, EmulatedTracker, PtyLink
from tactile_bayes.hardware.head import rotation_sense
from tactile_bayes.hardware.ports import guess_device
from tactile_bayes.scans import TrackerPoses


def pivoting(turn_deg: float = 40.0, *, count: int = 200, noise_mm: float = 0.3) -> TrackerPoses:
    """Poses of a sensor that turns about a point 80 mm from it."""
    rng, time = np.random.default_rng(2), np.arange(count) / 100
    vector = np.radians(turn_deg) / 2 * np.stack([np.sin(3 * time), np.cos(5 * time), np.sin(2 * time)], axis=-1)
    rotation = rotation_from_vector(vector)
    position = np.array([100.0, -50.0, 30.0]) - rotation @ np.array([10.0, 20.0, 77.0])
    position += noise_mm * rng.standard_normal(position.shape)
    return TrackerPoses(time, position, np.array([quaternion_from_rotation(one) for one in rotation]))


def test_a_fixed_point_tells_the_sense_of_the_rotations():
    poses = pivoting()
    right = rotation_sense(poses.position_mm, poses.quaternion_wxyz)
    assert right.as_given_mm < 0.7
    assert right.inverted_mm > 5
    assert "record as it is" in str(right)
    wrong = rotation_sense(poses.position_mm, poses.quaternion_wxyz * [1, -1, -1, -1])
    assert (wrong.as_given_mm, wrong.inverted_mm) == pytest.approx((right.inverted_mm, right.as_given_mm))
    assert "--invert-rotation" in str(wrong)


def test_a_point_that_moves_is_not_clear():
    poses = pivoting(noise_mm=40.0)
    assert "not clear" in str(rotation_sense(poses.position_mm, poses.quaternion_wxyz))


@pytest.mark.parametrize(("options", "words"), [({"turn_deg": 5.0}, "turned by"), ({"count": 5}, "too few")])
def test_too_little_turning_is_refused(options, words):
    poses = pivoting(**options)
    with pytest.raises(BadDataError, match=words):
        rotation_sense(poses.position_mm, poses.quaternion_wxyz)


@pytest.mark.parametrize(
    ("vendor", "product", "words"),
    [
        (0x0F44, "", "tracker (Polhemus)"),
        (0x2E8A, "Pico", "scan head, perhaps"),
        (None, "Tactile head 3", "scan head, perhaps"),
        (0x0403, "FT232R", "serial adapter"),
        (None, "", "unknown"),
        (0x1234, "mouse", "unknown"),
    ],
)
def test_a_guessed_device_is_said_to_be_a_guess(vendor, product, words):
    assert words in guess_device(vendor, product)


def test_a_pivot_beside_a_probe_is_refused(run_cli):
    """It was not made, without a word."""
    done = run_cli("devices", "--probe", "/dev/null", "--pivot", "/dev/null")
    assert done.returncode == 2
    assert "give one of them" in done.stderr


def test_ports_are_listed(run_cli):
    done = run_cli("devices")
    assert done.returncode == 0, done.stderr
    assert done.stdout


def test_a_head_is_found_by_asking(run_cli):
    with serving(EmulatedHead(short_scan(0.3)), PtyLink()) as emulator:
        done = run_cli("devices", "--probe", emulator.link.url)
    assert done.returncode == 0, done.stderr
    assert "scan head 'emulated', 16 x 26 taxels, 200 Hz" in done.stdout


@pytest.mark.slow
@pytest.mark.parametrize("protocol", ["fastrak", "liberty", "bird"])
def test_a_tracker_is_found_by_asking(run_cli, protocol):
    with serving(EmulatedTracker(short_scan(0.3).poses, protocol=protocol), PtyLink()) as emulator:
        done = run_cli("devices", "--probe", emulator.link.url)
    assert done.returncode == 0, done.stderr
    assert f"--tracker-protocol {protocol}" in done.stdout


@pytest.mark.long
def test_a_pivot_is_measured_on_the_tracker_itself(run_cli):
    with serving(EmulatedTracker(pivoting(), protocol="bird"), PtyLink()) as emulator:
        words = ["--pivot", emulator.link.url, "--tracker-protocol", "bird", "--duration", 0.5]
        done = run_cli("devices", *words)
    assert done.returncode == 0, done.stderr
    assert "record as it is" in done.stdout


@pytest.mark.long
def test_a_replay_goes_the_way_of_a_recording(run_cli, tmp_path):
    scan = replace(short_scan(0.5), session={"source": "simulated", "side": "left", "subject": "P7"})
    write_scan(tmp_path / "a.mcap", scan, provenance=Provenance("test", {}))
    done = run_cli("replay", "a.mcap", "-o", "b.mcap", "--speed", 2, "--live", cwd=tmp_path, env={"TERM": "dumb"})
    assert done.returncode == 0, done.stderr
    assert "frames lost 0" in done.stdout
    assert "kPa" in done.stderr
    again = read_scan(tmp_path / "b.mcap")
    np.testing.assert_array_equal(again.frames.counts, scan.frames.counts)
    np.testing.assert_array_equal(again.poses.position_mm, scan.poses.position_mm)
    assert dict(again.session) | dict(scan.session) == dict(again.session)  # a simulated scan is none of a person
    shown = run_cli("show", "b.mcap", cwd=tmp_path)
    assert "frames_missing  0" in shown.stdout
    assert "the head stopped" in shown.stdout


@pytest.mark.long
def test_no_module_is_taken_from_the_current_folder(tmp_path, run_python):
    """Any numpy.py in a folder of scans was run by the emulated devices and the live view."""
    write_scan(tmp_path / "a.mcap", short_scan(1.0), provenance=Provenance("test", {}))
    (tmp_path / "numpy.py").write_text("open('taken', 'w')\n")
    done = run_python("-P", "-m", "tactile_bayes", "replay", "a.mcap", "--live", cwd=tmp_path, env={"TERM": "dumb"})
    assert done.returncode == 0, done.stderr
    assert "live view: " in done.stderr
    assert not (tmp_path / "taken").exists()


@pytest.mark.long
def test_a_signal_to_a_replay_and_its_devices_ends_it_in_order(tmp_path, child_environment):
    """With `timeout` the emulated devices died first: "the device has gone", exit code 4."""
    write_scan(tmp_path / "a.mcap", short_scan(20.0), provenance=Provenance("test", {}))
    process = subprocess.Popen(
        [sys.executable, "-m", "tactile_bayes", "replay", "a.mcap", "-o", "b.mcap"],
        cwd=tmp_path,
        env=child_environment,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    try:
        wait_for_bytes(tmp_path / "b.mcap", 60_000)
    finally:
        os.killpg(process.pid, signal.SIGTERM)
    out, err = process.communicate(timeout=60)
    assert process.returncode == 0, err
    assert "ended by SIGTERM" in out
