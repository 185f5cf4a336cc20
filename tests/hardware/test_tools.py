"""Several tools, tools out of sight, and messages of other kinds: what is followed, what is a gap, what is refused.

Messages are packed here from the protocol's text, with a checksum bit by bit, not by the program's own encoder.
"""

from __future__ import annotations

import contextlib
import math
import os
import socket
import struct
import threading
import tty

import numpy as np
import pytest
from emulated_devices import head_and_tracker, serving, short_scan
from hypothesis import given
from hypothesis import strategies as st

import tactile_bayes as tb
from tactile_bayes.actions.show import describe
from tactile_bayes.declarations import replace
from tactile_bayes.errors import BadDataError, DeviceError, UsageError
from tactile_bayes.files.provenance import Provenance
from tactile_bayes.files.scan_mcap import read_scan, write_scan
from tactile_bayes.geometry import rotation_from_quaternion
from tactile_bayes.hardware import serial_trackers
from tactile_bayes.hardware.emulated import EmulatedHead, EmulatedNdi, EmulatedTracker, Faults, PtyLink, TcpLink
from tactile_bayes.hardware.head import HeadParser, encode_hello, encode_pose
from tactile_bayes.hardware.ports import Port
from tactile_bayes.hardware.readings import (
    Follower,
    HelloReading,
    MissingReading,
    PoseReading,
    relative_pose,
)
from tactile_bayes.hardware.serial_trackers import TRACKERS, check_head, open_tracker
from tactile_bayes.hardware.trackers import IgtlinkParser, encode_transform
from tactile_bayes.mapping.build import build_map
from tactile_bayes.mapping.select import Jumps, scan_findings
from tactile_bayes.scans import TrackerPoses

PLACE, TURN = (254.0, -127.0, 25.5), (0.5, 0.5, -0.5, 0.5)
MATRIX = struct.pack(">12f", *rotation_from_quaternion(np.array(TURN)).T.ravel(), *PLACE)
QUATERNION = struct.pack(">7f", *PLACE, *TURN[1:], TURN[0])
IDENTITY = struct.pack(">12f", 1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0)
SEEN = PoseReading(PLACE, TURN, 5_500_000_000, tool="Probe")


def checksum(data: bytes) -> int:
    """CRC-64 of ECMA-182, bit by bit."""
    crc = 0
    for byte in data:
        crc ^= byte << 56
        for _ in range(8):
            crc = (crc << 1 ^ (0x42F0E1EBA9EA3693 if crc >> 63 else 0)) & (1 << 64) - 1
    return crc


def message(kind: bytes, body: bytes, *, name: bytes = b"Probe", version: int = 1, crc: int | None = None) -> bytes:
    crc = checksum(body) if crc is None else crc
    return struct.pack(">H12s20sIIQQ", version, kind, name, 5, 1 << 31, len(body), crc) + body


def extended(content: bytes, *facts: tuple[bytes, bytes], size: int = 12) -> bytes:
    """Body of header version 2 and later: extended header, content, metadata."""
    header = struct.pack(">H", len(facts)) + b"".join(struct.pack(">HHI", len(k), 3, len(v)) for k, v in facts)
    data = b"".join(key + value for key, value in facts)
    return struct.pack(">HHII", size, len(header), len(data), 9).ljust(size, b"\0") + content + header + data


def is_seen(reading: object) -> bool:
    """Whether it is `SEEN`, of a matrix to its rounding."""
    return (
        isinstance(reading, PoseReading)
        and reading[2:] == SEEN[2:]
        and reading.position_mm == PLACE
        and np.allclose(reading.quaternion_wxyz, TURN, atol=1e-12)
    )


def named(name: bytes, numbers: bytes) -> bytes:
    return struct.pack(">20sBB", name, 2, 0) + numbers


