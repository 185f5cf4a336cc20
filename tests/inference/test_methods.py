"""Every method against closed forms, against each other, and under one contract."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from posterior_maps import TRUTH, bump_map, correlated_field
from scipy.stats import kstest, t

from tactile_bayes.declarations import names_of
from tactile_bayes.errors import NotConvergedError
from tactile_bayes.inference.draws import ParameterDraws, student_draws
from tactile_bayes.inference.ensemble import EnsembleOptions, ensemble
from tactile_bayes.inference.modes import find_mode, finite_differences, laplace, mode_and_covariance, optimise, stencil
from tactile_bayes.mapping.map import TactileMap
from tactile_bayes.posterior.bump import ErrorModel
from tactile_bayes.posterior.draw import SamplerSettings
from tactile_bayes.posterior.estimate import estimate_map
from tactile_bayes.posterior.result import Estimate
from tactile_bayes.posterior.white import Target
from tactile_bayes.presets import METHODS

ROWS, DIMENSION = 30, 3


class Linear:
    """A regression whose posterior is a multivariate t: location beta, scale s^2 (X'X)^-1, k - p degrees of freedom."""

    def __init__(self) -> None:
        rng = np.random.default_rng(31)
        self.design = rng.standard_normal((ROWS, DIMENSION)) @ np.array([[1, 0.5, 0], [0, 1, 0.8], [0, 0, 1.0]])
        self.data = self.design @ [1.0, -2.0, 0.5] + 0.3 * rng.standard_normal(ROWS)
        self.beta = np.linalg.lstsq(self.design, self.data, rcond=None)[0]
        self.sse = float(np.sum((self.data - self.design @ self.beta) ** 2))
        self.dof = float(ROWS - DIMENSION)
        self.scale = self.sse / self.dof * np.linalg.inv(self.design.T @ self.design)
        self.sd = np.sqrt(np.diag(self.scale))

    def target(self, *, noise: float = 1.0, inflation: float = 1.0) -> Target:
        errors = ErrorModel(noise * np.sqrt(self.sse / self.dof), inflation, self.dof)
        return Target(
            lambda theta: theta @ self.design.T,
            self.data,
            np.ones(ROWS),
            lambda at: np.zeros(len(at)),
            errors,
            self.sse,
            DIMENSION,
        )

    def draw(self, method: str, **changes: float) -> ParameterDraws:
        rng = np.random.default_rng(32)
        target = self.target(**changes)
        if method == "optimise":
            return optimise(self.beta, self.scale, dof=self.dof, rng=rng)
        if method == "laplace":
            return laplace(target, self.beta + 0.5 * self.sd, scale=self.sd, dof=self.dof, rng=rng)
        mode, covariance, _ = mode_and_covariance(target, self.beta, scale=self.sd)
        return ensemble(target, mode, covariance, rng=rng)


LINEAR = Linear()


@cache
def linear_draws(method: str) -> ParameterDraws:
    return LINEAR.draw(method)


class TestLinearModel:
    @pytest.mark.parametrize("method", ["optimise", "laplace"])
    def test_independent_draws_are_those_of_the_exact_t(self, method: str) -> None:
        z = (linear_draws(method).flat - LINEAR.beta) / LINEAR.sd
        assert min(kstest(z[:, i], t(LINEAR.dof).cdf).pvalue for i in range(DIMENSION)) > 1e-3

    def test_half_the_noise_is_not_the_exact_t(self) -> None:
        z = (LINEAR.draw("laplace", noise=0.5).flat - LINEAR.beta) / LINEAR.sd
        assert max(kstest(z[:, i], t(LINEAR.dof).cdf).pvalue for i in range(DIMENSION)) < 1e-3

    @pytest.mark.long_repeats
    @pytest.mark.parametrize("method", METHODS)
    def test_moments_are_exact_within_monte_carlo_error(self, method: str) -> None:
        """A mean is known to SD / sqrt(n), a deviation to 1 / sqrt(2 n) and 10 % more for the tails of the t."""
        found = linear_draws(method)
        worth = found.diagnostics.get("ess_bulk", float(len(found.flat)))
        exact_sd = LINEAR.sd * np.sqrt(LINEAR.dof / (LINEAR.dof - 2))
        assert np.abs(found.flat.mean(axis=0) - LINEAR.beta).max() < (4 * exact_sd / np.sqrt(worth)).max()
        np.testing.assert_allclose(found.flat.std(axis=0), exact_sd, rtol=4 * 1.1 / np.sqrt(2 * worth))
        exact_correlation = LINEAR.scale / np.outer(LINEAR.sd, LINEAR.sd)
        np.testing.assert_allclose(np.corrcoef(found.flat.T), exact_correlation, atol=4 / np.sqrt(worth))

    def test_the_density_is_the_exact_t_up_to_a_constant(self) -> None:
        rng = np.random.default_rng(33)
        theta = LINEAR.beta + 2 * LINEAR.sd * rng.standard_normal((50, DIMENSION))
        off = theta - LINEAR.beta
        quadratic = np.einsum("mp,pq,mq->m", off, np.linalg.inv(LINEAR.scale), off)
        exact = -0.5 * (LINEAR.dof + DIMENSION) * np.log1p(quadratic / LINEAR.dof)
        np.testing.assert_allclose(LINEAR.target()(theta), exact, rtol=1e-9)

    def test_inflation_widens_by_its_root(self) -> None:
        """Variance by the factor c, with the degrees of freedom of the noise as they were."""
        narrow = mode_and_covariance(LINEAR.target(), LINEAR.beta, scale=LINEAR.sd)[1]
        wide = mode_and_covariance(LINEAR.target(inflation=4.0), LINEAR.beta, scale=LINEAR.sd)[1]
        np.testing.assert_allclose(wide, 4 * narrow, rtol=0.02)  # second differences, steps of 0.05 SD

    def test_the_noise_given_the_parameters_is_a_scaled_inverse_chi(self) -> None:
        target = LINEAR.target()
        noise = target.draw_noise_sd(np.full(20_000, 0.4), np.random.default_rng(34))
        precision = (LINEAR.sse + 0.4) / noise**2  # chi^2 with 30 degrees of freedom: mean 30, variance 60
        assert precision.mean() == pytest.approx(ROWS, abs=4 * np.sqrt(60 / 20_000))
        assert precision.var() == pytest.approx(60, rel=0.06)


def test_a_normal_prior_and_known_noise_give_the_normal_closed_form() -> None:
    prior_sd, noise, known = 0.2, 0.3, 1e7
    target = Target(
        lambda theta: theta @ LINEAR.design.T,
        LINEAR.data,
        np.ones(ROWS),
        lambda theta: -0.5 * np.sum((theta / prior_sd) ** 2, axis=-1),
        ErrorModel(noise, 1.0, known),
        LINEAR.sse,
        DIMENSION,
    )
    precision = LINEAR.design.T @ LINEAR.design / noise**2 + np.eye(DIMENSION) / prior_sd**2
    exact = np.linalg.solve(precision, LINEAR.design.T @ LINEAR.data / noise**2)
    mode, covariance, _ = mode_and_covariance(target, LINEAR.beta, scale=LINEAR.sd)
    np.testing.assert_allclose(mode, exact, atol=1e-4 * LINEAR.sd.max())
    np.testing.assert_allclose(covariance, np.linalg.inv(precision), rtol=1e-4, atol=1e-8)


def test_differences_are_derivatives() -> None:
    def cubic(theta: np.ndarray) -> np.ndarray:
        x, y = theta[:, 0], theta[:, 1]
        return x**2 * y - 3 * x * y + 2 * y**2

    at = np.array([1.5, -0.5])
    step = np.array([1e-3, 2e-3])
    gradient, hessian = finite_differences(cubic(stencil(at, step=step)), step=step)
    np.testing.assert_allclose(gradient, [2 * 1.5 * -0.5 + 1.5, 1.5**2 - 4.5 - 2], atol=1e-6)
    np.testing.assert_allclose(hessian, [[-1.0, 0.0], [0.0, 4.0]], atol=1e-6)


def test_student_draws_are_normal_with_endless_degrees_of_freedom() -> None:
    draws = student_draws(np.zeros(1), np.eye(1), dof=np.inf, number=4000, rng=np.random.default_rng(35))
    assert kstest(draws[:, 0], "norm").pvalue > 1e-3
    heavy = student_draws(np.zeros(1), np.eye(1), dof=3.0, number=4000, rng=np.random.default_rng(35))
    assert kstest(heavy[:, 0], "norm").pvalue < 1e-3


def test_a_flat_density_has_no_mode() -> None:
    def rising(theta: np.ndarray) -> np.ndarray:
        return theta.sum(axis=1)

    with pytest.raises(NotConvergedError, match="--method ensemble"):
        mode_and_covariance(rising, np.zeros(2), scale=np.ones(2))


def test_an_ensemble_that_has_not_converged_says_how_long_to_run() -> None:
    options = EnsembleOptions(block=20, max_steps=20)
    with pytest.raises(NotConvergedError, match=r"not converged after 20 steps.*max_steps = \d+") as caught:
        ensemble(LINEAR.target(), LINEAR.beta, LINEAR.scale, rng=np.random.default_rng(1), options=options)
    assert caught.value.exit_code == 5
    assert caught.value.diagnostics["ess_bulk"] < 800


def test_ensembles_that_disagree_have_not_converged() -> None:
    """Two modes far apart: each ensemble may look well by itself."""

    def two_modes(theta: np.ndarray) -> np.ndarray:
        apart = np.abs(theta[:, 0]) - 40.0
        return -0.5 * (apart**2 + theta[:, 1] ** 2)

    with pytest.raises(NotConvergedError):
        ensemble(
            two_modes,
            np.zeros(2),
            np.diag([1600.0, 1.0]),
            rng=np.random.default_rng(2),
            options=EnsembleOptions(max_steps=300),
        )


ERRORS = {
    "white": 0.02 * np.random.default_rng(36).standard_normal((51, 51)),
    "3 mm field": 0.02 * correlated_field(np.random.default_rng(37), 51, length_cells=3.0),
}


def strong_map(errors: str) -> TactileMap:
    return bump_map(noise=ERRORS[errors])


@cache
def answer(method: str, errors: str = "white", seed: int = 1) -> Estimate:
    options = SamplerSettings(method=method, rotation="off")
    return estimate_map(strong_map(errors), calibration=None, options=options, rng=np.random.default_rng(seed))


def summary(estimate: Estimate) -> tuple[np.ndarray, np.ndarray]:
    """Medians and deviations of amplitude, centre and widths."""
    assert estimate.map_posterior is not None, estimate.reason
    names = ("amplitude", "x_mm", "y_mm", "sigma_x_mm", "sigma_y_mm")
    draws = np.stack([getattr(estimate.map_posterior, name).ravel() for name in names])
    return np.median(draws, axis=1), draws.std(axis=1)


@pytest.mark.long
@pytest.mark.parametrize("errors", list(ERRORS))
def test_methods_agree_on_a_strong_lump(errors: str) -> None:
    """Medians within 0.15 SD and deviations within 10 %; with correlated errors, where the t has fewer degrees of
    freedom and the bump bends within its interval, within 0.35 SD and 25 %.
    """
    median, sd = summary(answer("ensemble", errors))
    shift, stretch = (0.15, 0.10) if errors == "white" else (0.35, 0.25)
    for method in ("optimise", "laplace"):
        other_median, other_sd = summary(answer(method, errors))
        assert np.abs((other_median - median) / sd).max() < shift, method
        assert np.abs(other_sd / sd - 1).max() < stretch, method


MARKS = {"ensemble": pytest.mark.long}  # chains of seconds


@pytest.mark.parametrize("method", [pytest.param(name, marks=MARKS.get(name, ())) for name in METHODS])
class TestContract:
    def test_draws_are_finite_and_shaped_alike(self, method: str) -> None:
        found = answer(method)
        assert found.status == "estimate"
        assert found.draws is not None
        assert found.map_posterior is not None
        assert found.draws.method == method
        assert found.draws.theta.ndim == 3
        for name in set(names_of(found.map_posterior)) - {"labels", "oblique", "irregular"}:
            values = getattr(found.map_posterior, name)
            assert values.shape == found.draws.theta.shape[:2], name
            assert np.isfinite(values).all(), name

    def test_the_truth_lies_within_four_deviations(self, method: str) -> None:
        median, sd = summary(answer(method))
        truth = np.array([TRUTH[name] for name in ("amplitude", "x", "y", "sigma_x", "sigma_y")])
        assert np.abs((median - truth) / sd).max() < 4

    def test_a_stronger_bump_is_a_narrower_one(self, method: str) -> None:
        posterior = answer(method).map_posterior
        assert posterior is not None
        correlation = np.corrcoef(posterior.amplitude.ravel(), posterior.sigma_x_mm.ravel())[0, 1]
        assert correlation == pytest.approx(-0.5, abs=0.1)  # -1/2 for white errors on a round bump

    def test_the_noise_is_that_of_the_map(self, method: str) -> None:
        posterior = answer(method).map_posterior
        assert posterior is not None
        assert np.median(posterior.noise_sd) == pytest.approx(0.02, rel=0.05)
        assert (posterior.background == 1.0).all()

    def test_effective_draws_are_between_800_and_all(self, method: str) -> None:
        draws = answer(method).draws
        assert draws is not None
        assert 800 <= draws.effective_draws <= len(draws.flat)


@pytest.mark.parametrize("method", ["optimise", "laplace"])
def test_one_seed_gives_the_same_draws_and_another_does_not(method: str) -> None:
    options = SamplerSettings(method=method, rotation="off")
    again = estimate_map(strong_map("white"), calibration=None, options=options, rng=np.random.default_rng(1))
    first, other = answer(method).draws, answer(method, seed=2).draws
    assert first is not None
    assert again.draws is not None
    assert other is not None
    np.testing.assert_array_equal(first.theta, again.draws.theta)
    assert not np.array_equal(first.theta, other.theta)


@pytest.mark.parametrize("tolerance", [0.3, 1e-2])
def test_a_mode_is_nearer_than_the_last_step(tolerance: float) -> None:
    """A density with a bent ridge, whose mode is at (1, 1), where differences tell it to 0.002."""

    def log_density(theta: np.ndarray) -> np.ndarray:
        return -(20.0 * (theta[:, 1] - theta[:, 0] ** 2) ** 2) - (1.0 - theta[:, 0]) ** 2

    scale = np.full(2, 0.2)
    found, steps = find_mode(log_density, np.array([-0.5, 0.5]), scale=scale, tolerance=tolerance)
    assert np.abs((found - 1.0) / scale).max() < tolerance
    assert steps < find_mode(log_density, np.array([-0.5, 0.5]), scale=scale, tolerance=1e-8)[1]
