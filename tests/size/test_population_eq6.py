"""A calibration over a population of bodies, against tables made from known constants, and what it refuses."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from tactile_bayes.declarations import replace
from tactile_bayes.errors import BadDataError
from tactile_bayes.files.provenance import Provenance
from tactile_bayes.files.size_json import read_size_calibration, write_size_calibration
from tactile_bayes.size.bodies import UNLIKE_SD, BodyCalibration
from tactile_bayes.size.draws import ShapeDraws
from tactile_bayes.size.learn.bodies import learn_other_sd, learn_population, size_errors
from tactile_bayes.size.learn.regression import PopulationTable, rows_of
from tactile_bayes.size.pooling import SizePriors, pool_maps, pooled_size
from tactile_bayes.size.terms import Recipe

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


def learn_eq6(full: PopulationTable, *, recipe: Recipe = RECIPE) -> BodyCalibration:
    """Eq 6 alone: the table's law has nothing else."""
    return learn_population(full, recipe=recipe, residual=False)


@pytest.fixture(scope="module")
def learned() -> BodyCalibration:
    return learn_eq6(table(), recipe=RECIPE)


@pytest.fixture(scope="module")
def plain() -> BodyCalibration:
    return learn_eq6(table(400, fat=False, fat_matters=False), recipe=RECIPE)


def profile(w: float) -> tuple[float, ...]:
    return (LOG_FAT + w, 0.0, 0.0)


def test_the_constants_of_the_paper_are_found(plain) -> None:
    """The table's own m, b, e and f, within what 400 bodies determine."""
    found = plain.constants()
    assert found["f"] == pytest.approx(F, abs=0.02)
    assert found["b_mm"] == pytest.approx(B_MM, abs=0.8)
    assert found["m"] / found["e"] == pytest.approx(M / E, rel=0.08)
    assert found["e"] == pytest.approx(E, rel=0.1)
    sd = np.sqrt(np.diag(plain.eq6.covariance))
    assert sd[1] < 0.02
    assert sd[2] < 0.8


def test_the_printed_constants_give_the_size(learned, plain) -> None:
    """Eq 6 with the constants as printed is the calibration's own size, at each depth and width."""
    for one in (plain, learned.at_fat([profile(0.5)])):
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
    fit = learned.fit
    assert fit["body_sd"] == pytest.approx(np.hypot(BODY_SD, 0.12 / np.sqrt(12)), rel=0.2)
    assert fit["exam_sd"] == pytest.approx(EXAM_SD, rel=0.3)
    assert fit["left_out_held_percent"] == pytest.approx(90, abs=5)


def test_without_a_profile_sizes_are_averaged_over_the_depths_that_go_with_the_map(learned) -> None:
    """The size is the mean over bodies of any depth, and their spread is part of SD(B)."""
    bare, here = learned.at_fat([None]), (np.array([-1.0]), np.array([1.5]))
    assert bare.fat_mm is None
    assert "no pressure profile" in bare.fat_note
    w = np.random.default_rng(4).normal(0.0, 0.4, 20_000)
    sizes = np.log(eq6(np.exp(-1.0), np.exp(1.5), w))
    assert bare.log_size(*here)[0] == pytest.approx(sizes.mean(), abs=0.08)
    own = learned.at_fat([profile(0.0)]).body_sd(*here, np.zeros(1))[0]
    assert bare.body_sd(*here, np.zeros(1))[0] == pytest.approx(np.hypot(own, sizes.std()), rel=0.1)
    new = table(150, seed=8)
    told, silent = size_errors(learned, new), size_errors(learned, replace(new, profile=None))
    assert silent.error.std() > 2 * told.error.std()
    assert np.mean(np.abs(silent.error) < 1.96 * np.sqrt(silent.variance)) == pytest.approx(0.95, abs=0.04)


@pytest.mark.long
def test_the_depth_of_other_bodies_is_worth_nothing() -> None:
    """The control: shuffled profiles must not seem to help."""
    full = table(200)
    order = np.random.default_rng(3).permutation(200)
    rows = (2 * order[:, None] + np.arange(2)).ravel()
    shuffled = learn_eq6(replace(full, profile=full.profile[rows], log_fat=full.log_fat[rows]))
    assert shuffled.fit["left_out_sd"] > 0.95 * learn_eq6(replace(full, profile=None)).fit["left_out_sd"]


@pytest.mark.long
def test_what_eq6_leaves_is_learned_and_a_law_without_it_has_none() -> None:
    """A ripple in ln a that Eq 6 does not follow; the control has none."""
    full, new = table(300), table(150, seed=5)

    def rippled(one: PopulationTable) -> PopulationTable:
        return replace(one, d_mm=one.d_mm * np.exp(0.2 * np.sin(2.0 * one.log_amplitude)))

    with_it, alone = (learn_population(rippled(full), recipe=RECIPE, residual=one) for one in (True, False))
    errors = [size_errors(one, rippled(new)).error.std() for one in (with_it, alone)]
    assert errors[0] < 0.7 * errors[1]
    assert with_it.constants() == pytest.approx(alone.constants())
    plain = learn_population(full, recipe=RECIPE)
    assert size_errors(plain, new).error.std() == pytest.approx(size_errors(learn_eq6(full), new).error.std(), rel=0.05)
    # far from all bodies it is Eq 6 alone
    at = (np.array([-40.0]), np.array([1.5]))
    far = with_it.at_fat([profile(0.0)]), alone.at_fat([profile(0.0)])
    assert far[0].log_size(*at) == pytest.approx(far[1].log_size(*at))