GOOD = (b"TransformValid", b"True"), (b"TransformStatus", b"OK")
MESSAGES = {
    "version 1": message(b"TRANSFORM", MATRIX),
    "version 2": message(b"TRANSFORM", extended(MATRIX, *GOOD), version=2),
    "version 2 without metadata": message(b"TRANSFORM", extended(MATRIX), version=2),
    "version 3": message(b"TRANSFORM", extended(MATRIX, *GOOD), version=3),
    "a longer extended header": message(b"TRANSFORM", extended(MATRIX, *GOOD, size=20), version=2),
    "version 2 with the body of 1": message(b"TRANSFORM", MATRIX, version=2),
    "3D Slicer": message(b"TRANSFORM", extended(MATRIX, (b"TransformStatus", b"UNKNOWN")), version=2),
    "a pressed button": message(
        b"TRANSFORM", extended(MATRIX, (b"TransformValid", b"False"), (b"TransformStatus", b"SWITCH1_IS_ON")), version=2
    ),
    "POSITION": message(b"POSITION", QUATERNION),
    "QTRANS": message(b"QTRANS", QUATERNION),
    "TDATA": message(b"TDATA", named(b"Probe", MATRIX), name=b"Tracker"),
    "QTDATA": message(b"QTDATA", extended(named(b"Probe", QUATERNION)), name=b"Tracker", version=2),
    "no checksum": message(b"TRANSFORM", MATRIX, crc=0),
}


@pytest.mark.parametrize("wire", MESSAGES.values(), ids=MESSAGES)
def test_every_kind_of_message_with_a_pose_is_read(wire):
    whole, parser = IgtlinkParser(), IgtlinkParser()
    pieces = [(wire * 5)[i : i + 7] for i in range(0, 5 * len(wire), 7)]
    for found in (whole.feed(wire * 5), [one for piece in pieces for one in parser.feed(piece)]):
        assert len(found) == 5
        assert all(map(is_seen, found))
    assert whole.garbage_bytes == parser.garbage_bytes == 0


@pytest.mark.long_repeats
@pytest.mark.parametrize("wire", MESSAGES.values(), ids=MESSAGES)
def test_every_byte_lost_or_turned_costs_that_message_and_the_next_at_most(wire):
    for at in range(len(wire)):
        for bad in (wire[:at] + wire[at + 1 :], wire[:at] + bytes([wire[at] ^ 0x41]) + wire[at + 1 :]):
            assert sum(map(is_seen, IgtlinkParser().feed(wire + bad + wire * 5)[-4:])) == 4, at


@pytest.mark.parametrize(
    ("wire", "why"),
    [
        (message(b"TRANSFORM", IDENTITY), "identity sent"),
        (message(b"POSITION", struct.pack(">7f", 0, 0, 0, 0, 0, 0, 1)), "identity sent"),
        (message(b"TRANSFORM", bytes(48)), "no rotation"),
        (message(b"TRANSFORM", struct.pack(">12f", *9 * [math.nan], 1, 2, 3)), "no rotation"),
        (message(b"TRANSFORM", struct.pack(">12f", 1, 0, 0, 0, 1, 0, 0, 0, -1, 1, 2, 3)), "no rotation"),  # mirrored
        (message(b"TRANSFORM", extended(MATRIX, (b"TransformStatus", b"OUT_OF_VOLUME")), version=2), "out of volume"),
        (message(b"TRANSFORM", extended(MATRIX, (b"TransformStatus", b"\x1b[2J")), version=2), "unknown status"),
        (message(b"TRANSFORM", extended(MATRIX, (b"TransformValid", b"False")), version=2), "invalid"),
    ],
)
def test_a_tool_without_a_pose_is_missing_for_the_reason_given(wire, why):
    assert IgtlinkParser().feed(wire) == [MissingReading(why, "Probe")]


def test_many_tools_in_one_message_keep_their_names():
    body = named(b"Reference", MATRIX) + named(b"Probe", MATRIX) + named(b"Pen", IDENTITY)
    first, second, third = IgtlinkParser().feed(message(b"TDATA", body))
    assert is_seen(second)
    assert (first.tool, third) == ("Reference", MissingReading("identity sent", "Pen"))
    assert IgtlinkParser().feed(message(b"TDATA", b"")) == []  # nothing is seen: servers leave tools out


