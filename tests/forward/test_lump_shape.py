"""Shapes of lumps: radii and caliper diameters against closed forms."""

from __future__ import annotations

import numpy as np
import pytest

from tactile_bayes.forward.lump_shape import LumpShape, _extremes, _sphere

TILTED = LumpShape((9.0, 6.0, 5.0), tilt_rad=0.6)


def test_a_tilted_ellipsoid_has_its_axes_where_they_are_said_to_be() -> None:
    first = np.array([np.cos(0.6), 0.0, -np.sin(0.6)])  # z runs down, so the first axis rises
    third = np.array([np.sin(0.6), 0.0, np.cos(0.6)])
    assert TILTED.radius_mm(np.stack([first, third, [0.0, 1.0, 0.0]])) == pytest.approx([9.0, 5.0, 6.0])


def test_diameters_of_an_ellipsoid_are_those_of_the_points_on_it() -> None:
    """The closed forms against calipers over the boundary's points."""
    points = TILTED.points_mm()
    assert TILTED.diameters_mm() == pytest.approx((18.0, 10.0))
    assert _extremes(points, _sphere(1200)) == pytest.approx((18.0, 10.0), rel=5e-3)
    angle = np.arange(180) * (np.pi / 180)
    level = _extremes(points[:, :2], np.stack([np.cos(angle), np.sin(angle)], axis=-1))
    assert level == pytest.approx(TILTED.diameters_across_mm(), rel=5e-3)
    assert np.abs(points[:, 2]).max() == pytest.approx(TILTED.half_height_mm, rel=5e-3)


def test_a_pair_is_as_long_as_its_balls_together_and_as_wide_as_one() -> None:
    pair = LumpShape((9.0, 5.0, 5.0), pair=True)
    largest, smallest = pair.diameters_mm()
    assert largest == pytest.approx(18.0)
    assert smallest == pytest.approx(10.0, rel=0.01)
    groove = pair.radius_mm(np.array([0.0, 1.0, 0.0]))
    assert 3.0 < groove < 3.6  # two balls with centres 8 mm apart meet in a circle of radius 3; the groove is rounded


def test_lobes_lengthen_every_kth_direction() -> None:
    lobed = LumpShape((8.0, 8.0, 8.0), lobes=3, lobe_share=0.2)
    turn = np.array([0.0, 2 * np.pi / 3, np.pi / 3])
    around = np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=-1)
    assert lobed.radius_mm(around) == pytest.approx([9.6, 9.6, 6.4])
    assert lobed.radius_mm(np.array([0.0, 0.0, 1.0])) == pytest.approx(8.0)


def test_roughness_has_the_given_root_mean_square_and_depends_on_its_seed() -> None:
    direction = _sphere(2500)
    log = [np.log(LumpShape((8.0, 8.0, 8.0), rough_share=0.1, rough_seed=s).radius_mm(direction) / 8.0) for s in (1, 2)]
    for one in log:
        assert np.sqrt(np.mean(one**2)) == pytest.approx(0.1, rel=0.01)
        assert abs(one.mean()) < 0.001
    assert abs(np.corrcoef(log)[0, 1]) < 0.9


def test_only_balls_and_upright_spheroids_are_axisymmetric() -> None:
    assert LumpShape((8.0, 8.0, 8.0), tilt_rad=0.3).upright_spheroid
    assert LumpShape((8.0, 8.0, 5.0)).upright_spheroid
    for other in (
        TILTED,
        LumpShape((8.0, 8.0, 5.0), tilt_rad=0.3),
        LumpShape((8.0, 8.0, 8.0), rough_share=0.1),
        LumpShape((8.0, 8.0, 8.0), lobe_share=0.1, lobes=2),
    ):
        assert not other.upright_spheroid
