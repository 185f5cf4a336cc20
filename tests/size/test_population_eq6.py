"""Eq 6 over a population of bodies, against tables made from known constants, and what it refuses."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tactile_bayes.errors import BadDataError
from tactile_bayes.files.provenance import Provenance
from tactile_bayes.files.size_json import read_size_calibration, write_body_calibration
from tactile_bayes.head_shape import DEFAULT_HEAD
from tactile_bayes.size.eq6 import Recipe
from tactile_bayes.size.learn.eq6_population import learn_population_eq6
from tactile_bayes.size.learn.regression import PopulationTable
from tactile_bayes.size.pooling import SizePriors, pool_maps, pooled_size
from tactile_bayes.size.population_eq6 import PopulationEq6
from tactile_bayes.size.shape_draws import ShapeDraws

RECIPE = Recipe("gain", "free", 20.0, False, "field", False)
M, B_MM, E, F = 3.3, -1.5, 0.62, -0.3
BODY_SD, EXAM_SD = 0.05, 0.02
LOG_FAT = 2.6


def eq6(amplitude: np.ndarray, sigma_mm: np.ndarray, w: np.ndarray | float = 0.0) -> np.ndarray:
    """Wellman & Howe (1999) eq. 6 with m and f that change with ln F = 2.6 + w."""
    return M * np.exp(0.5 * w) * sigma_mm / (E * amplitude ** (F + 0.1 * w)) + B_MM


def table(bodies: int = 250, *, seed: int = 1, fat: bool = True, fat_matters: bool = True) -> PopulationTable:
    """Bodies of known constants, two exams each; seat 1.2 makes d 10 % smaller for the same map."""
    rng = np.random.default_rng(seed)
    body = np.repeat(np.arange(bodies), 2)
    log_a, log_s, w = rng.normal(-1.0, 0.8, bodies), rng.normal(1.5, 0.35, bodies), rng.normal(0, 0.4, bodies)
    seat = rng.uniform(0, 1.2, bodies)
    sizes = eq6(np.exp(log_a), np.exp(log_s), w if fat_matters else 0.0)
    d_mm = sizes * np.exp(rng.normal(0, BODY_SD, bodies) - 0.1 * (seat - 0.6))
    # Delta sigma is 1 one diameter deep: there a is e^(-1/f)
    log_ratio = -(log_a - np.log(E) / -F) / 1.7
    log_fat = LOG_FAT + w[body]
    profile = np.column_stack([log_fat, rng.normal(0, 0.05, (len(body), 2))]) if fat else None
    q = 0.04 - 0.02 * (log_a[body] + 1.0) + rng.normal(0, 0.01, len(body))
    return PopulationTable(
        body,
        d_mm[body],
        log_a[body],
        log_s[body] + rng.normal(0, EXAM_SD, len(body)),
        q,
        np.tile(np.diag([1e-6, 1e-6, 1e-4]), (len(body), 1, 1)),
        {"depth_mm": (np.log(d_mm) + log_ratio)[body], "seat": seat[body]},
        profile,
        log_fat if fat else None,
    )


@pytest.fixture(scope="module")
def learned() -> PopulationEq6:
    return learn_population_eq6(table(), recipe=RECIPE)


@pytest.fixture(scope="module")
def plain() -> PopulationEq6:
    return learn_population_eq6(table(400, fat=False, fat_matters=False), recipe=RECIPE)


def profile(w: float) -> tuple[float, ...]:
    return (LOG_FAT + w, 0.0, 0.0)


def test_the_constants_of_the_paper_are_found(plain) -> None:
    """The table's own m, b, e and f, within what 400 bodies determine."""
    found = plain.constants()
    assert found["f"] == pytest.approx(F, abs=0.02)
    assert found["b_mm"] == pytest.approx(B_MM, abs=0.8)
    assert found["m"] / found["e"] == pytest.approx(M / E, rel=0.08)
    assert found["e"] == pytest.approx(E, rel=0.1)
    sd = np.sqrt(np.diag(plain.covariance))
    assert sd[1] < 0.02
    assert sd[2] < 0.8


