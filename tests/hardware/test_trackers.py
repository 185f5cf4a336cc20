"""Tracker protocols: byte transcripts in, poses out, nothing left over."""

from __future__ import annotations

import math
import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tactile_bayes.hardware.head import encode_pose
from tactile_bayes.hardware.readings import PoseReading
from tactile_bayes.hardware.serial_trackers import TRACKERS, encode_bird
from tactile_bayes.hardware.trackers import crc64, encode_transform

# One pose in every protocol: (10, -5, 1) inches, quaternion (.5, .5, -.5, .5).
FASTRAK = bytes.fromhex(
    "30 31 20 00 00 20 41 00 00 a0 c0 00 00 80 3f 00 00 00 3f 00 00 00 3f 00 00 00 bf 00 00 00 3f 20"
)
FASTRAK_TEXT = b"01   10.00  -5.00   1.00 0.5000 0.5000-0.5000 0.5000\r\n"
FASTRAK_TOUCHING = b"02E  10.00  -5.00-123.45 0.5000-0.5000-0.5000-0.5000\r\n"
LIBERTY = bytes.fromhex(
    "4c 59 01 43 20 00 25 00 00 00 20 41 00 00 a0 c0 00 00 80 3f 00 00 00 3f 00 00 00 3f 00 00 00 bf 00 00 00 3f"
    "40 e2 01 00 00 00 00 00 20"
)
LIBERTY_TEXT = b"01    10.000   -5.000    1.000   0.50000  0.50000 -0.50000  0.50000  123456  0\r\n"
BIRD = bytes.fromhex("e3 11 0e 77 63 01 00 20 00 20 00 60 00 20")
IGTLINK = encode_transform(PoseReading((254.0, -127.0, 25.4), (0.5, 0.5, -0.5, 0.5), 123_456_000_000))
OPEN = encode_pose(PoseReading((254.0, -127.0, 25.4), (0.5, 0.5, -0.5, 0.5), 123_456_000_000), sequence=0)

FLOCK = TRACKERS["bird"].other_parser
assert FLOCK is not None

PROTOCOLS = {
    "fastrak": (TRACKERS["fastrak"].parser, FASTRAK),
    "fastrak text": (TRACKERS["fastrak-ascii"].parser, FASTRAK_TEXT),
    "liberty": (TRACKERS["liberty"].parser, LIBERTY),
    "liberty text": (TRACKERS["liberty-ascii"].parser, LIBERTY_TEXT),
    "bird": (TRACKERS["bird"].parser, BIRD),
    "bird group": (FLOCK, BIRD + b"\x01"),
    "igtlink": (TRACKERS["igtlink"].parser, IGTLINK),
    "open": (TRACKERS["open"].parser, OPEN),
}


def close(pose: PoseReading) -> bool:
    off = max(abs(a - b) for a, b in zip(pose.position_mm, (254.0, -127.0, 25.4), strict=True))
    turn = max(abs(a - b) for a, b in zip(pose.quaternion_wxyz, (0.5, 0.5, -0.5, 0.5), strict=True))
    return off < 0.12 and turn < 1e-6 and pose.tool in ("", "1", "Tracker") and pose.flags == ()


@pytest.mark.parametrize("protocol", PROTOCOLS.values(), ids=PROTOCOLS)
class TestEveryProtocol:
    def test_a_transcript_is_read_and_nothing_is_left_over(self, protocol):
        make, record = protocol
        parser = make()
        poses = parser.feed(record * 5)
        assert len(poses) == 5
        assert all(map(close, poses))
        assert parser.garbage_bytes == 0
        assert len(parser.feed(record)) == 1

    @pytest.mark.parametrize("size", [1, 3, 31, 64])
    def test_bytes_may_come_in_any_pieces(self, protocol, size):
        make, record = protocol
        parser, stream = make(), record * 7
        poses = [p for i in range(0, len(stream), size) for p in parser.feed(stream[i : i + size])]
        assert len(poses) == 7
        assert all(map(close, poses))

    @given(noise=st.binary(max_size=300))
    def test_after_noise_the_records_are_found_again(self, protocol, noise):
        check_noise(protocol, noise)

    @pytest.mark.slow
    @settings(max_examples=10_000)
    @given(noise=st.binary(max_size=300))
    def test_after_noise_the_records_are_found_again_ten_thousand_times(self, protocol, noise):
        check_noise(protocol, noise)

    @given(noise=st.binary(max_size=40), place=st.integers(0, 60), bit=st.integers(0, 7))
    def test_a_pose_is_never_out_of_this_world(self, protocol, noise, place, bit):
        make, record = protocol
        stream = bytearray(record * 3)
        stream[place % len(stream)] ^= 1 << bit
        for pose in make().feed(bytes(stream[:place]) + noise + bytes(stream[place:])):
            assert all(map(math.isfinite, (*pose.position_mm, *pose.quaternion_wxyz)))


