"""Intervals corrected for rare misses and few influential patients, and ratios over common masses only."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

from tactile_bayes.trial import lines
from tactile_bayes.trial.accuracy import mape_figure, mape_ratios, share_interval
from tactile_bayes.trial.figures import JACKKNIFE, Intervals, effective_number, interval_from_values, kurtosis_freedom
from tactile_bayes.trial.method_comparison import compare_methods, limit_figures, limits, limits_unlinked
from tactile_bayes.trial.readings import ModalitySizes, Reading, Trial
from validation.simulated_trials import ErrorModel, check_intervals

CORRECTED = Intervals(0.95, method="corrected")
SINGLE_MISS = ErrorModel(0.0, 0.2, miss=0.04)


def trial(rng: np.random.Generator, patient: np.ndarray, *, sd: float = 0.2, shared: float = 0.0) -> ModalitySizes:
    """Log-normal errors; `shared` is the patient's part of the SD."""
    e = 16 * np.exp(rng.normal(0, 0.38, len(patient)))
    of_patient = rng.normal(0, shared, patient.max() + 1)[patient]
    size = e * np.exp(0.02 + of_patient + rng.normal(0, math.sqrt(sd**2 - shared**2), len(patient)))
    return ModalitySizes("tactile", patient, e, size, tuple(size[:, None]))


def masses() -> ModalitySizes:
    return trial(np.random.default_rng(1999), np.minimum(np.arange(25), 23))


@pytest.mark.parametrize("seed", [1, 2])
def test_intervals_of_mape_hold_with_rare_misses(seed: int) -> None:
    """400 trials; 3 binomial standard deviations below 0.95 is 0.917."""
    check = check_intervals(masses(), SINGLE_MISS, intervals=CORRECTED, trials=400, seed=seed)
    assert check is not None
    assert check.share >= 0.917


def test_the_bootstrap_fails_the_same_check() -> None:
    bootstrap = Intervals(0.95, method="bca", resamples=300)
    check = check_intervals(masses(), SINGLE_MISS, intervals=bootstrap, trials=400, seed=1)
    assert check is not None
    assert check.share < 0.90


def test_without_a_miss_the_interval_over_masses_found_stays() -> None:
    """The lower end is the jackknife's, the upper one allows for the misses that 25 masses cannot rule out."""
    plain, found = masses(), mape_figure(masses(), intervals=CORRECTED)
    assert found.interval is not None
    jackknife = mape_figure(plain, intervals=JACKKNIFE).interval
    assert jackknife is not None
    assert found.interval[0] == pytest.approx(jackknife[0])
    most = share_interval(0.0, effective_number(np.ones(25), plain.patient), confidence=0.95)[1]
    assert found.value is not None
    expected = found.value + math.hypot(jackknife[1] - found.value, (100 - found.value) * most)
    assert found.interval[1] == pytest.approx(expected)


@pytest.mark.parametrize(("k", "n"), [(0, 25), (1, 25), (7, 19), (25, 25)])
def test_shares_have_jeffreys_interval(k: int, n: int) -> None:
    """Equal tails of Beta(k + 1/2, n - k + 1/2), as R's binom::binom.bayes; the share observed is inside."""
    low, high = stats.beta(k + 0.5, n - k + 0.5).ppf([0.025, 0.975])
    assert share_interval(k / n, n, confidence=0.95) == pytest.approx((min(low, k / n), max(high, k / n)))


def test_effective_numbers_count_patients_by_their_weight() -> None:
    patient = np.array([0, 0, 1, 2])
    assert effective_number(np.ones(4), patient) == pytest.approx(16 / 6)
    assert effective_number(np.array([1.0, 0, 0, 0]), patient) == 1
    assert effective_number(1e300 * np.ones(4), np.arange(4)) == pytest.approx(4)


def test_fewer_degrees_of_freedom_widen_by_students_t() -> None:
    values = np.random.default_rng(0).normal(3, 0.1, 12)
    full = interval_from_values(3.0, values, scale="linear", confidence=0.95)
    few = interval_from_values(3.0, values, scale="linear", confidence=0.95, freedom=5)
    assert (few[1] - few[0]) / (full[1] - full[0]) == pytest.approx(stats.t.ppf(0.975, 5) / stats.t.ppf(0.975, 11))
    assert kurtosis_freedom(np.array([1.0, -1.0] * 6)) == pytest.approx(36)
    assert kurtosis_freedom(np.array([12.0, *[0.0] * 11])) < 4


