"""A scan that is not arranged as it is stated is refused by name; an empty one says that it shows nothing."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import mapping_scans as scans
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import tactile_bayes as tb
from tactile_bayes.declarations import replace
from tactile_bayes.errors import BadDataError
from tactile_bayes.geometry import inverse, quaternion_from_rotation, rigid, rotation_from_quaternion
from tactile_bayes.mapping.arrangement import (
    LEAST_SWAY_GAIN,
    LEAST_SWAY_MM,
    Arrangement,
    ArrangementCheck,
    _Overlap,
    _screened,
    check_arrangement,
    check_scan,
)
from tactile_bayes.mapping.convention import corrected
from tactile_bayes.mapping.select import SelectedFrames, select_frames
from tactile_bayes.presets import CORRECTIONS
from tactile_bayes.scans import ElementCalibration, HeadGeometry, PressureFrames, Scan, TrackerPoses
from validation.lump_probability_scenes import draw

# What undoes a mistake; most are their own inverses.
UNDONE_BY = {
    **{name: name for name in CORRECTIONS},
    "quarter-turn": "quarter-turn-back",
    "quarter-turn-back": "quarter-turn",
}
SEEN = [name for name in CORRECTIONS if name not in ("inverse-rotation", "lever-none")]
"""An inverse rotation hardly moves the frames of a head that is hardly turned; a lever arm left out stands below."""


@cache
def lump() -> Scan:
    """The packaged scan with its tracker on a handle, a quarter turned, so that no mistake is the identity."""
    scan = tb.demo_scan()
    mount = rigid(np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), np.array([3.0, 10.0, -55.0]))
    lever, pose = scan.head.scanhead_from_tracker, scan.poses
    poses = [
        rigid(rotation_from_quaternion(wxyz), place) @ inverse(lever) @ mount
        for wxyz, place in zip(pose.quaternion_wxyz, pose.position_mm, strict=True)
    ]
    quaternion = np.array([quaternion_from_rotation(one[:3, :3]) for one in poses])
    place = np.array([one[:3, 3] for one in poses])
    return replace(
        scan,
        head=HeadGeometry(scan.head.surface_mm, scan.head.pitch_mm, mount),
        poses=TrackerPoses(pose.time_s, place, quaternion),
    )


def mistaken(scan: Scan, name: str) -> Scan:
    """The scan as one gives it who makes a mistake."""
    if name == "scalar-last":
        wxyz = np.roll(scan.poses.quaternion_wxyz, -1, axis=1)
        return replace(scan, poses=TrackerPoses(scan.poses.time_s, scan.poses.position_mm, wxyz))
    if name == "transposed":
        held = scan.element_calibration
        return replace(
            scan,
            frames=PressureFrames(scan.frames.time_s, reshaped(scan.frames.counts)),
            element_calibration=ElementCalibration(reshaped(held.gain_kpa_per_count), reshaped(held.offset_kpa)),
        )
    return corrected(scan, [name])


def reshaped(array: np.ndarray) -> np.ndarray:
    """An array that was stored column by column and reshaped to (rows, columns)."""
    return np.ascontiguousarray(array.swapaxes(-1, -2)).reshape(array.shape)


def select(scan: Scan) -> SelectedFrames:
    return select_frames(scan, pressure_window_kpa=(5.0, 14.0))


def checked(scan: Scan) -> ArrangementCheck:
    return check_arrangement(select(scan), thorough=False)


def overlap(scan: Scan) -> _Overlap:
    found = _Overlap.of(select(scan), 0.0)
    assert found is not None
    return found


@pytest.mark.long_repeats
@pytest.mark.parametrize("name", SEEN)
def test_a_mistake_is_refused_and_named(name):
    scan = mistaken(lump(), name)
    check = checked(scan)
    assert check.refused
    assert check.best.corrections == (UNDONE_BY[name],)
    right = corrected(scan, check.best.corrections)
    assert np.array_equal(right.frames.counts, lump().frames.counts)
    assert np.allclose(right.head.scanhead_from_tracker, lump().head.scanhead_from_tracker)
    assert np.array_equal(right.poses.quaternion_wxyz, lump().poses.quaternion_wxyz)


@pytest.mark.long
@pytest.mark.parametrize(
    ("order", "call"), [("XYZ", "angles, degrees=True"), ("zxy", "angles, degrees=True"), ("ZYX", "angles")]
)
def test_angles_of_another_order_or_in_radians_are_named(order, call):
    """They were told as an array or quaternions the wrong way round, and `--correct` made a map of them."""
    poses = lump().poses
    angles = Rotation.from_quat(poses.quaternion_wxyz, scalar_first=True).as_euler(order, degrees="degrees" in call)
    wxyz = Rotation.from_euler("ZYX", angles, degrees=True).as_quat(scalar_first=True)
    check = check_scan(replace(lump(), poses=TrackerPoses(poses.time_s, poses.position_mm, wxyz)), thorough=False)
    assert check.refused
    assert f'Rotation.from_euler("{order}", {call}).as_quat(scalar_first=True)' in check.remedy


@pytest.mark.long
def test_a_map_names_angles_of_another_order_where_the_face_leans_on_its_motion():
    """No correction fits, and the map said to check the tilt of the head."""
    poses, turn = lump().poses, Rotation.from_euler("z", 40, degrees=True)
    rotation = turn * Rotation.from_quat(poses.quaternion_wxyz, scalar_first=True)
    wxyz = Rotation.from_euler("ZYX", rotation.as_euler("XYZ")).as_quat(scalar_first=True)
    place = poses.position_mm @ turn.as_matrix().T
    check = checked(replace(lump(), poses=TrackerPoses(poses.time_s, place, wxyz)))
    assert 0.9 < check.stated.agreement < 0.98
    assert check.words.startswith("the rotations' angles (azimuth, elevation, roll) are in degrees, about x, the new y")


@pytest.mark.long
def test_poses_that_lead_from_the_base_to_the_sensor_are_named():
    """They were told as quaternions with the scalar last."""
    poses = lump().poses
    back = rotation_from_quaternion(poses.quaternion_wxyz).swapaxes(1, 2)
    place, wxyz = -np.einsum("mij,mj->mi", back, poses.position_mm), poses.quaternion_wxyz * [1.0, -1, -1, -1]
    check = check_scan(replace(lump(), poses=TrackerPoses(poses.time_s, place, wxyz)), thorough=False)
    assert check.refused
    assert check.words.startswith("the poses lead from the base to the sensor (odds ")


def test_a_scan_that_is_right_is_left_alone():
    check = check_arrangement(select(lump()), thorough=False, other_poses=True)
    assert check.best is check.stated
    assert not check.findings
    assert not set(check.not_shown) & set(SEEN)


@pytest.mark.long
def test_a_lever_arm_left_out_shows_by_the_turn_of_the_mount():
    check = checked(corrected(lump(), ["lever-none"]))
    assert check.refused
    assert set(check.best.corrections) <= {"quarter-turn", "quarter-turn-back"}
    assert "lever arm" in check.words


@pytest.mark.long
def test_two_mistakes_at_once_are_named_both():
    check = check_scan(mistaken(mistaken(lump(), "columns-reversed"), "scalar-last"), thorough=False)
    assert check.refused
    assert set(check.best.corrections) == {"columns-reversed", "scalar-last"}


@pytest.mark.long
def test_the_base_of_the_tracker_may_lie_anyhow():
    rng = np.random.default_rng(3)
    turn = rotation_from_quaternion(rng.standard_normal(4))
    scan = mistaken(lump(), "rows-reversed")
    rotation = rotation_from_quaternion(scan.poses.quaternion_wxyz)
    quaternion = np.array([quaternion_from_rotation(turn @ one) for one in rotation])
    place = scan.poses.position_mm @ turn.T + rng.normal(0, 300, 3)
    moved = replace(scan, poses=TrackerPoses(scan.poses.time_s, place, quaternion))
    assert checked(moved).best.corrections == ("rows-reversed",)
    assert checked(moved).best.spread == pytest.approx(checked(scan).best.spread, rel=0.05)


@pytest.mark.long
def test_frames_of_another_clock_contradict_each_other():
    """Control: places of other frames fit in no arrangement."""
    scan = lump()
    place = np.roll(scan.poses.position_mm, len(scan.poses) // 3, axis=0)
    check = checked(replace(scan, poses=TrackerPoses(scan.poses.time_s, place, scan.poses.quaternion_wxyz)))
    assert check.contradicting
    assert not check.refused
    assert [one.kind for one in check.findings] == ["frames_contradict"]


def test_an_empty_breast_says_that_it_shows_nothing():
    check = checked(tb.simulate(Path(tb.__file__).parent / "demo" / "empty.toml").scan)
    assert check.inconclusive
    assert not check.refused
    assert [one.kind for one in check.findings] == ["arrangement_unknown"]


def test_readings_that_differ_by_rounding_alone_say_nothing():
    scan = lump()
    alike = np.full_like(scan.frames.counts, 777)
    gain = np.full(alike.shape[1:], 0.0137)
    calibration = ElementCalibration(gain, np.full_like(gain, 0.1), scan.element_calibration.saturation_count)
    found = checked(replace(scan, frames=PressureFrames(scan.frames.time_s, alike), element_calibration=calibration))
    assert found.inconclusive
    assert found.best is found.stated


@pytest.mark.parametrize(
    ("explained", "lasting", "spread", "contradicting"),
    [(0.2, 0.6, 0.03, True), (0.3, 0.6, 0.03, False), (0.2, 0.4, 0.03, False), (0.2, 0.6, 0.01, False)],
)
def test_frames_contradict_each_other_by_lasting_errors_that_nothing_explains(
    explained, lasting, spread, contradicting
):
    """Noise does not last, and what the head's response makes is small or explained."""
    stated = Arrangement((), spread=spread, explained=explained, lasting=lasting, agreement=1.0)
    assert stated.contradicting == contradicting
    check = ArrangementCheck(stated, stated, 0.0, {"half-turn": 0.0}, stated.contradicting)
    assert [one.kind for one in check.findings] == ["frames_contradict" if contradicting else "arrangement_unknown"]


