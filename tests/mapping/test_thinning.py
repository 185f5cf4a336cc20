"""Fewer frames: which are kept, and what the map says of it."""

from __future__ import annotations

import mapping_scans as scans
import numpy as np
import pytest

import tactile_bayes as tb
from tactile_bayes.declarations import replace
from tactile_bayes.errors import UsageError
from tactile_bayes.mapping.build import build_map
from tactile_bayes.mapping.convention import POOL_S, every_stretch, thinning
from tactile_bayes.mapping.select import every_nth, first_seconds
from tactile_bayes.report.map import map_text
from tactile_bayes.scans import PressureFrames


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


def test_the_first_seconds_of_a_scan_end_at_their_time():
    whole = scan()
    start = whole.frames.time_s[0]
    part = first_seconds(whole, 0.5)
    assert part.frames.time_s[-1] <= start + 0.5 < whole.frames.time_s[len(part.frames)]
    assert len(part.poses) == len(whole.poses)


@pytest.mark.parametrize("every", [0, -2, 1.5, True])
def test_a_number_that_is_none_is_refused(every):
    with pytest.raises(UsageError, match=r"every is .*; give a whole number from 1 on"):
        build_map(scan(), every=every)


@pytest.mark.parametrize(("every", "start"), [(6, 3), (12, 4), (21, 17), (32, 7), (40, 39)])
def test_frames_that_come_less_often_make_a_map_from_any_start(every, start):
    # every third stretch of 20 ms was read, and frames 60 ms apart can all lie between those
    whole = tb.demo_scan()
    frames = PressureFrames(whole.frames.time_s[start::every], whole.frames.counts[start::every].copy())
    thinned = build_map(replace(whole, frames=frames))
    assert {"stroke_lag_mm", "stroke_lag_sd_mm"} <= set(thinned.quality)


@pytest.mark.slow
@pytest.mark.parametrize("every", range(2, 41))
def test_every_thinning_makes_a_map_from_every_start(every):
    whole = tb.demo_scan()
    for start in range(every):
        frames = PressureFrames(whole.frames.time_s[start::every], whole.frames.counts[start::every].copy())
        assert "stroke_lag_mm" in build_map(replace(whole, frames=frames)).quality


@pytest.mark.parametrize("step", [0.25, 1, 1.5, 2, 3, 6, 7.3])
@pytest.mark.parametrize("every", [1, 2, 3, 6, 7])
@pytest.mark.parametrize("start", range(3))
def test_of_regular_frames_every_so_many_th_stretch_is_averaged(step, every, start):
    time_s = (start + 0.5 + step * np.arange(400)) * POOL_S
    held = len(np.unique(np.floor(time_s / POOL_S)))
    chosen = np.unique(np.floor(time_s[every_stretch(time_s, every)] / POOL_S))
    assert len(chosen) in (held // every, held // every + 1)
    assert np.ptp(np.diff(np.searchsorted(np.unique(np.floor(time_s / POOL_S)), chosen))) == 0


def test_of_frames_without_gaps_the_clock_says_which():
    time_s = 0.37 + 0.005 * np.arange(1000)
    assert np.array_equal(every_stretch(time_s, 3), np.flatnonzero(np.floor(time_s / POOL_S) % 3 == 0))


def test_a_scan_of_few_frames_keeps_one_stretch():
    assert every_stretch(np.array([0.021, 0.022, 0.05]), 7).tolist() == [0, 1]
    assert every_stretch(np.empty(0), 7).tolist() == []
    assert thinning([np.empty(0)], most=5) == 1
    assert thinning([np.arange(8) * 1.0, np.arange(3) * 1.0], most=5) == 3
