"""Sizes from one map or several: what is learned about their spread, what averages out and what does not."""

from __future__ import annotations

import numpy as np
import pytest
from plain_calibration import plain_calibration

from tactile_bayes.declarations import replace
from tactile_bayes.errors import UsageError
from tactile_bayes.size.bodies import BodyCalibration
from tactile_bayes.size.draws import (
    OVAL_SD,
    SHOWN,
    SHOWN_CV,
    SHOWN_POWER,
    BetweenMaps,
    ShapeDraws,
    ShapePrior,
    elongation,
    log_ratio_rotation,
    outlying_maps,
    shown_share,
)
from tactile_bayes.size.pooling import IRREGULAR_SD, SizePriors, pool_maps, pooled_size
from tactile_bayes.size.terms import HiddenTerms

BODY_SD = 0.08


def calibration(*, body_sd: float = BODY_SD, hidden: HiddenTerms | None = None) -> BodyCalibration:
    return plain_calibration(body_sd=body_sd, hidden=hidden)


def shape(log_size: float, *, noise: float = 0.01, q: float = 0.05, r: float = 0.0, seed: int = 0, turn: float = 0.0):
    """Draws of a map whose size by the calibration is as given."""
    rng = np.random.default_rng(seed)
    n = 2000
    v = log_size - 2.5 + noise * rng.standard_normal(n)
    q_draws, r_draws = (value + 0.01 * rng.standard_normal(n) for value in (q, r))
    return ShapeDraws(np.full(n, -1.0), v + 1.5, q_draws, r_draws, turn)


def pooled(maps, *, priors: SizePriors | None = None, use: BodyCalibration | None = None, seed: int = 3):
    return pooled_size(
        maps, calibration=use or calibration(), priors=priors or SizePriors(), rng=np.random.default_rng(seed),
        number=20_000,
    )  # fmt: skip


KNOWN_0 = SizePriors(between_maps=BetweenMaps(0.0, 0.0))


def test_one_map_with_nothing_between_has_the_bodys_spread_alone():
    found = np.log(pooled([shape(2.7)], priors=KNOWN_0).max_size_mm)
    assert found.mean() == pytest.approx(2.7, abs=0.004)
    assert found.std() == pytest.approx(np.hypot(BODY_SD, 0.01), rel=0.03)


def test_three_maps_average_what_differs_between_them_and_not_what_they_share():
    priors = SizePriors(between_maps=BetweenMaps(0.12, 0.0))
    one = np.log(pooled([shape(2.7)], priors=priors).max_size_mm).std()
    three = np.log(pooled([shape(2.7, seed=i) for i in range(3)], priors=priors).max_size_mm).std()
    assert one == pytest.approx(np.sqrt(BODY_SD**2 + 0.12**2 + 0.01**2), rel=0.03)
    assert three == pytest.approx(np.sqrt(BODY_SD**2 + (0.12**2 + 0.01**2) / 3), rel=0.03)


def test_the_spread_between_maps_is_learned_from_them():
    prior = BetweenMaps()
    priors = SizePriors(between_maps=prior)
    alike = pooled([shape(2.7 + 0.005 * i, seed=i) for i in range(5)], priors=priors)
    apart = pooled([shape(2.7 + 0.3 * (i - 2), seed=i) for i in range(5)], priors=priors)
    alone = pooled([shape(2.7)], priors=priors)
    assert alike.figures["between_map_sd"] < 0.6 * prior.sd
    assert apart.figures["between_map_sd"] > 1.5 * prior.sd
    assert alone.figures["between_map_sd"] == pytest.approx(prior.sd, rel=0.05)


