"""Weighted draws and chains on maps that differ; the proposal on the maps that used to leave it for chains."""

from __future__ import annotations

import numpy as np
import pytest

from tactile_bayes.inference import importance as sampling
from tactile_bayes.inference.importance import TOO_WIDE, Gaussians
from tactile_bayes.posterior.draw import SamplingTarget, importance_draws
from tactile_bayes.posterior.fit import FieldFit
from validation.method_agreement import MAPS, differences, fit_of, rms, under_other_prior


@pytest.fixture(scope="module")
def fit() -> FieldFit:
    """A strong wide lump in a scan: of its errors a field of little evidence would leave the widths much less sure."""
    return fit_of(MAPS["scan, wide and strong"]())


@pytest.fixture(scope="module")
def nearly_independent(fit: FieldFit) -> SamplingTarget:
    return fit.sampling_target()


def tail_shape(density: SamplingTarget, gaussians: Gaussians) -> float:
    """Pareto shape of the weights of 8,192 points."""
    rng = np.random.default_rng(2)
    sampler = sampling._adapted_start(density.log_density, gaussians, rng=rng, options=sampling.ImportanceOptions())
    while sampler.number < 8192:
        sampler.extend(sampler.points)
    return sampler.shape


@pytest.mark.long
def test_a_plain_map_with_nearly_independent_errors_needs_no_chains(nearly_independent: SamplingTarget) -> None:
    density = nearly_independent
    assert density.parts is not None
    assert density.parts.widest(density.covariance) > TOO_WIDE
    found = importance_draws(density, rng=np.random.default_rng(1)).diagnostics
    assert found["pareto_k"] < 0.3
    assert found["evaluations"] <= 20480
    assert tail_shape(density, density.parts) < 0.2
    # the control: under one Gaussian for all fields the tail is heavy, and heavier with every doubling
    assert tail_shape(density, Gaussians.single(density.mean, density.covariance)) > 0.5


def test_gaussians_of_all_fields_hold_the_evidence(fit: FieldFit, nearly_independent: SamplingTarget) -> None:
    """The sampled evidence is nearer to theirs than to that of fields with a hundredth of the density at the mode."""
    sampled = importance_draws(nearly_independent, rng=np.random.default_rng(2)).diagnostics["log_evidence"]
    assert nearly_independent.parts is not None
    all_fields = nearly_independent.parts.log_evidence  # type: ignore[attr-defined]
    assert abs(sampled - all_fields) < 0.03
    assert abs(sampled - all_fields) < abs(sampled - fit.log_evidence)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["field of 1.5 mm", "half covered", "scan, small"])
def test_chains_and_weighted_draws_agree_and_another_prior_does_not(name: str) -> None:
    fit = fit_of(MAPS[name]())
    own, other = differences(
        fit.sampling_target(), [fit.sampling_target(), under_other_prior(fit).sampling_target()], seed=1
    )
    assert rms(own) < 1.6
    assert np.abs(own).max() < 4.5
    assert rms(other) > 2.5