def test_the_printed_constants_give_the_size(learned) -> None:
    """Eq 6 with the constants as printed is the calibration's own size, at each depth and width."""
    for one in (learned, learned.at_fat([profile(0.5)])):
        for a, sigma in ((0.2, 3.0), (0.8, 6.0)):
            c = one.constants(sigma)
            by_hand = c["m"] * sigma / (c["e"] * a ** c["f"]) + c["b_mm"]
            assert np.exp(one.log_size(np.log(a), np.log(sigma))) == pytest.approx(by_hand, rel=1e-9)


def test_sizes_follow_the_depth_of_fat(learned) -> None:
    a, sigma = (one.ravel() for one in np.meshgrid([0.2, 0.4, 0.8], [3.0, 4.5, 6.0]))
    for w in (-0.5, 0.0, 0.5):
        at = learned.at_fat([profile(w)])
        assert at.fat_mm == pytest.approx(np.exp(LOG_FAT + w), rel=1e-3)
        np.testing.assert_allclose(at.log_size(np.log(a), np.log(sigma)), np.log(eq6(a, sigma, w)), atol=0.06)
    bare = learned.at_fat([None])
    assert bare.fat_mm is None
    assert np.abs(bare.log_size(np.log(a), np.log(sigma)) - np.log(eq6(a, sigma, 0.5))).max() > 0.15
    assert np.exp(learned.mean[-3]) > 2 * np.exp(at.mean[-3])


def test_the_depth_of_other_bodies_is_worth_nothing() -> None:
    """The control: shuffled profiles must not seem to help."""
    full = table(200)
    order = np.random.default_rng(3).permutation(200)
    rows = (2 * order[:, None] + np.arange(2)).ravel()
    shuffled = learn_population_eq6(
        replace(full, profile=full.profile[rows], log_fat=full.log_fat[rows]), recipe=RECIPE
    )
    assert shuffled.with_fat.fit["left_out_sd"] > 0.95 * shuffled.fit["left_out_sd"]


def test_terms_are_derivatives_by_the_coefficients(learned) -> None:
    """Against central differences, at any depth and at one."""
    a, p = np.log([0.15, 0.5]), np.log([3.0, 6.0])
    for one in (learned, learned.at_fat([profile(0.4)])):
        terms = one.terms(a, p)
        for i in range(one.coefficients):
            step = np.zeros(len(one.mean))
            step[i] = 1e-5
            high, low = (replace(one, mean=one.mean + sign * step).log_size(a, p) for sign in (1, -1))
            np.testing.assert_allclose(terms[:, i], (high - low) / 2e-5, rtol=1e-5, atol=1e-9)
        slope = (one.log_size(a, p + 1e-5) - one.log_size(a, p - 1e-5)) / 2e-5
        np.testing.assert_allclose(one.width_slope(a, p), slope, rtol=1e-6)


def test_errors_of_bodies_left_out_are_those_of_refitting() -> None:
    """Closed form on the tangent against learning anew without each tenth of the bodies."""
    full = table(120, fat=False, fat_matters=False)
    closed = learn_population_eq6(full, recipe=RECIPE).fit["left_out_mae_percent"]
    errors = []
    for fold in range(10):
        out = full.body % 10 == fold
        one = learn_population_eq6(full.rows(~out), recipe=RECIPE)
        log_size = one.log_size(full.log_amplitude[out], full.log_width[out])
        errors.append(np.abs(np.expm1(log_size.reshape(-1, 2).mean(axis=1) - np.log(full.d_mm[out][::2]))))
    assert closed == pytest.approx(100 * np.mean(np.concatenate(errors)), rel=0.1)


def coverage(calibration: PopulationEq6, *, shrink: float = 1.0) -> float:
    """Share of 60 new bodies in their 90 % interval, by the spread between bodies times `shrink`."""
    new, held = table(60, seed=9), 0
    for i in range(0, len(new), 2):
        at = calibration.at_fat([tuple(new.profile[i])])
        mean = at.mean.copy()
        mean[-3] += np.log(shrink)
        shape = (np.full(128, one[i]) for one in (new.log_amplitude, new.log_width, new.half_log_ratio))
        draws = ShapeDraws(*shape, np.zeros(128))
        size = pooled_size(
            [draws], calibration=replace(at, mean=mean), priors=SizePriors(), rng=np.random.default_rng(i)
        )
        low, high = np.quantile(0.5 * (np.log(size.d_x_mm) + np.log(size.d_y_mm)), [0.05, 0.95])
        held += low <= np.log(new.d_mm[i]) <= high
    return held / 60


