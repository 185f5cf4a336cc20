"""Draws of a posterior: their summary, a cache of solutions, Sobol points and stratified quantiles."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Annotated, Any, Final, Literal

import numpy as np
from scipy.special import ndtri

from tactile_bayes.declarations import Meta, Record, field, replace, rounded
from tactile_bayes.errors import check_number
from tactile_bayes.geometry import FloatArray, IndexArray
from tactile_bayes.presets import INTERVAL

# --- Draws of a model's parameters, the result of every method.

END_ERROR = 2.67
"""Monte-Carlo error of an end of a 95 % interval, in SDs, times the root of the independent draws (normal tails)."""
INDEPENDENT_DRAWS = 4000
"""Draws of the methods that draw independently: end-point Monte-Carlo error of a 95 % interval about 0.04 SD."""
REPLICATES = 4  #: Independent parts of every set of draws; their spread is the Monte-Carlo error.
Labels = IndexArray


def even_replicates(number: int) -> Labels:
    """(number,) labels of `REPLICATES` equal parts of independent draws."""
    return np.arange(number) * REPLICATES // max(number, 1)


class ParameterDraws(Record, eq=False):
    """Draws of a parameter vector."""

    theta: FloatArray  #: (chain, draw, p) array.
    method: str  #: One of `presets.METHODS`.
    diagnostics: Mapping[str, float] = field(default_factory=dict)
    """Figures of the method (R-hat, effective draws, evaluations...), for the report."""
    labels: Labels | None = None
    """(chain * draw,) array or None: Replicate of each draw, for draws in one chain; None for independent draws."""
    statistics: Mapping[str, FloatArray] = field(default_factory=dict)
    """(chain, draw) arrays of the sampler by name: ``lp``, the log density at the draw; ``log_weight``, that of its
    point in importance sampling; ``accepted``, 1 where the chain's walker moved in that step."""

    @property
    def flat(self) -> FloatArray:
        """(chain * draw, p) draws of all chains."""
        return self.theta.reshape(-1, self.theta.shape[-1])

    @property
    def replicates(self) -> Labels:
        """(chain * draw,) replicate of each draw; chains are independent of each other."""
        chains, draws = self.theta.shape[:2]
        if self.labels is not None:
            return self.labels
        return even_replicates(draws) if chains == 1 else np.repeat(np.arange(chains), draws) % REPLICATES

    @property
    def effective_draws(self) -> float:
        """Effective draws for an interval's end: the smallest tail ESS, or all when independent."""
        return float(min(self.diagnostics.get("ess_tail", np.inf), len(self.flat)))


def student_draws(
    centre: FloatArray, scale: FloatArray, *, dof: float, number: int, rng: np.random.Generator
) -> FloatArray:
    """(number, p) draws of a multivariate t; normal for `dof` of ``inf``. The (p, p) scale may be near-singular."""
    values, vectors = np.linalg.eigh(scale)
    root = vectors * np.sqrt(np.clip(values, 0.0, None))
    normal = rng.standard_normal((number, len(centre))) @ root.T
    if np.isinf(dof):
        return np.asarray(centre + normal)
    return np.asarray(centre + normal * np.sqrt(dof / rng.chisquare(dof, size=number))[:, None])


def rows_by_label(labels: Labels, wanted_labels: Labels, rng: np.random.Generator) -> Labels:
    """Indices of draws with `wanted_labels`, in random order; each draw of a replicate is used equally often."""
    index = np.empty(len(wanted_labels), dtype=np.intp)
    for label in range(REPLICATES):
        members, positions = np.flatnonzero(labels == label), np.flatnonzero(wanted_labels == label)
        members = members if len(members) else np.arange(len(labels))
        index[positions] = rng.permutation(np.resize(rng.permutation(members), len(positions)))
    return index


# --- Summary of a posterior in seven numbers, with its interval's kind and probability.

INTERVAL_KIND: Final = "eti"


class Quantity(Record, kw_only=True):
    """Summary of one quantity's draws."""

    median: float
    mean: float
    sd: Annotated[float, Meta(ge=0)]
    low: float
    high: float
    """`low`, `high`: Ends of the equal-tailed interval of `probability`."""
    mc_error: Annotated[float, Meta(ge=0)] = 0.0
    """Monte-Carlo standard error of the less certain of low and high, in their unit: further digits mean nothing."""
    probability: Annotated[float, Meta(gt=0, lt=1)]
    kind: Literal["eti", "hdi"]

    @property
    def rounded(self) -> Quantity:
        """The same with nine significant digits, as files have it."""
        return replace(rounded(self), probability=self.probability)