def test_one_exam_has_the_spread_of_simulated_exams_and_another_one_that_of_the_papers_maps():
    """In the mean square once: 2 % of the calibration here, 15 % of Wellman & Howe (1999), section 4."""
    size = pooled([shape(2.7)])
    assert size.another_exam is not None
    this, another = (np.log(one.max_size_mm) for one in (size, size.another_exam))
    assert this.std() == pytest.approx(np.sqrt(BODY_SD**2 + 0.02**2 + 0.01**2), rel=0.03)
    assert another.std() == pytest.approx(np.sqrt(BODY_SD**2 + 0.15**2 + 0.01**2), rel=0.05)
    assert np.median(another) == pytest.approx(np.median(this), abs=0.01)
    assert size.figures["between_map_sd"] == pytest.approx(0.02, rel=0.05)
    assert size.another_exam.figures["between_map_sd"] == pytest.approx(0.15, rel=0.05)


def test_a_spread_that_is_stated_leaves_one_interval():
    size = pooled([shape(2.7)], priors=SizePriors(between_maps=BetweenMaps(0.05, 0.0), another_exam=None))
    assert size.another_exam is None
    assert size.figures["between_map_sd"] == pytest.approx(0.05)


@pytest.mark.slow
@pytest.mark.parametrize("maps", [1, 3])
def test_both_intervals_hold_what_they_say(maps):
    """Nominal 95 %: exams as alike as the calibration's for the one, as far apart as the paper's for the other."""
    rng, trials = np.random.default_rng(11), 400
    held = {"this": 0, "another": 0, "this where exams differ by 15 %": 0}
    for _ in range(trials):
        true, body, apart = 2.7, rng.normal(0, BODY_SD), rng.standard_normal(maps)
        for tau in (0.02, 0.15):
            seeds = rng.integers(1 << 30, size=maps)
            draws = [shape(float(true - body + tau * z), seed=int(s)) for z, s in zip(apart, seeds, strict=True)]
            size = pooled_size(draws, calibration=calibration(), priors=SizePriors(), rng=rng, number=500)
            assert size.another_exam is not None
            one = size if tau < 0.1 else size.another_exam
            low, high = np.quantile(np.log(one.max_size_mm), [0.025, 0.975])
            held["this" if tau < 0.1 else "another"] += low <= true <= high
            low, high = np.quantile(np.log(size.max_size_mm), [0.025, 0.975])
            held["this where exams differ by 15 %"] += tau > 0.1 and low <= true <= high
    share = {name: count / trials for name, count in held.items()}
    assert 0.92 < share["this"] < 0.98
    assert 0.92 < share["another"] < 0.98
    # the negative control: the narrower interval where exams differ as the paper's
    assert share["this where exams differ by 15 %"] < 0.90


@pytest.mark.slow
@pytest.mark.parametrize(("tau", "maps", "trials"), [(0.05, 3, 300), (0.15, 3, 300), (0.3, 5, 300)])
def test_intervals_of_pooled_masses_cover(tau, maps, trials):
    """Masses drawn with a spread between maps from about the prior, and less: nominal 90 %."""
    rng = np.random.default_rng(7)
    inside = {"learned": 0, "left out": 0}
    for _ in range(trials):
        true, body = 2.7, rng.normal(0, BODY_SD)
        centres = true - body + rng.normal(0, tau, maps)
        draws = [shape(float(c), seed=int(rng.integers(1 << 30))) for c in centres]
        for name, priors in (("learned", SizePriors(between_maps=BetweenMaps())), ("left out", KNOWN_0)):
            size = pooled_size(draws, calibration=calibration(), priors=priors, rng=rng, number=1500)
            low, high = np.quantile(np.log(size.max_size_mm), [0.05, 0.95])
            inside[name] += low <= true <= high
    share = {name: count / trials for name, count in inside.items()}
    assert share["learned"] > 0.86
    # the negative control: maps taken to agree
    assert tau < 0.1 or share["left out"] < 0.86


def test_the_order_of_the_maps_does_not_matter():
    maps = [shape(2.6, seed=1), shape(2.8, seed=2, noise=0.05), shape(2.75, seed=3)]
    one, other = (np.log(pooled(order).max_size_mm) for order in (maps, maps[::-1]))
    assert one.mean() == pytest.approx(other.mean(), abs=0.005)
    assert one.std() == pytest.approx(other.std(), rel=0.03)


