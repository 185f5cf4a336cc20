"""Scans in two dimensions: a cylinder under the head, by the plane-strain solver and by Eqs 1 to 4."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path
from subprocess import CompletedProcess

import numpy as np
import pytest

from tactile_bayes.declarations import replace
from tactile_bayes.errors import BadDataError
from tactile_bayes.files.scan_mcap import read_scan_report
from tactile_bayes.forward import scene as scene_types
from tactile_bayes.forward.plane import condense, kappa, press, press_layers
from tactile_bayes.forward.scene import (
    Background,
    HeadSection,
    Lump,
    Noise,
    Scene,
    Strokes,
    frame_times,
    head_poses,
    level_kpa,
)
from tactile_bayes.forward.simulate import PlaneSection, simulate
from tactile_bayes.forward.tissue import Body, Layers, Rib, SceneBody, SolidLump

Run = Callable[..., "CompletedProcess[str]"]
SCENE = Scene(
    duration_s=0.2,
    body=SceneBody(),
    solid_lumps=(SolidLump(x_mm=3.0, seat=0.0),),
    strokes=Strokes(lines=1, half_length_mm=20.0, tilt_deg=0.0, wander_mm=0.0),
    background=Background(ramp_s=0.05, drift_period_s=0.1),
    noise=Noise(0.0, 0.0, 0.0, 0.0, 0.0),
)


def frames_of(scene: Scene, time_s: np.ndarray, fidelity: str = "plane-strain") -> np.ndarray:
    level = level_kpa(scene.background, time_s)
    return PlaneSection.of(scene, fidelity).frames(*head_poses(scene, time_s), level, reach_mm=60.0)


@cache
def frames(fidelity: str) -> np.ndarray:
    return frames_of(SCENE, frame_times(SCENE), fidelity)


def test_every_column_feels_the_frame_of_the_two_dimensional_body() -> None:
    """One frame at a time by the study's own contact, at the head's place and that frame's force."""
    time = frame_times(SCENE)
    place, level = head_poses(SCENE, time)[1][:, 0] - 3.0, level_kpa(SCENE.background, time)
    surface = condense(Body(15.0, 1.0, 0.0))
    for i in (12, 20, 33):
        direct = press(surface, 100.0, place[i : i + 1], mean_kpa=float(level[i])).as_taxels(1.5).pressure_kpa[0]
        np.testing.assert_allclose(frames("plane-strain")[i], np.repeat(direct[:, None], 26, axis=1), rtol=1e-6)
        assert frames("plane-strain")[i].mean() == pytest.approx(level[i], rel=1e-9)


def test_the_empirical_frames_are_eqs_1_to_4() -> None:
    """Their parts by the printed formulas, from the fitted numbers; scaled with the level."""
    time = frame_times(SCENE)
    place, level = head_poses(SCENE, time)[1][:, 0] - 3.0, level_kpa(SCENE.background, time)
    model, s = PlaneSection.of(SCENE, "empirical").empirical_model(condense(Body(15.0, 1.0, 0.0)))
    p1 = model.peak_kpa * np.sqrt(1 - model.curvature_per_mm2 * s**2)
    largest = max(model.peak_kpa, model.peak_kpa * np.sqrt(1 - model.curvature_per_mm2 * 12.0**2))
    for i in (12, 20, 33):
        bump = model.height_kpa * np.exp(-((s + place[i]) ** 2) / (2 * model.width_mm**2))
        printed = bump * (p1 / largest) ** 2 + kappa(place[i : i + 1], d_mm=15.0) * p1
        np.testing.assert_allclose(frames("empirical")[i, :, 7], printed * level[i] / 9.5, rtol=1e-9)


def test_a_turned_head_has_its_columns_at_different_places() -> None:
    turned = replace(SCENE, strokes=replace(SCENE.strokes, yaw_deg=20.0))
    time = frame_times(turned)[25:26]
    found = frames_of(turned, time)[0]
    rotation, origin = head_poses(turned, time)
    level = float(level_kpa(turned.background, time)[0])
    surface = condense(Body(15.0, 1.0, 0.0))
    for column in (0, 25):
        x = origin[0, 0] - 3.0 + rotation[0, 0, 1] * (column - 12.5) * 1.5
        direct = press(surface, 100.0, np.array([x]), mean_kpa=level).as_taxels(1.5).pressure_kpa[0]
        np.testing.assert_allclose(found[:, column], direct, atol=2e-3 * level)
    assert np.abs(found[:, 0] - found[:, 25]).max() > 0.05 * level


