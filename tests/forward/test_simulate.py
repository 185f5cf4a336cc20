"""The simulator against its own formula, its symmetries, its seed, and every mistake a scene can hold."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import fastjsonschema
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import tactile_bayes
from tactile_bayes.declarations import as_dict, replace
from tactile_bayes.errors import BadDataError
from tactile_bayes.files.documents import load_schema, parse_toml
from tactile_bayes.files.instrument import read_scene, scene_of
from tactile_bayes.files.scan_mcap import read_scan, read_scan_report
from tactile_bayes.forward.scene import (
    Background,
    Lump,
    Noise,
    Scene,
    SceneLandmarks,
    Strokes,
    Taxels,
    Tracker,
    head_poses,
    level_kpa,
)
from tactile_bayes.forward.simulate import simulate
from tactile_bayes.forward.tissue import SolidLump
from tactile_bayes.geometry import apply, inverse, rotation_from_quaternion
from tactile_bayes.scans import Scan

SILENT = Noise(0.0, 0.0, 0.0, 0.0, 0.0)
LUMP = Lump(x_mm=4.0, y_mm=-3.0, amplitude=0.4, sigma_x_mm=6.0, sigma_y_mm=4.0, angle_deg=30.0)
QUIET = Scene(duration_s=1.0, pose_rate_hz=200.0, lumps=(LUMP,), noise=SILENT, background=Background(ramp_s=0.0))
DEMO = Path(tactile_bayes.__file__).parent / "demo"


def scene_from_text(text: str) -> Scene:
    return scene_of(parse_toml(text, way_out="see the scene in the documentation"))


def run(scene: Scene, seed: int = 0) -> Scan:
    return simulate(scene, rng=np.random.default_rng(seed)).scan


def taxels_in_plane(scan: Scan, scene: Scene) -> np.ndarray:
    """(n, rows, columns, 3) taxel centres by way of the poses, lever arm and base, as a reader of the scan has them."""
    tracker_from_scanhead = inverse(scan.head.scanhead_from_tracker)
    in_tracker = apply(tracker_from_scanhead, scan.head.surface_mm)
    rotation = rotation_from_quaternion(scan.poses.quaternion_wxyz)
    in_base = np.einsum("nij,rcj->nrci", rotation, in_tracker) + scan.poses.position_mm[:, None, None]
    return apply(inverse(scene.tracker.base_from_plane()), in_base)


def test_without_noise_the_scan_is_the_scenes_function() -> None:
    scan = run(QUIET)
    points = taxels_in_plane(scan, QUIET)
    ratio = scan.pressure_kpa() / level_kpa(QUIET.background, scan.frames.time_s)[:, None, None]
    d = points[..., :2] - [LUMP.x_mm, LUMP.y_mm]
    c, s = np.cos(np.radians(30.0)), np.sin(np.radians(30.0))
    R = np.array([[c, -s], [s, c]])
    precision = R @ np.diag([6.0**-2, 4.0**-2]) @ R.T
    expected = 1 + 0.4 * np.exp(-0.5 * np.einsum("...i,ij,...j", d, precision, d))
    step = 34 / 4095 / 9.0  # half a count of rounding, as a share of the lowest level
    np.testing.assert_allclose(ratio, expected, atol=0.51 * step)


def test_load_sharing_keeps_the_mean_of_each_frame() -> None:
    scene = replace(QUIET, background=Background(ramp_s=0.0, load_sharing=True))
    scan = run(scene)
    level = level_kpa(scene.background, scan.frames.time_s)
    np.testing.assert_allclose(scan.pressure_kpa().mean(axis=(1, 2)), level, atol=0.0042)  # half a count


@given(st.tuples(*[st.floats(-170, 170)] * 3), st.tuples(*[st.floats(-500, 500)] * 3))
def test_turning_the_base_changes_nothing_after_the_transform(turn: Any, shift: Any) -> None:
    short = replace(QUIET, duration_s=0.1)
    scene = replace(short, tracker=Tracker(base_rotation_deg=turn, base_offset_mm=shift))
    scan, still = run(scene), run(short)
    np.testing.assert_array_equal(scan.frames.counts, still.frames.counts)
    np.testing.assert_allclose(taxels_in_plane(scan, scene), taxels_in_plane(still, short), atol=1e-8)


def test_swapping_widths_is_turning_the_lump() -> None:
    a = replace(LUMP, sigma_x_mm=4.0, sigma_y_mm=6.0, angle_deg=120.0)
    turned = run(replace(QUIET, lumps=(a,))).frames.counts.astype(int)
    assert np.abs(turned - run(QUIET).frames.counts).max() <= 1


def test_a_seed_gives_one_scan_and_another_seed_another() -> None:
    scene = Scene(duration_s=0.2, lumps=(LUMP,))
    a, b, other = run(scene, 5), run(scene, 5), run(scene, 6)
    np.testing.assert_array_equal(a.frames.counts, b.frames.counts)
    np.testing.assert_array_equal(a.poses.quaternion_wxyz, b.poses.quaternion_wxyz)
    assert (a.frames.counts != other.frames.counts).any()


def test_a_longer_scan_keeps_its_calibration() -> None:
    a, b = (run(Scene(duration_s=t)).element_calibration.gain_kpa_per_count for t in (0.1, 0.3))
    np.testing.assert_array_equal(a, b)


def test_noise_has_the_size_it_says() -> None:
    noisy = replace(QUIET, duration_s=3.0, noise=Noise(0.3, 0.4, 0.2, 0.0, 0.0))
    scan, still = run(noisy), run(replace(noisy, noise=SILENT))
    assert np.std(scan.pressure_kpa() - still.pressure_kpa()) == pytest.approx(0.3, rel=0.02)
    assert np.std(scan.poses.position_mm - still.poses.position_mm) == pytest.approx(0.4, rel=0.1)
    dots = np.abs(np.einsum("ij,ij->i", scan.poses.quaternion_wxyz, still.poses.quaternion_wxyz))
    angle = np.degrees(2 * np.arccos(np.clip(dots, -1, 1)))
    assert np.sqrt(np.mean(angle**2) / 3) == pytest.approx(0.2, rel=0.1)


def test_stamps_are_late_by_the_latency_and_the_poses_are_not() -> None:
    late = replace(QUIET, tracker=Tracker(latency_ms=12.0))
    a, b = run(late).poses, run(QUIET).poses
    np.testing.assert_allclose(a.time_s - b.time_s, 0.012, atol=1e-9)
    np.testing.assert_array_equal(a.position_mm, b.position_mm)


def test_faulty_taxels_read_nothing_or_full_scale() -> None:
    scan = run(replace(QUIET, taxels=Taxels(dead=((0, 1),), saturated=((15, 25),))))
    assert (scan.frames.counts[:, 0, 1] == 0).all()
    assert (scan.frames.counts[:, 15, 25] == 4095).all()
    assert np.isnan(scan.pressure_kpa()[:, 15, 25]).all()


def test_strokes_cover_their_lines() -> None:
    time = np.linspace(0, 7, 1401)
    _, origin = head_poses(Scene(strokes=Strokes(wander_mm=0.0)), time)
    assert origin[:, 0].min() == pytest.approx(-34, abs=0.1)
    assert origin[:, 0].max() == pytest.approx(34, abs=0.1)
    lines = np.unique(np.round(origin[::140, 1][1::2], 1))
    np.testing.assert_allclose(lines, [-12, -6, 0, 6, 12], atol=0.1)
    assert np.abs(np.diff(origin[:, :2], axis=0)).max() < 0.7  # mm in 5 ms: no jumps


def test_truth_says_where_the_lump_is_in_every_frame() -> None:
    simulated = simulate(QUIET, rng=np.random.default_rng(0))
    lump = simulated.truth["lumps"][0]
    landmarks = simulated.scan.landmarks
    assert landmarks is not None
    np.testing.assert_allclose(lump["patient_mm"], [64.0, 87.0, 0.0], atol=1e-9)
    plane = apply(np.array(simulated.truth["plane_from_base"]), np.array(lump["base_mm"]))
    np.testing.assert_allclose(plane, [4.0, -3.0, 0.0], atol=1e-9)
    assert run(replace(QUIET, landmarks=SceneLandmarks(touched=False))).landmarks is None


def test_the_heads_face_is_an_arc_with_shoulders() -> None:
    arc, rounded = Scene().head.surface_mm(), replace(Scene().head, shoulder_mm=3.0).surface_mm()
    np.testing.assert_allclose(arc[..., 0] ** 2 + (arc[..., 2] + 35) ** 2, 35**2)
    assert (rounded[[0, -1], :, 2] < arc[[0, -1], :, 2] - 0.5).all()
    np.testing.assert_array_equal(rounded[4:12], arc[4:12])


def test_a_lump_in_a_file_has_the_keys_of_both_kinds_and_the_defaults_of_a_bump() -> None:
    keys = load_schema("scene.schema.json")["properties"]["lump"]["items"]["properties"]
    assert set(keys) == {*as_dict(Lump()), *as_dict(SolidLump())}
    for key, rule in keys.items():
        assert rule.get("default") == getattr(Lump(), key, None), key


def test_an_empty_scene_is_the_default_scene() -> None:
    assert scene_from_text("") == Scene()


BAD_SCENES = [
    ("[noise]\nelement_kPa = 1", "noise.element_kPa is not known; did you mean element_kpa"),
    ("[[lump]]\nx_cm = 1", r"lump\[0\].x_cm is not known; give x_mm, in the unit it names"),
    ("[[lump]]\namplitud = 1", "did you mean amplitude"),
    ("duration_s = 7.0\n[body]", r"duration_s stands in no table; write it below \[scene\]"),
    ("[strks]\nlines = 1", "strks is not known; did you mean strokes"),
    ("[zebra]", "known are scene, background"),
    ("[scene]\nduration_s = 0", "scene.duration_s is 0; give a number above 0 up to 600"),
    ("[scene]\nduration_s = '7 s'", "scene.duration_s is '7 s'; give a number above 0"),
    ("[scene]\nseed = 1.5", "scene.seed is 1.5; give a whole number from 0"),
    ("[scene]\nduration_s = true", "scene.duration_s is True"),
    ("[[lump]]\nsigma_x_mm = nan", r"lump\[0\].sigma_x_mm is nan; give a finite"),
    ("[[lump]]\nsigma_x_mm = -1", r"lump\[0\].sigma_x_mm is -1; give a number from 0.1 to 200"),
    ("[tracker]\nbase_offset_mm = [1, 2]", r"tracker.base_offset_mm is \[1, 2\]; give a list of 3"),
    ("[taxels]\ndead = [[16, 0]]", r"taxels.dead names \[16, 0\]; rows are 0 to 15"),
    ("[taxels]\ndead = [3]", r"taxels.dead\[0\] is 3; give a list of 2"),
    ("[head]\nradius_mm = 5", "head.radius_mm is 5; it must exceed the half width of 12 mm"),
    ("[head]\nshoulder_mm = 20", "head.shoulder_mm is 20"),
    ("[background]\ndrift_kpa = 9.5", "background.drift_kpa is 9.5; it must stay below"),
    ("[landmarks]\nxiphoid_mm = [-60, 90, 0]", "place them apart"),
    ("lump = 3", "lump is 3; give a list of at most 100"),
    ("[scene", "is not TOML"),
]


@pytest.mark.parametrize(("text", "words"), BAD_SCENES, ids=[row[0] for row in BAD_SCENES])
def test_every_mistake_in_a_scene_is_one_line(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "scene.toml"
    path.write_text(text)
    with pytest.raises(BadDataError, match=words) as caught:
        read_scene(path)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


def test_the_scene_schema_is_draft_7() -> None:
    assert load_schema("scene.schema.json")["$schema"].startswith("http://json-schema.org/draft-07")
    fastjsonschema.compile(load_schema("scene.schema.json"))


@pytest.mark.long
def test_the_shipped_scan_is_what_its_scene_gives() -> None:
    assert (DEMO / "scan.mcap").stat().st_size <= 2_000_000
    scene = read_scene(DEMO / "scene.toml")
    simulated = simulate(scene, rng=np.random.default_rng(scene.seed))
    shipped = read_scan(DEMO / "scan.mcap")
    # Another build of numpy may round an exponential the other way, so one count in a thousand readings is let off.
    difference = np.abs(shipped.frames.counts.astype(int) - simulated.scan.frames.counts)
    assert difference.max() <= 1
    assert np.mean(difference > 0) < 1e-3
    np.testing.assert_allclose(shipped.poses.position_mm, simulated.scan.poses.position_mm, atol=1e-9)
    truth = read_scan_report(DEMO / "scan.mcap").truth
    assert truth is not None
    assert truth["lumps"][0]["d_mm"] == 15.0
