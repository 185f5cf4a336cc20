"""Pairs of modalities, resampled intervals, and simulated trials: exact small cases and their own promises."""

from __future__ import annotations

import math
from itertools import product

import numpy as np
import pytest
from scipy import stats

from tactile_bayes.trial import accuracy
from tactile_bayes.trial import accuracy as origin_line
from tactile_bayes.trial import replicates as spread
from tactile_bayes.trial.accuracy import holm, mape_ratio, on_common_masses, paired_comparisons, sign_flip
from tactile_bayes.trial.figures import (
    JACKKNIFE,
    Intervals,
    Sample,
    SumStatistic,
    UndefinedError,
    bca_interval,
    draw_patients,
    figure,
)
from tactile_bayes.trial.planning import PlanCase, map_gains, pilot_errors, simulate_design
from tactile_bayes.trial.readings import ModalitySizes
from validation.simulated_trials import ErrorModel, check_intervals, simulate


def sizes(
    name: str, size: list[float], *, mass: list[int] | None = None, e: list[float] | None = None
) -> ModalitySizes:
    n = len(size)
    return ModalitySizes(
        name,
        np.arange(n),
        np.array(e or [10.0 + i for i in range(n)]),
        np.array(size, dtype=float),
        tuple(np.array([y] if y else []) for y in size),
        mass=np.arange(n) if mass is None else np.array(mass),
    )


def trial(seed: int, n: int = 24, sd: float = 0.3, name: str = "tactile") -> ModalitySizes:
    rng = np.random.default_rng(seed)
    e = rng.lognormal(2.8, 0.4, n)
    patient = np.minimum(np.arange(n), n - 2)
    groups = tuple(y * rng.lognormal(0, 0.1, 3) for y in e * rng.lognormal(0, sd, n))
    return ModalitySizes(name, patient, e, np.array([group.mean() for group in groups]), groups)


STATISTICS = {
    "mape": accuracy.mape_percent, "weighted": accuracy.weighted_mape_percent, "mae": accuracy.mae_mm,
    "ratio": accuracy.geometric_ratio, "slope": origin_line.slope,
    **origin_line.CORRELATIONS, **spread.SPREAD,
}  # fmt: skip


@pytest.mark.parametrize("name", STATISTICS)
def test_leaving_out_by_sums_is_leaving_out(name: str) -> None:
    """Two ways to one number: the sums less a patient's, and the statistic of all other masses."""
    one, statistic = trial(1), STATISTICS[name]
    assert isinstance(statistic, SumStatistic)
    expected = [statistic(one.only(one.patient != patient)) for patient in one.patients]
    assert Sample(statistic, (one,)).left_out() == pytest.approx(np.array(expected), rel=1e-10)


@pytest.mark.parametrize("name", STATISTICS)
def test_redrawing_by_sums_is_redrawing(name: str) -> None:
    one, statistic = trial(2), STATISTICS[name]
    draws = draw_patients(len(one.patients), resamples=20, seed=3)
    plain = Sample(lambda masses: statistic(masses), (one,))
    assert Sample(statistic, (one,)).redrawn(draws) == pytest.approx(plain.redrawn(draws), rel=1e-10)


def test_bca_agrees_with_scipy() -> None:
    """Same data, other draws: ends agree within the error of 9,999 draws."""
    one = trial(4)
    errors = np.abs(one.size_mm / one.ex_vivo_mm - 1) * 100
    by_patient = ModalitySizes(one.name, np.arange(24), one.ex_vivo_mm, one.size_mm, one.replicates_mm)
    chosen = Intervals(0.95, method="bca", resamples=9_999)
    found = figure(accuracy.mape_percent, by_patient, scale="log", intervals=chosen).interval
    expected = stats.bootstrap((errors,), np.mean, method="BCa", rng=np.random.default_rng(5)).confidence_interval
    assert found == pytest.approx((expected.low, expected.high), rel=0.03)


def test_bca_of_a_symmetric_figure_is_between_its_quantiles() -> None:
    drawn = np.concatenate([np.linspace(-1, 1, 2001)])
    left_out = np.array([-1.0, 1.0] * 5)
    assert bca_interval(0.0, drawn, left_out, confidence=0.9) == pytest.approx(
        np.quantile(drawn, (0.05, 0.95)), abs=1e-9
    )


