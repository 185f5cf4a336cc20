"""`record`: a scan head and a tracker into a scan file."""

from __future__ import annotations

import os
import select
import signal
import sys
import termios
import tty
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import KW_ONLY, dataclass
from datetime import date
from pathlib import Path
from typing import Any

import click
import numpy as np

from tactile_bayes.api.arguments import PathLike, path_of, takes
from tactile_bayes.commands.options import protect_inputs
from tactile_bayes.declarations import as_dict, default_of, field
from tactile_bayes.errors import EXIT_DONE, EXIT_INTERRUPTED, DeviceError, UsageError, check_number
from tactile_bayes.files.atomic import refuse_existing, unwritable
from tactile_bayes.files.documents import check_session, read_session
from tactile_bayes.files.instrument import read_array_calibration, read_head_geometry
from tactile_bayes.files.provenance import Provenance, hash_inputs
from tactile_bayes.files.scan_mcap import RecordingWriter, create_exclusive, full_disk, read_scan, touched_landmarks
from tactile_bayes.geometry import FloatArray
from tactile_bayes.hardware import head
from tactile_bayes.hardware.ports import SILENT_S, Port, read_in_process
from tactile_bayes.hardware.reading import ENDING
from tactile_bayes.hardware.readings import Follower, HelloReading, Parser
from tactile_bayes.hardware.recorder import DeviceLine, LandmarkTouch, Observer, Recorder, RecordingReport
from tactile_bayes.hardware.serial_trackers import TRACKERS, check_head, open_tracker
from tactile_bayes.options import RecordOptions
from tactile_bayes.presets import PRESSURE_RANGE_KPA, RECORDING_KEYS, RESEARCH_USE
from tactile_bayes.scans import ElementCalibration, HeadGeometry, Landmarks
from tactile_bayes.shell import can_redraw

_KEYS: dict[int, str] = {signal.SIGINT: "Ctrl-C", signal.SIGTSTP: "Ctrl-Z", signal.SIGQUIT: "Ctrl-\\"}
_NOMINAL = "the nominal gain is for bladder steps: uneven taxels may hide a lump or pass for one"
_PATHS = ("like", "head_geometry", "array_calibration", "landmarks")


class Request(RecordOptions, kw_only=True):
    """Options of one recording, and the facts and settings that its file stores of them."""

    replayed: dict[str, str] = field(default_factory=dict)  #: Session of a scan that is replayed, kept unchanged.
    replay_speed: float = 1.0  #: Seconds of a replayed scan in a second.

    def facts(self) -> dict[str, str]:
        """Session facts as text: from the file, overridden by options."""
        facts = read_session(self.session_file)
        for name in ("side", "posture", "lubricant", "examiner", "subject"):
            if value := getattr(self, name):
                check_session({name: value}, path=Path(f"--{name}"))
                facts[name] = value
        return facts

    def session(self, hello: HelloReading, follower: Follower, facts: dict[str, str]) -> dict[str, str]:
        """Session as the file stores it: devices, clock and facts."""
        tracker = self.tracker_protocol if self.tracker_url else "none"
        devices = {"source": "recorded", "head_id": hello.device_id[:64], "tracker_id": tracker, "clock": self.clock}
        tools = {"tool": follower.tool, "reference": follower.reference}
        devices |= {name: value for name, value in tools.items() if value}
        return devices | ({"rotation": "inverted"} if self.invert_rotation else {}) | facts | self.replayed

    def settings(self, hello: HelloReading) -> dict[str, Any]:
        """Settings for the provenance."""
        return {
            "tracker_protocol": self.tracker_protocol if self.tracker_url else None,
            "tool": self.tool,
            "reference": self.reference,
            "rate_hz": hello.rate_hz / self.every,
            "every": self.every,
            "clock": self.clock,
            "invert_rotation": self.invert_rotation,
            "calibrated": not self.uncalibrated,
        }


