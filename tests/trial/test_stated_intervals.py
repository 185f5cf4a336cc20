"""Stated uncertainty judged: honest ones pass, dishonest ones do not, and scores are what their definitions say."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import integrate, stats

from tactile_bayes.declarations import replace
from tactile_bayes.report.trial import method_lines
from tactile_bayes.trial.readings import Interval, Reading, Trial
from tactile_bayes.trial.summary import (
    Calibration,
    Prediction,
    calibration,
    crps_log_normal,
    interval_score,
    log_normal,
    prediction_of,
    summarise,
)


def stated_by(
    low: float | None, high: float | None, probability: float | None, size: float, sd: float | None
) -> tuple[float, float] | None:
    ends = None if low is None or high is None or probability is None else Interval(low, high, probability)
    return log_normal(Reading(("p", "m"), "tactile", 1, "detected", size, ends, sd_mm=sd))


def drawn(n: int, *, stated: float = 1.0, shift: float = 0.0, seed: int = 1, replicates: int = 1) -> Prediction:
    """n masses whose sizes scatter by SD 0.2 about the prediction, of which `stated` times as much is stated."""
    rng = np.random.default_rng(seed)
    found = rng.normal(2.8, 0.4, n)
    median = found - shift + rng.normal(0, 0.2, n)
    mass = np.arange(n, dtype=float)
    return Prediction(*(np.repeat(one, replicates) for one in (median, np.full(n, 0.2 * stated), found, mass)))


def judged(prediction: Prediction) -> Calibration:
    return calibration(prediction, confidence=0.95)


def test_honest_uncertainty_is_left_alone() -> None:
    found = judged(drawn(400))
    assert found.advice.startswith("no change")
    assert found.scale == pytest.approx(1, abs=0.08)
    assert all(one.interval[0] <= one.probability <= one.interval[1] for one in found.levels)
    assert found.ecdf_distance < found.ecdf_band
    assert sum(found.pit) == 400


@pytest.mark.parametrize(("stated", "word"), [(0.5, "too narrow"), (2.0, "too wide")])
def test_halved_and_doubled_widths_are_found_out_and_mended(stated: float, word: str) -> None:
    prediction = drawn(200, stated=stated)
    found = judged(prediction)
    assert word in found.advice
    assert found.scale == pytest.approx(1 / stated, rel=0.12)
    mended = Prediction(
        prediction.median_log,
        prediction.sd_log * found.scale,
        prediction.ex_vivo_log,
        prediction.mass,
    )
    assert judged(mended).advice.startswith("no change")


def test_a_shift_is_found_by_the_distribution_of_the_transforms() -> None:
    found = judged(drawn(300, shift=0.15, stated=1.25))
    assert found.ecdf_distance > found.ecdf_band
    assert found.shift_percent == pytest.approx(100 * math.expm1(0.15), abs=4)


def test_repeated_readings_of_a_mass_do_not_sharpen_the_verdict() -> None:
    once, five_times = judged(drawn(30)), judged(drawn(30, replicates=5))
    assert five_times.n == 5 * once.n
    assert five_times.masses == once.masses
    assert five_times.scale_interval == pytest.approx(once.scale_interval)
    assert five_times.ecdf_band == pytest.approx(once.ecdf_band)
    for five, one in zip(five_times.levels, once.levels, strict=True):
        assert five.interval == pytest.approx(one.interval)


def test_crps_is_the_integral_that_defines_it() -> None:
    prediction = drawn(4)
    for index, score in enumerate(crps_log_normal(prediction)):
        median, sd = prediction.median_log[index], prediction.sd_log[index]
        found = math.exp(prediction.ex_vivo_log[index])
        cdf = stats.lognorm(sd, scale=math.exp(median)).cdf
        below = integrate.quad(lambda x, cdf=cdf: cdf(x) ** 2, 0, found, limit=200)[0]
        above = integrate.quad(lambda x, cdf=cdf: (1 - cdf(x)) ** 2, found, 40 * found, limit=200)[0]
        assert score == pytest.approx(below + above, rel=1e-6)


def test_crps_of_a_sure_prediction_is_its_absolute_error() -> None:
    one = np.ones(1)
    sure = Prediction(np.log(12.0) * one, 1e-9 * one, np.log(15.0) * one, one)
    assert crps_log_normal(sure)[0] == pytest.approx(3.0, rel=1e-6)


def test_interval_score_by_hand() -> None:
    """90 % interval 10 to 20 mm: found 15 costs its width, found 23 costs 3 x 2 / 0.1 more."""
    median, sd = stated_by(10, 20, 0.9, 14, None)
    found = np.log(np.array([15.0, 23.0]))
    prediction = Prediction(np.full(2, median), np.full(2, sd), found, np.arange(2))
    assert interval_score(prediction, probability=0.9) == pytest.approx([10, 10 + 60])


def test_a_stated_interval_or_sd_gives_the_log_normal() -> None:
    median, sd = stated_by(8, 18, 0.95, 12, None)
    assert stats.lognorm(sd, scale=math.exp(median)).ppf([0.025, 0.975]) == pytest.approx([8, 18])
    median, sd = stated_by(None, None, None, 12, 3)
    stated = stats.lognorm(sd, scale=math.exp(median))
    assert (stated.mean(), stated.std()) == pytest.approx((12, 3))
    assert stated_by(0, 18, 0.95, 12, None) is None
    assert stated_by(None, None, None, 12, 0) is None


def test_the_calipers_error_is_added_in_quadrature() -> None:
    low, high = (math.exp(2.5 + sign * 0.12 * stats.norm.ppf(0.975)) for sign in (-1, 1))
    trial = one_reading(Interval(low, high, 0.95))
    found = prediction_of(replace(trial, ex_vivo_sd_mm={("p", "m"): 0.5}), "tactile")
    without = prediction_of(trial, "tactile")
    assert found is not None
    assert without is not None
    assert found.sd_log[0] == pytest.approx(math.hypot(0.12, math.sqrt(math.log1p(0.05**2))))
    assert without.sd_log[0] == pytest.approx(0.12)


def one_reading(stated: Interval | None) -> Trial:
    return Trial([Reading(("p", "m"), "tactile", 1, "detected", 12.0, stated)], {("p", "m"): 10.0})


def test_the_text_says_of_how_many_readings_the_calibration_is() -> None:
    """An interval without a width, or from 0, has no log-normal: left out in silence it would flatter the rest."""
    ends = [(9.0, 13.0), (8.0, 14.0), (11.0, 11.0), (0.0, 14.0)]
    made = [
        Reading((f"p{i}", "1"), "tactile", 1, "detected", 11.0, Interval(low, high, 0.95))
        for i, (low, high) in enumerate(ends)
    ]
    for some, words in (
        (made, "tactile: stated uncertainty of 2 of 4 readings: CRPS"),
        (made[:2], "uncertainty: CRPS"),
    ):
        report = summarise(Trial(some, {one.key: 10.0 for one in some}))
        assert words in "\n".join(method_lines(report))
    report = summarise(Trial(made[2:], {one.key: 10.0 for one in made[2:]}))
    assert (
        report.modalities["tactile"].reasons["calibration"].endswith("width and ends above 0, or a standard deviation")
    )


def test_nothing_stated_and_few_masses_have_defined_answers() -> None:
    assert prediction_of(one_reading(None), "tactile") is None
    assert "too few masses (5)" in judged(drawn(5)).advice
