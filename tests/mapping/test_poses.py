"""Poses at the frames' times: interpolated, never extrapolated, never over a gap."""

from __future__ import annotations

import mapping_scans as scans
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_bayes.geometry import quaternion_from_rotation
from tactile_bayes.mapping.cells import distinct_poses, poses_at
from tactile_bayes.scans import TrackerPoses


def turning(n: int = 50, *, step_s: float = 0.008, degrees: float = 0.3) -> TrackerPoses:
    """A tracker that moves and turns evenly."""
    time = 10 + step_s * np.arange(n)
    quaternion = np.array([quaternion_from_rotation(scans.rotation(degrees * i)) for i in range(n)])
    return TrackerPoses(time, np.stack([2.0 * np.arange(n), -np.arange(n), np.zeros(n)], axis=1), quaternion)


def test_even_motion_is_interpolated_exactly():
    poses = turning()
    found = poses_at(distinct_poses(poses), poses.time_s[:-1] + 0.002)
    assert found.known.all()
    assert found.position_mm[7] == pytest.approx([2 * 7.25, -7.25, 0])
    assert found.rotation[7] == pytest.approx(scans.rotation(0.3 * 7.25), abs=1e-9)


@given(st.lists(st.booleans(), min_size=50, max_size=50))
def test_signs_of_quaternions_do_not_matter(flips):
    poses = turning()
    flipped = TrackerPoses(poses.time_s, poses.position_mm, poses.quaternion_wxyz * np.where(flips, -1, 1)[:, None])
    time = poses.time_s[:-1] + 0.003
    assert poses_at(distinct_poses(flipped), time).rotation == pytest.approx(
        poses_at(distinct_poses(poses), time).rotation, abs=1e-15
    )


def test_latency_moves_the_poses_back_in_time():
    poses = turning()
    late = TrackerPoses(poses.time_s + 0.013, poses.position_mm, poses.quaternion_wxyz)
    time = poses.time_s[5:-5] + 0.001
    straight, corrected = poses_at(distinct_poses(poses), time), poses_at(distinct_poses(late), time, latency_ms=13.0)
    assert corrected.position_mm == pytest.approx(straight.position_mm, abs=1e-9)
    assert np.abs(poses_at(distinct_poses(late), time).position_mm - straight.position_mm).max() > 1


def test_repeated_samples_are_dropped_whatever_their_sign():
    poses = turning()
    twice = np.repeat(np.arange(50), 2)
    sign = np.where(np.arange(100) % 3 == 0, -1, 1)[:, None]
    repeated = TrackerPoses(10 + 0.004 * np.arange(100), poses.position_mm[twice], poses.quaternion_wxyz[twice] * sign)
    fresh = distinct_poses(repeated)
    assert np.array_equal(fresh.time_s, 10 + 0.004 * np.arange(0, 100, 2))
    time = poses.time_s[:-1] + 0.003
    assert poses_at(distinct_poses(repeated), time).position_mm == pytest.approx(
        poses_at(distinct_poses(poses), time).position_mm, abs=1e-9
    )


def test_frames_in_a_gap_or_outside_are_not_known():
    poses = turning()
    keep = (np.arange(50) < 20) | (np.arange(50) >= 30)
    gap = TrackerPoses(poses.time_s[keep], poses.position_mm[keep], poses.quaternion_wxyz[keep])
    time = np.array([9.999, 10.0, 10.1, 10.152, 10.16, 10.2, 10.24, 10.241, 10.392, 10.393])
    assert poses_at(distinct_poses(gap), time).known.tolist() == [
        False,
        True,
        True,
        True,
        False,
        False,
        True,
        True,
        True,
        False,
    ]
    assert poses_at(distinct_poses(gap), time, max_gap_ms=100.0).known.tolist() == [False, *[True] * 8, False]


def test_a_frozen_tracker_is_a_gap():
    poses = turning()
    position, quaternion = poses.position_mm.copy(), poses.quaternion_wxyz.copy()
    position[20:30], quaternion[20:30] = position[20], quaternion[20]
    frozen = TrackerPoses(poses.time_s, position, quaternion)
    known = poses_at(distinct_poses(frozen), poses.time_s + 0.001).known
    assert not known[21:29].any()
    assert known[:20].all()


def strokes(**frozen: slice) -> TrackerPoses:
    """3 s of strokes of 60 mm at 100 poses a second, turning by 20 degrees; the part named stands still meanwhile."""
    time = 0.01 * np.arange(300)
    angle = np.radians(10.0 * np.sin(3.0 * time))
    values = {
        "place": np.stack([30.0 * np.sin(4.0 * time), 5.0 * time, 0.01 * time], axis=1),
        "rotation": np.stack([np.cos(angle / 2), 0 * time, 0 * time, np.sin(angle / 2)], axis=1),
    }
    for name, when in frozen.items():
        values[name][when] = values[name][when.start]
    return TrackerPoses(time, values["place"], values["rotation"])


STILL = slice(100, 150)


@pytest.mark.parametrize("part", ["place", "rotation"])
def test_a_place_or_a_rotation_that_stands_still_alone_is_a_gap(part: str) -> None:
    poses = strokes(**{part: STILL})
    known = poses_at(distinct_poses(poses), poses.time_s).known
    assert known.tolist() == [not 100 < n < 150 for n in range(300)]
    assert poses_at(distinct_poses(strokes()), poses.time_s).known.all()


def test_a_place_that_stands_still_for_some_poses_is_bridged() -> None:
    """Control of what a repeat costs: interpolated, the head is where it was."""
    right = strokes()
    held = poses_at(distinct_poses(strokes(place=slice(100, 104))), right.time_s)
    assert held.known.all()
    assert held.position_mm == pytest.approx(right.position_mm, abs=0.1)


def test_a_place_that_stands_still_to_the_end_is_none() -> None:
    poses = strokes(place=slice(200, 300))
    assert poses_at(distinct_poses(poses), poses.time_s).known.tolist() == [n <= 200 for n in range(300)]


def test_a_head_that_rests_or_does_not_turn_is_no_frozen_tracker() -> None:
    """Controls: a rig that never turns, one that turns between strokes, and a place told to 0.5 mm."""
    poses = strokes()
    never = np.tile([1.0, 0.0, 0.0, 0.0], (300, 1))
    between = poses.quaternion_wxyz.copy()
    between[:100], between[150:] = between[100], between[149]
    coarse = 0.5 * np.rint(poses.position_mm / 0.5)
    for place, rotation in (
        (poses.position_mm, never),
        (poses.position_mm, between),
        (coarse, poses.quaternion_wxyz),
    ):
        assert len(distinct_poses(TrackerPoses(poses.time_s, place, rotation))) == 300


def test_without_poses_no_frame_has_a_known_pose():
    nothing = TrackerPoses(np.zeros(0), np.zeros((0, 3)), np.zeros((0, 4)))
    found = poses_at(distinct_poses(nothing), np.arange(3.0))
    assert not found.known.any()
    assert np.isfinite(found.rotation).all()


def test_one_pose_knows_the_frame_at_its_time_only():
    one = TrackerPoses(np.array([1.0]), np.array([[1.0, 2.0, 3.0]]), np.array([[1.0, 0, 0, 0]]))
    found = poses_at(distinct_poses(one), np.array([0.5, 1.0, 1.5]))
    assert found.known.tolist() == [False, True, False]
    assert found.position_mm[1].tolist() == [1.0, 2.0, 3.0]