def instrument_of(
    request: Request, facts: dict[str, str]
) -> tuple[HeadGeometry, ElementCalibration | None, str, Landmarks | None]:
    """Geometry, calibration, its head if --like gives it, and landmarks; `UsageError` where a file is missing.

    Without a calibration is --uncalibrated: the head's own full scale is needed for one.
    """
    owner = ""
    like = read_scan(request.like) if request.like else None
    if request.head_geometry:
        head = read_head_geometry(request.head_geometry)
    elif like is not None:
        head = like.head
    else:
        raise UsageError("the head's geometry is missing; give --head-geometry HEAD.json or --like SCAN.mcap")
    if request.uncalibrated and request.array_calibration:
        raise UsageError("--uncalibrated leaves --array-calibration unused; give one of them")
    if request.uncalibrated:
        calibration: ElementCalibration | None = None
    elif request.array_calibration:
        calibration = read_array_calibration(request.array_calibration).calibration
    elif like is not None:
        calibration, owner = like.element_calibration, like.session.get("head_id", "")
    else:
        raise UsageError("the array's calibration is missing; give --array-calibration, --like or --uncalibrated")
    session = {**facts, "reference": request.reference or ""}
    landmarks = None if request.landmarks is None else touched_landmarks(request.landmarks, session)
    return head, calibration, owner, landmarks


def calibration_age(request: Request, *, head_id: str, today: date) -> dict[str, str]:
    """Session fact on the age of the array calibration, in days; one that is stale or of another head is refused."""
    if not request.array_calibration:
        return {}
    calibration = read_array_calibration(request.array_calibration)
    age, fault = (today - calibration.day).days, ""
    if calibration.head_id != head_id:
        fault = f"was measured on head {calibration.head_id!r}, this is {head_id!r}; calibrate this head"
    elif age < 0:
        fault = f"is of {calibration.day}, which is to come; correct its date or this computer's clock"
    elif age > request.calibration_days:
        fault = f"is of {calibration.day}, {age} days ago (at most {request.calibration_days:g}); calibrate again"
    if fault and not request.accept_calibration:
        raise UsageError(f"{request.array_calibration} {fault}, or give --accept-calibration")
    return {"array_calibration_days": str(age)}


@contextmanager
def noted_signals() -> Iterator[list[str]]:
    """List the names of `ENDING` signals, which are to end the recording, in place of their effect."""
    names: list[str] = []

    def note(number: int, _frame: object) -> None:
        names.append(_KEYS.get(number) or signal.Signals(number).name)

    under_nohup = signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    before = {one: signal.signal(one, note) for one in ENDING if not (one == signal.SIGHUP and under_nohup)}
    try:
        yield names
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@dataclass
class Keys:
    """Keys of a terminal for landmarks, start and stop; where a live view is `drawn`, nothing is printed."""

    recorder: Recorder
    scanhead_from_tracker: FloatArray
    _: KW_ONLY
    wait: bool
    drawn: bool

    def __post_init__(self) -> None:
        self._terminal = sys.stdin.isatty()
        self.waiting, self._printed_landmarks = self.wait and self._terminal, 0

    @contextmanager
    def listening(self) -> Iterator[None]:
        """Take keys one by one; starts the recording, or the tracker alone where space starts it."""
        settings = termios.tcgetattr(sys.stdin) if self._terminal else None
        if settings:
            tty.setcbreak(sys.stdin)
        try:
            if self.waiting:
                self._say(RECORDING_KEYS)
            (self.recorder.listen if self.waiting else self.recorder.start)()
            yield
        finally:
            with suppress(termios.error):  # the terminal was closed
                if settings:
                    termios.tcsetattr(sys.stdin, termios.TCSADRAIN, settings)

    def poll(self) -> None:
        """Act on the keys pressed since the last call, and report landmarks."""
        for text in self.recorder.report.landmarks[self._printed_landmarks :]:
            self._say(text)
            self._printed_landmarks += 1
        if not self._terminal or not select.select([sys.stdin], [], [], 0)[0]:
            return
        keys = b""
        with suppress(OSError):  # a closed terminal is at its end, or fails
            keys = os.read(sys.stdin.fileno(), 64)
        if not keys:
            self.recorder.stop("a closed terminal")
        for key in keys.decode("latin-1"):
            self._press(key)

    def _say(self, words: str) -> None:
        if not self.drawn:
            click.echo(words, err=True)

    def _press(self, key: str) -> None:
        names = {"n": "sternal_notch", "x": "xiphoid", "p": "nipple"}
        if key in names and self.recorder.tracker is None:
            self._say("no landmark without a tracker")
        elif key in names:
            self.recorder.begin_touch(LandmarkTouch(names[key], scanhead_from_tracker=self.scanhead_from_tracker))
            self._say(f"{names[key].replace('_', ' ')}: hold still")
        elif key == " " and self.waiting:
            self.waiting = False
            self.recorder.start()
            self._say("recording")
        elif key == "q":
            self.recorder.stop("q")