def test_intervals_of_new_bodies_hold_and_too_narrow_ones_do_not(learned) -> None:
    """Nominal 90 %; the control has a fifth of the spread between bodies."""
    assert coverage(learned) > 0.8
    assert coverage(learned, shrink=0.2) < 0.75


def test_maps_of_a_mass_are_pooled_and_a_known_seat_narrows(learned) -> None:
    def draws(log_a: float) -> ShapeDraws:
        rng = np.random.default_rng(1)
        return ShapeDraws(
            np.full(400, log_a), 1.5 + 0.01 * rng.standard_normal(400), *np.full((2, 400), 0.03), profile=profile(0.0)
        )

    maps = [draws(-1.0), draws(-0.95), draws(-1.05)]
    found = pool_maps(maps, calibration=learned, priors=SizePriors(), rng=np.random.default_rng(2))
    known = pool_maps(maps, calibration=learned, priors=SizePriors(known={"seat": 1.2}), rng=np.random.default_rng(2))
    middle, given = (np.median(one.size.max_size_mm) for one in (found, known))
    assert middle == pytest.approx(float(eq6(np.exp(-1.0), np.exp(1.5))), rel=0.08)
    assert given == pytest.approx(middle * np.exp(-0.06), rel=0.03)
    assert np.std(np.log(known.size.max_size_mm)) < np.std(np.log(found.size.max_size_mm))


@pytest.mark.parametrize(
    ("amplitude", "sigma", "words"), [(0.4, 4.5, None), (60.0, 4.5, "amplitude"), (0.4, 40.0, "sigma")]
)
def test_a_map_beyond_the_table_is_told(learned, amplitude, sigma, words) -> None:
    found = learned.outside(amplitude, sigma)
    assert (not found) if words is None else words in " ".join(found)


def test_a_negative_size_is_none(learned) -> None:
    low = replace(learned, mean=np.concatenate([learned.mean[:2], [-50.0], learned.mean[3:]]))
    assert np.isnan(low.log_size(np.array(-1.0), np.array(1.0)))


def test_a_table_without_depths_has_e_one_by_convention() -> None:
    bare = replace(table(60, fat=False), unknowns={})
    assert learn_population_eq6(bare, recipe=RECIPE).constants()["e"] == 1.0
    with pytest.raises(BadDataError, match="at least 20"):
        learn_population_eq6(table(12, fat=False), recipe=RECIPE)


def test_a_file_holds_what_was_learned(learned, tmp_path: Path) -> None:
    path = tmp_path / "eq6.json"
    write_body_calibration(path, learned, provenance=Provenance("calibrate size", {}, {}))
    back = read_size_calibration(path)
    assert isinstance(back, PopulationEq6)
    assert back.constants() == pytest.approx(learned.constants(), rel=1e-7)
    one, other = back.at_fat([profile(0.3)]), learned.at_fat([profile(0.3)])
    np.testing.assert_allclose(one.mean, other.mean, rtol=1e-7)
    assert one.unknowns == pytest.approx(other.unknowns, rel=1e-6)
    # a file without a head is of a version that knew the paper's only
    assert back.recipe == replace(learned.recipe, head=DEFAULT_HEAD)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"mean": [0.0] * 5}, "mean"),
        ({"most_leverage": 0}, "most_leverage"),
        ({"parameters": ["m"]}, "parameters"),
        ({"form": "eq7"}, "residual_correlation"),
    ],
)
def test_a_broken_file_is_refused(learned, tmp_path: Path, change, words) -> None:
    path = tmp_path / "eq6.json"
    write_body_calibration(path, learned, provenance=Provenance("calibrate size", {}, {}))
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(BadDataError, match=words):
        read_size_calibration(path)
