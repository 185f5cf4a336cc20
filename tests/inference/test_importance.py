"""Importance sampling: its points, its weights, its stopping rule, against exact answers and a library's own points."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import genpareto, qmc

from tactile_bayes.errors import NotConvergedError
from tactile_bayes.inference.draws import (
    BITS,
    MOST_DIMENSIONS,
    ParameterDraws,
    shifted_sobol,
    sobol_integers,
    weighted_quantiles_of,
)
from tactile_bayes.inference.importance import (
    TRUSTED_SHAPE,
    Gaussians,
    ImportanceOptions,
    fit_generalised_pareto,
    importance,
    smooth_weights,
    systematic,
)

MEAN = np.array([1.0, -2.0, 0.5])
COVARIANCE = np.array([[1.0, 0.6, 0.1], [0.6, 2.0, -0.3], [0.1, -0.3, 0.5]])


def normal(theta: np.ndarray) -> np.ndarray:
    off = theta - MEAN
    return -0.5 * np.einsum("mp,pq,mq->m", off, np.linalg.inv(COVARIANCE), off)


@pytest.mark.parametrize("dimension", range(1, MOST_DIMENSIONS + 1))
@pytest.mark.parametrize("start", [0, 1, 300, 1024])
def test_points_are_the_librarys(dimension: int, start: int) -> None:
    theirs = qmc.Sobol(dimension, scramble=False).random(2048)
    ours = sobol_integers(start, 200, dimension) / 2.0**BITS
    np.testing.assert_array_equal(ours, theirs[start : start + 200])


def test_a_digital_shift_keeps_the_points_even() -> None:
    shifts = np.random.default_rng(3).integers(2**BITS, size=(2, 4), dtype=np.uint32)
    points = shifted_sobol(0, 256, shifts=shifts)
    for replicate in points:
        for column in replicate.T:  # one point in each of 256 equal intervals
            assert len(np.unique((column * 256).astype(int))) == 256
    assert not np.allclose(points[0], points[1])


def test_a_normal_is_sampled_to_the_accuracy_asked_for() -> None:
    errors = []
    for seed in range(12):
        draws = importance(normal, MEAN, COVARIANCE, rng=np.random.default_rng(seed))
        assert draws.diagnostics["end_error_sd"] <= 0.02
        ends = np.quantile(draws.flat, [0.025, 0.975], axis=0)
        exact = MEAN + np.array([[-1.0], [1.0]]) * 1.959964 * np.sqrt(np.diag(COVARIANCE))
        errors.append((ends - exact) / np.sqrt(np.diag(COVARIANCE)))
    # the 4000 draws that are kept add an error of their own, about 0.04 SD at an end when they were independent
    assert np.sqrt(np.mean(np.square(errors))) < 0.05


def test_the_evidence_of_a_normal_is_exact() -> None:
    draws = importance(normal, MEAN, COVARIANCE, rng=np.random.default_rng(1))
    exact = 0.5 * np.linalg.slogdet(2 * np.pi * COVARIANCE)[1]
    assert draws.diagnostics["log_evidence"] == pytest.approx(exact, abs=0.01)


def test_a_wrong_proposal_is_corrected() -> None:
    draws = importance(normal, MEAN + 0.4, 1.5 * COVARIANCE, rng=np.random.default_rng(2))
    np.testing.assert_allclose(draws.flat.mean(axis=0), MEAN, atol=0.05)
    np.testing.assert_allclose(np.cov(draws.flat.T), COVARIANCE, atol=0.12)
    uncorrected = MEAN + 0.4  # the negative control: without the weights the mean would stay where it was
    assert np.abs(draws.flat.mean(axis=0) - uncorrected).min() > 0.2


def test_tails_too_heavy_are_refused_not_reported() -> None:
    def cauchy(theta: np.ndarray) -> np.ndarray:
        return -np.log1p(np.sum(theta**2, axis=1)) * 1.01

    with pytest.raises(NotConvergedError, match="--method ensemble") as caught:
        importance(cauchy, np.zeros(3), np.eye(3), rng=np.random.default_rng(0), options=ImportanceOptions(most=1024))
    assert caught.value.diagnostics["pareto_k"] > TRUSTED_SHAPE


def test_same_seed_same_draws() -> None:
    one, two, other = (importance(normal, MEAN, COVARIANCE, rng=np.random.default_rng(s)).theta for s in (5, 5, 6))
    np.testing.assert_array_equal(one, two)
    assert not np.array_equal(one, other)


@pytest.mark.parametrize("shape", [-0.3, 0.1, 0.5, 0.9])
def test_the_pareto_fit_finds_the_shape(shape: float) -> None:
    excess = np.sort(genpareto.rvs(shape, scale=2.0, size=4000, random_state=7))
    found, scale = fit_generalised_pareto(excess)
    assert found == pytest.approx(shape, abs=0.06)
    assert scale == pytest.approx(2.0, rel=0.1)


def test_heavy_weights_are_told_from_light_ones() -> None:
    rng = np.random.default_rng(4)
    light = smooth_weights(0.3 * rng.standard_normal(4000))[1]
    heavy = smooth_weights(rng.standard_cauchy(4000))[1]
    assert light < 0.5
    assert heavy > TRUSTED_SHAPE


def test_equal_weights_and_few_weights_have_defined_shapes() -> None:
    weights, shape = smooth_weights(np.zeros(1000))
    assert shape == -np.inf
    np.testing.assert_allclose(weights, 1e-3)
    assert np.isnan(smooth_weights(np.zeros(4))[1])


def test_weighted_quantiles_and_resampling_agree_with_repetition() -> None:
    rng = np.random.default_rng(8)
    values = rng.standard_normal(500)
    times = rng.integers(1, 5, size=500)
    repeated = np.repeat(values, times)
    order = np.argsort(values)
    found = weighted_quantiles_of(values[order], times[order] / times.sum(), np.array([0.1, 0.5, 0.9]))
    np.testing.assert_allclose(found, np.quantile(repeated, [0.1, 0.5, 0.9]), atol=0.03)
    index = systematic(times / times.sum(), int(times.sum()), rng)
    np.testing.assert_array_equal(np.bincount(index, minlength=500), times)


def test_points_that_can_be_trusted_go_on_where_a_fitted_proposal_is_worse(monkeypatch: pytest.MonkeyPatch) -> None:
    """A map of a wide, faint lump was once answered by chains: its fitted mixture had the heavier tail."""
    fits: list[object] = []

    def spoilt(*points: object, **_: object) -> tuple[Gaussians, int]:
        fits.append(points)
        return Gaussians.single(np.zeros(3), 0.2 * np.eye(3)), 0

    monkeypatch.setattr("tactile_bayes.inference.importance.fitted_gaussians", spoilt)

    def sampled(accuracy_sd: float) -> ParameterDraws:
        return importance(
            lambda theta: -0.5 * np.sum(theta**2, axis=1),
            np.zeros(3),
            0.7 * np.eye(3),
            rng=np.random.default_rng(1),
            options=ImportanceOptions(accuracy_sd=accuracy_sd),
        )

    draws = sampled(0.0008)
    assert fits
    assert draws.diagnostics["end_error_sd"] <= 3 * 0.0008
    assert np.quantile(draws.flat[:, 0], 0.975) == pytest.approx(1.96, abs=0.02)
    with pytest.raises(NotConvergedError):  # the control: an error out of reach is refused
        sampled(1e-6)