def record_action(output: Path, **options: Any) -> int:
    """Record a scan head and a tracker."""
    request = Request(output=output, **options)
    if request.size_calibration != default_of(RecordOptions, "size_calibration"):
        from tactile_bayes.files.size_json import size_calibration_path  # slow to import: it brings the sizing

        protect_inputs(size_calibration_path(request.size_calibration))
    report, interrupted = make_recording(request)
    click.echo(record_text(report, output=str(output)), nl=False)
    if report.fault:
        raise DeviceError(report.fault)
    return EXIT_INTERRUPTED if interrupted and request.duration_s is not None else EXIT_DONE


def record_text(report: RecordingReport, *, output: str) -> str:
    """Summary of a recording and its losses."""
    rate = (report.frames - 1) / report.duration_s if report.frames > 1 and report.duration_s > 0 else 0.0
    dropped = f" (the head dropped {report.head_dropped})" if report.head_dropped else ""
    lines = [
        f"{output}: scan, ended by {report.ended_by}",
        f"{report.frames} frames in {report.duration_s:.3f} s, {rate:.1f} Hz; {report.poses} poses",
        f"frames lost {report.frames_lost}{dropped}",
        f"poses repeated {report.poses_repeated}, flagged {report.poses_flagged}, missing {report.poses_missing}"
        + (f" ({report.missing_why})" if report.missing_why else ""),
        *([f"records of other tools left out: {report.other_tools}"] if report.other_tools else []),
        *report.landmarks,
    ]
    counts = {
        "times the head's counter of time wrapped": report.head_clock_wraps,
        "times the tracker's counter of time wrapped": report.tracker_clock_wraps,
        "poses before the first frame or without a time, left out": report.poses_without_time,
        "bytes from the head that made no sense": report.head_garbage_bytes,
        "bytes from the tracker that made no sense": report.tracker_garbage_bytes,
        "bytes this computer came too late for": report.overrun_bytes,
    }
    lines += [f"{words}: {number}" for words, number in counts.items() if number]
    lines += [f"caution: {text}" for text in report.cautions]
    return "\n".join([*lines, RESEARCH_USE]) + "\n"


