"""The Monte-Carlo error of a size's interval: small, told as it is, and of the map's values alone."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from in_process import run_here
from plain_calibration import RECIPE
from posterior_files import MADE
from posterior_maps import bump_map
from scipy.special import ndtr
from test_pooling import BODY_SD, calibration, shape

from tactile_bayes.declarations import replace
from tactile_bayes.files.map_nc import write_map
from tactile_bayes.inference.draws import (
    ParameterDraws,
    Quantity,
    even_replicates,
    normal_cdf,
    paired_points,
    stratified_quantiles,
    summarise,
)
from tactile_bayes.posterior import estimate as drawn
from tactile_bayes.posterior.draw import SamplerSettings
from tactile_bayes.posterior.white import MapDraws
from tactile_bayes.size.draws import BetweenMaps, BumpDraws, ShapeDraws
from tactile_bayes.size.eq6 import AxisCalibration, SizeCalibration, push_sizes
from tactile_bayes.size.pooling import SizePriors, pool_maps, pooled_size

SEEDS = 24
PROBABILITY = 0.95


def spread_and_told(found: list[Quantity]) -> tuple[float, float]:
    """Standard deviation over seeds of the less certain end, and the root mean square of what is told, in SDs."""
    ends = np.array([(one.low, one.high) for one in found])
    sd = float(np.mean([one.sd for one in found]))
    told = float(np.sqrt(np.mean([one.mc_error**2 for one in found])))
    return float(ends.std(axis=0, ddof=1).max()) / sd, told / sd


def sizes_of(make, name: str = "max_size_mm") -> list[Quantity]:
    return [make(np.random.default_rng(seed)).summarise(name, probability=PROBABILITY) for seed in range(SEEDS)]


def one_map(rng: np.random.Generator, noise: float = 0.02) -> ShapeDraws:
    """A map whose own draws are by chance."""
    return shape(2.7, noise=noise, seed=int(rng.integers(1 << 30)))


@pytest.mark.long
@pytest.mark.parametrize("name", ["max_size_mm", "min_size_mm"])
def test_ends_of_a_size_stray_over_seeds_by_no_more_than_is_told_and_by_little(name: str) -> None:
    def make(rng: np.random.Generator):
        return pooled_size([one_map(rng)], calibration=calibration(), priors=SizePriors(), rng=rng)

    spread, told = spread_and_told(sizes_of(make, name))
    assert spread < 1.3 * told
    assert told < 0.025  # 2,000 random numbers have 0.06
    # the negative control: as many draws with nothing done about them stray by more than that
    by_chance = []
    for found in (make(np.random.default_rng(seed)) for seed in range(SEEDS)):
        index = np.random.default_rng(found.invalid + len(by_chance)).integers(2000, size=2000)
        by_chance.append(summarise(getattr(found, name)[index], probability=PROBABILITY, replicates=found.replicates))
    stray, _ = spread_and_told(by_chance)
    assert stray > 2.0 * told


@pytest.mark.long
@pytest.mark.parametrize("noise", [0.02, 0.3])
def test_ends_of_a_pooled_size_stray_by_no_more_than_is_reported(noise: float) -> None:
    """With the spread between maps known to be nothing, what the maps say matters most."""
    priors = SizePriors(between_maps=BetweenMaps(0.0, 0.0)) if noise > 0.1 else SizePriors()

    def make(rng: np.random.Generator):
        return pool_maps(
            [one_map(rng, noise) for _ in range(3)], calibration=calibration(), priors=priors, rng=rng
        ).size

    spread, told = spread_and_told(sizes_of(make))
    assert spread < 1.3 * told


def test_ends_of_a_size_by_eq_6_stray_by_no_more_than_is_reported() -> None:
    rows = np.random.default_rng(1).normal(
        [2.0, 1.0, 0.6, -0.3, 0.15, 0.2], [0.1, 0.3, 0.02, 0.02, 0.01, 0.02], (400, 6)
    )
    axis = AxisCalibration(
        rows, reference_amplitude=0.3, domain={"amplitude": (0, 1), "sigma_mm": (1, 9), "d_mm": (5, 25)}
    )
    eq6 = SizeCalibration(axis, axis, 0.5, RECIPE)

    def make(rng: np.random.Generator):
        a, sx, sy = (m * np.exp(0.02 * rng.standard_normal((1, 4000))) for m in (0.3, 5.0, 4.5))
        return push_sizes(BumpDraws(a, sx, sy, np.zeros_like(a)), calibration=eq6, rng=rng)

    spread, told = spread_and_told(sizes_of(make))
    assert spread < 1.3 * told
    assert told < 0.03  # 4,000 random numbers have 0.042


def test_the_error_told_from_replicates_is_that_of_random_numbers_and_a_clone_is_found_out() -> None:
    rng = np.random.default_rng(3)
    labels = even_replicates(4000)
    honest = [summarise(rng.standard_normal(4000), probability=PROBABILITY, replicates=labels) for _ in range(60)]
    spread, told = spread_and_told(honest)
    assert spread == pytest.approx(told, rel=0.4)
    # every draw thrice within its replicate: worth a third of the draws, which counting them does not see
    thrice = [np.repeat(rng.standard_normal((4, 333)), 3, axis=1).ravel() for _ in range(60)]
    found = [summarise(one, probability=PROBABILITY, replicates=even_replicates(len(one))) for one in thrice]
    blind = [summarise(one, probability=PROBABILITY) for one in thrice]
    spread, told = spread_and_told(found)
    assert spread == pytest.approx(told, rel=0.4)
    assert spread_and_told(blind)[1] < 0.7 * told


def test_points_are_spread_evenly_in_each_replicate_in_order_of_the_key() -> None:
    rng = np.random.default_rng(4)
    key, labels = rng.standard_normal(4096), rng.permutation(even_replicates(4096))
    points = paired_points(key, labels, 3, rng)
    for label in range(4):
        mine = points[labels == label][np.argsort(key[labels == label])]
        for column in mine.T:
            assert np.bincount((column * 1024).astype(int), minlength=1024).max() == 1  # one in each of 1024 parts
        # with the rank of the key too: one in each of 32 by 32
        boxes = (np.arange(1024) // 32) * 32 + (mine[:, 0] * 32).astype(int)
        assert np.bincount(boxes, minlength=1024).max() == 1


def test_evened_draws_have_the_quantiles_of_their_mixture() -> None:
    rng = np.random.default_rng(5)
    n = 8192
    mean, sd = 0.3 * rng.standard_normal(n), np.exp(0.6 * rng.standard_normal(n))
    found = stratified_quantiles(mean + sd * rng.standard_normal(n), mean, sd, even_replicates(n))
    for p in (0.025, 0.25, 0.5, 0.975):
        x = float(np.quantile(found, p))
        assert ndtr((x - mean) / sd).mean() == pytest.approx(p, abs=6e-4)
    assert np.isnan(
        stratified_quantiles(np.full(3, np.nan), np.full(3, np.nan), np.ones(3), np.zeros(3, dtype=int))
    ).all()
    assert stratified_quantiles(np.zeros(0), np.zeros(0), np.zeros(0), np.zeros(0, dtype=int)).size == 0


def test_the_normal_distribution_function_is_the_librarys() -> None:
    z = np.linspace(-8, 8, 1001)
    np.testing.assert_allclose(normal_cdf(z), ndtr(z), atol=1e-7)


def test_what_is_left_open_of_a_size_is_as_wide_as_its_parts() -> None:
    """Against the closed form: a fixed spread between maps, the body's, the coefficients' error and the map's noise."""
    priors = replace(SizePriors(between_maps=BetweenMaps(0.12, 0.0)))
    found = np.log(pooled_size([shape(2.7, noise=0.03)], calibration=calibration(), priors=priors,
                               rng=np.random.default_rng(6)).min_size_mm)  # fmt: skip
    log_d = 0.5 * (np.quantile(found, 0.8413) - np.quantile(found, 0.1587))
    assert log_d == pytest.approx(np.sqrt(0.12**2 + BODY_SD**2 + 0.03**2 + 1e-6), rel=0.03)


