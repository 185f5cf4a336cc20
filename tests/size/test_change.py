"""Sizes at several visits together: what is shared cancels, what is not does not, and the stated odds hold.

Reference values are the closed form of a linear model with normal errors.
"""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from plain_calibration import plain_calibration

from tactile_bayes.declarations import replace
from tactile_bayes.files.size_json import read_size_calibration, size_calibration_path
from tactile_bayes.report.compare import TrendReport, growth_rates, rate_sentences
from tactile_bayes.size.bodies import BodyCalibration
from tactile_bayes.size.draws import BetweenMaps, ShapeDraws, ShapePrior
from tactile_bayes.size.pooling import POOLED_DRAWS, SizePriors, pooled_size
from tactile_bayes.size.terms import SiteShift
from tactile_bayes.size.visits import (
    AMPLITUDE_LAW,
    SHARED_BODY,
    SHARED_WITHOUT_DEPTH,
    STRANGERS,
    AmplitudeLaw,
    JointSizes,
    SharedBody,
    joint_sizes,
    straight_line,
    visit_calibrations,
)

BODY_SD, EXAM_SD, NOISE = 0.08, 0.02, 0.01
ROUND = SizePriors(shape=ShapePrior(oval_probability=1e-9), another_exam=None)
WHOLE = SharedBody(0.0, 1e6)


def calibration(*, amplitude_variance: float = 1e-6) -> BodyCalibration:
    return plain_calibration(body_sd=BODY_SD, exam_sd=EXAM_SD, amplitude_variance=amplitude_variance)


def shape(log_size: float, *, seed: int = 0, u: float = 0.0) -> ShapeDraws:
    """Draws of a map whose size by the calibration is as given."""
    rng = np.random.default_rng(seed)
    v = log_size - 2.5 - 0.3 * u + NOISE * rng.standard_normal(1000)
    q, r = (value + 0.01 * rng.standard_normal(1000) for value in (0.05, 0.0))
    return ShapeDraws(np.full(1000, -1.0 + u), v + 1.5, q, r)


def joint(
    *visits: list[ShapeDraws],
    law: SharedBody = WHOLE,
    use: BodyCalibration | None = None,
    amplitudes: AmplitudeLaw | None = None,
    number: int = POOLED_DRAWS,
):
    """Sizes of the visits together, by default by the sizes alone."""
    return joint_sizes(
        visits,
        calibration=use or calibration(),
        priors=ROUND,
        rng=np.random.default_rng(3),
        between=BetweenMaps(EXAM_SD, 0.0),
        law=law,
        amplitudes=amplitudes,
        number=number,
    )


def test_a_body_that_is_shared_cancels_and_the_maps_remain():
    change = joint([shape(2.7)], [shape(2.8, seed=1)]).change(0, 1)
    assert np.median(change.log_ratio) == pytest.approx(0.1, abs=0.003)
    assert change.log_sd == pytest.approx(np.sqrt(2 * (EXAM_SD**2 + NOISE**2)), rel=0.04)


def test_strangers_have_the_spread_of_two_separate_estimates():
    change = joint([shape(2.7)], [shape(2.8, seed=1)], law=STRANGERS).change(0, 1)
    assert change.log_sd == pytest.approx(np.sqrt(2 * (BODY_SD**2 + EXAM_SD**2 + NOISE**2)), rel=0.03)


@pytest.mark.parametrize("growth", [0.0, 0.3])
def test_between_the_two_the_law_says_how_much_of_the_body_is_another(growth):
    law = SharedBody(0.2, 0.5)
    change = joint([shape(2.6)], [shape(2.6 + growth, seed=1)], law=law).change(0, 1)
    shared = 0.8 * np.exp(-0.5 * (growth / 0.5) ** 2)
    expected = 2 * (EXAM_SD**2 + NOISE**2 + (1 - shared) * BODY_SD**2)
    assert change.log_sd == pytest.approx(np.sqrt(expected), rel=0.04)


def test_exams_of_a_visit_average_out():
    visits = [[shape(2.7 + 0.1 * v, seed=4 * v + e) for e in range(4)] for v in range(2)]
    change = joint(*visits).change(0, 1)
    assert change.log_sd == pytest.approx(np.sqrt(2 * (EXAM_SD**2 + NOISE**2) / 4), rel=0.05)


