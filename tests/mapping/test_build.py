"""From scans to a map: exact answers, what must not change it, and a defined answer at every extreme."""

from __future__ import annotations

import re
from itertools import pairwise

import mapping_scans as scans
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from tactile_bayes.declarations import replace
from tactile_bayes.errors import BadDataError, UsageError
from tactile_bayes.geometry import apply, rigid
from tactile_bayes.mapping.arrangement import check_scan
from tactile_bayes.mapping.build import build_map
from tactile_bayes.mapping.map import TactileMap
from tactile_bayes.scans import HeadGeometry, Landmarks, PressureFrames, Scan, TrackerPoses

ALL = (0.0, 30.0)
MARKS = Landmarks(np.array([60.0, 200.0, -40.0]), np.array([60.0, 20.0, -35.0]))
ARRAYS = ("mean", "variance", "count", "x_mm", "y_mm", "plane_from_base")


def same(one: TactileMap, two: TactileMap) -> bool:
    return all(np.array_equal(getattr(one, name), getattr(two, name), equal_nan=True) for name in ARRAYS)


def wide_scan(**options) -> Scan:
    """64 x 64 mm read evenly, 8 x 8 points in each 2 mm square."""
    return scans.make_scan(scans.even_centres(), head=scans.flat_head(rows=32, columns=32), **options)


EXCHANGED = Landmarks(MARKS.xiphoid_mm, MARKS.sternal_notch_mm)


def stroke_scan(**options) -> Scan:
    options.setdefault("field", scans.gaussian(x=3.0, y=-2.0))
    return scans.make_scan(scans.strokes(), landmarks=MARKS, **options)


def moments(tactile_map: TactileMap, background: float) -> tuple[float, float, float, float]:
    """Centre and variances of what stands above the background."""
    excess = tactile_map.mean - background
    x, y = np.meshgrid(tactile_map.x_mm, tactile_map.y_mm)
    total = excess.sum()
    cx, cy = (excess * x).sum() / total, (excess * y).sum() / total
    return cx, cy, (excess * (x - cx) ** 2).sum() / total, (excess * (y - cy) ** 2).sum() / total


@pytest.mark.parametrize("cell_mm", [1.0, 2.0])
def test_a_known_bump_keeps_its_place_and_widths(cell_mm):
    field = scans.gaussian(amplitude=1.0, sigma_x=6.0, sigma_y=4.5, x=1.3, y=-0.7)
    tactile_map = build_map(wide_scan(field=field), cell_mm=cell_mm, pressure_window_kpa=ALL, normalise="none")
    cx, cy, vx, vy = moments(tactile_map, scans.LEVEL_KPA)
    assert (cx, cy) == pytest.approx((1.3, -0.7), abs=0.01)
    cell = cell_mm**2 / 12  # what averaging over a cell adds; a model integrated over the cell takes it off again
    assert np.sqrt(vx - cell) == pytest.approx(6.0, rel=6e-4)
    assert np.sqrt(vy - cell) == pytest.approx(4.5, rel=6e-4)
    assert tactile_map.mean.max() == pytest.approx(2 * scans.LEVEL_KPA, rel=0.02)


def test_widths_without_the_cell_correction_are_too_wide():
    field = scans.gaussian(amplitude=1.0, sigma_x=3.0, sigma_y=3.0)
    tactile_map = build_map(wide_scan(field=field), cell_mm=2.0, pressure_window_kpa=ALL, normalise="none")
    assert np.sqrt(moments(tactile_map, scans.LEVEL_KPA)[2]) > 3.0 * 1.01


def test_within_cell_variance_is_the_field_s_own():
    slope = 0.05
    tactile_map = build_map(
        wide_scan(field=lambda u, v: 1 + slope * u / 8 + 0 * v), pressure_window_kpa=ALL, normalise="none"
    )
    inner = tactile_map.variance[5:-5, 5:-5]
    assert np.median(inner) == pytest.approx(slope**2 / 12, rel=0.1)


def test_the_plane_and_the_patient_frame_are_right():
    tactile_map = build_map(stroke_scan())
    to_plane, to_patient = tactile_map.plane_from_base, tactile_map.patient_from_plane
    assert to_plane[:3, :3] == pytest.approx(np.eye(3), abs=1e-6)
    assert apply(to_patient @ to_plane, MARKS.xiphoid_mm) == pytest.approx([0, 0, 0], abs=1e-6)
    notch = apply(to_patient @ to_plane, MARKS.sternal_notch_mm)
    assert notch == pytest.approx([0, np.linalg.norm(MARKS.sternal_notch_mm - MARKS.xiphoid_mm), 0], abs=1e-6)
    assert build_map(replace(stroke_scan(), landmarks=None)).patient_from_plane is None


