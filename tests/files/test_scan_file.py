"""Scan files: exact round trips, the reference reader's view, and every way a file can be cut or changed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from mcap.reader import make_reader
from mcap.records import Chunk
from mcap.stream_reader import StreamReader
from mcap_protobuf.decoder import DecoderFactory

from tactile_bayes.declarations import replace
from tactile_bayes.errors import BadDataError, UsageError
from tactile_bayes.files.provenance import Provenance
from tactile_bayes.files.scan_mcap import CHUNK_BYTES, ScanWriter, read_scan, read_scan_report, write_scan
from tactile_bayes.forward.scene import Lump, Scene
from tactile_bayes.forward.simulate import simulate
from tactile_bayes.scans import ElementCalibration, HeadGeometry, Landmarks, PressureFrames, Scan, TrackerPoses

MADE = Provenance("test", {"a": 1})
SCENE = Scene(duration_s=1.0, lumps=(Lump(),))
FINITE = st.floats(-1e6, 1e6, allow_nan=False, width=64)


@pytest.fixture(scope="module")
def scan() -> Scan:
    return simulate(SCENE, rng=np.random.default_rng(3)).scan


@pytest.fixture(scope="module")
def whole(scan: Scan, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("whole") / "scan.mcap"
    write_scan(path, scan, provenance=MADE, truth={"lumps": [1, 2]})
    return path


def assert_same(a: Scan, b: Scan) -> None:
    np.testing.assert_array_equal(a.frames.counts, b.frames.counts)
    np.testing.assert_array_equal(a.poses.position_mm, b.poses.position_mm)
    np.testing.assert_array_equal(a.poses.quaternion_wxyz, b.poses.quaternion_wxyz)
    np.testing.assert_array_equal(a.head.surface_mm, b.head.surface_mm)
    np.testing.assert_array_equal(a.head.scanhead_from_tracker, b.head.scanhead_from_tracker)
    np.testing.assert_array_equal(a.element_calibration.gain_kpa_per_count, b.element_calibration.gain_kpa_per_count)
    np.testing.assert_array_equal(a.element_calibration.offset_kpa, b.element_calibration.offset_kpa)
    assert a.element_calibration.saturation_count == b.element_calibration.saturation_count
    assert a.head.pitch_mm == b.head.pitch_mm
    assert dict(a.session) == dict(b.session)
    for x, y in ((a.frames.time_s, b.frames.time_s), (a.poses.time_s, b.poses.time_s)):
        np.testing.assert_allclose(x, y, rtol=2e-16, atol=0.51e-9)
    assert (a.landmarks is None) == (b.landmarks is None)
    if a.landmarks is not None and b.landmarks is not None:
        np.testing.assert_array_equal(a.landmarks.xiphoid_mm, b.landmarks.xiphoid_mm)
        np.testing.assert_array_equal(a.landmarks.sternal_notch_mm, b.landmarks.sternal_notch_mm)


@st.composite
def scans(draw: st.DrawFn) -> Scan:
    n, m = draw(st.integers(0, 4)), draw(st.integers(0, 4))
    rows, columns = draw(st.integers(1, 3)), draw(st.integers(1, 3))
    taxels = (rows, columns)
    times = st.floats(0, 2e9, allow_nan=False)
    quaternion = draw(arrays(np.float64, (m, 4), elements=st.floats(-1, 1)))
    quaternion[np.linalg.norm(quaternion, axis=1) < 0.1] = [1.0, 0.0, 0.0, 0.0]
    quaternion /= np.linalg.norm(quaternion, axis=1, keepdims=True)
    point = arrays(np.float64, 3, elements=FINITE)
    return Scan(
        PressureFrames(
            np.sort(draw(arrays(np.float64, n, elements=times))),
            draw(arrays(np.uint16, (n, *taxels))),
        ),
        TrackerPoses(
            np.sort(draw(arrays(np.float64, m, elements=times))),
            draw(arrays(np.float64, (m, 3), elements=FINITE)),
            quaternion,
        ),
        HeadGeometry(draw(arrays(np.float64, (*taxels, 3), elements=FINITE)), draw(st.floats(0.01, 50)), np.eye(4)),
        ElementCalibration(
            draw(arrays(np.float64, taxels, elements=st.floats(0, 1e3))),
            draw(arrays(np.float64, taxels, elements=FINITE)),
            draw(st.integers(0, 65535)),
        ),
        landmarks=draw(st.none() | st.builds(Landmarks, point, point)),
        session=draw(st.dictionaries(st.from_regex(r"x_[a-z0-9]{0,9}", fullmatch=True), st.text(max_size=9))),
    )


@given(scans())
@settings(suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture, HealthCheck.data_too_large])
def test_any_scan_comes_back_as_it_went_in(tmp_path: Path, scan: Scan) -> None:
    path = tmp_path / "any.mcap"
    write_scan(path, scan, provenance=MADE, force=True)
    file = read_scan_report(path)
    assert file.complete
    assert_same(file.scan, scan)
    again = tmp_path / "again.mcap"
    write_scan(again, file.scan, provenance=MADE, force=True)
    assert again.read_bytes() == path.read_bytes()


def test_the_same_scan_gives_the_same_bytes(scan: Scan, whole: Path, tmp_path: Path) -> None:
    write_scan(tmp_path / "b.mcap", scan, provenance=MADE, truth={"lumps": [1, 2]})
    assert (tmp_path / "b.mcap").read_bytes() == whole.read_bytes()


def test_the_report_counts_topics_and_names_the_maker(whole: Path) -> None:
    file = read_scan_report(whole)
    assert (len(file.scan.poses), len(file.scan.frames)) == (120, 200)
    assert file.complete
    assert not file.damaged
    assert file.lost == ()
    assert file.provenance["command"] == "test"


def test_truth_is_kept_apart(scan: Scan, whole: Path, tmp_path: Path) -> None:
    assert read_scan_report(whole).truth == {"lumps": [1, 2]}
    assert "truth" not in read_scan(whole).session
    write_scan(tmp_path / "real.mcap", scan, provenance=MADE)
    assert read_scan_report(tmp_path / "real.mcap").truth is None


def test_the_reference_reader_sees_the_same_counts_and_poses(scan: Scan, whole: Path) -> None:
    with whole.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        decoded = list(reader.iter_decoded_messages(log_time_order=False))
    times = [message.log_time for _, _, message, _ in decoded]
    assert times == sorted(times)
    grids = [(message, grid) for _, channel, message, grid in decoded if channel.topic == "/pressure"]
    for i, (message, grid) in enumerate(grids):
        # A grid is row by row in y; the array's axis 0 is x.
        cells = np.frombuffer(grid.data, dtype="<u2").reshape(-1, grid.column_count)
        np.testing.assert_array_equal(cells.T, scan.frames.counts[i])
        assert message.publish_time == grid.timestamp.seconds * 10**9 + grid.timestamp.nanos
    assert [(f.name, f.offset) for f in grids[0][1].fields] == [("counts", 0)]
    poses = [pose for _, channel, _, pose in decoded if channel.topic == "/pose"]
    assert [pose.pose.position.y for pose in poses] == scan.poses.position_mm[:, 1].tolist()
    assert {pose.frame_id for pose in poses} == {"base"}
    names = [channel.metadata["name"] for _, channel, _, _ in decoded if channel.topic == "/landmark"]
    assert names == ["sternal_notch", "xiphoid"]


def test_chunks_stay_small(whole: Path) -> None:
    with whole.open("rb") as stream:
        chunks = [r for r in StreamReader(stream, emit_chunks=True).records if isinstance(r, Chunk)]
    assert len(chunks) > 2
    assert max(chunk.uncompressed_size for chunk in chunks) <= CHUNK_BYTES
    assert {chunk.compression for chunk in chunks} == {"zstd"}


def test_a_file_cut_anywhere_gives_a_prefix_or_one_line(scan: Scan, whole: Path, tmp_path: Path) -> None:
    data = whole.read_bytes()
    cut = tmp_path / "cut.mcap"
    rng = np.random.default_rng(0)
    kept: list[int] = []
    told: list[str] = []
    for length in sorted({0, 3, 8, 20, len(data) - 1, len(data) - 20, *rng.integers(0, len(data), 40).tolist()}):
        cut.write_bytes(data[:length])
        try:
            file = read_scan_report(cut)
        except BadDataError as error:
            told.append(str(error))
            kept.append(0)
            continue
        n = len(file.scan.frames)
        kept.append(n)
        assert not file.complete
        assert not file.damaged
        assert len(file.lost) == 1
        np.testing.assert_array_equal(file.scan.frames.counts, scan.frames.counts[:n])
        np.testing.assert_array_equal(file.scan.frames.time_s, scan.frames.time_s[:n])
    assert kept == sorted(kept)
    assert all(str(cut) in line and "\n" not in line and "damaged" not in line for line in told)
    assert kept[0] == 0
    assert kept[-1] == len(scan.frames)
    assert len(set(kept)) > 3


def chunk_offsets(path: Path) -> list[int]:
    """Where each chunk's compressed bytes are, from the index."""
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    return [index.chunk_start_offset + index.chunk_length // 2 for index in summary.chunk_indexes]


@pytest.mark.parametrize("which", [0, 1, -1])
def test_a_changed_byte_in_a_chunk_is_reported(scan: Scan, whole: Path, tmp_path: Path, which: int) -> None:
    data = bytearray(whole.read_bytes())
    data[chunk_offsets(whole)[which]] ^= 0x41
    bad = tmp_path / "bad.mcap"
    bad.write_bytes(data)
    file = read_scan_report(bad)
    assert file.damaged
    assert not file.complete
    assert "chunk" in file.lost[0]
    assert 0 < len(file.scan.frames) < len(scan.frames)
    assert np.isin(file.scan.frames.time_s, scan.frames.time_s).all()
    with pytest.raises(BadDataError, match="is damaged"):
        read_scan(bad)


def test_of_two_files_joined_the_second_is_lost_with_a_word(scan: Scan, whole: Path, tmp_path: Path) -> None:
    """The second exam was left out, and the file called whole."""
    joined = tmp_path / "joined.mcap"
    joined.write_bytes(2 * whole.read_bytes())
    file = read_scan_report(joined)
    assert_same(file.scan, replace(scan, findings=file.scan.findings))
    assert (file.complete, file.damaged) == (False, True)
    assert "another file was joined to it" in file.lost[0]


def test_a_file_whose_first_chunk_is_damaged_was_not_cut_off(whole: Path, tmp_path: Path) -> None:
    data = bytearray(whole.read_bytes())
    for place in chunk_offsets(whole):
        data[place] ^= 0x41
    bad = tmp_path / "bad.mcap"
    bad.write_bytes(data[:-100])
    with pytest.raises(BadDataError, match=r"is damaged .chunk 1.*holds no frame"):
        read_scan_report(bad)


def test_a_changed_byte_anywhere_is_never_silent(whole: Path, tmp_path: Path) -> None:
    """Every byte up to the index is under a checksum."""
    data = whole.read_bytes()
    end = chunk_offsets(whole)[-1]
    bad = tmp_path / "bad.mcap"
    for place in np.random.default_rng(1).integers(8, end, 60).tolist():
        changed = bytearray(data)
        changed[place] ^= 0x10
        bad.write_bytes(changed)
        with pytest.raises(BadDataError):
            read_scan(bad)


def test_a_recording_in_progress_can_be_read(scan: Scan, tmp_path: Path) -> None:
    path = tmp_path / "live.mcap"
    with path.open("wb") as stream:
        writer = ScanWriter(
            stream,
            head=scan.head,
            element_calibration=scan.element_calibration,
            session={"examiner": "E7"},
            provenance=MADE,
        )
        for i, frame in enumerate(scan.frames.counts):
            writer.add_frame(frame, device_ns=i * 5_000_000, host_ns=10**18 + i * 5_000_000)
        stream.flush()
        file = read_scan_report(path)
        with pytest.raises(BadDataError, match="a frame has shape"):
            writer.add_frame(scan.frames.counts[0][:3], device_ns=0, host_ns=0)
    assert 100 < len(file.scan.frames) < len(scan.frames)
    assert file.scan.frames.time_s[1] == 0.005  # the device's clock, not the host's
    assert "cut off" in file.lost[0]
    assert file.scan.session == {"examiner": "E7"}


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "is empty"),
        (b"\x89MCAP", "cut off in its header"),
        (b"zipzipzip", "not an MCAP file"),
        (b"PK\x03\x04zipzipzip", "is an archive"),
    ],
)
def test_a_foreign_file_is_one_line(tmp_path: Path, content: bytes, words: str) -> None:
    path = tmp_path / "x.mcap"
    path.write_bytes(content)
    with pytest.raises(BadDataError, match=words) as caught:
        read_scan(path)
    assert caught.value.exit_code == 3
    assert "\n" not in str(caught.value)