def summarise(
    draws: FloatArray, *, probability: float, effective_draws: float | None = None, replicates: Labels | None = None
) -> Quantity:
    """Summary of draws with their equal-tailed interval, leaving NaN out; `ValueError` when no draw is finite.

    The Monte-Carlo error is from the spread between the `replicates` of ``draws.ravel()``, or without them from the
    number of effective draws in a tail (by default all).
    """
    flat = draws.ravel()
    is_finite = np.isfinite(flat)
    values = flat[is_finite]
    if not values.size:
        raise ValueError("no finite draws")
    tail = (1.0 - probability) / 2.0
    ordered = np.sort(values)
    low, median, high = quantiles_of(ordered, np.array([tail, 0.5, 1.0 - tail]))
    if replicates is None:
        step = float(np.sqrt(tail * (1.0 - tail) / max(effective_draws or values.size, 1.0)))
    else:
        step = _tail_error(values, replicates[is_finite], (low, high))
    # standard error of an end: half the distance between the order statistics one standard error below and above
    around = np.clip([tail - step, tail + step, 1 - tail - step, 1 - tail + step], 0.0, 1.0)
    ends = quantiles_of(ordered, around)
    return Quantity(
        median=float(median),
        mean=float(values.mean()),
        sd=float(values.std()),
        low=float(low),
        high=float(high),
        mc_error=float(max(ends[1] - ends[0], ends[3] - ends[2]) / 2.0),
        probability=probability,
        kind=INTERVAL_KIND,
    )


def _tail_error(values: FloatArray, replicates: Labels, ends: tuple[float, float]) -> float:
    """Standard error of the probability beyond an interval's end, from the spread of the replicates; at least one draw.

    That of a ratio of sums (Cochran 1977, Sampling Techniques, ch. 6). Pooling both ends doubles the few degrees of
    freedom.
    """
    count, n = np.bincount(replicates), len(values)
    r = int(np.count_nonzero(count))
    if r < 2:
        return 0.5
    squares = []
    for beyond in (values < ends[0], values > ends[1]):
        inside = np.bincount(replicates, weights=beyond)
        squares.append(float(np.sum((inside - count * inside.sum() / n) ** 2)) * r / (r - 1))
    return max(float(np.sqrt(np.mean(squares))), 1.0) / n


def quantiles_of(ordered: FloatArray, probabilities: FloatArray) -> FloatArray:
    """Quantiles of sorted values, linear between neighbours: ``np.quantile`` without its slower sort."""
    return np.interp(probabilities * (len(ordered) - 1), np.arange(len(ordered)), ordered)


def weighted_quantiles_of(ordered: FloatArray, weights: FloatArray, probabilities: FloatArray) -> FloatArray:
    """Weighted quantiles of sorted values, linear between the middles of their steps."""
    edges = np.cumsum(weights)
    return np.interp(probabilities, (edges - 0.5 * weights) / edges[-1], ordered)


# --- Cache of conditional (linear) solutions by parameter vector, reused when those points become draws.

Solution = tuple[FloatArray, ...]  #: Arrays with a row a parameter vector; see `CollapsedTarget.conditional`.


class SolutionCache:
    """Cache of solutions by parameter vector; `solve` maps (m, p) vectors to arrays of m rows.

    Importance sampling chooses its draws among points that it has evaluated: to solve those again for amplitude, level
    and noise scale would cost as much as the sampling.
    """

    def __init__(self, solve: Callable[[FloatArray], Solution]) -> None:
        self._solve = solve
        self._theta: list[FloatArray] = []
        self._solutions: list[Solution] = []

    def add(self, theta: FloatArray, solution: Solution) -> None:
        """Store the solution at (m, p) parameter vectors."""
        self._theta.append(theta)
        self._solutions.append(solution)

    def __call__(self, theta: FloatArray) -> Solution:
        """Solutions at (m, p) parameter vectors: from the cache where it has all, else computed."""
        if not self._theta:
            return self._solve(theta)
        points = np.concatenate(self._theta)
        order = np.argsort(points[:, 0], kind="stable")  # random points never share their first coordinate
        position = np.searchsorted(points[:, 0], theta[:, 0], sorter=order)
        row = order[np.minimum(position, len(points) - 1)]
        if not np.array_equal(points[row], theta):
            return self._solve(theta)
        return tuple(np.concatenate(parts)[row] for parts in zip(*self._solutions, strict=True))


# --- Posterior draws of one quantity, with its median and intervals.


