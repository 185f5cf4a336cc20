"""Clocks that wrap, step, stand still or run wrong: no record is lost, and what happened is told."""

from __future__ import annotations

import select

import numpy as np
import pytest
from emulated_devices import short_scan
from hypothesis import given
from hypothesis import strategies as st

from tactile_bayes.declarations import replace
from tactile_bayes.errors import BadDataError, DeviceError
from tactile_bayes.files.provenance import Provenance
from tactile_bayes.files.scan_mcap import ScanWriter, read_scan
from tactile_bayes.findings import finding
from tactile_bayes.hardware.readings import (
    LATEST_NS,
    MOST_STEPS,
    STILL_NS,
    WRAPS_NS,
    DeviceClock,
    EndReading,
    FrameReading,
    PoseClock,
    PoseReading,
    wrap_period,
)
from tactile_bayes.hardware.recorder import DeviceLine, LandmarkTouch, Recorder, RecordingReport
from tactile_bayes.mapping.select import Span, overlap_cautions, scan_findings, with_times
from tactile_bayes.scans import PressureFrames, TrackerPoses

S = 1_000_000_000
FRAME_NS = S // 200
COUNTS = np.zeros((2, 2), dtype=np.uint16)


class FakePort:
    """A port that is spoken to."""

    name = "tracker fake"

    def write(self, data: bytes) -> None:
        if data == b"gone":
            raise DeviceError("it has gone")


class FakeParser:
    garbage_bytes = 0
    fault = remark = ""


class FakeStream:
    ended = False
    overrun_bytes = 0

    def stop(self) -> None:
        """Nothing to stop."""


class Kept:
    """A sink that remembers."""

    def __init__(self) -> None:
        self.frames, self.poses, self.notes, self.landmarks = [], [], [], []

    def add_frame(self, _counts, *, device_ns, **_):
        self.frames.append(device_ns)

    def add_pose(self, *_, device_ns, **__):
        self.poses.append(device_ns)

    def add_landmark(self, name, *_, **__):
        self.landmarks.append(name)

    def add_note(self, text, *, device, **_):
        self.notes.append((device, text))

    def flush(self):
        """Nothing waits."""


class Session:
    """A recorder fed by hand, in a time of its own."""

    def __init__(self, *, shared: bool = False, tracker: bool = True, **options) -> None:
        self.now_ns, self.sink = 0, Kept()
        self.lines = [
            DeviceLine(role, FakePort(), FakeStream(), FakeParser(), b"", b"") for role in ("head", "tracker")
        ]
        self.recorder = Recorder(
            self.lines[0],
            self.lines[1] if tracker else None,
            self.sink,
            shared_clock=shared,
            clock_ns=lambda: self.now_ns,
            **options,
        )
        self.recorder.recording = True

    def frame(self, device_ns: int, **more) -> None:
        self.recorder._process(self.lines[0], FrameReading(COUNTS, device_ns, **more), self.now_ns)

    def pose(self, device_ns: int | None, x_mm: float = 0.0) -> None:
        self.recorder._process(self.lines[1], PoseReading((x_mm, 0, 0), (1, 0, 0, 0), device_ns), self.now_ns)

    def end(self) -> RecordingReport:
        self.recorder._add_cautions()
        return self.recorder.report


def test_an_old_record_that_is_sent_again_before_the_frames_does_not_stop_the_trackers_clock() -> None:
    """A tool hidden at the start: "the clock stood still", and poses were timed by their arrival from then on."""
    session = Session()
    for i in range(200):
        session.now_ns = i * FRAME_NS
        session.pose(S if i < 100 else S + session.now_ns, x_mm=float(max(0, i - 99)))
        session.now_ns += FRAME_NS // 2
        session.frame(i * FRAME_NS)
    report = session.end()
    assert report.tracker_clock_steps == 0
    assert (report.poses, report.missing_why) == (100, "an old record sent again 99")


@pytest.mark.parametrize(
    ("lost", "silent_s", "caution"),
    [
        (3, 0.0, "3 of 203 frames lost: check the head's cable"),
        (2, 0.4, None),
        (0, 0.6, "no frame came in the last 0.6"),
    ],
)
def test_frames_that_do_not_come_are_a_caution(lost: int, silent_s: float, caution: str | None) -> None:
    """A fifth of the frames lost, or a head that died before the end, were told by numbers alone, if at all."""
    session = Session(tracker=False)
    for i in range(200):
        session.now_ns = i * FRAME_NS
        session.frame(i * FRAME_NS, lost=lost if i == 50 else 0)
    session.now_ns += round(silent_s * S)
    session.recorder.stop("q")
    cautions = session.end().cautions
    assert [one for one in cautions if "frame" in one][:1] == [one for one in cautions if caution and caution in one]
    assert len(cautions) == (caution is not None)


