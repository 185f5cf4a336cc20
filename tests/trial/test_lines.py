"""Lines between methods against printed answers, independent derivations and what scaling must do to them."""

from __future__ import annotations

import math
from itertools import combinations

import numpy as np
import pytest
from scipy import stats

from tactile_bayes.trial import lines
from tactile_bayes.trial.figures import UndefinedError
from tactile_bayes.trial.lines import (
    deming,
    deming_slope,
    deming_slopes,
    jackknife_errors,
    least_squares,
    passing_bablok,
    weighted_deming,
)

# NCSS Statistical Software, chapter "Deming Regression", example 1.
NCSS_X = np.array([7, 8.3, 10.5, 9, 5.1, 8.2, 10.2, 10.3, 7.1, 5.9])
NCSS_Y = np.array([7.9, 8.2, 9.6, 9, 6.5, 7.3, 10.2, 10.6, 6.3, 5.2])


def cloud(seed: int, n: int = 40, *, digits: int | None = None) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    x = rng.lognormal(2.8, 0.4, n)
    y = 1.1 * x * rng.lognormal(0, 0.2, n)
    return (x, y) if digits is None else (np.round(x, digits), np.round(y, digits))


def test_deming_as_ncss_prints_it() -> None:
    line = deming(NCSS_X, NCSS_Y, error_ratio=4)
    assert line.intercept == pytest.approx(-0.0897, abs=5e-5)
    assert line.slope == pytest.approx(1.0012, abs=5e-5)


def test_jackknife_errors_of_deming_as_ncss_prints_them() -> None:
    intercept_se, slope_se = jackknife_errors(lambda x, y: deming(x, y, error_ratio=4), NCSS_X, NCSS_Y)
    assert intercept_se == pytest.approx(1.7220, abs=5e-5)
    assert slope_se == pytest.approx(0.1872, abs=5e-5)


def test_jackknife_errors_of_a_mean_like_line_are_students() -> None:
    """With x constant in pairs the slope is a difference of two means; its jackknife variance is that of the means."""
    x = np.repeat([1.0, 2.0], 6)
    y = np.random.default_rng(0).normal(0, 1, 12)
    _, slope_se = jackknife_errors(least_squares, x, y)
    left_out = np.array([least_squares(np.delete(x, i), np.delete(y, i)).slope for i in range(12)])
    assert slope_se == pytest.approx(math.sqrt(11 / 12 * np.sum((left_out - left_out.mean()) ** 2)))


def test_least_squares_as_scipy() -> None:
    x, y = cloud(1)
    found, expected = least_squares(x, y), stats.linregress(x, y)
    assert (found.slope, found.intercept) == pytest.approx((expected.slope, expected.intercept))
    assert (found.slope_se, found.intercept_se) == pytest.approx((expected.stderr, expected.intercept_stderr))


@pytest.mark.parametrize("error_ratio", [0.05, 0.5, 1.0, 4.0, 30.0])
@pytest.mark.parametrize("sign", [1, -1])
def test_deming_is_the_principal_axis_of_data_scaled_by_their_errors(error_ratio: float, sign: int) -> None:
    x, y = cloud(3)
    y = sign * y
    _, vectors = np.linalg.eigh(np.cov(x / math.sqrt(error_ratio), y))
    along = vectors[:, 1]
    expected = along[1] / along[0] / math.sqrt(error_ratio)
    found = deming(x, y, error_ratio=error_ratio)
    assert found.slope == pytest.approx(expected, rel=1e-10)
    assert found.intercept == pytest.approx(y.mean() - expected * x.mean(), rel=1e-9)


def test_deming_runs_from_one_least_squares_line_to_the_other() -> None:
    x, y = cloud(4)
    assert deming(x, y, error_ratio=1e-9).slope == pytest.approx(least_squares(x, y).slope, rel=1e-6)
    assert deming(x, y, error_ratio=1e9).slope == pytest.approx(1 / least_squares(y, x).slope, rel=1e-6)


def test_exchanging_the_methods_inverts_demings_line() -> None:
    x, y = cloud(5)
    assert deming(y, x, error_ratio=0.25).slope == pytest.approx(1 / deming(x, y, error_ratio=4).slope)
    assert weighted_deming(y, x, error_ratio=0.25, threshold=1e-13).slope == pytest.approx(
        1 / weighted_deming(x, y, error_ratio=4, threshold=1e-13).slope, rel=1e-8
    )