@pytest.mark.parametrize(
    ("wire", "fault"),
    [
        (message(b"TRANSFORM", MATRIX, crc=0x1234), "TRANSFORM of 'Probe' has the checksum 0000000000001234, its body"),
        (message(b"TRANSFORM", MATRIX[:-4]), "has a body of 44 bytes"),
        (message(b"TRANSFORM", extended(MATRIX[4:]), version=2), "header version 2, has a body of 58 bytes"),
        (struct.pack("<H12s20sIIQQ", 1, b"TRANSFORM", b"P", 5, 0, 48, 1) + MATRIX, "its numbers are little-endian"),
        (message(b"STATUS", b"okay") + message(b"STRING", b"hi"), "STATUS, STRING came, but no TRANSFORM"),
        (
            message(b"TRANSFORM", struct.pack(">12f", 2, 0, 0, 0, 2, 0, 0, 0, 2, 1, 2, 3)),
            "'Probe' sends is no rotation",
        ),
    ],
)
def test_the_fault_of_a_record_is_named(wire, fault):
    parser = IgtlinkParser()
    found = parser.feed(wire * 3 + bytes(60))
    assert not [one for one in found if isinstance(one, PoseReading)]
    assert fault in parser.fault


def test_an_image_is_passed_over_without_being_kept():
    image = message(b"IMAGE", bytes(range(256)) * 12_000, crc=1)
    parser, found, most = IgtlinkParser(), [], 0
    for i in range(0, len(image), 4096):
        found += parser.feed(image[i : i + 4096])
        most = max(most, len(parser._rest))
    assert is_seen(*parser.feed(MESSAGES["version 2"]))
    assert (found, parser.garbage_bytes) == ([], 0)
    assert most < 100


def test_an_image_whose_size_is_spoilt_hides_no_pose():
    header = struct.pack(">H12s20sIIQQ", 1, b"IMAGE", b"x", 5, 0, 1 << 60, 1)
    assert is_seen(*IgtlinkParser().feed(header + bytes(500) + MESSAGES["version 1"]))


def test_what_the_emulator_sends_is_by_the_text_too():
    assert encode_transform(SEEN) == MESSAGES["version 1"]
    assert IgtlinkParser().feed(encode_transform(MissingReading("", "Probe"))) == [
        MissingReading("identity sent", "Probe")
    ]


def test_a_pose_in_the_open_framing_carries_its_tool_and_what_speaks_against_it():
    flagged = SEEN._replace(flags=("partly out of volume",))
    sent = [SEEN, flagged, MissingReading("out of volume", "Probe"), SEEN._replace(tool="")]
    assert HeadParser().feed(b"".join(encode_pose(one, sequence=0) for one in sent)) == sent


# --- Which tool is followed.


def pose(x: float, tool: str, time: int | None = None) -> PoseReading:
    return PoseReading((x, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), time, tool=tool)


def followed(follower: Follower, *readings: PoseReading | MissingReading, step_ns: int = 10_000_000) -> list:
    found = [one for i, each in enumerate(readings) for one, _ in follower.take(each, i * step_ns)]
    return [one.position_mm[0] if isinstance(one, PoseReading) else one.why for one in found]


def test_only_the_chosen_tool_is_followed_and_others_are_counted():
    follower = Follower("b")
    assert followed(follower, pose(1, "a"), pose(2, "b"), pose(3, "c"), MissingReading("hidden", "b")) == [2, "hidden"]
    assert follower.other_tools == {"a": 1, "c": 1}
    assert followed(Follower(), pose(1, "a"), pose(2, "b"), pose(3, "a")) == [1, 3]  # by default that seen first


STAMPS = {
    "one stamp": [(1, 1), (2, 2), (3, 3)],
    "none": [(None, None)] * 3,
    "each its own": [(1, 11), (101, 111), (201, 211)],
}