@pytest.mark.long
@given(
    angle=st.floats(-180, 180),
    about=st.sampled_from([(0, 0, 1), (1, 0, 0), (1, 2, 3), (-1, 0.2, 0.1)]),
    shift=st.sampled_from([(0, 0, 0), (150, -80, 30), (1e5, -1e5, 1e5)]),
)
def test_moving_the_whole_scan_leaves_the_map(angle, about, shift):
    scan = stroke_scan(yaw_deg=np.linspace(-5, 5, 120))
    still = build_map(scan)
    moved = build_map(scans.moved(scan, rigid(scans.rotation(angle, about=about), np.array(shift, dtype=float))))
    assert moved.mean.shape == still.mean.shape
    alike = (moved.count == still.count) & np.isclose(moved.mean, still.mean, atol=1e-9, equal_nan=True)
    assert alike.mean() > 0.98  # a reading on the edge between two cells may fall on either side
    assert moved.patient_from_plane == pytest.approx(still.patient_from_plane, abs=1e-3)


@pytest.mark.long
@given(
    cuts=st.lists(st.integers(0, 120), max_size=4), reverse=st.booleans(), normalise=st.sampled_from(["mean", "none"])
)
def test_scans_in_parts_and_any_order_give_the_same_bits(cuts, reverse, normalise):
    scan = stroke_scan(yaw_deg=np.linspace(-5, 5, 120))
    ends = [0, *sorted(cuts), 120]
    assume(all(b == a or b - a >= 20 for a, b in pairwise(ends)))  # in few frames a good taxel may read as stuck
    parts = [scans.part(scan, slice(a, b)) for a, b in pairwise(ends)]
    merged = build_map(parts[::-1] if reverse else parts, normalise=normalise)
    assert same(merged, build_map(scan, normalise=normalise))
    assert merged.patient_from_plane == pytest.approx(build_map(scan).patient_from_plane, abs=1e-12)


def test_every_frame_twice_gives_the_same_mean_and_twice_the_readings():
    scan = stroke_scan()
    one, two = build_map(scan), build_map([scan, scan])
    assert np.array_equal(two.mean, one.mean, equal_nan=True)
    assert np.array_equal(two.count, 2 * one.count)
    assert two.frame_count == 2 * one.frame_count


def test_a_scan_without_a_frame_adds_nothing_to_another():
    scan = stroke_scan()
    assert same(build_map([scan, scans.part(scan, slice(0))]), build_map(scan))


def test_dividing_by_the_mean_takes_the_frames_levels_out():
    levels = 8 + 3 * np.sin(np.arange(120))
    steady, varying = stroke_scan(levels_kpa=8.0), stroke_scan(levels_kpa=levels)
    assert build_map(varying).mean == pytest.approx(build_map(steady).mean, abs=1e-3, nan_ok=True)
    kept = build_map(varying, normalise="none")
    assert np.nanmax(np.abs(kept.mean / np.nanmedian(kept.mean) - build_map(steady).mean)) > 0.05
    assert kept.background is None
    assert build_map(varying).background == 1.0


def test_without_a_lump_mean_and_none_differ_by_the_level():
    scan = stroke_scan(field=scans.uniform)
    kpa, ratio = build_map(scan, normalise="none"), build_map(scan)
    assert kpa.mean == pytest.approx(scans.LEVEL_KPA * ratio.mean, rel=1e-3, nan_ok=True)


def test_the_gain_solve_removes_what_the_mean_takes_from_a_lump():
    """In a field times level model the frame's mean holds the lump; the solve finds the field itself."""
    levels = 8 + 2 * np.sin(np.arange(120))
    scan = stroke_scan(field=scans.gaussian(amplitude=0.4, sigma_x=3, sigma_y=3), levels_kpa=levels)
    by_mean, solved = build_map(scan, normalise="mean"), build_map(scan, normalise="gain")
    assert np.nanmax(solved.mean) == pytest.approx(1.4, rel=0.01)
    assert np.nanmax(by_mean.mean) < 1.35
    assert solved.quality["gain_passes"] > 1
    assert solved.quality["gain_last_change"] <= 1e-4
    assert solved.quality["gain_unsettled"] == 0
    assert np.nanmedian(solved.variance) < np.nanmedian(by_mean.variance)


