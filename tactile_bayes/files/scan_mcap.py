"""Scans as MCAP files, also while they are recorded."""

from __future__ import annotations

import fcntl
import json
import os
import threading
from collections.abc import Collection, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import IO, Any, Final, TypeVar

import numpy as np
from foxglove_schemas_protobuf.Grid_pb2 import Grid
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from google.protobuf.message import DecodeError
from numpy.typing import NDArray

from tactile_bayes import __version__, scans
from tactile_bayes.declarations import Record, as_dict, from_plain
from tactile_bayes.errors import BadDataError, UsageError, in_file
from tactile_bayes.files.atomic import atomic_path, refuse_existing
from tactile_bayes.files.documents import check_session, parse_json
from tactile_bayes.files.instrument import calibration_document, head_document, read_landmarks
from tactile_bayes.files.mcap_records import McapRecords, Messages, read_records
from tactile_bayes.files.provenance import Provenance
from tactile_bayes.findings import Finding, finding, findings_in
from tactile_bayes.geometry import FloatArray
from tactile_bayes.scans import LANDMARK_NAMES

# --- Scan files: MCAP that Foxglove opens, readable after the recording program was killed.
#
# docs/formats.md has the layout. Metadata and attachments come first, so that even an unfinished file says what it is.
# Lengths are in mm, not in the metres that Foxglove assumes: mm / 1000 * 1000 is not always the number it was, and a
# scan must come back as it went in. Viewers draw a head of 24 x 39 "metres"; each channel's metadata says ``mm``.

SCAN_SCHEMA: Final = "tactile-bayes/scan/1"
CHUNK_BYTES: Final = 64 * 1024
NIPPLE: Final = "nipple"  #: An optional landmark; a file has a channel for it only where it was touched.
TOPICS: Final = ("/pressure", "/pose", "/landmark")
_NS: Final = 1_000_000_000
_CALIBRATION: Final = "element_calibration.json"
_LATEST_NS: Final = 2**63 - 1
T = TypeVar("T")