@pytest.mark.parametrize("times", STAMPS.values(), ids=STAMPS)
@pytest.mark.parametrize("reference_first", [True, False])
def test_a_tool_is_placed_by_the_reference_of_its_own_moment(times, reference_first):
    pairs = [(pose(10.0 * i, "ref", a), pose(10.0 * i + 5 + i, "tool", b)) for i, (a, b) in enumerate(times)]
    stream = [one for pair in pairs for one in (pair if reference_first else pair[::-1])]
    assert followed(Follower("tool", "ref"), *stream) == [5, 6, 7]


def test_without_the_reference_there_is_no_pose():
    follower = Follower("tool", "ref")
    hidden = MissingReading("hidden", "ref")
    stream = [pose(0, "ref", 1), pose(5, "tool", 1), hidden, pose(6, "tool", 2), hidden, pose(7, "tool", 3)]
    assert followed(follower, *stream, pose(1, "ref", 3)) == [5, "no pose of ref", 6]
    lost = [pose(0, "ref", 1), pose(5, "tool", 1), pose(16, "tool", 2), pose(20, "ref", 3), pose(27, "tool", 3)]
    assert followed(Follower("tool", "ref"), *lost) == [5, -4, 7]  # a lost one costs that pose 10 ms, no other
    late = [pose(0, "ref", 1), pose(5, "tool", 1), pose(6, "tool", 2), pose(7, "tool", 3)]
    assert followed(Follower("tool", "ref"), *late, step_ns=40_000_000) == [5, "no pose of ref"]


UNIT = st.floats(-1, 1)


@given(
    st.tuples(*3 * [st.floats(-500, 500)]),
    st.tuples(*3 * [st.floats(-500, 500)]),
    st.tuples(*4 * [UNIT]).filter(lambda q: math.hypot(*q) > 0.1),
)
def test_a_relative_pose_is_the_product_of_the_transforms(place, base_place, turn):
    turn = tuple(part / math.hypot(*turn) for part in turn)
    base, seen = PoseReading(base_place, turn, tool="ref"), PoseReading(place, TURN, tool="tool")
    found = relative_pose(seen, base)
    rotation = rotation_from_quaternion(np.array(turn))
    np.testing.assert_allclose(found.position_mm, rotation.T @ (np.array(place) - base_place), atol=1e-9)
    np.testing.assert_allclose(
        rotation_from_quaternion(np.array(found.quaternion_wxyz)),
        rotation.T @ rotation_from_quaternion(np.array(TURN)),
        atol=1e-12,
    )
    tracker = relative_pose(PoseReading((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)), base)
    np.testing.assert_allclose(relative_pose(found, tracker).position_mm, place, atol=1e-9)


def test_rotations_are_inverted_before_they_are_combined():
    base = PoseReading((1, 2, 3), (0.6, 0.8, 0, 0), 1, tool="ref")
    seen = PoseReading((4, 5, 6), TURN, 1, tool="tool")
    inverted = [one._replace(quaternion_wxyz=(w, -i, -j, -k)) for one in (base, seen) for w, i, j, k in [one[1]]]
    plain, turned = Follower("tool", "ref"), Follower("tool", "ref", inverse=True)
    kept = [
        [one for each in stream for one, _ in follower.take(each, 0)]
        for follower, stream in (
            (plain, (base, seen)),
            (turned, inverted),
        )
    ]
    assert kept[0] == kept[1]


TWO = ("1", "2", "'1', '2'")
CASES = {
    "fastrak": TWO,
    "fastrak-ascii": TWO,
    "liberty": TWO,
    "liberty-ascii": TWO,
    "bird": TWO,
    "open": ("Probe", "Reference", "'Probe', 'Reference'"),
    "igtlink": ("Probe", "Reference", "'Probe', 'Reference'"),
}


