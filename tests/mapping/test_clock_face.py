"""The clock face about the nipple: hours and distance as the examiner sees them who faces the patient."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from mapping_scans import gaussian, make_scan, strokes

from tactile_bayes.declarations import replace
from tactile_bayes.errors import BadDataError
from tactile_bayes.mapping.build import build_map
from tactile_bayes.mapping.clock import NIPPLE_SD_MM, ClockPosition, clock_position, clock_text
from tactile_bayes.mapping.map import TactileMap
from tactile_bayes.scans import Landmarks

INTO_BODY = np.array([0.0, 0.0, 1.0])  # of `make_scan`: its head's z axis is the base's
HEADS = (70, 270, 0, 180)
UP_MM, ACROSS_MM = 20.0, 30.0
EXACT = np.zeros((2, 2))


def axes_of(head_deg: float) -> tuple[np.ndarray, np.ndarray]:
    """Directions of the patient's head and left in the base."""
    angle = np.radians(head_deg)
    up = np.array([np.cos(angle), np.sin(angle), 0.0])
    return up, np.cross(INTO_BODY, up)  # posterior cross superior is the patient's left


@cache
def map_of(head_deg: float, *, nipple: bool = True) -> TactileMap:
    """A map with a nipple at the base's origin."""
    up, _ = axes_of(head_deg)
    marks = Landmarks(200 * up, -100 * up, nipple_mm=np.array([0.0, 0.0, -5.0]) if nipple else None)
    field = gaussian(sigma_x=3.0, sigma_y=3.0)
    return build_map([make_scan(strokes(lines=7), field=field, landmarks=marks)], normalise="mean")


def on_plane(tactile_map: TactileMap, point: np.ndarray) -> tuple[float, float]:
    assert tactile_map.plane_from_base is not None
    x, y, _ = tactile_map.plane_from_base[:3, :3] @ point + tactile_map.plane_from_base[:3, 3]
    return float(x), float(y)


def position(head_deg: float, side: str, *, up_mm: float, left_mm: float) -> ClockPosition:
    up, left = axes_of(head_deg)
    tactile_map = map_of(head_deg)
    centre = on_plane(tactile_map, up_mm * up + left_mm * left)
    found = clock_position(tactile_map, centre, side=side, covariance_mm2=EXACT)
    assert found is not None
    return found


@pytest.mark.parametrize("head_deg", HEADS)
@pytest.mark.parametrize(
    ("side", "left_mm", "hours"),
    [
        # atan(30 / 20) is 56 degrees, 1.877 hours from 12, towards the patient's left on the viewer's right
        ("left", ACROSS_MM, 1.877),
        ("right", -ACROSS_MM, 12 - 1.877),
    ],
)
def test_upper_outer_is_one_to_two_on_the_left_and_ten_to_eleven_on_the_right(head_deg, side, left_mm, hours):
    found = position(head_deg, side, up_mm=UP_MM, left_mm=left_mm)
    assert found.hours == pytest.approx(hours, abs=0.02)
    assert found.quadrant == "upper outer"
    assert found.distance_mm == pytest.approx(np.hypot(UP_MM, ACROSS_MM), abs=0.1)
    assert found.text() == f"{side} breast, {2 if side == 'left' else 10} o'clock, 36 mm from the nipple (upper outer)"


@pytest.mark.parametrize(
    ("up_mm", "left_mm", "side", "hours", "quadrant"),
    [
        (30.0, 0.0, "left", 12.0, "upper"),
        (0.0, 30.0, "left", 3.0, "outer"),
        (0.0, 30.0, "right", 3.0, "inner"),
        (-30.0, 0.0, "right", 6.0, "lower"),
        (0.0, -30.0, "left", 9.0, "inner"),
        (-20.0, 20.0, "left", 4.5, "lower outer"),
        (-20.0, 20.0, "right", 4.5, "lower inner"),
    ],
)
def test_the_hours_run_clockwise_from_the_head(up_mm, left_mm, side, hours, quadrant):
    found = position(70, side, up_mm=up_mm, left_mm=left_mm)
    assert (found.hours - hours + 6) % 12 - 6 == pytest.approx(0.0, abs=0.02)
    assert found.quadrant == quadrant


def test_a_mirrored_patient_would_be_seen():
    """The control of the tests above: with right and left exchanged, upper outer left is at ten, not at two."""
    mirrored = position(70, "left", up_mm=UP_MM, left_mm=-ACROSS_MM)
    assert mirrored.hours == pytest.approx(12 - 1.877, abs=0.02)
    assert mirrored.quadrant == "upper inner"


@pytest.mark.parametrize(("hours", "text"), [(12.0, "12"), (0.1, "12"), (1.74, "1:30"), (1.76, "2"), (11.8, "12")])
def test_hours_are_told_to_the_nearest_half(hours, text):
    assert clock_text(hours) == text


