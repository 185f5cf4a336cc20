"""The certified regressions as posteriors: with flat priors their deviations are the certified ones.

The posterior is nearly a multivariate t with 242 degrees of freedom, whose standard deviation is
sqrt(242/240) = 1.0042 times the certified one. The standard deviation of n effective draws is known to
1/sqrt(2 n): 1.1 % of 4000 draws, 2.5 % of 800. The checks allow four of these.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from nist import DATASETS, Certified, read

from tactile_bayes.inference.draws import ParameterDraws
from tactile_bayes.inference.ensemble import ensemble
from tactile_bayes.inference.modes import laplace, mode_and_covariance, optimise
from tactile_bayes.posterior.bump import ErrorModel
from tactile_bayes.posterior.white import Target

DOF = 242.0
T_FACTOR = np.sqrt(DOF / (DOF - 2))


def target(nist: Certified, *, noise: float = 1.0) -> Target:
    sse = float(np.sum((nist.y - nist.predict(nist.theta[None])[0]) ** 2))
    errors = ErrorModel(noise_sd=noise * nist.residual_sd, inflation=1.0, dof=DOF)
    return Target(nist.predict, nist.y, np.ones(250), lambda theta: np.zeros(len(theta)), errors, sse, 8)


def draws(method: str, nist: Certified, *, noise: float = 1.0) -> ParameterDraws:
    rng = np.random.default_rng(8)
    density = target(nist, noise=noise)
    if method == "laplace":
        return laplace(density, nist.theta, scale=nist.sd, dof=DOF, rng=rng)
    mode, covariance, _ = mode_and_covariance(density, nist.theta, scale=nist.sd)
    if method == "optimise":
        return optimise(mode, covariance * (DOF + 8) / DOF, dof=DOF, rng=rng)
    return ensemble(density, mode, covariance, rng=rng)


def worst_in_errors(found: ParameterDraws, nist: Certified) -> float:
    """Largest distance from the certified deviations, in Monte-Carlo standard errors."""
    worth = found.diagnostics.get("ess_bulk", float(len(found.flat)))
    ratio = found.flat.std(axis=0) / (T_FACTOR * nist.sd)
    return float(np.abs(ratio - 1).max() * np.sqrt(2 * worth))


@pytest.mark.parametrize("method", ["optimise", "laplace"])
@pytest.mark.parametrize("name", DATASETS)
def test_deviations_are_the_certified_ones(shared_data: Path, name: str, method: str) -> None:
    nist = read(shared_data, name)
    found = draws(method, nist)
    assert worst_in_errors(found, nist) < 4
    assert np.abs((found.flat.mean(axis=0) - nist.theta) / nist.sd).max() < 4 / np.sqrt(4000)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["Gauss1", "Gauss2"])
def test_the_ensemble_finds_the_certified_deviations(shared_data: Path, name: str) -> None:
    nist = read(shared_data, name)
    assert worst_in_errors(draws("ensemble", nist), nist) < 4


@pytest.mark.slow
def test_the_ensemble_on_overlapping_peaks(shared_data: Path) -> None:
    """Gauss3's peaks overlap: the posterior leans a little, its means by up to 0.1 SD, its deviations by 3 %."""
    nist = read(shared_data, "Gauss3")
    assert worst_in_errors(draws("ensemble", nist), nist) < 5


@pytest.mark.parametrize("method", ["optimise", "laplace"])
def test_half_the_noise_is_found_out(shared_data: Path, method: str) -> None:
    nist = read(shared_data, "Gauss1")
    assert worst_in_errors(draws(method, nist, noise=0.5), nist) > 4