class ScanWriter:
    """Writer of one scan to a binary stream, which stays open: its description, then messages as they arrive.

    `truth` is the scene of a simulated scan, which `read_scan_report` returns beside the scan. `findings` are those of
    the file that the scan is a copy of.
    """

    def __init__(
        self,
        stream: IO[bytes],
        *,
        head: scans.HeadGeometry,
        element_calibration: scans.ElementCalibration,
        session: Mapping[str, str],
        provenance: Provenance,
        truth: Mapping[str, Any] | None = None,
        findings: Sequence[Finding] = (),
    ) -> None:
        from mcap.writer import CompressionType, Writer  # reading a scan need not load it

        self._shape = head.shape
        self._sequence: dict[int, int] = {}
        message_bytes = 2 * head.shape[0] * head.shape[1] + 512
        self._writer = Writer(
            stream,
            chunk_size=max(1, CHUNK_BYTES - message_bytes),  # a chunk closes after the message that fills it
            compression=CompressionType.ZSTD,
            enable_data_crcs=True,
        )
        self._writer.start(profile="", library=f"tactile-bayes/{__version__}")
        documents = {
            "provenance": provenance.as_dict(),
            "truth": truth,
            "findings": [as_dict(one) for one in findings] or None,
        }
        units = {"length_unit": "mm", "time_unit": "ns", "pressure": "raw counts"}
        self._writer.add_metadata("tactile-bayes", {"schema": SCAN_SCHEMA, **units})
        self._writer.add_metadata("session", dict(sorted(session.items())))
        for name, document in documents.items():
            if document is not None:
                self._writer.add_metadata(name, {"json": _compact(document)})
        parts = {"head.json": head_document(head), _CALIBRATION: calibration_document(element_calibration)}
        for name, document in parts.items():
            data = _compact(document).encode()
            self._writer.add_attachment(create_time=0, log_time=0, name=name, media_type="application/json", data=data)
        self._schema_of = {kind: self._schema(kind) for kind in (Grid, PoseInFrame)}
        self._frame_channel = self._channel("/pressure", Grid)
        self._pose_channel = self._channel("/pose", PoseInFrame)
        self._landmark_channel = {name: self._channel("/landmark", PoseInFrame, name=name) for name in LANDMARK_NAMES}
        self._grid = _grid_of(head).SerializeToString(deterministic=True)

    def _schema(self, kind: Any) -> int:
        from mcap_protobuf.schema import build_file_descriptor_set

        data = build_file_descriptor_set(kind).SerializeToString(deterministic=True)
        return int(self._writer.register_schema(name=kind.DESCRIPTOR.full_name, encoding="protobuf", data=data))

    def _channel(self, topic: str, kind: Any, **metadata: str) -> int:
        described, schema = {"length_unit": "mm", **metadata}, self._schema_of[kind]
        return int(self._writer.register_channel(topic, "protobuf", schema, described))

    def add_frame(self, counts: scans.CountArray, *, device_ns: int, host_ns: int) -> None:
        """Add one (rows, columns) frame of raw counts."""
        if counts.shape != self._shape:
            raise BadDataError(f"a frame has shape {counts.shape}", way_out=f"this head has {self._shape} taxels")
        stamp = Grid()
        _stamp(stamp, device_ns)
        data = Grid(data=counts.T.astype("<u2").tobytes())
        # Serialised messages joined are the merged message. One Grid used again and again would keep every frame: its
        # memory is given back only with the message itself.
        body = stamp.SerializeToString() + self._grid + data.SerializeToString()
        self._send(self._frame_channel, body, device_ns=device_ns, host_ns=host_ns)

    def add_pose(self, position_mm: FloatArray, quaternion_wxyz: FloatArray, *, device_ns: int, host_ns: int) -> None:
        """Add one (3,) position and (4,) quaternion, scalar first, of the tracker's sensor in `base`."""
        message = _pose_message(position_mm, quaternion_wxyz)
        self._send_message(self._pose_channel, message, device_ns=device_ns, host_ns=host_ns)

    def add_landmark(self, name: str, position_mm: FloatArray, *, device_ns: int, host_ns: int) -> None:
        """Add one (3,) point of `LANDMARK_NAMES`, or the `NIPPLE`, in `base`."""
        message = _pose_message(position_mm, np.array([1.0, 0.0, 0.0, 0.0]))
        if name not in self._landmark_channel:
            self._landmark_channel[name] = self._channel("/landmark", PoseInFrame, name=name)
        self._send_message(self._landmark_channel[name], message, device_ns=device_ns, host_ns=host_ns)

    def _send_message(self, channel: int, message: Any, *, device_ns: int, host_ns: int) -> None:
        _stamp(message, device_ns)
        self._send(channel, message.SerializeToString(), device_ns=device_ns, host_ns=host_ns)

    def _send(self, channel: int, body: bytes, *, device_ns: int, host_ns: int) -> None:
        sequence = self._sequence.get(channel, 0)
        self._sequence[channel] = sequence + 1
        self._writer.add_message(
            channel_id=channel, log_time=host_ns, publish_time=device_ns, data=body, sequence=sequence
        )

    def finish(self) -> None:
        """Write the last chunk, the index and the footer."""
        self._writer.finish()


def _compact(document: object) -> str:
    return json.dumps(document, allow_nan=False, ensure_ascii=False, separators=(",", ":"))


def _stamp(message: Any, device_ns: int) -> None:
    message.timestamp.seconds, message.timestamp.nanos = divmod(device_ns, _NS)


def _grid_of(head: scans.HeadGeometry) -> Any:
    """Grid message without time and counts, which all frames of the head share."""
    rows, columns = head.shape
    pitch = head.pitch_mm
    grid = Grid(frame_id="scanhead", column_count=rows, row_stride=2 * rows, cell_stride=2)
    grid.cell_size.x = grid.cell_size.y = pitch
    grid.pose.position.x, grid.pose.position.y = -rows * pitch / 2, -columns * pitch / 2
    grid.pose.orientation.w = 1.0
    grid.fields.add(name="counts", offset=0, type=PackedElementField.UINT16)
    return grid


def _pose_message(position_mm: FloatArray, quaternion_wxyz: FloatArray) -> Any:
    message = PoseInFrame(frame_id="base")
    place, turn = message.pose.position, message.pose.orientation
    place.x, place.y, place.z = (float(value) for value in position_mm)
    turn.w, turn.x, turn.y, turn.z = (float(value) for value in quaternion_wxyz)
    return message


def ns_from_s(time_s: FloatArray) -> NDArray[np.int64]:
    """Whole ns of times in s, seconds and fraction apart: a time since 1970 times 1e9 fits no double's 53 bits."""
    seconds = np.floor(time_s)
    nanos = np.rint((time_s - seconds) * _NS)
    return seconds.astype(np.int64) * _NS + nanos.astype(np.int64)


