"""The collapsed posterior under correlated errors: against dense linear algebra, and how often its intervals cover."""

from __future__ import annotations

import numpy as np
import pytest

from tactile_bayes.posterior import collapsed
from tactile_bayes.posterior.bump import BumpPrior
from tactile_bayes.posterior.cells import FitCells, window_cells
from tactile_bayes.posterior.collapsed import CollapsedTarget
from tactile_bayes.posterior.field import cosine_basis, spectrum, whitenings
from tactile_bayes.posterior.field_posterior import FieldFit, draw_field, fit_field, rotation_odds, shape_draws
from tests.posterior_maps import TRUTH, bump_map, correlated_field

RADIUS = 20.0
START = np.array([np.log(6.0), np.log(4.5), 1.3, -0.8, 0.0])
Z90 = 1.6448536


def cells_of(noise: np.ndarray | float, radius: float = RADIUS, **bump: float) -> FitCells:
    return window_cells(bump_map(noise=noise, **bump), (1.0, -1.0), radius_mm=radius)


def target_of(cells: FitCells, *, level: float | None = None, rotated: bool = True) -> CollapsedTarget:
    return CollapsedTarget(
        cells, prior=BumpPrior(), level=level, rotated=rotated, widest_mm=0.75 * RADIUS, radius_mm=RADIUS
    )


def fitted(cells: FitCells, *, rotated: bool = False) -> FieldFit:
    return fit_field(cells, START, prior=BumpPrior(), rotated=rotated, widest_mm=0.75 * RADIUS, radius_mm=RADIUS)