@pytest.mark.parametrize("protocol", PROTOCOLS.values(), ids=PROTOCOLS)
def test_one_lost_byte_costs_at_most_two_records(protocol):
    make, record = protocol
    for place in range(len(record)):
        stream = record + record[:place] + record[place + 1 :] + record * 3
        good = [pose for pose in make().feed(stream) if close(pose)]
        assert len(good) >= 3, place


def check_noise(protocol, noise: bytes) -> None:
    make, record = protocol
    parser = make()
    parser.feed(noise)
    # text ends a line, a header may claim a length: the noise may swallow what follows it, but not for long
    poses = [pose for _ in range(80) for pose in parser.feed(record)]
    assert len(poses) >= 3
    assert all(map(close, poses[-3:]))


def test_fastrak_text_is_cut_by_column_because_numbers_touch():
    (pose,) = TRACKERS["fastrak-ascii"].parser().feed(FASTRAK_TOUCHING)
    assert (pose.flags, pose.tool) == (("error E",), "2")
    assert pose.position_mm == pytest.approx((254.0, -127.0, -3135.63))
    assert pose.quaternion_wxyz == (0.5, -0.5, -0.5, -0.5)


def test_records_are_as_long_as_their_items_make_them():
    assert TRACKERS["fastrak"].parser().record_bytes == len(FASTRAK) == 3 + 7 * 4 + 1
    assert TRACKERS["fastrak-ascii"].parser().record_bytes == len(FASTRAK_TEXT) == 3 + 7 * 7 + 2
    assert TRACKERS["liberty"].parser().record_bytes == len(LIBERTY) == 8 + 9 * 4 + 1


def test_liberty_keeps_time_error_and_distortion():
    header = struct.pack("<2sBBBBH", b"PA", 2, ord("C"), ord("I"), 0, 37)
    body = struct.pack("<7fIi", 10, -5, 1, 0.5, 0.5, -0.5, 0.5, 4_000_000_000, -3)
    (pose,) = TRACKERS["liberty"].parser().feed(header + body + b" ")
    assert pose.tool == "2"
    assert pose.device_ns == 4_000_000_000_000_000
    assert pose.flags == ("error I", "distortion -3")


@pytest.mark.parametrize("size", [37, 36])
def test_the_size_may_or_may_not_count_the_space(size):
    record = LIBERTY[:6] + struct.pack("<H", size) + LIBERTY[8:]
    assert len(TRACKERS["liberty"].parser().feed(record)) == 1


def test_bird_words_are_fourteen_bits():
    (pose,) = TRACKERS["bird"].parser().feed(BIRD)
    assert [mm / 25.4 for mm in pose.position_mm] == pytest.approx([9.99756, -5.00098, 0.99756], abs=1e-5)
    assert encode_bird((10, -5, 1, 0.5, 0.5, -0.5, 0.5)) == BIRD
    (second,) = FLOCK().feed(BIRD + b"\x02")
    assert second.tool == "2"


def test_the_checksum_of_a_transform_is_the_published_one():
    assert crc64(b"123456789") == 0x6C40DF5F0B497347


def test_other_messages_and_other_devices_are_passed_over():
    status = struct.pack(">H12s20sIIQQ", 1, b"STATUS", b"Tracker", 0, 0, 4, crc64(b"okay")) + b"okay"
    assert len(TRACKERS["igtlink"].parser().feed(status + IGTLINK)) == 1


def test_an_exact_pose_stays_exact():
    pose = PoseReading((152.27590461023, -107.0805, 1e-9), (0.1, -0.7, 0.1, 0.7), 8_333_333)
    assert TRACKERS["open"].parser().feed(encode_pose(pose, sequence=0)) == [pose]
