"""The open framing: golden bytes, every single-bit error, garbage in any place."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tactile_bayes.errors import BadDataError, DeviceError
from tactile_bayes.hardware.head import (
    MOST_LOST,
    HeadParser,
    Packet,
    PacketParser,
    check_link_rate,
    cobs_decode,
    cobs_encode,
    encode_command,
    encode_end,
    encode_frame,
    encode_hello,
    encode_packet,
    encode_pose,
    needed_baud,
)
from tactile_bayes.hardware.readings import EndReading, FrameReading, HelloReading, PoseReading

HELLO = HelloReading("head-7", 16, 26, 4095, 200.0)

# Made by another program (the cobs package and zlib) after docs/scan-head-protocol.md; firmware can check against them.
GOLDEN = {
    "hello": (
        encode_hello(HELLO),
        "00 03 01 01 01 01 01 01 01 01 01 01 01 01 01 08 10 1a ff 0f 40 0d 03 0b 68 65 61 64 2d 37 e2 76 9e a2 00",
    ),
    "start": (
        encode_command(129, every=1),
        "00 03 01 81 01 01 01 01 01 01 01 01 01 01 01 06 01 0d e6 53 07 00",
    ),
    "end": (
        encode_end(12000, 2),
        "00 03 01 03 01 01 01 01 01 01 01 01 01 01 01 03 e0 2e 01 02 02 01 01 05 e8 f8 44 72 00",
    ),
}
COBS = [
    ("", "01"),
    ("00", "01 01"),
    ("00 00", "01 01 01"),
    ("11 22 00 33", "03 11 22 02 33"),
    ("11 22 33 44", "05 11 22 33 44"),
    ("11 00 00 00", "02 11 01 01 01"),
    ("01" * 254, "ff" + "01" * 254),
    ("01" * 255, "ff" + "01" * 254 + "02 01"),
    ("01" * 254 + "00", "ff" + "01" * 254 + "01 01"),
]


def frame(seed: int = 1, *, sequence: int = 0, shape: tuple[int, int] = (16, 26)) -> tuple[np.ndarray, bytes]:
    counts = np.random.default_rng(seed).integers(0, 4096, shape).astype(np.uint16)
    return counts, encode_frame(counts, sequence=sequence, device_us=5000 * sequence)


@pytest.mark.parametrize(("plain", "stuffed"), COBS)
def test_stuffing_is_the_published_one(plain, stuffed):
    assert cobs_encode(bytes.fromhex(plain)) == bytes.fromhex(stuffed)
    assert cobs_decode(bytes.fromhex(stuffed)) == bytes.fromhex(plain)


@given(st.binary(max_size=1200) | st.binary(max_size=5).map(lambda part: part * 300))
def test_stuffing_round_trips_and_leaves_no_zero(data):
    stuffed = cobs_encode(data)
    assert 0 not in stuffed
    assert cobs_decode(stuffed) == data


@pytest.mark.parametrize("broken", ["", "05 11", "00", "03 11 00 22", "02 11 05"])
def test_codes_that_do_not_end_with_the_data_are_refused(broken):
    assert cobs_decode(bytes.fromhex(broken)) is None


@pytest.mark.parametrize("name", GOLDEN)
def test_the_golden_packets_are_those_of_the_protocols_page(name):
    made, golden = GOLDEN[name]
    assert made.hex(" ") == golden
    page = (Path(__file__).parents[2] / "docs" / "scan-head-protocol.md").read_text(encoding="utf-8")
    assert golden in page


def test_a_golden_frame_byte_by_byte():
    # version 1, type 2, sequence 0x01020304, 0x1122334455667788 us, one row of two taxels: 0x0102 and 0x0A00
    body = bytes.fromhex("01 02 04 03 02 01 88 77 66 55 44 33 22 11 02 01 00 0a")
    assert body == struct.pack("<BBIQ2H", 1, 2, 0x01020304, 0x1122334455667788, 0x0102, 0x0A00)
    crc = zlib.crc32(body).to_bytes(4, "little")
    assert crc.hex(" ") == "a8 de 89 98"
    wire = bytes.fromhex("00 11 01 02 04 03 02 01 88 77 66 55 44 33 22 11 02 01 06 0a a8 de 89 98 00")
    counts = np.array([[0x0102, 0x0A00]], dtype=np.uint16)
    assert encode_frame(counts, sequence=0x01020304, device_us=0x1122334455667788) == wire
    assert PacketParser().packets(wire) == [Packet(2, 0x01020304, 0x1122334455667788, body[14:])]


def test_every_payload_comes_back():
    parser = HeadParser()
    counts, wire = frame(sequence=7)
    pose = PoseReading((152.27590461, -1e-300, 3.0), (0.1, -0.7, 0.1, 0.7), 8_333_333)
    hello, read, turned, end = parser.feed(
        encode_hello(HELLO) + wire + encode_pose(pose, sequence=1) + encode_end(9, 2)
    )
    assert hello == HELLO
    assert isinstance(read, FrameReading)
    np.testing.assert_array_equal(read.counts, counts)
    assert (read.device_ns, read.lost) == (35_000_000, 0)
    assert turned == pose
    assert end == EndReading(9, 2)


def test_every_single_bit_error_of_a_frame_is_detected_and_costs_only_that_frame():
    before, after = frame(2, sequence=1)[1], frame(3, sequence=3)[1]
    _, wire = frame(1, sequence=2)
    for bit in range(8 * len(wire)):
        broken = bytearray(wire)
        broken[bit // 8] ^= 1 << bit % 8
        packets = PacketParser().packets(before + bytes(broken) + after)
        numbers = [packet.sequence for packet in packets]
        # a flipped delimiter spoils what touches it, but each packet has its own on either side
        if 0 < bit // 8 < len(wire) - 1:
            assert numbers == [1, 3], bit
        else:
            assert numbers == [1, 2, 3] or numbers == [1, 3], bit


@pytest.mark.parametrize("size", [1, 2, 7, 853, 10_000])
def test_bytes_may_come_in_any_pieces(size):
    stream = b"".join(frame(i, sequence=i)[1] for i in range(9))
    parser = PacketParser()
    found = [p.sequence for i in range(0, len(stream), size) for p in parser.packets(stream[i : i + size])]
    assert found == list(range(9))
    assert parser.garbage_bytes == 0


def insert_garbage(wires: list[bytes], garbage: list[tuple[int, bytes]]) -> bytes:
    pieces = [bytearray(wire) for wire in wires]
    for place, noise in garbage:
        pieces[place % len(pieces)] += noise
    return b"".join(map(bytes, pieces))


def check_garbage_between_packets(garbage: list[tuple[int, bytes]], cut: int) -> None:
    wires = [frame(i, sequence=i, shape=(2, 3))[1] for i in range(4)]
    stream = insert_garbage(wires, garbage)
    parser = PacketParser()
    found = parser.packets(stream[:cut]) + parser.packets(stream[cut:])
    assert [packet.sequence for packet in found if packet.kind == 2] == [0, 1, 2, 3]


def check_anything(data: bytes, cut: int) -> None:
    parser = HeadParser()
    parser.feed(data[:cut])
    parser.feed(data[cut:])
    counts, wire = frame(5, shape=(16, 26))
    found = [r for r in parser.feed(encode_hello(HELLO) + wire) if isinstance(r, FrameReading)]
    assert len(found) == 1
    np.testing.assert_array_equal(found[0].counts, counts)


GARBAGE = st.lists(st.tuples(st.integers(0, 3), st.binary(max_size=40)), max_size=4)


@given(GARBAGE, st.integers(0, 200))
def test_garbage_between_packets_costs_none(garbage, cut):
    check_garbage_between_packets(garbage, cut)


@given(st.binary(max_size=2000), st.integers(0, 2000))
def test_after_anything_the_next_packet_is_found(data, cut):
    check_anything(data, cut)


@pytest.mark.slow
@settings(max_examples=10_000)
@given(GARBAGE, st.integers(0, 200))
def test_garbage_between_packets_costs_none_ten_thousand_times(garbage, cut):
    check_garbage_between_packets(garbage, cut)


@pytest.mark.slow
@settings(max_examples=10_000)
@given(st.binary(max_size=2000), st.integers(0, 2000))
def test_after_anything_the_next_packet_is_found_ten_thousand_times(data, cut):
    check_anything(data, cut)


def test_noise_without_a_delimiter_is_dropped():
    parser = PacketParser()
    for _ in range(100):
        parser.packets(b"\x55" * 4000)
    assert parser.garbage_bytes >= 300_000
    assert [p.sequence for p in parser.packets(frame(sequence=4)[1])] == [4]


def test_gaps_wraps_and_restarts_of_the_sequence():
    parser = HeadParser()
    parser.feed(encode_hello(HELLO))
    found = [parser.feed(frame(sequence=one)[1])[0] for one in (2**32 - 2, 2**32 - 1, 0, 3, 3 + 5, 0)]
    assert [one.lost for one in found] == [0, 0, 0, 2, 4, 0]
    assert [one.restarted for one in found] == [False] * 5 + [True]


@pytest.mark.parametrize(("jump", "lost"), [(1, 0), (4, 3), (MOST_LOST + 1, MOST_LOST), (MOST_LOST + 2, 0), (2**30, 0)])
def test_a_counter_that_jumps_far_is_damaged_and_no_loss(jump, lost):
    parser = HeadParser()
    parser.feed(encode_hello(HELLO) + frame(sequence=7)[1])
    (reading,) = parser.feed(frame(sequence=7 + jump)[1])
    assert (reading.lost, reading.restarted) == (lost, jump > MOST_LOST + 1)


def test_a_decimated_head_loses_nothing_by_leaving_out():
    parser = HeadParser(every=4)
    parser.feed(encode_hello(HELLO))
    found = [parser.feed(frame(sequence=sequence)[1])[0].lost for sequence in (0, 4, 8, 16)]
    assert found == [0, 0, 0, 1]


def test_what_does_not_fit_its_kind_is_counted():
    parser = HeadParser()
    assert parser.feed(frame()[1]) == []  # no hello yet: how many rows?
    parser.feed(encode_hello(HELLO))
    for wire in (frame(shape=(3, 3))[1], encode_packet(77, b"", sequence=0, device_us=0)):
        assert parser.feed(wire) == []
    for kind in (1, 3, 4):
        assert parser.feed(encode_packet(kind, b"x", sequence=0, device_us=0)) == []
    assert parser.fault == "it sent a POSE of 1 bytes"


def test_another_version_is_told_apart_from_noise():
    body = bytes.fromhex("02 02 00 00 00 00") + bytes(8)
    wire = b"\0" + cobs_encode(body + zlib.crc32(body).to_bytes(4, "little")) + b"\0"
    parser = PacketParser()
    assert parser.packets(wire) == []
    assert "packets of version 2 of the framing, this program reads 1" in parser.fault
    assert parser.garbage_bytes == 0


def test_a_payload_above_the_limit_is_refused():
    with pytest.raises(BadDataError, match="a packet holds"):
        encode_packet(2, bytes(20_000), sequence=0, device_us=0)


def test_the_line_rate_is_that_of_the_longest_frame():
    worst = max(
        len(encode_frame(np.full((16, 26), v, np.uint16), sequence=2**32 - 1, device_us=2**64 - 1)) for v in (0, 257)
    )
    assert 2000 * worst <= needed_baud(416, rate_hz=200.0) == 1_712_000
    check_link_rate(HELLO, baud=2_000_000)
    check_link_rate(HELLO, baud=460_800, every=4)
    with pytest.raises(
        DeviceError, match=r"/dev/x: 16 x 26 taxels at 200 Hz need 1.71 Mbaud, the line has 0.1152.*--every 15"
    ):
        check_link_rate(HELLO, baud=115_200, port="/dev/x")
