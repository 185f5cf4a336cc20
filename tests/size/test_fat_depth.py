"""The calibration that knows the depth of the fat, against tables made from a known law, and what it refuses."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tactile_bayes.errors import BadDataError
from tactile_bayes.files.provenance import Provenance
from tactile_bayes.files.size_json import read_size_calibration
from tactile_bayes.files.size_quadratic_json import write_log_quadratic
from tactile_bayes.presets import HEAD_PROFILE
from tactile_bayes.size.elongation import ShapePrior
from tactile_bayes.size.eq6 import Recipe
from tactile_bayes.size.fat_depth import POWERS, cubic_terms, head_profile
from tactile_bayes.size.learn.fat_depth import learn_fat_cubic
from tactile_bayes.size.learn.log_quadratic import learn_log_quadratic
from tactile_bayes.size.learn.regression import PopulationTable
from tactile_bayes.size.log_quadratic import LogQuadratic
from tactile_bayes.size.polynomials import monomials, powers
from tactile_bayes.size.pooling import SizePriors, pool_maps
from tactile_bayes.size.shape_draws import ShapeDraws

RECIPE = Recipe("mean", "free", 20.0, False, "field")
BODY_SD, EXAM_SD = 0.04, 0.01


def profile_of(log_fat: np.ndarray) -> np.ndarray:
    """(n, 3) profiles whose first figure tells ln F by a quadratic; the others have nothing to do with it."""
    rng = np.random.default_rng(9)
    first = (-5.0 + np.sqrt(25.0 + 12.0 * (log_fat - 2.6))) / 6.0  # ln F = 2.6 + 5 x + 3 x^2
    return np.column_stack([first, rng.normal(0, 0.05, (len(log_fat), 2))])


def law(u: np.ndarray, v: np.ndarray, w: np.ndarray) -> np.ndarray:
    """ln d of a body: of third order."""
    return 2.3 + 0.3 * u + v + 0.05 * u * v - 0.3 * w + 0.1 * u * w - 0.15 * v * w**2 + 0.02 * u**3


def table(bodies: int = 250, *, exams: int = 2, seed: int = 1, known_fat: bool = True) -> PopulationTable:
    """Bodies by the law; their profiles tell F, or (`known_fat` false) another body's."""
    rng = np.random.default_rng(seed)
    body = np.repeat(np.arange(bodies), exams)
    u, v, w = rng.normal(0, 0.9, bodies), rng.normal(0, 0.35, bodies), rng.normal(0, 0.45, bodies)
    log_d = law(u, v, w) + rng.normal(0, BODY_SD, bodies)
    wobble = rng.normal(0, EXAM_SD, len(body))
    log_fat = 2.6 + (w if known_fat else rng.permutation(w))[body]
    covariance = np.tile(np.diag([1e-6, 1e-6, 1e-4]), (len(body), 1, 1))
    q = 0.04 - 0.02 * u[body] + 0.03 * w[body] + rng.normal(0, 0.01, len(body))
    return PopulationTable(
        body,
        np.exp(log_d[body]),
        u[body] - 1.0,
        v[body] + wobble + 1.4,
        q,
        covariance,
        {"seat": rng.uniform(0, 1.2, bodies)[body]},
        profile_of(log_fat),
        log_fat,
    )


@pytest.fixture(scope="module")
def learned() -> LogQuadratic:
    return learn_log_quadratic(table(), recipe=RECIPE)


def one_profile(log_fat: float) -> tuple[float, ...]:
    """As `profile_of`, the other figures at their means."""
    first = float(profile_of(np.array([log_fat]))[0, 0])
    return (first, 0.0, 0.0)


def test_powers_are_all_up_to_the_order_and_products_are_right() -> None:
    assert powers(2) == ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))
    assert len(POWERS) == 20
    assert {sum(one) for one in POWERS} == {0, 1, 2, 3}
    u, v, w = np.random.default_rng(1).normal(size=(3, 7))
    by_hand = np.stack([u**i * v**j * w**k for i, j, k in POWERS], axis=-1)
    np.testing.assert_allclose(cubic_terms(u, v, w), by_hand, rtol=1e-12)


