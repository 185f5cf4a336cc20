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
    log_beyond = np.log1p(-(np.arange(tail) + 0.5) / tail)
    weights[top] = np.minimum(cut + scale * np.expm1(-shape * log_beyond) / shape, 1.0)
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
    def single(cls, mean: FloatArray, covariance: FloatArray) -> Gaussians:
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
        within = np.einsum("h,hpq->pq", self.weight, self.covariance)
        return mean, np.asarray(within + _covariance(self.mean, self.weight, mean))

    def conditional(self, last: FloatArray) -> Gaussians:
        """Conditional mixture of the first parameters given (j,) values of the last."""
        k = self.mean.shape[1] - len(last)
        across = np.linalg.solve(self.covariance[:, k:, k:], self.covariance[:, k:, :k])
        mean = self.mean[:, :k] + np.einsum("hj,hjk->hk", last - self.mean[:, k:], across)
        covariance = self.covariance[:, :k, :k] - self.covariance[:, :k, k:] @ across
        log_density_at_last = [
            Gaussians.single(mean[k:], covariance[k:, k:]).log_density(last[None])[0]
            for mean, covariance in zip(self.mean, self.covariance, strict=True)
        ]
        log_weight = np.log(self.weight) + log_density_at_last
        return Gaussians(np.exp(log_weight - np.logaddexp.reduce(log_weight)), mean, covariance)

    def widest(self, covariance: FloatArray) -> float:
        """Largest variance of a Gaussian in any direction, over that of `covariance` in the same direction."""
        whiten = np.linalg.inv(np.linalg.cholesky(covariance))
        return float(np.linalg.eigvalsh(whiten @ self.covariance @ whiten.T).max())


class Proposal:
    """Gaussians with bent tails: coordinates z become sinh(b z) / b, normal in the middle, log-normal outside."""

    def __init__(self, gaussians: Gaussians, stretch: float) -> None:
        self._gaussians, self._stretch = gaussians, stretch
        self._roots = np.linalg.cholesky(gaussians.covariance)
        self._log_det = np.log(np.diagonal(self._roots, axis1=1, axis2=2)).sum(axis=1)

    @property
    def dimension(self) -> int:
        """Number of uniform coordinates per point: one for each parameter, and one to choose among Gaussians."""
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


# --- Incremental mixture importance sampling, where one Gaussian is not enough.
#
# A Gaussian is added where the largest weight is, as wide as the points about it, and its points join the others. It
# finds a second mode, a curved ridge or a skewed flank.
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
    """Mixture fitted to a density from (n, p) points of a first proposal with their (n,) log densities, and the number
    of evaluations. The first Gaussian is defensive, with mean and covariance of all the weighted points."""
    # log of the sum over all proposals of their number of points times their density at a point
    n, log_share = len(theta), first.log_density(theta) + np.log(len(theta))
    weight, _ = smooth_weights(log_target - log_share)
    mean = weight @ theta
    covariance = _covariance(theta, weight, mean)
    means, covariances = [mean], [covariance]
    for number in range(1, MOST_ADDED + 1):
        weight, shape = smooth_weights(log_target - log_share)
        if 1.0 / np.sum(weight**2) > ENOUGH * len(theta) and shape <= LIGHT_TAIL:
            break
        centre = theta[np.argmax(log_target - log_share)]
        means.append(centre)
        # covariance of the nearest points, weighted half by their weights and half equally
        z = np.linalg.solve(np.linalg.cholesky(covariance), (theta - centre).T)
        nearest = np.argsort(np.sum(z**2, axis=0), kind="stable")[:ADDED]
        mixed_weight = weight[nearest] + 1.0 / len(theta)
        near = _covariance(theta[nearest], mixed_weight / mixed_weight.sum(), centre)
        covariances.append(near + LEAST_VARIANCE * covariance)
        points = centre + rng.standard_normal((ADDED, len(centre))) @ np.linalg.cholesky(covariances[-1]).T
        added = Gaussians.single(centre, covariances[-1])
        log_share = np.logaddexp(log_share, np.log(ADDED) + added.log_density(theta))
        earlier = Gaussians(np.full(number, 1.0 / number), np.array(means[1:]), np.array(covariances[1:]))
        log_share_of_added = np.log(ADDED * number) + earlier.log_density(points)
        log_share = np.concatenate([log_share, np.logaddexp(np.log(n) + first.log_density(points), log_share_of_added)])
        theta, log_target = np.concatenate([theta, points]), np.concatenate([log_target, log_density(points)])
    n_points = np.array([n, *[ADDED] * (len(means) - 1)], dtype=np.float64)
    return Gaussians(n_points / n_points.sum(), np.array(means), np.array(covariances)), ADDED * (len(means) - 1)


def _covariance(theta: FloatArray, weight: FloatArray, centre: FloatArray) -> FloatArray:
    off = theta - centre
    return np.asarray((weight[:, None] * off).T @ off)


# --- Importance sampling by randomised quasi-Monte Carlo about the mode, doubled until interval ends are accurate.

