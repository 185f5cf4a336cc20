"""The bump averaged over cells against exact integrals, and the coordinates of its widths against linear algebra."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from posterior_maps import covariance
from scipy.integrate import dblquad
from scipy.linalg import expm
from scipy.special import erf

from tactile_bayes.posterior.bump import cell_mean_gaussian, covariance_from_log_widths, principal_widths

DOCUMENTED_ERROR = 3e-5  # at cells of 0.75 sigma


def exact_line(u: np.ndarray, *, sigma: float, cell: float) -> np.ndarray:
    """Mean of exp(-u^2 / (2 sigma^2)) over cells of a line."""
    ends = erf((u + cell / 2) / (sigma * np.sqrt(2))) - erf((u - cell / 2) / (sigma * np.sqrt(2)))
    return sigma * np.sqrt(np.pi / 2) * ends / cell


def grid() -> tuple[np.ndarray, np.ndarray]:
    """Places out to five widths of 4 mm."""
    axis = np.arange(-20.0, 20.25, 0.25)
    u, v = np.meshgrid(axis, axis)
    return u.ravel(), v.ravel()


def axis_error(cell: float, *, sigma_x: float = 4.0, sigma_y: float = 4.0) -> float:
    u, v = grid()
    exact = exact_line(u, sigma=sigma_x, cell=cell) * exact_line(v, sigma=sigma_y, cell=cell)
    ours = cell_mean_gaussian(u, v, covariance_mm2=covariance(sigma_x, sigma_y), cell_mm=cell)
    return float(np.abs(ours - exact).max())


@pytest.mark.parametrize("sigma_y", [4.0, 7.0])
def test_cell_means_are_those_of_the_error_function(sigma_y: float) -> None:
    assert axis_error(3.0, sigma_y=sigma_y) < DOCUMENTED_ERROR


def test_the_error_falls_with_the_sixth_power_of_the_cell() -> None:
    order = np.log2(axis_error(3.0) / axis_error(1.5))
    assert 5.5 < order < 6.5


def test_the_value_at_the_centre_of_a_cell_is_not_good_enough() -> None:
    u, v = grid()
    exact = exact_line(u, sigma=4.0, cell=3.0) * exact_line(v, sigma=4.0, cell=3.0)
    at_centre = cell_mean_gaussian(u, v, covariance_mm2=covariance(4.0, 4.0), cell_mm=0.0)
    assert np.abs(at_centre - exact).max() > 500 * DOCUMENTED_ERROR


@pytest.mark.parametrize(("u", "v"), [(0.0, 0.0), (2.5, -1.0), (-4.0, 5.0)])
def test_turned_cell_means_are_those_of_quadrature(u: float, v: float) -> None:
    shape, cell = covariance(6.0, 4.0, 35.0), 3.0
    precision = np.linalg.inv(shape)

    def height(y: float, x: float) -> float:
        return float(np.exp(-0.5 * np.array([x, y]) @ precision @ np.array([x, y])))

    h = cell / 2
    exact = dblquad(height, u - h, u + h, v - h, v + h, epsabs=1e-9)[0] / cell**2
    ours = cell_mean_gaussian(np.array([u]), np.array([v]), covariance_mm2=shape, cell_mm=cell)[0]
    assert ours == pytest.approx(exact, abs=DOCUMENTED_ERROR)


def test_points_are_equation_7() -> None:
    u, v = grid()
    ours = cell_mean_gaussian(u, v, covariance_mm2=covariance(4.0, 6.0), cell_mm=0.0)
    np.testing.assert_allclose(ours, np.exp(-(u**2) / (2 * 4.0**2) - v**2 / (2 * 6.0**2)), rtol=1e-12)


def test_leading_axes_are_those_of_the_covariance() -> None:
    shapes = np.stack([covariance(4.0, 6.0), covariance(5.0, 3.0, 20.0)])
    u, v = np.array([0.0, 1.0, 4.0]), np.array([0.0, -2.0, 1.0])
    both = cell_mean_gaussian(u, v, covariance_mm2=shapes, cell_mm=1.0)
    one = [cell_mean_gaussian(u, v, covariance_mm2=shape, cell_mm=1.0) for shape in shapes]
    np.testing.assert_allclose(both, one, rtol=1e-14)


LOGS = st.floats(-1.0, 1.0)


@given(p=st.floats(-1.0, 3.0), q=LOGS, r=LOGS)
def test_the_covariance_is_the_square_of_a_matrix_exponential(p: float, q: float, r: float) -> None:
    root = expm(np.array([[p + q, r], [r, p - q]]))
    ours = covariance_from_log_widths(np.array(p), np.array(q), np.array(r))
    np.testing.assert_allclose(ours, root @ root, rtol=1e-10, atol=1e-12)


@given(p=st.floats(-1.0, 3.0), q=LOGS, r=LOGS)
def test_widths_and_angle_are_those_of_the_eigenvectors(p: float, q: float, r: float) -> None:
    args = np.array(p), np.array(q), np.array(r)
    sigma_x, sigma_y, angle = (float(value) for value in principal_widths(*args))
    values = np.linalg.eigvalsh(covariance_from_log_widths(*args))
    np.testing.assert_allclose(np.sort([sigma_x**2, sigma_y**2]), values, rtol=1e-9)
    assert -np.pi / 4 - 1e-12 <= angle <= np.pi / 4 + 1e-12
    rebuilt = covariance(sigma_x, sigma_y, np.degrees(angle))
    np.testing.assert_allclose(rebuilt, covariance_from_log_widths(*args), rtol=1e-9, atol=1e-9 * values[1])


@given(p=st.floats(-1.0, 3.0), q=LOGS.filter(lambda q: abs(q) > 1e-6), r=LOGS)
def test_a_quarter_turn_swaps_the_widths(p: float, q: float, r: float) -> None:
    before = principal_widths(np.array(p), np.array(q), np.array(r))
    after = principal_widths(np.array(p), np.array(-q), np.array(-r))
    np.testing.assert_allclose([after[0], after[1], after[2]], [before[1], before[0], before[2]], rtol=1e-12)


@given(direction=st.floats(0.0, 2 * np.pi), small=st.floats(0.0, 1e-7))
def test_the_covariance_is_smooth_through_round(direction: float, small: float) -> None:
    q, r = small * np.cos(direction), small * np.sin(direction)
    ours = covariance_from_log_widths(np.array(1.0), np.array(q), np.array(r))
    linear = np.exp(2.0) * np.array([[1 + 2 * q, 2 * r], [2 * r, 1 - 2 * q]])
    np.testing.assert_allclose(ours, linear, rtol=0.0, atol=1e-12)