def test_each_visits_size_is_that_of_its_maps_pooled():
    maps = [shape(2.7, seed=1), shape(2.72, seed=2)]
    together = joint(maps, [shape(2.9, seed=3)], law=SHARED_BODY)
    priors = replace(ROUND, between_maps=BetweenMaps(EXAM_SD, 0.0))
    alone = pooled_size(maps, calibration=calibration(), priors=priors, rng=np.random.default_rng(5), number=8192)
    for probability in (0.025, 0.5, 0.975):
        mine = np.quantile(together.log_size[0], probability)
        assert mine == pytest.approx(np.quantile(np.log(alone.max_size_mm), probability), abs=0.006)


def test_visits_in_the_other_order_give_the_opposite_change():
    one, two = [shape(2.7, seed=1)], [shape(2.82, seed=2)]
    there, back = joint(one, two).change(0, 1), joint(two, one).change(0, 1)
    assert np.median(there.log_ratio) == pytest.approx(-np.median(back.log_ratio), abs=0.002)
    assert there.probability_above(0.0) == pytest.approx(1 - back.probability_above(0.0), abs=0.002)


@pytest.mark.parametrize("growth", [0.0, 0.4])
def test_an_uncertain_coefficient_matters_by_what_changes_of_its_term(growth):
    """The term of f is -u: two maps that differ by 0.4 in u differ by 0.4 times the coefficient's error."""
    use = calibration(amplitude_variance=0.05**2)
    change = joint([shape(2.6)], [shape(2.6 + growth, seed=1, u=growth)], use=use).change(0, 1)
    expected = 2 * (EXAM_SD**2 + NOISE**2) + (0.05 * growth) ** 2
    assert change.log_sd == pytest.approx(np.sqrt(expected), rel=0.05)


def test_a_sites_correction_is_shared_too():
    site = SiteShift(1.5, np.array([0.1, 0.0]), np.diag([0.05**2, 0.1**2]), 5, 10, "b", True, {})
    use = replace(calibration(), site=site)
    apart = joint([shape(2.6)], [shape(3.0, seed=1)], use=use)
    expected = 2 * (EXAM_SD**2 + NOISE**2) + (0.1 * 0.4) ** 2
    assert apart.change(0, 1).log_sd == pytest.approx(np.sqrt(expected), rel=0.05)
    assert np.median(apart.log_size[0]) == pytest.approx(2.7, abs=0.01)


def test_the_spread_between_exams_is_learned_at_all_visits_together():
    alike = [[shape(2.7 + 0.1 * v, seed=3 * v + e) for e in range(3)] for v in range(2)]
    apart = [[shape(2.7 + 0.1 * v + 0.2 * (e - 1), seed=3 * v + e) for e in range(3)] for v in range(2)]
    of = {
        name: joint_sizes(maps, calibration=calibration(), priors=ROUND, rng=np.random.default_rng(1), between=prior)
        for prior in (BetweenMaps(),)
        for name, maps in (("alike", alike), ("apart", apart), ("one", [one[:1] for one in apart]))
    }
    assert of["one"].between_map_sd == pytest.approx(0.15, rel=0.05)
    assert of["alike"].between_map_sd < 0.05
    assert of["apart"].between_map_sd > 0.15


def trial(
    rng: np.random.Generator,
    law: SharedBody,
    *,
    growth: float,
    use: SharedBody,
    exams: float = EXAM_SD,
    between: BetweenMaps | None = None,
) -> tuple[bool, bool]:
    """Two visits of two exams from the model with one law, compared by another: does the 95 % interval hold, alarm?

    `exams` is how far exams lie apart, `between` what the comparison supposes of it.
    """
    shared = law.correlation(np.array([0.0, growth]))
    bodies = BODY_SD * np.linalg.cholesky(shared + 1e-12 * np.eye(2)) @ rng.standard_normal(2)
    visits = [
        [shape(2.6 + g - b + exams * rng.standard_normal(), seed=int(rng.integers(1 << 30))) for _ in range(2)]
        for g, b in zip((0.0, growth), bodies, strict=True)
    ]
    found: JointSizes = joint_sizes(
        visits,
        calibration=calibration(),
        priors=ROUND,
        rng=rng,
        between=between or BetweenMaps(EXAM_SD, 0.0),
        law=use,
        amplitudes=None,
        number=512,
    )
    change = found.change(0, 1)
    q = change.log_summary(0.95)
    return q.low <= growth <= q.high, not 0.025 <= change.probability_above(0.0) <= 0.975