STRETCH, WIDE_STRETCH = 0.45, 0.8
"""Bend b of the proposal's tails, see `Proposal`. For densities with tails like a t the wide one needs a quarter of the
points."""
HEAVY_TAIL = 0.3  #: Pareto shape of the first points' weights above which the wide proposal is taken.
TOO_WIDE = 2.0
"""Where a part of the density has this many times the variance of the single Gaussian, weights under that have infinite
variance: the proposal has a Gaussian for each part."""
ADAPTED_FROM = 1024  #: Points per replicate from which a mixture is fitted where the weights cannot be trusted.
POOR = 0.5  #: Below this share of effective draws the proposal is moved to the weighted moments of the points so far.
FITTED_AT = 4096
"""Points per replicate at which a mixture is fitted where the error is not reached: more points are seldom cheaper."""
NEAR_ENOUGH = 3.0
"""Times the requested error that is accepted of trusted weights where a fitted proposal is worse: of chains, which come
next, five times is requested."""
MOST_MOVES = 4
LEAST_KEPT = 8192  #: Least number of equal-weight draws returned; twice the points where that is more.
HEAVY_POINTS, HEAVY = 2048, 0.1
"""Points per replicate from which a Pareto shape this much above `TRUSTED_SHAPE` ends the sampling."""


