"""Scans of the solid model: what the scene says, what cannot be, and another program's scan frame by frame."""

from __future__ import annotations

import csv
from collections.abc import Callable
from functools import cache
from pathlib import Path
from subprocess import CompletedProcess

import numpy as np
import pytest
from posterior_maps import find_bump

from tactile_bayes.declarations import replace
from tactile_bayes.errors import BadDataError
from tactile_bayes.files.documents import parse_toml
from tactile_bayes.files.instrument import read_scene, scene_of
from tactile_bayes.files.scan_mcap import read_scan, read_scan_report
from tactile_bayes.forward.scene import (
    Background,
    Head,
    Lump,
    Noise,
    Scene,
    SimulatedScan,
    Strokes,
    Tracker,
    frame_times,
    head_poses,
    level_kpa,
)
from tactile_bayes.forward.simulate import (
    SkinPerturbation,
    SolidHead,
    condensed_lump,
    frames_at_poses,
    head_face,
    simulate,
    skin_perturbation,
    solid_head,
)
from tactile_bayes.forward.tissue import Rib, SceneBody, SolidLump, fat_thickness
from tactile_bayes.geometry import (
    apply,
    inverse,
    patient_from_base,
    rigid,
    rotation_from_quaternion,
    unroll_quaternion_signs,
)
from tactile_bayes.mapping.build import build_map
from tactile_bayes.posterior.draw import SamplerSettings

Run = Callable[..., "CompletedProcess[str]"]
SILENT = Noise(0.0, 0.0, 0.0, 0.0, 0.0)
BALL = SolidLump()
SHORT = Scene(
    duration_s=0.25,
    pose_rate_hz=200.0,
    body=SceneBody(),
    solid_lumps=(BALL,),
    strokes=Strokes(lines=1, half_length_mm=20.0, tilt_deg=0.0, wander_mm=0.0),
    background=Background(ramp_s=0.05),
    noise=SILENT,
)
TOML = "[scene]\nseed = 4\nduration_s = 0.1\n[body]\n[[lump]]\nd_mm = 15\ndepth_ratio = 1\nseat = 1.2\n"


@cache
def short_scan() -> SimulatedScan:
    return simulate(SHORT, rng=np.random.default_rng(0))


def scene_from_text(text: str) -> Scene:
    return scene_of(parse_toml(text, way_out="see the scene in the documentation"))