def test_a_recording_without_a_frame_is_a_caution() -> None:
    session = Session(tracker=False)
    session.recorder.stop("q")
    assert session.end().cautions == ["no frame was recorded"]


def run_head(raw_of, *, seconds: float = 2.0, **options) -> tuple[Session, RecordingReport]:
    """A head at 200 Hz whose clock says ``raw_of(true time in ns)``."""
    session = Session(tracker=False, **options)
    for i in range(round(seconds * 200)):
        session.now_ns = i * FRAME_NS
        session.frame(raw_of(session.now_ns))
    return session, session.end()


def wrapping(period_ns: int, *, before_s: float = 1.0):
    """A counter of that period which wraps so long after the start."""
    return lambda true_ns: (true_ns + period_ns - round(before_s * S)) % period_ns


@pytest.mark.parametrize("period_ns", WRAPS_NS)
def test_a_counter_that_wraps_is_unwrapped_to_the_nanosecond(period_ns):
    session, report = run_head(wrapping(period_ns))
    assert np.unique(np.diff(session.sink.frames)).tolist() == [FRAME_NS]
    assert (report.head_clock_wraps, report.head_clock_steps, report.cautions) == (1, 0, [])
    assert session.sink.notes == [("head", f"the clock wrapped after {period_ns / 1e9:.6f} s")]


