"""Intervals: exact ones against scipy, the jackknife against its own promise, and coverage counted by hand."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from tactile_bayes.trial import accuracy
from tactile_bayes.trial.figures import (
    MIN_PATIENTS,
    Figure,
    Intervals,
    UndefinedError,
    clopper_pearson,
    figure,
    interval_from_values,
)
from tactile_bayes.trial.readings import Interval, ModalitySizes, Reading
from tactile_bayes.trial.summary import coverage

NOMINAL = 0.95


@pytest.mark.parametrize(("k", "n"), [(0, 1), (1, 1), (0, 25), (24, 25), (25, 25), (7, 19), (500, 1000)])
@pytest.mark.parametrize("confidence", [0.5, 0.95, 0.999])
def test_clopper_pearson_agrees_with_scipy(k: int, n: int, confidence: float) -> None:
    expected = stats.binomtest(k, n).proportion_ci(confidence, method="exact")
    assert clopper_pearson(k, n, confidence=confidence) == pytest.approx((expected.low, expected.high), abs=1e-12)


def test_clopper_pearson_mirrors() -> None:
    low, high = clopper_pearson(3, 25, confidence=NOMINAL)
    assert clopper_pearson(22, 25, confidence=NOMINAL) == pytest.approx((1 - high, 1 - low))


@pytest.mark.parametrize(("k", "n"), [(-1, 5), (6, 5), (0, 0)])
def test_clopper_pearson_refuses_what_is_no_share(k: int, n: int) -> None:
    with pytest.raises(ValueError, match="0 <= k <= n"):
        clopper_pearson(k, n, confidence=NOMINAL)


def test_jackknife_of_a_mean_is_students_interval() -> None:
    """For a mean the jackknife standard error is s / sqrt n exactly (Efron & Tibshirani 1993, eq. 11.8)."""
    x = np.random.default_rng(2).normal(3.0, 1.0, 12)
    left_out = np.array([np.delete(x, i).mean() for i in range(12)])
    expected = stats.t.interval(NOMINAL, 11, x.mean(), x.std(ddof=1) / np.sqrt(12))
    found = interval_from_values(float(x.mean()), left_out, scale="linear", confidence=NOMINAL)
    assert found == pytest.approx(expected)


def constant(values: list[float], *, scale: str = "log") -> tuple[float, float]:
    return interval_from_values(1.0, np.array(values), scale=scale, confidence=NOMINAL)


def test_jackknife_refuses_with_the_reason() -> None:
    with pytest.raises(UndefinedError, match=rf"at least {MIN_PATIENTS} patients \(found 7\)"):
        constant([1, 1.1, 1.2, 0.9, 1, 1, 1])
    with pytest.raises(UndefinedError, match="same whichever patient"):
        constant([1.0] * 10)
    with pytest.raises(UndefinedError, match="has no logarithm"):
        constant([1.0] * 9 + [0.0])
    with pytest.raises(UndefinedError, match="more than a factor of 1000"):
        constant([1e-300] * 5 + [1e300] * 5)


def trial(rng: np.random.Generator, *, patients: int, masses: int, shared: float, own: float) -> ModalitySizes:
    """Log-normal errors: a part shared by the masses of a patient and a part of each mass's own."""
    n = patients * masses
    ex_vivo = np.exp(rng.normal(2.8, 0.38, n))
    error = np.repeat(rng.normal(0, shared, patients), masses) + rng.normal(0, own, n)
    size = ex_vivo * np.exp(error)
    patient = np.repeat(np.arange(patients), masses)
    return ModalitySizes("tactile", patient, ex_vivo, size, tuple(size[:, np.newaxis]))


def mape_covered(trials: int, *, shrink: float = 1.0, by_mass: bool = False, **shape: float) -> float:
    """Share of intervals of the percent error that hold its true value, here that of half a million masses."""
    rng = np.random.default_rng(17)
    truth = np.log(accuracy.mape_percent(trial(rng, **(shape | {"patients": 500_000 // int(shape["masses"])}))))
    hits = 0
    for _ in range(trials):
        one = trial(rng, **shape)
        if by_mass:
            one = ModalitySizes("x", np.arange(len(one.patient)), one.ex_vivo_mm, one.size_mm, one.replicates_mm)
        found = figure(accuracy.mape_percent, one, scale="log", intervals=Intervals(NOMINAL))
        hits += _holds(found, truth, shrink=shrink)
    return hits / trials


def _holds(found: Figure, truth: float, *, shrink: float) -> bool:
    assert found.interval is not None
    low, high = np.log(found.interval)
    middle, reach = (low + high) / 2, shrink * (high - low) / 2
    return bool(abs(truth - middle) <= reach)


def test_jackknife_covers_about_as_often_as_it_says() -> None:
    """400 trials of the paper's size; 3 binomial standard deviations below 0.94 is 0.90."""
    assert mape_covered(400, patients=24, masses=1, shared=0.0, own=0.2) >= 0.90


def test_half_the_width_fails_the_same_check() -> None:
    assert mape_covered(400, shrink=0.5, patients=24, masses=1, shared=0.0, own=0.2) < 0.80


@pytest.mark.slow
@pytest.mark.parametrize("own", [0.2, 0.42])
def test_jackknife_coverage_in_full(own: float) -> None:
    assert 0.925 <= mape_covered(4000, patients=24, masses=1, shared=0.0, own=own) <= 0.97


@pytest.mark.slow
def test_masses_of_one_patient_must_go_together() -> None:
    """Left out one by one, masses that err together make the interval far too short."""
    shape = {"patients": 12, "masses": 4, "shared": 0.4, "own": 0.05}
    assert mape_covered(1000, **shape) >= 0.91
    assert mape_covered(1000, by_mass=True, **shape) < 0.80


EX_VIVO_MM = {("P1", str(mass)): 10.0 for mass in range(20)}


def interval_reading(mass: str, low: float, high: float, *, probability: float = 0.95) -> Reading:
    return Reading(("P1", mass), "tactile", 1, "detected", low, Interval(low, high, probability))


def test_coverage_counts_ends_as_covered_and_splits_by_probability() -> None:
    wide = [interval_reading("1", 10, 12), interval_reading("2", 8, 10), interval_reading("3", 11, 12)]
    half, full = coverage([*wide, interval_reading("1", 9, 11, probability=0.5)], EX_VIVO_MM, confidence=NOMINAL)
    assert (half.probability, half.covered, half.n) == (0.5, 1, 1)
    assert (full.probability, full.covered, full.n, full.masses) == (0.95, 2, 3, 3)
    assert full.fraction_interval == pytest.approx(clopper_pearson(2, 3, confidence=NOMINAL))


def test_repeating_the_maps_of_a_mass_does_not_sharpen_coverage() -> None:
    one_each = [interval_reading(str(i), 9, 11 if i else 9.5) for i in range(20)]
    (once,) = coverage(one_each, EX_VIVO_MM, confidence=NOMINAL)
    (five_times,) = coverage(one_each * 5, EX_VIVO_MM, confidence=NOMINAL)
    assert (five_times.n, five_times.covered, five_times.masses) == (100, 95, 20)
    assert five_times.fraction_interval == pytest.approx(once.fraction_interval)
