"""Lumps that are no balls: the axisymmetric answer, the first-order limit, turning, symmetry and sign of energy."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from tactile_bayes.errors import BadDataError
from tactile_bayes.forward.lump_shape import LumpShape
from tactile_bayes.forward.solid.axisymmetric import Tissue, condense_lump
from tactile_bayes.forward.solid.frames import SkinChange, skin_perturbation
from tactile_bayes.forward.solid.inclusion import Rings, families
from tactile_bayes.forward.solid.mesh import LumpGeometry, MeshSize
from tactile_bayes.forward.solid.shaped import SHAPE_MESH, ShapedLump, ShapePerturbation, hull_of, shaped_lump
from tactile_bayes.geometry import FloatArray

TISSUE = Tissue()
COARSE = MeshSize(arc=12, core=4)
PLACE = np.array([(x + 0.3, y + 0.2) for x in np.arange(-18.0, 19.0, 6.0) for y in np.arange(-18.0, 19.0, 6.0)])
FLAT = LumpShape((8.0, 5.0, 5.0))


def change(perturbation: SkinChange, place: FloatArray = PLACE) -> FloatArray:
    """Change of the compliance between points of the skin."""
    value, sign = perturbation.vectors(place[:, 0], place[:, 1])
    return (value * sign) @ value.T


@cache
def flat_lump(orders: int = 5) -> ShapedLump:
    return shaped_lump(FLAT, TISSUE, depth_mm=12.0, fat_mm=14.0, thickness_mm=50.0, size=COARSE, orders=orders)


@cache
def flat(kpa: float) -> ShapePerturbation:
    return flat_lump().perturbation(kpa)


@pytest.mark.parametrize(
    "geometry",
    [LumpGeometry(7.5, 7.5, 15.0, 15.0, 70.0), LumpGeometry(7.5, 7.5, 12.0, 15.75, 70.0)],
    ids=["centred", "half seated"],
)
def test_a_ball_as_a_shape_is_the_axisymmetric_ball(geometry: LumpGeometry) -> None:
    """Reference: the ball's own path, whose tests hold it to exact solutions; here block by block of the orders."""
    shape = LumpShape((geometry.radius_mm,) * 3)
    size, orders = MeshSize(core=6), 4
    lump = shaped_lump(
        shape,
        TISSUE,
        depth_mm=geometry.depth_mm,
        fat_mm=geometry.fat_mm,
        thickness_mm=geometry.thickness_mm,
        size=size,
        orders=orders,
    )
    ball = skin_perturbation(condense_lump(geometry, TISSUE, size=size, orders=orders), 500.0)
    expected = change(ball)
    assert np.abs(change(lump.perturbation(500.0)) - expected).max() < 0.005 * np.abs(expected).max()
    even, odd = lump.matrices(500.0)
    s = len(lump.around.radius_mm)
    for m in range(1, orders):  # both families carry the same axisymmetric answer; no order acts on another
        at, other = slice(m * s, (m + 1) * s), slice(0, s)
        assert np.abs(even[at, at] - odd[at, at]).max() < 1e-9 * np.abs(even).max()
        assert np.abs(even[at, other]).max() < 1e-9 * np.abs(even).max()
    assert np.abs(odd[:s]).max() < 1e-12


def test_a_spheroid_in_a_hull_of_another_form_is_the_axisymmetric_spheroid() -> None:
    """Reference: the spheroid's own mesh. The layers' boundary cuts lump and hull at different angles."""
    geometry = LumpGeometry(5.0, 7.5, 13.0, 17.0, 70.0)
    hull = LumpGeometry(9.0, 8.5, 13.0, 17.0, 70.0)
    expected = change(skin_perturbation(condense_lump(geometry, TISSUE, orders=4), 300.0))
    lump = shaped_lump(
        LumpShape((5.0, 5.0, 7.5)),
        TISSUE,
        depth_mm=13.0,
        fat_mm=17.0,
        thickness_mm=70.0,
        size=MeshSize(core=6),
        orders=4,
        hull=hull,
    )
    assert np.abs(change(lump.perturbation(300.0)) - expected).max() < 0.015 * np.abs(expected).max()