@pytest.mark.slow
def test_intervals_hold_and_alarms_are_as_rare_as_stated():
    """Nominal 95 and 5 % over 300 pairs each; with the body taken as wholly the same, the control, neither does."""
    law, rng = SharedBody(0.3, 0.5), np.random.default_rng(17)
    still = np.array([trial(rng, law, growth=0.0, use=law) for _ in range(300)])
    grown = np.array([trial(rng, law, growth=0.25, use=law) for _ in range(300)])
    sure = np.array([trial(rng, law, growth=0.0, use=WHOLE) for _ in range(200)])
    assert 0.92 < still[:, 0].mean() < 0.98
    assert 0.92 < grown[:, 0].mean() < 0.98
    assert 0.02 < still[:, 1].mean() < 0.08
    assert grown[:, 1].mean() > 0.8
    assert sure[:, 1].mean() > 0.12
    assert sure[:, 0].mean() < 0.88


@pytest.mark.slow
def test_changes_at_a_site_hold_by_its_repeatability_and_not_by_half_of_it():
    """Exams 12 % apart and a file learned from such: nominal 95 and 5 %. The controls take 3 %, as without a file."""
    law, rng = SharedBody(0.3, 0.5), np.random.default_rng(23)
    learned = BetweenMaps(0.12, 0.25)
    by_site = np.array([trial(rng, law, growth=0.0, use=law, exams=0.12, between=learned) for _ in range(300)])
    without = np.array([trial(rng, law, growth=0.0, use=law, exams=0.12, between=BetweenMaps(0.03, 0.0))
                        for _ in range(200)])  # fmt: skip
    half = np.array([trial(rng, law, growth=0.0, use=law, exams=0.12, between=BetweenMaps(0.06, 0.0))
                     for _ in range(200)])  # fmt: skip
    assert 0.92 < by_site[:, 0].mean() < 0.98
    assert 0.02 < by_site[:, 1].mean() < 0.08
    assert half[:, 0].mean() < 0.88
    assert without[:, 0].mean() < 0.75


ONE = AmplitudeLaw(2.0, 2.0, posture=3.0, posture_sd=0.04, fat_sd=0.02, exam_factor=3.0, otherwise=0.0)
"""A law with one exponent, by which everything is normal."""


@pytest.mark.parametrize("u", [0.2, 0.3, 0.0])
def test_amplitudes_are_weighted_by_what_posture_and_exams_leave_in_them(u):
    """Two normals about one change: the sizes' own, and ln a over 2 with what posture and exams leave in it."""
    visits = [shape(2.7)], [shape(2.8 + 0.3 * u, seed=1, u=u)]
    alone, both = joint(*visits).change(0, 1), joint(*visits, amplitudes=ONE).change(0, 1)
    by_size = 1 / (2 * (EXAM_SD**2 + NOISE**2))
    by_amplitude = 2.0**2 / (2 * ((3.0 * EXAM_SD) ** 2 + (3.0 * 0.04) ** 2))
    middle = (by_size * np.median(alone.log_ratio) + by_amplitude * u / 2.0) / (by_size + by_amplitude)
    assert np.median(both.log_ratio) == pytest.approx(middle, abs=0.002)
    assert both.log_sd == pytest.approx((by_size + by_amplitude) ** -0.5, rel=0.04)


def test_noise_that_moves_size_and_amplitude_alike_shows_in_the_amplitude_and_goes():
    """A mass that did not change, whose maps' errors of ln d and ln a are the same."""
    rng = np.random.default_rng(5)

    def faint(error: float) -> ShapeDraws:
        one, common = shape(2.7, seed=int(rng.integers(1000))), 0.2 * rng.standard_normal(1000)
        return replace(one, log_width=one.log_width + error + common, log_amplitude=one.log_amplitude + error + common)

    visits = [faint(0.0)], [faint(0.2)]
    sure = replace(ONE, least=1e-3, most=1e-3, posture_sd=0.0, exam_factor=0.1)
    alone, both = joint(*visits).change(0, 1), joint(*visits, amplitudes=sure).change(0, 1)
    assert np.median(alone.log_ratio) == pytest.approx(0.26, abs=0.03)
    assert np.median(both.log_ratio) == pytest.approx(0.0, abs=0.03)
    assert both.log_sd < 0.2 * alone.log_sd


def test_an_amplitude_that_fell_with_deeper_fat_is_no_shrinkage():
    """In the control, whose amplitudes do not depend on the posture, it is."""
    path = size_calibration_path("solid")
    assert path is not None
    shipped = read_size_calibration(path)
    profiles = (0.0, 0.0, 0.0), (0.03, 0.0, 0.0)
    first, later = visit_calibrations([[replace(shape(2.5), profile=one)] for one in profiles], shipped)
    deeper = float(np.log(later.fat_mm / first.fat_mm))
    by_posture = -AMPLITUDE_LAW.posture * deeper
    visits = [[replace(shape(2.5, u=u), profile=one)] for u, one in zip((0.0, by_posture), profiles, strict=True)]
    law = replace(AMPLITUDE_LAW, posture_sd=1.0)
    stayed, shrunk = (
        joint(*visits, use=shipped, amplitudes=one).change(0, 1) for one in (law, replace(law, posture=0.0))
    )
    alone = joint(*visits, use=shipped).change(0, 1)
    middle = [float(np.median(one.log_ratio)) for one in (stayed, shrunk, alone)]
    assert np.sign(deeper) * (middle[0] - middle[1]) > 0.02
    assert abs(middle[0]) < abs(middle[2])