def test_demings_standard_error_is_about_what_trials_scatter() -> None:
    rng = np.random.default_rng(6)
    slopes, errors = [], []
    for _ in range(400):
        truth = rng.normal(20, 5, 60)
        line = deming(truth + rng.normal(0, 1, 60), 1.2 * truth + rng.normal(0, 1, 60))
        slopes.append(line.slope)
        errors.append(line.slope_se)
    assert np.mean(errors) == pytest.approx(np.std(slopes), rel=0.12)


@pytest.mark.parametrize("error_ratio", [0.5, 1.0, 3.0])
def test_weighted_deming_is_a_fixed_point(error_ratio: float) -> None:
    """Carried on to its end, the line is Deming's for the weights that it gives itself, by plain formulas."""
    x, y = cloud(7)
    line = weighted_deming(x, y, error_ratio=error_ratio, max_iterations=500, threshold=1e-14)
    foot = (x + error_ratio * line.slope * (y - line.intercept)) / (1 + error_ratio * line.slope**2)
    weight = ((foot + error_ratio * (line.intercept + line.slope * foot)) / (1 + error_ratio)) ** -2.0
    mx, my = np.average(x, weights=weight), np.average(y, weights=weight)
    covariance = np.cov(x / math.sqrt(error_ratio), y, aweights=weight)
    along = np.linalg.eigh(covariance)[1][:, 1]
    assert line.slope == pytest.approx(along[1] / along[0] / math.sqrt(error_ratio), rel=1e-9)
    assert line.intercept == pytest.approx(my - line.slope * mx, abs=1e-8)


def test_weighted_deming_stops_at_its_limit_of_iterations() -> None:
    x, y = cloud(8)
    first = weighted_deming(x, y, max_iterations=1)
    usual, more = weighted_deming(x, y), weighted_deming(x, y, max_iterations=500, threshold=0)
    assert abs(first.slope - more.slope) > abs(usual.slope - more.slope)
    assert usual.slope == pytest.approx(more.slope, abs=1e-5)


