"""A recording of hours needs no more memory than one of seconds."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from emulated_devices import short_scan
from foxglove_schemas_protobuf.Grid_pb2 import Grid
from mcap.reader import make_reader

from tactile_bayes.files.provenance import Provenance
from tactile_bayes.files.scan_mcap import RecordingWriter, write_scan
from tests.endurance.recording import write_moment

STATM = Path("/proc/self/statm")


def resident_bytes() -> int:
    return int(STATM.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


@pytest.mark.skipif(not STATM.exists(), reason="the system does not say how much memory a process holds")
def test_what_was_written_is_not_kept_in_memory(tmp_path):
    scan = short_scan(0.2)
    with (tmp_path / "a.mcap").open("wb") as stream:
        writer = RecordingWriter(
            stream,
            head=scan.head,
            element_calibration=scan.element_calibration,
            session={"source": "test"},
            provenance=Provenance("test", {}),
        )
        for number in range(1000):
            write_moment(writer, scan, number)
        before = resident_bytes()
        for number in range(1000, 9000):
            write_moment(writer, scan, number)
        grown = resident_bytes() - before
        writer.stop_syncing()
    assert grown < 2e6, f"{grown / 8000:.0f} bytes a frame"  # 832 bytes a frame would be 6.7 MB; the index takes 0.14


def test_a_frame_is_the_message_that_its_parts_make(tmp_path):
    scan = short_scan(0.1)
    write_scan(tmp_path / "a.mcap", scan, provenance=Provenance("test", {}))
    with (tmp_path / "a.mcap").open("rb") as stream:
        bodies = [message.data for _, _, message in make_reader(stream).iter_messages(topics=["/pressure"])]
    assert len(bodies) == len(scan.frames)
    for i, body in enumerate(bodies):
        grid = Grid.FromString(body)
        assert grid.SerializeToString(deterministic=True) == body  # in the order that one message would have
        assert grid.timestamp.seconds * 10**9 + grid.timestamp.nanos == round(scan.frames.time_s[i] * 1e9)
        assert (grid.frame_id, len(grid.fields)) == ("scanhead", 1)
        counts = np.frombuffer(grid.data, dtype="<u2").reshape(scan.head.shape[::-1]).T
        np.testing.assert_array_equal(counts, scan.frames.counts[i])