def test_32_bits_of_microseconds_wrap_as_a_head_sends_them():
    _, report = run_head(lambda true_ns: ((true_ns // 1000 + 2**32 - 700_000) % 2**32) * 1000)
    assert report.frames == 400
    assert report.duration_s == pytest.approx(1.995, abs=1e-6)
    assert report.head_clock_wraps == 1


@pytest.mark.parametrize(
    ("name", "raw_of"),
    [
        ("back by 7 s", lambda t: t + 10 * S - (7 * S if t >= S else 0)),
        ("back to 0", lambda t: t + 12_345_678_901 if t < S else t - S),
        ("forward by an hour", lambda t: t + (3600 * S if t >= S else 0)),
        ("a period of 37 s", wrapping(37 * S)),
        ("beyond 2^63 ns", lambda t: t + (2**63 if t >= S else 0)),
    ],
)
def test_a_step_is_told_and_nothing_is_lost(name, raw_of):
    session, report = run_head(raw_of)
    assert report.frames == len(session.sink.frames) == 400, name
    # the step itself is measured by when the frames arrived, here without delay
    assert np.diff(session.sink.frames).tolist() == [FRAME_NS] * 399
    assert report.head_clock_steps == 1
    assert len(session.sink.notes) == 1
    assert session.sink.notes[0][1].startswith("the clock stepped ")
    assert report.cautions == ["the head's clock stepped once; this computer's clock was used instead"]


@pytest.mark.parametrize("value", [0, 5 * S, 2**63])
def test_a_clock_that_stands_still_is_replaced(value):
    session, report = run_head(lambda _: value)
    assert report.frames == 400
    assert np.diff(session.sink.frames).min() >= 0
    late = np.array(session.sink.frames) - session.sink.frames[0] - FRAME_NS * np.arange(400)
    assert abs(late[-1]) < 1e6
    assert (np.abs(late) > 1e6).sum() * FRAME_NS <= STILL_NS + FRAME_NS
    assert any("stood still" in text for _, text in session.sink.notes)
    assert len(session.sink.notes) <= 2


def test_a_clock_of_coarse_ticks_is_no_clock_that_stands_still():
    session, report = run_head(lambda t: t // (20 * 10**6) * 20 * 10**6)
    assert report.head_clock_steps == 0
    assert session.sink.notes == []


@pytest.mark.parametrize(("factor", "steps"), [(1000, MOST_STEPS), (0.001, 0)])
def test_a_clock_in_another_unit_is_reported(factor, steps):
    _, report = run_head(lambda t: round(t * factor), seconds=3.0)
    assert report.frames == 600
    assert report.head_clock_steps == steps
    words = "stepped 20 times" if steps else "the head's clock ran 0.0 s while 3.0 s passed on this computer"
    assert any(words in text for text in report.cautions)


@pytest.mark.parametrize("start", [2**62, 2**63, 2**64 * 1000 - 5 * S])
def test_times_that_no_file_can_hold_are_brought_into_range(start):
    session, report = run_head(lambda t: start + t)
    assert 0 <= min(session.sink.frames) <= max(session.sink.frames) < 2**63
    assert np.unique(np.diff(session.sink.frames)).tolist() == [FRAME_NS]
    assert report.head_clock_steps == 1


@given(
    raws=st.lists(st.integers(0, 2**64 * 1000), min_size=1, max_size=60),
    gaps=st.lists(st.integers(0, S), min_size=60, max_size=60),
)
def test_whatever_a_clock_says_times_rise_and_fit_a_file(raws, gaps):
    clock, host, before = DeviceClock(), 0, 0
    for raw, gap in zip(raws, gaps, strict=False):
        host += gap
        time_ns = clock.read(raw, host).time_ns
        assert before <= time_ns < 2 * LATEST_NS
        before = time_ns


@pytest.mark.parametrize("raw_of", [lambda t: t, lambda _: 7, lambda t: t + (3600 * S if t >= S else 0)])
def test_a_duration_ends_whatever_the_clock_does(raw_of):
    session = Session(tracker=False, duration_s=3.0)
    for i in range(10 * 200):
        session.now_ns = i * FRAME_NS
        session.frame(raw_of(session.now_ns))
        session.recorder._check_host_time(session.now_ns)
        if session.recorder.report.ended_by:
            break
    assert session.recorder.report.ended_by == "duration"
    assert 3.0 <= session.now_ns / 1e9 <= 3.3
    assert session.recorder.report.frames == pytest.approx(600, abs=1)


def test_a_clock_that_lags_ends_by_this_computers():
    session = Session(tracker=False, duration_s=3.0)
    for i in range(10 * 200):
        session.now_ns = i * FRAME_NS
        session.frame(session.now_ns // 1000)
        session.recorder._check_host_time(session.now_ns)
        if session.recorder.report.ended_by:
            break
    assert session.recorder.report.ended_by == "duration, by this computer's clock"
    assert session.now_ns / 1e9 == pytest.approx(4.0, abs=0.1)


@pytest.mark.parametrize("shared", [False, True])
@pytest.mark.parametrize(
    ("name", "raw_of", "steps", "wraps"),
    [
        ("sound", lambda t: t, 0, 0),
        ("32 bits of us", wrapping((1 << 32) * 1000), 0, 1),
        ("back", lambda t: t + 10 * S - (7 * S if t >= S else 0), 1, 0),
        ("forward", lambda t: t + (3600 * S if t >= S else 0), 1, 0),
        ("constant", lambda _: 7 * S, 1, 0),
    ],
)
def test_a_trackers_clock_may_do_all_that_too(shared, name, raw_of, steps, wraps):
    session = Session(shared=shared)
    for i in range(3 * 200):
        session.now_ns = i * FRAME_NS
        session.frame(raw_of(session.now_ns) if shared else session.now_ns)
        session.pose(raw_of(session.now_ns), x_mm=float(i))
    report = session.end()
    assert (report.frames, report.poses) == (600, 600), name
    assert (report.tracker_clock_steps, report.tracker_clock_wraps) == (steps, wraps)
    apart_ns = np.abs(np.array(session.sink.poses) - np.array(session.sink.frames))
    settled = slice(round(1.1 * STILL_NS / FRAME_NS), None) if name == "constant" else slice(None)
    assert apart_ns[settled].max() < 1e6
    assert len([1 for device, _ in session.sink.notes if device == "tracker"]) == steps + wraps


def test_poses_keep_their_order_when_they_are_placed():
    clock = PoseClock(shared=False)
    clock.head.read(0, 0)
    times = [clock.time_of(None, host).time_ns for host in (10, 30, 20, 40)]
    assert times == sorted(times)


def test_a_restart_is_no_wrap():
    assert wrap_period(2**32 * 1000 - 5, 10, passed_ns=15) == 2**32 * 1000
    assert wrap_period(2**32 * 1000 - 5, 10, passed_ns=S) is None
    assert wrap_period(50 * S, 0, passed_ns=FRAME_NS) is None


def test_a_damaged_frame_counter_is_reported():
    session = Session(tracker=False)
    for i in range(10):
        session.now_ns = i * FRAME_NS
        session.frame(session.now_ns, restarted=i == 5)
    report = session.end()
    assert (report.frames, report.frames_lost, report.frame_counter_restarts) == (10, 0, 1)
    assert "restarted, or its counter is damaged" in session.sink.notes[0][1]
    assert report.cautions == ["the head's frame counter restarted or was damaged once"]


def mismatch(frames: tuple[float, float], poses: tuple[float, float], *, rate_hz: float = 200.0) -> RecordingReport:
    """The account of frames and poses that were measured between these times in s."""
    session = Session(shared=True, rate_hz=rate_hz)
    times = np.arange(0, 6 * S, FRAME_NS)
    for i, time_ns in enumerate(times.tolist()):
        session.now_ns = time_ns
        if frames[0] * S <= time_ns <= frames[1] * S:
            session.frame(time_ns)
        if poses[0] * S <= time_ns <= poses[1] * S:
            session.pose(time_ns, x_mm=float(i))
    return session.end()


@pytest.mark.parametrize(
    ("frames", "poses", "said"),
    [
        ((0, 5), (0, 5), []),
        ((0, 5), (0, 2.2), ["poses end 2.8 s before the frames"]),
        ((0, 5), (1.5, 5), ["poses start 1.5 s after the frames"]),
        ((0, 2), (3, 5), ["no frame has a pose: poses cover 3.00 to 5.00 s, frames 0.00 to 2.00 s"]),
    ],
)
def test_poses_that_do_not_cover_the_frames_are_reported(frames, poses, said):
    report = mismatch(frames, poses)
    assert report.cautions == said
    assert ("none of its" in report.fault) == any("no frame has a pose" in text for text in said)


@pytest.mark.parametrize(
    ("frames_s", "poses_s", "said"),
    [
        (np.arange(40) * 0.15, np.arange(600) * 0.01, []),  # a slow array
        (0.01 * np.arange(600) + 0.08 * (np.arange(600) > 100), np.arange(610) * 0.01, []),
        (
            0.01 * np.arange(600) + 0.19 * (np.arange(600) > 100),
            np.arange(620) * 0.01,
            ["no frame for 0.20 s from 1.00 s on (longest gap)"],
        ),
        (
            0.01 * np.arange(300, 500),
            np.arange(200) * 0.01,
            ["no frame has a pose: poses cover 0.00 to 1.99 s, frames 3.00 to 4.99 s"],
        ),
    ],
)
def test_a_gap_is_longer_than_a_tenth_of_a_second_and_than_five_intervals(frames_s, poses_s, said):
    spans = Span.of(frames_s), Span.of(poses_s)
    assert overlap_cautions(*spans) == said
    noted = [finding("times_apart", text) for text in said]  # by the recorder, too
    assert [one.text for one in with_times(noted, *spans)] == said


def test_an_old_record_sent_again_is_a_gap_and_spoils_no_clock():
    """As servers do while a tool is hidden: the last pose with its own time, again and again."""
    session = Session()
    for i in range(200):
        session.now_ns = i * FRAME_NS
        session.frame(session.now_ns)
        shown = min(i, 60) if i < 140 else i
        session.pose(shown * FRAME_NS, x_mm=float(shown))
    report = session.end()
    assert (report.poses, report.poses_missing, report.missing_why) == (121, 79, "an old record sent again 79")
    assert report.tracker_clock_steps == 0


def test_no_pose_at_all_is_a_fault():
    session = Session()
    for i in range(10):
        session.now_ns = i * FRAME_NS
        session.frame(session.now_ns)
    assert "tracker fake: none of its 0 poses was measured while frames came" in session.end().fault


def test_gaps_a_promise_not_kept_and_a_stuck_tracker_are_reported():
    session = Session(shared=True, rate_hz=200.0)
    for i in range(800):
        session.now_ns = i * FRAME_NS
        if not 300 <= i < 400:
            session.pose(session.now_ns)
        if i % 4 == 0 and not 500 <= i < 600:
            session.frame(session.now_ns)
    session.recorder._process(session.lines[0], EndReading(800, 0), session.now_ns)
    cautions = session.end().cautions
    assert "no pose for 0.50 s from 1.50 s on (longest gap)" in cautions
    assert "no frame for 0.52 s from 2.48 s on (longest gap)" in cautions
    assert any(text.startswith("the head promised 200 frames per second and measured 43") for text in cautions)
    assert "every pose is the same: the tracker does not follow the head" in cautions


@pytest.mark.parametrize(("every", "caution"), [(5, True), (3, False)], ids=["20 Hz", "33 Hz"])
def test_a_tracker_too_slow_for_a_map_is_told_while_the_patient_is_there(every: int, caution: bool) -> None:
    """Half of the frames had no pose, or all, and only `map` said so."""
    session = Session(rate_hz=100.0)
    for i in range(300):
        session.now_ns = i * 2 * FRAME_NS
        session.pose(None, x_mm=float(i // every))
        session.frame(session.now_ns)
    slow = ["20 different poses a second, too few for a map: set the tracker to 50 or more"]
    assert session.end().cautions == slow * caution


def test_landmarks_in_a_hurry_in_one_place_or_in_motion_are_told() -> None:
    """A second key gave the first landmark up without a word; two in one place could not be mapped at all."""
    session = Session()
    for name, places in (
        ("xiphoid", "0"),
        ("sternal_notch", "000"),
        ("xiphoid", "000"),
        ("nipple", "939"),
        ("xiphoid", ""),
    ):
        session.recorder.begin_touch(LandmarkTouch(name, scanhead_from_tracker=np.eye(4), samples=3))
        for x in places:
            session.pose(None, x_mm=float(x))
    report = session.end()
    assert report.landmarks == [
        "xiphoid: given up after 1 of 3 samples; touch it again",
        "sternal notch at 0.0 0.0 0.0 mm, spread 0.00 mm over 3 samples",
        "xiphoid at 0.0 0.0 0.0 mm, spread 0.00 mm over 3 samples; not stored: this is the place of the sternal notch, "
        "touch both again",
        "nipple at 7.0 0.0 0.0 mm, spread 3.46 mm over 3 samples; the head moved, touch it again",
        "xiphoid: given up after 0 of 3 samples; touch it again",
        "xiphoid not stored: maps will have no axes of the patient",
    ]
    assert session.sink.landmarks == ["sternal_notch", "nipple"]
    assert "the head moved by 3 mm while it touched the nipple: places may be wrong" in report.cautions


def test_of_two_silent_devices_one_is_named(monkeypatch):
    """The recording said that the head fell silent, its error named the tracker."""
    monkeypatch.setattr(select, "select", lambda *_: ([], [], []))
    session = Session()
    head, tracker = session.lines
    head.port.name, head.heard_ns, tracker.heard_ns = "head fake", 100, 200
    session.recorder._check_silence(4 * S)
    assert session.recorder.report.ended_by == "the head fell silent"
    assert session.recorder.report.fault.startswith("head fake: ")


@pytest.mark.parametrize("speed", [0.05, 20.0])
def test_a_replay_keeps_its_times_at_any_speed(speed):
    """At twenty times the pace every replay had a caution, and a pause of 3 s was cut to 0.15 s."""
    session = Session(tracker=False, speed=speed, rate_hz=200.0)
    times_ns = [i * FRAME_NS for i in range(200)] + [4 * S + i * FRAME_NS for i in range(200)]
    for time_ns in times_ns:
        session.now_ns = round(time_ns / speed)
        session.frame(time_ns)
    report = session.end()
    assert session.sink.frames == times_ns
    assert report.head_clock_steps == 0
    gap, pace = report.cautions
    assert gap.startswith("no frame for 3.0")
    assert pace.startswith("the head promised 200 frames per second")


@pytest.mark.parametrize("topic", ["/pressure", "/pose"])
def test_a_file_with_a_time_that_no_reader_can_hold_is_refused_in_one_line(tmp_path, topic):
    scan = short_scan(0.1)
    with (tmp_path / "a.mcap").open("wb") as stream:
        writer = ScanWriter(
            stream,
            head=scan.head,
            element_calibration=scan.element_calibration,
            session={"source": "test"},
            provenance=Provenance("test", {}),
        )
        writer.add_frame(scan.frames.counts[0], device_ns=2**63 if topic == "/pressure" else 0, host_ns=0)
        place, turn = scan.poses.position_mm[0], scan.poses.quaternion_wxyz[0]
        writer.add_pose(place, turn, device_ns=2**63 if topic == "/pose" else 0, host_ns=0)
        writer.finish()
    with pytest.raises(BadDataError, match=f"{topic} holds a time of {2**63} ns"):
        read_scan(tmp_path / "a.mcap")


@pytest.mark.parametrize("stepped", [("frames",), ("poses",), ("frames", "poses"), ()])
def test_a_step_of_one_clock_is_a_caution(stepped):
    """A gap in the one, which then lasts longer by it: of a ball of 15 mm no map showed a thing."""
    scan = short_scan(1.0)
    frame_s, pose_s = scan.frames.time_s, scan.poses.time_s
    frames = PressureFrames(frame_s + 0.3 * ("frames" in stepped) * (frame_s > 0.5), scan.frames.counts)
    pose_s = pose_s + 0.3 * ("poses" in stepped) * (pose_s > 0.5)
    poses = TrackerPoses(pose_s, scan.poses.position_mm, scan.poses.quaternion_wxyz)
    found = [one.text for one in scan_findings(replace(scan, frames=frames, poses=poses)) if one.severity == "caution"]
    wanted = [f"the {name}' clock seems to step by 0.3 s" for name in stepped if len(stepped) == 1]
    assert [text.partition(" at ")[0] for text in found] == wanted