def plain_passing_bablok(x: np.ndarray, y: np.ndarray, confidence: float = 0.95) -> tuple[float, ...]:
    """By the words of Passing & Bablok (1983), section 2.1: slopes, K of them below -1, the shifted median. For a
    rising cloud without a slope of -1 and without an even number of slopes' middle on either side of it."""
    slopes = []
    for i, j in combinations(range(len(x)), 2):
        if x[i] != x[j]:
            slopes.append((y[i] - y[j]) / (x[i] - x[j]))
        elif y[i] != y[j]:
            slopes.append(math.inf)
    slopes.sort()
    number, k, n = len(slopes), sum(slope < -1 for slope in slopes), len(x)
    assert -1 not in slopes

    def at(twice: int) -> float:  # 1-based rank twice / 2, or the angle between two
        if twice % 2 == 0:
            return slopes[twice // 2 - 1]
        return math.tan((math.atan(slopes[twice // 2 - 1]) + math.atan(slopes[twice // 2])) / 2)

    reach = round(stats.norm.ppf(0.5 + confidence / 2) * math.sqrt(n * (n - 1) * (2 * n + 5) / 18))
    middle = number + 1 + 2 * k
    slope, low, high = at(middle), at(middle - reach), at(middle + reach)
    return slope, np.median(y - slope * x), low, high, np.median(y - high * x), np.median(y - low * x)


@pytest.mark.parametrize("seed", range(12))
def test_passing_bablok_by_its_definition(seed: int) -> None:
    x, y = cloud(seed, 9 + 3 * seed)
    found = passing_bablok(x, y)
    flat = (found.slope, found.intercept, *found.stated[1], *found.stated[0])
    assert flat == pytest.approx(plain_passing_bablok(x, y))


def test_passing_bablok_is_of_one_slope_in_mm_and_in_tenths_of_them() -> None:
    """Tenths are whole numbers, whose pairs of slope -1 are exact; in mm 13.3 - 12.1 is not 1.2: they were missed."""
    rng = np.random.default_rng(77)
    for _ in range(60):
        x = np.round(10 * rng.lognormal(2.8, 0.4, 12))
        y = np.round(1.1 * x * np.exp(rng.normal(0, 0.15, 12)))
        tenths, mm = passing_bablok(x, y), passing_bablok(x / 10, y / 10)
        assert mm.slope == pytest.approx(tenths.slope, rel=1e-12)
        assert mm.stated is not None and tenths.stated is not None  # noqa: PT018
        assert mm.stated[1] == pytest.approx(tenths.stated[1], rel=1e-12)


def test_passing_bablok_counts_ties_and_slopes_of_minus_one_by_half() -> None:
    """Slopes of the six pairs by hand: 1, 1, 1, -1 twice, vertical once. Shift: two at -1 are half each, so 1."""
    x, y = np.array([0.0, 1.0, 1.0, 2.0]), np.array([0.0, 1.0, -1.0, 2.0])
    # pairs: (0,1) 1; (0,2) -1; (0,3) 1; (1,2) vertical; (1,3) 1; (2,3) 3 -> ordered -1 1 1 1 3 inf, half a shift
    assert passing_bablok(x, y).slope == pytest.approx(1.0)
    coincident = passing_bablok(np.repeat(x, 2), np.repeat(y, 2))
    assert coincident.slope == pytest.approx(1.0)


def test_two_middle_slopes_are_averaged_as_angles() -> None:
    x, y = np.array([0.0, 1.0, 1.0, 3.0]), np.array([0.0, 1.0, 3.0, 4.0])
    # ordered: 1/2, 1, 4/3, 3/2, 3, vertical; the middle two are 4/3 and 3/2
    assert passing_bablok(x, y).slope == pytest.approx(math.tan((math.atan(4 / 3) + math.atan(3 / 2)) / 2))


@pytest.mark.parametrize("seed", range(4))
def test_a_falling_line_is_the_mirror_image(seed: int) -> None:
    x, y = cloud(seed)
    up, down = passing_bablok(x, y), passing_bablok(x, -y)
    assert (down.slope, down.intercept) == pytest.approx((-up.slope, -up.intercept))
    assert down.stated[1] == pytest.approx((-up.stated[1][1], -up.stated[1][0]))
    assert down.stated[0] == pytest.approx((-up.stated[0][1], -up.stated[0][0]))


@pytest.mark.parametrize("seed", range(4))
def test_exchanging_the_methods_inverts_passing_and_babloks_line(seed: int) -> None:
    x, y = cloud(seed, 41)
    one, other = passing_bablok(x, y), passing_bablok(y, x)
    assert other.slope == pytest.approx(1 / one.slope)
    assert other.stated[1] == pytest.approx(tuple(1 / end for end in reversed(one.stated[1])))


def test_a_line_through_the_pairs_of_too_many_masses_is_undefined() -> None:
    x = np.linspace(5, 40, lines.MOST_MASSES + 1)
    with pytest.raises(UndefinedError, match=r"the pairs of more than 10,000 masses are not listed"):
        passing_bablok(x, x)


@pytest.mark.parametrize("digits", [None, 0])
def test_pairs_listed_in_parts_are_all_pairs(digits: int | None, monkeypatch: pytest.MonkeyPatch) -> None:
    x, y = cloud(9, 240, digits=digits)
    whole = passing_bablok(x, y)
    monkeypatch.setattr(lines, "_AT_ONCE", 7)
    assert passing_bablok(x, y) == whole
    angles, _ = lines._pair_angles(x, y)
    pairs = [(b - a, d - c) for (a, c), (b, d) in combinations(zip(x, y, strict=True), 2) if (a, c) != (b, d)]
    expected = sorted(math.pi / 2 if dx == 0 else math.atan(dy / dx) for dx, dy in pairs)
    assert angles == pytest.approx(expected, abs=1e-14)


@pytest.mark.parametrize("digits", [None, 0])
def test_a_line_rises_where_kendalls_tau_is_not_negative(digits: int | None) -> None:
    for seed in range(6):
        x, y = np.random.default_rng(seed).normal(0, 3, (2, 30))
        if digits is not None:
            x, y = np.round(x), np.round(y)
        assert lines._pair_angles(x, y)[1] == (stats.kendalltau(x, y).statistic >= 0)


FITS = {
    "least squares": least_squares,
    "Deming": lambda x, y: deming(x, y, error_ratio=2),
    "weighted Deming": lambda x, y: weighted_deming(x, y, error_ratio=2, threshold=0, max_iterations=60),
    "Passing-Bablok": passing_bablok,
}


@pytest.mark.parametrize("name", FITS)
@pytest.mark.parametrize("scale", [1e-6, 1e12])
def test_scaling_both_methods_scales_only_the_intercept(name: str, scale: float) -> None:
    x, y = cloud(11)
    plain, scaled = FITS[name](x, y), FITS[name](scale * x, scale * y)
    assert scaled.slope == pytest.approx(plain.slope, rel=1e-9)
    assert scaled.intercept == pytest.approx(scale * plain.intercept, rel=1e-7)


@pytest.mark.parametrize("name", FITS)
def test_a_perfect_line_is_found_as_it_is(name: str) -> None:
    x = np.array([3.0, 5.0, 8.0, 13.0, 21.0])
    line = FITS[name](x, 0.5 + 1.25 * x)
    assert (line.intercept, line.slope) == pytest.approx((0.5, 1.25))


def test_slope_zero_has_a_defined_answer() -> None:
    x, y = np.array([1.0, 2.0, 3.0, 4.0]), np.array([5.0, 5.0, 5.0, 5.0])
    for name in FITS:
        line = FITS[name](x, y)
        assert (line.slope, line.intercept) == pytest.approx((0, 5)), name
    assert deming(x, np.array([4.9, 5.1, 5.1, 4.9])).slope == pytest.approx(0)


def test_points_that_neither_rise_nor_fall_determine_no_line() -> None:
    """Half the slopes of these four are below -1, so the median shifted by their number is past the last slope."""
    x, y = np.array([5.0, 6.0, 7.0, 8.0]), np.array([6.0, 1.0, 7.0, 2.0])
    for scale in (1.0, 2.0, 1e-6):
        with pytest.raises(UndefinedError, match="neither rise nor fall"):
            passing_bablok(scale * x, scale * y)


def test_what_determines_no_line_is_refused() -> None:
    same, one = np.full(5, 7.0), np.arange(1.0, 6.0)
    for name, fit in FITS.items():
        with pytest.raises(UndefinedError):
            fit(same, same)
        with pytest.raises(UndefinedError):
            fit(one[:1], one[:1])
        if name != "least squares":
            with pytest.raises(UndefinedError, match=r"vertical|every direction"):
                fit(same, one)
    with pytest.raises(UndefinedError, match="equal"):
        least_squares(same, one)
    with pytest.raises(ValueError, match="error_ratio"):
        deming(one, one, error_ratio=0)


def test_demings_slope_does_not_cancel() -> None:
    """u so much above q that the textbook form loses all digits of p."""
    assert deming_slope(1e12, 1e-2, 1e3, 1.0) == pytest.approx(1e-9, rel=1e-12)
    assert deming_slopes(*np.array([[1e12], [1e-2], [1e3]]), error_ratio=1.0)[0] == pytest.approx(1e-9, rel=1e-12)


@pytest.mark.parametrize("error_ratio", [0.25, 1.0, 4.0])
def test_one_deming_slope_is_that_of_several(error_ratio: float) -> None:
    """One is computed in floats, for speed."""
    u, q, share = np.random.default_rng(5).uniform(0.1, 10.0, (3, 200))
    p = np.sqrt(u * q) * (share / 5.0 - 1.0)
    together = deming_slopes(u, q, p, error_ratio=error_ratio)
    alone = [deming_slope(*one, error_ratio) for one in zip(u.tolist(), q.tolist(), p.tolist(), strict=True)]
    np.testing.assert_allclose(together, alone, rtol=1e-12)
    assert np.isnan(deming_slopes(np.ones(1), np.full(1, 2.0), np.zeros(1), error_ratio=error_ratio * 2)).all()
    with pytest.raises(UndefinedError, match="vertical"):
        deming_slope(1.0, 2.0, 0.0, error_ratio * 2)


def test_few_masses_leave_passing_and_babloks_ends_open() -> None:
    x, y = cloud(12, 4)
    line = passing_bablok(x, y)
    assert line.stated == ((-math.inf, math.inf),) * 2