def test_a_scan_of_a_second_is_too_short():
    scan = lump()
    short = replace(scan, frames=PressureFrames(scan.frames.time_s[:100], scan.frames.counts[:100]))
    check = check_scan(short)
    assert check.too_short
    assert check.lines() == ["too few frames to compare arrangements"]
    still_shorter = replace(scan, frames=PressureFrames(scan.frames.time_s[:20], scan.frames.counts[:20]))
    assert [one.kind for one in check_scan(still_shorter).doubts] == ["unlike_an_exam"]


@pytest.mark.long
def test_a_map_refuses_and_takes_the_scan_where_it_is_told_to():
    scan = mistaken(lump(), "columns-reversed")
    with pytest.raises(BadDataError, match="columns run backwards") as refused:
        tb.build_map(scan)
    assert "columns-reversed" in refused.value.way_out
    assert [one.kind for one in tb.build_map(scan, as_stated=True).findings] == ["wrong_arrangement"]


@pytest.mark.long
def test_each_scan_of_a_map_is_checked():
    with pytest.raises(BadDataError, match="scan 2: the array's rows run backwards"):
        tb.build_map([lump(), mistaken(lump(), "rows-reversed")])


@pytest.mark.long
def test_a_body_that_breathes_is_named_and_a_still_one_is_not():
    scan = lump()
    poses = scan.poses
    along = np.linalg.svd(poses.position_mm - poses.position_mm.mean(axis=0), full_matrices=False)[2]
    for axis in along[:2]:
        sway = 5.0 * np.sin(2 * np.pi * poses.time_s / 4.0)[:, None] * axis
        breathing = replace(scan, poses=TrackerPoses(poses.time_s, poses.position_mm + sway, poses.quaternion_wxyz))
        check = checked(breathing)
        (found,) = check.findings
        assert found.kind == "frames_contradict"  # a map without a lump says nothing then
        assert "the body moved to and fro" in found.text
        assert check.best.sway_mm == pytest.approx(10.0, abs=3.0)
        assert check.best.sways_a_minute == pytest.approx(15.0, abs=3.1)
        assert not check.refused