@pytest.mark.long
@pytest.mark.parametrize("protocol", CASES)
def test_two_tools_are_refused_without_a_choice_and_followed_with_one(protocol):
    first, second, listed = CASES[protocol]
    tracker = EmulatedTracker(short_scan(0.5).poses, protocol=protocol, faults=Faults(breathe_mm=10.0))
    link = TcpLink("127.0.0.1", 0) if protocol == "igtlink" else PtyLink()
    driver = TRACKERS[protocol]
    with serving(tracker, link, leads=False):
        port = open_tracker(protocol, link.url)
        with pytest.raises(UsageError, match=f"sends several tools: {listed}; name the one on the head with --tool"):
            driver.check(port)
        with pytest.raises(UsageError, match=f"its reference are both {first!r}"):
            driver.check(port, tool=first, reference=first)
        with pytest.raises(
            DeviceError, match=rf"no pose of a tool 'Pen' comes \(is it in sight\?\); it sends {listed}"
        ):
            driver.check(port, tool="Pen")
        answer = driver.check(port, tool=first, reference=second)
        assert (answer.tool, answer.reference, answer.unseen) == (first, second, "")
        assert driver.check(port, reference=second).tool == first
        port.close()


def test_a_name_may_leave_out_the_frame_but_not_part_of_the_name():
    tools = ("ProbeToTracker", "Probe2ToTracker", "ReferenceToTracker", "0A-8700339")
    called = serial_trackers._tools_named
    assert called(tools, "Probe") == called(tools, "ProbeToTracker") == ["ProbeToTracker"]
    assert called(tools, "0A") == ["0A-8700339"]
    assert called(tools, "Pro") == called(tools, ".*") == []
    assert called(("StylusTipToReference",), "StylusTipToReferenceOfTheTable") == ["StylusTipToReference"]
    assert called(("ProbeToTracker", "ProbeToReference"), "Probe") == ["ProbeToTracker", "ProbeToReference"]


def test_a_flock_in_group_mode_is_noticed_by_what_it_sends():
    poses = short_scan(0.2).poses
    with serving(EmulatedTracker(poses, protocol="bird"), PtyLink()) as emulator:
        port = open_tracker("bird", emulator.link.url)
        answer = TRACKERS["bird"].check(port)
        assert answer.tools == {"": ""}
        assert answer.parser().record_bytes == TRACKERS["bird"].parser().record_bytes
        port.close()


@pytest.mark.long
def test_records_of_another_tracker_are_named():
    with serving(EmulatedTracker(short_scan(0.5).poses, protocol="liberty"), PtyLink()) as emulator:
        port = Port(emulator.link.url, baud=115_200, role="tracker")
        port.write(b"C\r")
        with pytest.raises(DeviceError, match=r"records of a Polhemus LIBERTY .*give --tracker-protocol liberty"):
            replace(TRACKERS["fastrak"], stop=b"", configure=(), single=b"").check(port)
        port.close()


@pytest.mark.parametrize("protocol", ["fastrak", "liberty-ascii", "bird", "open"])
def test_a_single_record_of_another_tracker_is_named(protocol):
    """Of what answers once when it is asked, nothing was said but "give another --tracker-protocol"."""
    record = EmulatedTracker(short_scan(0.2).poses, protocol=protocol).record(3)
    asked = TRACKERS["liberty"]
    words = asked._fault_words(asked.parser(), b"\r\n", record, rate=True)
    assert words.endswith(f"records of {TRACKERS[protocol].title}; give --tracker-protocol {protocol}")


@pytest.mark.long
def test_a_server_that_sends_only_on_request_is_asked():
    listener = socket.create_server(("127.0.0.1", 0))

    def answer() -> None:
        peer, _ = listener.accept()
        with peer, contextlib.suppress(OSError):
            asked = b""
            while len(asked) < 58 + 36:
                asked += peer.recv(4096)
            assert struct.unpack(">H12s", asked[:14]) == (1, b"STT_TDATA".ljust(12, b"\0"))
            assert asked[50:58] == checksum(asked[58:]).to_bytes(8, "big")
            peer.sendall(message(b"RTS_TDATA", b"\0") + message(b"TDATA", named(b"Probe", MATRIX)) * 3)
            peer.recv(1)  # until the other end closes

    thread = threading.Thread(target=answer, daemon=True)
    thread.start()
    port = open_tracker("igtlink", f"socket://127.0.0.1:{listener.getsockname()[1]}")
    assert TRACKERS["igtlink"].check(port).tools == {"Probe": ""}
    port.close()
    thread.join(5.0)
    listener.close()


