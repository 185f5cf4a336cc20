r"""Simulation-based calibration of the posterior of a map: truths from its own prior, and where they rank.

Where a parameter is drawn from the prior, a map from the model, and draws from the posterior of that map, the rank of
the parameter among the draws is uniform: any departure is a fault of the posterior. The priors here are those that
`estimate_map` uses under a noise field (`Scene.log_prior`, `CollapsedTarget`, `field`), with these choices where they
are improper or depend on the map:

- amplitude: its normal prior restricted to rises, for an estimate needs one; ranks are conditional on that.
- noise scale (improper): an independent SD of a cell log-uniform on `NOISE_SD`; level (improper): 1; tilt (improper):
  normal of `BumpPrior.tilt_sd`. For such parameters of location and scale ranks are uniform at every value.
- centre (uniform in a window that follows the map): uniform within `CENTRE_MM` of the map's middle.

Maps that give no estimate have no ranks: ranks are conditional on detection. Whether a map gives one depends on the
map alone, so that exact ranks stay uniform.

References
----------
Talts, Betancourt, Simpson, Vehtari & Gelman (2018), arXiv:1804.06788; Saeilynoja, Buerkner & Vehtari (2022), Statistics
and Computing 32:32 (simultaneous bands of the ECDF).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tactile_bayes.geometry import FloatArray
from tactile_bayes.mapping.tactile_map import MapRecipe, TactileMap
from tactile_bayes.posterior.bump import BumpPrior
from tactile_bayes.posterior.estimate import EstimateOptions, MapPosterior, estimate_map
from tactile_bayes.posterior.field import COSINES, LENGTHS_MM, MARGIN, SHARES, spectrum
from tactile_bayes.posterior.fit import WIDEST_IN_RADII, FitOptions
from tactile_bayes.posterior.window import cell_mean_profile

HALF_MM = 25.0
CELL_MM = 1.0
RADIUS_MM = 20.0
CENTRE_MM = 5.0
NOISE_SD = (0.005, 0.1)
COUNTS = (20, 80)
DRAWS = 99
"""Draws among which a truth is ranked: 100 ranks, divisible into the bins and the intervals below."""
PARAMETERS = ("amplitude", "sigma_x_mm", "sigma_y_mm", "x_mm", "y_mm")
"""Ranks of an amplitude or a width are those of its logarithm."""
PROBABILITIES = (0.5, 0.9)
BAND = 0.95
BAND_SIMULATIONS = 4000
LEAST_IN_BIN = 5
IntArray = np.ndarray[tuple[int, ...], np.dtype[np.int64]]


@dataclass(frozen=True, slots=True)
class Truth:
    """What one simulated map was made from.

    Parameters
    ----------
    amplitude, sigma_x_mm, sigma_y_mm, x_mm, y_mm
        Of the bump.
    length_mm, share
        Of the noise field: correlation length, and its variance over the mean independent variance of a cell.
    noise_sd
        Root of that variance.
    """

    amplitude: float
    sigma_x_mm: float
    sigma_y_mm: float
    x_mm: float
    y_mm: float
    length_mm: float
    share: float
    noise_sd: float


@dataclass(frozen=True, slots=True)
class MapRanks:
    """One simulated map, and where its truth lies in the posterior.

    Parameters
    ----------
    index
        The map's number.
    truth
        What was put in.
    ranks
        Of `PARAMETERS`: how many of `DRAWS` draws lie below the truth; None without an estimate.
    outcome
        The method that gave the draws, or the code of the abstention.
    """

    index: int
    truth: Truth
    ranks: tuple[int, ...] | None
    outcome: str


@dataclass(frozen=True, slots=True)
class Coverage:
    """How often the central interval of a nominal probability held the truth, with its binomial standard error."""

    probability: float
    covered: float
    error: float


@dataclass(frozen=True, slots=True)
class RankTest:
    """What the ranks of one parameter say.

    Parameters
    ----------
    name
        Of the parameter.
    n
        Ranks.
    chi2_p
        P value of equal numbers in bins of ranks.
    ecdf_p
        Share of uniform samples whose ECDF strays at least as far, anywhere.
    mean_rank, spread
        Mean of (rank + 1/2) / (draws + 1), 0.5 when calibrated; and its SD over that of a uniform one: above 1 the
        posterior is too narrow, below 1 too wide.
    coverage
        Of central intervals.
    """

    name: str
    n: int
    chi2_p: float
    ecdf_p: float
    mean_rank: float
    spread: float
    coverage: tuple[Coverage, ...]

    @property
    def inside(self) -> bool:
        """Whether the ECDF stays inside its simultaneous band."""
        return self.ecdf_p > 1.0 - BAND


def settings(method: str, seed: int) -> dict[str, object]:
    """All that the ranks of a map depend on besides its number."""
    return {
        "method": method,
        "seed": seed,
        "draws": DRAWS,
        "noise_sd": list(NOISE_SD),
        "counts": list(COUNTS),
        "lengths_mm": list(LENGTHS_MM),
        "shares": list(SHARES),
        **BumpPrior().as_dict(),
    }


def ranks_of_map(index: int, *, method: str, seed: int) -> MapRanks:
    """Draw one map from the prior, estimate it and rank its truth: all random numbers come from seed and index."""
    rng = np.random.default_rng([seed, index])
    prior = BumpPrior()
    truth = draw_truth(rng, prior)
    options = EstimateOptions(method=method, fit=FitOptions("free", RADIUS_MM, "off", None, "field"), prior=prior)
    found = estimate_map(draw_map(truth, rng, prior), calibration=None, options=options, rng=rng)
    if found.map_posterior is None or found.draws is None:
        return MapRanks(index, truth, None, found.code or "none")
    return MapRanks(index, truth, _ranks_in(found.map_posterior, truth, rng), found.draws.method)


def _ranks_in(posterior: MapPosterior, truth: Truth, rng: np.random.Generator) -> tuple[int, ...]:
    """Ranks of a truth among some of the joint draws, the same ones for every parameter."""
    number = posterior.x_mm.size
    chosen = rng.choice(number, size=DRAWS, replace=number < DRAWS)
    return tuple(int(np.sum(getattr(posterior, name).ravel()[chosen] < getattr(truth, name))) for name in PARAMETERS)


def draw_truth(rng: np.random.Generator, prior: BumpPrior) -> Truth:
    """Bump and noise field from the prior of the field posterior; see the module for what is improper there."""
    p, q = _draw_log_widths(rng, prior)
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


def _draw_log_widths(rng: np.random.Generator, prior: BumpPrior) -> tuple[float, float]:
    """Mean and half difference of the log widths, none wider than the window allows."""
    widest = np.log(WIDEST_IN_RADII * RADIUS_MM)
    while True:
        p = np.log(prior.width_median_mm) + prior.log_width_sd * rng.standard_normal()
        q = prior.log_ratio_sd * rng.standard_normal()
        if p + abs(q) <= widest:
            return float(p), float(q)


def draw_map(truth: Truth, rng: np.random.Generator, prior: BumpPrior) -> TactileMap:
    """A map of the bump on a sloping level of 1, with independent errors by count and the noise field."""
    axis = np.arange(-HALF_MM, HALF_MM + 0.5 * CELL_MM, CELL_MM)
    count = rng.integers(COUNTS[0], COUNTS[1], size=(len(axis), len(axis)), endpoint=True)
    reading_variance = truth.noise_sd**2 / float(np.mean(1.0 / count))
    slope = prior.tilt_sd * rng.standard_normal(2) / RADIUS_MM
    level = 1.0 + slope[0] * axis + slope[1] * axis[:, None]
    errors = np.sqrt(reading_variance / count) * rng.standard_normal(count.shape)
    field = np.sqrt(truth.share) * truth.noise_sd * draw_field(axis, truth, rng)
    return TactileMap(
        mean=level + truth.amplitude * _bump(axis, truth) + errors + field,
        variance=np.full(count.shape, reading_variance),
        count=count.astype(np.int64),
        x_mm=axis,
        y_mm=axis,
        recipe=MapRecipe("grid", "mean", CELL_MM),
        background=1.0,
    )


def _bump(axis: FloatArray, truth: Truth) -> FloatArray:
    """(n, n) cell means of the bump of unit height."""
    centre, width = np.array([truth.x_mm, truth.y_mm]), np.array([truth.sigma_x_mm, truth.sigma_y_mm])
    columns, rows = cell_mean_profile(axis - centre[:, None], sigma_mm=width, cell_mm=CELL_MM)
    return np.asarray(rows[:, None] * columns)


def draw_field(axis: FloatArray, truth: Truth, rng: np.random.Generator) -> FloatArray:
    """(n, n) values of the noise field of mean variance 1: the model's cosines on a rectangle about the bump."""
    side = 2.0 * MARGIN * np.floor(RADIUS_MM / CELL_MM) * CELL_MM
    order = np.arange(COSINES)
    height = np.where(order > 0, np.sqrt(2.0), 1.0)
    across, along = (
        height * np.cos(np.pi * order * ((axis - centre)[:, None] / side + 0.5)) for centre in (truth.x_mm, truth.y_mm)
    )
    frequency2 = (np.pi * order / side) ** 2
    variance = spectrum((frequency2[:, None] + frequency2).ravel(), truth.length_mm).reshape(COSINES, COSINES)
    return np.asarray(along @ (np.sqrt(variance) * rng.standard_normal(variance.shape)) @ across.T)


