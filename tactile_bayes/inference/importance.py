"""Importance sampling from adapted Student-t proposals, with Pareto-smoothed weights."""

from __future__ import annotations

import numpy as np
from scipy.special import ndtri

from tactile_bayes.declarations import Record
from tactile_bayes.errors import NotConvergedError
from tactile_bayes.geometry import FloatArray, IndexArray
from tactile_bayes.inference import draws
from tactile_bayes.inference.modes import LogDensity

# --- Pareto-smoothed importance sampling (PSIS): smoothed weights, and the shape that shows if they can be trusted.

TRUSTED_SHAPE = 0.7
"""Above this shape of the weights' tail, their mean converges too slowly to be of use (Vehtari et al. 2024)."""


def smooth_weights(log_weights: FloatArray) -> tuple[FloatArray, float]:
    """Smooth weights (PSIS): replace the upper tail by quantiles of a fitted Pareto tail, and normalise.

    From (n,) unnormalised log weights (-inf without density) to non-negative weights of sum 1 and the tail's shape k:
    NaN when the tail is too short to fit, -inf when all its weights are equal. Vehtari, Simpson, Gelman, Yao & Gabry
    (2024), Journal of Machine Learning Research 25(72).
    """
    n = len(log_weights)
    weights = np.exp(log_weights - log_weights.max())
    tail = int(min(0.2 * n, 3.0 * np.sqrt(n)))
    if tail < 5 or not np.isfinite(log_weights.max()):
        return weights / weights.sum(), float("nan")
    order = np.argsort(weights, kind="stable")
    top = order[-tail:]
    cut = weights[order[-tail - 1]]
    excess = weights[top] - cut
    if not excess[-1] > 1e-12:
        return weights / weights.sum(), float("-inf")
    shape, scale = fit_generalised_pareto(excess)
    if np.isfinite(shape):
        probability = (np.arange(tail) + 0.5) / tail
        log_beyond = np.log1p(-probability)
        near_exponential = abs(shape) < 1e-10
        quantile = -scale * log_beyond if near_exponential else scale * np.expm1(-shape * log_beyond) / shape
        weights[top] = np.minimum(cut + quantile, 1.0)
    return weights / weights.sum(), shape


