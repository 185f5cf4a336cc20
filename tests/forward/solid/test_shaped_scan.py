"""Scenes with lumps that are no balls: what the scene says, what cannot be, what the truth states."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from tactile_bayes.errors import BadDataError
from tactile_bayes.files.scene_toml import scene_from_toml
from tactile_bayes.forward.scene import Scene
from tactile_bayes.forward.simulate import simulate
from tactile_bayes.forward.solid.scan import frames_at_poses
from tactile_bayes.forward.tissue import SceneBody, SolidLump

BALL = SolidLump(d_mm=14.0, depth_ratio=0.8, stiffness_ratio=30.0)
FLAT = dataclasses.replace(BALL, width_mm=9.0, height_mm=9.0)


def over(lump: SolidLump) -> np.ndarray:
    """The frame of a level head over the lump."""
    scene = Scene(body=SceneBody(fat_mm=14.0, thickness_mm=50.0), solid_lumps=(lump,))
    pressure, _ = frames_at_poses(scene, np.eye(3)[None], np.zeros((1, 3)), mean_kpa=np.array([9.0]))
    return np.asarray(pressure[0])


def test_a_ball_is_the_same_however_it_is_turned() -> None:
    turned = dataclasses.replace(BALL, turn_deg=30.0, tilt_deg=20.0, width_mm=14.0)
    np.testing.assert_array_equal(over(turned), over(BALL))


def test_a_lying_lump_presses_along_its_first_axis() -> None:
    """Second moments of the rise over the plain head, along x (rows) and y (columns)."""
    plain = over(dataclasses.replace(BALL, stiffness_ratio=1.0, seat=None, depth_ratio=1.2))
    moments = []
    for turn in (0.0, 90.0):
        rise = np.clip(over(dataclasses.replace(FLAT, turn_deg=turn)) - plain, 0.0, None)
        row, column = (np.arange(n) - (n - 1) / 2 for n in rise.shape)
        moments.append([(rise.sum(axis=1) @ row**2) / rise.sum(), (rise.sum(axis=0) @ column**2) / rise.sum()])
    assert moments[0][0] > 1.1 * moments[1][0]
    assert moments[1][1] > 1.1 * moments[0][1]


def test_the_truth_states_the_diameters() -> None:
    lump = dataclasses.replace(FLAT, tilt_deg=40.0, turn_deg=10.0)
    scene = Scene(duration_s=0.02, body=SceneBody(), solid_lumps=(lump,))
    (told,) = simulate(scene, rng=np.random.default_rng(0)).truth["lumps"]
    across = 2 * np.hypot(7.0 * np.cos(np.radians(40)), 4.5 * np.sin(np.radians(40)))
    assert (told["largest_mm"], told["smallest_mm"]) == pytest.approx((14.0, 9.0))
    assert (told["largest_across_mm"], told["smallest_across_mm"]) == pytest.approx((across, 9.0))
    assert (told["width_mm"], told["tilt_deg"], told["turn_deg"]) == (9.0, 40.0, 10.0)


LUMP = "[[lump]]\nd_mm = 15\ndepth_ratio = 1\n"


def test_a_scene_gives_a_pair() -> None:
    (lump,) = scene_from_toml(LUMP + "pair = true\nturn_deg = 45\n").solid_lumps
    assert lump.shape.pair
    assert lump.shape.half_axes_mm[:2] == pytest.approx((7.5, 7.5 / 1.8))
    assert lump.vertical_mm == pytest.approx(15 / 1.8, rel=0.01)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("pair = true\nheight_mm = 9", r"lump\[0\].height_mm is 9 for a pair; a pair is two balls: leave it out"),
        (
            "pair = true\nwidth_mm = 5",
            r"lump\[0\].width_mm is 5 for a pair 15 mm long; .* 8.108 to 14.29 mm",
        ),
        ("width_mm = 4", r"lump\[0\] has diameters 15, 4 and 15 mm; the largest may be 3 times the smallest"),
        ("rough_share = 0.2", r"lump\[0\].rough_share is 0.2; it must be a number at least 0, at most 0.15"),
        ("lobes = 9\nlobe_share = 0.1", r"lump\[0\].lobes is 9"),
        ("width_mm = 10\namplitude = 0.2", r"lump\[0\] gives amplitude, of a bump, and depth_ratio, of tissue"),
        ("tilt = 3", r"lump\[0\].tilt is not known"),
    ],
)
def test_an_impossible_shape_is_refused_by_name(text: str, message: str) -> None:
    with pytest.raises(BadDataError, match=message):
        scene_from_toml(LUMP + text)


def test_a_shape_needs_more_room_below_the_skin_than_a_ball() -> None:
    ball = scene_from_toml("[[lump]]\nd_mm = 15\ndepth_ratio = 0.52\n")
    assert ball.solid_lumps[0].depth_ratio == 0.52
    with pytest.raises(BadDataError, match=r"lump\[0\].depth_ratio is 0.52: the lump stands out of the skin"):
        scene_from_toml("[[lump]]\nd_mm = 15\ndepth_ratio = 0.52\nwidth_mm = 12\n")


def test_the_plane_models_refuse_a_shape() -> None:
    scene = Scene(body=SceneBody(), solid_lumps=(dataclasses.replace(BALL, width_mm=9.0),))
    with pytest.raises(BadDataError, match=r"lump\[0\] has a width, a tilt or an outline; the plane-strain model"):
        simulate(scene, rng=np.random.default_rng(0), fidelity="plane-strain")
