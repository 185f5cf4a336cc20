"""Live, in shards or all at once: one map, bit for bit."""

from __future__ import annotations

import mapping_scans as scans
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_bayes.declarations import replace
from tactile_bayes.errors import BadDataError, UsageError
from tactile_bayes.geometry import rigid
from tactile_bayes.mapping.accumulate import Instrument, MapAccumulator, MapGrid
from tactile_bayes.mapping.build import build_map
from tactile_bayes.mapping.plane import FramePoses, poses_at
from tactile_bayes.mapping.select import TaxelFault, find_faults
from tactile_bayes.scans import ElementCalibration, Scan

FRAMES = 90
ARRAYS = ("mean", "variance", "count", "x_mm", "y_mm", "plane_from_base")
FAR = rigid(scans.rotation(40, about=(1, 2, 3)), np.array([1e5, -1e5, 1e5]))


def rough_scan() -> Scan:
    """Nothing is a round number: gains, yaw, levels in and out of the window, some readings at full scale."""
    rng = np.random.default_rng(4)
    head = scans.flat_head(rows=6, columns=5, lever_mm=(3.3, -7.1, 41.0))
    scan = scans.make_scan(
        rng.normal(0, 8, (FRAMES, 2)),
        field=scans.gaussian(),
        head=head,
        yaw_deg=rng.normal(0, 9, FRAMES),
        levels_kpa=rng.uniform(4, 15, FRAMES),
    )
    counts = scan.frames.counts.copy()
    counts[rng.random(counts.shape) < 0.003] = 65535
    counts[:, 4, 4] = 0
    gain = scans.GAIN_KPA * (1 + 0.03 * rng.standard_normal((6, 5)))
    calibration = ElementCalibration(gain, 0.05 * rng.standard_normal((6, 5)), saturation_count=65535)
    return replace(scans.with_counts(scan, counts), element_calibration=calibration)


SCANS = {"near": rough_scan(), "far": scans.moved(rough_scan(), FAR)}


def poses_of(scan: Scan) -> FramePoses:
    poses = poses_at(scan.poses, scan.frames.time_s)
    return FramePoses(poses.position_mm, poses.rotation, poses.known & (np.arange(FRAMES) % 11 != 3))


def instrument_of(scan: Scan, **options) -> Instrument:
    return Instrument(scan.head, scan.element_calibration, find_faults(scan), **options)


def fed(scan: Scan, portions, *, grid: MapGrid | None = None, **options) -> MapAccumulator:
    """An accumulator that was given the frames in portions, each a list of frame numbers."""
    poses = poses_of(scan)
    grown = MapAccumulator(grid or grid_of(scan), instrument_of(scan, **options))
    for portion in portions:
        grown.add(scan.frames.counts[portion], poses.part(np.asarray(portion, dtype=int)))
    return grown


def grid_of(scan: Scan, cell_mm: float = 1.0) -> MapGrid:
    return MapGrid.under(scan.head, poses_of(scan), cell_mm=cell_mm)


def same(one: MapAccumulator, two: MapAccumulator) -> bool:
    a, b = one.snapshot(), two.snapshot()
    alike = all(np.array_equal(getattr(a, name), getattr(b, name), equal_nan=True) for name in ARRAYS)
    planes = [grown.plane().plane_from_base for grown in (one, two)]
    return alike and one.figures == two.figures and np.array_equal(*planes)


@given(seed=st.integers(0, 999), parts=st.integers(1, FRAMES), name=st.sampled_from(["near", "far"]))
def test_any_portions_in_any_order_give_the_bits_of_the_whole(seed, parts, name):
    order = np.random.default_rng(seed).permutation(FRAMES)
    assert same(fed(SCANS[name], np.array_split(order, parts)), fed(SCANS[name], [np.arange(FRAMES)]))


@given(seed=st.integers(0, 999), shards=st.integers(1, 6), normalise=st.sampled_from(["mean", "none"]))
def test_shards_merged_in_any_order_give_the_bits_of_the_whole(seed, shards, normalise):
    scan, rng = SCANS["near"], np.random.default_rng(seed)
    portions = np.array_split(rng.permutation(FRAMES), shards)
    grown = [fed(scan, [portion], normalise=normalise) for portion in portions]
    first, *others = [grown[i] for i in rng.permutation(shards)]
    for other in others:
        first.merge(other)
    whole = fed(scan, [np.arange(FRAMES)], normalise=normalise)
    assert same(first, whole)
    assert same(first.rebuild(), whole.rebuild())


def test_frame_by_frame_gives_the_bits_of_build_map():
    scan = SCANS["far"]
    at_once = build_map(scan, normalise="mean")
    grid = MapGrid(at_once.plane_from_base)
    poses = poses_at(scan.poses, scan.frames.time_s)
    live = MapAccumulator(grid, instrument_of(scan))
    for frame in range(FRAMES):
        live.add(scan.frames.counts[frame : frame + 1], poses.part(slice(frame, frame + 1)))
    assert np.array_equal(live.plane().plane_from_base, at_once.plane_from_base)
    snapshot = live.snapshot()
    for name in ARRAYS:
        assert np.array_equal(getattr(snapshot, name), getattr(at_once, name), equal_nan=True)
    names = set(live.figures) & set(at_once.quality)
    assert len(names) >= 9
    assert {name: live.figures[name] for name in names} == {name: at_once.quality[name] for name in names}