def test_draws_are_made_finer_until_the_size_is_as_exact_as_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    """With a method that draws as finely as it is told; the size's error is then what ends it."""
    asked = []

    def once(work, _seen):
        options, rng = work.options, work.rng
        asked.append(options.accuracy_sd)
        number = 2000 if options.accuracy_sd is None else int(2000 * (0.02 / options.accuracy_sd) ** 2)
        size = pooled_size([shape(2.7, noise=0.02, seed=9)], calibration=calibration(), priors=SizePriors(),
                           rng=rng, number=number)  # fmt: skip
        draws = ParameterDraws(np.zeros((1, number, 1)), "importance")
        return MapDraws(None, None, draws, None, {}, size=size)

    monkeypatch.setattr(drawn, "draw_with_size", once)
    for options in (SamplerSettings(), SamplerSettings(accuracy_sd=0.01), SamplerSettings(accuracy_mm=0.005)):
        asked.clear()
        found = drawn.draw_until_accurate(drawn.EstimationTask(None, None, options, np.random.default_rng(2)), None)
        size = found.size.summarise("max_size_mm", probability=PROBABILITY)
        if options.accuracy_mm is not None:
            assert size.mc_error <= options.accuracy_mm
        assert size.mc_error <= (options.accuracy_sd or 0.02) * size.sd
    assert len(asked) > 1


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("same")
    rng = np.random.default_rng(5)
    for i in range(3):
        made = bump_map(noise=0.01 * rng.standard_normal((51, 51)), amplitude=0.3, sigma_x=4.0, sigma_y=4.0)
        write_map(place / f"map{i}.nc", made, provenance=MADE)
        write_map(place / f"other{i}.nc", made, provenance=replace(MADE, command="another history"))
    return place


