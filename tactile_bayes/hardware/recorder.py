"""Recording of devices to a file, with landmarks, and a report of what came and what was lost."""

from __future__ import annotations

import contextlib
import math
import select
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import KW_ONLY, dataclass, field
from typing import Final, Protocol

import numpy as np

from tactile_bayes.errors import DeviceError
from tactile_bayes.findings import first_of
from tactile_bayes.geometry import LEAST_APART_MM, FloatArray, inverse, rotation_from_quaternion
from tactile_bayes.hardware import readings
from tactile_bayes.hardware.ports import SILENT_S, Port, Stream
from tactile_bayes.mapping.select import Jumps, Span, disjoint, overlap_cautions
from tactile_bayes.scans import LANDMARK_NAMES, CountArray

# --- Summary of a recording: what arrived, what was lost, and what makes it unfit for use.

# The head's clock runs as this computer's, and its frames come as it promised, to within this share or time.
_RATE_SHARE: Final = 0.02
_RATE_LEAST_S: Final = 0.5
_STUCK_POSES: Final = 10
_LEAST_POSE_HZ: Final = 25.0  #: A map knows no place between poses more than 50 ms apart.
_CAUTION_SHARE: Final = 0.01  #: Of lost frames, and of missing or flagged poses: any exam has fewer.


@dataclass(slots=True)
class RecordingReport:
    """Counts of a recording, its losses and its cautions; numbers count records unless the name says bytes."""

    frames: int = 0
    frames_lost: int = 0
    frame_counter_restarts: int = 0
    head_dropped: int = 0
    head_clock_steps: int = 0
    head_clock_wraps: int = 0
    tracker_clock_steps: int = 0
    tracker_clock_wraps: int = 0
    poses: int = 0
    poses_repeated: int = 0
    poses_flagged: int = 0
    poses_missing: int = 0
    unseen: str = ""  #: Why no pose comes now; empty while poses come.
    missing_why: str = ""
    flagged_why: str = ""  #: `missing_why`, `flagged_why`: The tracker's reasons, each with its number.
    other_tools: str = ""  #: Tools that were not followed, each with the number of its records.
    tracker_remark: str = ""
    poses_without_time: int = 0
    head_garbage_bytes: int = 0
    tracker_garbage_bytes: int = 0
    overrun_bytes: int = 0
    first_ns: int = 0
    last_ns: int = 0
    longest_wait_ms: float = 0.0
    ended_by: str = ""
    fault: str = ""
    landmarks: list[str] = field(default_factory=list)
    cautions: list[str] = field(default_factory=list)

    @property
    def duration_s(self) -> float:
        """Time from the first frame to the last by the head's clock, made continuous."""
        return (self.last_ns - self.first_ns) / 1e9


def _cautions(
    report: RecordingReport, passed_s: float, silent_s: float, rate_hz: float, pose_s: float
) -> Iterator[str]:
    """Cautions about frames that did not come, clocks and counters that jump, the pace of both, and the poses.

    By the host's clock, `passed_s` is the time from the first frame to the last, `silent_s` from there to the stop;
    `pose_s` is the time from the first pose to the last without their longest gap.
    """

    def times(number: int) -> str:
        return "once" if number == 1 else f"{number} times"

    if not (report.frames or report.fault):
        yield "no frame was recorded"
    elif silent_s > _RATE_LEAST_S and not report.fault:
        yield f"no frame came in the last {silent_s:.1f} s"
    all_frames = report.frames + report.frames_lost
    if report.frames_lost > _CAUTION_SHARE * all_frames and not report.frame_counter_restarts:
        yield f"{report.frames_lost:,} of {all_frames:,} frames lost: check the head's cable and line rate"
    head_s = report.duration_s
    if abs(head_s - passed_s) > max(_RATE_LEAST_S, _RATE_SHARE * passed_s):
        yield f"the head's clock ran {head_s:.1f} s while {passed_s:.1f} s passed on this computer"
    promised, measured = head_s * rate_hz, report.frames - 1 + report.frames_lost
    if promised > 0 and abs(measured - promised) > max(_RATE_LEAST_S * rate_hz, _RATE_SHARE * promised):
        yield f"the head promised {rate_hz:g} frames per second and measured {measured / head_s:.1f}"
    for role, steps in (("head", report.head_clock_steps), ("tracker", report.tracker_clock_steps)):
        if steps:
            yield f"the {role}'s clock stepped {times(steps)}; this computer's clock was used instead"
    if report.frame_counter_restarts:
        yield f"the head's frame counter restarted or was damaged {times(report.frame_counter_restarts)}"
    all_poses = report.poses + report.poses_missing
    for number, state, why in (
        (report.poses_missing, "missing", report.missing_why),
        (report.poses_flagged, "flagged by the tracker", report.flagged_why),
    ):
        if number > _CAUTION_SHARE * all_poses:
            yield f"{number:,} of {all_poses:,} poses {state}: {why}"
    if report.tracker_remark:
        yield f"the tracker's {report.tracker_remark}"
    if report.poses > _STUCK_POSES and report.poses_repeated >= report.poses - 1:
        yield "every pose is the same: the tracker does not follow the head"
    elif report.poses > _STUCK_POSES and (fresh := report.poses - report.poses_repeated) < _LEAST_POSE_HZ * pose_s:
        yield f"{fresh / pose_s:.0f} different poses a second, too few for a map: set the tracker to 50 or more"