def test_a_reference_alone_is_no_tool():
    with serving(EmulatedTracker(short_scan(0.5).poses, protocol="fastrak"), PtyLink()) as emulator:
        port = open_tracker("fastrak", emulator.link.url)
        with pytest.raises(UsageError, match=r"sends only the reference, '1'; is the tool on the head in sight\?"):
            TRACKERS["fastrak"].check(port, reference="1")
        port.close()


def test_frames_of_poses_are_not_mixed(tmp_path):
    scan = tb.demo_scan()
    fixed = replace(scan, session={**scan.session, "reference": "Sternum"})
    with pytest.raises(BadDataError, match=r"differ in reference \(Sternum, the tracker's own frame\)"):
        build_map([scan, fixed], every=8)
    write_scan(tmp_path / "fixed.mcap", fixed, provenance=Provenance("test", {}))
    given = {"head": "loop://head", "tracker": "loop://tracker", "like": tmp_path / "fixed.mcap", "duration_s": 1.0}
    with pytest.raises(UsageError, match="are relative to the tool 'Sternum'; touch them with the same reference"):
        tb.record(tmp_path / "a.mcap", landmarks=tmp_path / "fixed.mcap", **given)


# --- Whole recordings.


@pytest.mark.long
@pytest.mark.parametrize(("protocol", "step_mm"), [("liberty", 0.3), ("igtlink", 1e-4), ("open", 1e-9)])
def test_breathing_goes_with_the_reference(tmp_path, protocol, step_mm):
    """To the rounding of the protocol; LIBERTY's clock has whole ms."""
    scan = short_scan(1.5)
    write_scan(tmp_path / "like.mcap", scan, provenance=Provenance("test", {}))
    faults, (first, second, _) = Faults(breathe_mm=20.0), CASES[protocol]
    with head_and_tracker(scan, protocol=protocol, tcp=protocol == "igtlink", tracker_faults=faults) as words:
        given = {"head": words[1], "tracker": words[3], "tracker_protocol": protocol, "like": tmp_path / "like.mcap"}
        report = tb.record(tmp_path / "a.mcap", duration_s=1.4, clock="shared", tool=first, reference=second, **given)
    found = read_scan(tmp_path / "a.mcap")
    assert report.other_tools == ""
    assert (found.session["tool"], found.session["reference"]) == (first, second)
    assert len(found.poses) > 100
    there = [np.interp(found.poses.time_s, scan.poses.time_s, column) for column in scan.poses.position_mm.T]
    off = np.abs(found.poses.position_mm - np.transpose(there)).max(axis=1)
    assert off.max() < step_mm


