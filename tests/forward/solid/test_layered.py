"""The layered body's surface against closed forms, another program's algebra, and what must not change it."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import dblquad, quad
from scipy.special import j0

from tactile_bayes.forward.axisymmetric import (
    layering_compliance,
    skin_flexibility,
    square_compliance,
    taxel_compliance,
)
from tactile_bayes.forward.tissue import Layers

NU = 0.495
INCOMPRESSIBLE = 0.5 - 1e-14
BREAST = Layers(15.0, poisson=NU)
DEEP = 9999.0  # mm; to the waves of a millimetre or a hundred a half-space
WAVES = np.geomspace(0.01, 20.0, 40)


def half_space(k: np.ndarray, modulus: float = 5.0, nu: float = NU) -> np.ndarray:
    return 2 * (1 - nu**2) / (modulus * k)


def bonded_layer(k: np.ndarray, modulus: float, thickness: float) -> np.ndarray:
    """An incompressible layer bonded to a rigid base: hyperbolic closed form."""
    kh, shear = k * thickness, modulus / 3
    return (np.sinh(2 * kh) - 2 * kh) / (np.cosh(2 * kh) + 1 + 2 * kh**2) / (2 * shear * k)


@pytest.mark.parametrize("fat_mm", [15.0, 4000.0])
def test_deep_layers_of_one_tissue_are_a_half_space(fat_mm: float) -> None:
    deep = Layers(fat_mm, DEEP, 5.0, 1.0, NU)
    np.testing.assert_allclose(skin_flexibility(WAVES, deep)[:, 1, 1], half_space(WAVES), rtol=1e-9)
    # a half-space of fat is taken off, and its own base lifts what is left by about 0.2 (mm kPa) / 10 m
    np.testing.assert_allclose(layering_compliance(np.array([0.0, 3.0, 60.0]), deep), 0.0, atol=1e-5)


@pytest.mark.parametrize("share", [0.2, 0.5, 0.9])
def test_an_incompressible_layer_is_the_closed_form_wherever_it_is_split(share: float) -> None:
    k = np.geomspace(0.01, 5.0, 30)
    np.testing.assert_allclose(skin_flexibility(k, rubber(3.0 * share))[:, 1, 1], bonded_layer(k, 7.0, 3.0), rtol=1e-9)


def rubber(fat_mm: float) -> Layers:
    """Two layers of one tissue, 3 mm of 7 kPa, as good as incompressible."""
    return Layers(fat_mm, 3.0, 7.0, 1.0, INCOMPRESSIBLE)


def test_a_slip_of_nu_from_a_half_is_a_slip_of_the_answer() -> None:
    exact, near = (skin_flexibility(WAVES, Layers(15.0, poisson=nu))[:, 1, 1] for nu in (INCOMPRESSIBLE, 0.4999999))
    np.testing.assert_allclose(near, exact, rtol=1e-4)


def plane_transfer(k_per_mm: np.ndarray, layers: Layers) -> np.ndarray:
    """The skin's displacement under a pressure cos kx, by eight waves of plane strain and the conditions on them.

    In each layer the displacements are combinations of e^-kz, z e^-kz and of the same measured from the layer's floor
    (Johnson 1985, section 2.2).
    """
    k = np.asarray(k_per_mm, dtype=np.float64)
    nu, fat = layers.poisson, layers.fat_mm
    gland = layers.thickness_mm - fat
    # Depths are scaled by 1/k: one matrix for each wave number.
    top0, top1 = layer_waves(k, 0.0, fat, nu, 1.0), layer_waves(k, fat, fat, nu, 1.0)
    low0 = layer_waves(k, 0.0, gland, nu, layers.gland_ratio)
    low1 = layer_waves(k, gland, gland, nu, layers.gland_ratio)
    system = np.zeros((len(k), 8, 8))
    system[:, 0:2, :4] = top0[:, 2:4]
    system[:, 2:6, :4] = top1
    system[:, 2:6, 4:] = -low0
    system[:, 6:8, 4:] = low1[:, 0:2]
    load = np.zeros((len(k), 8, 1))
    load[:, 1, 0] = -1.0 / layers.fat_kpa
    solution = np.linalg.solve(system, load)[..., 0]
    return np.asarray(np.einsum("nj,nj->n", top0[:, 1], solution[:, :4]) / k)


def layer_waves(k: np.ndarray, z_mm: float, height_mm: float, nu: float, young: float) -> np.ndarray:
    """(n, 4, 4) rows u_x k, u_z k, shear and normal stress of the four solutions of a layer at depth `z_mm` in it.

    u_x goes with sin kx, the other displacement and sigma_zz with cos kx; stresses per unit of fat modulus.
    """
    mu = young / (2 * (1 + nu))
    up, down = np.exp(-k * z_mm), np.exp(-k * (height_mm - z_mm))
    z, rest = k * z_mm, k * (height_mm - z_mm)
    bulk = 3 - 4 * nu
    one = np.ones_like(k)
    shear, normal = 2 - 4 * nu, 4 - 4 * nu
    first = np.stack([one, one, -2 * mu * one, -2 * mu * one], axis=1)
    second = np.stack([z, z + bulk, -mu * (2 * z + shear), -mu * (2 * z + normal)], axis=1)
    # Turned upside down, u_z and the shear change sign.
    third = np.stack([one, -one, 2 * mu * one, -2 * mu * one], axis=1)
    fourth = np.stack([rest, -(rest + bulk), mu * (2 * rest + shear), -mu * (2 * rest + normal)], axis=1)
    columns = (first * up[:, None], second * up[:, None], third * down[:, None], fourth * down[:, None])
    return np.stack(columns, axis=2)


@pytest.mark.parametrize("nu", [0.0, 0.3, 0.495])
def test_plane_and_axisymmetric_waves_are_one(nu: float) -> None:
    layers = Layers(12.0, 70.0, 5.0, 8.0, nu)
    np.testing.assert_allclose(skin_flexibility(WAVES, layers)[:, 1, 1], plane_transfer(WAVES, layers), rtol=1e-8)


@pytest.mark.parametrize("r", [0.0, 1.0, 8.0, 40.0])
def test_the_hankel_transform_is_that_of_adaptive_quadrature(r: float) -> None:
    body = rubber(1.5)

    def integrand(k: float) -> float:
        bracket = bonded_layer(np.array([k]), 7.0, 3.0)[0] - half_space(k, 7.0, 0.5)
        return float(bracket * j0(k * r) * k / (2 * np.pi))

    edges = np.concatenate([[1e-6], np.arange(0.25, 8.0, 0.25)])
    expected = sum(quad(integrand, a, b, epsabs=1e-13)[0] for a, b in pairwise(edges))
    scale = abs(layering_compliance(np.array([0.0]), body)[0])
    assert layering_compliance(np.array([r]), body)[0] == pytest.approx(expected, abs=2e-6 * scale)


def test_the_point_load_is_boussinesqs() -> None:
    """A square from afar is a point: w = (1 - nu^2) P / (pi E r)."""
    w = square_compliance(np.array([60.0]), np.array([80.0]), side_mm=1.5, modulus_kpa=5.0, nu=NU)[0]
    assert w == pytest.approx((1 - NU**2) * 1.5**2 / (np.pi * 5.0 * 100.0), rel=1e-4)


def test_the_uniform_square_is_love_s() -> None:
    """Johnson (1985) sec. 3.3: at the centre of a square of side 2a under p, w = 8 asinh(1) (1 - nu^2) p a / (pi E)."""
    w = square_compliance(np.zeros(1), np.zeros(1), side_mm=3.0, modulus_kpa=5.0, nu=NU)[0]
    assert w == pytest.approx(8 * np.arcsinh(1.0) * 1.5 * (1 - NU**2) / (np.pi * 5.0), rel=1e-12)
    off, _ = dblquad(lambda y, x: 1 / np.hypot(x - 4.0, y - 1.0), -1.5, 1.5, -1.5, 1.5)
    beside = square_compliance(np.array([4.0]), np.array([1.0]), side_mm=3.0, modulus_kpa=5.0, nu=NU)[0]
    assert beside == pytest.approx(off * (1 - NU**2) / (np.pi * 5.0), rel=1e-9)


def test_taxel_compliance_is_symmetric_positive_and_falls_with_distance() -> None:
    compliance = taxel_compliance(BREAST, rows=5, columns=7, pitch_mm=1.5)
    np.testing.assert_array_equal(compliance, compliance.T)
    assert np.linalg.eigvalsh(compliance).min() > 0
    assert (np.diff(compliance[0, :7]) < 0).all()
    # the mean of a uniform square over itself: 2.9732 (1 - nu^2) p s / (pi E) on a half-space
    soft = taxel_compliance(Layers(15.0, DEEP, 5.0, 1.0, NU), rows=1, columns=1, pitch_mm=1.5)[0, 0]
    assert soft == pytest.approx(2.9732 * 1.5 * (1 - NU**2) / (np.pi * 5.0), rel=2e-3)


def test_four_small_squares_are_one_large_one() -> None:
    fine = taxel_compliance(BREAST, rows=8, columns=8, pitch_mm=1.5).reshape(4, 2, 4, 2, 4, 2, 4, 2)
    merged = fine.mean(axis=(1, 3)).sum(axis=(3, 5)).reshape(16, 16)
    coarse = taxel_compliance(BREAST, rows=4, columns=4, pitch_mm=3.0)
    np.testing.assert_allclose(merged, coarse, rtol=2e-3)


def test_compliance_is_inversely_proportional_to_stiffness() -> None:
    harder = Layers(15.0, fat_kpa=15.0, poisson=NU)
    a, b = (taxel_compliance(body, rows=3, columns=4, pitch_mm=1.5) for body in (BREAST, harder))
    np.testing.assert_allclose(3 * b, a, rtol=1e-12)


def test_shear_sinks_a_half_space_ahead_by_the_closed_form_and_shears_what_pressure_sinks() -> None:
    """Johnson (1985) eq. 3.75 in wave numbers; by Betti's theorem the matrix is symmetric up to the waves' signs."""
    found = skin_flexibility(WAVES, Layers(15.0, DEEP, 5.0, 1.0, 0.3))
    np.testing.assert_allclose(found[:, 1, 0], -(1 - 2 * 0.3) * (1 + 0.3) / (5.0 * WAVES), rtol=1e-9)
    layered = skin_flexibility(WAVES, BREAST)
    np.testing.assert_allclose(layered[:, 0, 1], layered[:, 1, 0], rtol=1e-7, atol=1e-12)
    # the control: an incompressible half-space does not sink under shear, a layered body does
    rubber = skin_flexibility(WAVES, Layers(15.0, DEEP, 5.0, 1.0, INCOMPRESSIBLE))
    assert np.abs(rubber[:, 1, 0]).max() < 1e-9 * np.abs(rubber[:, 1, 1]).max()
    assert np.abs(layered[:, 1, 0]).max() > 1e-3 * np.abs(layered[:, 1, 1]).max()