def test_a_map_apart_is_named_and_none_where_all_agree():
    prior = BetweenMaps()
    noise = np.full(4, 1e-4)
    assert outlying_maps(np.array([2.70, 2.72, 2.68, 4.0]), noise, prior) == (3,)
    assert outlying_maps(np.array([2.70, 2.72, 2.68, 2.8]), noise, prior) == ()
    assert outlying_maps(np.array([2.0, 3.0]), noise[:2], prior) == ()
    stated, learned = BetweenMaps(0.02, 0.0), BetweenMaps(0.02, 0.5)  # what is stated of these maps is not of others
    others = [SizePriors(between_maps=one, another_exam=None).spread_of_others for one in (stated, learned, None)]
    assert others == [prior, learned, prior]


def test_a_round_lump_stays_round_and_its_largest_size_is_not_biased():
    """Two axes with errors of their own would put the larger of them 0.56 standard deviations too high."""
    found = pooled([shape(2.7, q=0.05 + 0.01)], priors=KNOWN_0)
    assert found.figures["oval_probability"] < 0.2
    assert np.log(np.median(found.max_size_mm)) == pytest.approx(2.7, abs=0.01)


SEEN = SHOWN * np.exp(SHOWN_POWER * (2.7 - 1.7))
"""Share of the half log axis ratio that the maps of `shape(2.7)` show: d of 14.9 mm, widths of 5.5 mm."""


def test_an_oval_lump_is_found_along_either_axis_and_between_them():
    lump = 0.3 * SEEN
    for q, r in ((0.05 + lump, 0.0), (0.05 - lump, 0.0), (0.05, lump)):
        found = pooled([shape(2.7, q=q, r=r)], priors=KNOWN_0)
        assert found.figures["oval_probability"] > 0.95
        assert found.figures["shown_share"] == pytest.approx(SEEN, rel=0.01)
        ratio = np.median(found.max_size_mm / found.min_size_mm)
        assert np.log(ratio) == pytest.approx(0.6, rel=0.2)
    assert np.median(pooled([shape(2.7, q=0.25)]).d_x_mm) > np.median(pooled([shape(2.7, q=0.25)]).d_y_mm)
    assert np.median(pooled([shape(2.7, q=-0.15)]).d_x_mm) < np.median(pooled([shape(2.7, q=-0.15)]).d_y_mm)


def test_an_oval_seen_by_a_turned_head_is_one_oval():
    """Head turned by 60 degrees between two maps: pooled in the patient's axes they agree, in their own they cancel."""
    turn = np.radians(60.0)
    lump = np.array([0.2 * SEEN, 0.0])
    seen = lump @ log_ratio_rotation(turn)  # in the axes of a head turned by that much
    maps = [shape(2.7, q=0.05 + lump[0], r=0.0), shape(2.7, q=0.05 + seen[0], r=seen[1], turn=turn, seed=1)]
    assert pooled(maps, priors=KNOWN_0).figures["oval_half_log_ratio"] == pytest.approx(0.2, rel=0.15)
    blind = [maps[0], shape(2.7, q=0.05 + seen[0], r=seen[1], seed=1)]
    assert pooled(blind, priors=KNOWN_0).figures["oval_half_log_ratio"] < 0.14


def without_r(map_draws, oblique):
    """The same map with an angle that the fit left out."""
    return replace(map_draws, r=np.zeros_like(map_draws.r), oblique=oblique)


def test_an_angle_that_the_fit_left_out_is_not_measured_as_round():
    """A lump at 45 degrees: as measured beside the fit, unknown, and as the fit without it would have it (control)."""
    lump = 0.2 * SEEN
    straight = shape(2.7, q=0.05)
    beside = pooled([without_r(straight, (lump, 0.01))], priors=KNOWN_0)
    assert beside.figures["oval_half_log_ratio"] == pytest.approx(0.2, rel=0.2)
    assert beside.figures["oval_probability"] > 0.6
    control = pooled([without_r(straight, (0.0, 1e-6))], priors=KNOWN_0)
    unknown = pooled([without_r(straight, None)], priors=KNOWN_0)
    assert control.figures["oval_probability"] < unknown.figures["oval_probability"] < 0.5