@pytest.mark.parametrize("more", [0.0, 0.15])
def test_lumps_of_another_origin_tell_how_far_such_sizes_are_off(learned, more: float) -> None:
    """Within the interval that the fit states; lumps of the same origin add nothing."""
    new = table(40, seed=6)
    off = more * np.random.default_rng(7).standard_normal(40)
    others = replace(new, d_mm=new.d_mm * np.exp(off[new.body.astype(int)]))
    found = learn_other_sd(learned, others, source="others")
    assert found.other_sd == pytest.approx(more, abs=0.05)
    assert found.other_sd <= found.fit["other_sd_most"] < more + 0.12
    assert found.fit["other_standard_sd"] == pytest.approx(1.0, abs=0.15)
    assert found.spread.other_source == "others"


def test_a_profile_unlike_the_tables_leaves_room_for_another_kind_of_body(learned) -> None:
    """And a map without a profile does not: it says nothing of the body."""
    unlike, without = learned.at_fat([(30.0, 0.0, 0.0)]), learned.at_fat([None])
    assert unlike.fat_mm is without.fat_mm is None
    assert (unlike.other_sd, without.other_sd) == (UNLIKE_SD, 0.0)
    here = np.array([-1.0]), np.array([1.5]), np.zeros(1)
    assert unlike.body_sd(*here) == pytest.approx(np.hypot(without.body_sd(*here), UNLIKE_SD))
    assert "allows 10 % (SD) more" in " ".join(unlike.omissions())
    assert "allows" not in " ".join(without.omissions())
    assert unlike.at_fat([profile(0.0)]) is unlike


def test_a_map_unlike_the_tables_at_its_depth_is_sized_at_any_depth(learned) -> None:
    at = learned.at_fat([profile(0.0)])
    far = at.at_depth_or_fallback(np.exp(8.0), np.exp(4.0))
    assert (far.fat_mm, far.other_sd) == (None, UNLIKE_SD)
    assert at.at_depth_or_fallback(np.exp(-1.0), np.exp(1.5)) is at


def test_maps_of_a_mass_share_their_depth_of_fat(learned) -> None:
    between = learned.at_fat([profile(-0.2), profile(0.2), None, (30.0, 0.0, 0.0)])
    assert between.fat_mm == pytest.approx(np.exp(LOG_FAT), rel=0.02)
    assert learned.depth.disagreement_mm([profile(0.1), profile(0.1)]) is None
    assert learned.depth.disagreement_mm([profile(-0.5), profile(0.5)]) == pytest.approx(np.exp([2.1, 3.1]), rel=0.05)


def test_terms_are_derivatives_by_the_coefficients(learned) -> None:
    """Against central differences, at any depth and at one."""
    a, p = np.log([0.15, 0.5]), np.log([3.0, 6.0])
    for one in (learned, learned.at_fat([profile(0.4)])):
        terms = one.terms(a, p)
        mean = one.eq6.mean
        for i in range(len(mean)):
            step = 1e-5 * (np.arange(len(mean)) == i)
            moved = (replace(one, eq6=replace(one.eq6, mean=mean + sign * step)) for sign in (1, -1))
            high, low = (other.log_size(a, p) for other in moved)
            np.testing.assert_allclose(terms[:, i], (high - low) / 2e-5, rtol=1e-5, atol=1e-9)
        slope = (one.log_size(a, p + 1e-5) - one.log_size(a, p - 1e-5)) / 2e-5
        np.testing.assert_allclose(one.width_slope(a, p), slope, rtol=1e-6)


@pytest.mark.long
def test_errors_of_bodies_left_out_are_those_of_refitting() -> None:
    """Closed form on the tangent against learning anew without each tenth of the bodies."""
    full = table(120, fat=False, fat_matters=False)
    closed = learn_eq6(full, recipe=RECIPE).fit["left_out_mae_percent"]
    errors = []
    for fold in range(10):
        out = full.body % 10 == fold
        one = learn_eq6(rows_of(full, ~out), recipe=RECIPE)
        log_size = one.log_size(full.log_amplitude[out], full.log_width[out])
        errors.append(np.abs(np.expm1(log_size.reshape(-1, 2).mean(axis=1) - np.log(full.d_mm[out][::2]))))
    assert closed == pytest.approx(100 * np.mean(np.concatenate(errors)), rel=0.1)