def test_limits_over_patients_have_the_values_of_the_exact_ones() -> None:
    rng = np.random.default_rng(4)
    plain = masses()
    groups = tuple(size * np.exp(rng.normal(0, 0.1, 1 + i % 3)) for i, size in enumerate(plain.size_mm))
    size = np.array([group.mean() for group in groups])
    replicated = ModalitySizes("tactile", plain.patient, plain.ex_vivo_mm, size, groups)
    single = limits(plain.size_mm - plain.ex_vivo_mm)
    several = limits_unlinked([np.array([e]) for e in replicated.ex_vivo_mm], list(groups))
    for one, expected in ((plain, single), (replicated, several)):
        found = limit_figures(one, intervals=CORRECTED)
        assert found["limit_low_mm"].value == pytest.approx(expected.low)
        assert found["limit_high_mm"].value == pytest.approx(expected.high)


def held(intervals: str, trials: int = 300) -> float:
    """Share of trials, 11 of 14 patients with two masses that err together, whose upper ratio limit is held."""
    rng, patient = np.random.default_rng(11), np.concatenate([np.repeat(np.arange(11), 2), [11, 12, 13]])
    truth, hits = 0.02 + 1.959964 * 0.2, 0
    for _ in range(trials):
        one = trial(rng, patient, shared=0.16)
        ends = (
            limit_figures(one, intervals=CORRECTED)["limit_high_log_ratio"].interval
            if intervals == "patients"
            else limits(np.log(one.size_mm / one.ex_vivo_mm)).high_interval
        )
        assert ends is not None
        hits += ends[0] <= truth <= ends[1]
    return hits / trials


@pytest.mark.long
def test_limits_over_patients_hold_where_masses_of_a_patient_err_together() -> None:
    assert held("patients") >= 0.91


def test_exact_limits_fail_the_same_check() -> None:
    assert held("exact") < 0.90


def slope_held(method: str, trials: int = 150) -> float:
    """Share of trials whose slope's interval holds, of those that are given one: a rare trial rests on one patient."""
    rng, hits, given = np.random.default_rng(5), 0, 0
    for _ in range(trials):
        one = trial(rng, np.arange(20), sd=0.4)
        chosen = Intervals(0.95, method=method)  # type: ignore[arg-type]
        ends = compare_methods(one, intervals=chosen).ols_slope_interval
        if ends is not None:
            given += 1
            hits += ends[0] <= math.exp(0.02 + 0.4**2 / 2) <= ends[1]
    assert given >= 0.97 * trials
    return hits / given


@pytest.mark.slow
def test_slopes_hold_more_often_than_by_the_plain_jackknife() -> None:
    plain, corrected = slope_held("jackknife", 400), slope_held("corrected", 400)
    assert corrected > plain + 0.02
    assert corrected >= 0.92


def test_each_line_is_fitted_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Intercept, slope and both jackknifes, over patients and over masses, share the lines without one patient."""
    fitted, fit = [], lines.weighted_deming
    monkeypatch.setattr(lines, "weighted_deming", lambda x, y, **options: fitted.append(len(x)) or fit(x, y, **options))
    compare_methods(trial(np.random.default_rng(1), np.arange(12)), intervals=JACKKNIFE)
    assert fitted == [12, *[11] * 12]


def test_ratios_are_over_common_masses_only() -> None:
    """Tactile reads all six masses, four of them badly; ultrasound only the two that both read alike."""
    ex_vivo = {(f"P{i}", "1"): 10.0 for i in range(6)}
    tactile = [11.0, 11.0, 15.0, 15.0, 15.0, 15.0]
    readings = [Reading(key, "tactile", 1, "detected", size) for key, size in zip(ex_vivo, tactile, strict=True)]
    readings += [Reading(key, "ultrasound", 1, "detected", 11.0) for key in list(ex_vivo)[:2]]
    found = mape_ratios(Trial(readings, ex_vivo).sizes(), intervals=JACKKNIFE)["ultrasound"]
    assert found.masses == found.masses_detected == 2
    assert found.ratio == pytest.approx(1.0)
    assert found.ratio_detected == pytest.approx(1.0)