def test_a_1_5_to_1_spheroid_is_covered_and_by_the_slope_of_ln_d_it_was_not():
    """Figures of a simulated lump, 15.2 by 10.1 mm, sigma 4.6 mm (record 0107): beyond a ball's 0.072, SD 0.011."""
    truth, excess, noise = 0.5 * np.log(15.2 / 10.1), np.array([0.072, -0.011]), 0.011**2 * np.eye(2)
    shown = SHOWN * (13.3 / 4.6) ** SHOWN_POWER
    found = elongation(excess, noise, shown=shown, prior=ShapePrior())
    assert found.probability > 0.95
    assert abs(found.mean[0] - truth) < 1.96 * np.sqrt(found.covariance[0, 0])
    slope = 1.5
    before = elongation(excess, noise, shown=1 / slope, prior=ShapePrior(0.5, 0.15))
    assert abs(before.mean[0] - truth) > 1.96 * np.sqrt(before.covariance[0, 0])


def test_the_mean_size_of_an_oval_lump_is_less_certain_than_a_balls():
    both = [pooled([shape(2.7, q=0.05 + h * SEEN)], priors=KNOWN_0) for h in (0.0, 0.35)]
    ball, oval = (np.log(one.max_size_mm * one.min_size_mm).std() / 2 for one in both)
    longer = both[1].figures["oval_half_log_ratio"]
    assert oval == pytest.approx(np.hypot(ball, OVAL_SD * longer), rel=0.1)


def test_the_share_that_a_map_shows_goes_with_d_over_its_width():
    one = shown_share(np.array([2.7, np.nan]), np.array([1.7, 1.7]))
    assert one == pytest.approx(SEEN)
    assert shown_share(np.array([2.7]), np.array([1.7 + np.log(2)])) == pytest.approx(SEEN / 2**SHOWN_POWER)


def test_an_irregular_outline_widens_both_sizes_and_is_reported():
    plain = shape(2.7)
    odd = replace(plain, irregular=True)
    narrow, wide = pooled([plain], priors=KNOWN_0), pooled([odd], priors=KNOWN_0)
    assert (narrow.figures["irregular_outline"], wide.figures["irregular_outline"]) == (0.0, 1.0)
    for name in ("max_size_mm", "min_size_mm"):
        spread = [np.log(getattr(one, name)).std() for one in (narrow, wide)]
        assert spread[1] == pytest.approx(np.hypot(spread[0], IRREGULAR_SD), rel=0.03)
    one_of_three = pooled([odd, shape(2.7, seed=1), shape(2.7, seed=2)], priors=KNOWN_0)
    assert one_of_three.figures["irregular_outline"] == 0.0


def test_elongation_is_the_conjugate_posterior():
    """Against a sum over a grid of the same model."""
    prior = ShapePrior(0.4, 0.15)
    measured, noise = np.array([0.06, -0.03]), np.diag([0.03**2, 0.05**2])
    found = elongation(measured, noise, shown=1 / 1.1, prior=prior)
    e = np.linspace(-0.9, 0.9, 901)
    x, y = np.meshgrid(e, e, indexing="ij")
    like = np.exp(-0.5 * (((1.1 * 0.06 - x) / (1.1 * 0.03)) ** 2 + ((-1.1 * 0.03 - y) / (1.1 * 0.05)) ** 2))
    slab = np.exp(-0.5 * (x**2 + y**2) / 0.15**2) / (2 * np.pi * 0.15**2)
    oval = 0.4 * np.sum(like * slab) * (e[1] - e[0]) ** 2
    round_ = 0.6 * like[450, 450]
    assert found.probability == pytest.approx(oval / (oval + round_), rel=1e-6)
    # an oval's own posterior allows for the share that is known to `SHOWN_CV` only
    seen = 1.1 * measured
    wider = 1.1**2 * noise + SHOWN_CV**2 * np.outer(seen, seen)
    off = np.stack([seen[0] - x, seen[1] - y], axis=-1)
    like = np.exp(-0.5 * np.einsum("abi,ij,abj->ab", off, np.linalg.inv(wider), off))
    assert found.mean[0] == pytest.approx(np.sum(like * slab * x) / np.sum(like * slab), rel=1e-6)


