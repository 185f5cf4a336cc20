"""The stressed simulators: without stress they are the solid model, and each stress has its closed form or its sign."""

from __future__ import annotations

import numpy as np
import pytest

from tactile_bayes.forward.scene import Scene, Strokes, head_poses, level_kpa
from tactile_bayes.forward.simulate import frames_at_poses
from tactile_bayes.forward.tissue import Layers, SceneBody, SolidLump
from validation.stress import CONTROL, STRESSES, jobs
from validation.stress_frames import Physics, VaryingLayers, shear_sinking, stressed_frames

SCENE = Scene(
    duration_s=4.0,
    body=SceneBody(),
    solid_lumps=(SolidLump(d_mm=15.0, depth_ratio=1.0, seat=0.5),),
    strokes=Strokes(lines=2, half_length_mm=30.0, tilt_deg=0.0, wander_mm=0.0),
)
TIMES = np.array([0.5, 0.9, 1.3, 2.7])


def frames(physics: Physics) -> np.ndarray:
    return stressed_frames(SCENE, TIMES, physics)[0]


def fat(slope: float) -> Physics:
    return Physics(VaryingLayers("fat", lambda u, own: own + slope * u, 0.0))


@pytest.fixture(scope="module")
def plain() -> np.ndarray:
    level = level_kpa(SCENE.background, TIMES)
    return frames_at_poses(SCENE, *head_poses(SCENE, TIMES), mean_kpa=level)[0]


@pytest.mark.long_repeats
@pytest.mark.parametrize("physics", [Physics(), fat(0.0), Physics(skin_radius_mm=1e9)], ids=["none", "even", "flat"])
def test_without_stress_the_frames_are_the_solid_models(physics: Physics, plain: np.ndarray) -> None:
    np.testing.assert_allclose(frames(physics), plain, atol=2e-5 * plain.max())


@pytest.mark.long_repeats
@pytest.mark.parametrize(
    "physics",
    [
        fat(0.1),
        Physics(skin_radius_mm=100.0),
        Physics(lag_mm=2.0),
        Physics(friction=0.3),
        Physics(local_stiffening=0.25),
        Physics(gland_stiffening=1.0),
    ],
)
def test_a_stress_changes_frames_and_keeps_the_force(physics: Physics, plain: np.ndarray) -> None:
    found = frames(physics)
    assert np.abs(found - plain).max() > 0.001 * plain.max()  # 50 times what the unstressed ones differ by
    np.testing.assert_allclose(found.mean(axis=(1, 2)), plain.mean(axis=(1, 2)), rtol=1e-9)


@pytest.mark.long
def test_thinner_fat_presses_harder_on_its_side(plain: np.ndarray) -> None:
    """Fat that deepens along +x leaves the gland nearer, and the skin stiffer, on the side of -x."""

    def skew(pressure: np.ndarray) -> np.ndarray:
        return pressure[:, 8:].mean(axis=(1, 2)) - pressure[:, :8].mean(axis=(1, 2))

    assert np.all(skew(frames(fat(0.1))) < skew(plain))
    assert np.all(skew(frames(fat(-0.1))) > skew(plain))


def test_a_shear_force_on_a_half_space_sinks_the_skin_ahead_of_it() -> None:
    """(1 - 2 nu) / (4 pi G r) straight ahead (Johnson 1985, eq. 3.75); deep even layers tend to it."""
    r, nu, modulus = np.array([1.0, 4.0, 20.0]), 0.3, 5.0
    exact = (1 - 2 * nu) * (1 + nu) / (2 * np.pi * modulus * r)
    np.testing.assert_allclose(shear_sinking(r, Layers(15.0, 2015.0, modulus, 1.0, nu)), exact, rtol=1e-3)
    np.testing.assert_allclose(shear_sinking(r, Layers(500.0, 9999.0, modulus, 1.0, nu)), exact, rtol=1e-5)


def test_every_body_has_its_control_and_two_more() -> None:
    made = list(jobs(3))
    assert len(made) == 3 * (len(STRESSES) + 2) == len(set(made))
    assert sum(name == CONTROL for name, _ in made) == 9
    moved = {name for name, one in STRESSES.items() if one.apply(SCENE, np.random.default_rng(1)) != (SCENE, Physics())}
    assert moved == set(STRESSES) - {CONTROL}
