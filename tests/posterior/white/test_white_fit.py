"""Fits of known bumps: exact, unbiased by the cells, as symmetric as the map."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from posterior_maps import TRUTH, bump_map, bump_values, find_bump, grid_map
from scipy.special import erf

from tactile_bayes.declarations import replace
from tactile_bayes.inference import modes
from tactile_bayes.mapping.map import TactileMap
from tactile_bayes.posterior import white as fit_module
from tactile_bayes.posterior.draw import SamplerSettings
from tactile_bayes.posterior.white import BumpFit, fit_bump, rotation_odds

OFF = SamplerSettings(rotation="off")
ON = SamplerSettings(rotation="on")
NOISE = 0.02 * np.random.default_rng(11).standard_normal((51, 51))


def fitted(tactile_map: TactileMap, options: SamplerSettings = OFF) -> BumpFit:
    found = find_bump(tactile_map, options)[-1]
    assert found.fit is not None, found.fault
    assert found.fault == ""
    return found.fit


def facts(fit: BumpFit) -> np.ndarray:
    """Amplitude, x, y, sigma_x, sigma_y, angle."""
    return np.array([*fit.theta[:3], *fit.widths()])


@pytest.mark.parametrize("angle", [0.0, 30.0, -40.0])
def test_a_map_without_errors_gives_its_bump_back(angle: float) -> None:
    found = facts(fitted(bump_map(angle_deg=angle), ON))
    truth = [TRUTH[name] for name in ("amplitude", "x", "y", "sigma_x", "sigma_y")]
    np.testing.assert_allclose(found, [*truth, np.radians(angle)], atol=1e-6)


def test_the_free_background_is_found() -> None:
    fit = fitted(bump_map(level=1.07), replace(OFF, background="free"))
    assert fit.theta[-1] == pytest.approx(1.07, abs=1e-8)
    np.testing.assert_allclose(fit.widths()[:2], [6.0, 4.5], atol=1e-6)
    wrong = fitted(bump_map(level=1.07))
    assert abs(wrong.widths()[0] - 6.0) > 0.5


@pytest.mark.parametrize(("cell", "bound"), [(1.0, 1e-7), (2.0, 2e-5), (3.0, 2e-4)])
def test_coarse_cells_bias_no_width(cell: float, bound: float) -> None:
    """Against exact cell means by the error function: cells of 3 mm are 0.75 of the narrower width of 4 mm."""
    n = 2 * round(24 / cell) + 1
    axis = (np.arange(n) - (n - 1) / 2) * cell

    def line(u: np.ndarray, sigma: float) -> np.ndarray:
        ends = [erf((u + s * cell / 2) / (sigma * np.sqrt(2))) for s in (1, -1)]
        return sigma * np.sqrt(np.pi / 2) * (ends[0] - ends[1]) / cell

    exact = 1 + 0.3 * np.outer(line(axis + 0.4, 4.0), line(axis - 0.7, 5.0))
    fit = fitted(grid_map(exact, cell_mm=cell))
    np.testing.assert_allclose(fit.widths()[:2], [5.0, 4.0], rtol=bound)
    assert fit.theta[0] == pytest.approx(0.3, rel=bound)
    # what Eq 7 at the cells' centres would give: sigma^2 + h^2 / 12
    naive = np.sqrt(4.0**2 + cell**2 / 12) / 4.0 - 1
    assert naive > 10 * bound


def test_deviations_fall_with_the_noise() -> None:
    sd = [np.sqrt(np.diag(fitted(bump_map(noise=scale * NOISE)).covariance)) for scale in (1.0, 0.5, 0.25)]
    np.testing.assert_allclose(sd[0] / sd[1], 2.0, rtol=0.05)
    np.testing.assert_allclose(sd[1] / sd[2], 2.0, rtol=0.05)


@given(dx=st.integers(-500, 500), dy=st.integers(-500, 500))
def test_moving_the_coordinates_moves_the_centre_only(dx: int, dy: int) -> None:
    here = bump_map(noise=NOISE)
    there = replace(here, x_mm=here.x_mm + dx, y_mm=here.y_mm + dy)
    np.testing.assert_allclose(facts(fitted(there)) - facts(fitted(here)), [0, dx, dy, 0, 0, 0], atol=1e-6)


@given(factor=st.floats(1e-3, 1e3))
def test_scaling_a_map_of_unknown_level_scales_the_amplitude_only(factor: float) -> None:
    free = replace(OFF, background="free")
    values = bump_map(noise=NOISE).mean
    before = fitted(grid_map(values, background=None, normalise="none"), free)
    after = fitted(grid_map(factor * values, background=None, normalise="none"), free)
    np.testing.assert_allclose(facts(after)[1:], facts(before)[1:], atol=1e-6)
    assert after.theta[0] == pytest.approx(factor * before.theta[0], rel=1e-6)
    assert after.theta[-1] == pytest.approx(factor * before.theta[-1], rel=1e-6)
    assert after.errors.noise_sd == pytest.approx(factor * before.errors.noise_sd, rel=1e-5)


def test_mirrors_and_transposition_do_to_the_bump_what_they_do_to_the_map() -> None:
    values = bump_values(angle_deg=20.0) + NOISE
    a, x, y, sx, sy, angle = facts(fitted(grid_map(values), ON))
    np.testing.assert_allclose(facts(fitted(grid_map(values[:, ::-1]), ON)), [a, -x, y, sx, sy, -angle], atol=1e-6)
    np.testing.assert_allclose(facts(fitted(grid_map(values[::-1]), ON)), [a, x, -y, sx, sy, -angle], atol=1e-6)
    np.testing.assert_allclose(facts(fitted(grid_map(values.T), ON)), [a, y, x, sy, sx, -angle], atol=1e-6)


def test_data_beyond_the_window_are_not_used() -> None:
    near = bump_map(noise=NOISE)
    values = near.mean.copy()
    values[0, :] = 9.0  # 24 mm below a centre whose window has 20
    far = fit_bump(grid_map(values), (1.0, -1.0), options=OFF)[0]
    assert far is not None
    np.testing.assert_array_equal(facts(far), facts(fitted(near)))


@pytest.mark.parametrize(
    ("bump", "fault"),
    [
        ({"amplitude": -0.3}, "a depression"),
        ({"sigma_x": 0.35, "sigma_y": 0.35, "x": 0.0, "y": 0.0}, "narrower than a cell"),
        ({"sigma_x": 22.0, "sigma_y": 19.0}, "wider than the window"),
        ({"x": 26.5}, "at the rim of the map"),
        ({"sigma_x": 10.0, "sigma_y": 1.6}, "a ridge, not a lump"),
    ],
)
def test_what_cannot_be_a_lump_is_named(bump: dict[str, float], fault: str) -> None:
    centre = (bump.get("x", 1.0), bump.get("y", -1.0))
    fit, found = fit_bump(bump_map(**bump), centre, options=OFF)
    assert fit is not None
    assert found.startswith(fault)


def test_too_few_cells_for_the_parameters_is_no_fit() -> None:
    fit, fault = fit_bump(bump_map(half_mm=1.0), (0.0, 0.0), options=replace(OFF, fit_radius_mm=1.0))
    assert fit is None
    assert fault == "too few covered cells (5, at least 7 needed)"


def test_the_highest_bump_that_can_be_a_lump_is_taken() -> None:
    ridge = bump_values(x=-15, y=0, sigma_x=2.5, sigma_y=25.0, amplitude=0.6)
    values = ridge + bump_values(x=10, y=0, amplitude=0.3, sigma_x=4, sigma_y=4) - 1
    tried = find_bump(grid_map(values), SamplerSettings(fit_radius_mm=12.0, rotation="off"))
    assert tried[-1].fault == ""
    assert tried[-1].centre_mm[0] > 5
    assert len(tried) > 1
    assert all(one.fault for one in tried[:-1])


def test_the_user_may_say_where_to_look() -> None:
    values = bump_values(x=-13, y=0, amplitude=0.5) + bump_values(x=13, y=0, amplitude=0.2) - 1
    chosen = find_bump(grid_map(values), replace(OFF, fit_radius_mm=11.0, centre_mm=(12.0, 0.0)))
    assert len(chosen) == 1
    assert chosen[0].fit is not None
    assert chosen[0].fit.theta[1] == pytest.approx(13.0, abs=0.5)


def test_a_turned_ellipse_asks_for_its_rotation_and_a_straight_one_does_not() -> None:
    straight, turned = bump_map(noise=NOISE), bump_map(noise=NOISE, angle_deg=30.0)
    options = SamplerSettings()
    odds = [rotation_odds(m, fitted(m), options=options)[0] for m in (straight, turned)]
    assert odds[0] < 1 / 3
    assert odds[1] > 1e6


@pytest.mark.parametrize(
    ("errors", "noise", "widths"), [(0.003, "field", 1), (0.3, "field", 3), (0.003, "independent", 3)]
)
def test_other_widths_are_tried_where_one_does_not_explain_the_window(
    errors: float, noise: str, widths: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And always where least squares is the answer, not only a place to begin."""
    starts: list[np.ndarray] = []
    original = modes.fit_least_squares

    def counted(model: object, begin: np.ndarray, **settings: object) -> object:
        starts.append(begin)
        return original(model, begin, **settings)  # type: ignore[arg-type]

    monkeypatch.setattr(modes, "fit_least_squares", counted)
    values = bump_values() + errors * np.random.default_rng(2).standard_normal((51, 51))
    fit_bump(grid_map(values), (1.0, -1.0), options=SamplerSettings(rotation="off", noise=noise))
    tried = {round(float(np.exp(start[3])), 6) for start in starts}
    assert len(tried & set(fit_module.START_WIDTHS_MM)) == widths
