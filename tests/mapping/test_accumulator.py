"""Live or all at once: one map, bit for bit."""

from __future__ import annotations

import mapping_scans as scans
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from tactile_bayes.declarations import replace
from tactile_bayes.geometry import rigid
from tactile_bayes.mapping.accumulate import MapAccumulator
from tactile_bayes.mapping.build import build_map
from tactile_bayes.mapping.cells import FramePoses, distinct_poses, head_moments, poses_at
from tactile_bayes.scans import ElementCalibration, Scan

FRAMES = 90
ARRAYS = ("mean", "variance", "count", "x_mm", "y_mm", "plane_from_base")
FAR = rigid(scans.rotation(40, about=(1, 2, 3)), np.array([1e5, -1e5, 1e5]))


def rough_scan() -> Scan:
    """Nothing is a round number: gains, yaw, levels in and out of the window, some readings at full scale.

    Every taxel works: a live map leaves none out.
    """
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
    gain = scans.GAIN_KPA * (1 + 0.03 * rng.standard_normal((6, 5)))
    calibration = ElementCalibration(gain, 0.05 * rng.standard_normal((6, 5)), saturation_count=65535)
    return replace(scans.with_counts(scan, counts), element_calibration=calibration)


SCANS = {"near": rough_scan(), "far": scans.moved(rough_scan(), FAR)}


def poses_of(scan: Scan) -> FramePoses:
    poses = poses_at(distinct_poses(scan.poses), scan.frames.time_s)
    return FramePoses(poses.position_mm, poses.rotation, poses.known & (np.arange(FRAMES) % 11 != 3))


def plane_of(poses: FramePoses, scan: Scan) -> np.ndarray:
    return head_moments(scan.head, poses).plane().plane_from_base


def empty(scan: Scan, plane_from_base: np.ndarray) -> MapAccumulator:
    return MapAccumulator(scan.head, scan.element_calibration, plane_from_base=plane_from_base)


def fed(scan: Scan, portions, *, plane_from_base: np.ndarray | None = None) -> MapAccumulator:
    """An accumulator that was given the frames in portions, each a list of frame numbers."""
    poses = poses_of(scan)
    grown = empty(scan, plane_of(poses, scan) if plane_from_base is None else plane_from_base)
    for portion in portions:
        grown.add(scan.frames.counts[portion], poses.part(np.asarray(portion, dtype=int)))
    return grown


def same(one: MapAccumulator, two: MapAccumulator) -> bool:
    a, b = one.snapshot(), two.snapshot()
    alike = all(np.array_equal(getattr(a, name), getattr(b, name), equal_nan=True) for name in ARRAYS)
    return alike and one.figures == two.figures


@given(seed=st.integers(0, 999), parts=st.integers(1, FRAMES), name=st.sampled_from(["near", "far"]))
def test_any_portions_in_any_order_give_the_bits_of_the_whole(seed, parts, name):
    order = np.random.default_rng(seed).permutation(FRAMES)
    assert same(fed(SCANS[name], np.array_split(order, parts)), fed(SCANS[name], [np.arange(FRAMES)]))


def test_frame_by_frame_gives_the_bits_of_build_map():
    scan = SCANS["far"]
    at_once = build_map(scan, normalise="mean")
    assert not at_once.masked_taxels
    poses = poses_at(distinct_poses(scan.poses), scan.frames.time_s)
    live = empty(scan, at_once.plane_from_base)
    for frame in range(FRAMES):
        live.add(scan.frames.counts[frame : frame + 1], poses.part(slice(frame, frame + 1)))
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
    assert figures["negative_readings"] >= figures["frames_used"] > 0
    assert figures["clipped_values"] == 0


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
    nothing = fed(scan, [[]])
    assert nothing.snapshot().mean.shape == (0, 0)
    assert set(nothing.figures.values()) == {0.0}
