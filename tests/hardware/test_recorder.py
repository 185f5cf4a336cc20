"""The parts of a recording: reading processes, clocks, landmarks, emulated faults, ports."""

from __future__ import annotations

import os
import select
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from emulated_devices import short_scan
from hypothesis import given
from hypothesis import strategies as st

from tactile_bayes.commands.devices import PROTOCOLS as CHOICES
from tactile_bayes.errors import DeviceError
from tactile_bayes.files import scan_mcap
from tactile_bayes.files.provenance import Provenance
from tactile_bayes.geometry import inverse, quaternion_from_rotation, rigid
from tactile_bayes.hardware import reading
from tactile_bayes.hardware.emulated import EmulatedTracker, Faults, PtyLink, is_during
from tactile_bayes.hardware.ports import Port, Stream, preview, read_in_process
from tactile_bayes.hardware.readings import ArrivalClock, PoseClock, PoseReading
from tactile_bayes.hardware.recorder import LandmarkTouch
from tactile_bayes.hardware.serial_trackers import PROTOCOLS, TRACKERS


def read_all(stream: Stream, size: int) -> bytes:
    """What comes, up to `size` bytes."""
    found = b""
    while len(found) < size:
        assert select.select([stream], [], [], 10.0)[0], f"{len(found)} of {size} bytes came"
        found += b"".join(data for _, data in stream.read())
        if stream.ended:
            break
    return found


@pytest.fixture
def line():
    """A reading process on a pipe of the test: what to write to, and the stream."""
    device, ours = os.pipe()
    near, far = os.pipe()
    process = subprocess.Popen(
        [sys.executable, "-I", "-S", reading.__file__, str(device), str(far)], pass_fds=(device, far)
    )
    os.close(device)
    os.close(far)
    os.set_blocking(near, False)
    stream = Stream(process, near)
    yield ours, stream
    stream.close()


def test_a_reader_hands_over_what_it_reads_in_order_with_rising_times(line):
    ours, stream = line
    sent = [os.urandom(700) for _ in range(50)]
    stamps, found = [], b""
    for data in sent:
        os.write(ours, data)
    while len(found) < 35_000:
        assert select.select([stream], [], [], 10.0)[0]
        for host_ns, data in stream.read():
            stamps.append(host_ns)
            found += data
    assert found == b"".join(sent)
    assert stamps == sorted(stamps)
    os.close(ours)


def test_a_reader_says_when_it_reads_and_nothing_of_that_is_data(line):
    ours, stream = line
    assert not stream.ready
    stream.wait_until_ready()
    assert stream.ready
    os.write(ours, b"first")
    assert read_all(stream, 5) == b"first"
    os.close(ours)


def test_a_reader_that_does_not_come_is_not_waited_for_without_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tactile_bayes.hardware.ports.READY_S", 0.05)
    device, far = os.pipe()
    process = subprocess.Popen([sys.executable, "-c", "import sys; sys.stdin.read()"], stdin=subprocess.PIPE)
    stream = Stream(process, device)
    stream.wait_until_ready()
    assert not stream.ready
    process.stdin.close()
    stream.close()
    os.close(far)


def test_a_reader_tells_when_the_device_has_gone(line):
    ours, stream = line
    os.write(ours, b"last words")
    os.close(ours)
    assert read_all(stream, 1000) == b"last words"
    for _ in range(100):
        if stream.ended:
            break
        select.select([stream], [], [], 0.1)
        stream.read()
    assert stream.ended


def test_a_full_pipe_loses_whole_records_and_counts_them(line):
    ours, stream = line
    sent = 0
    for _ in range(100):  # nobody reads: the pipe takes 64 KiB, the rest has nowhere to go
        sent += os.write(ours, b"x" * 4000)
        time.sleep(0.001)
    time.sleep(0.2)
    kept = 0
    while select.select([stream], [], [], 0.3)[0]:
        kept += sum(len(data) for _, data in stream.read())
    os.write(ours, b"y")
    kept += len(read_all(stream, 1))
    assert stream.overrun_bytes > 0
    assert kept + stream.overrun_bytes == sent + 1
    os.close(ours)


def test_a_reader_leaves_when_nobody_listens(line):
    ours, stream = line
    os.close(stream.pipe)
    os.write(ours, b"x")
    assert stream.process.wait(10.0) == 0
    stream.pipe = os.open("/dev/null", os.O_RDONLY)
    os.close(ours)


def test_the_reader_imports_nothing_of_ours():
    text = Path(reading.__file__).read_text(encoding="utf-8")
    assert "tactile_bayes" not in text
    assert "numpy" not in text