def test_without_a_lump_every_frame_is_that_of_the_layers() -> None:
    bare = replace(SCENE, solid_lumps=(), body=SceneBody(fat_mm=10.0))
    found = frames_of(bare, np.array([0.1, 0.15]))
    level = level_kpa(bare.background, np.array([0.15]))[0]
    plain = press_layers(Layers(10.0), head=HeadSection(), mean_kpa=float(level)).as_taxels(1.5).pressure_kpa[0]
    np.testing.assert_allclose(found[1], np.repeat(plain[:, None], 26, axis=1), rtol=1e-9)


def test_the_truth_names_the_model_and_its_shape() -> None:
    short = replace(SCENE, duration_s=0.06)
    for fidelity in ("empirical", "plane-strain"):
        truth = simulate(short, rng=np.random.default_rng(0), fidelity=fidelity).truth
        assert truth["model"] == fidelity
        assert truth["shape"].startswith("a cylinder along y")
        assert truth["lumps"][0]["d_mm"] == 15.0
        assert truth["body"]["fat_mm"] == 15.0


def test_the_counts_are_the_models_frames_rounded() -> None:
    scan = simulate(SCENE, rng=np.random.default_rng(0), fidelity="plane-strain").scan
    np.testing.assert_allclose(scan.pressure_kpa(), frames("plane-strain"), atol=0.51 * 34 / 4095)


BALL = SolidLump(seat=0.0)
IMPOSSIBLE = {
    "two lumps": ({"solid_lumps": (BALL, replace(BALL, x_mm=30.0))}, "the scene has 2 lumps; the .* solid"),
    "rib": (
        {"ribs": (Rib(),)},
        "the scene has a rib; .* one lump and no rib; use --fidelity solid",
    ),
    "spheroid": (
        {"solid_lumps": (replace(BALL, height_mm=9.0),)},
        r"lump\[0\].height_mm is 9; .* circle",
    ),
    "above the gland": ({"solid_lumps": (replace(BALL, seat=3.0),)}, r"seats lump\[0\] at 3; .* 0 to 2"),
    "in the gland": (
        {"solid_lumps": (replace(BALL, seat=None),), "body": SceneBody(fat_mm=10.0)},
        r"the gland lies 10 mm deep, which seats lump\[0\] at -0.667",
    ),
    "hardly any skin": (
        {"solid_lumps": (replace(BALL, depth_ratio=0.515),)},
        r"lump\[0\]: depth_ratio is 0.515",
    ),
    "strokes off the mesh": (
        {"strokes": Strokes(half_length_mm=150.0)},
        "strokes.half_length_mm 150.*mesh reaches",
    ),
    "head wider than the mesh": (
        {"head": scene_types.Head(rows=200, radius_mm=500.0)},
        "a head 300 mm wide.*the mesh reaches 142 mm: shorten the strokes or narrow the head",
    ),
    "bump": (
        {"solid_lumps": (), "body": None, "lumps": (Lump(),)},
        r"lump\[0\] gives no depth_ratio",
    ),
}


@pytest.mark.parametrize("fidelity", ["empirical", "plane-strain"])
@pytest.mark.parametrize("name", IMPOSSIBLE)
def test_a_scene_that_two_dimensions_cannot_model_is_one_line(name: str, fidelity: str) -> None:
    changes, words = IMPOSSIBLE[name]
    with pytest.raises(BadDataError, match=words) as caught:
        simulate(replace(SCENE, **changes), rng=np.random.default_rng(0), fidelity=fidelity)
    assert "\n" not in str(caught.value)


def test_the_command_says_what_its_model_is(run_cli: Run, tmp_path: Path) -> None:
    (tmp_path / "s.toml").write_text("[scene]\nduration_s = 0.1\n[body]\n[[lump]]\nd_mm = 15\ndepth_ratio = 1\n")
    done = run_cli("simulate", "s.toml", "-o", "a.mcap", "--fidelity", "plane-strain", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "model plane-strain: a cylinder along y: each frame's profile across the head is repeated" in done.stdout
    truth = read_scan_report(tmp_path / "a.mcap").truth
    assert truth is not None
    assert truth["model"] == "plane-strain"