def fit_generalised_pareto(excess: FloatArray) -> tuple[float, float]:
    """Fit shape and scale of a generalised Pareto distribution to ascending positive excesses.

    The posterior mean under a weak prior of Zhang & Stephens (2009), Technometrics 51:316, with the shape drawn towards
    0.5 by the weight of ten observations as in Vehtari et al. (2024), appendix C.
    """
    n = len(excess)
    positive = np.maximum(excess, 1e-300)
    grid = 30 + int(np.sqrt(n))
    quarter = positive[max(int(n / 4 + 0.5) - 1, 0)]
    index = np.arange(1, grid + 1)
    theta = 1.0 / positive[-1] + (1.0 - np.sqrt(grid / (index - 0.5))) / (3.0 * quarter)
    shapes = np.mean(np.log1p(-theta[:, None] * positive), axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        profile = n * (np.log(-theta / shapes) - shapes - 1.0)
    profile = np.where(np.isfinite(profile), profile, -np.inf)
    if not np.isfinite(profile.max()):
        return float("nan"), float("nan")
    weight = np.exp(profile - profile.max())
    best = float(weight @ theta / weight.sum())
    shape = float(np.mean(np.log1p(-best * positive)))
    scale = -shape / best
    return (n * shape + 10 * 0.5) / (n + 10), scale


# --- The density that importance sampling draws from: one Gaussian or a mixture of several, their tails bent outwards.


class Gaussians(Record, eq=False):
    """A mixture of Gaussians."""

    weight: FloatArray  #: (h,) array: Sum 1.
    mean: FloatArray  #: (h, p) array.
    covariance: FloatArray  #: (h, p, p) array.

    @classmethod
    def one(cls, mean: FloatArray, covariance: FloatArray) -> Gaussians:
        """A single Gaussian."""
        return cls(np.ones(1), mean[None], covariance[None])

    def __len__(self) -> int:
        return len(self.weight)

    def log_density(self, theta: FloatArray) -> FloatArray:
        """(m,) log density at (m, p) points, normalised."""
        parts = []
        for weight, mean, covariance in zip(self.weight, self.mean, self.covariance, strict=True):
            z = np.linalg.solve(np.linalg.cholesky(covariance), (theta - mean).T)
            volume = float(np.linalg.slogdet(2.0 * np.pi * covariance)[1])
            parts.append(np.log(weight) - 0.5 * np.sum(z**2, axis=0) - 0.5 * volume)
        return np.asarray(np.logaddexp.reduce(parts, axis=0))

    def moments(self) -> tuple[FloatArray, FloatArray]:
        """(p,) mean and (p, p) covariance of the whole."""
        mean = self.weight @ self.mean
        off = self.mean - mean
        return mean, np.asarray(
            np.einsum("h,hpq->pq", self.weight, self.covariance) + (self.weight[:, None] * off).T @ off
        )

    def given(self, last: FloatArray) -> Gaussians:
        """The mixture of the first parameters, the last ones known: (j,) values."""
        k = self.mean.shape[1] - len(last)
        across = np.linalg.solve(self.covariance[:, k:, k:], self.covariance[:, k:, :k])
        mean = self.mean[:, :k] + np.einsum("hj,hjk->hk", last - self.mean[:, k:], across)
        covariance = self.covariance[:, :k, :k] - self.covariance[:, :k, k:] @ across
        at_last = [
            Gaussians.one(mean[k:], covariance[k:, k:]).log_density(last[None])[0]
            for mean, covariance in zip(self.mean, self.covariance, strict=True)
        ]
        log_weight = np.log(self.weight) + at_last
        return Gaussians(np.exp(log_weight - np.logaddexp.reduce(log_weight)), mean, covariance)

    def widest(self, covariance: FloatArray) -> float:
        """Largest variance of any of them in any direction, over that of `covariance` in the same direction."""
        whiten = np.linalg.inv(np.linalg.cholesky(covariance))
        return float(np.linalg.eigvalsh(whiten @ self.covariance @ whiten.T).max())


class Proposal:
    """Bent Gaussians: normal coordinates z become sinh(b z) / b, normal in the middle and log-normal outside."""

    def __init__(self, gaussians: Gaussians, stretch: float) -> None:
        self._gaussians, self._stretch = gaussians, stretch
        self._roots = np.linalg.cholesky(gaussians.covariance)
        self._log_det = np.log(np.diagonal(self._roots, axis1=1, axis2=2)).sum(axis=1)

    @property
    def dimension(self) -> int:
        """Uniform coordinates that a point takes: one for each parameter, and the last one to choose a Gaussian."""
        return int(self._gaussians.mean.shape[1]) + (len(self._gaussians) > 1)

    def points(self, uniform: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Points (..., p) and their log densities (...) for (..., dimension) uniform coordinates."""
        mean, b = self._gaussians.mean, self._stretch
        p = mean.shape[1]
        z = ndtri(uniform[..., :p])
        bent = np.sinh(b * z) / b
        if len(mean) == 1:
            return mean[0] + bent @ self._roots[0].T, self._log_bent(z) - self._log_det[0]
        chosen = np.searchsorted(np.cumsum(self._gaussians.weight)[:-1], uniform[..., p])
        theta = np.empty_like(bent)
        for h, root in enumerate(self._roots):
            theta[chosen == h] = mean[h] + bent[chosen == h] @ root.T
        return theta, self.log_density(theta)

    def log_density(self, theta: FloatArray) -> FloatArray:
        """(...) log density at (..., p) points."""
        total = np.full(theta.shape[:-1], -np.inf)
        for h, root in enumerate(self._roots):
            bent = (theta - self._gaussians.mean[h]) @ np.linalg.inv(root).T
            z = np.arcsinh(self._stretch * bent) / self._stretch
            total = np.logaddexp(total, np.log(self._gaussians.weight[h]) + self._log_bent(z) - self._log_det[h])
        return total

    def _log_bent(self, z: FloatArray) -> FloatArray:
        parts = -0.5 * z**2 - np.log(np.cosh(self._stretch * z)) - 0.5 * np.log(2 * np.pi)
        return np.asarray(parts.sum(axis=-1))


# --- A mixture of Gaussians fitted to weighted points: the second round of importance sampling where one was not
# enough.
#
# Incremental mixture importance sampling: a Gaussian goes where the largest weight is, as wide as the points about
# it, and its points join the others. It finds a second mode, a curved ridge or a skewed flank, where one Gaussian
# has too little.
#
# References
# ----------
# Raftery & Bao (2010), Biometrics 66:1162, section 3; Hesterberg (1995), Technometrics 37:185 (defensive mixtures).

ADDED = 256  #: Points of each Gaussian added, and points that its width is taken from.
MOST_ADDED = 32
ENOUGH = 0.75  #: Share of effective points at which no more Gaussians are added, if the weights' tail is light as well.
LIGHT_TAIL = 0.3  #: Pareto shape of weights that more points will hardly show to be heavier.
LEAST_VARIANCE = 1e-6
"""Least variance of a Gaussian in any direction, over that of all the points: points may lie in a plane."""


def fitted_gaussians(
    log_density: LogDensity, first: Proposal, theta: FloatArray, log_target: FloatArray, *, rng: np.random.Generator
) -> tuple[Gaussians, int]:
    """Gaussians whose mixture resembles a density, from (n, p) points of another proposal and their (n,) log density.

    The first of them is a defensive one: mean and covariance of all the weighted points. Also counts the evaluations.
    """
    # a point's share: over all the proposals, their number of points times their density there
    n, log_share = len(theta), first.log_density(theta) + np.log(len(theta))
    weight, _ = smooth_weights(log_target - log_share)
    mean = weight @ theta
    whole = _covariance(theta, weight, mean)
    means, covariances = [mean], [whole]
    for number in range(1, MOST_ADDED + 1):
        weight, shape = smooth_weights(log_target - log_share)
        if 1.0 / np.sum(weight**2) > ENOUGH * len(theta) and shape <= LIGHT_TAIL:
            break
        centre = theta[np.argmax(log_target - log_share)]
        means.append(centre)
        # of the nearest points, weighted half by their weights and half alike
        z = np.linalg.solve(np.linalg.cholesky(whole), (theta - centre).T)
        near = np.argsort(np.sum(z**2, axis=0), kind="stable")[:ADDED]
        mixed = weight[near] + 1.0 / len(theta)
        covariances.append(_covariance(theta[near], mixed / mixed.sum(), centre) + LEAST_VARIANCE * whole)
        points = centre + rng.standard_normal((ADDED, len(centre))) @ np.linalg.cholesky(covariances[-1]).T
        log_share = np.logaddexp(log_share, np.log(ADDED) + Gaussians.one(centre, covariances[-1]).log_density(theta))
        earlier = Gaussians(np.full(number, 1.0 / number), np.array(means[1:]), np.array(covariances[1:]))
        there = np.log(ADDED * number) + earlier.log_density(points)
        log_share = np.concatenate([log_share, np.logaddexp(np.log(n) + first.log_density(points), there)])
        theta, log_target = np.concatenate([theta, points]), np.concatenate([log_target, log_density(points)])
    size = np.array([n, *[ADDED] * (len(means) - 1)], dtype=np.float64)
    return Gaussians(size / size.sum(), np.array(means), np.array(covariances)), ADDED * (len(means) - 1)


def _covariance(theta: FloatArray, weight: FloatArray, centre: FloatArray) -> FloatArray:
    off = theta - centre
    return np.asarray((weight[:, None] * off).T @ off)


# --- Importance sampling by randomised quasi-Monte Carlo about the mode, doubled until interval ends are accurate.

STRETCH, WIDE_STRETCH = 0.45, 0.8
"""Bend of the proposal's tails, see `Proposal`. The wide one is for densities with tails like a t: from a few thousand
points it needs a quarter of the narrow one's."""
HEAVY_TAIL = 0.3  #: Pareto shape of the first points' weights above which the wide proposal is taken.
TOO_WIDE = 2.0
"""A part of the density with this many times the variance of one Gaussian gives weights of infinite variance under it:
then the proposal has a Gaussian for each part."""
ADAPTED_FROM = 1024  #: Points a replicate from which a tail heavier than trusted lets a mixture be fitted to them.
POOR = 0.5  #: Below this share of effective draws the proposal is moved to the weighted moments of the points so far.
FITTED_AT = 4096
"""Points a replicate at which a mixture is fitted where the error is not reached: with four times as many it is cheaper
only now and then."""
NEAR_ENOUGH = 3.0
"""Points whose weights can be trusted stand at so many times the wanted error, where a fitted proposal is worse: chains
are asked for five times it."""
MOST_MOVES = 4
LEAST_KEPT = 8192  #: Equal-weight draws returned, at least: twice the points where those are more.
HEAVY_POINTS, HEAVY = 2048, 0.1
"""With as many points a replicate and a tail heavier than trusted by this, more points do not help."""


class ImportanceOptions(Record):
    """Stopping rule of importance sampling."""

    accuracy_sd: float = 0.02
    """Wanted Monte-Carlo error of the ends of a 95 % interval, in posterior standard deviations."""
    first: int = 256  #: Points of a replicate to begin with.
    most: int = 16384  #: And at most.


def importance(
    log_density: LogDensity,
    mode: FloatArray,
    covariance: FloatArray,
    *,
    rng: np.random.Generator,
    options: ImportanceOptions | None = None,
    parts: Gaussians | None = None,
) -> draws.ParameterDraws:
    """Draw from a log density, (m, p) to (m,), by importance sampling; returns draws of equal weight.

    The proposal has the (p,) mode and (p, p) covariance given, or is made of `parts`, Gaussians that the density is
    about a mixture of, where one of them is `TOO_WIDE` for the one above. `NotConvergedError` when the weights' tail is
    too heavy even for a mixture fitted to the points (`fitted_gaussians`), or the error is not reached.

    The points are a Sobol set under random digital shifts. The proposal is smooth, close to a normal in its middle and
    wider in its tails, so that the points stay even and the weights bounded where the density falls a little more
    slowly than a normal. Put the parameters that matter first: a Sobol set fills its first coordinates most evenly, and
    the proposal's root is triangular.
    """
    options = options or ImportanceOptions()
    gaussians = Gaussians.one(mode, covariance)
    if parts is not None and parts.widest(covariance) > TOO_WIDE:
        gaussians = parts
    sampler = _sampled(_settled(log_density, gaussians, rng=rng, options=options), options)
    keep = max(LEAST_KEPT, 2 * sampler.number)
    chosen = systematic(sampler.weights, keep, rng)
    log_evidence, log_evidence_error = sampler.log_evidence()
    figures = {
        "pareto_k": float(sampler.shape),
        "end_error_sd": sampler.error,
        "evaluations": float(sampler.evaluations),
        "effective_draws": float(1.0 / np.sum(sampler.weights**2)),
        "log_evidence": log_evidence,
        "log_evidence_error": log_evidence_error,
        "draws": float(keep),
    }
    lp, log_weight = sampler.log_target.ravel()[chosen], sampler.log_weights.ravel()[chosen] - log_evidence
    statistics = {"lp": lp[None], "log_weight": log_weight[None]}
    labels = chosen // sampler.points
    return draws.ParameterDraws(sampler.theta[chosen][None], "importance", figures, labels, statistics)


def _sampled(sampler: _Sampler, options: ImportanceOptions) -> _Sampler:
    """More points until the error is reached, if need be from a proposal fitted to them; where that is worse the first
    one goes on if its points can be trusted."""
    wanted = options.accuracy_sd
    if sampler.extended(wanted, most=min(FITTED_AT, options.most), patience=ADAPTED_FROM).reached(wanted):
        return sampler
    fitted = sampler.adapted()
    fitted.extend(ADAPTED_FROM)
    # a fitted proposal may take twice the points: chains, which come next, are asked for a fifth of the accuracy
    if fitted.extended(wanted, most=2 * options.most, patience=HEAVY_POINTS, heavy=HEAVY).reached(wanted):
        return fitted
    if _trusted(sampler.shape):
        sampler.extended(wanted, most=options.most, patience=ADAPTED_FROM)
        if sampler.reached(NEAR_ENOUGH * wanted):
            return sampler
    raise NotConvergedError(
        f"importance sampling stopped at {fitted.number} points with an end-point error of {fitted.error:.3f} SD "
        f"(wanted {wanted:g}) and Pareto shape {fitted.shape:.2f} (wanted {TRUSTED_SHAPE:g} or less); "
        "use --method ensemble",
        diagnostics={"pareto_k": float(fitted.shape), "end_error_sd": fitted.error},
    )


def _trusted(shape: float) -> bool:
    return shape == -np.inf or bool(np.isfinite(shape) and shape <= TRUSTED_SHAPE)


def _settled(
    log_density: LogDensity, gaussians: Gaussians, *, rng: np.random.Generator, options: ImportanceOptions
) -> _Sampler:
    """First points, from a proposal that is adapted while it is poor."""
    spent, stretch = 0, STRETCH
    for _ in range(MOST_MOVES):
        sampler = _Sampler(log_density, gaussians, stretch=stretch, rng=rng, spent=spent)
        sampler.extend(options.first)
        weights = sampler.weights
        if not np.isfinite(weights).all():
            raise NotConvergedError(
                "importance sampling found no density about the mode; use --method ensemble",
                diagnostics={"pareto_k": float("nan")},
            )
        if sampler.shape > HEAVY_TAIL and stretch < WIDE_STRETCH:
            stretch, spent = WIDE_STRETCH, sampler.evaluations
            continue
        if 1.0 / np.sum(weights**2) > POOR * sampler.number:
            break
        centre = weights @ sampler.theta
        about = _covariance(sampler.theta, weights, centre)
        if not np.linalg.eigvalsh(about)[0] > 1e-6 * np.linalg.eigvalsh(gaussians.covariance[0])[0]:
            break
        gaussians, spent = Gaussians.one(centre, about), sampler.evaluations
    return sampler


class _Sampler:
    """Points with densities and smoothed weights, by replicate: independent shifts of the set, whose spread is the
    error."""

    weights: FloatArray  #: (n,) of all points.
    shape: float  #: Pareto shape of their tail.
    error: float  #: Largest Monte-Carlo error, over the parameters, of a 95 % interval's ends, in SDs; see `extended`.

    def __init__(
        self, log_density: LogDensity, gaussians: Gaussians, *, stretch: float, rng: np.random.Generator, spent: int
    ) -> None:
        self._log_density, self._rng, self._spent = log_density, rng, spent
        self._proposal = Proposal(gaussians, stretch)
        self._shifts = rng.integers(2**draws.BITS, size=(draws.REPLICATES, self._proposal.dimension), dtype=np.uint32)
        self._theta = np.empty((draws.REPLICATES, 0, gaussians.mean.shape[1]))
        self.log_target, self.log_weights = np.empty((draws.REPLICATES, 0)), np.empty((draws.REPLICATES, 0))

    def adapted(self) -> _Sampler:
        """One whose proposal is fitted to these points, without points."""
        gaussians, spent = fitted_gaussians(
            self._log_density, self._proposal, self.theta, self.log_target.ravel(), rng=self._rng
        )
        spent += self.evaluations
        return _Sampler(self._log_density, gaussians, stretch=STRETCH, rng=self._rng, spent=spent)

    @property
    def number(self) -> int:
        """Number of points in all replicates."""
        return self.log_weights.size

    @property
    def points(self) -> int:
        """Number of points per replicate."""
        return self.log_weights.shape[1]

    @property
    def evaluations(self) -> int:
        """Number of densities evaluated, including earlier proposals."""
        return self._spent + self.number

    @property
    def theta(self) -> FloatArray:
        """(n, p) points of all replicates."""
        return self._theta.reshape(-1, self._theta.shape[2])

    def extend(self, points: int) -> None:
        """Add `points` to every replicate."""
        theta, log_proposal = self._proposal.points(draws.shifted_sobol(self.points, points, shifts=self._shifts))
        log_target = self._log_density(theta.reshape(-1, theta.shape[2])).reshape(theta.shape[:2])
        self._theta = np.concatenate([self._theta, theta], axis=1)
        self.log_target = np.concatenate([self.log_target, log_target], axis=1)
        self.log_weights = np.concatenate([self.log_weights, log_target - log_proposal], axis=1)
        self.weights, self.shape = smooth_weights(self.log_weights.ravel())

    def extended(self, accuracy_sd: float, *, most: int, patience: int, heavy: float = 0.0) -> _Sampler:
        """Double the points until the error is reached, or `most` a replicate, or the tail is heavier than trusted by
        `heavy`, from `patience` points a replicate on."""
        while True:
            # a few replicates' spread misses what a heavy tail does now and then: 0.036 SD was seen for 0.015
            self.error = self._end_error() * (1.0 + max(self.shape, 0.0) if np.isfinite(self.shape) else 1.0)
            hopeless = self.points >= patience and not _trusted(self.shape - heavy)
            if self.reached(accuracy_sd) or self.points >= most or hopeless:
                return self
            self.extend(self.points)

    def reached(self, accuracy_sd: float) -> bool:
        """True where the weights can be trusted and the error is no larger than this."""
        return _trusted(self.shape) and self.error <= accuracy_sd

    def log_evidence(self) -> tuple[float, float]:
        """Log of the integral of exp(log density), and its standard error, from the replicates."""
        each = np.logaddexp.reduce(self.log_weights, axis=1)
        share = np.exp(each - each.max())
        error = float(share.std(ddof=1) / share.mean() / np.sqrt(len(share)))
        return float(np.logaddexp.reduce(self.log_weights.ravel()) - np.log(self.number)), error

    def _end_error(self) -> float:
        by_replicate, tails = self.weights.reshape(self.log_weights.shape), np.array([0.025, 0.975])
        worst = 0.0
        for i in range(self._theta.shape[2]):
            values = self._theta[:, :, i]
            mean = float(np.sum(self.weights * values.ravel()))
            sd = float(np.sqrt(np.sum(self.weights * (values.ravel() - mean) ** 2)))
            order = np.argsort(values, axis=1)
            ordered, weights = (np.take_along_axis(one, order, axis=1) for one in (values, by_replicate))
            ends = [draws.weighted_quantiles_of(v, w, tails) for v, w in zip(ordered, weights, strict=True)]
            error = float(np.sqrt(np.mean(np.var(ends, axis=0, ddof=1)) / len(ends)))
            worst = max(worst, error / sd if sd > 0 else 0.0)
        return worst


def systematic(weights: FloatArray, number: int, rng: np.random.Generator) -> IndexArray:
    """Indices of `number` equal-weight draws by systematic resampling, then shuffled."""
    edges = np.cumsum(weights) / weights.sum()
    index = np.searchsorted(edges, (np.arange(number) + rng.uniform()) / number)
    return np.asarray(rng.permutation(np.minimum(index, len(weights) - 1)))