def test_another_programs_mcap_is_refused(tmp_path: Path) -> None:
    from mcap.writer import Writer

    path = tmp_path / "other.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        writer.finish()
    with pytest.raises(BadDataError, match="not a scan of this program"):
        read_scan(path)
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        writer.add_metadata("tactile-bayes", {"schema": "tactile-bayes/scan/9"})
        writer.finish()
    with pytest.raises(BadDataError, match="schema 'tactile-bayes/scan/9'"):
        read_scan(path)


def test_a_missing_file_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(BadDataError, match="cannot be read"):
        read_scan(tmp_path / "none.mcap")


def test_an_existing_file_stays_unless_forced(scan: Scan, tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    path.write_text("mine")
    with pytest.raises(UsageError, match="--force"):
        write_scan(path, scan, provenance=MADE)
    assert path.read_text() == "mine"


@pytest.mark.parametrize(
    ("session", "words"),
    [
        ({"side": "middle"}, "side"),
        ({"examiner": "Dr Jane Doe"}, "examiner"),
        ({"patient_name": "x"}, "propert|must not|name"),
        ({"Head": "x"}, "propert|Head|match"),
    ],
)
def test_a_session_that_may_name_a_person_is_refused(
    scan: Scan, tmp_path: Path, session: dict[str, str], words: str
) -> None:
    named = replace(scan, session=session)
    with pytest.raises(BadDataError, match=words):
        write_scan(tmp_path / "s.mcap", named, provenance=MADE)
    assert not list(tmp_path.iterdir())


def test_a_landmark_touched_again_counts_last_and_tells_its_spread(scan: Scan, tmp_path: Path) -> None:
    path = tmp_path / "again.mcap"
    with path.open("wb") as stream:
        writer = ScanWriter(
            stream,
            head=scan.head,
            element_calibration=scan.element_calibration,
            session=scan.session,
            provenance=Provenance("test", {}),
        )
        for name, x_mm in (("xiphoid", 0.0), ("sternal_notch", 1.0), ("sternal_notch", 5.0)):
            writer.add_landmark(name, np.array([x_mm, 0.0, 3.0]), device_ns=0, host_ns=0)
        writer.finish()
    marks = read_scan(path).landmarks
    assert marks is not None
    assert (marks.sternal_notch_mm[0], marks.spread_mm) == (5.0, 4.0)
