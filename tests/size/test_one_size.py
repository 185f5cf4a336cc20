"""Whether maps can be of one size and place: exact cases, calibration under the model, power, and its control."""

from __future__ import annotations

import numpy as np
import pytest

from tactile_bayes.size.draws import EXAM_SD, LEAST_PROBABILITY, BetweenMaps, one_size_probability
from tactile_bayes.size.visits import PatientPlace, one_place_probability, place_shift

KNOWN = BetweenMaps(EXAM_SD, 0.0)
NOISE = np.array([0.03, 0.02]) ** 2


def test_two_maps_are_a_two_sided_normal_test_of_their_difference() -> None:
    """P(|Z| > 2) = 0.04550026, Abramowitz and Stegun table 26.1."""
    sd = float(np.sqrt(NOISE.sum() + 2 * EXAM_SD**2))
    # weights differ, so Q of two maps is the squared difference over the sum of their variances
    assert one_size_probability(np.array([2.7, 2.7 + 2 * sd]), NOISE, KNOWN) == pytest.approx(0.04550026, abs=1e-7)


def test_three_maps_of_equal_weight_follow_chi_squared() -> None:
    """P(chi2 of 2 > q) = exp(-q / 2)."""
    centre = np.array([2.5, 2.6, 2.8])
    variance = 0.0009 + EXAM_SD**2
    q = float(((centre - centre.mean()) ** 2).sum() / variance)
    assert one_size_probability(centre, np.full(3, 0.0009), KNOWN) == pytest.approx(np.exp(-q / 2))


def test_order_and_a_common_factor_change_nothing_and_one_map_agrees_with_itself() -> None:
    centre, noise = np.array([2.5, 2.6, 2.9]), np.array([1e-3, 2e-3, 3e-3])
    p = one_size_probability(centre, noise, BetweenMaps())
    assert one_size_probability(centre[::-1] + 0.7, noise[::-1], BetweenMaps()) == pytest.approx(p)
    assert one_size_probability(centre[:1], noise[:1], KNOWN) == 1.0


@pytest.mark.long
@pytest.mark.parametrize("prior", [KNOWN, BetweenMaps(), BetweenMaps(0.08, 0.3)], ids=["known", "paper", "site"])
@pytest.mark.parametrize("k", [2, 4])
def test_the_probability_is_uniform_over_maps_of_one_size(prior: BetweenMaps, k: int) -> None:
    """Spreads drawn from the prior: refused as the level says; a wider spread, the control, more often."""
    rng = np.random.default_rng([33, k])

    def refused(factor: float) -> float:
        tau = prior.sd if prior.log_sd == 0 else prior.median * np.exp(prior.log_sd * rng.standard_normal(3000))
        noise = rng.uniform(0.0005, 0.003, (3000, k))
        sd = np.sqrt(noise + np.reshape((factor * tau) ** 2, (-1, 1)))
        maps = 2.7 + sd * rng.standard_normal((3000, k))
        return float(np.mean([one_size_probability(one, n, prior) < 0.05 for one, n in zip(maps, noise, strict=True)]))

    assert refused(1.0) < 0.064  # three standard errors; 0.05 where tau is known, below where it is not
    assert refused(2.5) > 0.1


def test_sizes_that_contradict_each_other_are_refused_and_a_wider_site_takes_them() -> None:
    """Maps of 18.0 and 29.7 mm (issue 33, line 6)."""
    centre = np.log([18.0, 29.7])
    assert one_size_probability(centre, NOISE, None) < 1e-6
    assert one_size_probability(centre, NOISE, BetweenMaps(0.2, 0.0)) > LEAST_PROBABILITY
    assert one_size_probability(np.log([18.0, 19.5]), NOISE, None) > 0.2


def test_two_places_have_the_probability_that_compare_gives_them() -> None:
    first = PatientPlace(np.array([60.0, 90.0]), np.diag([1.0, 4.0]))
    second = PatientPlace(np.array([72.0, 99.0]), np.array([[2.0, 0.5], [0.5, 1.0]]))
    assert one_place_probability([first, second]) == pytest.approx(place_shift(first, second).probability)
    assert one_place_probability([first]) == 1.0


def test_places_of_one_mass_are_refused_at_the_level() -> None:
    rng = np.random.default_rng(33)
    told = [
        one_place_probability([PatientPlace(rng.normal(0, 5 / np.sqrt(2), 2), np.zeros((2, 2))) for _ in range(3)])
        for _ in range(4000)
    ]
    assert np.mean(np.array(told) < 0.05) == pytest.approx(0.05, abs=0.011)
    assert one_place_probability([PatientPlace(np.array([x, 0.0]), np.eye(2)) for x in (0.0, 1.0, 30.0)]) < 1e-4
