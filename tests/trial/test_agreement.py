"""Agreement and repeatability against printed answers and independent derivations."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import integrate, optimize, stats

from tactile_bayes.trial.figures import JACKKNIFE, UndefinedError
from tactile_bayes.trial.lines import concordance, least_squares
from tactile_bayes.trial.method_comparison import content_factor, limits, limits_unlinked, percentile_factor, trend
from tactile_bayes.trial.readings import ModalitySizes, Reading
from tactile_bayes.trial.replicates import components, icc, log_sd_within, reader_components
from tactile_bayes.trial.replicates import replicate_figures as figures

# Bland & Altman (1986), Lancet i, 307, table 1: peak expiratory flow in l/min, first readings of both meters.
WRIGHT = np.array([494, 395, 516, 434, 476, 557, 413, 442, 650, 433, 417, 656, 267, 478, 178, 423, 427], dtype=float)
MINI = np.array([512, 430, 520, 428, 500, 600, 364, 380, 658, 445, 432, 626, 260, 477, 259, 350, 451], dtype=float)

# Shrout & Fleiss (1979), Psychol. Bull. 86, 420, table 2: six targets, four judges.
RATINGS = np.array([[9, 2, 5, 8], [6, 1, 3, 2], [8, 4, 6, 8], [7, 1, 2, 6], [10, 5, 6, 9], [6, 2, 4, 7]], dtype=float)

# Davies (1947), Statistical Methods in Research and Production: yield of dyestuff, six batches of five samples.
DAVIES = """
1545 1440 1440 1520 1580 1540 1555 1490 1560 1495 1595 1550 1605 1510 1560 1445 1440 1595 1465 1545 1595 1630
1515 1635 1625 1520 1455 1450 1480 1445"""
DYESTUFF = np.array(DAVIES.split(), dtype=float)


def test_bias_and_spread_of_peak_flow() -> None:
    found = limits(WRIGHT - MINI)
    assert found.bias == pytest.approx(-2.117647, abs=5e-7)
    assert found.sd == pytest.approx(38.765130, abs=5e-7)
    assert found.bias_interval == pytest.approx((-22.0, 17.8), abs=0.06)  # printed in the paper
    assert (found.low, found.high) == pytest.approx((-2.117647 - 1.959964 * 38.76513, -2.117647 + 1.959964 * 38.76513))


@pytest.mark.parametrize("n", [2, 3, 10, 17, 25, 300])
@pytest.mark.parametrize("confidence", [0.025, 0.5, 0.975])
def test_single_limits_are_quantiles_of_the_noncentral_t(n: int, confidence: float) -> None:
    expected = stats.nct.ppf(confidence, n - 1, stats.norm.ppf(0.975) * math.sqrt(n)) / math.sqrt(n)
    assert percentile_factor(n, percentile=0.975, confidence=confidence) == pytest.approx(expected, rel=1e-8)


@pytest.mark.long_repeats
@pytest.mark.parametrize(("n", "confidence"), [(4, 0.95), (10, 0.975), (17, 0.025), (60, 0.95)])
def test_paired_limits_by_integrating_over_mean_and_deviation(n: int, confidence: float) -> None:
    """The probability that mean +- k SD holds 95 % of the population, the plain double integral."""
    k = content_factor(n, content=0.95, confidence=confidence)

    def holds(mean: float) -> float:
        radius = optimize.brentq(lambda r: stats.norm.cdf(mean + r) - stats.norm.cdf(mean - r) - 0.95, 0, 40)
        return stats.chi2.sf((n - 1) * (radius / k) ** 2, n - 1) * stats.norm.pdf(mean, scale=1 / math.sqrt(n))

    reached = 2 * integrate.quad(holds, 0, 9 / math.sqrt(n), epsabs=1e-11, epsrel=1e-11)[0]
    assert reached == pytest.approx(confidence, abs=1e-8)


def test_tolerance_factors_as_tables_print_them() -> None:
    """Odeh & Owen (1980), 95 % of the population with 95 % confidence, n = 10."""
    assert percentile_factor(10, percentile=0.95, confidence=0.95) == pytest.approx(2.911, abs=5e-4)
    assert content_factor(10, content=0.95, confidence=0.95) == pytest.approx(3.393, abs=5e-4)


def test_exact_limits_cover_in_trials() -> None:
    rng = np.random.default_rng(1)
    single = pair = 0
    for _ in range(400):
        found = limits(rng.normal(0, 1, 12))
        single += found.high_interval[0] <= stats.norm.ppf(0.975) <= found.high_interval[1]
        outer = found.pair_intervals[1][1] - found.bias
        pair += stats.norm.cdf(found.bias + outer) - stats.norm.cdf(found.bias - outer) >= 0.95
    assert stats.binomtest(int(single), 400, 0.95).pvalue > 1e-3
    assert stats.binomtest(int(pair), 400, 0.975).pvalue > 1e-3


def unlinked(rng: np.random.Generator, masses: int) -> tuple[list[np.ndarray], list[np.ndarray]]:
    truth, own = rng.normal(20, 5, masses), rng.normal(1, 2, masses)
    x = [t + rng.normal(0, 1, rng.integers(1, 4)) for t in truth]
    y = [t + o + rng.normal(0, 1.5, rng.integers(3, 6)) for t, o in zip(truth, own, strict=True)]
    return x, y


def test_replicates_restore_the_spread_of_single_readings() -> None:
    """Simulated with variances 4 (mass by method), 1 and 2.25 (readings): a single difference has SD 2.693."""
    x, y = unlinked(np.random.default_rng(2), 4000)
    found = limits_unlinked(x, y)
    assert found.sd == pytest.approx(math.sqrt(4 + 1 + 2.25), rel=0.02)
    assert found.bias == pytest.approx(1, abs=0.1)
    assert sum(found.components.values()) == pytest.approx(found.sd**2)


def test_replicate_limits_by_hand() -> None:
    """Two masses: means of differences 1 and 4 (variance 4.5); within y (4 + 0)/2 with 2 each, x single."""
    x = [np.array([10.0]), np.array([20.0])]
    y = [np.array([9.0, 13.0]), np.array([24.0, 24.0])]
    found = limits_unlinked(x, y)
    assert found.components == pytest.approx({"means": 4.5, "reference_within": 0, "within": 0.5 * 4})
    assert found.sd == pytest.approx(math.sqrt(6.5))


def test_one_reading_each_is_the_plain_analysis() -> None:
    x, y = [np.array([v]) for v in WRIGHT], [np.array([v]) for v in MINI]
    plain = limits(MINI - WRIGHT)
    found = limits_unlinked(x, y)
    assert (found.bias, found.sd, found.low, found.high) == pytest.approx((plain.bias, plain.sd, plain.low, plain.high))
    assert found.bias_interval == pytest.approx(plain.bias_interval)


@pytest.mark.slow
def test_replicate_limits_cover_in_trials() -> None:
    rng = np.random.default_rng(3)
    truth = 1 + 1.959964 * math.sqrt(4 + 1 + 2.25)
    hits = 0
    for _ in range(2000):
        found = limits_unlinked(*unlinked(rng, 25))
        hits += found.high_interval[0] <= truth <= found.high_interval[1]
    assert 0.925 < hits / 2000 < 0.975


def test_trend_of_differences_is_their_regression() -> None:
    mean = (WRIGHT + MINI) / 2
    found, expected = trend(WRIGHT - MINI, mean), stats.linregress(mean, WRIGHT - MINI)
    assert (found.slope, found.p_value) == pytest.approx((expected.slope, expected.pvalue))
    assert found.interval == pytest.approx(least_squares(mean, WRIGHT - MINI).intervals(confidence=0.95)[1])
    assert trend(np.zeros(4), np.arange(4.0)).p_value == 1.0


def test_concordance_by_its_definition() -> None:
    """1 - expected squared distance from identity over what it would be without correlation (Lin 1989, eq. 1)."""
    found = concordance(WRIGHT, MINI)
    independent = np.var(WRIGHT) + np.var(MINI) + (WRIGHT.mean() - MINI.mean()) ** 2
    assert found.coefficient == pytest.approx(1 - np.mean((WRIGHT - MINI) ** 2) / independent)
    assert found.coefficient == pytest.approx(found.pearson_r * found.bias_correction)
    assert found.pearson_r == pytest.approx(np.corrcoef(WRIGHT, MINI)[0, 1])


def test_lins_interval_is_the_delta_method_for_normal_pairs() -> None:
    x, y = WRIGHT, 1.2 * MINI + 30
    n = len(x)

    def fisher(theta: np.ndarray) -> float:
        mx, my, sxx, syy, sxy = theta
        return math.atanh(2 * sxy / (sxx + syy + (mx - my) ** 2))

    c = np.cov(x, y, bias=True)
    theta = np.array([x.mean(), y.mean(), c[0, 0], c[1, 1], c[0, 1]])
    cross = [[c[i, k] * c[j, m] + c[i, m] * c[j, k]
              for k, m in ((0, 0), (1, 1), (0, 1))] for i, j in ((0, 0), (1, 1), (0, 1))]  # fmt: skip
    covariance = np.zeros((5, 5))
    covariance[:2, :2], covariance[2:, 2:] = c, cross
    gradient = optimize.approx_fprime(theta, fisher, 1e-5 * np.abs(theta))
    reach = stats.norm.ppf(0.975) * math.sqrt(gradient @ covariance @ gradient / (n - 2))
    expected = math.tanh(fisher(theta) - reach), math.tanh(fisher(theta) + reach)
    assert concordance(x, y).interval == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("scale", [1e-6, 1e12])
def test_scaling_changes_no_concordance_and_scales_the_limits(scale: float) -> None:
    plain, scaled = concordance(WRIGHT, MINI), concordance(scale * WRIGHT, scale * MINI)
    assert scaled.coefficient == pytest.approx(plain.coefficient)
    assert scaled.interval == pytest.approx(plain.interval)
    assert limits(scale * (WRIGHT - MINI)).high_interval == pytest.approx(
        tuple(scale * end for end in limits(WRIGHT - MINI).high_interval)
    )


def test_extremes_of_agreement_have_defined_answers() -> None:
    with pytest.raises(UndefinedError, match="at least 2"):
        limits(np.array([1.0]))
    with pytest.raises(UndefinedError, match="vary"):
        concordance(np.full(5, 3.0), np.arange(5.0))
    upside_down = concordance(np.arange(5.0), np.arange(5.0)[::-1])
    assert upside_down.coefficient == pytest.approx(-1)
    assert upside_down.interval is None
    same = limits(np.full(5, 2.0))
    assert (same.sd, same.low, same.high_interval) == (0, 2, (2, 2))
    uncorrelated = concordance(np.array([1.0, 1, 2, 2]), np.array([1.0, 2, 1, 2]))
    assert (uncorrelated.coefficient, uncorrelated.interval) == (0, None)


def masses(groups: list[np.ndarray]) -> ModalitySizes:
    sizes = [np.asarray(group, dtype=float) for group in groups]
    mean = np.array([group.mean() for group in sizes])
    return ModalitySizes("tactile", np.arange(len(groups)), np.full(len(groups), 10.0), mean, tuple(sizes))


def test_icc_as_shrout_and_fleiss_print_it() -> None:
    """ICC(1,1) = .17; the figure works on logarithms, so the ratings are handed in as exponents."""
    assert icc(masses(list(np.exp(RATINGS)))) == pytest.approx(0.17, abs=0.005)


def test_repeatability_is_as_wide_up_as_down_in_ratio() -> None:
    found = figures(masses(list(np.exp(RATINGS / 10))), intervals=JACKKNIFE)
    down, up = found["repeatability_low_percent"].value, found["repeatability_high_percent"].value
    assert (1 + down / 100) * (1 + up / 100) == pytest.approx(1)
    pooled = math.sqrt(np.mean(np.var(RATINGS / 10, axis=1, ddof=1)))
    assert found["within_mass_log_sd"].value == pytest.approx(pooled)
    assert up == pytest.approx(100 * math.expm1(1.959964 * math.sqrt(2) * pooled), rel=1e-6)


def test_variances_of_the_dyestuff_batches() -> None:
    """Davies (1947), table 6.1; for equal groups REML is the analysis of variance: 1764.05 and 2451.25."""
    found = components(DYESTUFF, np.repeat(np.arange(6), 5), np.zeros(30, dtype=np.int64))
    assert found.mass == pytest.approx(1764.05, rel=1e-5)
    assert found.map == pytest.approx(2451.25, rel=1e-5)
    assert found.reader is None


def test_variances_of_targets_and_judges() -> None:
    """Mean squares printed by Shrout & Fleiss: targets 11.24, judges 32.49, residual 1.02."""
    found = components(RATINGS.ravel(), np.repeat(np.arange(6), 4), np.tile(np.arange(4), 6))
    assert found.mass == pytest.approx((11.24 - 1.02) / 4, abs=0.01)
    assert found.reader == pytest.approx((32.49 - 1.02) / 6, abs=0.01)
    assert found.map == pytest.approx(1.02, abs=0.005)


def test_unbalanced_variances_maximise_the_dense_restricted_likelihood() -> None:
    rng = np.random.default_rng(4)
    mass, reader = rng.integers(0, 12, 50), rng.integers(0, 3, 50)
    mass[:12], reader[:3] = np.arange(12), np.arange(3)
    y = rng.normal(0, 1, 12)[mass] + rng.normal(0, 0.6, 3)[reader] + rng.normal(0, 0.5, 50)

    def minus_log_likelihood(log_sd: np.ndarray) -> float:
        a, b, e = np.exp(2 * log_sd)
        v = a * (mass[:, None] == mass) + b * (reader[:, None] == reader) + e * np.eye(50)
        inverse, one = np.linalg.inv(v), np.ones(50)
        mean = one @ inverse @ y / (one @ inverse @ one)
        off = y - mean
        return np.linalg.slogdet(v)[1] + math.log(one @ inverse @ one) + off @ inverse @ off

    best = optimize.minimize(minus_log_likelihood, [0, -0.5, -0.7], method="Nelder-Mead",
                             options={"xatol": 1e-9, "fatol": 1e-12, "maxiter": 4000})  # fmt: skip
    found = components(y, mass, reader)
    assert (found.mass, found.reader, found.map) == pytest.approx(tuple(np.exp(2 * best.x)), rel=1e-5)


def test_a_variance_of_zero_is_reached() -> None:
    """Equal batch means: the between variance would be negative, its REML estimate is 0."""
    found = components(np.tile([1.0, 2.0, 4.0], 5), np.repeat(np.arange(5), 3), np.zeros(15, dtype=np.int64))
    assert found.mass == pytest.approx(0, abs=1e-9)
    assert found.map == pytest.approx(np.var(np.tile([1.0, 2.0, 4.0], 5), ddof=1))


def test_readers_are_left_out_of_what_has_none() -> None:
    def read(readers: list[str | None]) -> list[Reading]:
        sizes = [("a", 3.0), ("a", 3.5), ("b", 7.0), ("b", 10.0), ("c", 4.5), ("c", 4.0)]
        return [
            Reading(("p", mass), "tactile", 1, "detected", size, reader=reader)
            for (mass, size), reader in zip(sizes, readers, strict=True)
        ]

    alone, two = reader_components(read([None] * 6)), reader_components(read(["A", "B"] * 3))
    assert alone is not None
    assert alone.reader is None
    assert two is not None
    assert two.readers == 2
    assert reader_components(read([None] * 6)[::2]) is None  # one replicate each


def test_one_replicate_leaves_repeatability_undefined() -> None:
    found = figures(masses([[10.0], [12.0]]), intervals=JACKKNIFE)
    assert all(one.value is None and "two detected replicates" in one.reason for one in found.values())
    same = figures(masses([[10.0, 10.0], [12.0, 12.0]]), intervals=JACKKNIFE)
    assert same["within_mass_log_sd"].value == 0
    assert same["icc"].value == pytest.approx(1)
    with pytest.raises(UndefinedError):
        icc(masses([[10.0, 10.0]]))
    assert log_sd_within(masses([[10.0, 10.0]])) == 0