def sizes(folder: Path, *words: str) -> list[dict]:
    done = run_here("estimate", *words, "--method", "laplace", "--json", cwd=folder)
    assert done.returncode == 0, done.stderr
    document = json.loads(done.stdout)
    return [one["max_size_mm"] for one in (document if isinstance(document, list) else [document])]


@pytest.mark.long
def test_maps_of_equal_values_give_equal_draws_whatever_their_history(folder: Path) -> None:
    assert (folder / "map0.nc").read_bytes() != (folder / "other0.nc").read_bytes()
    one, other = sizes(folder, "map0.nc"), sizes(folder, "other0.nc")
    assert one == other
    assert sizes(folder, "map1.nc", "other0.nc")[1:] == one  # in a batch too
    assert sizes(folder, "map0.nc", "--seed", "2") != one


@pytest.mark.long
def test_a_pool_is_of_values_in_any_order(folder: Path) -> None:
    one = sizes(folder, "map0.nc", "map1.nc", "map2.nc", "--pool")
    assert sizes(folder, "other2.nc", "map0.nc", "other1.nc", "--pool") == one
    assert sizes(folder, "map0.nc", "map1.nc", "--pool") != one


def test_the_fingerprint_is_of_values_and_cells_and_of_nothing_else() -> None:
    made = bump_map(amplitude=0.3)
    same = replace(made, quality={"x": 1.0}, patient_from_plane=np.eye(4), masked_taxels=("row 1 column 1 dead",))
    assert same.fingerprint == made.fingerprint
    others = [
        replace(made, mean=made.mean + 1e-12),
        replace(made, variance=made.variance + 1.0),
        replace(made, count=made.count + 1),
        replace(made, x_mm=made.x_mm + 1.0),
    ]
    assert len({made.fingerprint, *(one.fingerprint for one in others)}) == 5
    bare = np.where(made.count > 0, made.mean, 7.0)
    hidden = made.count.copy()
    hidden[0, 0] = 0
    empty = [replace(made, mean=np.where(hidden > 0, bare, fill), count=hidden) for fill in (np.nan, 3.0)]
    assert empty[0].fingerprint == empty[1].fingerprint


@pytest.mark.long
def test_the_report_says_how_exact_the_sizes_ends_are(folder: Path) -> None:
    text = run_here("estimate", "map0.nc", "--method", "laplace", "-v", cwd=folder).stdout
    (line,) = [one for one in text.splitlines() if one.startswith("Method laplace")]
    document = json.loads(run_here("estimate", "map0.nc", "--method", "laplace", "--json", cwd=folder).stdout)
    worst = max((document[name] for name in ("max_size_mm", "min_size_mm")), key=lambda one: one["mc_error"])
    assert f"interval ends: sizes {worst['mc_error'] / worst['sd']:.3f} SD" in line
    assert ", widths 0.0" in line
    pooled = run_here("estimate", "map0.nc", "map1.nc", "--pool", "--method", "laplace", cwd=folder).stdout
    assert "Quality: interval ends to 0.0" in pooled
