"""The spread between exams of one mass, learned from repeats: against ANOVA, error contrasts and coverage."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import null_space
from scipy.stats import binomtest, chi2, multivariate_normal

from tactile_bayes.errors import BadDataError
from tactile_bayes.size.draws import BetweenMaps, restricted_log_likelihood
from tactile_bayes.size.learn.site import GRID, RepeatedExams, learn_repeatability


def exams(masses: int, spread: float, *, maps: int = 3, noise_sd: float = 0.03, seed: int = 1) -> list[RepeatedExams]:
    rng = np.random.default_rng(seed)
    found = []
    for i in range(masses):
        noise = np.exp(rng.normal(np.log(noise_sd), 0.4, maps)) ** 2
        centre = rng.normal(2.7, 0.4) + rng.normal(0.0, spread, maps) + rng.normal(0.0, np.sqrt(noise))
        found.append(RepeatedExams(f"m{i}", f"m{i}", centre, noise))
    return found


def test_without_map_errors_it_is_the_within_mean_square_of_one_way_anova() -> None:
    repeats = exams(80, 0.1, noise_sd=1e-6)
    found = learn_repeatability(repeats).repeatability
    freedom = sum(len(one.centre) - 1 for one in repeats)
    squares = sum(float(np.sum((one.centre - one.centre.mean()) ** 2)) for one in repeats)
    assert found.median == pytest.approx(np.sqrt(squares / freedom), rel=0.01)
    exact = np.sqrt(squares / chi2.ppf([0.975, 0.025], freedom))
    assert (found.low, found.high) == pytest.approx(tuple(exact), rel=0.01)
    assert found.sd == pytest.approx(np.sqrt(squares / (freedom - 2)), rel=0.01)
    assert found.log_sd == pytest.approx(1 / np.sqrt(2 * freedom), rel=0.05)


def test_the_likelihood_is_that_of_error_contrasts() -> None:
    """REML by its definition: the density of the contrasts that the mean does not enter."""
    one = exams(1, 0.1, maps=4)[0]
    contrasts = null_space(np.ones((1, 4))).T
    at = np.array([0.01, 0.05, 0.1, 0.3])
    direct = [
        multivariate_normal.logpdf(
            contrasts @ one.centre, cov=contrasts @ (np.diag(one.noise) + tau**2 * np.eye(4)) @ contrasts.T
        )
        for tau in at
    ]
    ours = restricted_log_likelihood(one.centre, one.noise, at)
    assert np.diff(ours) == pytest.approx(np.diff(direct), abs=1e-9)


def test_sizes_and_what_a_body_does_to_all_its_maps_cancel() -> None:
    repeats = exams(6, 0.08)
    moved = [RepeatedExams(one.name, one.mass, one.centre + i, one.noise) for i, one in enumerate(repeats)]
    first, second = (learn_repeatability(some) for some in (repeats, moved))
    assert first.density == pytest.approx(second.density, rel=1e-6, abs=1e-12)


@pytest.mark.long
@pytest.mark.parametrize("spread", [0.03, 0.15])
def test_the_interval_holds_the_true_spread_and_not_where_map_errors_are_left_out(spread: float) -> None:
    held, control = 0, 0
    for seed in range(200):
        repeats = exams(10, spread, seed=seed, noise_sd=0.04)
        exact = [RepeatedExams(one.name, one.mass, one.centre, np.full(3, 1e-12)) for one in repeats]
        ours, theirs = (learn_repeatability(some).repeatability for some in (repeats, exact))
        held += ours.low <= spread <= ours.high
        control += theirs.low <= spread <= theirs.high
    assert binomtest(held, 200, 0.95).pvalue > 1e-3
    if spread < 0.05:
        assert control < 120


def test_the_log_normal_gives_single_maps_the_intervals_of_the_whole_posterior() -> None:
    for spread in (0.03, 0.15):
        learned = learn_repeatability(exams(5, spread))
        rng = np.random.default_rng(3)
        z = rng.standard_normal(400_000)
        whole = GRID[rng.choice(len(GRID), z.size, p=learned.density)]
        prior = learned.repeatability.between_maps
        fitted = prior.at(rng.uniform(size=z.size))
        ends = [np.quantile(np.abs(np.hypot(0.07, tau) * z), 0.95) for tau in (whole, fitted)]
        assert ends[1] == pytest.approx(ends[0], rel=0.01)


def test_a_mass_that_lies_apart_is_named_and_takes_part_and_others_are_rarely() -> None:
    repeats = exams(10, 0.05)
    odd = RepeatedExams("m0", "m0", repeats[0].centre + np.array([0.4, 0.0, -0.4]), repeats[0].noise)
    found = learn_repeatability([odd, *repeats[1:]])
    assert found.repeatability.outlying == ("m0",)
    assert found.by_chance[0] < 1e-6
    assert found.repeatability.maps == 30
    alarms = sum(bool(learn_repeatability(exams(10, 0.05, seed=seed)).repeatability.outlying) for seed in range(200))
    assert alarms < 25


def test_too_few_masses_are_refused_and_visits_count_once() -> None:
    two = exams(2, 0.1)
    with pytest.raises(BadDataError, match="2 masses have repeated exams with sizes; give at least 3: one or two"):
        learn_repeatability(two)
    again = [RepeatedExams(f"{one.name}, later", one.mass, one.centre + 0.1, one.noise) for one in two]
    with pytest.raises(BadDataError, match="2 masses"):
        learn_repeatability([*two, *again])


def test_few_masses_leave_much_open_and_many_little() -> None:
    few, many = (learn_repeatability(exams(n, 0.08)).repeatability for n in (3, 30))
    assert few.high / few.low > 2 * many.high / many.low
    assert few.log_sd > 2 * many.log_sd
    assert isinstance(few.between_maps, BetweenMaps)
    assert (few.between_maps.sd, few.between_maps.log_sd) == (few.sd, few.log_sd)