def test_bootstraps_refuse_what_they_cannot_do() -> None:
    few = figure(accuracy.mape_percent, sizes("x", [11.0] * 5), scale="log", intervals=Intervals(0.95, method="bca"))
    assert few.interval is None
    assert "at least 8 patients" in few.interval_reason
    with pytest.raises(UndefinedError, match="undefined"):
        bca_interval(1.5, np.array([1.0, np.nan, 2.0]), np.arange(8.0), confidence=0.9)
    with pytest.raises(UndefinedError, match="same whichever"):
        bca_interval(1.0, np.ones(10), np.ones(8), confidence=0.9)


def test_sign_flips_by_brute_force() -> None:
    differences = np.array([0.3, -0.1, 0.2, 0.5, 0.0, 0.1])
    kept = differences[differences != 0]
    sums = [abs(sum(s * d for s, d in zip(signs, kept, strict=True))) for signs in product((1, -1), repeat=5)]
    expected = np.mean(np.array(sums) >= abs(kept.sum()) - 1e-12)
    assert sign_flip(differences, seed=0) == pytest.approx(expected)


def test_random_sign_flips_come_near_the_exact_ones() -> None:
    differences = np.random.default_rng(6).normal(0.35, 1, 14)
    exact = sign_flip(differences, seed=0)
    tiny = np.concatenate([differences, np.full(2, 1e-12)])
    assert sign_flip(tiny, seed=0) == pytest.approx(exact, abs=0.02)
    assert sign_flip(np.zeros(4), seed=0) is None
    assert sign_flip(np.array([1.0]), seed=0) == 1.0


def test_sign_flips_reject_as_often_as_they_say() -> None:
    rng = np.random.default_rng(7)
    p = [sign_flip(rng.normal(0, 1, 12), seed=0) for _ in range(400)]
    assert stats.binomtest(sum(value < 0.05 for value in p), 400, 0.05).pvalue > 1e-3


def test_holm_as_in_his_paper() -> None:
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])  # R: p.adjust
    assert holm([0.6, None, 0.7]) == [1.0, None, 1.0]
    assert holm([]) == []


def test_pairs_are_compared_on_common_masses_only() -> None:
    one = sizes("tactile", [11, 12, 13, 14], mass=[0, 1, 2, 3])
    other = sizes("cbe", [0, 22, 26], mass=[1, 2, 5], e=[11, 12, 20])
    first, second = on_common_masses(one, other)
    assert first.mass.tolist() == second.mass.tolist() == [1, 2]
    (pair,) = paired_comparisons({"tactile": one, "cbe": other}, intervals=JACKKNIFE)
    assert pair.masses == 2
    assert pair.second_percent == pytest.approx(50 * (1 + 22 / 12 - 1))
    assert "at least 8 patients" in pair.reasons["difference_percent_interval"]


def test_modalities_without_a_common_mass_have_no_comparison() -> None:
    (pair,) = paired_comparisons(
        {"a": sizes("a", [11.0], mass=[0]), "b": sizes("b", [11.0], mass=[1])}, intervals=Intervals(0.95)
    )
    assert (pair.masses, pair.p_value, pair.p_holm, pair.difference_percent) == (0, None, None, None)


def test_a_pairs_interval_takes_what_both_share_out() -> None:
    """Errors common to both modalities do not widen the interval of their difference."""
    one = trial(8)
    same = ModalitySizes("cbe", one.patient, one.ex_vivo_mm, one.size_mm * 1.02, one.replicates_mm)
    (pair,) = paired_comparisons({"tactile": one, "cbe": same}, intervals=JACKKNIFE)
    alone = figure(accuracy.mape_percent, one, scale="log", intervals=JACKKNIFE).interval
    assert np.ptp(pair.difference_percent_interval) < 0.35 * np.ptp(alone)
    assert mape_ratio(same, one, intervals=JACKKNIFE).value == pytest.approx(pair.second_percent / pair.first_percent)


@pytest.mark.parametrize(
    ("bias", "sd", "miss"), [(0.0, 0.2, 0.0), (0.15, 0.42, 0.04), (-0.3, 0.1, 0.0), (0.2, 0.0, 0.5)]
)
def test_the_true_error_of_a_model_is_its_mean(bias: float, sd: float, miss: float) -> None:
    rng = np.random.default_rng(9)
    y = np.exp(rng.normal(bias, sd, 400_000)) * (rng.random(400_000) >= miss)
    model = ErrorModel(bias, 0.8 * sd, patient_sd=0.6 * sd, miss=miss)
    assert model.true_mape_percent == pytest.approx(100 * np.mean(np.abs(y - 1)), rel=0.01)