class ImportanceOptions(Record):
    """Stopping rule of importance sampling."""

    accuracy_sd: float = 0.02  #: Monte-Carlo error of the ends of a 95 % interval to reach, in posterior SDs.
    first: int = 256  #: Points per replicate to begin with.
    most: int = 16384  #: Largest number of points per replicate.


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

    The proposal has the (p,) mode and (p, p) covariance, or is a mixture of `parts` where one of them is `TOO_WIDE` for
    that; its points are a Sobol set under random digital shifts. Parameters that matter most come first: there a Sobol
    set is most even. `NotConvergedError` when the weights cannot be trusted even for a mixture fitted to the points
    (`fitted_gaussians`), or the error is not reached.
    """
    options = options or ImportanceOptions()
    gaussians = Gaussians.single(mode, covariance)
    if parts is not None and parts.widest(covariance) > TOO_WIDE:
        gaussians = parts
    sampler = _sample_until_accurate(_adapted_start(log_density, gaussians, rng=rng, options=options), options)
    number = max(LEAST_KEPT, 2 * sampler.number)
    index = systematic(sampler.weights, number, rng)
    log_evidence, log_evidence_error = sampler.log_evidence()
    figures = {
        "pareto_k": float(sampler.shape),
        "end_error_sd": sampler.error,
        "evaluations": float(sampler.evaluations),
        "effective_draws": float(1.0 / np.sum(sampler.weights**2)),
        "log_evidence": log_evidence,
        "log_evidence_error": log_evidence_error,
        "draws": float(number),
    }
    lp, log_weight = sampler.log_target.ravel()[index], sampler.log_weights.ravel()[index] - log_evidence
    statistics = {"lp": lp[None], "log_weight": log_weight[None]}
    labels = index // sampler.points
    return draws.ParameterDraws(sampler.theta[index][None], "importance", figures, labels, statistics)


def _sample_until_accurate(sampler: _Sampler, options: ImportanceOptions) -> _Sampler:
    """Extend until the error is reached, or else replace the proposal by a mixture fitted to the points; where that is
    worse, extend the first one if its weights can be trusted."""
    accuracy_sd = options.accuracy_sd
    if sampler.extended(accuracy_sd, most=min(FITTED_AT, options.most), patience=ADAPTED_FROM).reached(accuracy_sd):
        return sampler
    mixture = sampler.adapted()
    mixture.extend(ADAPTED_FROM)
    # a fitted proposal may take twice the points: chains, which come next, are asked for a fifth of the accuracy
    if mixture.extended(accuracy_sd, most=2 * options.most, patience=HEAVY_POINTS, heavy=HEAVY).reached(accuracy_sd):
        return mixture
    if sampler.shape <= TRUSTED_SHAPE:
        sampler.extended(accuracy_sd, most=options.most, patience=ADAPTED_FROM)
        if sampler.reached(NEAR_ENOUGH * accuracy_sd):
            return sampler
    raise NotConvergedError(
        f"importance sampling stopped at {mixture.number} points with an end-point error of {mixture.error:.3f} SD "
        f"(wanted {accuracy_sd:g}) and Pareto shape {mixture.shape:.2f} (wanted {TRUSTED_SHAPE:g} or less); "
        "use --method ensemble",
        diagnostics={"pareto_k": float(mixture.shape), "end_error_sd": mixture.error},
    )


def _adapted_start(
    log_density: LogDensity, gaussians: Gaussians, *, rng: np.random.Generator, options: ImportanceOptions
) -> _Sampler:
    """First points, from a proposal that is widened or moved while it is poor."""
    earlier, stretch = 0, STRETCH
    for _ in range(MOST_MOVES):
        sampler = _Sampler(log_density, gaussians, stretch=stretch, rng=rng, earlier=earlier)
        sampler.extend(options.first)
        weights = sampler.weights
        if not np.isfinite(weights).all():
            raise NotConvergedError(
                "importance sampling found no density about the mode; use --method ensemble",
                diagnostics={"pareto_k": float("nan")},
            )
        if sampler.shape > HEAVY_TAIL and stretch < WIDE_STRETCH:
            stretch, earlier = WIDE_STRETCH, sampler.evaluations
            continue
        if 1.0 / np.sum(weights**2) > POOR * sampler.number:
            break
        centre = weights @ sampler.theta
        covariance = _covariance(sampler.theta, weights, centre)
        if not np.linalg.eigvalsh(covariance)[0] > 1e-6 * np.linalg.eigvalsh(gaussians.covariance[0])[0]:
            break
        gaussians, earlier = Gaussians.single(centre, covariance), sampler.evaluations
    return sampler


class _Sampler:
    """Points with densities and smoothed weights, by replicate: independent shifts of the Sobol set, whose spread gives
    the Monte-Carlo error."""

    weights: FloatArray  #: (n,) smoothed weights of all points.
    shape: float  #: Pareto shape of their tail.
    error: float  #: Largest Monte-Carlo error, over the parameters, of a 95 % interval's ends, in SDs; see `extended`.

    def __init__(
        self, log_density: LogDensity, gaussians: Gaussians, *, stretch: float, rng: np.random.Generator, earlier: int
    ) -> None:
        self._log_density, self._rng, self._earlier = log_density, rng, earlier
        self._proposal = Proposal(gaussians, stretch)
        self._shifts = rng.integers(2**draws.BITS, size=(draws.REPLICATES, self._proposal.dimension), dtype=np.uint32)
        self._theta = np.empty((draws.REPLICATES, 0, gaussians.mean.shape[1]))
        self.log_target, self.log_weights = np.empty((draws.REPLICATES, 0)), np.empty((draws.REPLICATES, 0))

    def adapted(self) -> _Sampler:
        """Sampler without points whose proposal is fitted to these points."""
        points = self.theta, self.log_target.ravel()
        gaussians, evaluations = fitted_gaussians(self._log_density, self._proposal, *points, rng=self._rng)
        earlier = self.evaluations + evaluations
        return _Sampler(self._log_density, gaussians, stretch=STRETCH, rng=self._rng, earlier=earlier)

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
        return self._earlier + self.number

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
        """Double the points until the error is reached or they are `most` per replicate; from `patience` on, also end
        where the shape is `heavy` above the trusted one."""
        while True:
            # the spread of four replicates misses rare large weights: 0.036 SD was seen for 0.015
            self.error = self._end_error() * (1.0 + max(self.shape, 0.0) if np.isfinite(self.shape) else 1.0)
            # a shape of NaN is no trusted one, and -inf, of equal weights, is
            hopeless = self.points >= patience and not self.shape - heavy <= TRUSTED_SHAPE
            if self.reached(accuracy_sd) or self.points >= most or hopeless:
                return self
            self.extend(self.points)

    def reached(self, accuracy_sd: float) -> bool:
        """True where the weights can be trusted and the error is no larger than this."""
        return self.shape <= TRUSTED_SHAPE and self.error <= accuracy_sd

    def log_evidence(self) -> tuple[float, float]:
        """Log of the integral of exp(log density), and its standard error, from the replicates."""
        by_replicate = np.logaddexp.reduce(self.log_weights, axis=1)
        share = np.exp(by_replicate - by_replicate.max())
        error = float(share.std(ddof=1) / share.mean() / np.sqrt(len(share)))
        return float(np.logaddexp.reduce(self.log_weights.ravel()) - np.log(self.number)), error

    def _end_error(self) -> float:
        """Largest Monte-Carlo error of a 95 % interval's ends over the parameters, in SDs, between the replicates."""
        by_replicate, tails = self.weights.reshape(self.log_weights.shape), np.array([0.025, 0.975])
        worst = 0.0
        for i in range(self._theta.shape[2]):
            values = self._theta[:, :, i]
            mean = float(np.sum(self.weights * values.ravel()))
            sd = float(np.sqrt(np.sum(self.weights * (values.ravel() - mean) ** 2)))
            order = np.argsort(values, axis=1)
            ordered, weights = (np.take_along_axis(array, order, axis=1) for array in (values, by_replicate))
            ends = [draws.weighted_quantiles_of(v, w, tails) for v, w in zip(ordered, weights, strict=True)]
            error = float(np.sqrt(np.mean(np.var(ends, axis=0, ddof=1)) / len(ends)))
            worst = max(worst, error / sd if sd > 0 else 0.0)
        return worst


def systematic(weights: FloatArray, number: int, rng: np.random.Generator) -> IndexArray:
    """Indices of `number` equal-weight draws by systematic resampling, then shuffled."""
    edges = np.cumsum(weights) / weights.sum()
    index = np.searchsorted(edges, (np.arange(number) + rng.uniform()) / number)
    return np.asarray(rng.permutation(np.minimum(index, len(weights) - 1)))