def write_scan(
    path: Path, scan: scans.Scan, *, provenance: Provenance, truth: Mapping[str, Any] | None = None, force: bool = False
) -> None:
    """Write a scan; equal scans give equal bytes. ``log_time`` is the device time, that of landmarks the first one."""
    check_session(scan.session, path=path)
    with atomic_path(path, force=force) as partial, partial.open("wb") as stream:
        writer = ScanWriter(
            stream,
            head=scan.head,
            element_calibration=scan.element_calibration,
            session=scan.session,
            provenance=provenance,
            truth=truth,
            findings=scan.findings,
        )
        frame_ns = ns_from_s(scan.frames.time_s)
        all_ns = np.concatenate([frame_ns, ns_from_s(scan.poses.time_s)])
        if scan.landmarks is not None:
            start = int(all_ns.min()) if len(all_ns) else 0
            for name, point in scan.landmarks.points().items():
                writer.add_landmark(name, point, device_ns=start, host_ns=start)
        for i in np.argsort(all_ns, kind="stable").tolist():
            time = int(all_ns[i])
            if i < len(frame_ns):
                writer.add_frame(scan.frames.counts[i], device_ns=time, host_ns=time)
            else:
                j = i - len(frame_ns)
                writer.add_pose(scan.poses.position_mm[j], scan.poses.quaternion_wxyz[j], device_ns=time, host_ns=time)
        writer.finish()


def read_scan(path: Path) -> scans.Scan:
    """Read a scan; from an unfinished file, everything up to the last complete chunk.

    Damaged chunks are an error: a scan with a hole must not pass for a whole one. `read_scan_report` reads around the
    damage.
    """
    file = read_scan_report(path)
    if file.damaged:
        way_out = "copy it again, or keep what is intact with `tactile-bayes import`"
        raise BadDataError(f"is damaged ({file.lost[0]})", way_out=way_out, path=str(path))
    return file.scan


def touched_landmarks(source: Path | scans.Scan, session: Mapping[str, str]) -> scans.Landmarks:
    """Landmarks of a JSON file or another scan, which is to be of this session's patient, visit and frame."""
    if isinstance(source, Path) and source.suffix.lower() != ".mcap":
        return read_landmarks(source)
    scan = read_scan(source) if isinstance(source, Path) else source
    whose = f"the landmarks of {source}" if isinstance(source, Path) else "the landmarks"
    if scan.landmarks is None:
        raise UsageError(f"{whose} were not touched; give another scan, or a JSON file")
    for name in ("subject", "visit"):
        theirs, ours = scan.session.get(name), session.get(name)
        if theirs and ours and theirs != ours:
            raise UsageError(f"{whose} are of {name} {theirs}, this is {ours}; touch them anew, or leave them out")
    reference = scan.session.get("reference", "")
    if bool(reference) != bool(session.get("reference")):
        frame = f"relative to the tool {reference!r}" if reference else "of the tracker's own frame"
        raise UsageError(f"{whose} are {frame}; touch them with the same --reference")
    return scan.landmarks


class ScanFile(Record, eq=False):
    """A scan and the report on its file."""

    scan: scans.Scan
    complete: bool  #: The file was closed properly and nothing was lost.
    damaged: bool  #: A checksum failed: bytes changed after they were written. An unfinished file is not damaged.
    lost: tuple[str, ...]  #: One line per loss, for people.
    provenance: Mapping[str, Any]  #: As `Provenance.as_dict` wrote it.
    truth: Mapping[str, Any] | None  #: Scene of a simulated scan; None for any other.


def read_scan_report(path: Path) -> ScanFile:
    """Read a scan with the report on its file; one cut off before its first complete chunk is an error."""
    records = scan_records(path, keep=TOPICS)
    with in_file(path):
        head = read_attachment(records, scans.HeadGeometry, "head.json")
        calibration = read_attachment(records, scans.ElementCalibration, _CALIBRATION)
        session = records.metadata.get("session", {})
        check_session(session, path=path)
        frames = _frames(records, head)
        if not len(frames) and not records.finished:
            what = "was cut off before its first complete frame"
            if records.damaged:
                what = f"is damaged ({records.lost[0]})"
            raise BadDataError(what, way_out="copy it again from where it was recorded: this copy holds no frame")
        messages = records.messages("/pose", schema="foxglove.PoseInFrame")
        places = _pose_table(messages)
        poses = scans.TrackerPoses(message_times(messages, topic="/pose"), places[:, :3], places[:, 3:])
        landmarks, findings = _landmarks(records), file_findings(records)
        truth = records.metadata.get("truth")
        return ScanFile(
            scan=scans.Scan(frames, poses, head, calibration, landmarks, session, findings),
            complete=records.finished and not records.lost,
            damaged=records.damaged,
            lost=tuple(records.lost),
            provenance=provenance_of(records),
            truth=None if truth is None else _json_object(truth.get("json", ""), name="truth"),
        )