def test_simulated_trials_have_the_trials_shape_and_errors() -> None:
    one, model = trial(10, 200), ErrorModel(0.1, 0.3, miss=0.1)
    again = simulate(one.patient, one.ex_vivo_mm, model, rng=np.random.default_rng(0))
    errors = pilot_errors(again, again)
    assert errors["tactile_bias"] == pytest.approx(0.1, abs=0.07)
    assert errors["other_sd"] == pytest.approx(0.3, rel=0.2)
    assert errors["other_miss"] == pytest.approx(0.1, abs=0.06)
    assert pilot_errors(one, sizes("x", [11, 0, 12])) is None


def test_intervals_are_checked_and_half_intervals_found_out() -> None:
    one, model = trial(11), ErrorModel(0.0, 0.3)
    honest = check_intervals(one, model, intervals=JACKKNIFE, trials=400, seed=1)
    dishonest = check_intervals(one, model, intervals=Intervals(0.6), trials=400, seed=1)
    assert honest.share_interval[0] <= 0.95 <= honest.share_interval[1] + 0.02
    assert dishonest.share < 0.75
    assert honest.covered + honest.above + honest.below == honest.trials == 400
    assert check_intervals(sizes("x", [11.0] * 4), model, intervals=JACKKNIFE, trials=10, seed=1) is None


def case(**changes: float) -> PlanCase:
    plain = {"patients": 24, "maps": 3, "tactile_bias": 0.0, "mass_sd": 0.1, "map_sd": 0.2, "other_bias": 0.0,
             "tactile_miss": 0.0,
             "other_sd": 0.4, "other_miss": 0.0, "trials": 150, "seed": 1}  # fmt: skip
    return PlanCase(**(plain | changes))


@pytest.mark.long
def test_plans_gain_by_patients_and_by_maps_less_each_time() -> None:
    found = [simulate_design(case(maps=m)) for m in (1, 3, 5)]
    assert simulate_design(case(patients=12)).power < found[1].power
    one, two = map_gains(found)
    assert one.tactile_percent_change < two.tactile_percent_change < 0
    assert (one.from_maps, two.to_maps) == (1, 5)


def test_without_a_difference_power_is_the_tests_level() -> None:
    """One-sided half of 5 %: the tactile error must be the smaller one."""
    found = simulate_design(case(maps=1, mass_sd=0.3, map_sd=0.0, other_sd=0.3, trials=400))
    assert stats.binomtest(round(found.power * 400), 400, 0.025).pvalue > 1e-3


def test_errors_of_the_plan_are_the_expected_ones() -> None:
    found = simulate_design(case(maps=1, patients=60, trials=200, other_miss=0.1, tactile_miss=0.2))
    assert found.other_percent == pytest.approx(ErrorModel(0, 0.4, miss=0.1).true_mape_percent, rel=0.04)
    expected = ErrorModel(0, math.hypot(0.1, 0.2), miss=0.2).true_mape_percent
    assert found.tactile_percent == pytest.approx(expected, rel=0.04)


def test_a_pilot_gives_the_assumptions() -> None:
    found = pilot_errors(trial(12, 300, 0.2), trial(13, 300, 0.4, "ultrasound"))
    assert found["mass_sd"] == pytest.approx(0.2, rel=0.15)
    assert found["map_sd"] == pytest.approx(0.1, rel=0.15)
    assert found["other_sd"] == pytest.approx(0.4, rel=0.15)
    assert simulate_design(PlanCase(patients=8, maps=1, **found, trials=50, seed=0)).power > 0


def test_a_pilots_mass_sd_does_not_hold_the_scatter_of_masses_with_few_readings() -> None:
    rng, n = np.random.default_rng(3), 4000
    groups = tuple(
        10 * np.exp(shared + rng.normal(0, 0.3, 1 + 8 * (i % 2))) for i, shared in enumerate(rng.normal(0, 0.1, n))
    )
    one = ModalitySizes("tactile", np.arange(n), np.full(n, 10.0), np.array([group.mean() for group in groups]), groups)
    assert pilot_errors(one, one, map_sd=0.3)["mass_sd"] == pytest.approx(0.1, rel=0.15)
