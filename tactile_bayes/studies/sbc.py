"""Simulation-based calibration of the posterior."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache

import numpy as np
from scipy.stats import binom, chisquare, poisson

from tactile_bayes.declarations import Record, as_dict
from tactile_bayes.errors import NotConvergedError
from tactile_bayes.geometry import FloatArray
from tactile_bayes.mapping.map import MapRecipe, TactileMap
from tactile_bayes.options import BumpPrior, FieldCosines
from tactile_bayes.posterior.draw import MapPosterior, SamplerSettings
from tactile_bayes.posterior.estimate import estimate_map
from tactile_bayes.posterior.white import WIDEST_IN_RADII
from tactile_bayes.posterior.window import LENGTHS_MM, SHARES, cell_mean_profile
from tactile_bayes.presets import Method
from tactile_bayes.size.bodies import BodyCalibration
from tactile_bayes.size.draws import BumpDraws, ShapeDraws, ShapePrior
from tactile_bayes.size.pooling import SizePriors, pooled_size

# --- Tests of uniform ranks, for simulation-based calibration.
#
# References
# ----------
# Talts, Betancourt, Simpson, Vehtari & Gelman (2018), arXiv:1804.06788; Saeilynoja, Buerkner & Vehtari (2022),
# Statistics and Computing 32:32 (simultaneous bands of the ECDF).

PROBABILITIES = (0.5, 0.9)
BAND = 0.95
BAND_SIMULATIONS = 4000
LEAST_IN_BIN = 5
IntArray = np.ndarray[tuple[int, ...], np.dtype[np.int64]]


class RankCoverage(Record):
    """Share of truths that a central interval of the nominal probability covered, with its binomial standard error."""

    probability: float
    covered: float
    error: float


class RankTest(Record):
    """Results of the tests on one parameter's ranks."""

    name: str  #: Name of the parameter.
    n: int  #: Number of ranks.
    chi2_p: float  #: P value of equal numbers in bins of ranks.
    ecdf_p: float  #: Share of uniform samples whose ECDF departs at least as far, anywhere.
    mean_rank: float
    spread: float
    """`mean_rank`, `spread`: Mean of (rank + 1/2) / (draws + 1), 0.5 when calibrated; and its SD over that of uniform
    ranks: above 1 the posterior is too narrow, below 1 too wide."""
    coverage: tuple[RankCoverage, ...]  #: Coverage of central intervals.

    @property
    def inside(self) -> bool:
        """True when the ECDF stays inside its simultaneous band."""
        return self.ecdf_p > 1.0 - BAND


def rank_test(name: str, ranks: IntArray, *, draws: int) -> RankTest:
    """Run all tests on one parameter's (n,) ranks from 0 to `draws`."""
    tails = uniform_least_tails(len(ranks), draws)
    # equally likely tails of discrete counts differ by rounding
    as_far = float(np.mean(tails <= least_tail(ecdf_counts(ranks[None], draws), len(ranks))[0] * (1.0 + 1e-9)))
    share = (ranks + 0.5) / (draws + 1)
    uniform_sd = np.sqrt((1.0 - 1.0 / (draws + 1) ** 2) / 12.0)
    return RankTest(
        name=name,
        n=len(ranks),
        chi2_p=chi2_p(ranks, draws),
        ecdf_p=as_far,
        mean_rank=float(share.mean()),
        spread=float(np.sqrt(np.mean((share - 0.5) ** 2)) / uniform_sd),
        coverage=tuple(coverage(ranks, draws, probability) for probability in PROBABILITIES),
    )