class Draws(Record, eq=False):
    """Posterior draws of one quantity.

    Examples
    --------
    >>> import tactile_bayes as tb
    >>> size = tb.estimate(tb.demo_map()).max_size_mm
    >>> low, high = size.interval(0.9)
    >>> bool(low < size.median < high)
    True
    """

    values: FloatArray  #: (chain, draw) array; NaN where a draw has no value.
    unit: str = ""  #: Such as ``"mm"``; empty for a ratio.
    probability: float = INTERVAL  #: Of the interval that is shown where none is asked for.
    replicates: Labels | None = None
    """(chain * draw,) label of the independent replicate of each draw; their spread is the Monte-Carlo error."""
    effective_draws: float | None = None  #: How many independent draws they are worth, where there are no replicates.

    def summary(self, probability: float | None = None) -> Quantity:
        """Median, mean, SD, equal-tailed interval and its Monte-Carlo error, as the command line prints them.

        Parameters
        ----------
        probability
            Of the interval, between 0 and 1.

        Raises
        ------
        UsageError
            When the probability is not between 0 and 1.
        """
        level = self.probability if probability is None else probability
        check_number("the probability of an interval", level, 0, 1, open_ends=True)
        return summarise(
            self.values, probability=level, effective_draws=self.effective_draws, replicates=self.replicates
        )

    def interval(self, probability: float | None = None) -> tuple[float, float]:
        """Ends of the equal-tailed credible interval."""
        summary = self.summary(probability)
        return summary.low, summary.high

    @property
    def median(self) -> float:
        """The posterior's median."""
        return self.summary().median

    @property
    def mean(self) -> float:
        """The posterior's mean."""
        return self.summary().mean

    @property
    def sd(self) -> float:
        """The posterior's standard deviation."""
        return self.summary().sd

    @property
    def mc_error(self) -> float:
        """Monte-Carlo standard error of the interval's ends."""
        return self.summary().mc_error

    def __array__(self, dtype: object = None, copy: bool | None = None) -> FloatArray:
        """The draws as an array."""
        return np.array(self.values, dtype=dtype, copy=copy)  # type: ignore[call-overload, no-any-return]

    def __array_function__(self, function: Any, _types: Any, args: tuple[Any, ...], keywords: dict[str, Any]) -> Any:
        """What a function of NumPy makes of the draws: `numpy.mean` would call the property of that name."""
        arrays = tuple(one.values if isinstance(one, Draws) else one for one in args)
        return self.values.__array_function__(function, (np.ndarray,), arrays, keywords)

    def __repr__(self) -> str:
        summary, unit = self.summary(), f" {self.unit}" if self.unit else ""
        interval = f"{summary.low:.3g} to {summary.high:.3g}, {100 * summary.probability:g} % interval"
        return f"{summary.median:.3g}{unit} ({interval})"


# --- The normal distribution function.


def normal_cdf(z: FloatArray) -> FloatArray:
    """Normal distribution function to 1e-7 (Abramowitz & Stegun 26.2.17)."""
    t = 1.0 / (1.0 + 0.2316419 * np.abs(z))
    tail = np.exp(-0.5 * z**2) / np.sqrt(2.0 * np.pi) * t * np.polyval(_B1, t)
    return np.asarray(np.where(z < 0, tail, 1.0 - tail))


_B1 = (1.330274429, -1.821255978, 1.781477937, -0.356563782, 0.319381530)


# --- Sobol points with random digital shifts, without the slow import of scipy.
#
# The library's generator lies behind 0.9 s of imports; the points are the same (a test compares them).

BITS = 30
# Degree, coefficients and initial numbers of the primitive polynomials of dimensions 2 to 8
# (Joe & Kuo 2008, SIAM Journal on Scientific Computing 30:2635, table new-joe-kuo-6).
_POLYNOMIALS = (
    (1, 0, (1,)),
    (2, 1, (1, 3)),
    (3, 1, (1, 3, 1)),
    (3, 2, (1, 1, 1)),
    (4, 1, (1, 1, 3, 3)),
    (4, 4, (1, 3, 5, 13)),
    (5, 2, (1, 1, 5, 5, 17)),
)
MOST_DIMENSIONS = len(_POLYNOMIALS) + 1


def sobol_integers(start: int, number: int, dimension: int) -> np.ndarray[tuple[int, ...], np.dtype[np.uint32]]:
    """(number, dimension) points of the Sobol sequence from `start` on, as integers of `BITS` bits."""
    index = np.arange(start, start + number, dtype=np.uint32)
    gray = index ^ (index >> np.uint32(1))
    points = np.zeros((number, dimension), dtype=np.uint32)
    directions = np.stack([_directions(column) for column in range(dimension)])
    for bit in range(max(1, int(start + number).bit_length())):
        chosen = ((gray >> np.uint32(bit)) & np.uint32(1)).astype(bool)
        points[chosen] ^= directions[:, bit]
    return points


def shifted_sobol(start: int, number: int, *, shifts: np.ndarray[tuple[int, ...], np.dtype[np.uint32]]) -> FloatArray:
    """(replicates, number, dimension) uniform points in (0, 1): the sequence under the digital shift of each row of
    `shifts`."""
    points = sobol_integers(start, number, shifts.shape[1])
    return np.asarray(((points ^ shifts[:, None, :]) + 0.5) / 2.0**BITS)