@pytest.mark.parametrize(("off_mm", "named"), [(0.0, False), (20.0, True)])
def test_a_lever_arm_that_is_off_shows_where_the_head_turned(off_mm: float, named: bool) -> None:
    """It smeared a lump of 15 mm to 20.2 without a word, in an exam whose head turned by 4 degrees."""
    wide, faint = scans.gaussian(sigma_x=4, sigma_y=6, x=3), scans.gaussian(amplitude=0.25, sigma_x=4, sigma_y=4, x=-9)
    scan = scans.make_scan(
        scans.strokes(lines=4, per_line=90, reach_mm=25.0, spacing_mm=6.0),
        field=lambda u, v: wide(u, v) + faint(u, v - 7) - 1,
        head=scans.flat_head(rows=10, columns=14, lever_mm=(5.0, -30.0, -60.0)),
        yaw_deg=5 * np.sin(np.arange(360) / 30),
    )
    lever = scan.head.scanhead_from_tracker.copy()
    lever[1, 3] += off_mm
    check = checked(replace(scan, head=HeadGeometry(scan.head.surface_mm, scan.head.pitch_mm, lever)))
    assert check.best.lever_mm == pytest.approx(off_mm, abs=4.0)
    assert ["measure the lever arm again" in one.remedy for one in check.findings] == [True] * named
    assert not check.refused