def test_frames_outside_the_window_are_dropped_and_counted():
    levels = np.full(120, 8.0)
    levels[:7], levels[7:12] = 2.0, 15.0
    tactile_map = build_map(stroke_scan(field=scans.uniform, levels_kpa=levels))
    assert tactile_map.quality["dropped_low"] == 7
    assert tactile_map.quality["dropped_high"] == 5
    assert tactile_map.frame_count == tactile_map.quality["frames_used"] == 108


def test_every_frame_is_counted_once():
    scan = stroke_scan(levels_kpa=8 + 8 * np.sin(np.arange(120) / 5))
    counts = scan.frames.counts.copy()
    counts[30:35, :4] = 65535
    poses = TrackerPoses(scan.poses.time_s[9:], scan.poses.position_mm[9:], scan.poses.quaternion_wxyz[9:])
    quality = build_map(replace(scans.with_counts(scan, counts), poses=poses)).quality
    dropped = [quality[f"dropped_{why}"] for why in ("no_pose", "elements", "low", "high")]
    assert dropped[0] == 9
    assert dropped[1] == 5
    assert min(dropped) > 0
    assert quality["frames_used"] + sum(dropped) == quality["frames_total"] == 120


def test_a_dead_taxel_leaves_the_map_of_the_others():
    levels = 8 + np.sin(np.arange(120))
    scan = stroke_scan(levels_kpa=levels, field=scans.uniform)
    counts = scan.frames.counts.copy()
    counts[:, 2, 6] = 0
    tactile_map = build_map(scans.with_counts(scan, counts))
    assert tactile_map.masked_taxels == ("row 2 column 6 dead",)
    assert tactile_map.quality["masked_taxels"] == 1
    assert tactile_map.mean[tactile_map.covered] == pytest.approx(1.0, abs=1e-3)
    assert build_map([scan, scans.with_counts(scan, counts)]).masked_taxels == ("scan 2 row 2 column 6 dead",)


def test_a_saturated_reading_is_left_out_without_its_frame():
    scan = stroke_scan()
    counts = scan.frames.counts.copy()
    counts[50, 1, 1] = 65535
    tactile_map = build_map(scans.with_counts(scan, counts))
    assert tactile_map.frame_count == 120
    assert tactile_map.count.sum() == 120 * 64 - 1
    assert tactile_map.quality["saturated_readings"] == 1


def test_latency_corrects_what_a_late_tracker_blurs():
    scan = stroke_scan()
    late = replace(
        scan, poses=TrackerPoses(scan.poses.time_s + 0.02, scan.poses.position_mm, scan.poses.quaternion_wxyz)
    )
    blurred = build_map(late, normalise="none")
    corrected = build_map(late, normalise="none", latency_ms=20.0)
    assert np.nanmean(corrected.variance) < 0.5 * np.nanmean(blurred.variance)
    assert corrected.recipe.latency_ms == 20.0


def test_progress_counts_to_the_end():
    told = []
    build_map(stroke_scan(), progress=lambda done, total: told.append((done, total)))
    assert told[-1] == (120, 120)


def one_frame() -> Scan:
    return scans.make_scan(np.zeros((1, 2)), field=scans.gaussian())


def upside_down() -> Scan:
    return scans.moved(stroke_scan(), rigid(scans.rotation(180, about=(1, 0, 0)), np.zeros(3)))


def head_turned_over() -> Scan:
    """The face looks away: the same motion with the tracker mounted the other way round."""
    scan = stroke_scan()
    turn = rigid(scans.rotation(180, about=(1, 0, 0)), np.zeros(3))
    return replace(scan, head=HeadGeometry(scan.head.surface_mm, scan.head.pitch_mm, turn))


EXTREMES = {
    "one frame": (one_frame, 1),
    "upside down": (upside_down, 120),
    "the head turned over": (head_turned_over, 120),
    "a head that never moved": (lambda: scans.part(stroke_scan(), slice(40, 41)), 1),
}


@pytest.mark.parametrize(("make", "frames"), EXTREMES.values(), ids=EXTREMES)
def test_extremes_give_a_map(make, frames):
    tactile_map = build_map(make())
    assert tactile_map.frame_count == frames
    assert np.isfinite(tactile_map.mean[tactile_map.count > 0]).all()
    assert all(np.isfinite(list(tactile_map.quality.values())))
    assert np.linalg.det(tactile_map.plane_from_base[:3, :3]) == pytest.approx(1)