def test_a_port_without_descriptor_is_read_all_the_same():
    port = Port("loop://", baud=9600, role="tracker")
    stream = read_in_process(port)
    port.write(b"round and round")
    assert read_all(stream, 15) == b"round and round"
    stream.close()
    port.close()


@pytest.mark.parametrize(
    ("data", "words"), [(b"", "nothing"), (b"hello\r\n", repr("hello\r\n")), (bytes(20), "00 00 00"), (b"\xff", "ff")]
)
def test_an_unexpected_reply_is_quoted(data, words):
    assert words in preview(data)


def test_a_port_that_another_program_has_open_says_so():
    link = PtyLink()
    port = Port(link.url, baud=9600, role="head")
    with pytest.raises(DeviceError, match=r"cannot be opened \(another program has it open\)"):
        Port(link.url, baud=9600, role="tracker")
    port.close()
    link.close()


@pytest.mark.parametrize("name", TRACKERS)
def test_every_driver_says_in_one_line_that_nobody_answers(name, monkeypatch):
    monkeypatch.setattr("tactile_bayes.hardware.serial_trackers.ANSWER_S", 0.05)
    near, far = os.openpty()
    port = Port(os.ttyname(far), baud=9600, role="tracker")
    with pytest.raises(DeviceError) as error:
        TRACKERS[name].check(port)
    assert "\n" not in str(error.value)
    for words in (os.ttyname(far), TRACKERS[name].title, "nothing came"):
        assert words in str(error.value)
    port.close()
    os.close(near)
    os.close(far)


def test_every_emulated_protocol_has_a_driver_and_the_other_way_round():
    assert {*PROTOCOLS, "ndi"} == set(TRACKERS) == set(CHOICES)  # an NDI tracker streams nothing: EmulatedNdi answers


@pytest.mark.parametrize("name", PROTOCOLS)
def test_a_driver_reads_what_the_emulated_tracker_says(name):
    poses = short_scan(0.2).poses
    tracker, parser = EmulatedTracker(poses, protocol=name), TRACKERS[name].parser()
    found = [one for i in range(len(poses)) for one in parser.feed(tracker.record(i))]
    assert len(found) == len(poses)
    assert parser.garbage_bytes == 0
    step = {"bird": 0.12, "fastrak-ascii": 0.13, "liberty-ascii": 2e-4, "open": 1e-12}.get(name, 2e-5)
    np.testing.assert_allclose([one.position_mm for one in found], poses.position_mm, rtol=0, atol=step)
    timed = name in ("liberty", "liberty-ascii", "open", "igtlink")
    assert timed == (found[-1].device_ns is not None)  # OpenIGTLink has no time 0


def test_settings_and_letters_may_come_in_one_piece():
    tracker = EmulatedTracker(short_scan(0.2).poses, protocol="fastrak")
    assert tracker.respond(b"cUO1,2,11,0\rf") == b""
    assert len(tracker.respond(b"P")) == 32
    tracker.respond(b"C")
    assert tracker.streaming


@given(
    offset=st.integers(-(10**12), 10**12),
    delays=st.lists(st.integers(0, 20_000_000), min_size=2, max_size=100),
)
def test_the_offset_of_a_clock_is_the_least_delay(offset, delays):
    clock = ArrivalClock()
    for i, delay in enumerate(delays):
        device_ns = i * 5_000_000
        clock.observe(device_ns, device_ns + offset + delay)
    assert clock.offset_ns == offset + min(delays)


def test_a_drifting_clock_is_followed():
    clock, drift = ArrivalClock(), 100e-6
    rng = np.random.default_rng(4)
    for i in range(12_000):
        device_ns = i * 5_000_000
        clock.observe(device_ns, round(device_ns * (1 + drift)) + int(rng.integers(0, 3_000_000)))
    true = 12_000 * 5_000_000 * drift
    assert abs(clock.offset_ns - true) < 1e6  # 6 ms of drift in a minute; the last seconds' share is left


def test_poses_are_placed_by_arrival_or_by_a_shared_clock():
    shared, arrival, clocked = PoseClock(shared=True), PoseClock(shared=False), PoseClock(shared=False)
    assert arrival.time_of(None, 10**9) is None  # no frame yet
    for clock in (shared, arrival, clocked):
        clock.head.read(2 * 10**9, 5 * 10**9)  # the head's zero is 3 s into the host's time
    assert shared.time_of(2_004_000_000, 5_010_000_000) == (2_004_000_000, "")
    assert arrival.time_of(None, 5_010_000_000) == (2_010_000_000, "")
    # with a clock of its own, a pose that was held up on its way keeps its place
    first = clocked.time_of(100_000_000, 5_010_000_000)
    late = clocked.time_of(110_000_000, 5_090_000_000)
    assert (first.time_ns, late.time_ns) == (2_010_000_000, 2_020_000_000)


