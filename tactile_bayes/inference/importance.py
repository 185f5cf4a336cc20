"""Importance sampling by randomised quasi-Monte Carlo about the mode, doubled until interval ends are accurate."""

from __future__ import annotations

import numpy as np

from tactile_bayes.errors import NotConvergedError
from tactile_bayes.geometry import FloatArray
from tactile_bayes.inference.adaptation import fitted_gaussians
from tactile_bayes.inference.draws import REPLICATES, ParameterDraws
from tactile_bayes.inference.laplace import LogDensity
from tactile_bayes.inference.pareto import TRUSTED_SHAPE, smooth_weights
from tactile_bayes.inference.proposal import Gaussians, Proposal
from tactile_bayes.inference.sobol import BITS, shifted_sobol
from tactile_bayes.inference.summary import weighted_quantiles_of
from tactile_bayes.records import dataclass

STRETCH, WIDE_STRETCH = 0.45, 0.8
"""Bend of the proposal's tails, see `Proposal`. The wide one is for densities with tails like a t: from a few thousand
points it needs a quarter of the narrow one's."""
HEAVY_TAIL = 0.3
"""Pareto shape of the first points' weights above which the wide proposal is taken."""
TOO_WIDE = 2.0
"""A part of the density with this many times the variance of one Gaussian gives weights of infinite variance under it:
then the proposal has a Gaussian for each part."""
ADAPTED_FROM = 1024
"""Points a replicate from which a tail heavier than trusted lets a mixture be fitted to them."""
POOR = 0.5
"""Below this share of effective draws the proposal is moved to the weighted moments of the points so far."""
NEAR_ENOUGH = 3.0
"""Points whose weights can be trusted stand at so many times the wanted error, where a fitted proposal is worse: chains
are asked for five times it."""
MOST_MOVES = 4
LEAST_KEPT = 8192
"""Equal-weight draws returned, at least: twice the points where those are more."""
HEAVY_POINTS, HEAVY = 2048, 0.1
"""With as many points a replicate and a tail heavier than trusted by this, more points do not help."""


@dataclass(frozen=True, slots=True)
class ImportanceOptions:
    """Stopping rule of importance sampling.

    Parameters
    ----------
    accuracy_sd
        Wanted Monte-Carlo error of the ends of a 95 % interval, in posterior standard deviations.
    first, most
        Points of a replicate to begin with, and at most.
    """

    accuracy_sd: float = 0.02
    first: int = 256
    most: int = 16384


def importance_options(accuracy_sd: float | None) -> ImportanceOptions:
    """The default options, with another accuracy if given."""
    return ImportanceOptions() if accuracy_sd is None else ImportanceOptions(accuracy_sd=accuracy_sd)


def importance(
    log_density: LogDensity,
    mode: FloatArray,
    covariance: FloatArray,
    *,
    rng: np.random.Generator,
    options: ImportanceOptions | None = None,
    parts: Gaussians | None = None,
) -> ParameterDraws:
    """Draw from a log density by importance sampling; returns draws of equal weight.

    Parameters
    ----------
    log_density
        Vectorised: (m, p) to (m,).
    mode, covariance : (p,), (p, p) arrays
        Of the proposal.
    parts
        Gaussians that the density is about a mixture of. They are the proposal where one of them is `TOO_WIDE` for the
        one above.

    Raises
    ------
    NotConvergedError
        When the weights' tail is too heavy, or the error is not reached; `ensemble` is the next method to try.

    Notes
    -----
    The points are a Sobol set under random digital shifts. The proposal is smooth, close to a normal in its middle and
    wider in its tails, so that the points stay even and the weights bounded where the density falls a little more
    slowly than a normal. Put the parameters that matter first: a Sobol set fills its first coordinates most evenly,
    and the proposal's root is triangular. Where the weights' tail stays too heavy a mixture is fitted to the points
    (`fitted_gaussians`), once, and new points are drawn from it.
    """
    options = options or ImportanceOptions()
    gaussians = Gaussians.one(mode, covariance)
    if parts is not None and parts.widest(covariance) > TOO_WIDE:
        gaussians = parts
    sampler, weights, shape, error = _sampled(
        _settled(log_density, gaussians, rng=rng, options=options), rng=rng, options=options
    )
    keep = max(LEAST_KEPT, 2 * sampler.number)
    chosen = systematic(weights, keep, rng)
    figures = {
        "pareto_k": float(shape),
        "end_error_sd": error,
        "evaluations": float(sampler.evaluations),
        "effective_draws": float(1.0 / np.sum(weights**2)),
        "log_evidence": sampler.log_evidence(),
        "log_evidence_error": sampler.log_evidence_error(),
        "draws": float(keep),
    }
    labels = chosen // sampler.points
    statistics = {name: values[chosen][None] for name, values in sampler.statistics().items()}
    return ParameterDraws(sampler.theta[chosen][None], "importance", figures, labels=labels, statistics=statistics)