def noise(seed: int, *, white: float = 0.01, field: float = 0.0, length: float = 3.0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    values = white * rng.standard_normal((51, 51))
    return values + field * correlated_field(rng, 51, length_cells=length) if field else values


def test_the_basis_is_orthonormal_on_its_rectangle() -> None:
    x, y = (v.ravel() for v in np.meshgrid(np.linspace(-10, 10, 121), np.linspace(-10, 10, 121)))
    basis, frequency2 = cosine_basis(x, y, cosines=4)
    assert basis.shape == (121 * 121, 16)
    assert frequency2[0] == 0.0
    np.testing.assert_allclose(np.mean(basis[:, 0] ** 2), 1.0)
    assert spectrum(frequency2, 3.0).sum() == pytest.approx(1.0)
    assert (np.diff(spectrum(np.sort(frequency2), 3.0)) <= 0).all()


def test_low_rank_algebra_is_dense_algebra() -> None:
    cells = cells_of(noise(0, field=0.01), radius=8.0)
    target = target_of(cells)
    theta = np.array([START, START + 0.1])
    evidence, solutions = target._solve(theta)
    basis, frequency2 = cosine_basis(cells.x_mm, cells.y_mm)
    column = 0
    for field in target.fields:
        for share in collapsed.SHARES:
            cov = np.diag(target.variance) + share * (basis * spectrum(frequency2, field.length_mm)) @ basis.T
            for row, one in enumerate(theta):
                bump = target._bumps(one[None])[0]
                design = np.column_stack([target.design, bump])
                inverse = np.linalg.inv(cov)
                information = design.T @ inverse @ design
                beta = np.linalg.solve(information, design.T @ inverse @ target.data)
                rest = target.data - design @ beta
                square = rest @ inverse @ rest
                n, c = design.shape
                log_det = np.linalg.slogdet(cov)[1] - np.log(target.variance).sum()
                exact = -0.5 * (log_det + np.linalg.slogdet(information)[1]) - 0.5 * (n - c) * np.log(square)
                assert evidence[row, column] == pytest.approx(exact, abs=1e-3)
                assert solutions[column].amplitude[row] == pytest.approx(beta[-1], rel=1e-6)
                assert solutions[column].level[row] == pytest.approx(beta[0], rel=1e-6)
                assert solutions[column].amplitude_variance[row] == pytest.approx(
                    np.linalg.inv(information)[-1, -1], rel=1e-5
                )
            column += 1


def test_dropping_idle_directions_changes_nothing_that_matters() -> None:
    cells = cells_of(noise(1, field=0.01))
    target = target_of(cells, rotated=False)
    whole = target(START[None, :4])[0]
    target.settle_fields(START[:4])
    assert target(START[None, :4])[0] == pytest.approx(whole, abs=0.05)
    assert sum(len(field.eigenvalues) for field in target.fields) < sum(
        len(field.eigenvalues) for field in whitenings(cells.x_mm, cells.y_mm, variance=target.variance)
    )


def test_a_level_and_a_tilt_do_not_matter() -> None:
    cells = cells_of(noise(2))
    plain = fitted(cells)
    tilted = cells_of(noise(2) + 0.02 * np.linspace(-1, 1, 51)[None, :] + 5.0)
    np.testing.assert_allclose(fitted(tilted).mode, plain.mode, atol=1e-3)


def test_a_dent_has_no_density() -> None:
    target = target_of(cells_of(noise(3), amplitude=-0.3))
    assert target(START[None])[0] == -np.inf


def test_amplitude_and_noise_come_back() -> None:
    fit = fitted(cells_of(noise(4, white=0.01)))
    theta = np.repeat(fit.mode[None], 4000, axis=0)
    amplitude, level, noise_sd = fit.target.draw_linear(theta, np.random.default_rng(0))
    assert amplitude.mean() == pytest.approx(TRUTH["amplitude"], abs=4 * amplitude.std())
    assert level.mean() == pytest.approx(1.0, abs=0.005)
    # against dense algebra without a field: the spread of the level, and that it falls as the amplitude rises
    design = np.column_stack([fit.target.design, fit.target._bumps(fit.mode[None])[0]])
    joint = np.linalg.inv(design.T @ (design / fit.target.variance[:, None]))
    white = np.sqrt(joint[0, 0]) * 0.01 / np.sqrt(fit.target.variance.mean())
    assert 0.9 * white < level.std() < 3.0 * white
    assert np.corrcoef(level, amplitude)[0, 1] < 0.0
    assert noise_sd.mean() == pytest.approx(0.01, rel=0.05)


@pytest.mark.parametrize(
    "methods", [("laplace", "importance"), pytest.param(("ensemble", "importance"), marks=pytest.mark.slow)]
)
def test_the_methods_agree(methods: tuple[str, ...]) -> None:
    fit = fitted(cells_of(noise(5, field=0.01)))
    drawn = {method: draw_field(fit, method, rng=np.random.default_rng(1)).flat for method in methods}
    sd = drawn["importance"].std(axis=0)
    for name, draws in drawn.items():
        assert (np.abs(draws.mean(axis=0) - drawn["importance"].mean(axis=0)) < 0.2 * sd).all(), name
        # where two fields share the evidence the mixture is sharper at its mode than it is wide: 0.74 was seen
        np.testing.assert_allclose(draws.std(axis=0), sd, rtol=0.35 if name == "laplace" else 0.12, err_msg=name)
    sigma_x, sigma_y, _ = shape_draws(fit, drawn["importance"])
    assert np.median(sigma_x) == pytest.approx(TRUTH["sigma_x"], rel=0.1)
    assert np.median(sigma_y) == pytest.approx(TRUTH["sigma_y"], rel=0.1)


def test_a_turned_ellipse_is_found_and_a_straight_one_is_not_turned() -> None:
    straight = fitted(cells_of(noise(6, field=0.005)), rotated=True)
    turned = fitted(cells_of(noise(6, field=0.005), angle_deg=35.0), rotated=True)
    assert rotation_odds(straight, BumpPrior()) < 1.0
    assert rotation_odds(turned, BumpPrior()) > 100.0


def coverage(maps: int, **errors: float) -> np.ndarray:
    """Share of 90 % intervals of ln sigma_x and ln sigma_y that hold the truth."""
    inside = np.zeros(2)
    for seed in range(maps):
        fit = fitted(cells_of(noise(1000 + seed, **errors)))
        z = (fit.mode[:2] - np.log([TRUTH["sigma_x"], TRUTH["sigma_y"]])) / np.sqrt(np.diag(fit.covariance)[:2])
        inside += np.abs(z) <= Z90
    return inside / maps


@pytest.mark.parametrize("errors", [{"white": 0.01}, {"white": 0.01, "field": 0.01, "length": 6.0}])
def test_intervals_cover(errors: dict[str, float]) -> None:
    # 30 maps: 0.73 is 3.1 binomial SDs below 0.90
    assert coverage(30, **errors).min() >= 0.73


def test_independent_errors_would_not_cover(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(collapsed, "SHARES", (0.0,))
    assert coverage(15, white=0.003, field=0.02, length=4.0).max() < 0.73


@pytest.mark.slow
@pytest.mark.parametrize(
    "errors",
    [
        {"white": 0.01},
        {"white": 0.01, "field": 0.01, "length": 3.0},
        {"white": 0.01, "field": 0.01, "length": 6.0},
        {"white": 0.002, "field": 0.02, "length": 4.0},
    ],
)
def test_intervals_cover_within_85_to_95_percent(errors: dict[str, float]) -> None:
    found = coverage(400, **errors)
    # the goal with three binomial SDs of 400 maps (0.015 each)
    assert found.min() >= 0.85 - 0.045
    assert found.max() <= 0.95 + 0.045
