"""The Bayesian model of errors: its likelihood against a dense normal one, its draws against what made the data."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

from tactile_bayes.posterior.ensemble import EnsembleOptions, ensemble
from tactile_bayes.trial.check_intervals import ErrorModel
from tactile_bayes.trial.next_mass import LogModel, expected_error_percent, next_mass
from tactile_bayes.trial.readings import ModalitySizes, Reading

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
    rho2, tau2, omega2 = np.exp(2 * theta[2:])
    x = np.log(found.ex_vivo_mm)
    spread2 = x.std(ddof=1) ** 2
    prior2 = max(spread2 - CALIPER**2, 0.25 * spread2)
    keep = prior2 / (prior2 + CALIPER**2)
    mass = np.repeat(np.arange(len(x)), [len(group) for group in found.replicates_mm])
    same_mass, same_patient = mass[:, None] == mass, found.patient[mass][:, None] == found.patient[mass]
    covariance = (tau2 + slope**2 * keep * CALIPER**2) * same_mass + rho2 * same_patient + omega2 * np.eye(len(mass))
    mean = x.mean() + bias + slope * keep * (x - x.mean())[mass]
    return float(stats.multivariate_normal(mean, covariance).logpdf(np.log(np.concatenate(found.replicates_mm))))


def prior(theta: np.ndarray) -> float:
    return float(
        -0.5 * (theta[0] / 0.5) ** 2 - 0.5 * ((theta[1] - 1) / 0.5) ** 2
        + np.sum(theta[2:] - 0.5 * np.exp(2 * theta[2:]) / 0.25)
    )  # fmt: skip


def test_the_likelihood_is_that_of_one_big_normal() -> None:
    """Up to a constant: differences between points agree."""
    found = modality()
    model = LogModel(found, np.full(len(found.size_mm), CALIPER))
    points = np.array([0.05, 1.0, -1.5, -1.2, -2.2]) + np.random.default_rng(1).normal(0, 0.3, (6, 5))
    ours = model.log_density(points)
    theirs = np.array([dense(found, point) + prior(point) for point in points])
    assert ours - ours[0] == pytest.approx(theirs - theirs[0], abs=1e-8)


def test_the_next_error_is_that_of_the_model() -> None:
    """At slope 1 it does not depend on size: the closed form of the error model."""
    found = modality()
    model = LogModel(found, np.full(len(found.size_mm), CALIPER))
    theta = np.array([[0.1, 1.0, math.log(0.1), math.log(0.2), math.log(0.15)]])
    expected = ErrorModel(0.1, math.sqrt(0.1**2 + 0.2**2 + 0.15**2), miss=0.04).true_mape_percent
    assert expected_error_percent(model, theta, np.array([0.04]))[0] == pytest.approx(expected)


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


def test_draws_find_what_made_the_data_and_who_errs_less() -> None:
    made, ex_vivo = readings(2, patients=60)
    found = next_mass(made, ex_vivo, {}, sample=quick, rng=np.random.default_rng(3))
    tactile = found.posteriors["tactile"].summaries
    assert tactile["bias_percent"][1] < 100 * math.expm1(0.05) < tactile["bias_percent"][2]
    assert tactile["replicate_sd"][0] == pytest.approx(0.1, rel=0.25)
    assert tactile["log_slope"][1] < 1 < tactile["log_slope"][2]
    truth = ErrorModel(0.05, math.hypot(0.1, 0.1)).true_mape_percent
    assert tactile["mape_percent"][1] < truth < tactile["mape_percent"][2]
    assert found.probability_less_error["tactile errs less than ultrasound"] > 0.99
    assert any("errs less" in line for line in found.lines())


def test_few_patients_get_no_model_and_are_told_why() -> None:
    made, ex_vivo = readings(4, patients=5)
    found = next_mass(made, ex_vivo, {}, sample=quick, rng=np.random.default_rng(0))
    assert found.posteriors == {}
    assert "at least 8 patients" in found.left_out["tactile"]
    assert found.as_document()["probability_less_error"] == {}


@pytest.mark.slow
def test_intervals_of_the_next_error_cover() -> None:
    truth = ErrorModel(0.05, math.hypot(0.25, 0.1)).true_mape_percent
    hits = 0
    for seed in range(60):
        made, ex_vivo = readings(seed, sds=(0.25, 0.4))
        made = [one for one in made if one.modality == "tactile"]
        found = next_mass(made, ex_vivo, {}, sample=quick, rng=np.random.default_rng(seed))
        _, low, high = found.posteriors["tactile"].summaries["mape_percent"]
        hits += low < truth < high
    assert stats.binomtest(hits, 60, 0.95).pvalue > 0.005