def _sampled(
    sampler: _Sampler, *, rng: np.random.Generator, options: ImportanceOptions
) -> tuple[_Sampler, FloatArray, float, float]:
    """More points until the error is reached, once from a proposal fitted to them; with weights, shape and error.

    Where the fitted proposal turns out worse than the first one, the first one's points stand if they can be trusted.
    """
    first: tuple[_Sampler, FloatArray, float, float] | None = None
    adapted = False
    while True:
        weights, shape = sampler.weights()
        # a few replicates' spread misses what a heavy tail does now and then: 0.036 SD was seen where they said 0.015
        error = sampler.end_error(weights) * (1.0 + max(shape, 0.0) if np.isfinite(shape) else 1.0)
        trusted = (np.isfinite(shape) and shape <= TRUSTED_SHAPE) or shape == -np.inf
        if trusted and error <= options.accuracy_sd:
            return sampler, weights, shape, error
        if not adapted and (sampler.points >= options.most or (sampler.points >= ADAPTED_FROM and not trusted)):
            if trusted and error <= NEAR_ENOUGH * options.accuracy_sd:
                first = sampler, weights, shape, error
            sampler, adapted = sampler.adapted(rng), True
            sampler.extend(ADAPTED_FROM)
            continue
        hopeless = sampler.points >= HEAVY_POINTS and not (shape <= TRUSTED_SHAPE + HEAVY)
        # a fitted proposal may take twice the points: chains, which come next, are asked for a fifth of the accuracy
        if sampler.points >= 2 * options.most or hopeless:
            if first is not None:
                return first
            raise NotConvergedError(
                f"importance sampling stopped at {sampler.number} points with an end-point error of {error:.3f} SD "
                f"(wanted {options.accuracy_sd:g}) and Pareto shape {shape:.2f} (wanted {TRUSTED_SHAPE:g} or less); "
                "use --method ensemble",
                diagnostics={"pareto_k": float(shape), "end_error_sd": error},
            )
        sampler.extend(sampler.points)


def _settled(
    log_density: LogDensity, gaussians: Gaussians, *, rng: np.random.Generator, options: ImportanceOptions
) -> _Sampler:
    """First points, from a proposal that is adapted while it is poor."""
    spent, stretch = 0, STRETCH
    for _ in range(MOST_MOVES):
        sampler = _Sampler(log_density, gaussians, stretch=stretch, rng=rng, spent=spent)
        sampler.extend(options.first)
        weights, shape = sampler.weights()
        if not np.isfinite(weights).all():
            raise NotConvergedError(
                "importance sampling found no density about the mode; use --method ensemble",
                diagnostics={"pareto_k": float("nan")},
            )
        if shape > HEAVY_TAIL and stretch < WIDE_STRETCH:
            stretch, spent = WIDE_STRETCH, sampler.evaluations
            continue
        if 1.0 / np.sum(weights**2) > POOR * sampler.number:
            break
        moved = sampler.theta - weights @ sampler.theta
        about = (weights[:, None] * moved).T @ moved
        if not np.linalg.eigvalsh(about)[0] > 1e-6 * np.linalg.eigvalsh(gaussians.covariance[0])[0]:
            break
        gaussians, spent = Gaussians.one(weights @ sampler.theta, about), sampler.evaluations
    return sampler


