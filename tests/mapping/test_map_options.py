"""Flat field, plane near the mass, rotation conventions, timing, advice: what each option and figure says."""

from __future__ import annotations

import mapping_scans as scans
import numpy as np
import pytest

from tactile_bayes.declarations import replace
from tactile_bayes.errors import BadDataError, UsageError
from tactile_bayes.geometry import rigid
from tactile_bayes.mapping.build import build_map
from tactile_bayes.mapping.map import advise_cell
from tactile_bayes.mapping.select import timing_figures
from tactile_bayes.report.map import map_text
from tactile_bayes.scans import ElementCalibration, HeadGeometry, Landmarks, PressureFrames, Scan, TrackerPoses


def curved_strokes(*, field=None, bend_mm: float = 0.0) -> Scan:
    """Strokes over a wide patch; `bend_mm` lifts the head towards the ends of the strokes."""
    centres = scans.strokes(reach_mm=40.0, lines=9, spacing_mm=5.0, per_line=60)
    scan = scans.make_scan(centres, field=field or scans.gaussian(amplitude=0.6, sigma_x=5, sigma_y=5))
    position = scan.poses.position_mm.copy()
    position[:, 2] += bend_mm * (centres[:, 0] / 40.0) ** 2 * np.sign(centres[:, 0])
    return replace(scan, poses=TrackerPoses(scan.poses.time_s, position, scan.poses.quaternion_wxyz))


def test_a_flat_field_takes_the_taxels_own_response_off():
    scan = curved_strokes()
    response = 1 + 0.1 * np.random.default_rng(0).standard_normal(scan.head.shape)
    gain = scan.element_calibration.gain_kpa_per_count * response
    uneven = replace(
        scan, element_calibration=ElementCalibration(gain, np.zeros(scan.head.shape), saturation_count=65535)
    )
    raw, flat = build_map(uneven, normalise="gain"), build_map(uneven, normalise="gain", flat_field=True)
    truth = build_map(scan, normalise="gain")
    well = truth.count > 5
    errors = [np.abs(one.mean - truth.mean)[well].mean() for one in (raw, flat)]
    assert errors[1] < 0.25 * errors[0]
    assert flat.quality["flat_field_sd"] == pytest.approx(float(response.std() / response.mean()), rel=0.1)
    assert flat.recipe.flat_field
    assert "frames without a lump" in map_text(flat)


def test_a_flat_field_without_lump_free_frames_is_refused():
    with pytest.raises(BadDataError, match="frames look free of a lump; scan beside the lump"):
        build_map(scans.make_scan(scans.strokes(), field=scans.gaussian()), flat_field=True)


def test_the_plane_near_the_mass_follows_the_skin_there():
    bent = curved_strokes(bend_mm=6.0)
    whole, near = build_map(bent), build_map(bent, plane_radius_mm=15.0)
    assert near.quality["plane_rms_mm"] < 0.5 * whole.quality["plane_rms_mm"]
    assert near.quality["plane_frames"] < whole.quality["frames_used"]
    auto = build_map(bent, plane_radius_mm="auto")
    assert auto.quality["plane_radius_mm"] == pytest.approx(np.hypot(14, 14) / 2)
    assert "frames within 10 mm of the mass" in map_text(auto)
    assert "all frames used; longest over second spread" in map_text(whole)
    with pytest.raises(BadDataError, match=r"no frame lies within 0\.001 mm|lie on a line"):
        build_map(bent, plane_radius_mm=0.001)


def test_a_radius_whose_frames_lie_on_a_line_grows():
    """A row of taxels that slides lengthwise over the lump, the next stroke 10 mm beside."""
    across = scans.strokes(lines=3, spacing_mm=10.0, per_line=120)
    row = scans.flat_head(rows=1, columns=16, pitch_mm=1.0, lever_mm=(5.0, -20.0, 80.0))
    lengthwise = scans.make_scan(
        across[:, ::-1], field=scans.gaussian(sigma_x=3.0, sigma_y=3.0, x=10.0, y=-5.0), head=row
    )
    quality = build_map(lengthwise, plane_radius_mm="auto", as_stated=True).quality
    assert quality["plane_radius_mm"] == pytest.approx(1.5 * 15.0 / 2)
    assert quality["plane_rms_mm"] == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("tilt_deg", [0.0, 12.0])
def test_the_motion_of_the_head_is_measured_in_degrees_and_millimetres(tilt_deg):
    """Of a head so small that its own taxels do not count; strokes of 30 mm, 15 mm from the first to the last."""
    centres = scans.strokes(reach_mm=15.0, lines=4, spacing_mm=5.0)
    turned = scans.make_scan(centres, head=scans.flat_head(pitch_mm=0.02), yaw_deg=16.0 * (-1.0) ** np.arange(120))
    lever = rigid(scans.rotation(tilt_deg, about=(0, 1, 0)), np.zeros(3))
    head = HeadGeometry(turned.head.surface_mm, turned.head.pitch_mm, lever)
    made = build_map(replace(turned, head=head), as_stated=True)
    spread = centres.std(axis=0)
    expected = {
        "tilt_deg": np.degrees(
            np.arctan(np.tan(np.radians(tilt_deg)) * np.cos(np.radians(16.0)))
        ),  # of the mean normal
        "yaw_sd_deg": 16.0,
        "span_x_mm": 30.0,
        "span_y_mm": 15.0,
        "plane_condition": spread[0] / spread[1],
    }
    assert {name: made.quality[name] for name in expected} == pytest.approx(expected, rel=0.01, abs=0.05)
    told = {one.kind for one in made.findings} & {"tilted_head", "turned_head"}
    assert told == ({"tilted_head", "turned_head"} if tilt_deg else {"turned_head"})