def chi2_p(ranks: IntArray, draws: int) -> float:
    """P value of the counts in equal bins of ranks: at most 20 bins, each with `LEAST_IN_BIN` or more expected."""
    bins = [b for b in range(2, 21) if (draws + 1) % b == 0 and len(ranks) >= LEAST_IN_BIN * b]
    if not bins:
        return 1.0
    return float(chisquare(np.bincount(ranks * bins[-1] // (draws + 1), minlength=bins[-1])).pvalue)


def coverage(ranks: IntArray, draws: int, probability: float) -> RankCoverage:
    """Coverage by the central interval between two draws with exactly the nominal share of ranks, see `DRAWS`."""
    tail = round((1.0 - probability) / 2.0 * (draws + 1))
    covered = (ranks >= tail) & (ranks <= draws - tail)
    error = float(np.sqrt(probability * (1.0 - probability) / len(ranks)))
    return RankCoverage(probability, float(covered.mean()), error)


def ecdf_counts(ranks: IntArray, draws: int) -> IntArray:
    """(m, draws) number of (m, n) ranks below 1, 2 ... `draws`."""
    below = ranks[..., None] < np.arange(1, draws + 1)
    return np.asarray(below.sum(axis=-2))


def least_tail(counts: IntArray, n: int) -> FloatArray:
    """(m,) smallest two-sided binomial tail of (m, draws) counts of n ranks: small where an ECDF departs somewhere."""
    uniform = np.arange(1, counts.shape[-1] + 1) / (counts.shape[-1] + 1)
    number = np.arange(n + 1)[:, None]
    tails = 2.0 * np.minimum(binom.cdf(number, n, uniform), binom.sf(number - 1, n, uniform))
    return np.asarray(np.min(tails[counts, np.arange(len(uniform))], axis=-1))


@cache
def uniform_least_tails(n: int, draws: int) -> FloatArray:
    """(BAND_SIMULATIONS,) `least_tail` of n simulated uniform ranks, with a seed of their own."""
    rng = np.random.default_rng([n, draws])
    number = rng.multinomial(n, np.full(draws + 1, 1.0 / (draws + 1)), size=BAND_SIMULATIONS)
    return least_tail(np.cumsum(number, axis=1)[:, :-1], n)


def ecdf_band(n: int, draws: int) -> tuple[FloatArray, FloatArray]:
    """(draws,) simultaneous band: lowest and highest share of n uniform ranks below 1, 2 ...

    Each point's binomial limits are as wide as makes the whole path stay inside with probability `BAND`.
    """
    level = float(np.quantile(uniform_least_tails(n, draws), 1.0 - BAND))
    uniform = np.arange(1, draws + 1) / (draws + 1)
    return np.asarray(binom.ppf(level / 2.0, n, uniform) / n), np.asarray(binom.isf(level / 2.0, n, uniform) / n)


# --- Simulation-based calibration of a map's posterior: ranks of true values drawn from its own prior.
#
# Where a parameter is drawn from the prior, a map from the model, and draws from the posterior of that map, the
# rank of the parameter among the draws is uniform: any departure is a fault of the posterior. The priors here are
# those that `estimate_map` uses under a noise field (`Scene.log_prior`, `CollapsedTarget`, `correlated.noise`),
# with these choices where they are improper or depend on the map:
#
# - amplitude: its normal prior restricted to rises, for an estimate needs one; ranks are conditional on that.
# - noise scale (improper): an independent SD of a cell log-uniform on `NOISE_SD`; level (improper): 1; tilt (improper):
#   normal of `BumpPrior.tilt_sd`. For such parameters of location and scale ranks are uniform at every value.
# - centre (uniform in a window that follows the map): uniform within `CENTRE_MM` of the map's middle;
# - field: the exponential correlation itself. The posterior writes it in cosines on a rectangle that follows its
#   window: what that approximation costs is part of what the ranks judge. (Cosines mirror a field at their rectangle's
#   edge. Maps made of them had folds where they reached beyond, which other windows took for lumps.)
#
# Maps without an estimate have no ranks: ranks are conditional on detection. Whether a map has one depends on the map
# alone, so that exact ranks stay uniform. Under a field much stronger than the bump the estimate may measure another
# rise. It then has a probability that there is a lump, and all draws lie at that rise: such maps have no ranks either,
# but their number is compared with the one that the probabilities predict.
#
# The size is that of a round lump: the true one is a draw of the size calibration's own law at the true amplitude
# and widths.

HALF_MM = 25.0
CELL_MM = 1.0
RADIUS_MM = 20.0
CENTRE_MM = 5.0
NOISE_SD = (0.005, 0.1)
COUNTS = (20, 80)
DRAWS = 99  #: Draws among which a truth is ranked: 100 ranks, divisible into the bins and the intervals below.
PARAMETERS = ("amplitude", "sigma_x_mm", "sigma_y_mm", "x_mm", "y_mm")
"""Ranks of an amplitude or a width are those of its logarithm."""
SIZE = "size_mm"
RANKED = (*PARAMETERS, SIZE)
ELSEWHERE = "elsewhere"
MANY_ELSEWHERE = 1e-3
"""More maps measured at another rise than all but this share of chances allow: the draws are too sure of the place."""
ROUND = SizePriors(shape=ShapePrior(oval_sd=1e-9))


class Truth(Record):
    """True parameters of one simulated map."""

    amplitude: float
    sigma_x_mm: float
    sigma_y_mm: float
    x_mm: float
    y_mm: float  #: `amplitude`, `sigma_x_mm`, `sigma_y_mm`, `x_mm`, `y_mm`: Of the bump.
    length_mm: float
    share: float
    """`length_mm`, `share`: Of the noise field: correlation length, and its variance over the mean independent variance
    of a cell."""
    noise_sd: float  #: Root of that variance.


class MapRanks(Record):
    """Ranks of one simulated map's true parameters in its posterior."""

    index: int  #: The map's number.
    truth: Truth  #: True values.
    ranks: tuple[int, ...] | None
    """Of `RANKED`: how many of `DRAWS` draws lie below the truth; None without an estimate of this bump."""
    outcome: str
    """The method that gave the draws, the code of the abstention, or `ELSEWHERE` when another rise was measured."""
    probability: float | None = None
    """Probability that the measured rise is a lump, by the estimate; None without an estimate."""


def settings(method: str, seed: int, *, size: str = "", cosines: FieldCosines = "auto") -> dict[str, object]:
    """All settings that a map's ranks depend on besides its number."""
    return {
        "method": method,
        "seed": seed,
        "draws": DRAWS,
        "size_calibration": size,
        "noise_sd": list(NOISE_SD),
        "counts": list(COUNTS),
        "lengths_mm": list(LENGTHS_MM),
        "shares": list(SHARES),
        "field": "exponential",
        "field_cosines": cosines,
        **as_dict(BumpPrior()),
    }


def ranks_of_map(
    index: int, *, method: Method, seed: int, calibration: BodyCalibration | None = None, cosines: FieldCosines = "auto"
) -> MapRanks:
    """Draw a map from the prior, estimate it and rank its truth; the size only with a calibration.

    `seed` and `index` fix all random numbers.
    """
    rng = np.random.default_rng([seed, index])
    prior = BumpPrior()
    truth = draw_truth(rng, prior)
    options = SamplerSettings(
        method=method,
        background="free",
        fit_radius_mm=RADIUS_MM,
        rotation="off",
        noise="field",
        field_cosines=cosines,
        **as_dict(prior),
    )
    try:
        estimate = estimate_map(draw_map(truth, rng, prior), calibration=None, options=options, rng=rng)
    except NotConvergedError:  # of the ensemble, which no method follows
        return MapRanks(index, truth, None, "method")
    if estimate.map_posterior is None or estimate.draws is None or estimate.detection is None:
        return MapRanks(index, truth, None, estimate.code or "none")
    probability = estimate.detection.probability
    if measured_other_rise(estimate.map_posterior, truth):
        return MapRanks(index, truth, None, ELSEWHERE, probability)
    ranks = _ranks_in(estimate.map_posterior, truth, rng, calibration)
    return MapRanks(index, truth, ranks, estimate.draws.method, probability)


def measured_other_rise(posterior: MapPosterior, truth: Truth) -> bool:
    """True when the estimate measured another rise: its centre is further from the true one than both widths."""
    away = np.hypot(np.median(posterior.x_mm) - truth.x_mm, np.median(posterior.y_mm) - truth.y_mm)
    widths = truth.sigma_x_mm, truth.sigma_y_mm, np.median(posterior.sigma_x_mm), np.median(posterior.sigma_y_mm)
    return bool(away > max(widths))


class OtherRises(Record):
    """Maps whose estimate measured another rise than the true lump."""

    number: int  #: Number of such maps.
    announced: float  #: Expected number, by the probabilities of all estimates.
    chance: float  #: Probability of this number or more, if the estimates' probabilities are right.

    @property
    def too_many(self) -> bool:
        """True when there are more such maps than the estimates' own probabilities allow."""
        return self.chance < MANY_ELSEWHERE


def count_other_rises(maps: list[MapRanks]) -> OtherRises:
    """Compare the number of maps measured elsewhere with what their estimates predicted, by a Poisson probability."""
    number = sum(one.outcome == ELSEWHERE for one in maps)
    announced = sum(1.0 - one.probability for one in maps if one.probability is not None)
    return OtherRises(number, announced, float(poisson.sf(number - 1, announced)) if number else 1.0)


def _ranks_in(
    posterior: MapPosterior, truth: Truth, rng: np.random.Generator, calibration: BodyCalibration | None
) -> tuple[int, ...]:
    """Ranks of a truth in a subset of the joint draws, the same subset for every parameter."""
    number = posterior.x_mm.size
    chosen = rng.choice(number, size=DRAWS, replace=number < DRAWS)
    drawn = {name: getattr(posterior, name).ravel()[chosen] for name in PARAMETERS}
    true = {name: np.full(DRAWS, getattr(truth, name)) for name in PARAMETERS}
    ranks = tuple(int(np.sum(drawn[name] < true[name])) for name in PARAMETERS)
    if calibration is None:
        return ranks
    # sizes of all draws are stratified; a random subset of them is as good as independent
    sizes = _sizes({name: getattr(posterior, name).ravel() for name in PARAMETERS}, calibration, rng)[chosen]
    return (*ranks, int(np.sum(sizes < _sizes(true, calibration, rng)[0])))


def _sizes(bumps: Mapping[str, FloatArray], calibration: BodyCalibration, rng: np.random.Generator) -> FloatArray:
    """(n,) sizes in mm, one per bump; 0 for a bump without a rise."""
    a, sigma_x, sigma_y = (bumps[name] for name in PARAMETERS[:3])
    draws = ShapeDraws.of(BumpDraws(a, sigma_x, sigma_y, np.zeros_like(a)))
    return np.nan_to_num(pooled_size([draws], calibration=calibration, priors=ROUND, rng=rng).max_size_mm.ravel())


def draw_truth(rng: np.random.Generator, prior: BumpPrior) -> Truth:
    """Draw bump and noise field from the field posterior's prior, with the choices above for its improper parts."""
    widest, p, q = np.log(WIDEST_IN_RADII * RADIUS_MM), np.inf, 0.0
    while p + abs(q) > widest:
        p = np.log(prior.width_median_mm) + prior.log_width_sd * rng.standard_normal()
        q = prior.log_ratio_sd * rng.standard_normal()
    away, direction = CENTRE_MM * np.sqrt(rng.uniform()), rng.uniform(0.0, 2.0 * np.pi)
    return Truth(
        amplitude=float(abs(prior.amplitude_sd * rng.standard_normal())),
        sigma_x_mm=float(np.exp(p + q)),
        sigma_y_mm=float(np.exp(p - q)),
        x_mm=float(away * np.cos(direction)),
        y_mm=float(away * np.sin(direction)),
        length_mm=float(rng.choice(LENGTHS_MM)),
        share=float(rng.choice(SHARES)),
        noise_sd=float(np.exp(rng.uniform(*np.log(NOISE_SD)))),
    )


def draw_map(truth: Truth, rng: np.random.Generator, prior: BumpPrior) -> TactileMap:
    """Draw a map of the bump on a sloping level about 1, with independent errors by count and the noise field."""
    axis = np.arange(-HALF_MM, HALF_MM + 0.5 * CELL_MM, CELL_MM)
    count = rng.integers(COUNTS[0], COUNTS[1], size=(len(axis), len(axis)), endpoint=True)
    reading_variance = truth.noise_sd**2 / float(np.mean(1.0 / count))
    slope = prior.tilt_sd * rng.standard_normal(2) / RADIUS_MM
    level = 1.0 + slope[0] * axis + slope[1] * axis[:, None]
    errors = np.sqrt(reading_variance / count) * rng.standard_normal(count.shape)
    field = np.sqrt(truth.share) * truth.noise_sd * draw_field(axis, rng, length_mm=truth.length_mm)
    centre, width = np.array([truth.x_mm, truth.y_mm]), np.array([truth.sigma_x_mm, truth.sigma_y_mm])
    columns, rows = cell_mean_profile(axis - centre[:, None], sigma_mm=width, cell_mm=CELL_MM)
    return TactileMap(
        mean=level + truth.amplitude * (rows[:, None] * columns) + errors + field,
        variance=np.full(count.shape, reading_variance),
        count=count.astype(np.int64),
        x_mm=axis,
        y_mm=axis,
        recipe=MapRecipe("grid", "mean", CELL_MM),
        background=1.0,
    )


def draw_field(axis: FloatArray, rng: np.random.Generator, *, length_mm: float) -> FloatArray:
    """Draw an (n, n) field of variance 1 and exponential correlation, cut from a torus too wide to wrap around."""
    cell_mm = float(axis[1] - axis[0])
    size = len(axis) + int(10 * length_mm / cell_mm)
    lag = np.fft.fftfreq(size, 1 / size) * cell_mm
    power = np.clip(np.fft.fft2(np.exp(-np.hypot(lag[:, None], lag) / length_mm)).real, 0.0, None)
    white = rng.standard_normal(power.shape)
    return np.asarray(np.fft.ifft2(np.fft.fft2(white) * np.sqrt(power)).real[: len(axis), : len(axis)])


def rank_tests(maps: list[MapRanks]) -> list[RankTest]:
    """Test each parameter's ranks; empty where no map has ranks."""
    ranks = np.array([one.ranks for one in maps if one.ranks is not None])
    if not len(ranks):
        return []
    return [rank_test(name, column, draws=DRAWS) for name, column in zip(RANKED, ranks.T, strict=False)]
