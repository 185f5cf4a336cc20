"""Noise through every parser: no exception, little memory, and the records after it are read."""

from __future__ import annotations

import random
import tracemalloc
from collections.abc import Callable, Iterator

import pytest
from emulated_devices import short_scan
from test_resync import NAMES, parser_of, stream_of

from tactile_bayes.hardware import head
from tactile_bayes.hardware.emulated import EmulatedHead, EmulatedNdi, EmulatedTracker
from tactile_bayes.hardware.head import encode_packet
from tactile_bayes.hardware.readings import HelloReading
from tactile_bayes.hardware.serial_trackers import PROTOCOLS

MEGABYTE = 1 << 20
PIECE = 4000
# A message of OpenIGTLink may be a megabyte, and is waited for; the text of an NDI command has no end of its own.
MOST_BYTES = 8 * MEGABYTE
# What the grammars are made of: noise of these goes further into them than noise of all bytes.
CHEAP = (b"\0", b"01 ", b"02X", b"LY\x01C \0\x21\0", b"PA", b"\r\n", b" 0.5000", b"-12.34", b"\x80", b"\xe3\x11", b"\n")
DEEP = (b"\0\1TRANSFORM\0\0\0", b"\0\2STATUS\0\0\0\0\0\0", b"\0\3\1\2\1\1\1", b"\0\x11\1\2\4", b"C\r", b"BX:0001", b"c")


def noise(kind: str, size: int, seed: int) -> Iterator[bytes]:
    """Pieces of `size` bytes in all: any bytes, zeros, or the words of the grammars between some of any."""
    rng, left = random.Random(seed), size
    while left > 0:
        if kind == "bytes":
            piece = rng.randbytes(PIECE)
        elif kind == "one byte":
            piece = bytes([rng.choice(b"\0\xff0A L")]) * PIECE
        else:
            piece = b"".join(rng.choice((*CHEAP, *DEEP, rng.randbytes(5))) for _ in range(PIECE // 6))
        piece = piece[:left]
        left -= len(piece)
        yield piece


def held_through(feed: Callable[[bytes], object], kind: str, size: int) -> int:
    """Feed noise; the most memory that was taken on the way, in bytes."""
    feed(next(noise(kind, PIECE, 0)))
    tracemalloc.start()
    try:
        for piece in noise(kind, size, 1):
            feed(piece)
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def check(name: str, kind: str, size: int) -> None:
    parser, stream = parser_of(name), stream_of(name, 3)
    assert held_through(parser.feed, kind, size) < MOST_BYTES
    assert parser.garbage_bytes > 0 or kind == "one byte"
    found = []
    # what waits for its end is given up when whole records come behind it, at the latest after its length
    for _ in range(200 if name != "igtlink" else 2):
        found = [one for record in stream.records for one in parser.feed(record)]
        if found[-3:] == stream.poses[-3:]:
            return
    raise AssertionError(f"{len(found)} poses were read after the noise")


KINDS = ("bytes", "one byte", "words")


@pytest.mark.long_repeats
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", NAMES)
def test_a_tracker_is_read_again_after_noise(name, kind):
    check(name, kind, 20_000)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", NAMES)
def test_a_tracker_is_read_again_after_ten_megabytes_of_noise(name, kind):
    check(name, kind, 10 * MEGABYTE)


def check_head(kind: str, size: int) -> None:
    scan = short_scan(0.1)
    device, parser = EmulatedHead(scan), head.HeadParser()
    parser.hello = HelloReading("h", *scan.head.shape, 4095, 200.0)
    assert held_through(parser.feed, kind, size) < MOST_BYTES
    found = [one for i in range(len(scan.frames)) for one in parser.feed(device.record(i))]
    assert len(found) >= len(scan.frames) - 1
    assert (found[-1].counts == scan.frames.counts[-1]).all()


@pytest.mark.parametrize("kind", KINDS)
def test_a_head_is_read_again_after_noise(kind):
    check_head(kind, 50_000)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_a_head_is_read_again_after_ten_megabytes_of_noise(kind):
    check_head(kind, 10 * MEGABYTE)


@pytest.mark.long_repeats
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", ["head", "ndi", *PROTOCOLS])
def test_an_emulated_device_outlives_noise(name, kind):
    scan = short_scan(0.1)
    device = {"head": lambda: EmulatedHead(scan), "ndi": lambda: EmulatedNdi(scan.poses)}.get(
        name, lambda: EmulatedTracker(scan.poses, protocol=name)
    )()
    assert held_through(device.respond, kind, 20_000) < MOST_BYTES


@pytest.mark.parametrize("payload", [b"", b"\0" * 11, b"\xff" * 58, b"x" * 900])
@pytest.mark.parametrize("number", range(6))
def test_a_whole_packet_of_the_wrong_length_is_no_reading(number, payload):
    parser = head.HeadParser()
    parser.hello = HelloReading("h", 2, 2, 4095, 200.0)
    found = parser.feed(encode_packet(number, payload, sequence=2**32 - 1, device_us=2**64 - 1))
    assert not found or isinstance(found[0], HelloReading) or number == head.END