def test_without_nipple_side_or_landmarks_there_is_no_clock():
    tactile_map = map_of(70)
    assert clock_position(tactile_map, (0.0, 10.0), side="", covariance_mm2=EXACT) is None
    assert clock_position(tactile_map, (0.0, 10.0), side="phantom", covariance_mm2=EXACT) is None
    assert clock_position(map_of(70, nipple=False), (0.0, 10.0), side="left", covariance_mm2=EXACT) is None
    assert (
        clock_position(replace(tactile_map, patient_from_plane=None), (0.0, 10.0), side="left", covariance_mm2=EXACT)
        is None
    )


def test_so_near_that_the_direction_is_unknown_it_is_behind_the_nipple():
    near = position(70, "left", up_mm=3.0, left_mm=0.0)
    assert near.hours_between(0.95) is None
    assert "behind the nipple" in near.text()
    assert near.as_position(0.95).clock_hours.median is None
    assert near.distance_between(0.95)[0] == 0.0


@pytest.mark.parametrize("place", [(40.0, 30.0), (-5.0, 35.0), (50.0, -1.0), (20.0, 12.0)])
def test_what_the_json_says_of_a_place_gives_the_place_back(place):
    up_mm, left_mm = place
    found = position(25.0, "left", up_mm=up_mm, left_mm=left_mm)
    again = ClockPosition.of(found.as_position(0.9))
    assert again is not None
    assert again.text() == found.text()
    for name in ("distance_mm", "distance_sd_mm", "angle_deg", "angle_sd_deg"):
        assert getattr(again, name) == pytest.approx(getattr(found, name), rel=1e-4)
    assert ClockPosition.of(None) is None
    behind = position(25.0, "left", up_mm=1.0, left_mm=1.0)
    assert ClockPosition.of(behind.as_position(0.9)) is None  # no direction is kept


def covered(found: ClockPosition, touch_sd_mm: float, rng: np.random.Generator) -> tuple[float, float]:
    """Share of touches of the nipple with this SD whose own hours and distance lie within the intervals."""
    truth = np.array([np.sin(np.radians(found.angle_deg)), np.cos(np.radians(found.angle_deg))]) * found.distance_mm
    seen = truth + touch_sd_mm * rng.standard_normal((4000, 2))
    hours = np.degrees(np.arctan2(seen[:, 0], seen[:, 1])) / 30 % 12
    low, high = found.hours_between(0.95)
    near, far = found.distance_between(0.95)
    distance = np.hypot(*seen.T)
    return float(np.mean((low <= hours) & (hours <= high))), float(np.mean((near <= distance) & (distance <= far)))


def test_intervals_hold_the_share_they_say_of_touches_of_the_nipple():
    found, rng = position(70, "left", up_mm=UP_MM, left_mm=ACROSS_MM), np.random.default_rng(117)
    assert covered(found, NIPPLE_SD_MM, rng) == (pytest.approx(0.95, abs=0.015), pytest.approx(0.95, abs=0.015))
    twice = covered(found, 2 * NIPPLE_SD_MM, rng)  # the control: a hand twice as unsteady is seen
    assert max(twice) < 0.8


def test_repeats_that_lie_apart_and_an_uncertain_centre_widen_it():
    tactile_map = map_of(70)
    up, left = axes_of(70)
    centre = on_plane(tactile_map, UP_MM * up + ACROSS_MM * left)
    plain = clock_position(tactile_map, centre, side="left", covariance_mm2=EXACT)
    apart = replace(tactile_map, quality={**tactile_map.quality, "landmark_spread_mm": 12.0})
    wider = clock_position(apart, centre, side="left", covariance_mm2=EXACT)
    vague = clock_position(tactile_map, centre, side="left", covariance_mm2=np.eye(2) * 100.0)
    assert wider.distance_sd_mm == pytest.approx(12.0)
    assert vague.distance_sd_mm == pytest.approx(np.hypot(NIPPLE_SD_MM, 10.0))
    assert min(wider.angle_sd_deg, vague.angle_sd_deg) > 2 * plain.angle_sd_deg


@pytest.mark.long
def test_nipples_of_several_scans_are_averaged_and_those_far_apart_refused():
    up, _ = axes_of(70)

    def scan(x_mm: float, seed: float):
        marks = Landmarks(200 * up, -100 * up, nipple_mm=np.array([x_mm, 0.0, -5.0]))
        return make_scan(strokes(lines=7) + seed, field=gaussian(), landmarks=marks)

    found = build_map([scan(0.0, 0.0), scan(6.0, 0.3)], normalise="mean")
    again = build_map([scan(6.0, 0.3), scan(0.0, 0.0)], normalise="mean")
    assert found.quality["landmark_spread_mm"] == pytest.approx(3.0)
    np.testing.assert_array_equal(found.nipple_mm, again.nipple_mm)
    assert found.nipple_mm[:2] == pytest.approx(on_plane(found, np.array([3.0, 0.0, -5.0])))
    with pytest.raises(BadDataError, match=r"landmarks lie up to 25 mm from their mean"):
        build_map([scan(0.0, 0.0), scan(50.0, 0.3)], normalise="mean")
