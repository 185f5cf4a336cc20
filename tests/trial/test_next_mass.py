"""The Bayesian model of errors: its likelihood against a dense normal one, its draws against what made the data."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest
from scipy import stats

from tactile_bayes.errors import NotConvergedError
from tactile_bayes.inference.ensemble import EnsembleOptions, ensemble
from tactile_bayes.inference.importance import ImportanceOptions, importance
from tactile_bayes.inference.modes import mode_and_covariance
from tactile_bayes.trial import next_mass as model_of
from tactile_bayes.trial.next_mass import LogModel, draw, expected_error_percent, next_mass, variances
from tactile_bayes.trial.readings import ModalitySizes, Reading, Trial
from validation.next_mass_coverage import DESIGNS, Design, half_normal_log_prior, ranks
from validation.simulated_trials import ErrorModel

CALIPER = 0.05


def modality(seed: int = 0, masses: int = 9, patients: int = 6) -> ModalitySizes:
    rng = np.random.default_rng(seed)
    e = rng.lognormal(2.8, 0.4, masses)
    groups = tuple(np.exp(np.log(e[i]) + rng.normal(0, 0.3) + rng.normal(0, 0.1, 1 + i % 3)) for i in range(masses))
    size = np.array([group.mean() for group in groups])
    return ModalitySizes("tactile", np.arange(masses) % patients, e, size, groups)


def dense(found: ModalitySizes, theta: np.ndarray) -> float:
    """Log density of all log readings at once, by one covariance matrix."""
    bias, slope = theta[:2]
    rho2, tau2, omega2 = (float(one[0]) for one in variances(theta[None]))
    x = np.log(found.ex_vivo_mm)
    spread2 = x.std(ddof=1) ** 2
    prior2 = max(spread2 - CALIPER**2, 0.25 * spread2)
    keep = prior2 / (prior2 + CALIPER**2)
    mass = np.repeat(np.arange(len(x)), [len(group) for group in found.replicates_mm])
    same_mass, same_patient = mass[:, None] == mass, found.patient[mass][:, None] == found.patient[mass]
    covariance = (tau2 + slope**2 * keep * CALIPER**2) * same_mass + rho2 * same_patient + omega2 * np.eye(len(mass))
    mean = x.mean() + bias + slope * keep * (x - x.mean())[mass]
    return float(stats.multivariate_normal(mean, covariance).logpdf(np.log(np.concatenate(found.replicates_mm))))


def prior(theta: np.ndarray, *, spread: float) -> float:
    """(r^2 + c^2)^(-3/2) in bias, slope error and SD, uniform shares, and what the logarithm and logits add."""
    bias, slope, log_total, *logits = theta
    square = bias**2 + ((slope - 1) * spread) ** 2 + math.exp(2 * log_total) + CALIPER**2
    shares = 1 / (1 + np.exp(-np.array(logits)))
    jacobian = log_total + float(np.sum(np.log(shares * (1 - shares))))
    return -1.5 * math.log(square) - 0.5 * (bias / 0.5) ** 2 - 0.5 * ((slope - 1) / 0.5) ** 2 + jacobian


def test_the_likelihood_is_that_of_one_big_normal() -> None:
    """Up to a constant: differences between points agree."""
    found = modality()
    model = LogModel(found, np.full(len(found.size_mm), CALIPER))
    points = np.array([0.05, 1.0, -1.2, -0.5, 0.3]) + np.random.default_rng(1).normal(0, 0.3, (6, 5))
    ours = model.log_density(points)
    theirs = np.array([dense(found, point) + prior(point, spread=model.spread) for point in points])
    assert ours - ours[0] == pytest.approx(theirs - theirs[0], abs=1e-8)


def test_the_next_error_is_that_of_the_model() -> None:
    """At slope 1 it does not depend on size: the closed form of the error model."""
    found = modality()
    model = LogModel(found, np.full(len(found.size_mm), CALIPER))
    theta = np.array([[0.1, 1.0, 0.5 * math.log(0.1**2 + 0.2**2 + 0.15**2), 0.0, 0.0]])
    expected = ErrorModel(0.1, math.sqrt(0.1**2 + 0.2**2 + 0.15**2)).true_mape_percent
    assert expected_error_percent(model, theta)[0] == pytest.approx(expected)


def readings(seed: int, *, patients: int = 24, sds: tuple[float, float] = (0.1, 0.4)) -> tuple[list[Reading], dict]:
    rng = np.random.default_rng(seed)
    made, ex_vivo = [], {}
    for i in range(patients):
        key = (f"P{i:03d}", "1")
        true = rng.normal(2.8, 0.4)
        ex_vivo[key] = math.exp(true + rng.normal(0, CALIPER))
        for name, sd in zip(("tactile", "ultrasound"), sds, strict=True):
            shared = rng.normal(0.05, sd)
            for replicate in range(1, 4 if name == "tactile" else 2):
                size = math.exp(true + shared + rng.normal(0, 0.1))
                made.append(Reading(key, name, replicate, "detected", size))
    return made, ex_vivo


def quick(log_density, centre, covariance, *, rng):
    options = EnsembleOptions(least_ess=200, most_rhat=1.05, ensembles=2)
    return ensemble(log_density, centre, covariance, rng=rng, options=options)


@pytest.mark.long
def test_draws_find_what_made_the_data_and_who_errs_less() -> None:
    made, ex_vivo = readings(2, patients=60)
    found = next_mass(Trial(made, ex_vivo), sample=quick, rng=np.random.default_rng(3))
    tactile = found.modalities["tactile"]
    assert tactile.bias_percent.low < 100 * math.expm1(0.05) < tactile.bias_percent.high
    assert tactile.replicate_sd.median == pytest.approx(0.1, rel=0.25)
    assert tactile.log_slope.low < 1 < tactile.log_slope.high
    truth = ErrorModel(0.05, math.hypot(0.1, 0.1)).true_mape_percent
    assert tactile.mape_percent.low < truth < tactile.mape_percent.high
    assert found.probability_less_error["tactile errs less than ultrasound"] > 0.99
    assert any("errs less" in line for line in found.lines())
    # beside errors of means over replicates, the report says of how many readings this one is
    assert all("expected error of one reading" in line for line in found.lines()[1 : 1 + len(found.modalities)])


def test_few_patients_get_no_model_and_are_told_why() -> None:
    made, ex_vivo = readings(4, patients=5)
    found = next_mass(Trial(made, ex_vivo), sample=quick, rng=np.random.default_rng(0))
    assert found.modalities == {}
    assert "at least 8 patients" in found.left_out["tactile"]
    assert found.probability_less_error == {}


@pytest.mark.long
def test_a_modality_whose_draws_do_not_converge_has_no_model_and_the_others_have() -> None:
    made, ex_vivo = readings(2, patients=12)
    made = [one for one in made if one.modality == "tactile"]
    exact = [Reading(key, "exact", 1, "detected", size_mm=mm) for key, mm in ex_vivo.items()]

    def failing(log_density, centre, covariance, *, rng):
        if abs(centre[0]) < 1e-9:  # the bias of sizes that are those after excision
            raise NotConvergedError("not converged after 9 steps: R-hat 2; run longer (max_steps = 99)")
        return quick(log_density, centre, covariance, rng=rng)

    found = next_mass(Trial([*made, *exact], ex_vivo), sample=failing, rng=np.random.default_rng(0))
    assert found.left_out == {"exact": "not converged after 9 steps: R-hat 2"}
    assert [*found.modalities] == ["tactile"]
    assert found.lines()[-1] == "exact: no model: not converged after 9 steps: R-hat 2"


def test_a_total_sd_splits_into_its_parts() -> None:
    theta = np.array([[0.0, 1.0, math.log(0.3), math.log(0.25 / 0.75), math.log(0.6 / 0.4)]])
    rho2, tau2, omega2 = (float(one[0]) for one in variances(theta))
    assert omega2 == pytest.approx(0.25 * 0.09)
    assert rho2 == pytest.approx(0.6 * 0.75 * 0.09)
    assert rho2 + tau2 + omega2 == pytest.approx(0.09)


def test_a_trial_without_a_miss_does_not_rule_misses_out() -> None:
    """Beta(1/3, 25 1/3): median 0.5 %, 97.5 % quantile 7.6 % by scipy."""
    made, ex_vivo = readings(5, patients=25)
    found = next_mass(Trial(made, ex_vivo), sample=draw, rng=np.random.default_rng(0)).modalities["tactile"]
    share = found.miss_share
    expected = stats.beta(1 / 3, 25 + 1 / 3).ppf([0.5, 0.025, 0.975])
    assert (share.median, share.low, share.high) == pytest.approx(tuple(expected), abs=0.006)
    assert found.mape_percent.high > found.mape_detected_percent.high


def rough(log_density, centre, covariance, *, rng):
    mode, about, _ = mode_and_covariance(log_density, centre, scale=np.sqrt(np.diag(covariance)))
    options = ImportanceOptions(accuracy_sd=0.2)
    try:
        return importance(log_density, mode, about, rng=rng, options=options)
    except NotConvergedError:
        return quick(log_density, centre, covariance, rng=rng)


def scores(design: Design, trials: int, *, seed: int = 7) -> np.ndarray:
    """Normal scores of the true error's rank among the draws; standard normal when intervals of every level hold."""
    found = np.array([one[1] for one in ranks(design, trials=trials, seed=seed, sample=rough)])
    return stats.norm.ppf(np.clip(found, 1e-4, 1 - 1e-4))