def test_a_landmark_is_where_the_apex_touches_however_the_handle_is_held():
    rng, point = np.random.default_rng(3), np.array([10.0, -20.0, 30.0])
    lever = rigid(np.eye(3), np.array([5.0, 6.0, -70.0]))
    apex = inverse(lever)[:3, 3]
    result, enough = LandmarkTouch("xiphoid", scanhead_from_tracker=lever, samples=50), False
    for _ in range(50):
        assert not enough
        turn = np.linalg.qr(rng.standard_normal((3, 3)))[0]
        turn *= np.linalg.det(turn)
        position = point - turn @ apex + 0.2 * rng.standard_normal(3)
        q = quaternion_from_rotation(turn)
        enough = result.add(PoseReading(tuple(position), tuple(q), flags=()))
    assert enough
    assert np.abs(result.position_mm - point).max() < 0.15
    assert 0.2 < result.spread_mm < 0.5
    assert "spread 0." in str(result)
    assert result.steady


def test_a_landmark_that_slipped_says_so_and_doubtful_poses_do_not_count():
    touch = LandmarkTouch("xiphoid", scanhead_from_tracker=np.eye(4), samples=2)
    assert not touch.add(PoseReading((0, 0, 0), (1, 0, 0, 0)))
    assert not touch.add(PoseReading((9, 9, 9), (1, 0, 0, 0), flags=("error W",)))
    assert touch.add(PoseReading((9, 0, 0), (1, 0, 0, 0)))
    assert not touch.steady
    assert "touch it again" in str(touch)


def test_faults_come_as_often_as_asked():
    rng = np.random.default_rng(1)
    faults = Faults(drop=0.1, corrupt=0.2)
    sent = [faults.disturb(b"record", rng) for _ in range(4000)]
    assert 0.08 < sum(one == b"" for one in sent) / 4000 < 0.12
    assert 0.16 < sum(one not in (b"", b"record") for one in sent) / 4000 < 0.20
    assert all(len(one) in (0, 6) for one in sent)
    assert Faults().disturb(b"record", rng) == b"record"
    assert [is_during((1.0, 0.5), t) for t in (0.9, 1.0, 1.49, 1.5)] == [False, True, True, False]


@pytest.fixture
def synced(tmp_path, monkeypatch):
    """A writer whose way to the disk is watched: when it was gone, and what was on the file then."""
    scan, seen = short_scan(0.2), []
    path = tmp_path / "a.mcap"
    monkeypatch.setattr(scan_mcap, "SYNC_S", 0.05)
    monkeypatch.setattr(os, "fdatasync", lambda _: seen.append((threading.get_ident(), path.stat().st_size)))
    with scan_mcap.create_exclusive(path, force=False) as stream:
        writer = scan_mcap.RecordingWriter(
            stream,
            head=scan.head,
            element_calibration=scan.element_calibration,
            session={"source": "test"},
            provenance=Provenance("test", {}),
        )
        yield writer, scan, seen, path
        writer.stop_syncing()


def wait_until(done) -> None:
    for _ in range(1000):
        if done():
            return
        time.sleep(0.01)
    raise AssertionError("it did not come")


def test_what_was_flushed_is_seen_onto_the_disk_by_a_thread_of_its_own(synced):
    writer, scan, seen, path = synced
    wait_until(lambda: seen)  # the description of the scan
    before = len(seen)
    writer.add_frame(scan.frames.counts[0], device_ns=0, host_ns=0)
    writer.flush()
    wait_until(lambda: len(seen) > before)
    assert seen[-1][1] == path.stat().st_size
    assert threading.get_ident() not in {thread for thread, _ in seen}
    after = len(seen)
    time.sleep(0.3)
    assert len(seen) == after  # nothing new, nothing to do


def test_a_disk_that_fails_later_is_told_at_the_next_flush(synced, monkeypatch):
    writer, _, seen, _ = synced
    wait_until(lambda: seen)

    def fail(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fdatasync", fail)

    def flush_on() -> None:
        for _ in range(1000):
            writer.flush()
            time.sleep(0.01)

    with pytest.raises(OSError, match="No space left"):
        flush_on()