def solid_frames(scene: Scene, time_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return frames_at_poses(scene, *head_poses(scene, time_s), mean_kpa=level_kpa(scene.background, time_s))


@cache
def short_frames() -> tuple[np.ndarray, np.ndarray]:
    return solid_frames(SHORT, frame_times(SHORT))


def test_frames_bear_the_level_and_rise_over_the_lump() -> None:
    time = frame_times(SHORT)
    pressure, depth = short_frames()
    np.testing.assert_allclose(pressure.mean(axis=(1, 2)), level_kpa(SHORT.background, time), rtol=1e-9, atol=1e-12)
    assert pressure.min() >= 0
    over = np.argmin(np.abs(head_poses(SHORT, time)[1][:, 0]))
    assert pressure[over, 7:9, 12:14].mean() > 1.2 * pressure[over].mean()
    # pressed harder, sunk deeper; over the lump less deep than beside it
    assert depth[0] < depth[5] < depth[10]
    assert depth[over] / level_kpa(SHORT.background, time[over : over + 1]) < depth[-1] / level_kpa(
        SHORT.background, time[-1:]
    )


def test_the_poses_say_how_deep_the_head_sank() -> None:
    made = short_scan()
    _, depth = short_frames()
    poses = made.scan.poses
    lever = inverse(made.scan.head.scanhead_from_tracker)[:3, 3]
    origin = poses.position_mm + rotation_from_quaternion(poses.quaternion_wxyz) @ lever
    in_plane = apply(inverse(SHORT.tracker.base_from_plane()), origin)
    np.testing.assert_allclose(in_plane[:, 2], depth, atol=1e-6)


def test_the_counts_are_the_models_frames_rounded() -> None:
    np.testing.assert_allclose(short_scan().scan.pressure_kpa(), short_frames()[0], atol=0.51 * 34 / 4095)


def test_the_truth_names_the_tissue_and_where_it_lies() -> None:
    lump = replace(BALL, x_mm=4.0, y_mm=-3.0, seat=1.2)
    scene = replace(SHORT, duration_s=0.02, solid_lumps=(lump,))
    truth = simulate(scene, rng=np.random.default_rng(0)).truth
    assert truth["model"] == "solid"
    assert truth["body"]["fat_mm"] == pytest.approx(24.0)
    (told,) = truth["lumps"]
    assert (told["d_mm"], told["height_mm"], told["depth_mm"], told["lump_kpa"]) == (15.0, 15.0, 15.0, 500.0)
    assert told["seat"] == pytest.approx(1.2)
    np.testing.assert_allclose(told["patient_mm"], [64.0, 87.0, 0.0], atol=1e-9)


def test_the_same_seed_gives_the_same_scan_and_tracker_noise_leaves_the_frames() -> None:
    scene = replace(SHORT, duration_s=0.03, noise=Noise())
    a = simulate(scene, rng=np.random.default_rng(5)).scan
    late = replace(scene, tracker=Tracker(latency_ms=7.0))
    np.testing.assert_array_equal(simulate(late, rng=np.random.default_rng(5)).scan.frames.counts, a.frames.counts)


def test_a_spheroid_and_several_lumps() -> None:
    flat = replace(BALL, height_mm=8.0)
    pair = replace(SHORT, duration_s=0.01, solid_lumps=(flat, replace(flat, x_mm=30.0)))
    alone = replace(pair, solid_lumps=(flat,))
    two, one = (solid_frames(scene, np.array([0.125]))[0] for scene in (pair, alone))
    assert np.abs(two - one).max() > 0.01


def test_a_scene_of_tissue_without_a_lump() -> None:
    scene = scene_from_text("[scene]\nduration_s = 0.02\n[body]\n")
    assert scene.fidelity == "solid"
    truth = simulate(scene, rng=np.random.default_rng(0)).truth
    assert truth["lumps"] == []
    assert truth["body"]["fat_mm"] == 15.0


def test_the_scene_decides_the_model() -> None:
    assert scene_from_text(TOML).fidelity == "solid"
    assert scene_from_text("[[lump]]\namplitude = 0.2").fidelity == "empirical-gaussian"
    assert scene_from_text("").fidelity == "empirical-gaussian"
    rng = np.random.default_rng(0)
    with pytest.raises(BadDataError, match=r"lump\[0\] gives no depth_ratio; the solid model needs"):
        simulate(Scene(lumps=(Lump(),)), rng=rng, fidelity="solid")
    with pytest.raises(BadDataError, match="use --fidelity solid"):
        simulate(SHORT, rng=rng, fidelity="empirical-gaussian")
    with pytest.raises(BadDataError, match="fidelity is 'exact'"):
        simulate(SHORT, rng=rng, fidelity="exact")


def test_a_rib_is_a_row_of_balls_and_no_lump() -> None:
    scene = scene_from_text("[scene]\nduration_s = 0.02\n[body]\nfat_mm = 12\n[[rib]]\nhalf_length_mm = 9\n")
    assert scene.fidelity == "solid"
    (rib,) = scene.ribs
    assert [(ball.x_mm, ball.y_mm, ball.depth_mm) for ball in rib.balls()] == [(x, 26, 12) for x in (-8, 0, 8)]
    truth = simulate(scene, rng=np.random.default_rng(0)).truth
    assert truth["lumps"] == []
    assert truth["ribs"][0]["ball_x_mm"] == [-8.0, 0.0, 8.0]
    with pytest.raises(BadDataError, match=r"rib\[0\] is of tissue; use --fidelity solid"):
        simulate(scene, rng=np.random.default_rng(0), fidelity="empirical-gaussian")


def test_shoulders_inside_the_array_leave_no_rim() -> None:
    assert head_face(Head())[1].shape == (18, 30)
    assert head_face(Head(shoulder_mm=3.0))[1].shape == (16, 26)


LUMP = "[[lump]]\nd_mm = 15\n"
IMPOSSIBLE = [
    (
        LUMP + "depth_ratio = 0.4",
        r"lump\[0\].depth_ratio is 0.4: the lump stands out of the skin; it must lie in 0.51 to",
    ),
    (LUMP + "depth_ratio = 4.5", r"lump\[0\].depth_ratio is 4.5: the lump reaches into the chest wall; .* to 4.157"),
    (LUMP + "depth_ratio = 1\nheight_mm = 80", r"lump\[0\] is 80 mm high; the body has 70 mm"),
    (LUMP + "depth_ratio = 1\nstiffness_ratio = 0", r"lump\[0\].stiffness_ratio is 0; give a number above 0 up to 1e"),
    (LUMP + "depth_ratio = 1\nstiffness_ratio = -3", r"lump\[0\].stiffness_ratio is -3; .* above 0"),
    (LUMP + "depth_ratio = 1\nseat = -1", r"lump\[0\].seat is -1; give a number from 0 to 20"),
    (LUMP + "depth_ratio = 1\nseat = 9", r"lump\[0\].seat puts the gland 82.5 mm deep"),
    (LUMP + "depth_ratio = 1\namplitude = 0.3", r"lump\[0\] gives amplitude, of a bump, and depth_ratio, of tissue"),
    (LUMP + "seat = 1", r"lump\[0\] gives no depth_ratio; a lump of tissue with seat needs it"),
    (
        LUMP + "x_mm = 1",
        r"lump\[0\] gives d_mm alone, from which no bump follows; give depth_ratio for a lump of tissue",
    ),
    ("[[lump]]\ndepth_ratio = 1", r"lump\[0\] gives no d_mm"),
    (LUMP + "depth_ratio = 1\n[[lump]]\nd_mm = 10\ndepth_ratio = 1", r"lump\[1\] puts the gland 10 mm deep, lump\[0\]"),
    ("[body]\nfat_mm = 20\n" + LUMP + "depth_ratio = 1\nseat = 0", "body.fat_mm puts it 20 mm deep"),
    ("[body]\nfat_mm = 80", "body.fat_mm puts the gland 80 mm deep"),
    ("[body]\nnu = 0.5", "body.nu is 0.5; give a number from 0 to below 0.5"),
    ("[body]\nfat = 5", "body.fat is not known; did you mean fat_mm"),
    ("[body]\nthickness_cm = 7", "body.thickness_cm is not known; give thickness_mm, in the unit it names"),
    ("[body]\nfat_kpa = -5", "body.fat_kpa is -5"),
    (LUMP + "depth_ratio = 1\n[[lump]]\namplitude = 0.2", "some lumps are bumps"),
    ("[head]\nrim_mm = 40", "head.rim_mm is 40; it must lie in 0 to below radius_mm, 35"),
    ("[head]\nrim_mm = -1", "head.rim_mm is -1"),
    ("[[rib]]\ndepth_mm = 5", r"rib\[0\].depth_mm is 5: the rib stands out of the skin; it must lie in 6.12 to 63.88"),
    ("[[rib]]\ndepth_mm = 68", r"rib\[0\].depth_mm is 68: the rib reaches into the chest wall"),
    ("[[rib]]\nspacing_mm = 1", r"rib\[0\] is a row of 81 balls; give spacing_mm or half_length_mm for 60 or fewer"),
    ("[[rib]]\nstiffness_ratio = 0", r"rib\[0\].stiffness_ratio is 0; give a number above 0 up to 1e"),
    ("[[rib]]\ndiameter_mm = 9", r"rib\[0\].diameter_mm is not known"),
    ("[[rib]]\ny_cm = 2", r"rib\[0\].y_cm is not known; give y_mm, in the unit it names"),
    ("[[rib]]\n[[lump]]\namplitude = 0.2", r"lump\[0\] is a bump and rib\[0\] is tissue"),
]


@pytest.mark.parametrize(("text", "words"), IMPOSSIBLE, ids=[row[0] for row in IMPOSSIBLE])
def test_an_impossible_scene_is_one_line(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "scene.toml"
    path.write_text(text)
    with pytest.raises(BadDataError, match=words) as caught:
        read_scene(path)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


def test_given_fat_places_lumps_of_any_size() -> None:
    text = "[body]\nfat_mm = 12\n" + LUMP + "depth_ratio = 0.8\n[[lump]]\nd_mm = 10\ndepth_ratio = 1.6\n"
    scene = scene_from_text(text)
    assert scene.body is not None
    assert fat_thickness(scene.body, scene.solid_lumps) == 12.0


def test_the_command_makes_a_solid_scan_whose_truth_stays_in_the_file(run_cli: Run, tmp_path: Path) -> None:
    (tmp_path / "s.toml").write_text(TOML)
    done = run_cli("simulate", "s.toml", "-o", "a.mcap", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "lump at 0, 0 mm: d 15 mm, h/d 1, 100 times as stiff as fat" in done.stdout
    assert "model solid" in done.stdout
    truth = read_scan_report(tmp_path / "a.mcap").truth
    assert truth is not None
    assert truth["model"] == "solid"
    assert "solid" not in str(read_scan(tmp_path / "a.mcap").session)
    other = run_cli("simulate", "s.toml", "-o", "b.mcap", "--fidelity", "empirical-gaussian", cwd=tmp_path)
    assert other.returncode == 3
    assert other.stderr.startswith("error: lump[0] gives depth_ratio and no amplitude; use --fidelity solid")


@pytest.mark.slow
def test_the_map_of_a_ball_is_the_other_programs() -> None:
    """15 mm, h/d 1, centred, 100 times as stiff: amplitude .30, sigma 5.1 and 4.0 mm in a scan of the other program."""
    scene = replace(SHORT, duration_s=7.0, strokes=Strokes(tilt_deg=0.1), background=Background())
    made = simulate(scene, rng=np.random.default_rng(1))
    fit = find_bump(build_map(made.scan, normalise="mean"), SamplerSettings())[-1].fit
    assert fit is not None
    sigma_x, sigma_y, _ = fit.widths()
    assert fit.theta[0] == pytest.approx(0.30, abs=0.01)
    assert sigma_x == pytest.approx(5.1, rel=0.03)
    assert sigma_y == pytest.approx(4.03, rel=0.03)


SHARED = [("s01_sphere15_hd1_clean", 0.007, 0.002), ("s11_resting15_hd1", 0.035, 0.02)]


@pytest.mark.parametrize(("name", "limit", "depth_limit"), SHARED)
def test_another_programs_frames_are_met_one_by_one(
    shared_data: Path, name: str, limit: float, depth_limit: float
) -> None:
    """Every 40th frame at its pose and mean pressure: residual of the taxels, and how deep the head sank."""
    with (shared_data / "scans" / "truth.csv").open(newline="") as file:
        row = next(row for row in csv.DictReader(file) if row["scan"] == name)
    seat = 1.2 if row["seat"] == "resting" else 0.0
    lump = SolidLump(
        d_mm=float(row["d_mm"]),
        depth_ratio=float(row["depth_ratio"]),
        stiffness_ratio=float(row["stiffness_ratio"]),
        seat=seat,
    )
    head, placed = one_ball(lump)
    skin = np.array([float(row[f"base_{axis}_mm"]) for axis in "xyz"])
    residual, ratio = [], []
    for pose, pressure in poses_and_frames(
        shared_data / "scans" / f"{name}.npz", skin, float(row["tracker_latency_ms"])
    ):
        mean = float(pressure.mean())
        frame, contact = head.frame([placed], pose[:3, :3], pose[:2, 3], mean_kpa=mean)
        residual.append((frame - pressure) / mean)
        ratio.append(contact.depth_mm / pose[2, 3])
    assert len(residual) > 25
    assert np.sqrt(np.mean(np.square(residual))) <= limit  # s11 has 0.2 kPa of noise, s01 0.02
    assert np.median(ratio) == pytest.approx(1.0, abs=depth_limit)


def test_another_programs_rib_is_met_frame_by_frame(shared_data: Path) -> None:
    """Scan s07: a ball of 12 mm, and 32 mm beside it along the head a row of them 8 mm apart; 0.2 kPa of noise."""
    with (shared_data / "scans" / "truth.csv").open(newline="") as file:
        row = next(row for row in csv.DictReader(file) if row["scan"] == "s07_rib_edge")
    rib = Rib(y_mm=116.0 - float(row["y_mm"]))
    assert (rib.d_mm, rib.spacing_mm) == (float(row["d_mm"]), 8.0)
    lump = SolidLump(d_mm=12.0, depth_ratio=1.0)
    head, placed = one_ball(lump)
    balls = [placed, *(replace(placed, x_mm=ball.x_mm, y_mm=ball.y_mm) for ball in rib.balls())]
    skin = np.array([float(row[f"base_{axis}_mm"]) for axis in "xyz"])
    found = poses_and_frames(shared_data / "scans" / "s07_rib_edge.npz", skin, float(row["tracker_latency_ms"]))
    residual, alone = [], []
    for pose, pressure in found[::3]:
        pressed = {"rotation": pose[:3, :3], "at_mm": pose[:2, 3], "mean_kpa": float(pressure.mean())}
        residual.append((head.frame(balls, **pressed)[0] - pressure) / pressure.mean())
        alone.append((head.frame([placed], **pressed)[0] - pressure) / pressure.mean())
    assert np.sqrt(np.mean(np.square(residual))) <= 0.04
    assert np.sqrt(np.mean(np.square(alone))) >= 0.08  # without the rib


def one_ball(lump: SolidLump) -> tuple[SolidHead, SkinPerturbation]:
    layers = Scene(solid_lumps=(lump,)).layers
    change = skin_perturbation(condensed_lump(lump, layers), lump.stiffness_ratio * layers.fat_kpa)
    return solid_head(Head(), layers), change


def poses_and_frames(path: Path, skin: np.ndarray, latency_ms: float) -> list[tuple[np.ndarray, np.ndarray]]:
    """Head poses in a frame with the lump's axis as z, and calibrated frames, within the gate."""
    with np.load(path, allow_pickle=False) as data:
        arrays = dict(data)
    pressure = arrays["counts"] * arrays["gain_kpa_per_count"] + arrays["offset_kpa"]
    quaternion = unroll_quaternion_signs(arrays["quaternion_wxyz"])
    frame_s, pose_s = arrays["frame_time_s"], arrays["pose_time_s"] - latency_ms / 1000
    notch, xiphoid = arrays["landmarks_mm"]
    tracker_from_head = inverse(arrays["array_from_tracker"])
    normal = (rotation_from_quaternion(quaternion) @ tracker_from_head[:3, 2]).mean(axis=0)
    patient = patient_from_base(notch, xiphoid, normal=normal)
    # the skin's own normal: the lump's point lies on the skin, as the xiphoid does
    y_axis = patient[1, :3]
    across = (skin - xiphoid) - ((skin - xiphoid) @ y_axis) * y_axis
    x_axis = across / np.linalg.norm(across)
    rotation = np.stack([x_axis, y_axis, np.cross(x_axis, y_axis)])
    lump_from_base = rigid(rotation, -rotation @ skin)
    found = []
    for i in range(60, len(frame_s), 40):
        if not 5.0 < pressure[i].mean() < 14.0:
            continue
        position = np.array([np.interp(frame_s[i], pose_s, arrays["position_mm"][:, k]) for k in range(3)])
        near = np.argsort(np.abs(pose_s - frame_s[i]))[:7]  # the tracker's angles are noisy: average a few
        turn = rotation_from_quaternion(quaternion[near].mean(axis=0))
        found.append((lump_from_base @ rigid(turn, position) @ tracker_from_head, pressure[i]))
    return found