def make_recording(request: Request) -> tuple[RecordingReport, bool]:
    """Check the devices, record and close the file; returns the report, and True if a signal ended it."""
    ndi = request.tracker_protocol == "ndi"
    for rom in request.tracker_rom:
        if not (ndi and rom.is_file()):
            fault = "not a file" if ndi else f"not for {request.tracker_protocol}"
            way_out = "give a wireless NDI tool's .rom file with --tracker-protocol ndi"
            raise UsageError(f"--tracker-rom {rom} is {fault}; {way_out}")
    if request.tracker_url == "":  # as of a shell's variable that is not set
        raise UsageError("--tracker is empty; give the tracker's port, or leave the option out")
    if not request.tracker_url and (request.tool or request.reference):
        raise UsageError("--tool and --reference are of a tracker; give its port with --tracker")
    if request.tracker_url == request.head_url:
        raise UsageError(f"--head and --tracker are both {request.head_url}; give two ports")
    refuse_existing(request.output, force=request.force)
    facts = request.facts()
    head, given, owner, landmarks = instrument_of(request, facts)
    with ExitStack() as after, ExitStack() as stack:
        hello, lines, follower = _connect(request, stack)
        _check_fit(hello, head, request)
        calibration = calibration_for(hello, given, request, owner=owner)
        age = calibration_age(request, head_id=hello.device_id, today=date.today())
        session = request.session(hello, follower, facts) | age
        check_session(session, path=request.output)
        observer = Observer()
        if request.live or request.serve:
            # slow to import: it maps and estimates
            from tactile_bayes.actions.live_view import live_view

            view = live_view(
                head, calibration, terminal=request.live, serve=request.serve, size_calibration=request.size_calibration
            )
            observer = stack.enter_context(view)
        stream = stack.enter_context(create_exclusive(request.output, force=request.force))
        inputs = {name: path for name in _PATHS if (path := getattr(request, name)) is not None}
        provenance = Provenance("record", request.settings(hello), hash_inputs(**inputs))
        try:
            writer = RecordingWriter(
                stream, head=head, element_calibration=calibration, session=session, provenance=provenance
            )
        except OSError as error:
            with suppress(OSError):  # its buffer cannot be written either
                stream.close()
            request.output.unlink(missing_ok=True)  # no data yet
            raise unwritable(request.output, error) from None
        stack.callback(writer.stop_syncing)
        recorder = Recorder(
            *lines,
            writer,
            shared_clock=request.clock == "shared",
            follower=follower,
            duration_s=request.duration_s,
            rate_hz=hello.rate_hz / request.every,
            observer=observer,
            speed=request.replay_speed,
        )
        for name, position_mm in {} if landmarks is None else landmarks.points().items():
            recorder.store_landmark(name, position_mm)
        signals = after.enter_context(noted_signals())  # to the end: a second Ctrl-C broke off what the first began
        try:
            report = _run(recorder, signals, head, request)
            if request.tracker_url and _is_nominal(calibration):  # also where --like gave it
                report.cautions.append(_NOMINAL)
            writer.close(as_dict(report) | {"cautions": "\n".join(report.cautions)})
        except OSError as error:
            writer.stop_syncing()
            with suppress(OSError):  # its buffer cannot be written either
                stream.close()
            raise full_disk(request.output, error) from None
    return report, bool(signals)


def _connect(request: Request, stack: ExitStack) -> tuple[HelloReading, tuple[DeviceLine, DeviceLine | None], Follower]:
    """Open the ports, identify the devices, choose the tool, and start the reading processes."""
    port = Port(request.head_url, baud=request.head_baud, role="head")
    stack.callback(port.close)
    hello = check_head(port, every=request.every)
    parser = head.HeadParser(hello, every=request.every)
    start, stop = head.encode_command(head.START, every=request.every), head.encode_command(head.STOP)
    devices: list[tuple[Port, Parser, bytes, bytes, float]] = [(port, parser, start, stop, SILENT_S)]
    follower = Follower()
    if request.tracker_url:
        driver = TRACKERS[request.tracker_protocol]
        port = open_tracker(
            request.tracker_protocol, request.tracker_url, baud=request.tracker_baud, roms=request.tracker_rom
        )
        stack.callback(port.close)
        answer = driver.check(port, tool=request.tool, reference=request.reference)
        for words in (f"no pose yet of {answer.unseen}" if answer.unseen else "", answer.parsed.remark):
            if words:
                click.echo(f"{port.name}: {words}", err=True)
        devices.append((port, answer.parser(), driver.start, driver.stop, driver.silent_s))
        follower = Follower(answer.tool, answer.reference, inverse=request.invert_rotation)
    lines = []
    for port, reads, start, stop, silent_s in devices:
        stream = read_in_process(port)
        stack.callback(stream.close)
        lines.append(DeviceLine(port.role, port, stream, reads, start, stop, silent_s))
    for line in lines:
        line.stream.wait_until_ready()
    return hello, (lines[0], lines[1] if len(lines) > 1 else None), follower


def _check_fit(hello: HelloReading, head: HeadGeometry, request: Request) -> None:
    if not hello.rows * hello.columns:
        fault = f"head {request.head_url}: {hello.device_id!r} is a device without taxels; give a head's port"
        raise DeviceError(fault)
    if (hello.rows, hello.columns) != head.shape:
        raise UsageError(
            f"head {request.head_url} has {hello.rows} x {hello.columns} taxels, the geometry given is for "
            f"{head.shape[0]} x {head.shape[1]}; give this head's"
        )
    if not (request.tracker_url or request.uncalibrated):
        click.echo("no tracker: no map can be made of this scan; give its port with --tracker", err=True)
    if request.every > 1:
        click.echo(f"one frame in {request.every}: {hello.rate_hz / request.every:g} Hz", err=True)