# --- Landmarks, touched with the head's apex: the mean of several poses, and their spread.

SAMPLES: Final = 60
STEADY_MM: Final = 2.0  #: A hand at rest on bone; more says that the head slipped while it touched.


class LandmarkTouch:
    """Position of a landmark, such as ``nipple``: the mean of the apex's positions while it rests on the landmark."""

    def __init__(self, name: str, *, scanhead_from_tracker: FloatArray, samples: int = SAMPLES) -> None:
        self.name, self.words = name, name.replace("_", " ")
        self._apex_mm = inverse(scanhead_from_tracker)[:3, 3]
        self._samples = samples
        self._points: list[FloatArray] = []

    def add(self, pose: readings.PoseReading) -> bool:
        """Add a pose, unless the tracker flags it; True when there are enough."""
        if not pose.flags:
            rotation = rotation_from_quaternion(np.array(pose.quaternion_wxyz))
            self._points.append(np.array(pose.position_mm) + rotation @ self._apex_mm)
        return len(self._points) >= self._samples

    @property
    def position_mm(self) -> FloatArray:
        """(3,) mean in `base`."""
        return np.asarray(np.mean(self._points, axis=0))

    @property
    def spread_mm(self) -> float:
        """Standard deviation of the samples about it (root of the sum over axes)."""
        return float(np.sqrt(np.var(self._points, axis=0, ddof=1).sum())) if len(self._points) > 1 else 0.0

    @property
    def steady(self) -> bool:
        """True when the head was held still enough."""
        return self.spread_mm <= STEADY_MM

    def __str__(self) -> str:
        if len(self._points) < self._samples:
            return f"{self.words}: given up after {len(self._points)} of {self._samples} samples; touch it again"
        x, y, z = self.position_mm
        words = "" if self.steady else "; the head moved, touch it again"
        return (
            f"{self.words} at {x:.1f} {y:.1f} {z:.1f} mm, spread {self.spread_mm:.2f} mm over "
            f"{len(self._points)} samples{words}"
        )


# --- Recorder: passes what devices send to a writer without loss, and reports losses on the way.

FLUSH_S: Final = 0.2
DRAIN_S: Final = 0.25
OVERTIME_S: Final = 1.0  #: A recording with a duration goes on for so long at most when the head's clock is behind.
# After so long without a pose the view says so, also where the tracker says nothing.
_HIDDEN_NS: Final = 300_000_000
_MOST_REASONS: Final = 5
_TICK_S: Final = 0.05
# Bytes read from the tracker before the head is read again: a tracker that sends without end must not hold it up.
_TRACKER_BYTES: Final = 32768


