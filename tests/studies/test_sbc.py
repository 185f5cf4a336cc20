"""Simulation-based calibration: exact posteriors pass, wrong ones fail, and the posterior of a map passes."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from tactile_bayes.declarations import as_dict, replace
from tactile_bayes.files.size_json import read_size_calibration, size_calibration_path
from tactile_bayes.options import BumpPrior
from tactile_bayes.posterior import draw
from tactile_bayes.posterior.draw import MapPosterior
from tactile_bayes.posterior.window import LENGTHS_MM
from tactile_bayes.report.laboratory import verdict
from tactile_bayes.studies import sbc
from tactile_bayes.studies.sbc import (
    BAND,
    DRAWS,
    ELSEWHERE,
    MapRanks,
    RankTest,
    Truth,
    chi2_p,
    count_other_rises,
    coverage,
    ecdf_band,
    ecdf_counts,
    rank_test,
)

TRUTH = Truth(1.2, 6.0, 4.5, 1.3, -0.8, 6.0, 3.0, 0.02)


def conjugate_ranks(n: int, *, sd_factor: float = 1.0, shift_sd: float = 0.0, seed: int = 5) -> np.ndarray:
    """Ranks of a normal mean with a normal prior, whose posterior is known; narrowed or shifted on request."""
    rng = np.random.default_rng(seed)
    truth = rng.standard_normal(n)
    data = truth + 0.7 * rng.standard_normal(n)
    variance = 1.0 / (1.0 + 1.0 / 0.7**2)
    mean = variance * data / 0.7**2 + shift_sd * np.sqrt(variance)
    draws = mean[:, None] + sd_factor * np.sqrt(variance) * rng.standard_normal((n, DRAWS))
    return np.sum(draws < truth[:, None], axis=1)


def of(ranks: np.ndarray) -> RankTest:
    return rank_test("mean", ranks, draws=DRAWS)


def test_an_exact_posterior_passes() -> None:
    found = of(conjugate_ranks(300))
    assert found.inside
    assert found.chi2_p > 0.01
    assert verdict(found) == "ok"
    for one in found.coverage:
        assert abs(one.covered - one.probability) < 3 * one.error


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        ({"sd_factor": 0.5}, "too narrow"),
        ({"sd_factor": 2.0}, "too wide"),
        ({"shift_sd": 0.5}, "too high"),
        ({"shift_sd": -0.5}, "too low"),
    ],
)
def test_a_wrong_posterior_fails_and_the_verdict_says_how(fault: dict[str, float], words: str) -> None:
    found = of(conjugate_ranks(300, **fault))
    assert not found.inside
    assert found.chi2_p < 0.001
    assert words in verdict(found)
    assert "FAILS" in verdict(found)


def test_halved_intervals_hold_the_truth_as_seldom_as_theory_says() -> None:
    """A 90 % interval of half its length is one of +-0.822 SD: 58.9 %."""
    covered = of(conjugate_ranks(4000, sd_factor=0.5)).coverage[1].covered
    assert covered == pytest.approx(0.589, abs=0.03)


def test_the_band_holds_a_whole_path_as_often_as_it_says() -> None:
    """Its points alone hold far more often: that is what simultaneous means."""
    n, rng = 60, np.random.default_rng(8)
    low, high = ecdf_band(n, DRAWS)
    share = ecdf_counts(rng.integers(0, DRAWS + 1, size=(2000, n)), DRAWS) / n
    inside = (share >= low) & (share <= high)
    assert 0.93 <= inside.all(axis=1).mean() <= 0.975
    assert inside.mean() > 0.99


def test_ranks_of_uniform_samples_are_judged_alike_by_band_and_p_value() -> None:
    rng = np.random.default_rng(9)
    found = [rank_test("x", rng.integers(0, DRAWS + 1, size=60), draws=DRAWS).inside for _ in range(200)]
    assert 0.9 <= np.mean(found) <= 0.99


def test_coverage_is_by_the_interval_with_just_the_nominal_share_of_ranks() -> None:
    assert coverage(np.arange(DRAWS + 1), DRAWS, 0.9).covered == 0.9


def test_few_ranks_have_no_bins_to_compare() -> None:
    assert chi2_p(np.array([1, 2, 3]), DRAWS) == 1.0


def mean_product(fields: np.ndarray, lag: int) -> tuple[float, float]:
    """Of cells `lag` apart, and its standard error over the fields."""
    products = np.mean(fields[:, :, : fields.shape[2] - lag] * fields[:, :, lag:], axis=(1, 2))
    return float(products.mean()), float(products.std() / np.sqrt(len(products)))


@pytest.mark.long_repeats
@pytest.mark.parametrize("length", LENGTHS_MM)
def test_simulated_fields_have_the_exponential_correlation(length: float) -> None:
    axis = np.arange(0.0, 51.0)
    fields = np.array([sbc.draw_field(axis, np.random.default_rng(i), length_mm=length) for i in range(200)])
    for lag in (0, 1, 3, 6, 12):
        mean, error = mean_product(fields, lag)
        assert mean == pytest.approx(np.exp(-lag / length), abs=4 * error), lag
    mean, error = mean_product(fields, round(length))
    assert abs(mean - np.exp(-round(length) / (2 * length))) > 4 * error  # the control: twice as long


@pytest.mark.long_repeats
@pytest.mark.parametrize("length", LENGTHS_MM)
def test_a_field_is_as_strong_at_the_rim_of_a_map_as_inside(length: float) -> None:
    """One made of cosines is twice as strong where they are mirrored."""
    axis = np.arange(0.0, 51.0)
    fields = np.array([sbc.draw_field(axis, np.random.default_rng(i), length_mm=length) for i in range(300)])
    rim = np.mean(np.stack([fields[:, 0], fields[:, -1], fields[:, :, 0], fields[:, :, -1]]) ** 2, axis=(0, 2))
    assert abs(np.mean(rim) - 1.0) < 4 * np.std(rim) / np.sqrt(len(rim))


def test_a_map_has_the_errors_it_says() -> None:
    """Without field, slope and bump, what is left varies as the map's own variance over count says."""
    truth = Truth(**as_dict(TRUTH) | {"share": 0.0, "amplitude": 0.0})
    tactile_map = sbc.draw_map(truth, np.random.default_rng(1), BumpPrior(tilt_sd=1e-9))
    z = (tactile_map.mean - 1.0) / np.sqrt(tactile_map.variance / tactile_map.count)
    assert np.std(z) == pytest.approx(1.0, abs=0.05)
    assert np.std(tactile_map.mean) == pytest.approx(truth.noise_sd, rel=0.05)