def scan_records(path: Path, *, keep: Collection[str]) -> McapRecords:
    """Read all records of a scan of a known version; of topics not in `keep` only the times."""
    records = read_records(path, keep=keep)
    if records.lost and not records.finished and is_recording(path):
        last_s = records.last_ns / 1e9
        records.lost[-1] = f"the scan is being recorded: what comes after {last_s:.3f} s is not in it yet"
    schema = records.metadata.get("tactile-bayes", {}).get("schema")
    if schema is None:
        what = "is cut off in its header" if records.lost else "is an MCAP file, but not a scan of this program"
        raise BadDataError(what, way_out="give a scan from `record`, `import` or `simulate`", path=str(path))
    if schema != SCAN_SCHEMA:
        way_out = f"this version reads {SCAN_SCHEMA}; use the program that wrote it"
        raise BadDataError(f"is a scan of schema {schema!r}", way_out=way_out, path=str(path))
    return records


def file_findings(records: McapRecords) -> tuple[Finding, ...]:
    """Findings of a scan's file: of the file that it is a copy of, of losses, and notes of its recorder."""
    copied = parse_json(records.metadata.get("findings", {}).get("json", "[]"), name="findings")
    noted = records.metadata.get("recording", {}).get("cautions", "").splitlines()
    lost = [finding("data_lost", text) for text in records.lost]
    return (*findings_in(copied), *lost, *(finding("recorder_noted", text) for text in noted))


def provenance_of(records: McapRecords) -> dict[str, Any]:
    """The provenance of a scan's file, as `Provenance.as_dict` wrote it."""
    return _json_object(records.metadata.get("provenance", {}).get("json", "{}"), name="provenance")


def read_attachment(records: McapRecords, kind: type[T], name: str) -> T:
    """A record from its JSON among the attachments."""
    if name not in records.attachments:
        way_out = "copy it again: it was cut off in its header"
        if records.finished:
            way_out = "attach it again: the program that wrote this copy left it out"
        raise BadDataError(f"holds no {name}", way_out=way_out)
    document = _json_object(records.attachments[name].decode("utf-8", "replace"), name=name)
    return from_plain(kind, document, where=name)


def _json_object(text: str, *, name: str) -> dict[str, Any]:
    """Parse a JSON object from a part of the file."""
    document = parse_json(text, name=name)
    if not isinstance(document, dict):
        raise BadDataError(f"{name} is a {type(document).__name__}", way_out="it must be a JSON object")
    return document


def message_times(messages: Messages, *, topic: str) -> FloatArray:
    """Times of messages, s; one beyond what 63 bits of nanoseconds hold is an error."""
    times = messages.times_ns
    latest = int(times.max()) if len(times) else 0
    if latest > _LATEST_NS:
        way_out = f"times must be {_LATEST_NS} ns or less; import it with times from 0"
        raise BadDataError(f"{topic} holds a time of {latest} ns", way_out=way_out)
    seconds, nanos = np.divmod(times.astype(np.int64), _NS)  # undoes `ns_from_s` to the bit
    return np.asarray(seconds + nanos / _NS)


def _frames(records: McapRecords, head: scans.HeadGeometry) -> scans.PressureFrames:
    messages = records.messages("/pressure", schema="foxglove.Grid")
    rows, columns = head.shape
    counts: NDArray[np.uint16] = np.empty((len(messages), rows, columns), dtype=np.uint16)
    for i, body in enumerate(messages.bodies()):
        data = _decode(Grid, body).data
        if len(data) != 2 * rows * columns:
            way_out = f"{rows} x {columns} uint16 counts are needed"
            raise BadDataError(f"/pressure message {i} holds {len(data)} bytes", way_out=way_out)
        counts[i] = np.frombuffer(data, dtype="<u2").reshape(columns, rows).T
    return scans.PressureFrames(message_times(messages, topic="/pressure"), counts)


def _pose_table(messages: Messages) -> FloatArray:
    """Rows of position and quaternion, scalar first, one per pose."""
    table: FloatArray = np.empty((len(messages), 7))
    for i, body in enumerate(messages.bodies()):
        pose = _decode(PoseInFrame, body).pose
        place, turn = pose.position, pose.orientation
        table[i] = place.x, place.y, place.z, turn.w, turn.x, turn.y, turn.z
    return table