def line_scan() -> Scan:
    head = scans.flat_head(rows=1, columns=2, pitch_mm=0.1)
    return scans.make_scan(scans.strokes(lines=1), head=head)


def no_overlap() -> Scan:
    scan = stroke_scan()
    return replace(scan, frames=PressureFrames(scan.frames.time_s + 60, scan.frames.counts))


def on_edge() -> Scan:
    """The motion runs at right angles to the face."""
    scan = stroke_scan()
    flat = HeadGeometry(scan.head.surface_mm * 0.01, 0.02, rigid(scans.rotation(90, about=(1, 0, 0)), np.zeros(3)))
    return replace(scan, head=flat)


def too_few_taxels() -> Scan:
    """7 of 64 taxels are dead."""
    scan = stroke_scan(levels_kpa=8 + np.sin(np.arange(120)))
    counts = scan.frames.counts.copy()
    counts[:, 4, :7] = 0
    return scans.with_counts(scan, counts)


def frozen() -> Scan:
    scan = stroke_scan()
    position = np.broadcast_to(scan.poses.position_mm[:1], (120, 3))
    quaternion = np.broadcast_to(scan.poses.quaternion_wxyz[:1], (120, 4))
    return replace(between_poses(), poses=TrackerPoses(scan.poses.time_s, position, quaternion))


def between_poses() -> Scan:
    scan = stroke_scan()
    return replace(scan, frames=PressureFrames(scan.frames.time_s + 0.001, scan.frames.counts))


def with_poses(scan: Scan, kept: slice) -> Scan:
    poses = scan.poses
    return replace(scan, poses=TrackerPoses(poses.time_s[kept], poses.position_mm[kept], poses.quaternion_wxyz[kept]))


REFUSED = {
    "pressed too lightly": (
        lambda: stroke_scan(field=scans.uniform, levels_kpa=np.linspace(1, 3, 120)),
        r"no frame's mean lies within 5 to 14 kPa \(120 frames, means 1.00 to 3.00 kPa, median 2.00\); "
        r"press harder, or a window of 1.1 to 2.9 kPa \(--pressure-window-kpa\) would keep nine in ten",
    ),
    "a few frames": (
        lambda: scans.part(stroke_scan(levels_kpa=np.linspace(1, 3, 120)), slice(0, 20)),
        r"no frame's mean lies within 5 to 14 kPa \(20 frames, .*; the scan has 20 frames only: record for longer; ",
    ),
    "a line": (line_scan, "lie on a line .*strokes side by side"),
    "other times": (no_overlap, r"no frame has a tracker pose \(frames 160.000 to 161.190 s, 120 poses 100.000"),
    "times in ms": (
        lambda: replace(stroke_scan(), frames=PressureFrames(10.0 * np.arange(120.0) + 5, stroke_scan().frames.counts)),
        "no frame has a tracker pose .*are the times in milliseconds",
    ),
    "few poses a second": (
        lambda: with_poses(between_poses(), slice(None, None, 12)),
        "10 poses .*, 120 ms apart: between them .*set the tracker to 50 poses a second",
    ),
    "one frame before the poses": (
        lambda: with_poses(scans.part(stroke_scan(), slice(0, 1)), slice(5, None)),
        "the scan has 1 frame only: record for longer; check that both run on one clock",
    ),
    "out of sight once pressed": (
        lambda: with_poses(stroke_scan(levels_kpa=np.where(np.arange(120) < 12, 1.0, 8.0)), slice(0, 10)),
        "10 of 120 frames have a tracker pose .* and that the tracker saw its sensor",
    ),
    "frozen tracker": (frozen, "the tracker's 120 poses are of one place: it froze; check the tracker"),
    "no pose": (
        lambda: replace(stroke_scan(), poses=TrackerPoses(np.zeros(0), np.zeros((0, 3)), np.zeros((0, 4)))),
        "holds no tracker pose",
    ),
    "no frame": (lambda: scans.part(stroke_scan(), slice(0)), "holds no frame"),
    "dead array": (
        lambda: scans.with_counts(stroke_scan(), np.zeros((120, 8, 8), dtype=np.uint16)),
        r"none of the 64 taxels works \(dead\); check the array's cable",
    ),
    "too few taxels": (
        too_few_taxels,
        r"no frame has 90 % of its taxels valid \(the best has 89.1 %; 7 of 64 taxels are dead throughout\); repair",
    ),
    "turned all round": (
        lambda: stroke_scan(yaw_deg=3.0 * np.arange(120)),
        "turned in all directions .*keep its direction",
    ),
    "at right angles": (on_edge, "degrees apart; check the quaternion order"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_scans_without_a_map_are_refused_in_one_line(name):
    """By `check` in the same words, but for a motion that spans no plane, which it does not fit."""
    make, message = REFUSED[name]
    for refuses in (build_map,) if name in ("a line", "turned all round") else (build_map, check_scan):
        with pytest.raises(BadDataError, match=message) as refusal:
            refuses(make())
        assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"every": 100, "pressure_window_kpa": (50.0, 60.0)}, "every 100 leaves 2 frames, .*; give a smaller --every"),
        ({"latency_ms": -9000.0}, "less a latency of -9000 ms; give another --latency-ms, or check that both run on"),
    ],
)
def test_an_option_that_leaves_no_frame_is_named(options, message):
    with pytest.raises(BadDataError, match=message):
        build_map(stroke_scan(), **options)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"cell_mm": 0.0}, "cell_mm is 0.0; give a number from 0.01 to 50"),
        ({"cell_mm": float("nan")}, "cell_mm is nan"),
        ({"cell_mm": "2"}, "cell_mm is '2'; give a number"),
        ({"pressure_window_kpa": 5.0}, "pressure_window_kpa is 5.0; give a list of 2"),
        ({"pressure_window_kpa": (14.0, 5.0)}, "two rising pressures"),
        ({"pressure_window_kpa": (0.0, 5.0)}, "divided by their mean"),
        ({"normalise": "median"}, "Give one of mean, gain, none"),
        ({"latency_ms": float("inf")}, "latency_ms is inf; give a number"),
    ],
)
def test_options_out_of_range_are_refused(options, message):
    with pytest.raises(UsageError, match=message):
        build_map(stroke_scan(), **options)