def coverage(calibration: BodyCalibration, *, shrink: float = 1.0) -> float:
    """Share of 60 new bodies in their 90 % interval, by the spread between bodies times `shrink`."""
    new, held = table(60, seed=9), 0
    for i in range(0, len(new), 2):
        at = calibration.at_fat([tuple(new.profile[i])])
        mean = at.spread.mean.copy()
        mean[0] += np.log(shrink)
        narrow = replace(at, spread=replace(at.spread, mean=mean))
        shape = (np.full(128, one[i]) for one in (new.log_amplitude, new.log_width, new.half_log_ratio))
        draws = ShapeDraws(*shape, np.zeros(128))
        size = pooled_size([draws], calibration=narrow, priors=SizePriors(), rng=np.random.default_rng(i))
        low, high = np.quantile(0.5 * (np.log(size.d_x_mm) + np.log(size.d_y_mm)), [0.05, 0.95])
        held += low <= np.log(new.d_mm[i]) <= high
    return held / 60


@pytest.mark.long
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
def test_a_map_beyond_the_table_is_reported(learned, amplitude, sigma, words) -> None:
    found = learned.outside(amplitude, sigma)
    assert (not found) if words is None else words in " ".join(found)


def test_a_negative_size_is_none(learned) -> None:
    mean = np.where(np.arange(13) == 12, -50.0, learned.eq6.mean)
    low = replace(learned, eq6=replace(learned.eq6, mean=mean))
    assert np.isnan(low.log_size(np.array(-1.0), np.array(1.0)))


def test_a_table_without_depths_has_e_one_by_convention() -> None:
    bare = replace(table(60, fat=False), unknowns={})
    assert learn_eq6(bare, recipe=RECIPE).constants()["e"] == 1.0
    with pytest.raises(BadDataError, match="at least 20"):
        learn_eq6(table(12, fat=False), recipe=RECIPE)


def test_a_file_holds_what_was_learned(learned, tmp_path: Path) -> None:
    path = tmp_path / "eq6.json"
    write_size_calibration(path, learned, provenance=Provenance("calibrate size", {}, {}))
    back = read_size_calibration(path)
    assert isinstance(back, BodyCalibration)
    assert back.constants() == pytest.approx(learned.constants(), rel=1e-7)
    one, other = back.at_fat([profile(0.3)]), learned.at_fat([profile(0.3)])
    np.testing.assert_allclose(one.eq6.mean, other.eq6.mean, rtol=1e-7)
    np.testing.assert_allclose(one.spread.mean, other.spread.mean, rtol=1e-7)
    assert one.unknowns == pytest.approx(other.unknowns, rel=1e-6)
    assert back.recipe == learned.recipe


MU_TO_3 = {"powers": [[3, 0, 0]], "mean": [0.0], "covariance": [[1.0]], "log_amplitude_one_deep": 0.0}
ONE_HIDDEN = {"names": ["seat"], "expected": [[0.0]], "covariance": [[1.0]], "with_body": [0.1], "body_variance": 1.0}
RESIDUAL = {
    "points": [[0.0] * 3],
    "lengths": [1.0, 0.0, 1.0],
    "scale": 1.0,
    "mean": [0.0],
    "covariance_factor": [[1.0]],
}
DEPTH = {
    "centre": [0.0] * 3,
    "scale": [1.0] * 3,
    "coefficients": [0.0] * 10,
    "information_inverse": [[0.0] * 10] * 10,
    "most_leverage": 1.0,
    "log_sd": 0.1,
    "fat_mm": [5.0, 30.0],
    "expected": [0.0] * 6,
    "expected_sd": 0.1,
}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"eq6": MU_TO_3}, "powers names more than mu, f and b"),
        ({"hidden": ONE_HIDDEN}, "hidden has arrays of other sizes"),
        ({"hidden": ONE_HIDDEN | {"expected": []}}, "expected has 0 numbers for 1x0"),
        ({"hidden": ONE_HIDDEN | {"expected": 0.0}}, "expected is 0.0; give a list of numbers"),
        ({"residual": RESIDUAL}, "a length of the residual is not above 0"),
        ({"depth": DEPTH | {"scale": [1.0, 0.0, 1.0]}}, "a scale of the profile is not above 0"),
        ({"depth": DEPTH | {"profile": ["shoulder"]}}, "profile is shoulder"),
        ({"eq6": {"powers": [], "mean": [0.0] * 5, "covariance": [], "log_amplitude_one_deep": 0.0}}, "mean"),
        ({"most_leverage": 0}, "most_leverage"),
        ({"surplus": 1}, "surplus"),
        ({"depth": None}, "depth is missing"),
        ({"form": "eq7"}, "form is 'eq7'; give one of eq6, population, site"),
    ],
)
def test_a_broken_file_is_refused(learned, tmp_path: Path, change, words) -> None:
    path = tmp_path / "eq6.json"
    write_size_calibration(path, learned, provenance=Provenance("calibrate size", {}, {}))
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(BadDataError, match=words):
        read_size_calibration(path)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"body": np.zeros(40)}, "1 bodies with a map"),
        ({"d_mm": np.full(40, 12.0)}, "all rows have one d_mm"),
        ({"log_width": np.full(40, 1.5)}, "all rows have one width"),
        ({"half_log_ratio": np.full(40, np.nan)}, "a row holds a number that is not finite"),
    ],
)
def test_bodies_that_cannot_teach_are_refused(change, words) -> None:
    with pytest.raises(BadDataError, match=words):
        learn_eq6(replace(table(20), **change))