@pytest.mark.parametrize("radius", [0.0, -3.0, float("nan"), float("inf"), "wide"])
def test_a_radius_that_is_none_is_refused(radius):
    with pytest.raises(UsageError, match=r"plane_radius_mm is .*; give a number above 0"):
        build_map(curved_strokes(), plane_radius_mm=radius)


def tilted_base(scan: Scan) -> Scan:
    return scans.moved(scan, np.block([[scans.rotation(120, about=(1, 0.3, 0.2)), np.zeros((3, 1))], [np.eye(4)[3:]]]))


def test_quaternions_told_scalar_last_are_named_as_such():
    scan = tilted_base(curved_strokes())
    q = scan.poses.quaternion_wxyz
    wrong = replace(scan, poses=TrackerPoses(scan.poses.time_s, scan.poses.position_mm, np.roll(q, -1, axis=1)))
    with pytest.raises(BadDataError, match=r"degrees apart; the quaternions seem to be scalar last \(agreement 1\.00"):
        build_map(wrong, as_stated=True)
    build_map(scan)  # the control: told as they should be, they pass


def test_timing_counts_what_is_late_missing_and_told_twice():
    scan = curved_strokes()
    keep = np.ones(len(scan.frames), dtype=bool)
    keep[100:103] = False
    keep[200] = False
    frames = PressureFrames(scan.frames.time_s[keep], scan.frames.counts[keep])
    twice = np.repeat(np.arange(len(scan.poses)), 2)
    poses = TrackerPoses(
        np.repeat(scan.poses.time_s, 2) + np.tile([0.0, 0.005], len(scan.poses)),
        scan.poses.position_mm[twice],
        scan.poses.quaternion_wxyz[twice],
    )
    figures = timing_figures([replace(scan, frames=frames, poses=poses)])
    assert figures["frames_missing"] == 4
    assert figures["frame_rate_hz"] == pytest.approx(100.0)
    assert figures["frame_jitter_ms"] == pytest.approx(0.0, abs=1e-6)
    assert figures["pose_repeats"] == len(scan.poses)
    assert figures["pose_rate_hz"] == pytest.approx(100.0)
    assert figures["pose_gap_ms"] == pytest.approx(10.0)
    assert timing_figures([scans.part(scan, slice(1))])["frames_missing"] == 0


def test_jitter_is_the_spread_of_the_intervals():
    scan = curved_strokes()
    late = 0.001 * np.random.default_rng(0).standard_normal(len(scan.frames))
    uneven = PressureFrames(np.sort(scan.frames.time_s + late), scan.frames.counts)
    assert timing_figures([replace(scan, frames=uneven)])["frame_jitter_ms"] == pytest.approx(1.4, rel=0.15)


def test_repeated_landmarks_tell_their_spread():
    scan = curved_strokes()
    marks = [Landmarks(np.array([0.0, 150.0 + d, 0]), np.array([0.0, -150.0, 0])) for d in (-3.0, 3.0)]
    found = build_map([replace(scan, landmarks=one) for one in marks])
    assert found.quality["landmark_spread_mm"] == pytest.approx(3.0)
    assert "repeats within 3.0 mm" in map_text(found)
    assert "landmark_spread_mm" not in build_map(replace(scan, landmarks=marks[0])).quality
    again = build_map(replace(scan, landmarks=replace(marks[0], spread_mm=4.5)))
    assert again.quality["landmark_spread_mm"] == 4.5
    with pytest.raises(BadDataError, match=r"spread_mm is -1\.0; give a distance"):
        replace(marks[0], spread_mm=-1.0)


def test_advice_names_the_width_and_what_finer_cells_would_cost():
    scan = curved_strokes(field=scans.gaussian(amplitude=0.6, sigma_x=6, sigma_y=4))
    advice = advise_cell(build_map(scan, normalise="gain", cell_mm=2.0))
    assert advice is not None
    assert advice.sigma_mm == pytest.approx(4.0, rel=0.15)
    assert advice.coarsest_mm == pytest.approx(0.5 * advice.sigma_mm)
    assert "1 mm would take 4 times the cells" in advice.text()
    coarse = replace(advice, cell_mm=6.0).text()
    assert "too coarse; use --cell-mm" in coarse
    assert float(coarse.rsplit(" ", 1)[1]) <= advice.coarsest_mm  # the advised cell is not too coarse itself
    assert advise_cell(build_map(curved_strokes(field=scans.uniform))) is None


def test_few_hit_cells_are_flagged():
    tactile_map = build_map(curved_strokes())
    few = tactile_map.few
    assert few.sum() == tactile_map.quality["few_cells"] > 0
    assert (tactile_map.count[few] < 10).all()
    assert not few[tactile_map.count == 0].any()
    assert f"{few.sum()} cells have fewer than 10 readings" in map_text(tactile_map)


def test_a_window_that_leaves_much_out_is_told_a_wider_one():
    levels = np.linspace(3, 9, 540)
    centres = scans.strokes(reach_mm=40.0, lines=9, spacing_mm=5.0, per_line=60)
    report = map_text(build_map(scans.make_scan(centres, levels_kpa=levels)))
    assert (
        "press harder next time; a window of 3.3 to 8.7 kPa (--pressure-window-kpa) would keep nine frames in ten"
        in report
    )
    levels[:180] = 0.5
    lifted = map_text(build_map(scans.make_scan(centres, levels_kpa=levels)))
    assert "the head was lifted: keep it on the skin" in lifted
    assert "would keep nine frames" not in lifted
