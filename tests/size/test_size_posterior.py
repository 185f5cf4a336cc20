"""Eq 6 draw by draw: what the joint draws carry, the axes, and where the variance comes from."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from plain_calibration import RECIPE

from tactile_bayes.declarations import replace
from tactile_bayes.errors import BadDataError
from tactile_bayes.size.draws import BumpDraws, SizePosterior
from tactile_bayes.size.eq6 import AxisCalibration, SizeCalibration, push_sizes
from tactile_bayes.size.terms import outside_domain

N = 40_000
DOMAIN = {"amplitude": (0.05, 0.8), "sigma_mm": (2.0, 9.0), "d_mm": (5.0, 25.0)}


def axis(m=2.0, b=1.0, e=0.6, f=-0.3, scatter=0.0, slope=0.0, *, rows: np.ndarray | None = None) -> AxisCalibration:
    draws = np.array([[m, b, e, f, scatter, slope]]) if rows is None else rows
    return AxisCalibration(draws, reference_amplitude=0.3, domain=DOMAIN)


X, Y = axis(), axis(m=1.5, b=2.0)


def calibration(x: AxisCalibration = X, y: AxisCalibration = Y, *, correlation: float = 0.0) -> SizeCalibration:
    return SizeCalibration(x, y, correlation, RECIPE)


def push(
    a: np.ndarray | float,
    sx: np.ndarray | float,
    sy: np.ndarray | float,
    angle: np.ndarray | float = 0.0,
    *,
    use: SizeCalibration | None = None,
) -> SizePosterior:
    arrays = [np.array(np.broadcast_to(value, (2, N // 2))) for value in (a, sx, sy, angle)]
    return push_sizes(BumpDraws(*arrays), calibration=use or calibration(), rng=np.random.default_rng(51))


def equation_6(axis: AxisCalibration, sigma: float, a: float) -> float:
    m, b, e, f = axis.draws[0, :4]
    return float(m * sigma / (e * a**f) + b)


@given(a=st.floats(0.01, 1.0), sx=st.floats(1.0, 10.0), sy=st.floats(1.0, 10.0))
def test_without_uncertainty_it_is_equation_6(a: float, sx: float, sy: float) -> None:
    found = push(a, sx, sy)
    assert found.d_x_mm[0, 0] == pytest.approx(equation_6(X, sx, a), rel=1e-12)
    assert found.d_y_mm[0, 0] == pytest.approx(equation_6(Y, sy, a), rel=1e-12)
    assert (found.max_size_mm == max(found.d_x_mm[0, 0], found.d_y_mm[0, 0])).all()
    assert (found.min_size_mm == min(found.d_x_mm[0, 0], found.d_y_mm[0, 0])).all()


def joint(rho: float) -> tuple[np.ndarray, np.ndarray]:
    """Amplitude and width, log-normal, 4 % and 4 %, with a correlation."""
    rng = np.random.default_rng(52)
    z = rng.standard_normal((2, 2, N // 2))
    z[1] = rho * z[0] + np.sqrt(1 - rho**2) * z[1]
    return 0.3 * np.exp(0.04 * z[0]), 5.0 * np.exp(0.04 * z[1])


def test_ignoring_the_correlation_of_amplitude_and_width_misstates_the_spread() -> None:
    """d ~ sigma a^-f with f = -0.3: var = s^2 (1 + f^2 - 2 f rho), so at rho = -0.47 the shuffle adds 17 %."""
    a, sigma = joint(-0.47)
    flat = axis(b=0.0)
    together = push(a, sigma, sigma, use=calibration(flat, flat)).d_x_mm
    shuffled = np.random.default_rng(53).permutation(a.ravel()).reshape(a.shape)
    apart = push(shuffled, sigma, sigma, use=calibration(flat, flat)).d_x_mm
    expected = np.sqrt((1 + 0.3**2) / (1 + 0.3**2 - 2 * 0.3 * 0.47))
    assert expected == pytest.approx(1.16, abs=0.01)
    assert apart.std() / together.std() == pytest.approx(expected, abs=0.02)


def test_swapping_the_axes_swaps_the_sizes() -> None:
    a, sigma = joint(-0.4)
    here = push(a, sigma, 0.8 * sigma, use=calibration(X, Y))
    there = push(a, 0.8 * sigma, sigma, use=calibration(Y, X))
    np.testing.assert_allclose(there.d_x_mm, here.d_y_mm, rtol=1e-12)
    np.testing.assert_allclose(there.d_y_mm, here.d_x_mm, rtol=1e-12)


def test_a_turned_ellipse_blends_the_axes() -> None:
    straight, turned, half = (push(0.3, 5.0, 4.0, angle) for angle in (0.0, np.pi / 2, np.pi / 4))
    assert straight.d_x_mm[0, 0] == pytest.approx(equation_6(X, 5.0, 0.3))
    assert turned.d_x_mm[0, 0] == pytest.approx(equation_6(Y, 5.0, 0.3))
    middle = (equation_6(X, 5.0, 0.3) + equation_6(Y, 5.0, 0.3)) / 2
    assert half.d_x_mm[0, 0] == pytest.approx(middle)
    alike = calibration(X, X)
    a, b = (push(0.3, 5.0, 4.0, angle, use=alike) for angle in (0.0, 0.6))
    np.testing.assert_allclose(a.d_x_mm, b.d_x_mm, rtol=1e-12)


def test_the_scatter_is_that_of_the_calibration_and_grows_for_faint_maps() -> None:
    scattering = axis(scatter=0.2, slope=0.5)
    use = calibration(scattering, scattering, correlation=0.6)
    at_reference, faint = push(0.3, 5.0, 5.0, use=use), push(0.075, 5.0, 5.0, use=use)
    error = 4 * 0.2 / np.sqrt(2 * N)
    assert np.log(at_reference.d_x_mm).std() == pytest.approx(0.2, abs=error)
    assert np.log(faint.d_x_mm).std() == pytest.approx(0.2 * 4**0.5, abs=2 * error)
    logs = np.log(at_reference.d_x_mm).ravel(), np.log(at_reference.d_y_mm).ravel()
    assert np.corrcoef(*logs)[0, 1] == pytest.approx(0.6, abs=4 / np.sqrt(N))


def test_shares_of_the_variance_sum_to_100_and_follow_their_source() -> None:
    rng = np.random.default_rng(54)
    rows = np.tile([2.0, 0.0, 0.6, -0.3, 0.1, 0.0], (500, 1))
    rows[:, 0] *= np.exp(0.1 * rng.standard_normal(500))
    use = calibration(axis(rows=rows), axis(rows=rows * [0.5, 1, 1, 1, 1, 1]))
    a, sigma = joint(0.0)
    share = push(a, sigma, sigma, use=use).variance_share
    assert sum(share.values()) == pytest.approx(100.0)
    map_variance = 0.04**2 * (1 + 0.3**2)
    total = map_variance + 0.1**2 + 0.1**2
    exact = {"map": 100 * map_variance / total, "calibration": 1 / total, "residual": 1 / total}
    assert share == pytest.approx(exact, rel=0.1)


def test_draws_without_a_size_are_counted_and_empty() -> None:
    a = np.full((2, N // 2), 0.3)
    a[0, :7] = -0.1
    found = push(a, 5.0, 5.0)
    assert found.invalid == 7
    assert np.isnan(found.d_x_mm[0, :7]).all()
    assert np.isfinite(found.d_x_mm[0, 7:]).all()
    assert push(0.3, 1.0, 1.0, use=calibration(axis(b=-20.0), Y)).invalid == N


def test_outside_the_table_is_said_with_its_range() -> None:
    assert outside_domain(DOMAIN, 0.3, 5.0) == []
    assert outside_domain(DOMAIN, 0.9, 12.0) == ["amplitude 0.9 (table: 0.05 to 0.8)", "sigma 12 mm (table: 2 to 9 mm)"]


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"normalise": "gain"}, "normalise gain (the calibration: mean)"),
        ({"background": "free"}, "background free (the calibration: fixed)"),
        ({"radius_mm": 12.0}, "fit radius 12 mm (the calibration: 20 mm)"),
        ({"noise": "field"}, "noise field (the calibration: independent)"),
        ({"flat_field": True}, "flat field on (the calibration: off)"),
    ],
)
def test_another_recipe_is_named(changes: dict[str, object], words: str) -> None:
    recipe = replace(RECIPE, flat_field=False)
    assert recipe.differences(recipe) == []
    assert recipe.differences(replace(recipe, **changes)) == [words]


def test_a_table_or_a_map_that_does_not_say_differs_from_none() -> None:
    known = replace(RECIPE, flat_field=True)
    assert RECIPE.differences(known) == []
    assert known.differences(RECIPE) == []


def test_shapes_are_checked() -> None:
    with pytest.raises(BadDataError, match="draws has 3x4 numbers for 3x6 finite ones"):
        AxisCalibration(np.zeros((3, 4)), 0.3, DOMAIN)
