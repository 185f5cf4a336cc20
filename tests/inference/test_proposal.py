"""Mixture proposals and fitted ones, on densities whose quantiles and integral are known without sampling."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.stats import multivariate_normal, norm

from tactile_bayes.errors import NotConvergedError
from tactile_bayes.inference import importance as adaptation
from tactile_bayes.inference.importance import STRETCH, TOO_WIDE, Gaussians, Proposal, importance
from tactile_bayes.posterior.draw import SamplingTarget, importance_draws

P, WIDE_SHARE, WIDE_SD = 4, 0.03, 3.0
PARTS = Gaussians(
    np.array([1.0 - WIDE_SHARE, WIDE_SHARE]), np.zeros((2, P)), np.stack([np.eye(P), WIDE_SD**2 * np.eye(P)])
)
BEND = 0.6


def scale_mixture(theta: np.ndarray) -> np.ndarray:
    """Log density with integral 1: mostly narrow, its tails all from the wide part."""
    narrow, wide = (multivariate_normal(np.zeros(P), sd**2 * np.eye(P)).pdf(theta) for sd in (1.0, WIDE_SD))
    return np.log((1.0 - WIDE_SHARE) * narrow + WIDE_SHARE * wide)


def upper_end() -> float:
    """97.5 % quantile of each parameter."""
    return brentq(lambda x: (1.0 - WIDE_SHARE) * norm.cdf(x) + WIDE_SHARE * norm.cdf(x / WIDE_SD) - 0.975, 0.0, 10.0)


def banana(theta: np.ndarray) -> np.ndarray:
    """Log density with integral 1: the second parameter follows the square of the first, which is normal."""
    x, y, z = theta.T
    return norm.logpdf(x) + norm.logpdf(y - BEND * (x**2 - 1.0), scale=0.3) + norm.logpdf(z)


BANANA_COVARIANCE = np.diag([1.0, 0.3**2 + 2.0 * BEND**2, 1.0])


def test_one_gaussian_is_too_narrow_for_a_wide_part_and_each_of_its_own_is_not() -> None:
    covariance = PARTS.moments()[1]
    assert PARTS.widest(covariance) > TOO_WIDE
    found = importance(scale_mixture, np.zeros(P), covariance, rng=np.random.default_rng(1), parts=PARTS)
    assert found.diagnostics["pareto_k"] < 0.3
    assert found.diagnostics["evaluations"] <= 16384
    assert abs(found.diagnostics["log_evidence"]) < 5 * found.diagnostics["log_evidence_error"] + 1e-3
    sd = np.sqrt(covariance[0, 0])
    np.testing.assert_allclose(np.quantile(found.flat, 0.975, axis=0), upper_end(), atol=0.06 * sd)
    # the control: the narrow part alone has another end
    assert abs(norm.ppf(0.975) - upper_end()) > 0.06 * sd


def test_a_sampling_target_is_drawn_by_its_own_gaussians() -> None:
    """Without them a mixture must be fitted first: four times as many evaluations, and a heavier tail."""
    covariance = PARTS.moments()[1]
    of_its_own, of_none = (
        importance_draws(
            SamplingTarget(scale_mixture, np.zeros(P), covariance, parts), rng=np.random.default_rng(1)
        ).diagnostics
        for parts in (PARTS, None)
    )
    assert 3 * of_its_own["evaluations"] < of_none["evaluations"]
    assert of_its_own["pareto_k"] < 0.1 < 0.4 < of_none["pareto_k"]


def test_without_parts_a_mixture_is_fitted(monkeypatch: pytest.MonkeyPatch) -> None:
    def draw():
        return importance(banana, np.zeros(3), BANANA_COVARIANCE, rng=np.random.default_rng(2))

    found = draw()
    assert found.diagnostics["pareto_k"] <= 0.7
    ends = np.quantile(found.flat[:, [0, 2]], [0.025, 0.975], axis=0)
    np.testing.assert_allclose(ends, [[-1.96, -1.96], [1.96, 1.96]], atol=0.06)
    assert abs(found.diagnostics["log_evidence"]) < 5 * found.diagnostics["log_evidence_error"] + 1e-3
    monkeypatch.setattr(adaptation, "MOST_ADDED", 0)  # the control: the defensive Gaussian alone does not follow it
    with pytest.raises(NotConvergedError, match="Pareto shape"):
        draw()


def test_fitted_gaussians_cover_both_modes() -> None:
    """A second mode 12 SDs away, seen by few of the points: both have a Gaussian."""

    def two(theta: np.ndarray) -> np.ndarray:
        return np.logaddexp(norm.logpdf(theta[:, 0]), norm.logpdf(theta[:, 0] - 12.0)) + norm.logpdf(theta[:, 1])

    first = Proposal(Gaussians.single(np.zeros(2), 9.0 * np.eye(2)), STRETCH)
    theta, _ = first.points(np.random.default_rng(3).uniform(size=(2000, 2)))
    found, evaluations = adaptation.fitted_gaussians(two, first, theta, two(theta), rng=np.random.default_rng(4))
    assert evaluations == adaptation.ADDED * (len(found) - 1) > 0
    away = np.abs(found.mean[1:, 0, None] - np.array([0.0, 12.0]))
    assert (away.min(axis=0) < 2.0).all()


def test_a_proposals_density_is_that_of_its_points() -> None:
    """By one Gaussian from normal coordinates, by several from the points: the same number."""
    covariance = np.array([[1.0, 0.6], [0.6, 2.0]])
    one = Proposal(Gaussians.single(np.array([1.0, -2.0]), covariance), STRETCH)
    uniform = np.random.default_rng(5).uniform(size=(50, 2))
    theta, log_density = one.points(uniform)
    np.testing.assert_allclose(one.log_density(theta), log_density, atol=1e-9)
    x, y = np.meshgrid(np.linspace(-30, 32, 800), np.linspace(-40, 36, 800))
    cell = (x[0, 1] - x[0, 0]) * (y[1, 0] - y[0, 0])
    both = Gaussians(np.array([0.3, 0.7]), np.array([[1.0, -2.0], [0.0, 0.0]]), np.stack([covariance, np.eye(2)]))
    mixed = Proposal(both, STRETCH).log_density(np.stack([x, y], axis=-1))
    assert np.exp(mixed).sum() * cell == pytest.approx(1.0, abs=2e-3)


def test_a_mixture_given_some_parameters_is_the_conditional_density() -> None:
    rng = np.random.default_rng(6)
    roots = rng.standard_normal((2, 3, 3))
    mixture = Gaussians(np.array([0.4, 0.6]), rng.standard_normal((2, 3)), roots @ roots.transpose(0, 2, 1) + np.eye(3))
    last, some = np.array([0.7]), rng.standard_normal((5, 2))
    joint = mixture.log_density(np.column_stack([some, np.full(5, last[0])]))
    gap = joint - mixture.conditional(last).log_density(some)
    np.testing.assert_allclose(gap, gap[0], atol=1e-9)  # the marginal density of the last parameter