def _directions(column: int) -> np.ndarray[tuple[int, ...], np.dtype[np.uint32]]:
    """Direction numbers of one dimension, from Bratley & Fox (1988)."""
    if column == 0:
        return np.array([1 << (BITS - 1 - k) for k in range(BITS)], dtype=np.uint32)
    degree, coefficients, initial = _POLYNOMIALS[column - 1]
    numbers = [m << (BITS - 1 - k) for k, m in enumerate(initial)]
    for k in range(degree, BITS):
        value = numbers[k - degree] ^ (numbers[k - degree] >> degree)
        for i in range(1, degree):
            if (coefficients >> (degree - 1 - i)) & 1:
                value ^= numbers[k - i]
        numbers.append(value)
    return np.array(numbers, dtype=np.uint32)


# --- Quasi-random points and stratified quantiles: small Monte-Carlo errors for quantities that the map does not show.

MOST_PAIRED = MOST_DIMENSIONS - 1
MERGED, LEAST_MERGED = 8, 512  #: Neighbouring normals of a mixture taken as one; least number where this is done.
_NODES = np.sinh(np.linspace(-3.0, 3.0, 81))
"""Where a mixture's distribution function is computed, in SDs from its mean; dense in the middle."""
LEAST_SD = 1e-2  #: Least SD of a component, as a share of the mixture's: a narrower one is widened to this.


def distinct_rows(theta: FloatArray) -> tuple[FloatArray, IndexArray]:
    """Distinct rows of an (n, p) array, in order, and the (n,) index of each row among them."""
    rows, index = np.unique(theta, axis=0, return_inverse=True)
    return rows, index.reshape(-1)  # some versions of numpy return a column


def paired_points(key: FloatArray, replicates: Labels, dimension: int, rng: np.random.Generator) -> FloatArray:
    """(n, dimension) uniform points in (0, 1) for drawing further quantities, one point per draw.

    Within a replicate the rank of the (n,) `key` (the quantity on which the result depends most) and the point together
    are a Sobol set under a random digital shift, so that a sum over the draws has the error of an integral of few
    dimensions, at most `MOST_PAIRED`: L'Ecuyer, Lecot & Tuffin (2008), Operations Research 56:958.
    """
    counts = np.bincount(replicates)
    shifts = rng.integers(2**BITS, size=(len(counts), dimension + 1), dtype=np.uint32)
    points = shifted_sobol(0, int(counts.max()), shifts=shifts)
    paired = np.empty((len(key), dimension))
    for label, (count, replicate_points) in enumerate(zip(counts, points, strict=True)):
        members = np.flatnonzero(replicates == label)
        order = np.argsort(replicate_points[:count, 0])
        paired[members[np.argsort(key[members], kind="stable")]] = replicate_points[order, 1:]
    return paired


def stratified_quantiles(values: FloatArray, mean: FloatArray, sd: FloatArray, replicates: Labels) -> FloatArray:
    """Replace (n,) normal draws by evenly spaced quantiles of the mixture of the normals that they were drawn from.

    Within each replicate, and in the order of its values; NaN stays. The mixture's distribution function is the mean of
    the normals' (Rao-Blackwell), inverted on a grid as normal scores, in which it is nearly straight.
    """
    even = values.copy()
    for label in range(int(replicates.max(initial=-1)) + 1):
        members = np.flatnonzero((replicates == label) & np.isfinite(values))
        if len(members):
            members = members[np.argsort(values[members])]
            even[members] = _mixture_quantiles(mean[members], sd[members])
    return even


def _mixture_quantiles(mean: FloatArray, sd: FloatArray) -> FloatArray:
    """(n,) ascending, evenly spaced quantiles of a mixture of n normals."""
    spread, n = float(np.var(mean)), len(mean)
    total = float(np.sqrt(np.mean(sd**2) + spread))
    sort_key, n_merged = mean if spread > np.mean(sd**2) else sd, n // MERGED * MERGED
    sd = np.maximum(sd, LEAST_SD * total)
    if n_merged >= LEAST_MERGED:  # a subset spread evenly over the order, so that neither end is lost
        order = np.argsort(sort_key)[np.linspace(0, n - 1, n_merged).round().astype(np.intp)].reshape(-1, MERGED)
        sd = np.sqrt(np.mean(sd[order] ** 2, axis=1) + np.var(mean[order], axis=1))
        mean = mean[order].mean(axis=1)
    grid = float(mean.mean()) + total * _NODES
    score = ndtri(np.clip(normal_cdf((grid[:, None] - mean) / sd).mean(axis=1), 1e-12, 1.0 - 1e-12))
    return np.interp(ndtri((np.arange(n) + 0.5) / n), score, grid)