@pytest.mark.parametrize("side", ["left", "right", "phantom", ""])
def test_exchanged_landmarks_are_told_by_the_breast(side):
    """The right ones put the scan to the patient's left, exchanged ones to the right."""
    for marks, place in ((MARKS, "left"), (EXCHANGED, "right")):
        made = build_map(replace(stroke_scan(), session={"side": side}, landmarks=marks))
        findings = [one.text for one in made.findings if one.kind == "side"]
        told = f"the scan says {side} breast, and the landmarks put the scanned place 60 mm to the patient's {place} of"
        wrong = side in ("left", "right") and side != place
        assert [text.startswith(told) for text in findings] == [True] * wrong


@pytest.mark.parametrize(
    ("between", "moved_mm", "told"),
    [
        *((between, *moved) for between in (True, False) for moved in ((0.0, ""), (3.0, ""), (15.0, "none"))),
        (True, 6.0, "less"),
    ],
)
def test_a_patient_who_moved_between_scans_or_within_one_is_told(between, moved_mm, told):
    """One lump was mapped as two, or as one of 27 mm for 21, and the map called sound."""
    centres = np.tile(scans.strokes(), (1 if between else 2, 1))
    scan = scans.make_scan(centres, field=scans.gaussian(x=3.0, y=-2.0))
    moves_mm = np.outer(np.arange(len(scan.poses)) >= (0 if between else 120), [moved_mm, 0, 0])
    other = replace(
        scan, poses=TrackerPoses(scan.poses.time_s, scan.poses.position_mm + moves_mm, scan.poses.quaternion_wxyz)
    )
    built = build_map([scan, other] if between else other, as_stated=True)
    findings = [one for one in built.findings if one.kind == "frames_contradict"]
    near = f"the highest rise (?:{moved_mm:.0f}|14) mm apart, each where the other feels {told}:"
    assert [bool(re.search(near, one.text)) for one in findings] == [True] * bool(told)