def test_an_amplitude_that_changed_for_another_reason_leaves_the_sizes_alone():
    """A mass that became much softer: without room for that, the control, the change is wrong and sure."""
    visits = [shape(2.7)], [shape(2.7, seed=1, u=-1.0)]
    alone = joint(*visits).change(0, 1)
    found, sure = (joint(*visits, amplitudes=one).change(0, 1) for one in (replace(ONE, otherwise=0.1), ONE))
    assert np.median(found.log_ratio) == pytest.approx(np.median(alone.log_ratio), abs=0.01)
    assert found.log_sd == pytest.approx(alone.log_sd, rel=0.05)
    assert np.median(sure.log_ratio) < np.median(alone.log_ratio) - 0.02


def seen(rng: np.random.Generator, growth: float, exponent: float, exam_factor: float) -> list[list[ShapeDraws]]:
    """Two visits of two exams of one body, with amplitudes as a law has them."""
    visits = []
    for g, s in zip((0.0, growth), AMPLITUDE_LAW.posture_sd * rng.standard_normal(2), strict=True):
        exams = []
        for e in rng.standard_normal((2, 2)):
            u = exponent * g - AMPLITUDE_LAW.posture * s + exam_factor * EXAM_SD * e[1]
            exams.append(shape(2.6 + g + EXAM_SD * e[0], seed=int(rng.integers(1 << 30)), u=u))
        visits.append(exams)
    return visits


@pytest.mark.slow
def test_intervals_by_amplitudes_hold_wherever_the_lump_grew_to():
    """Nominal 95 and 5 % over 200 pairs each; the control has no posture and a fifth of the exams' spread in ln a."""
    rng, law = np.random.default_rng(29), replace(AMPLITUDE_LAW, exam_factor=3.0)

    def judged(growth: float, use: AmplitudeLaw) -> tuple[float, float]:
        found = []
        for _ in range(200):
            exponent = float(np.exp(rng.uniform(np.log(law.least), np.log(law.most))))
            visits = seen(rng, growth, exponent, 3.0)
            change = joint(*visits, amplitudes=use, number=512).change(0, 1)
            q = change.log_summary(0.95)
            found.append((q.low <= growth <= q.high, not 0.025 <= change.probability_above(0.0) <= 0.975))
        held, alarmed = np.array(found).mean(axis=0)
        return float(held), float(alarmed)

    still, grown = judged(0.0, law), judged(0.15, law)
    assert still[0] > 0.92
    assert still[1] < 0.08
    assert 0.92 < grown[0] < 0.99
    assert grown[1] > 0.9
    sure = judged(0.0, replace(law, posture_sd=0.001, exam_factor=0.6))
    assert sure[1] > 0.12


def test_the_smallest_detectable_change_is_that_whose_interval_begins_at_none():
    """exp(1.96 SD) - 1 or 1 - exp(-1.96 SD): at that estimated change the probability of its direction is 0.975."""
    change = joint([shape(2.7)], [shape(2.75, seed=1)]).change(0, 1)
    growth, shrinkage = change.smallest_detectable(0.95)
    assert growth == pytest.approx(np.expm1(1.96 * change.log_sd), rel=0.02)
    assert shrinkage == pytest.approx(-np.expm1(-1.96 * change.log_sd), rel=0.02)
    for least, probability in ((growth, 0.975), (-shrinkage, 0.025)):
        moved = replace(change, mean=change.mean - change.mean.mean() + np.log1p(least))
        assert moved.probability_above(0.0) == pytest.approx(probability, abs=0.003)


def test_odds_fall_with_the_growth_that_is_asked_for():
    change = joint([shape(2.7)], [shape(2.88, seed=1)]).change(0, 1)
    odds = [change.probability_above(share) for share in (-0.2, 0.0, 0.1, 0.2, 0.5)]
    assert odds == sorted(odds, reverse=True)
    assert odds[0] > 0.999 > 0.001 > odds[-1]
    assert change.percent(0.95).median == pytest.approx(100 * np.expm1(0.18), abs=1.0)