def calibration_for(
    hello: HelloReading, given: ElementCalibration | None, request: Request, *, owner: str = ""
) -> ElementCalibration:
    """The calibration given, which must be of this head and its full scale; without one a nominal gain."""
    full_scale, name = hello.saturation_count, f"head {request.head_url}"
    if given is None:
        if not full_scale:
            raise DeviceError(f"{name}: its HELLO has saturation count 0; it must be the count at full scale, as 4095")
        return _nominal((hello.rows, hello.columns), full_scale)
    if owner not in ("", hello.device_id) and not request.accept_calibration:
        raise UsageError(
            f"{name} is {hello.device_id!r}, {request.like} was recorded with {owner!r}; give this head's "
            "--head-geometry and --array-calibration, or --accept-calibration"
        )
    if given.saturation_count != full_scale and not request.accept_calibration:
        raise UsageError(
            f"{name} is saturated at {full_scale} counts, the calibration given at {given.saturation_count}; calibrate "
            "this head, or give --accept-calibration"
        )
    return given


def _nominal(shape: tuple[int, ...], full_scale: int) -> ElementCalibration:
    """The same gain for all taxels, by which full scale is the upper end of the pressure range."""
    return ElementCalibration(np.full(shape, PRESSURE_RANGE_KPA[1] / full_scale), np.zeros(shape), full_scale)


def _is_nominal(calibration: ElementCalibration) -> bool:
    gain, offset = calibration.gain_kpa_per_count, calibration.offset_kpa
    nominal = _nominal(gain.shape, calibration.saturation_count)
    return np.array_equal(gain, nominal.gain_kpa_per_count) and np.array_equal(offset, nominal.offset_kpa)


def _run(recorder: Recorder, signals: list[str], head: HeadGeometry, request: Request) -> RecordingReport:
    wait, drawn = request.duration_s is None and not request.at_once, request.live and can_redraw()
    keys = Keys(recorder, head.scanhead_from_tracker, wait=wait, drawn=drawn)

    def poll() -> None:
        keys.poll()
        if signals:
            recorder.stop(signals[-1])

    with keys.listening():
        return recorder.run(poll)


# --- From scripts: the same recorder, started at once.


@takes(RecordOptions, without=("output", "head_url", "duration_s", "tracker_url", "session_file"))
def record(
    output: PathLike,
    *,
    head: str,
    duration_s: float,
    tracker: str | None = None,
    session: PathLike | None = None,
    **options: Any,
) -> RecordingReport:
    """Record a scan head and a tracker into a scan file for some seconds, starting now.

    Call it from the main thread: Ctrl-C ends the recording in order.

    Parameters
    ----------
    output
        Scan file to write (``.mcap``).
    head
        Port of the scan head.
    duration_s
        By the head's clock.
    tracker
        Port of the tracker; without, there are no poses.
    session
        File of facts of the exam.
    **options
        As of `tactile_bayes.options.RecordOptions`, by default as of `tactile-bayes record`; `force` overwrites.

    Returns
    -------
    RecordingReport
        Frames, poses, what was lost, and cautions.

    Raises
    ------
    DeviceError
        When a port cannot be opened, or a device stopped answering; what came before is in the file.
    UsageError
        When options contradict each other, or the file exists and `force` is false.
    """
    check_number("duration_s", duration_s, 0, open_ends=True)
    values = options | {name: path_of(options[name]) for name in _PATHS if name in options}
    roms = values.get("tracker_rom", ())
    values["tracker_rom"] = tuple(map(path_of, [roms] if isinstance(roms, str | Path) else roms))
    values |= {"output": path_of(output), "head_url": head, "duration_s": duration_s, "at_once": True}
    values |= {"tracker_url": tracker, "session_file": path_of(session)}
    report, _ = make_recording(Request(**values))
    if report.fault:
        raise DeviceError(report.fault)
    return report