def test_truths_follow_the_prior_and_fit_the_window() -> None:
    rng, prior = np.random.default_rng(2), BumpPrior()
    drawn = [sbc.draw_truth(rng, prior) for _ in range(2000)]
    half = np.array([np.log(one.sigma_x_mm / one.sigma_y_mm) / 2 for one in drawn])
    assert max(max(one.sigma_x_mm, one.sigma_y_mm) for one in drawn) <= 15.0
    assert abs(half.mean()) < 0.05
    assert 0.4 < half.std() <= prior.log_ratio_sd
    assert np.mean([one.amplitude for one in drawn]) == pytest.approx(prior.amplitude_sd * np.sqrt(2 / np.pi), rel=0.06)


def maps_with(probability: float, measured_other_rise: int, *, of: int) -> list[MapRanks]:
    ranks = (50,) * len(sbc.RANKED)
    made = [MapRanks(i, TRUTH, None, ELSEWHERE, probability) for i in range(measured_other_rise)]
    return made + [MapRanks(i, TRUTH, ranks, "importance", probability) for i in range(measured_other_rise, of)]


def test_other_rises_are_held_against_what_the_probabilities_announce() -> None:
    honest, sure = count_other_rises(maps_with(0.98, 5, of=200)), count_other_rises(maps_with(0.999, 5, of=200))
    assert (honest.number, sure.number) == (5, 5)
    assert honest.announced == pytest.approx(4.0)
    assert honest.chance == pytest.approx(1 - np.exp(-4) * (1 + 4 + 8 + 64 / 6 + 256 / 24))  # five or more, mean 4
    assert (honest.too_many, sure.too_many) == (False, True)
    assert len(sbc.rank_tests(maps_with(0.98, 5, of=200))) == len(sbc.RANKED)


def test_another_rise_is_one_that_neither_reaches() -> None:
    at = {name: np.array([value]) for name, value in as_dict(TRUTH).items() if name in sbc.PARAMETERS}
    rest = {"angle_rad": np.zeros(1), "background": np.ones(1), "noise_sd": np.ones(1)}
    near = MapPosterior(**(at | rest | {"x_mm": np.array([TRUTH.x_mm + 5.9])}))
    far = MapPosterior(**(at | rest | {"x_mm": np.array([TRUTH.x_mm + 6.1])}))
    assert (sbc.measured_other_rise(near, TRUTH), sbc.measured_other_rise(far, TRUTH)) == (False, True)