@pytest.mark.long
@pytest.mark.parametrize("protocol", ["igtlink", "open", "ndi"])
def test_a_hidden_tool_leaves_a_gap_that_show_and_map_tell(tmp_path, protocol):
    if protocol == "ndi":
        pytest.importorskip("ndicapy")
    scan, faults = short_scan(2.0), Faults(hide=(0.6, 0.5))
    write_scan(tmp_path / "like.mcap", scan, provenance=Provenance("test", {}))
    given = {"like": tmp_path / "like.mcap", "duration_s": 1.9, "tracker_protocol": protocol}
    if protocol == "ndi":
        lines = [PtyLink(), PtyLink()]
        tracker = EmulatedNdi(short_scan(9.0).poses, faults=Faults(hide=(1.5, 0.5)))
        with serving(EmulatedHead(scan), lines[0]), serving(tracker, lines[1]):
            report = tb.record(tmp_path / "a.mcap", head=lines[0].url, tracker=lines[1].url, **given)
    else:
        with head_and_tracker(scan, protocol=protocol, tcp=True, tracker_faults=faults) as words:
            report = tb.record(tmp_path / "a.mcap", head=words[1], tracker=words[3], **given)
    why = {"igtlink": "identity sent", "open": "out of sight", "ndi": "out of volume"}[protocol]
    total = report.poses + report.poses_missing
    said = f"{report.poses_missing:,} of {total:,} poses missing: {why} {report.poses_missing:,}"
    assert said in report.cautions
    found = read_scan(tmp_path / "a.mcap")
    gaps = np.diff(found.poses.time_s)
    assert gaps.max() > 0.4
    assert np.abs(found.poses.position_mm).max(axis=1).min() > 1.0  # no identity among them
    if protocol != "ndi":
        period = float(np.median(np.diff(scan.poses.time_s)))
        assert abs(report.poses_missing - 0.5 / period) <= 2
    told = describe(tmp_path / "a.mcap")
    assert said in " ".join(told["findings"])
    assert told["recording"]["missing_why"] == f"{why} {report.poses_missing:,}"
    assert told["notes"] >= 2  # where the gap begins and where it ends
    assert said in " ".join(one.text for one in scan_findings(found))


@pytest.mark.long
def test_a_tool_hidden_at_the_start_is_told_and_recorded_once_seen(tmp_path, capfd):
    scan = short_scan(1.0)
    write_scan(tmp_path / "like.mcap", scan, provenance=Provenance("test", {}))
    with head_and_tracker(scan, protocol="igtlink", tcp=True, tracker_faults=Faults(hide=(0.0, 0.3))) as words:
        given = {"head": words[1], "tracker": words[3], "tracker_protocol": "igtlink", "like": tmp_path / "like.mcap"}
        report = tb.record(tmp_path / "a.mcap", duration_s=0.9, **given)
    assert "no pose yet of Tracker (identity sent)" in capfd.readouterr().err
    assert report.poses > 20 < report.poses_missing


@pytest.mark.long
def test_jumps_are_told_and_named_in_place_of_the_quaternions():
    scan = tb.demo_scan()
    place = scan.poses.position_mm.copy()
    place[1::2] += (300.0, 0.0, 0.0)  # every other pose is of another tool
    mixed = replace(scan, poses=TrackerPoses(scan.poses.time_s, place, scan.poses.quaternion_wxyz))
    (found,) = [one for one in scan_findings(mixed) if one.kind == "poses_jump"]
    assert found.severity == "caution"
    assert f"jump {len(place) - 1:,} times, by up to 30" in found.text
    flipped = scan.poses.position_mm.copy()
    flipped[200:400] *= -1.0
    opposite = TrackerPoses(scan.poses.time_s, flipped, scan.poses.quaternion_wxyz)
    (line,) = Jumps.of(opposite).cautions()
    assert "jump 2 times" in line
    assert "hemisphere" in line
    (told,) = [one for one in scan_findings(replace(scan, poses=opposite)) if one.kind == "poses_jump"]
    assert told.remedy == "set the tracker's hemisphere to the patient's side, and scan again"
    assert not Jumps.of(scan.poses).cautions()
    assert found in build_map(mixed, every=4).findings
    turned = scan.poses.quaternion_wxyz.copy()
    turned[1::2] = turned[1::2, [1, 0, 3, 2]] * (-1.0, 1.0, 1.0, -1.0)  # and it lies on its back
    with pytest.raises(BadDataError, match=r"89 degrees apart, where the poses jump .*; record one tool"):
        build_map(replace(scan, poses=TrackerPoses(scan.poses.time_s, place, turned)), every=4)