def test_sizes_follow_the_law_at_every_depth(learned) -> None:
    u, v = np.meshgrid([-1.0, 0.0, 1.0], [-0.4, 0.0, 0.4])
    for w in (-0.6, 0.0, 0.6):
        at = learned.at_fat([one_profile(2.6 + w)])
        assert at.fat_mm == pytest.approx(np.exp(2.6 + w), rel=1e-6)
        np.testing.assert_allclose(at.log_size(u - 1.0, v + 1.4), law(u, v, np.full_like(u, w)), atol=0.04)
    # what does not know the depth is far off somewhere
    bare = learned.at_fat([None])
    assert np.abs(bare.log_size(u - 1.0, v + 1.4) - law(u, v, np.full_like(u, -0.6))).max() > 0.2


def test_the_spread_between_bodies_is_what_the_depth_leaves(learned) -> None:
    at = learned.at_fat([one_profile(2.6)])
    assert np.exp(at.mean[-3]) == pytest.approx(BODY_SD, rel=0.2)
    assert np.exp(learned.mean[-3]) > 3 * BODY_SD
    assert at.fit["left_out_held_percent"] == pytest.approx(90, abs=5)


def test_profiles_of_other_bodies_are_worth_nothing() -> None:
    """The control: the depth must not seem to help where it says nothing."""
    shuffled = learn_log_quadratic(table(known_fat=False), recipe=RECIPE)
    assert shuffled.with_fat is not None
    with_depth, without = (one.fit["left_out_sd"] for one in (shuffled.with_fat, shuffled))
    assert with_depth > 0.95 * without


def test_one_depth_is_the_cubic_there(learned) -> None:
    cubic, w = learned.with_fat, 0.3
    u, v = np.random.default_rng(2).normal(size=(2, 9))
    whole = cubic_terms(u, v, np.full(9, w)) @ cubic.mean[:-3]
    at_one = monomials((u, v), powers(3)) @ (cubic.contraction(w + cubic.centre[2]) @ cubic.mean[:-3])
    np.testing.assert_allclose(at_one, whole, rtol=1e-10)


def test_the_slope_by_the_width_is_the_derivative(learned) -> None:
    for one in (learned, learned.at_fat([one_profile(2.9)])):
        a, p, h = np.array([-1.3]), np.array([1.6]), 1e-5
        difference = (one.log_size(a, p + h) - one.log_size(a, p - h)) / (2 * h)
        np.testing.assert_allclose(one.width_slope(a, p), difference, rtol=1e-6)


def test_a_map_that_does_not_tell_is_sized_without_and_says_so(learned) -> None:
    for profiles, words in (
        ([None], "no pressure profile"),
        ([(3.0, 0.0, 0.0)], "unlike any"),
    ):
        bare = learned.at_fat(profiles)
        assert bare.fat_mm is None
        assert words in bare.fat_note
        np.testing.assert_array_equal(bare.mean, learned.mean)
        assert bare.at_fat([one_profile(2.6)]) is bare


def test_a_depth_beyond_the_tables_is_not_used(learned) -> None:
    narrow = replace(learned, with_fat=replace(learned.with_fat, fat_mm=(12.0, 13.0)))
    assert narrow.at_fat([one_profile(np.log(12.5))]).fat_mm == pytest.approx(12.5, rel=0.02)
    assert "table: 12 to 13 mm" in narrow.at_fat([one_profile(np.log(20.0))]).fat_note


