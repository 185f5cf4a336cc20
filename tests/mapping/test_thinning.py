"""Fewer frames: which are kept, and what the map says of it."""

from __future__ import annotations

from dataclasses import replace

import mapping_scans as scans
import numpy as np
import pytest

from tactile_bayes.errors import BadDataError
from tactile_bayes.mapping import build_map
from tactile_bayes.mapping.thinning import every_nth, first_seconds
from tactile_bayes.report.map_text import map_text
from tactile_bayes.scan import PressureFrames


def scan():
    return scans.make_scan(scans.strokes(), field=scans.gaussian())


def test_every_third_frame_is_the_map_of_every_third_frame():
    whole = scan()
    by_hand = replace(whole, frames=PressureFrames(whole.frames.time_s[::3], whole.frames.counts[::3].copy()))
    thinned, wanted = build_map(whole, every=3), build_map(by_hand)
    assert np.array_equal(thinned.mean, wanted.mean, equal_nan=True)
    assert np.array_equal(thinned.count, wanted.count)
    assert thinned.count.sum() < 0.4 * build_map(whole).count.sum()
    assert "one of every 3 of the scan" in map_text(thinned)
    assert "one of every" not in map_text(wanted)


def test_all_frames_are_the_scan_itself():
    whole = scan()
    assert every_nth(whole, 1) is whole
    assert len(first_seconds(whole, 1e9).frames) == len(whole.frames)


def test_the_first_seconds_are_those():
    whole = scan()
    start = whole.frames.time_s[0]
    part = first_seconds(whole, 0.5)
    assert part.frames.time_s[-1] <= start + 0.5 < whole.frames.time_s[len(part.frames)]
    assert len(part.poses) == len(whole.poses)


@pytest.mark.parametrize("every", [0, -2, 1.5, True])
def test_a_number_that_is_none_is_refused(every):
    with pytest.raises(BadDataError, match=r"every is .*; give a whole number from 1 on"):
        build_map(scan(), every=every)


def test_no_time_is_refused():
    with pytest.raises(BadDataError, match="duration_s is 0; give a time above 0 s"):
        first_seconds(scan(), 0)