@pytest.mark.long
def test_a_board_that_restarts_when_its_port_is_opened_is_waited_for(monkeypatch):
    monkeypatch.setattr(serial_trackers, "_RESTART_S", 1.2)
    near, far = os.openpty()
    tty.setraw(far)

    def boot() -> None:
        for line in (b"ets Jul 29 2019 12:21:46\r\n", b"rst:0x1 (POWERON_RESET)\r\n", b"load:0x3fff0030\r\n"):
            os.write(near, line)
            threading.Event().wait(0.4)
        os.read(near, 4096)  # asked meanwhile, in vain
        os.read(near, 4096)
        os.write(near, encode_hello(HelloReading("head-7", 2, 2, 4095, 10.0)))

    threading.Thread(target=boot, daemon=True).start()
    port = Port(os.ttyname(far), baud=2_000_000, role="head")
    assert check_head(port).device_id == "head-7"
    port.close()
    os.close(near)
    os.close(far)


# --- Peers that mean harm, or are broken.


def test_headers_after_headers_do_not_keep_the_program_busy(monkeypatch):
    checked = []
    monkeypatch.setattr("tactile_bayes.hardware.trackers.crc64", lambda data: checked.append(len(data)) or 1)
    fake = b"".join(struct.pack(">H12s20sIIQQ", 2, b"TDATA", b"x", 1, 0, 8000, 5) for _ in range(2000))
    parser = IgtlinkParser()
    for i in range(0, len(fake), 4096):
        assert parser.feed(fake[i : i + 4096]) == []
    assert sum(checked) < 40 * len(fake)
    monkeypatch.undo()
    assert sum(is_seen(one) for _ in range(200) for one in parser.feed(MESSAGES["version 1"])) > 50


def test_names_without_end_are_counted_together():
    follower = Follower("tool")
    assert followed(follower, *(pose(0, f"made up {i}") for i in range(1000)), *[pose(0, "made up 3")] * 5) == []
    assert len(follower.other_tools) < 20
    assert (follower.other_tools.total(), follower.other_tools["made up 3"]) == (1005, 6)


def test_a_second_head_on_the_line_is_told_and_its_frames_are_left_out():
    parser = HeadParser()
    first = HelloReading("head-7", 2, 2, 4095, 10.0)
    assert parser.feed(encode_hello(first) + encode_hello(HelloReading("head-8", 3, 3, 4095, 10.0))) == [first]
    assert parser.feed(encode_hello(first)) == [first]  # a head says it again after each START
    assert parser.fault == "it sent a HELLO of 'head-8' with 3 x 3 taxels beside that of 'head-7'"


@pytest.mark.long
def test_a_tracker_that_floods_costs_no_frame(tmp_path, monkeypatch):
    scan = short_scan(1.0)
    write_scan(tmp_path / "like.mcap", scan, provenance=Provenance("test", {}))
    fake = b"".join(struct.pack(">H12s20sIIQQ", 2, b"TDATA", b"x", 1, 0, 8000, 5) for _ in range(500))
    listener, recording = socket.create_server(("127.0.0.1", 0)), threading.Event()

    def flood() -> None:
        with contextlib.suppress(OSError):
            peer, _ = listener.accept()
            with peer:
                while not recording.is_set():
                    peer.sendall(MESSAGES["version 1"])
                    recording.wait(0.01)
                while True:
                    peer.sendall(fake)

    threading.Thread(target=flood, daemon=True).start()
    url = f"socket://127.0.0.1:{listener.getsockname()[1]}"
    given = {"tracker": url, "tracker_protocol": "igtlink", "like": tmp_path / "like.mcap", "duration_s": 0.9}
    head = EmulatedHead(scan)
    monkeypatch.setattr(head, "start", lambda start=head.start: (start(), recording.set()))
    monkeypatch.setattr("tactile_bayes.hardware.recorder.OVERTIME_S", 60.0)  # a busy computer may lag behind the head
    with serving(head, PtyLink()) as emulator, contextlib.suppress(DeviceError):
        tb.record(tmp_path / "a.mcap", head=emulator.link.url, **given)
    listener.close()
    found = describe(tmp_path / "a.mcap")
    assert (found["frames_missing"], found["complete"]) == (0, True)
    assert found["frames"] > 100
    assert found["recording"]["ended_by"].startswith("duration")