@pytest.mark.parametrize(("rate", "drift"), [(6.0, True), (15.0, False)])
def test_a_motion_slower_than_breath_may_be_the_trackers_drift(rate: float, drift: bool) -> None:
    """A drift of 20 mm over a scan was told as breathing, to be mended by a held breath."""
    stated = Arrangement((), spread=0.03, explained=0.5, lasting=0.6, agreement=1.0)
    moved = replace(stated, spread=0.01, sway_mm=12.0, sways_a_minute=rate)
    (found,) = ArrangementCheck(stated, moved, 9.0, {"rows-reversed": 9.0}).findings
    assert found.kind == "frames_contradict"
    for words in (found.text, found.remedy, found.on_paper):
        assert ("tracker drifted" in words or "warm" in words) is drift


@pytest.mark.long
def test_what_the_strokes_drag_along_is_no_body_that_moves():
    """Over this lump a body that moves by 8 mm fits better by far; so does one that follows the strokes by a fifth."""
    scan = draw(6, seed=20294303).scan()
    check, given = checked(scan), overlap(scan)
    moved, dragged = given.fit_sway(), given.fit_drag()
    assert moved is not None
    assert moved.sway_mm > LEAST_SWAY_MM
    assert moved.gain_over(check.stated) > LEAST_SWAY_GAIN
    assert moved.gain_over(dragged) < LEAST_SWAY_GAIN / 2
    assert not check.findings


# --- clocks


def later(scan: Scan, late_ms: float) -> Scan:
    """The scan with poses stamped so much later, and all times a second on so that none is below 0."""
    poses, frames = scan.poses, scan.frames
    told = TrackerPoses(poses.time_s + 1.0 + late_ms / 1000.0, poses.position_mm, poses.quaternion_wxyz)
    return replace(scan, poses=told, frames=PressureFrames(frames.time_s + 1.0, frames.counts))


@pytest.mark.long_repeats
@pytest.mark.parametrize("late_ms", [-400.0, -100.0, 100.0, 300.0])
def test_another_clock_is_named_with_its_sign(late_ms):
    check = checked(later(lump(), late_ms))
    (found,) = check.findings
    assert found.kind == "late_poses"
    assert check.best.late_ms == pytest.approx(late_ms, abs=25.0)
    assert f"--latency-ms {check.best.late_ms:.0f}" in found.remedy
    assert ("too late" if late_ms > 0 else "too early") in found.remedy
    assert ("averaged over time, which smears the lump" in found.remedy) is (late_ms < 0)
    assert not check.refused  # the map can be told


@pytest.mark.long
def test_a_clock_too_far_off_to_be_estimated_is_named_where_it_is_asked_for():
    with pytest.raises(BadDataError, match=r"does not determine .*; map it with latency_ms=3[01]0$"):
        tb.build_map(later(lump(), 300.0), latency_ms="auto")


@pytest.mark.long
def test_the_latency_that_is_stated_is_what_the_clock_is_held_against():
    late = select_frames(later(lump(), 300.0), pressure_window_kpa=(5.0, 14.0), latency_ms=300.0)
    right = check_arrangement(late, latency_ms=300.0)
    assert right.best is right.stated
    wrong = check_arrangement(late, latency_ms=150.0)
    assert float(wrong.remedy.split()[-1]) == pytest.approx(300.0, abs=25.0)


@pytest.mark.long
def test_a_clock_that_is_no_better_than_those_beside_it_is_not_named():
    """Frames over uneven fat agree better the earlier their poses are said to be."""
    scan = draw(95, seed=20292303).scan()
    check, early = checked(scan), overlap(scan).judge((), -500.0)
    assert early.plausible
    assert early.gain_over(check.stated) > 0.15
    assert check.best is check.stated


def test_frames_without_a_pose_by_another_clock_do_not_count():
    never = overlap(lump()).judge((), 60_000.0)
    assert never.spread == never.explained == 0.0
    assert not never.plausible
    assert never.gain_over(checked(lump()).stated) < 0


@pytest.mark.parametrize("late_ms", [0.0, 40.0])
def test_few_frames_rule_out_nothing_that_all_frames_do_not(late_ms):
    scan = later(lump(), late_ms)
    all_frames, few = (_Overlap.of(select(scan), 0.0, rough=rough) for rough in (False, True))
    assert all_frames is not None
    assert few is not None
    assert len(few.array.block) < len(all_frames.array.block) / 2
    trials = [((name,), 0.0) for name in CORRECTIONS] + [((), float(ms)) for ms in (-300, -100, -30, 30, 100, 300)]
    close, excluded = _screened(few, trials, stretches=all_frames.stretches)
    assert 0 < len(close) < len(trials) / 2
    for trial in set(trials) - set(close):
        gain = all_frames.judge(*trial).gain_over(all_frames.stated_fit[0])
        assert gain < 0
        if trial[0]:
            assert -all_frames.stretches * gain - np.log(len(trials) + 1) > excluded[trial[0][0]] - 2.0