@pytest.mark.parametrize(("profile", "law"), [(None, SHARED_WITHOUT_DEPTH), ((0.0, 0.0, 0.0), SHARED_BODY)])
def test_the_law_is_that_of_what_the_maps_hide(profile, law):
    """Maps that tell the depth of fat hide less, and something else, than those that do not."""
    path = size_calibration_path("solid")
    assert path is not None
    visits = [[replace(shape(p, seed=1), profile=profile)] for p in (2.5, 2.55)]
    shipped, rng = read_size_calibration(path), np.random.default_rng(1)
    found = joint_sizes(visits, calibration=shipped, priors=ROUND, rng=rng, number=512)
    assert (found.calibrations[0].fat_mm is None) == (profile is None)
    shared = law.correlation(np.array([float(np.nanmean(one)) for one in found.log_size]))
    assert found.correlation[0, 1] == pytest.approx(shared[0, 1], rel=0.05)


def test_each_visit_is_sized_at_the_depth_of_fat_that_its_own_maps_tell():
    """Posture changes that depth; where one visit tells none, none has one."""
    path = size_calibration_path("solid")
    assert path is not None
    shipped = read_size_calibration(path)
    deeper, shallower, none = ([replace(shape(2.5), profile=one)] for one in ((0.0,) * 3, (0.03, 0.0, 0.0), None))
    first, later = visit_calibrations([deeper, shallower], shipped)
    assert first.fat_mm != pytest.approx(later.fat_mm, rel=0.002)
    assert first.fat_mm == visit_calibrations([deeper, deeper], shipped)[1].fat_mm
    assert [one.fat_mm for one in visit_calibrations([deeper, none], shipped)] == [None, None]


def test_the_correlation_of_many_visits_is_one_matrix():
    """Positive semi-definite whatever the growth, or no draws could have it."""
    rng = np.random.default_rng(2)
    for _ in range(20):
        law = SharedBody(float(rng.uniform(0, 1)), float(rng.uniform(0.05, 3)))
        matrix = law.correlation(rng.normal(2.7, 0.5, 8))
        assert np.linalg.eigvalsh(matrix)[0] > -1e-9
        assert np.allclose(np.diag(matrix), 1.0)


def test_a_straight_line_through_two_visits_is_their_change_over_the_time():
    covariance = np.array([[0.02, 0.018], [0.018, 0.021]])
    line = straight_line(np.array([2.7, 2.9]), covariance, [0.0, 50.0])
    assert line.per_day == pytest.approx(0.2 / 50)
    assert line.sd == pytest.approx(np.sqrt(0.02 + 0.021 - 2 * 0.018) / 50)
    assert line.departure is None


def test_a_straight_line_through_equal_independent_visits_is_least_squares():
    """numpy's own fit; what all visits share moves neither the slope nor its error."""
    days, y = np.array([0.0, 30.0, 90.0, 200.0]), np.array([2.60, 2.70, 2.72, 2.95])
    own = 0.05**2 * np.eye(4)
    slope = np.polyfit(days, y, 1)[0]
    for shared in (0.0, 0.1):
        line = straight_line(y, own + shared**2, list(days))
        assert line.per_day == pytest.approx(slope)
        assert line.sd == pytest.approx(0.05 / np.sqrt(np.sum((days - days.mean()) ** 2)))
    assert line.departure is not None
    bent = straight_line(np.array([2.6, 2.9, 2.6, 2.9]), own, list(days))
    assert bent.departure is not None
    assert bent.departure < 0.001 < line.departure


@pytest.mark.parametrize(("chance", "lines"), [(0.049, 2), (0.05, 1), (None, 1)])
def test_sizes_that_do_not_follow_one_growth_are_told(chance: float | None, lines: int):
    trend = TrendReport(4, 90.0, *growth_rates([0.01, 0.005, 0.02], 0.9), chance)
    told = rate_sentences(SimpleNamespace(trend=trend))
    assert len(told) == lines
    assert told[-1].startswith("The sizes do not follow one steady growth (probability 0.049)") == (lines == 2)


def test_a_volume_that_grows_by_one_percent_a_day_doubles_in_69_days():
    rate, doubling = growth_rates([0.01, 0.0, 0.02], 0.9)
    assert (rate.median, rate.low, rate.high, rate.probability) == (1.0, 0.0, 2.0, 0.9)
    assert (doubling.median, doubling.shortest) == pytest.approx((69.3, 34.7), abs=0.1)
    assert doubling.longest is None
    assert growth_rates([-0.01, -0.02, 0.01], 0.9)[1].median is None
