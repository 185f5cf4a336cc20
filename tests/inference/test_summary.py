"""Summaries of draws against the distributions they were drawn from."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import norm

from tactile_bayes.inference.draws import quantiles_of, summarise
from tactile_bayes.report.estimate_text import decimals

N = 40_000
NORMAL = 10.0 + 2.0 * np.random.default_rng(41).standard_normal(N)


@pytest.mark.parametrize("probability", [0.5, 0.9, 0.95])
def test_a_normal_is_summarised_by_its_quantiles(probability: float) -> None:
    found = summarise(NORMAL, probability=probability, effective_draws=N)
    low, high = norm(10, 2).interval(probability)
    assert found.kind == "eti"
    np.testing.assert_allclose([found.low, found.high], [low, high], atol=4 * found.mc_error)
    np.testing.assert_allclose([found.median, found.mean, found.sd], [10, 10, 2], atol=0.05)
    assert 4 * found.mc_error < 0.15  # so the check above can fail


def test_the_error_of_an_end_is_that_of_repeated_draws() -> None:
    rng = np.random.default_rng(42)
    found = [summarise(rng.standard_normal(1000), probability=0.95, effective_draws=1000) for _ in range(300)]
    spread = np.std([one.high for one in found])
    # the larger of two ends is told, so a little more than one end's spread
    assert spread < np.mean([one.mc_error for one in found]) < 1.5 * spread


def test_fewer_effective_draws_are_a_larger_error() -> None:
    full = summarise(NORMAL, probability=0.95, effective_draws=N)
    tenth = summarise(NORMAL, probability=0.95, effective_draws=N / 100)
    assert tenth.mc_error == pytest.approx(10 * full.mc_error, rel=0.3)


@given(st.lists(st.floats(-1e6, 1e6), min_size=2, max_size=50), st.floats(0.01, 0.98))
def test_intervals_are_nested_and_hold_the_median(values: list[float], probability: float) -> None:
    draws = np.array(values)
    inner = summarise(draws, probability=probability, effective_draws=len(draws))
    outer = summarise(draws, probability=(1 + probability) / 2, effective_draws=len(draws))
    assert outer.low <= inner.low <= inner.median <= inner.high <= outer.high


def test_draws_without_a_value_are_left_out_and_none_is_refused() -> None:
    with_gaps = summarise(np.array([1.0, np.nan, 2.0, 3.0]), probability=0.5, effective_draws=3)
    assert with_gaps.median == 2.0
    with pytest.raises(ValueError, match="no finite draws"):
        summarise(np.full(3, np.nan), probability=0.5, effective_draws=3)


def test_numbers_are_written_with_nine_digits() -> None:
    written = summarise(np.full(3, 1 / 3), probability=0.5, effective_draws=3).rounded
    assert written.median == 0.333333333
    assert written.kind == "eti"


@pytest.mark.parametrize(
    ("error", "places"),
    [(0.0, 3), (1e-9, 3), (0.004, 3), (0.006, 2), (0.04, 2), (0.06, 1), (0.4, 1), (0.6, 0), (30, 0)],
)
def test_the_last_printed_digit_is_the_first_of_twice_the_error(error: float, places: int) -> None:
    assert decimals(error) == places


@pytest.mark.parametrize("number", [1, 2, 7, 8192])
def test_quantiles_are_numpys(number: int) -> None:
    values = np.random.default_rng(number).standard_normal(number)
    at = np.array([0.0, 0.025, 0.31, 0.5, 0.975, 1.0])
    np.testing.assert_allclose(quantiles_of(np.sort(values), at), np.quantile(values, at), rtol=1e-12, atol=1e-15)