def test_sums_of_floats_would_show_the_portions():
    """The control: the same frames' ratios, added as floats in two orders, differ."""
    scan, grid = SCANS["near"], np.arange(FRAMES)
    pressure = scan.pressure_kpa().reshape(FRAMES, -1)[:, :20]
    ratio = np.nan_to_num(pressure / np.nanmean(pressure, axis=1, keepdims=True))
    assert not np.array_equal(ratio.sum(axis=0), ratio[grid[::-1]].sum(axis=0))


def test_a_rebuilt_map_is_the_one_built_on_that_plane():
    scan = SCANS["near"]
    early = MapGrid.under(scan.head, poses_of(scan).part(slice(0, 1)))
    grown = fed(scan, [[i] for i in range(FRAMES)], grid=early)
    rebuilt = grown.rebuild()
    assert not grown.grid.same(rebuilt.grid)
    assert same(rebuilt, fed(scan, [np.arange(FRAMES)], grid=MapGrid(grown.plane().plane_from_base)))


def test_every_frame_is_counted_once_and_negatives_are_counted():
    scan = SCANS["near"]
    counts = scan.frames.counts.copy()
    counts[:, 0, 0] = 0
    offset = scan.element_calibration.offset_kpa - 0.3
    low = replace(scan, element_calibration=replace(scan.element_calibration, offset_kpa=offset))
    figures = fed(scans.with_counts(low, counts), [np.arange(FRAMES)]).figures
    dropped = [figures[f"dropped_{why}"] for why in ("no_pose", "elements", "low", "high")]
    assert figures["frames_used"] + sum(dropped) == figures["frames_total"] == FRAMES
    assert min(dropped[0], dropped[2], dropped[3]) > 0
    unmasked = MapAccumulator(grid_of(low), Instrument(low.head, low.element_calibration))
    unmasked.add(counts, poses_of(low))
    assert unmasked.figures["negative_readings"] >= unmasked.figures["frames_used"] > 0
    assert unmasked.figures["clipped_values"] == 0


def test_a_later_frame_leaves_an_earlier_snapshot_alone():
    scan = SCANS["near"]
    grown = fed(scan, [np.arange(40)])
    snapshot = grown.snapshot()
    before = snapshot.mean.copy()
    grown.add(scan.frames.counts[40:], poses_of(scan).part(slice(40, None)))
    assert np.array_equal(snapshot.mean, before, equal_nan=True)
    assert grown.snapshot().frame_count > snapshot.frame_count


def test_nothing_added_is_an_empty_map():
    scan = SCANS["near"]
    empty = MapAccumulator(grid_of(scan), instrument_of(scan))
    assert empty.snapshot().mean.shape == (0, 0)
    assert empty.add(scan.frames.counts[:0], poses_of(scan).part(slice(0))) == 0
    with pytest.raises(BadDataError, match="no frame was used yet"):
        empty.plane()


def test_without_kept_frames_there_is_no_rebuilding():
    scan = SCANS["near"]
    lean = MapAccumulator(grid_of(scan), instrument_of(scan), keep_frames=False)
    lean.add(scan.frames.counts, poses_of(scan))
    assert same(lean, fed(scan, [np.arange(FRAMES)]))
    with pytest.raises(UsageError, match="keep_frames=True"):
        lean.rebuild()


def _other(**changes) -> MapAccumulator:
    scan = SCANS["near"]
    grid = changes.pop("grid", None) or grid_of(scan)
    return MapAccumulator(grid, replace(instrument_of(scan), **changes))


def _another_head() -> dict[str, object]:
    head = SCANS["near"].head
    return {"head": replace(head, surface_mm=head.surface_mm * 1.01)}


def _another_calibration() -> dict[str, object]:
    calibration = SCANS["near"].element_calibration
    return {"element_calibration": replace(calibration, gain_kpa_per_count=calibration.gain_kpa_per_count * 1.01)}


UNLIKE = {
    "cell": (lambda: {"grid": grid_of(SCANS["near"], 2.0)}, "another plane or cell size cannot be merged"),
    "plane": (lambda: {"grid": grid_of(SCANS["far"])}, "another plane or cell size"),
    "head": (_another_head, "another head"),
    "calibration": (_another_calibration, "another element calibration"),
    "faults": (lambda: {"faults": (TaxelFault(0, 0, "dead"),)}, "another element calibration|taxels left out"),
    "window": (lambda: {"pressure_window_kpa": (4.0, 14.0)}, "another pressure window"),
    "normalise": (lambda: {"normalise": "none"}, "another way to normalise"),
}


@pytest.mark.parametrize(("make", "message"), UNLIKE.values(), ids=UNLIKE)
def test_what_means_something_else_is_not_merged(make, message):
    grown = fed(SCANS["near"], [np.arange(FRAMES)])
    before = grown.snapshot()
    with pytest.raises(BadDataError, match=message):
        grown.merge(_other(**make()))
    assert np.array_equal(grown.snapshot().count, before.count)


def test_options_that_mean_nothing_are_refused():
    scan = SCANS["near"]
    with pytest.raises(UsageError, match="one by one with normalise 'gain'"):
        instrument_of(scan, normalise="gain")
    with pytest.raises(BadDataError, match=r"cell_mm is -1; it must be positive"):
        MapGrid(np.eye(4), -1)
    with pytest.raises(BadDataError, match="one pose per frame"):
        fed(scan, []).add(scan.frames.counts[:3], poses_of(scan).part(slice(2)))