def test_maps_of_a_mass_share_one_depth(learned) -> None:
    rng = np.random.default_rng(3)
    profiles = [one_profile(2.4), None, one_profile(2.8)]
    draws = [
        ShapeDraws(np.full(500, -1.0), 1.4 + 0.01 * rng.standard_normal(500), *np.full((2, 500), 0.02), profile=one)
        for one in profiles
    ]
    as_balls = SizePriors(shape=ShapePrior(oval_probability=1e-9))
    pooled = pool_maps(draws, calibration=learned, priors=as_balls, rng=rng)
    assert pooled.calibration is not None
    assert pooled.calibration.fat_mm == pytest.approx(np.exp(2.6), rel=0.02)
    bare = pool_maps([replace(one, profile=None) for one in draws], calibration=learned, priors=SizePriors(), rng=rng)
    assert bare.calibration is not None
    assert "no pressure profile" in bare.calibration.fat_note
    expected = float(law(*np.zeros((3, 1)))[0])
    assert np.median(np.log(pooled.size.max_size_mm)) == pytest.approx(expected, abs=0.06)


def test_maps_whose_fat_is_of_different_depth_are_doubted_to_be_of_one_body(learned) -> None:
    noisy = replace(learned.with_fat, depth=replace(learned.with_fat.depth, log_sd=0.04))
    assert noisy.depths_apart([one_profile(2.6), None, one_profile(2.7)]) is None  # 0.10 within 3 x sqrt(2) x 0.04
    assert noisy.depths_apart([one_profile(2.6), None, one_profile(2.8)]) == pytest.approx(np.exp([2.6, 2.8]), rel=0.02)
    assert noisy.depths_apart([one_profile(2.6)]) is None
    assert noisy.depths_apart([None, None]) is None


def test_a_table_without_profiles_or_with_few_bodies_has_no_cubic() -> None:
    full = table()
    assert learn_fat_cubic(replace(full, profile=None, log_fat=None)) is None
    assert learn_fat_cubic(table(60)) is None
    assert learn_fat_cubic(table(90)) is not None


def test_maps_without_a_profile_are_left_out_of_the_cubic_only() -> None:
    full = table()
    assert full.profile is not None
    some = full.profile.copy()
    some[::5] = np.nan
    learned = learn_log_quadratic(replace(full, profile=some), recipe=RECIPE)
    assert learned.fit["maps"] == 500
    assert learned.with_fat is not None
    assert learned.with_fat.fit["maps"] == 400


def test_figures_that_are_missing_or_cannot_be_are_no_profile() -> None:
    quality = dict.fromkeys(HEAD_PROFILE, 0.1)
    assert head_profile(quality) == (0.1, 0.1, 0.1)
    assert head_profile(quality | {HEAD_PROFILE[2]: float("nan")}) is None
    assert head_profile({k: v for k, v in quality.items() if k != HEAD_PROFILE[0]}) is None


def test_a_file_holds_what_was_learned(learned, tmp_path: Path) -> None:
    path = tmp_path / "size.json"
    write_log_quadratic(path, learned, provenance=Provenance("calibrate size", {}, {}))
    read = read_size_calibration(path)
    assert isinstance(read, LogQuadratic)
    for profile in (one_profile(2.3), one_profile(3.0)):
        one, other = read.at_fat([profile]), learned.at_fat([profile])
        np.testing.assert_allclose(one.mean, other.mean, rtol=1e-6, atol=1e-7)
        np.testing.assert_allclose(one.covariance, other.covariance, rtol=1e-4, atol=1e-8)
        assert one.fat_mm == pytest.approx(other.fat_mm, rel=1e-6)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"mean": [0.0] * 22}, "fat_cubic.mean"),
        ({"fat_mm": [0, 5]}, "fat_cubic.fat_mm"),
        ({"powers": [[0, 0, 0]]}, "fat_cubic.powers"),
        ({"more": 1}, "fat_cubic"),
    ],
)
def test_a_spoilt_file_is_refused_by_the_field(learned, tmp_path: Path, change, words) -> None:
    path = tmp_path / "size.json"
    write_log_quadratic(path, learned, provenance=Provenance("calibrate size", {}, {}))
    document = json.loads(path.read_text())
    document["fat_cubic"] |= change
    path.write_text(json.dumps(document))
    with pytest.raises(BadDataError, match=words.replace(".", r"\.")):
        read_size_calibration(path)