def size_ranks(n: int, *, wider: float = 1.0) -> np.ndarray:
    """Ranks of the size where truth and draws have one law, log-normal about an oval bump; `wider` spoils it."""
    ranks = []
    path = size_calibration_path("solid")
    assert path is not None
    calibration = read_size_calibration(path)
    for i in range(n):
        rng = np.random.default_rng(i)
        middle = {"amplitude": 1.2, "sigma_x_mm": 8.0, "sigma_y_mm": 3.5}
        drawn = {name: value * np.exp(0.15 * rng.standard_normal(1000)) for name, value in middle.items()}
        true = {name: float(value * np.exp(0.15 * rng.standard_normal())) for name, value in middle.items()}
        true |= {name: wider * true[name] for name in ("sigma_x_mm", "sigma_y_mm")}
        rest = ("x_mm", "y_mm", "angle_rad", "background", "noise_sd")
        posterior = MapPosterior(**drawn, **dict.fromkeys(rest, np.zeros(1000)))
        ranks.append(sbc._ranks_in(posterior, Truth(**as_dict(TRUTH) | true), rng, calibration)[-1])
    return np.array(ranks)


@pytest.mark.long
@pytest.mark.parametrize(("maps", "wider"), [(30, 2.0), pytest.param(150, 1.3, marks=pytest.mark.slow)])
def test_a_size_drawn_from_the_law_of_its_draws_ranks_uniformly(maps: int, wider: float) -> None:
    assert rank_test("size_mm", size_ranks(maps), draws=DRAWS).inside
    assert not rank_test("size_mm", size_ranks(maps, wider=wider), draws=DRAWS).inside


@pytest.mark.long
def test_a_map_is_the_same_wherever_it_is_made() -> None:
    one = sbc.ranks_of_map(2, method="laplace", seed=1)
    assert one == sbc.ranks_of_map(2, method="laplace", seed=1)
    assert one.ranks is not None
    assert one.truth != sbc.ranks_of_map(2, method="laplace", seed=2).truth


@pytest.fixture
def narrowed_chains(monkeypatch: pytest.MonkeyPatch) -> Callable[[], None]:
    """Chains whose draws are drawn to their mean by a half: what a sampler that mixes badly does to its tails."""

    def spoil() -> None:
        exact = draw.ensemble_draws

        def spoiled(density, **options):
            draws = exact(density, **options)
            middle = draws.flat.mean(axis=0)
            return replace(draws, theta=middle + 0.5 * (draws.theta - middle))

        monkeypatch.setattr(draw, "ensemble_draws", spoiled)

    return spoil


@pytest.mark.slow
def test_chains_are_calibrated_and_narrowed_ones_are_not(narrowed_chains: Callable[[], None]) -> None:
    def lowest() -> float:
        maps = [sbc.ranks_of_map(i, method="ensemble", seed=1) for i in range(60)]
        assert {one.outcome for one in maps if one.ranks is not None} == {"ensemble"}
        return min(one.ecdf_p for one in sbc.rank_tests(maps))

    limit = (1.0 - BAND) / len(sbc.PARAMETERS)
    assert lowest() > limit
    narrowed_chains()
    assert lowest() < limit


@pytest.mark.slow
@pytest.mark.parametrize(("method", "maps"), [("importance", 300), ("laplace", 600)])
def test_the_posterior_of_a_map_is_calibrated(method: str, maps: int) -> None:
    """Five bands of 95 % would let a calibrated posterior fail in one run of four: together they hold 95 %.

    By laplace 300 maps of this seed have 0.008 for the amplitude, 600 have 0.055, and 300 of seed 2 have 0.29.
    """
    ranks = [sbc.ranks_of_map(i, method=method, seed=1) for i in range(maps)]
    found = {one.name: one for one in sbc.rank_tests(ranks)}
    for one in found.values():
        assert one.ecdf_p > (1.0 - BAND) / len(found), one
        assert one.n > 150
    for name in ("sigma_x_mm", "sigma_y_mm"):
        assert 0.85 <= found[name].coverage[1].covered <= 0.95, found[name]