class Sink(Protocol):
    """Interface of a recording's destination; `files` has the one for scan files."""

    def add_frame(self, counts: CountArray, *, device_ns: int, host_ns: int) -> None: ...
    def add_pose(
        self, position_mm: FloatArray, quaternion_wxyz: FloatArray, *, device_ns: int, host_ns: int
    ) -> None: ...
    def add_landmark(self, name: str, position_mm: FloatArray, *, device_ns: int, host_ns: int) -> None: ...
    def add_note(self, text: str, *, device: str, device_ns: int, host_ns: int, serious: bool = False) -> None: ...

    def flush(self) -> None:
        """Store what was added so far, so that it survives the end of this process."""


class Observer:
    """Observer of a recording, which must never wait; it gets the report several times a second."""

    def landmark(self, name: str, position_mm: FloatArray) -> None: ...
    def frame(self, counts: CountArray, device_ns: int) -> None: ...
    def pose(self, pose: readings.PoseReading, device_ns: int) -> None: ...
    def report(self, report: RecordingReport) -> None: ...


@dataclass(slots=True)
class DeviceLine:
    """A device in use: port, reading process, parser, and commands to start and stop it."""

    role: str
    port: Port
    stream: Stream
    parser: readings.Parser
    start: bytes
    stop: bytes
    silent_s: float = SILENT_S  #: After so long without a byte it has gone.
    heard_ns: int = 0
    finished: bool = False