def rank_tests(maps: list[MapRanks]) -> list[RankTest]:
    """One verdict a parameter; none where no map has ranks."""
    ranks = np.array([one.ranks for one in maps if one.ranks is not None])
    if not len(ranks):
        return []
    strays = uniform_strays(len(ranks), DRAWS)
    return [rank_test(name, ranks[:, i], draws=DRAWS, strays=strays) for i, name in enumerate(PARAMETERS)]


def rank_test(name: str, ranks: IntArray, *, draws: int, strays: FloatArray | None = None) -> RankTest:
    """All tests of one parameter's ranks.

    Parameters
    ----------
    ranks : (n,) array
        Each from 0 to `draws`.
    strays
        From `uniform_strays`, where it is at hand.
    """
    known = uniform_strays(len(ranks), draws) if strays is None else strays
    # equally likely strays of discrete counts differ by rounding
    as_far = float(np.mean(known <= stray(ecdf_counts(ranks[None], draws), len(ranks))[0] * (1.0 + 1e-9)))
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
    """P value of the numbers in equal bins of ranks: at most 20, each with `LEAST_IN_BIN` or more expected."""
    from scipy.stats import chi2

    bins = [b for b in range(2, 21) if (draws + 1) % b == 0 and len(ranks) >= LEAST_IN_BIN * b]
    if not bins:
        return 1.0
    number = np.bincount(ranks * bins[-1] // (draws + 1), minlength=bins[-1])
    expected = len(ranks) / bins[-1]
    return float(chi2.sf(np.sum((number - expected) ** 2) / expected, bins[-1] - 1))


def coverage(ranks: IntArray, draws: int, probability: float) -> Coverage:
    """Share of truths in the central interval between two draws, which holds exactly the nominal share of ranks.

    Raises
    ------
    ValueError
        When no central interval between draws has that probability.
    """
    tail = (1.0 - probability) / 2.0 * (draws + 1)
    if abs(tail - round(tail)) > 1e-9:
        raise ValueError(f"{draws} draws have no central interval of probability {probability:g}")
    held = (ranks >= round(tail)) & (ranks <= draws - round(tail))
    return Coverage(probability, float(held.mean()), float(np.sqrt(probability * (1.0 - probability) / len(ranks))))


def ecdf_counts(ranks: IntArray, draws: int) -> IntArray:
    """(m, draws) how many of (m, n) ranks lie below 1, 2 ... `draws`."""
    below = ranks[..., None] < np.arange(1, draws + 1)
    return np.asarray(below.sum(axis=-2))


def stray(counts: IntArray, n: int) -> FloatArray:
    """(m,) smallest two-sided binomial tail of (m, draws) counts of n ranks: small where an ECDF strays somewhere."""
    from scipy.stats import binom

    at = np.arange(1, counts.shape[-1] + 1) / (counts.shape[-1] + 1)
    number = np.arange(n + 1)[:, None]
    tails = 2.0 * np.minimum(binom.cdf(number, n, at), binom.sf(number - 1, n, at))
    return np.asarray(np.min(tails[counts, np.arange(len(at))], axis=-1))


def uniform_strays(n: int, draws: int, *, simulations: int = BAND_SIMULATIONS) -> FloatArray:
    """(simulations,) `stray` of n uniform ranks, from random numbers of their own: the same each time."""
    rng = np.random.default_rng([n, draws])
    number = rng.multinomial(n, np.full(draws + 1, 1.0 / (draws + 1)), size=simulations)
    return stray(np.cumsum(number, axis=1)[:, :-1], n)


def ecdf_band(n: int, draws: int, *, probability: float = BAND) -> tuple[FloatArray, FloatArray]:
    """(draws,) lowest and highest share of n ranks below 1, 2 ... that uniform ranks keep to everywhere at once.

    Each point's binomial limits are as wide as makes the whole path stay inside with `probability`.
    """
    from scipy.stats import binom

    level = float(np.quantile(uniform_strays(n, draws), 1.0 - probability))
    at = np.arange(1, draws + 1) / (draws + 1)
    return np.asarray(binom.ppf(level / 2.0, n, at) / n), np.asarray(binom.isf(level / 2.0, n, at) / n)