class _Sampler:
    """Points with densities and weights, in order of the replicates.

    Replicates are independent random shifts of the point set; their spread is the error.
    """

    def __init__(
        self, log_density: LogDensity, gaussians: Gaussians, *, stretch: float, rng: np.random.Generator, spent: int
    ) -> None:
        p = gaussians.mean.shape[1]
        self._log_density = log_density
        self._proposal = Proposal(gaussians, stretch)
        self._shifts = rng.integers(2**BITS, size=(REPLICATES, self._proposal.dimension), dtype=np.uint32)
        self._spent = spent
        self._theta = np.empty((REPLICATES, 0, p))
        self._log_target = np.empty((REPLICATES, 0))
        self._log_weights = np.empty((REPLICATES, 0))

    def adapted(self, rng: np.random.Generator) -> _Sampler:
        """One whose proposal is fitted to these points, without points."""
        gaussians, spent = fitted_gaussians(
            self._log_density, self._proposal, self.theta, self._log_target.ravel(), rng=rng
        )
        return _Sampler(self._log_density, gaussians, stretch=STRETCH, rng=rng, spent=self.evaluations + spent)

    @property
    def number(self) -> int:
        """Number of points in all replicates."""
        return self._log_weights.size

    @property
    def points(self) -> int:
        """Number of points per replicate."""
        return self._log_weights.shape[1]

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
        theta, log_proposal = self._proposal.points(shifted_sobol(self.points, points, shifts=self._shifts))
        log_target = self._log_density(theta.reshape(-1, theta.shape[2])).reshape(theta.shape[:2])
        self._theta = np.concatenate([self._theta, theta], axis=1)
        self._log_target = np.concatenate([self._log_target, log_target], axis=1)
        self._log_weights = np.concatenate([self._log_weights, log_target - log_proposal], axis=1)

    def weights(self) -> tuple[FloatArray, float]:
        """Smoothed weights of all points, and the Pareto shape of their tail."""
        return smooth_weights(self._log_weights.ravel())

    def statistics(self) -> dict[str, FloatArray]:
        """Log density and log weight of all points, the weights' mean 1."""
        log_weight = self._log_weights.ravel()
        return {"lp": self._log_target.ravel(), "log_weight": log_weight - self.log_evidence()}

    def log_evidence(self) -> float:
        """Log of the integral of exp(log density)."""
        flat = self._log_weights.ravel()
        return float(np.logaddexp.reduce(flat) - np.log(len(flat)))

    def log_evidence_error(self) -> float:
        """Standard error of `log_evidence`, from the replicates."""
        each = np.logaddexp.reduce(self._log_weights, axis=1)
        share = np.exp(each - each.max())
        return float(share.std(ddof=1) / share.mean() / np.sqrt(len(share)))

    def end_error(self, weights: FloatArray) -> float:
        """Largest Monte-Carlo error, over the parameters, of a 95 % interval's ends, in SDs."""
        by_replicate = weights.reshape(self._log_weights.shape)
        worst = 0.0
        for i in range(self._theta.shape[2]):
            values = self._theta[:, :, i]
            mean = float(np.sum(weights * values.ravel()))
            sd = float(np.sqrt(np.sum(weights * (values.ravel() - mean) ** 2)))
            ends = [weighted_quantile(v, w, (0.025, 0.975)) for v, w in zip(values, by_replicate, strict=True)]
            error = float(np.sqrt(np.mean(np.var(ends, axis=0, ddof=1)) / len(ends)))
            worst = max(worst, error / sd if sd > 0 else 0.0)
        return worst


def weighted_quantile(values: FloatArray, weights: FloatArray, probabilities: tuple[float, ...]) -> FloatArray:
    """Quantiles of weighted draws, linear between the midpoints of their steps."""
    order = np.argsort(values)
    return weighted_quantiles_of(values[order], weights[order], np.array(probabilities))


def systematic(
    weights: FloatArray, number: int, rng: np.random.Generator
) -> np.ndarray[tuple[int, ...], np.dtype[np.intp]]:
    """Indices of `number` equal-weight draws by systematic resampling, then shuffled."""
    edges = np.cumsum(weights) / weights.sum()
    index = np.searchsorted(edges, (np.arange(number) + rng.uniform()) / number)
    return np.asarray(rng.permutation(np.minimum(index, len(weights) - 1)))