@pytest.mark.parametrize(
    ("spacing_mm", "profile"),
    [(5.0, [1.6, 1, 1, 1, 1, 1, 1, 1.6]), (2.0, [1, 1, 1.2, 3.5, 3.5, 1.2, 1, 1])],
    ids=["harder at its rim", "harder at its middle, as on convex skin"],
)
def test_a_head_that_presses_unevenly_has_not_moved(spacing_mm, profile):
    """Each third felt the head's own profile: 1 of 8 right scans was told as of a patient who moved."""
    scan = scans.make_scan(scans.strokes(spacing_mm=spacing_mm), field=scans.uniform)
    felt = scans.with_counts(scan, np.rint(scan.frames.counts * (profile / np.mean(profile))).astype(np.uint16))
    built = build_map(felt, as_stated=True)
    assert [one for one in built.findings if one.kind == "frames_contradict"] == []


@pytest.mark.parametrize(("notch_mm", "xiphoid_mm", "told"), [(12, 12, True), (9, 9, False), (0, 18, False)])
def test_landmarks_that_lie_apart_tell_that_a_patient_moved_between_scans(notch_mm, xiphoid_mm, told):
    """Two scans displaced by 10 mm had no lump by their map, where the same at rest had one of 15 mm."""
    scan = scans.make_scan(scans.strokes(), field=scans.uniform)
    marks, up = MARKS, np.array([0.0, 0.0, 1.0])
    moved = Landmarks(marks.sternal_notch_mm + notch_mm * up, marks.xiphoid_mm + xiphoid_mm * up)
    built = build_map([replace(scan, landmarks=one) for one in (marks, marks, moved)])
    found = [one.text for one in built.findings if one.kind == "frames_contradict"]
    assert [text.startswith("the landmarks of two scans lie 12 mm apart") for text in found] == [True] * told


def test_scans_that_do_not_belong_together_are_refused():
    scan = stroke_scan()
    moved = Landmarks(MARKS.sternal_notch_mm + np.array([0, 0, 60.0]), MARKS.xiphoid_mm)
    with pytest.raises(BadDataError, match="landmarks lie up to 30 mm from their mean"):
        build_map([scan, replace(scan, landmarks=moved)])
    with pytest.raises(BadDataError, match=r"differ in side \(left, right\)"):
        build_map([replace(scan, session={"side": side}) for side in ("right", "left")])
    assert build_map([scan, replace(scan, session={"side": "left"})]).frame_count == 240  # one says nothing of its side
    with pytest.raises(BadDataError, match=r"differ in visit \(1, 2\)"):
        build_map([replace(scan, session={"visit": visit}) for visit in "12"])
    with pytest.raises(BadDataError, match="no scan was given"):
        build_map([])


def test_the_input_is_left_as_it_was():
    scan = stroke_scan()
    before = scan.frames.counts.copy(), scan.poses.quaternion_wxyz.copy()
    build_map(scan, normalise="gain")
    assert np.array_equal(scan.frames.counts, before[0])
    assert np.array_equal(scan.poses.quaternion_wxyz, before[1])


LUMPS = {"s01_sphere15_hd1_clean": 0.0, "s03_sphere20_hd1_r10": 4.0, "s11_resting15_hd1": 11.0}


@pytest.mark.parametrize(("name", "latency_ms"), LUMPS.items())
def test_shared_scans_show_the_lump_where_it_is(shared_data, name, latency_ms):
    scan = scans.shared_scan(shared_data / "scans" / f"{name}.npz")
    tactile_map = build_map(scan, latency_ms=latency_ms)
    truth = [line.split(",") for line in (shared_data / "scans" / "truth.csv").read_text().splitlines()]
    x, y = next((float(row[3]), float(row[4])) for row in truth if row[0] == name)
    well = np.where(tactile_map.count > 40, tactile_map.mean, 0)
    row, column = np.unravel_index(well.argmax(), well.shape)
    peak = np.array([tactile_map.x_mm[column], tactile_map.y_mm[row], 0.0])
    assert apply(tactile_map.patient_from_plane, peak)[:2] == pytest.approx([x, y], abs=3.0)
    assert tactile_map.masked_taxels == ()
    assert tactile_map.quality["coverage"] > 0.8


@pytest.mark.long
@pytest.mark.parametrize("normalise", ["mean", "gain"])
def test_a_shared_scan_of_two_halves_is_the_whole(shared_data, normalise):
    scan = scans.shared_scan(shared_data / "scans" / "s05_two_masses.npz")
    halves = [scans.part(scan, slice(700, None)), scans.part(scan, slice(700))]
    one, two = build_map(scan, normalise=normalise), build_map(halves, normalise=normalise)
    if normalise == "mean":
        assert same(one, two)
    assert np.nanmax(np.abs(one.mean - two.mean)) < 1e-3