def _landmarks(records: McapRecords) -> scans.Landmarks | None:
    """Last touches, and the largest distance of an earlier one; None unless all `LANDMARK_NAMES` were touched."""
    points, apart = {}, []
    for name in (*LANDMARK_NAMES, NIPPLE):
        touches = records.messages("/landmark", schema="foxglove.PoseInFrame", name=name)
        if not len(touches):
            if name == NIPPLE:
                continue
            return None
        places = _pose_table(touches)[:, :3]
        points[f"{name}_mm"] = places[-1]
        apart += np.linalg.norm(places[:-1] - places[-1], axis=1).tolist()
    return scans.Landmarks(**points, spread_mm=max(apart) if apart else None)


def _decode(kind: Any, body: bytes) -> Any:
    try:
        return kind.FromString(body)
    except DecodeError:
        what = f"a message is not a {kind.DESCRIPTOR.full_name}"
        raise BadDataError(what, way_out="copy it again, or write such messages") from None


# --- A scan's file during its recording: readable at any moment, whatever happens to the program.

LOG_TOPIC: Final = "/log"
ACCOUNT: Final = "recording"
SYNC_S: Final = 0.5  #: Interval at which written bytes are synced to the disk: power may fail.


def create_exclusive(path: Path, *, force: bool) -> IO[bytes]:
    """Create a file for its owner only, locked until it is closed, under its final name: it must survive a kill."""
    refuse_existing(path, force=force)
    flags = os.O_WRONLY | os.O_CREAT | (0 if force else os.O_EXCL)
    try:
        stream = os.fdopen(os.open(path, flags, 0o600), "wb")
    except OSError as error:
        raise UsageError(f"{path} cannot be written ({error.strerror}); choose another place") from None
    with suppress(OSError):  # some network file systems have no locks
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            stream.close()
            raise being_recorded(path) from None
    stream.truncate(0)
    return stream


def being_recorded(path: Path) -> UsageError:
    """The error of a command that would write or repair a file which a recorder holds."""
    return UsageError(f"{path} is being recorded; wait for its end, or choose another name")


def is_recording(path: Path) -> bool:
    """True while a recorder holds the file locked; False too where that cannot be told."""
    with suppress(OSError), path.open("rb") as stream:  # whoever reads it says what is wrong with it
        try:
            fcntl.flock(stream, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
    return False


class RecordingWriter(ScanWriter):
    """A `ScanWriter` that can flush at once and stores notes about problems; the session was checked before."""

    def __init__(self, stream: IO[bytes], **described: Any) -> None:
        super().__init__(stream, **described)
        self._stream = stream
        # A thread, because the system lets go of the interpreter while it waits for the disk.
        self._thread, self._ended = ThreadPoolExecutor(1, thread_name_prefix="sync"), threading.Event()
        self._asked = False
        self._synced: Future[None] | None = None
        self._log_channel: int = self._writer.register_channel(
            topic=LOG_TOPIC, message_encoding="protobuf", schema_id=self._schema(Log)
        )
        self.flush()

    def add_note(self, text: str, *, device: str, device_ns: int, host_ns: int, serious: bool = False) -> None:
        """Add a line about the data at this time."""
        message = Log(level=Log.WARNING if serious else Log.INFO, message=text, name=device)
        self._send_message(self._log_channel, message, device_ns=device_ns, host_ns=host_ns)

    def flush(self) -> None:
        """Close the chunk and hand it to the system, from where it survives this process.

        Within `SYNC_S` it is on the disk too, and survives the computer. An OSError may be that of the disk before this
        call.
        """
        self._writer.flush()
        if self._synced is not None and self._synced.done():
            self._synced.result()  # raises what the disk did not take
        if not self._asked:
            self._asked = True
            self._synced = self._thread.submit(self._sync, self._stream.fileno())

    def _sync(self, descriptor: int) -> None:
        self._ended.wait(SYNC_S)
        self._asked = False  # what is flushed from here on asks again
        getattr(os, "fdatasync", os.fsync)(descriptor)  # not every system has the first

    def close(self, account: Mapping[str, Any]) -> None:
        """Write the account, the index and the footer, and sync them to the disk."""
        self.stop_syncing()
        self._writer.flush()
        self._writer.add_metadata(ACCOUNT, {name: str(value) for name, value in account.items()})
        self.finish()
        self._stream.flush()
        os.fsync(self._stream.fileno())

    def stop_syncing(self) -> None:
        """Release the file in any case; call it before closing the stream."""
        self._ended.set()
        self._thread.shutdown()


def full_disk(path: Path, error: OSError) -> UsageError:
    """Error for a recording that could not be continued because the disk is full."""
    way_out = "what was recorded before is kept; free space, then `tactile-bayes repair` it"
    return UsageError(f"{path}: cannot be written any further ({error.strerror}); {way_out}")