def test_a_faint_ellipsoid_is_the_sum_of_the_small_balls_that_fill_it() -> None:
    """Reference: to first order in the contrast each part of a lump acts as if it were alone (Born)."""
    a, b, depth, small, kpa = 8.0, 4.0, 14.0, 0.8, 5.5
    shape = LumpShape((a, b, b))
    lump = shaped_lump(shape, TISSUE, depth_mm=depth, fat_mm=35.0, thickness_mm=60.0, orders=6)
    got = change(lump.perturbation(kpa))
    node, weight = np.polynomial.legendre.leggauss(5)
    expected = np.zeros_like(got)
    for zeta, w in zip(node, weight, strict=True):
        ball = LumpGeometry(small, small, depth + b * zeta, 35.0, 60.0)
        around = skin_perturbation(condense_lump(ball, TISSUE, orders=3), kpa, tolerance=1e-9)
        # an ellipse of the section, by Gauss points in radius and even ones in angle
        for u, v in zip(node, weight, strict=True):
            rho, ring = np.sqrt((1 + u) / 2), v / 2 / 12
            for angle in np.arange(12) * (np.pi / 6):
                centre = np.sqrt(1 - zeta**2) * rho * np.array([a * np.cos(angle), b * np.sin(angle)])
                volume = w * b * ring * np.pi * a * b * (1 - zeta**2)
                expected += volume / (4 / 3 * np.pi * small**3) * change(around, PLACE - centre)
    assert np.abs(got - expected).max() < 0.03 * np.abs(expected).max()
    assert np.abs(got - got.mean()).max() > 0.3 * np.abs(got).max()  # the comparison is not of one number


def test_turning_the_body_of_a_shape_is_turning_the_coordinates() -> None:
    """The turned lump is solved anew with sines and cosines coupled, and must answer at the turned places."""
    lump = flat_lump()
    turn = 0.7
    c, s = np.cos(turn), np.sin(turn)

    def turned(direction: FloatArray) -> FloatArray:
        x, y, z = np.moveaxis(direction, -1, 0)
        return FLAT.radius_mm(np.stack([c * x + s * y, c * y - s * x, z], axis=-1))

    anew = replace(
        lump, inclusion=replace(lump.inclusion, radius=turned), families=families(5, symmetric=False)
    ).perturbation(300.0)
    expected = change(flat(300.0).turned(turn))
    scale = np.abs(expected).max()
    assert np.abs(change(anew) - expected).max() < 1e-4 * scale
    assert np.abs(change(flat(300.0)) - expected).max() > 0.05 * scale  # the turn is seen


def test_a_stiffer_lump_only_stiffens_and_a_softer_one_only_softens() -> None:
    lump = flat_lump()
    # without the gland in it, which a lump of 10 kPa would soften
    in_fat = shaped_lump(FLAT, TISSUE, depth_mm=12.0, fat_mm=30.0, thickness_mm=50.0, size=COARSE, orders=5)
    for kpa, sign in ((50.0, -1.0), (1.0, 1.0)):
        for matrix in in_fat.matrices(kpa):
            value = np.linalg.eigvalsh(sign * matrix)
            assert value[0] > -2e-3 * value[-1]
    softer, stiffer = (np.diag(change(lump.perturbation(kpa))) for kpa in (100.0, 1000.0))
    assert (stiffer < softer + 1e-6 * np.abs(softer).max()).all()


def test_the_change_is_reciprocal_and_as_symmetric_as_the_lump() -> None:
    mirrored = change(flat(300.0), PLACE * np.array([1.0, -1.0]))
    expected = change(flat(300.0))
    assert np.allclose(expected, expected.T, rtol=0, atol=1e-12 * np.abs(expected).max())
    assert np.allclose(mirrored, expected, rtol=0, atol=1e-12 * np.abs(expected).max())
    for matrix in flat_lump().matrices(300.0):
        assert np.abs(matrix - matrix.T).max() == 0


@pytest.mark.slow
@pytest.mark.parametrize(
    "shape",
    [
        LumpShape((10.0, 5.0, 5.0)),
        LumpShape((9.0, 5.0, 5.0), pair=True),
        LumpShape((7.5, 7.5, 7.5), lobes=3, lobe_share=0.2),
        LumpShape((9.0, 6.0, 6.0), tilt_rad=0.6),
    ],
    ids=["flat", "pair", "lobed", "tilted"],
)
def test_finer_meshes_and_more_orders_change_a_shape_by_less_than_one_per_cent(shape: LumpShape) -> None:
    def at(size: MeshSize, rings: Rings | None, orders: int | None) -> FloatArray:
        lump = shaped_lump(
            shape, TISSUE, depth_mm=12.0, fat_mm=14.0, thickness_mm=60.0, size=size, rings=rings, orders=orders
        )
        return change(lump.perturbation(200.0))

    fine = at(MeshSize(arc=24, core=6, rings=8), Rings(2, 3), 11)
    assert np.abs(at(SHAPE_MESH, None, None) - fine).max() < 0.01 * np.abs(fine).max()


def test_a_hull_holds_the_shape_and_keeps_off_the_skin() -> None:
    shape = LumpShape((9.0, 6.0, 6.0), tilt_rad=0.6)
    hull = hull_of(shape, depth_mm=12.0, fat_mm=14.0, thickness_mm=60.0)
    points = shape.points_mm()
    inside = (np.hypot(points[:, 0], points[:, 1]) / hull.radius_mm) ** 2 + (points[:, 2] / hull.half_height_mm) ** 2
    assert inside.max() < 1.0
    with pytest.raises(BadDataError, match=r"its centre must lie 7\.7\d* mm or more"):
        hull_of(shape, depth_mm=7.5, fat_mm=14.0, thickness_mm=60.0)
