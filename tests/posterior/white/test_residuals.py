"""What residuals say of the errors: exact answers for white errors, known fields, and weights from counts."""

from __future__ import annotations

import numpy as np
import pytest
from posterior_maps import bump_map, correlated_field, grid_map

from tactile_bayes.posterior.bump import (
    count_weights,
    fitted_tilt,
    level_offset,
    residual_autocorrelation,
    window_cells,
)
from tactile_bayes.posterior.draw import SamplerSettings
from tactile_bayes.posterior.white import BumpFit, fit_bump

NOISE = 0.02
SIZE = 51


def fitted(noise: np.ndarray, **options: object) -> BumpFit:
    fit, fault = fit_bump(bump_map(noise=noise), (1.0, -1.0), options=SamplerSettings(rotation="off", **options))
    assert fit is not None, fault
    return fit


def test_white_errors_are_not_inflated() -> None:
    rng = np.random.default_rng(1)
    fits = [fitted(NOISE * rng.standard_normal((SIZE, SIZE))) for _ in range(20)]
    assert np.mean([fit.errors.inflation for fit in fits]) < 1.02
    # 20 fits of 1257 cells know the noise to 0.02/sqrt(2 * 20 * 1250), 0.5 %
    assert np.mean([fit.errors.noise_sd for fit in fits]) == pytest.approx(NOISE, rel=0.02)
    assert np.mean([fit.errors.dof for fit in fits]) == pytest.approx(1252, rel=0.03)


def test_inflation_grows_with_the_length_of_the_errors() -> None:
    rng = np.random.default_rng(2)
    mean = [
        np.mean(
            [fitted(NOISE * correlated_field(rng, SIZE, length_cells=n)).errors.inflation for _ in range(10)],
        )
        for n in (0.5, 1.0, 3.0)
    ]
    assert 1.0 < mean[0] < mean[1] < mean[2]
    assert mean[2] > 8


def test_a_tilt_and_a_level_are_not_noise() -> None:
    cells = window_cells(bump_map(), (0.0, 0.0), radius_mm=15.0)
    plane = 0.3 + 0.02 * cells.x_mm - 0.01 * cells.y_mm
    weight = np.random.default_rng(3).uniform(0.5, 2.0, len(cells))
    np.testing.assert_allclose(fitted_tilt(cells, plane, weight=weight), plane, atol=1e-12)
    assert level_offset(np.full(len(cells), 0.3), weight=weight) == pytest.approx(0.3)


def test_the_autocorrelation_is_that_of_the_field() -> None:
    """Out to one length; farther out the window's own mean pulls it down."""
    rng = np.random.default_rng(4)
    total = np.zeros(4)
    for _ in range(60):
        correlation, half = residual_autocorrelation(correlated_field(rng, 60, length_cells=3.0), np.ones((60, 60)))
        assert half >= 3
        total += correlation[half, half : half + 4]
    # rings hold lags half a cell either side, hence not exactly exp(-lag / 3)
    np.testing.assert_allclose(total / 60, np.exp(-np.arange(4) / 3.0), atol=0.06)


def test_white_residuals_have_no_neighbours() -> None:
    rng = np.random.default_rng(5)
    halves = [residual_autocorrelation(rng.standard_normal((60, 60)), np.ones((60, 60)))[1] for _ in range(40)]
    assert np.mean(np.array(halves) > 0) <= 0.2  # noise passes a limit of 2 SD on one side in 2.3 % of lags


def test_counts_weigh_as_the_variance_of_a_mean() -> None:
    count = np.where(np.arange(SIZE) < SIZE // 2, 10, 90)[None, :] * np.ones((SIZE, 1), dtype=int)
    tactile_map = grid_map(bump_map().mean, count=count, variance=0.04)
    cells = window_cells(tactile_map, (0.0, 0.0), radius_mm=15.0)
    few = cells.count == 10
    sensor_only = count_weights(cells, 0.04 * np.mean(1 / cells.count))
    assert sensor_only[~few].mean() / sensor_only[few].mean() == pytest.approx(9.0, rel=0.02)
    misfit_rules = count_weights(cells, 10.0)
    assert misfit_rules[~few].mean() / misfit_rules[few].mean() == pytest.approx(1.0, abs=0.01)
    assert sensor_only.mean() == pytest.approx(1.0)


def test_maps_that_do_not_know_their_variance_are_weighed_alike() -> None:
    cells = window_cells(bump_map(), (0.0, 0.0), radius_mm=15.0)
    np.testing.assert_array_equal(count_weights(cells, 0.01), np.ones(len(cells)))


def test_twice_the_readings_of_the_same_frames_do_not_shrink_the_posterior() -> None:
    noise = NOISE * correlated_field(np.random.default_rng(6), SIZE, length_cells=2.0)
    once, twice = (grid_map(bump_map(noise=noise).mean, count=n, variance=0.04) for n in (40, 80))
    sd = []
    for tactile_map in (once, twice):
        fit, _ = fit_bump(tactile_map, (1.0, -1.0), options=SamplerSettings(rotation="off"))
        assert fit is not None
        sd.append(np.sqrt(np.diag(fit.covariance)))
    np.testing.assert_allclose(sd[1], sd[0], rtol=1e-3)
