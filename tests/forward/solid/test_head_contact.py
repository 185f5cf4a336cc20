"""The head's contact against Hertz, against a plain solver, and the conditions it must meet to rounding."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import nnls

from tactile_bayes.errors import BadDataError
from tactile_bayes.forward.axisymmetric import taxel_compliance
from tactile_bayes.forward.contact import ContactStiffness, FactoredCompliance, solve_contact
from tactile_bayes.forward.scene import Head
from tactile_bayes.forward.simulate import head_face
from tactile_bayes.forward.tissue import Layers

NU = 0.495
HALF_SPACE = Layers(4000.0, 9000.0, 5.0, 1.0, NU)  # as good as one under a head of a few millimetres
E_STAR = 5.0 / (1 - NU**2)


def squares(n: int, pitch: float) -> tuple[np.ndarray, np.ndarray]:
    x = (np.arange(n) - (n - 1) / 2) * pitch
    xx, yy = np.meshgrid(x, x, indexing="ij")
    return xx.ravel(), yy.ravel()


def small_body(n: int = 7) -> np.ndarray:
    return taxel_compliance(Layers(8.0, 38.0, poisson=NU), rows=n, columns=n, pitch_mm=1.5)


def test_a_sphere_presses_as_hertz_says() -> None:
    """Johnson (1985) eq. 4.22-4.24: a^3 = 3 P R / 4 E*, p0 = 3 P / 2 pi a^2, depth = a^2 / R."""
    pitch, radius, force = 0.5, 50.0, 60.0
    x, y = squares(33, pitch)
    body = ContactStiffness.of(taxel_compliance(HALF_SPACE, rows=33, columns=33, pitch_mm=pitch))
    contact = solve_contact(body, (x**2 + y**2) / (2 * radius), mean_kpa=force / (len(x) * pitch**2))
    a = (0.75 * force * radius / E_STAR) ** (1 / 3)
    assert 3.0 < a < 8.0
    peak = 1.5 * force / (np.pi * a**2)
    hertz = peak * np.sqrt(np.clip(1 - (x**2 + y**2) / a**2, 0, None))
    inner = np.hypot(x, y) < 0.85 * a
    np.testing.assert_allclose(contact.pressure_kpa[inner], hertz[inner], rtol=0.01)
    assert contact.pressure_kpa.max() == pytest.approx(peak, rel=0.005)
    assert contact.depth_mm == pytest.approx(a**2 / radius, rel=0.01)
    assert contact.touching.sum() * pitch**2 == pytest.approx(np.pi * a**2, rel=0.05)


@pytest.mark.slow
def test_a_long_cylinder_presses_as_hertz_says() -> None:
    """Johnson (1985) eq. 4.43-4.45, in the middle of a strip long against its width: a^2 = 4 P' R / pi E*."""
    rows, columns, pitch, radius = 20, 120, 0.5, 40.0
    x = np.repeat((np.arange(rows) - (rows - 1) / 2) * pitch, columns)
    body = ContactStiffness.of(taxel_compliance(HALF_SPACE, rows=rows, columns=columns, pitch_mm=pitch))
    contact = solve_contact(body, x**2 / (2 * radius), mean_kpa=0.4)
    middle = contact.pressure_kpa.reshape(rows, columns)[:, columns // 2]
    line = middle.sum() * pitch
    a = np.sqrt(4 * line * radius / (np.pi * E_STAR))
    expected = 2 * line / (np.pi * a) * np.sqrt(np.clip(1 - (x[::columns] / a) ** 2, 0, None))
    inner = np.abs(x[::columns]) < 0.8 * a
    np.testing.assert_allclose(middle[inner], expected[inner], rtol=0.03)


def test_a_flat_punch_presses_most_at_its_edge_and_without_a_gap() -> None:
    contact = solve_contact(ContactStiffness.of(small_body()), np.zeros(49), mean_kpa=3.0)
    pressure = contact.pressure_kpa.reshape(7, 7)
    assert contact.touching.all()
    assert pressure[0, 0] > pressure[0, 3] > pressure[3, 3]
    np.testing.assert_allclose(small_body() @ contact.pressure_kpa, contact.depth_mm, rtol=1e-10)


@given(
    heights=st.lists(st.floats(0, 6), min_size=49, max_size=49),
    mean=st.floats(1e-3, 30.0),
    start=st.lists(st.booleans(), min_size=49, max_size=49),
)
def test_every_contact_is_complementary_and_bears_its_force(
    heights: list[float], mean: float, start: list[bool]
) -> None:
    compliance, height = small_body(), np.array(heights)
    contact = solve_contact(ContactStiffness.of(compliance), height, mean_kpa=mean, touching=np.array(start))
    p, gap = contact.pressure_kpa, contact.gap_mm
    scale = max(contact.depth_mm, 1e-9)
    assert p.min() >= -1e-9 * mean
    assert gap.min() >= -1e-9 * scale
    assert np.abs(p * gap).max() <= 1e-8 * mean * scale
    assert p.mean() == pytest.approx(mean, rel=1e-9)
    np.testing.assert_allclose(compliance @ p + height - contact.depth_mm, gap, atol=1e-9 * scale)


@pytest.mark.parametrize("kind", [ContactStiffness, FactoredCompliance])
def test_the_answer_is_that_of_non_negative_least_squares(kind: type[ContactStiffness | FactoredCompliance]) -> None:
    """At its depth the contact minimises p C p / 2 - p (depth - height) over p >= 0: NNLS of a Cholesky factor."""
    rng = np.random.default_rng(3)
    compliance, height = small_body(), rng.uniform(0, 5, 49)
    contact = solve_contact(kind.of(compliance), height, mean_kpa=1.0)
    assert 0 < contact.touching.sum() < 49
    upper = np.linalg.cholesky(compliance).T
    other, _ = nnls(upper, np.linalg.solve(upper.T, contact.depth_mm - height))
    np.testing.assert_allclose(contact.pressure_kpa, other, atol=1e-8)


def test_only_the_counted_squares_bear_the_mean() -> None:
    counted = np.zeros(49, dtype=bool)
    counted[10:30] = True
    contact = solve_contact(ContactStiffness.of(small_body()), np.zeros(49), mean_kpa=2.0, counted=counted)
    assert contact.pressure_kpa[counted].mean() == pytest.approx(2.0)


def test_a_low_rank_change_is_the_changed_matrix() -> None:
    rng = np.random.default_rng(0)
    compliance, height = small_body(), rng.uniform(0, 1, 49)
    vectors, signs = 0.02 * rng.standard_normal((49, 5)), np.array([-1.0, -1.0, 1.0, -1.0, 1.0])
    quick = solve_contact(ContactStiffness.of(compliance).changed(vectors, signs), height, mean_kpa=1.0)
    plain = solve_contact(ContactStiffness.of(compliance + (vectors * signs) @ vectors.T), height, mean_kpa=1.0)
    np.testing.assert_allclose(quick.pressure_kpa, plain.pressure_kpa, atol=1e-9)
    assert quick.depth_mm == pytest.approx(plain.depth_mm, rel=1e-10)


def test_a_skin_without_compliance_left_is_refused() -> None:
    with pytest.raises(BadDataError, match="too close together for this model"):
        ContactStiffness.of(small_body()).changed(np.ones((49, 1)), np.array([-1.0]))
    with pytest.raises(BadDataError, match="not positive definite"):
        ContactStiffness.of(-small_body())


def test_a_head_that_is_not_pressed_hangs_over_the_skin() -> None:
    height = np.linspace(0.5, 3, 49)
    contact = solve_contact(ContactStiffness.of(small_body()), height, mean_kpa=0.0)
    assert contact.depth_mm == 0.5
    assert not contact.touching.any()
    with pytest.raises(BadDataError, match="not pull"):
        solve_contact(ContactStiffness.of(small_body()), height, mean_kpa=-1.0)


def test_the_rim_is_tangent_to_the_face_and_feels_nothing() -> None:
    taxels = Head().surface_mm()
    surface, sensing = head_face(Head(radius_mm=35.0, rim_mm=3.0))
    assert sensing.shape == (18, 30)
    np.testing.assert_array_equal(surface[sensing].reshape(16, 26, 3), taxels)
    across = surface[:, 15]
    centre = 32.0 * np.array([12 / 35, np.sqrt(1 - (12 / 35) ** 2)]) - [0.0, 35.0]
    assert np.hypot(*(across[-1, [0, 2]] - centre)) == pytest.approx(3.0)
    along = surface[9, :, 2] - surface[9, 15, 2]
    np.testing.assert_allclose(along[:3], [np.sqrt(9 - 2.25**2) - 3, np.sqrt(9 - 0.75**2) - 3, 0.0], atol=1e-12)
    bare, _ = head_face(Head(radius_mm=35.0, rim_mm=0.0))
    np.testing.assert_array_equal(bare, taxels)