def test_what_is_known_of_the_body_is_used_and_what_the_calibration_does_not_know_is_refused():
    hidden = HiddenTerms(
        ("seat",), np.array([[0.6, 0, 0, 0, 0, 0]]), np.array([[0.12]]), np.array([-0.024]), BODY_SD**2
    )
    use = calibration(hidden=hidden)
    as_ball = SizePriors(between_maps=BetweenMaps(0.0, 0.0), shape=ShapePrior(oval_probability=1e-9))
    centred = replace(as_ball, known={"seat": 0.0})
    known, unknown = (np.log(pooled([shape(2.7)], priors=p, use=use).max_size_mm) for p in (centred, as_ball))
    assert known.mean() - unknown.mean() == pytest.approx(0.6 * 0.2, abs=0.004)
    left = 1 - 0.024**2 / 0.12 / BODY_SD**2
    assert known.std() == pytest.approx(np.hypot(BODY_SD * np.sqrt(left), 0.01), rel=0.04)
    # where bodies differ twice as much, what is known of one tells twice as much of its size
    twice = replace(use.spread, mean=use.spread.mean + np.log([2.0, *np.ones(len(use.spread.mean) - 1)]))
    wide = replace(use, spread=twice)
    known, unknown = (np.log(pooled([shape(2.7)], priors=p, use=wide).max_size_mm) for p in (centred, as_ball))
    assert known.mean() - unknown.mean() == pytest.approx(2 * 0.6 * 0.2, abs=0.008)
    # and nothing of bodies of another kind
    other = use.with_other_sd(0.1)
    known, unknown = (np.log(pooled([shape(2.7)], priors=p, use=other).max_size_mm) for p in (centred, as_ball))
    assert known.mean() - unknown.mean() == pytest.approx(0.6 * 0.2, abs=0.006)
    assert known.std() == pytest.approx(np.sqrt(BODY_SD**2 * left + 0.01**2 + 0.1**2), rel=0.04)
    with pytest.raises(UsageError, match="no property weather"):
        pooled([shape(2.7)], priors=SizePriors(known={"weather": 1.0}), use=use)


def test_fewer_than_half_of_the_maps_give_no_size():
    few = pool_maps([shape(2.7), None, None], calibration=calibration(), priors=SizePriors(),
                    rng=np.random.default_rng(1))  # fmt: skip
    assert few.status == "no_estimate"
    assert "1 of 3" in few.reason
    enough = pool_maps([shape(2.7), None, shape(2.75, seed=1)], calibration=calibration(), priors=SizePriors(),
                       rng=np.random.default_rng(1))  # fmt: skip
    assert enough.status == "estimate"
    assert set(enough.centres) == {0, 2}
    assert pool_maps([], calibration=calibration(), priors=SizePriors(), rng=np.random.default_rng(1)).size is None


def test_draws_without_a_rise_are_counted():
    broken = shape(2.7)
    log_a = broken.log_amplitude.copy()
    log_a[::4] = np.nan
    maps = [ShapeDraws(log_a, broken.log_width, broken.q, broken.r)]
    assert pooled(maps).invalid == pytest.approx(5000, rel=0.1)
    none = pool_maps(maps, calibration=calibration(), priors=SizePriors(), rng=np.random.default_rng(1))
    assert none.status == "no_estimate"


@pytest.mark.parametrize("noise", [0.0, 1e-9])
def test_a_map_without_noise_is_no_special_case(noise):
    found = pooled([shape(2.7, noise=noise)] * 3, priors=KNOWN_0)
    assert np.isfinite(found.max_size_mm).all()
    assert sum(found.variance_share.values()) == pytest.approx(100.0)