FEW = Design(12, 1, 1, 0.0, 0.15, 0.10)


def test_the_next_error_is_neither_over_nor_underestimated() -> None:
    """Mean score of 30 trials with one reading a mass: within 3 standard errors of 0."""
    assert abs(float(scores(FEW, 30).mean())) < 3 / math.sqrt(30)


@pytest.mark.slow
def test_separate_priors_on_the_sds_fail_the_same_check(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(model_of, "log_prior", half_normal_log_prior)
    assert float(scores(FEW, 30).mean()) < -3 / math.sqrt(30)


@pytest.mark.slow
@pytest.mark.parametrize("name", DESIGNS)
@pytest.mark.parametrize("level", [0.5, 0.8, 0.95])
def test_intervals_of_the_next_error_hold_as_often_as_they_say(name: str, level: float) -> None:
    """400 trials: at most 3 binomial standard deviations, and 2 points for what record 0078 leaves, from nominal."""
    found = _all_ranks(name)
    off = 3 * math.sqrt(level * (1 - level) / len(found)) + 0.02
    assert abs(np.mean(np.abs(found - 0.5) < level / 2) - level) < off


@cache
def _all_ranks(name: str) -> np.ndarray:
    return np.array([one[1] for one in ranks(DESIGNS[name], trials=400, seed=1999)])
