"""Ends of intervals by the default method, against references that share nothing with it but the density.

The first is a grid: four shape parameters at steps of half a posterior SD over six SDs either way. The trapezoid rule
is exact to far below the figures here for densities this smooth, and a spline through a marginal's logarithm gives its
quantiles. The second is emcee's differential evolution. Its snooker move is left out: on a normal it makes intervals
3 % too narrow (emcee 3.1.6), which the grid told.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.stats import t as student

from tactile_bayes.inference.draws import END_ERROR
from tactile_bayes.inference.importance import importance
from tactile_bayes.inference.modes import mode_and_covariance
from tactile_bayes.posterior.draw import SamplingTarget, importance_draws
from tactile_bayes.posterior.fit import FieldFit
from tactile_bayes.posterior.marginal import Scene
from tests.inference.test_methods import LINEAR
from tests.posterior.correlated.test_marginal import cells_of, fitted, noise
from tests.posterior.correlated.test_scene_draws import half_covered, strong, weak

LogDensity = Callable[[np.ndarray], np.ndarray]
WANTED = 0.02
PROBABILITIES = (0.025, 0.975)
GRID = np.arange(-6.0, 6.25, 0.5)
MAPS = {"strong": strong, "weak": weak, "half covered": half_covered}


@cache
def plainly_round() -> FieldFit:
    """Three parameters: a grid that the fast tests can afford."""
    return fitted(cells_of(noise(5, field=0.01)), scene=Scene("round"), start=np.array([1.6, 1.3, -0.8]))


def on_grid(log_density: LogDensity, centre: np.ndarray, sd: np.ndarray) -> np.ndarray:
    """Log density on the grid, an axis a parameter; the largest is 0."""
    points = np.stack([v.ravel() for v in np.meshgrid(*[GRID] * len(centre), indexing="ij")], axis=1)
    value = np.concatenate([log_density(centre + sd * part) for part in np.array_split(points, len(points) // 4000)])
    return (value - value.max()).reshape((len(GRID),) * len(centre))


def grid_ends(log_density: np.ndarray, *, noise: float = 1.0) -> np.ndarray:
    """(2, p) ends of 95 % intervals in SDs from the centre; `noise` other than 1 is a wrong noise scale."""
    cube = np.exp(log_density / noise**2)
    found = []
    for axis in range(cube.ndim):
        others = tuple(other for other in range(cube.ndim) if other != axis)
        found.append(marginal_ends(GRID, cube.sum(axis=others)))
    return np.array(found).T


def marginal_ends(z: np.ndarray, density: np.ndarray) -> np.ndarray:
    """Quantiles of a density known on a grid."""
    fine = np.linspace(z[0], z[-1], 40001)
    between = np.exp(CubicSpline(z, np.log(density + 1e-300))(fine))
    total = np.cumsum(between)
    return np.interp(PROBABILITIES, (total - 0.5 * between) / total[-1], fine)


@cache
def density_of(name: str) -> SamplingTarget:
    """What is sampled for a map."""
    return (MAPS | {"round": plainly_round})[name]().sampling_target()


@cache
def reference(name: str) -> np.ndarray:
    """A map's log density on the grid about its Gaussians."""
    density = density_of(name)
    return on_grid(density.log_density, density.mean, np.sqrt(np.diag(density.covariance)))


def ends_in_sd(name: str, draws: np.ndarray) -> np.ndarray:
    """(2, p) ends of draws, counted as the grid counts."""
    density = density_of(name)
    return (np.quantile(draws, PROBABILITIES, axis=0) - density.mean) / np.sqrt(np.diag(density.covariance))


@cache
def importance_ends(name: str, runs: int) -> np.ndarray:
    """(runs, 2, p) ends by the default method."""
    seeds = (np.random.default_rng(seed) for seed in range(runs))
    return np.array([ends_in_sd(name, importance_draws(density_of(name), rng=rng).flat) for rng in seeds])


def off_by(name: str, runs: int, *, noise: float = 1.0) -> np.ndarray:
    """(2, p) root mean square error of each end over runs, in SDs, against the grid."""
    return np.sqrt(np.mean((importance_ends(name, runs) - grid_ends(reference(name), noise=noise)) ** 2, axis=0))