@dataclass
class Recorder:
    """Runs one recording of devices that were checked and do not stream yet; the sink gets all in order of arrival."""

    head: DeviceLine
    tracker: DeviceLine | None
    sink: Sink
    _: KW_ONLY
    shared_clock: bool = False  #: True when both devices count from one zero.
    follower: readings.Follower = field(default_factory=readings.Follower)  #: Follows one of the tracker's tools.
    duration_s: float | None = None
    """By the head's clock made continuous, and at most `OVERTIME_S` longer by the host's; None goes on until it is
    stopped."""
    rate_hz: float = 0.0  #: Frame rate that the head promised; 0 for none.
    observer: Observer = field(default_factory=Observer)
    clock_ns: Callable[[], int] = time.monotonic_ns  #: The host time that the reading processes stamp with.
    speed: float = 1.0  #: Seconds of the devices' clocks in one of the host's: other than 1 where a scan is replayed.
    touch: LandmarkTouch | None = None  #: The landmark for which the next poses are averaged.
    recording: bool = False

    def __post_init__(self) -> None:
        self.report = RecordingReport()
        self._lines = [line for line in (self.head, self.tracker) if line is not None]
        self._clock = readings.PoseClock(shared=self.shared_clock)
        self._why_missing: Counter[str] = Counter()
        self._why_flagged: Counter[str] = Counter()
        self._jumps, self._frame_span, self._pose_span = Jumps(), Span(), Span()
        self._zero_ns = self.clock_ns()
        self._begun_ns = self._heard_ns = 0
        self._last_pose: readings.PoseReading | None = None
        self._pose_ns = -1
        self._stopped_ns: int | None = None
        self._touched: dict[str, LandmarkTouch] = {}
        self._stored: set[str] = set()

    def start(self) -> None:
        """Start the devices and record them."""
        for line in reversed(self._lines):  # the tracker first, so that no frame is without a pose
            line.port.write(line.start)
            line.heard_ns = self.clock_ns()
        self.recording = True

    def listen(self) -> None:
        """Start the tracker alone, for landmarks before the scan."""
        if self.tracker is not None:
            self.tracker.port.write(self.tracker.start)

    def begin_touch(self, touch: LandmarkTouch | None) -> None:
        """Average the next poses for a landmark; another one that was not complete is given up, and told."""
        if self.touch and (touch is None or touch.name != self.touch.name):
            self.report.landmarks.append(str(self.touch))
        self.touch = touch

    def store_landmark(self, name: str, position_mm: FloatArray, *, device_ns: int = 0, host_ns: int = 0) -> None:
        """Store the place of a landmark, and show it."""
        self._stored.add(name)
        self.sink.add_landmark(name, position_mm, device_ns=device_ns, host_ns=max(0, host_ns))
        self.observer.landmark(name, position_mm)

    def stop(self, why: str) -> None:
        """End the recording once data on their way have arrived."""
        if not self.report.ended_by:
            self.report.ended_by = why
            self._stopped_ns = self.clock_ns()

    def run(self, each_tick: Callable[[], None] = lambda: None) -> RecordingReport:
        """Record until the end; `each_tick`, called many times a second, may call `stop` and `start` and set `touch`.

        However the recording ends, the devices get their stop commands and the report is complete.
        """
        flushed_ns = self.clock_ns()
        try:
            while not self._done():
                self._read_lines()
                each_tick()
                now = self.clock_ns()
                if now - flushed_ns > FLUSH_S * 1e9:
                    flushed_ns = now
                    self.sink.flush()
                    self._update_report()
                self._check_silence(now)
                self._check_host_time(now)
        finally:
            for line in self._lines:
                with contextlib.suppress(DeviceError):  # of one that has gone
                    line.port.write(line.stop)
                line.stream.stop()
            self._add_cautions()
            self._update_report()
        return self.report

    def _elapsed_ns(self, host_ns: int) -> int:
        """Time from the beginning to a host time, in the devices' nanoseconds."""
        return round((host_ns - self._zero_ns) * self.speed)

    def _read_lines(self) -> None:
        """Wait briefly for bytes, and process all of them."""
        waiting = [line.stream for line in self._lines if not line.stream.ended]
        ready, _, _ = select.select(waiting, [], [], _TICK_S)
        for line in self._lines:
            if line.stream not in ready:
                continue
            for host_ns, data in line.stream.read() if line is self.head else line.stream.read(_TRACKER_BYTES):
                line.heard_ns = host_ns
                for reading in line.parser.feed(data):
                    self._process(line, reading, host_ns)
            if line.stream.ended and not line.finished:
                self._device_gone(line)

    def _process(self, line: DeviceLine, reading: object, host_ns: int) -> None:
        """Process a reading that arrived at `host_ns`; from here on times on the host count from the beginning."""
        elapsed_ns = self._elapsed_ns(host_ns)
        match reading:
            case readings.FrameReading():
                self._frame(reading, elapsed_ns)
            case readings.PoseReading() | readings.MissingReading():
                for followed, arrival_ns in self.follower.take(reading, elapsed_ns):
                    if isinstance(followed, readings.PoseReading):
                        self._pose(followed, arrival_ns)
                    else:
                        self._missing(followed, arrival_ns)
            case readings.EndReading() if self.recording:
                line.finished = True
                if line is self.head:
                    self.report.head_dropped = reading.dropped
                    self.stop("the head stopped")
            case _:
                pass

    def _frame(self, reading: readings.FrameReading, host_ns: int) -> None:
        if not self.recording:
            return
        report = self.report
        device_ns, event = self._clock.head.read(reading.device_ns, host_ns)
        if not report.frames:
            report.first_ns, self._begun_ns = device_ns, host_ns
        elif self.duration_s is not None and device_ns - report.first_ns >= round(self.duration_s * 1e9):
            self.stop("duration")
            return
        remarks = (
            event,
            "the frame counter does not go on from the frame before: the head restarted, or its counter is damaged"
            * reading.restarted,
            f"{reading.lost} frames lost before this one" * bool(reading.lost),
        )
        for text in filter(None, remarks):
            self._note(text, "head", device_ns, host_ns)
        report.frames_lost += reading.lost
        report.frame_counter_restarts += reading.restarted
        self.sink.add_frame(reading.counts, device_ns=device_ns, host_ns=max(0, host_ns))
        self._frame_span.add(device_ns / 1e9)
        report.frames += 1
        report.last_ns, self._heard_ns = device_ns, host_ns
        wait_ms = (self._elapsed_ns(self.clock_ns()) - host_ns) / self.speed / 1e6
        report.longest_wait_ms = max(report.longest_wait_ms, wait_ms)
        self.observer.frame(reading.counts, device_ns)

    def _pose(self, reading: readings.PoseReading, host_ns: int) -> None:
        self._add_to_touch(reading, host_ns)
        if not self.recording:
            return
        if reading.device_ns is not None and self._last_pose is not None and reading[:3] == self._last_pose[:3]:
            self._missing(readings.MissingReading("an old record sent again", reading.tool), host_ns)
            return
        moment = self._clock.time_of(reading.device_ns, host_ns)
        if moment is None:
            self.report.poses_without_time += 1
            self._last_pose = reading if reading.device_ns is not None else self._last_pose
            return
        device_ns, event = moment
        flags = self._record_flags(reading)
        position, quaternion = np.array(reading.position_mm), np.array(reading.quaternion_wxyz)
        self.sink.add_pose(position, quaternion, device_ns=device_ns, host_ns=max(0, host_ns))
        self.report.poses += 1
        self._pose_ns = device_ns
        self._pose_span.add(device_ns / 1e9)
        self._jumps.add(device_ns / 1e9, reading.position_mm)
        if self.report.unseen:
            self.report.unseen = ""
            self._note(f"{reading.tool or 'the tool'} is seen again", "tracker", device_ns, host_ns)
        if event:
            self._note(event, "tracker", device_ns, host_ns)
        if flags:
            serious = flags != ("repeated",)
            self._note(", ".join(flags), "tracker", device_ns, host_ns, serious=serious)
        self.observer.pose(reading, device_ns)

    def _missing(self, reading: readings.MissingReading, host_ns: int) -> None:
        """Count a pose that the tracker does not have, once frames come; the file's log has both ends of a gap."""
        if not (self.recording and self.report.frames):
            return
        self.report.poses_missing += 1
        readings.tally(self._why_missing, reading.why)
        self._note_unseen(reading.why, host_ns)

    def _note_unseen(self, why: str, host_ns: int) -> None:
        """Store why no pose comes now; the file's log has where that begins."""
        if not self.report.unseen:
            text = f"no pose of {self.follower.tool or 'the tool'} from here on: {why}"
            self._note(text, "tracker", max(0, self._pose_ns), host_ns)
        self.report.unseen = why

    def _record_flags(self, reading: readings.PoseReading) -> tuple[str, ...]:
        """Count and return the device's flags of a pose, with ``repeated`` where it equals the last one."""
        self.report.poses_flagged += bool(reading.flags)
        for flag in reading.flags:
            readings.tally(self._why_flagged, flag.rstrip("-0123456789 "))
        last, self._last_pose = self._last_pose, reading
        if last is None or (last.position_mm, last.quaternion_wxyz) != (reading.position_mm, reading.quaternion_wxyz):
            return reading.flags
        self.report.poses_repeated += 1
        return (*reading.flags, "repeated")

    def _add_to_touch(self, reading: readings.PoseReading, host_ns: int) -> None:
        touch = self.touch
        if touch is None or not touch.add(reading):
            return
        self.touch, words, device_ns = None, str(touch), max(0, self._pose_ns)
        others = [other for other in self._touched.values() if other.name != touch.name]
        at_place = [one for one in others if math.dist(one.position_mm, touch.position_mm) <= LEAST_APART_MM]
        if at_place:
            words += f"; not stored: this is the place of the {at_place[0].words}, touch both again"
        else:
            self._touched[touch.name] = touch
            self.store_landmark(touch.name, touch.position_mm, device_ns=device_ns, host_ns=host_ns)
        self.report.landmarks.append(words)
        self._note(words, "tracker", device_ns, host_ns, serious=bool(at_place) or not touch.steady)

    def _note(self, text: str, device: str, device_ns: int, host_ns: int, *, serious: bool = True) -> None:
        self.sink.add_note(text, device=device, device_ns=device_ns, host_ns=max(0, host_ns), serious=serious)

    def _device_gone(self, line: DeviceLine) -> None:
        """End the recording because a device disappeared: its cable was pulled, or its program ended."""
        line.finished = True
        if self.report.ended_by:
            return
        lost = f"after {self.report.duration_s:.2f} s" if self.report.frames else "before the first frame"
        self._fail(line, f"the device has gone {lost}", line.port.remedy)
        self.stop(f"the {line.role} has gone")

    def _fail(self, line: DeviceLine, event: str, remedy: str) -> None:
        saved = "; what came before is in the file" if self.report.frames else ""
        self.report.fault = f"{line.port.name}: more data was expected, {event}{saved}; {remedy}"

    def _check_silence(self, now_ns: int) -> None:
        """End the recording when a device has sent nothing for too long; of several the one that fell silent first."""
        if not self.recording or self.report.ended_by:
            return
        for line in sorted(self._lines, key=lambda line: line.heard_ns):
            silent_s, limit_s = (now_ns - line.heard_ns) / 1e9, line.silent_s / min(1.0, self.speed)
            if silent_s > limit_s and not line.finished and not select.select([line.stream], [], [], 0)[0]:
                self._fail(line, f"nothing has come for {silent_s:.1f} s", "check that the device runs")
                self.stop(f"the {line.role} fell silent")
                return

    def _check_host_time(self, now_ns: int) -> None:
        """End a recording of limited duration by the host's clock when the head's is behind."""
        if self.duration_s is None or not self.report.frames:
            return
        passed_ns = self._elapsed_ns(now_ns) - self._begun_ns
        if passed_ns > (self.duration_s + OVERTIME_S) * 1e9:
            self.stop("duration, by this computer's clock")

    def _add_cautions(self) -> None:
        """Complete the report with counts and cautions; a tracker without one usable pose is a fault."""
        report, clock = self.report, self._clock
        report.head_clock_steps, report.head_clock_wraps = clock.head.steps, clock.head.wraps
        report.tracker_clock_steps, report.tracker_clock_wraps = clock.tracker.steps, clock.tracker.wraps
        report.missing_why = _counts_in_words(self._why_missing)
        report.flagged_why = _counts_in_words(self._why_flagged)
        report.other_tools = _counts_in_words(self.follower.other_tools)
        report.tracker_remark = self.tracker.parser.remark if self.tracker else ""
        passed_s = (self._heard_ns - self._begun_ns) / 1e9
        stopped_ns = self._heard_ns if self._stopped_ns is None else self._elapsed_ns(self._stopped_ns)
        silent_s = (stopped_ns - self._heard_ns) / self.speed / 1e9
        spans = self._frame_span, self._pose_span
        pose_s = self._pose_span.last_s - self._pose_span.first_s - self._pose_span.gap_s
        report.cautions = [*overlap_cautions(*spans), *_cautions(report, passed_s, silent_s, self.rate_hz, pose_s)]
        report.cautions += self._jumps.cautions()
        self.begin_touch(None)
        unstored = [name.replace("_", " ") for name in LANDMARK_NAMES if name not in self._stored]
        if unstored and self._stored:
            report.landmarks.append(f"{' and '.join(unstored)} not stored: maps will have no axes of the patient")
        report.cautions += [
            f"the head moved by {touch.spread_mm:.0f} mm while it touched the {touch.words}: places may be wrong"
            for touch in self._touched.values()
            if not touch.steady
        ]
        if self.head.parser.fault:
            report.cautions.append(f"the head's line: {self.head.parser.fault}")
        if self.tracker is not None and report.frames and not report.fault and disjoint(*spans):
            missing = f" ({report.poses_missing:,} missing: {report.missing_why})" if report.poses_missing else ""
            none = f"none of its {report.poses} poses was measured while frames came"
            report.fault = f"{self.tracker.port.name}: {none}{missing}"

    def _done(self) -> bool:
        """True when all data of the recording have arrived."""
        if self._stopped_ns is None:
            return False
        tracker = self.tracker
        behind = tracker is not None and not tracker.finished and self._pose_ns < self.report.last_ns
        return not behind or self.clock_ns() > self._stopped_ns + DRAIN_S * 1e9

    def _update_report(self) -> None:
        report = self.report
        report.head_garbage_bytes = self.head.parser.garbage_bytes
        report.tracker_garbage_bytes = self.tracker.parser.garbage_bytes if self.tracker else 0
        report.overrun_bytes = sum(line.stream.overrun_bytes for line in self._lines)
        if self.recording and self.tracker is not None and report.last_ns - self._pose_ns > _HIDDEN_NS:
            self._note_unseen(report.unseen or "nothing is sent", self._heard_ns)
        self.observer.report(report)


def _counts_in_words(counted: Counter[str]) -> str:
    """Words with their numbers, the most frequent first."""
    counts = [f"{word or 'one without a name'} {number:,}" for word, number in counted.most_common()]
    return first_of(counts, _MOST_REASONS)
