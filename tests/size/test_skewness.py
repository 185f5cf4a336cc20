"""A skewed departure of bodies from the calibration: scores, what a size has of it, and how it is learned."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from test_pooling import BODY_SD, KNOWN_0, calibration, pooled, shape

from tactile_bayes.files.size_parts_json import hidden_document, parse_hidden
from tactile_bayes.geometry import FloatArray
from tactile_bayes.inference.normal import normal_quantile, normal_score, skewed_score
from tactile_bayes.size.elongation import ShapePrior
from tactile_bayes.size.hidden import MOST_SKEWNESS, HiddenTerms
from tactile_bayes.size.learn.hidden import third_moment

ROUND = replace(KNOWN_0, shape=ShapePrior(oval_probability=1e-9))


def terms(skewness: float) -> HiddenTerms:
    """B goes with the inverse stiffness, which explains half of its variance, and a little with the seat."""
    expected = np.zeros((2, 6))
    expected[:, 0] = 0.05, 0.6
    with_body = np.array([np.sqrt(0.5 * 0.001), -0.05]) * BODY_SD
    return HiddenTerms(("stiffness_ratio", "seat"), expected, np.diag([0.001, 0.12]), with_body, BODY_SD**2,
                       inverted=("stiffness_ratio",), skewness=skewness)  # fmt: skip


def log_sizes(skewness: float, known: dict[str, float] | None = None) -> FloatArray:
    use = calibration(hidden=terms(skewness))
    return np.log(pooled([shape(2.7)], priors=replace(ROUND, known=known or {}), use=use).max_size_mm)


@pytest.mark.parametrize("skewness", [0.05, 0.4, 0.9])
def test_scores_are_those_of_a_shifted_log_normal(skewness: float) -> None:
    """Reference: the quantiles of scipy.stats.lognorm with that skewness, brought to mean 0 and SD 1."""
    from scipy.optimize import brentq

    s = brentq(lambda s: float(stats.lognorm.stats(s, moments="s")) - skewness, 1e-3, 1.0)
    law = stats.lognorm(s)
    p = np.array([0.005, 0.025, 0.5, 0.975, 0.995])
    found = skewed_score(normal_quantile(p), np.full(5, skewness))
    assert found == pytest.approx((law.ppf(p) - law.mean()) / law.std(), abs=1e-6)


def test_scores_without_skewness_are_the_normal_ones_and_near_it_they_join() -> None:
    z = np.linspace(-4, 4, 9)
    assert (skewed_score(z, np.zeros(9)) == z).all()
    assert skewed_score(z, np.full(9, 1.001e-3)) == pytest.approx(z, abs=4e-3)


@pytest.mark.parametrize("skewness", [0.0, 0.3, 1.0])
def test_normal_scores_are_found_again(skewness: float) -> None:
    z, all_alike = np.linspace(-3, 4, 15), np.full(15, skewness)
    assert normal_score(skewed_score(z, all_alike), all_alike) == pytest.approx(z, abs=1e-9)
    assert np.isfinite(normal_score(np.array([-1e3]), np.array([skewness])))


@pytest.mark.parametrize("name", ["soft", "hard", "centred"])
def test_a_supposed_size_is_that_with_the_property_known(name: str) -> None:
    """Of a stiffness that takes the skewness with it: the control, ends moved by their distance from the median
    alone, is off by twice what is allowed."""
    use = replace(calibration(hidden=terms(0.9)), bodies={"stiffness_ratio": (6.0, 100.0), "seat": (0.0, 1.2)})
    found = pooled([shape(2.7)], priors=ROUND, use=use)
    one = found.supposing[name]
    told = pooled([shape(2.7)], priors=replace(ROUND, known={one.name: one.value}), use=use).max_size_mm
    low, middle, high = np.quantile(found.max_size_mm, [0.025, 0.5, 0.975])
    moved = [one.moved(float(end), median_mm=float(middle)) for end in (low, middle, high)]
    assert moved == pytest.approx(np.quantile(told, [0.025, 0.5, 0.975]), rel=5e-3)
    if one.name == "stiffness_ratio":
        naive = middle * np.exp(one.log_shift + one.sd_ratio * np.log(high / middle))
        assert abs(naive / np.quantile(told, 0.975) - 1) > 1e-2


def test_a_skewed_body_makes_an_interval_longer_above() -> None:
    """Moments of ln d: B's own plus 1 % of the map; the control without skewness is even on both sides."""
    found, even = log_sizes(0.8), log_sizes(0.0)
    assert found.mean() == pytest.approx(even.mean(), abs=1e-3)
    assert found.std() == pytest.approx(even.std(), rel=0.01)
    left = (BODY_SD / np.hypot(BODY_SD, 0.01)) ** 3
    assert stats.skew(found) == pytest.approx(0.8 * left, abs=0.05)
    assert stats.skew(even) == pytest.approx(0.0, abs=0.05)
    low, middle, high = np.quantile(found, [0.025, 0.5, 0.975])
    assert high - middle > 1.2 * (middle - low)


def test_with_the_stiffness_known_nothing_skewed_is_left() -> None:
    known = log_sizes(0.8, {"stiffness_ratio": 20.0})
    assert stats.skew(known) == pytest.approx(0.0, abs=0.05)
    assert known.std() == pytest.approx(np.hypot(BODY_SD * np.sqrt(0.5), 0.01), rel=0.02)


def test_with_the_seat_known_the_third_moment_stays() -> None:
    hidden = terms(0.5)
    left = 1.0 - hidden.share("seat")
    assert hidden.skewness_left({"seat": 0.0}, np.array([left])) == pytest.approx(0.5 * left**-1.5)
    assert hidden.skewness_left({"seat": 0.0}, np.array([1e-3])) == MOST_SKEWNESS
    assert hidden.skewness_left({"stiffness_ratio": 9.0}, np.array([left])) == 0.0


def test_the_third_moment_is_found_beside_errors_of_exams() -> None:
    """A gamma law of skewness 0.6 with symmetric errors of its size, 20,000 bodies; the control has none, and a
    sample skewed the other way counts as none."""
    rng = np.random.default_rng(5)
    body = rng.gamma(4 / 0.36, 0.3, 20_000) - 2 / 0.6
    sd, noise = rng.uniform(0.05, 0.1, (2, 20_000))
    errors = noise * rng.standard_normal(20_000)
    assert third_moment(sd * body + errors, sd, sd**2 + noise**2) == pytest.approx(0.6, abs=0.15)
    assert third_moment(sd * rng.standard_normal(20_000) + errors, sd, sd**2 + noise**2) < 0.15
    assert third_moment(-sd * body, sd, sd**2) == 0.0


def test_a_calibrations_file_keeps_it_and_earlier_ones_have_none() -> None:
    document = hidden_document(terms(0.47))
    again = parse_hidden(document, terms=6)
    assert again is not None
    assert again.skewness == 0.47
    del document["skewness"]
    earlier = parse_hidden(document, terms=6)
    assert earlier is not None
    assert earlier.skewness == 0.0