def test_the_grid_knows_the_normal() -> None:
    root = np.array([[1.0, 0.0, 0.0], [0.6, 0.8, 0.0], [0.0, -0.6, 0.8]])
    inverse = np.linalg.inv(root)
    log_density = on_grid(lambda z: -0.5 * np.sum((z @ inverse.T) ** 2, axis=1), np.zeros(3), np.ones(3))
    found = grid_ends(log_density)
    np.testing.assert_allclose(found, [[-1.959964] * 3, [1.959964] * 3], atol=1e-4)


def test_ends_are_those_of_a_grid() -> None:
    """Six runs on a round bump, and against a grid whose noise is 5 % too large: its ends lie 0.1 SD further out."""
    assert np.sqrt(np.mean(off_by("round", 6) ** 2)) <= WANTED
    assert np.sqrt(np.mean(off_by("round", 6, noise=1.05) ** 2)) > 3 * WANTED


def test_a_linear_models_ends_are_those_of_the_t() -> None:
    """The exact linear case: the posterior is a t, and one with other tails would be seen."""
    target, begin = LINEAR.target(), LINEAR.beta
    mode, covariance, _ = mode_and_covariance(target, begin, scale=LINEAR.sd)
    runs = [importance(target, mode, covariance, rng=np.random.default_rng(seed)).flat for seed in range(6)]
    sd = LINEAR.sd * np.sqrt(LINEAR.dof / (LINEAR.dof - 2))
    exact = LINEAR.beta + np.outer(student.ppf(PROBABILITIES, LINEAR.dof), LINEAR.sd)
    found = np.array([np.quantile(one, PROBABILITIES, axis=0) for one in runs])
    assert np.sqrt(np.mean(((found - exact) / sd) ** 2)) <= WANTED
    thinner = LINEAR.beta + np.outer(student.ppf(PROBABILITIES, 10 * LINEAR.dof), LINEAR.sd)
    assert np.sqrt(np.mean(((found - thinner) / sd) ** 2)) > 1.5 * WANTED


@pytest.mark.slow
@pytest.mark.parametrize("name", list(MAPS))
def test_ends_are_those_of_a_grid_in_four_dimensions(name: str) -> None:
    """Sixteen runs a map; the worst single end may be off by half as much again."""
    off = off_by(name, 16)
    assert np.sqrt(np.mean(off**2)) <= WANTED
    assert off.max() <= 1.5 * WANTED
    assert np.sqrt(np.mean(off_by(name, 16, noise=1.05) ** 2)) > 3 * WANTED


@pytest.mark.slow
@pytest.mark.parametrize("name", list(MAPS))
def test_ends_are_those_of_long_chains(name: str) -> None:
    """What the chains' own Monte-Carlo error adds is taken from their autocorrelation."""
    chains, error = chain_ends(name)
    assert error <= WANTED
    assert np.sqrt(np.mean((importance_ends(name, 16) - chains) ** 2)) <= np.hypot(WANTED, error)
    assert np.sqrt(np.mean((chains - grid_ends(reference(name))) ** 2)) <= 2.0 * error


def chain_ends(name: str, *, walkers: int = 128, steps: int = 6000) -> tuple[np.ndarray, float]:
    """(2, p) ends in the reference's SDs by emcee's differential evolution, and their Monte-Carlo error."""
    import emcee

    density = density_of(name)
    rng = np.random.default_rng(77)
    sampler = emcee.EnsembleSampler(walkers, len(density.mean), density, vectorize=True, moves=emcee.moves.DEMove())
    begin = rng.multivariate_normal(density.mean, density.covariance, size=walkers)
    state = np.random.RandomState(int(rng.integers(2**32))).get_state()
    sampler.run_mcmc(emcee.State(begin, random_state=state), steps)
    discard = steps // 10
    flat = sampler.get_chain(discard=discard, flat=True)
    worth = len(flat) / sampler.get_autocorr_time(discard=discard, quiet=True).max()
    return ends_in_sd(name, flat), END_ERROR / float(np.sqrt(worth))
