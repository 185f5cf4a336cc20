"""Posterior draws of a scene by the chosen method, or by the next one if its diagnostics fail."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from typing import Literal, assert_never

import numpy as np

from tactile_bayes.declarations import Record, as_dict, replace
from tactile_bayes.errors import NotConvergedError
from tactile_bayes.geometry import FloatArray
from tactile_bayes.inference.draws import END_ERROR, INDEPENDENT_DRAWS, ParameterDraws, Solved, distinct_rows
from tactile_bayes.inference.importance import TRUSTED_SHAPE, Gaussians, importance, importance_options, smooth_weights
from tactile_bayes.posterior.fit import FieldFit, laplace_mixture, newton_mixture
from tactile_bayes.posterior.marginal import NEGLIGIBLE
from tactile_bayes.posterior.options import EstimateOptions

Sampler = Literal["laplace", "importance", "ensemble"]
LADDER: tuple[Sampler, ...] = ("laplace", "importance", "ensemble")
STEPS_UP = 1
"""Methods tried after the requested one: a user who wants a quick one does not wait minutes for chains."""
DISAGREEMENT = 5.0
"""Ends of intervals by two methods differ by more than this many of their joint Monte-Carlo errors: one is wrong."""
START_ACCURACY_SD = 0.05
CHECKED = 512
"""Draws of the Gaussians that are weighed to judge them."""
Progress = Callable[[int, int], None]


def accuracy_in_sd(fit: FieldFit, options: EstimateOptions) -> float | None:
    """Requested accuracy in posterior SDs of this fit's widths; the finer of SD and mm counts."""
    if options.accuracy_mm is None:
        return options.accuracy_sd
    return min(max(options.accuracy_mm / width_sd_mm(fit), 1e-3), options.accuracy_sd or 0.5)


def width_sd_mm(fit: FieldFit) -> float:
    """Posterior SD of the less certain width, from the Gaussian approximation."""
    names = [name for name in ("u", "v") if name in fit.scene.names]
    return max(fit.sd(name) * float(np.exp(fit.scene.column(fit.mode, name))) for name in names)


def draw_scene(
    fit: FieldFit,
    options: EstimateOptions,
    *,
    rng: np.random.Generator,
    progress: Progress | None = None,
    solved: Solved | None = None,
) -> tuple[ParameterDraws, tuple[str, ...]]:
    """Draw by the requested method, or by the next one if its diagnostics fail; says what was wrong with those before
    it.

    Importance sampling leaves what it solved in `solved`, for `CollapsedTarget.draw_linear`. `NotConvergedError` when
    the last method does not converge either; its message says what was wrong with each.
    """
    passed_over: list[str] = []
    figures: Mapping[str, float] = {}
    first = LADDER.index(options.method)
    steps = STEPS_UP if options.step_up else 0
    for name in LADDER[first : first + steps + 1]:
        try:
            draws = _draw(fit, name, rng=rng, options=options, progress=progress, solved=solved)
        except NotConvergedError as error:
            passed_over.append(f"{name}: {error}")
            figures = error.diagnostics
            continue
        figures = draws.diagnostics
        shape = figures.get("pareto_k", 0.0)
        if shape == -np.inf or shape <= TRUSTED_SHAPE:
            return with_end_error(fit, draws), tuple(passed_over)
        passed_over.append(f"{name}: Pareto shape {shape:.2f} (trusted up to {TRUSTED_SHAPE:g})")
    raise NotConvergedError("; ".join(passed_over), diagnostics=dict(figures))


def _draw(
    fit: FieldFit,
    method: Sampler,
    *,
    rng: np.random.Generator,
    options: EstimateOptions,
    progress: Progress | None,
    solved: Solved | None,
) -> ParameterDraws:
    if method == "laplace":
        return judged_laplace(fit, rng=rng, draws=options.draws)
    accuracy = accuracy_in_sd(fit, options)
    density = Sampled.of(fit)
    match method:
        case "importance":
            draws = importance_draws(density.keeping(solved), rng=rng, accuracy_sd=accuracy)
        case "ensemble":
            draws = ensemble_draws(density, rng=rng, accuracy_sd=accuracy, options=options, progress=progress)
        case _:
            assert_never(method)
    return density.finished(draws, rng)


def judged_laplace(fit: FieldFit, *, rng: np.random.Generator, draws: int = INDEPENDENT_DRAWS) -> ParameterDraws:
    """Draw from the Gaussian mixture, with the Pareto shape of its importance weights."""
    drawn = laplace_mixture(fit, rng=rng, draws=draws)
    some = drawn.flat[:CHECKED]
    _, shape = smooth_weights(fit.target(some) - fit.mixture.log_density(some))
    return replace(drawn, diagnostics=dict(drawn.diagnostics) | {"pareto_k": float(shape)})


class Sampled(Record, eq=False):
    """Density to be sampled: the bump's parameters, with a second structure's fixed at their mode.

    A rib whose crest lies outside the window shows a flank only: its place and width trade against each other along a
    curve that no sampler follows cheaply and that hardly concerns the bump. What that costs the bump in certainty is
    added afterwards, as large as the Gaussians have it.
    """

    fit: FieldFit
    mean: FloatArray
    covariance: FloatArray
    """`mean`, `covariance` (k,), (k, k) arrays: About, for the density."""
    beside: FloatArray
    """(j,) array: The second structure's parameters."""
    spread: FloatArray
    """(k, k) array: Root of the covariance that the second structure's uncertainty adds."""
    parts: Gaussians | None = None
    """A Gaussian for each noise field, also for those with little share of the density at the mode: under strongly
    correlated errors the widths are less certain, so that a field with 0.3 % of the density there had 4 % of the
    posterior, and all of its tails. None where one of them has no maximum.
    """
    solved: Solved | None = None
    """Where solutions are kept; None keeps none."""

    @classmethod
    def of(cls, fit: FieldFit) -> Sampled:
        """Prepare from a fit; without a second structure the density is the fit's own."""
        mean, covariance = fit.mixture.moments()
        k = len(fit.scene.alone().names)
        parts = newton_mixture(fit.target, fit.mode, fit.covariance, least_share=NEGLIGIBLE)
        if k == len(mean):
            return cls(fit, mean, covariance, np.zeros(0), np.zeros((k, k)), parts)
        across = covariance[:k, k:]
        added = across @ np.linalg.solve(covariance[k:, k:], across.T)
        values, vectors = np.linalg.eigh(0.5 * (added + added.T))
        spread = vectors * np.sqrt(np.clip(values, 0.0, None))
        given = None if parts is None else parts.given(fit.mode[k:])
        return cls(fit, fit.mode[:k], covariance[:k, :k] - added, fit.mode[k:], spread, given)

    def __call__(self, theta: FloatArray) -> FloatArray:
        """(m,) log density of (m, k) parameters of the bump."""
        if self.solved is None:
            return self.fit.target(self.whole(theta))
        return self.fit.target.solved_density(theta, self.solved)

    def keeping(self, solved: Solved | None) -> Sampled:
        """The same density, storing its solutions in `solved` if draws will be evaluated points."""
        return self if len(self.beside) else replace(self, solved=solved)

    def whole(self, theta: FloatArray) -> FloatArray:
        """(..., p) parameters of the whole scene."""
        return np.concatenate([theta, np.broadcast_to(self.beside, (*theta.shape[:-1], len(self.beside)))], axis=-1)

    def finished(self, draws: ParameterDraws, rng: np.random.Generator) -> ParameterDraws:
        """Draws of the whole scene, from draws of the sampled density."""
        if not len(self.beside):
            return draws
        # copies of a resampled point move together: each new point costs a linear solution
        points, back = distinct_rows(draws.flat)
        moved = (points + rng.standard_normal(points.shape) @ self.spread.T)[back]
        return replace(draws, theta=self.whole(moved).reshape(*draws.theta.shape[:2], -1))


def importance_draws(density: Sampled, *, rng: np.random.Generator, accuracy_sd: float | None = None) -> ParameterDraws:
    """Draw by importance sampling from the Gaussians' common mean and covariance, or from each of them."""
    options = importance_options(accuracy_sd)
    return importance(density, density.mean, density.covariance, rng=rng, options=options, parts=density.parts)


def ensemble_draws(
    density: Sampled,
    *,
    rng: np.random.Generator,
    options: EstimateOptions,
    accuracy_sd: float | None = None,
    progress: Progress | None = None,
) -> ParameterDraws:
    """Draw by MCMC, starting from importance draws.

    `NotConvergedError` when the chains do not agree with each other, or not with the importance draws.
    """
    from tactile_bayes.inference.ensemble import EnsembleOptions, ensemble

    settings = EnsembleOptions()
    if options.max_steps is not None:
        settings = replace(settings, max_steps=options.max_steps)
    if accuracy_sd is not None:
        settings = replace(settings, least_ess=(END_ERROR / accuracy_sd) ** 2)
    key = checkpoint_key(density.fit, settings.identity(), rng)
    start = _start(density, rng)
    draws = ensemble(
        density,
        density.mean,
        density.covariance,
        rng=rng,
        options=settings,
        progress=progress,
        start=None if start is None else start.flat,
        store=options.store,
        key=key,
    )
    if start is None:
        return draws
    gap = disagreement(draws, start)
    if gap > DISAGREEMENT:
        raise NotConvergedError(
            f"ensemble and importance sampling disagree: an interval's end by {gap:.1f} of its Monte-Carlo errors "
            f"(at most {DISAGREEMENT:g} is chance)",
            diagnostics=dict(draws.diagnostics) | {"disagreement": gap},
        )
    return replace(draws, diagnostics=dict(draws.diagnostics) | {"disagreement": gap})


def _start(density: Sampled, rng: np.random.Generator) -> ParameterDraws | None:
    try:
        return importance_draws(density, rng=rng, accuracy_sd=START_ACCURACY_SD)
    except NotConvergedError:
        return None


def disagreement(chains: ParameterDraws, weighted: ParameterDraws) -> float:
    """Largest difference of the ends of 95 % intervals over the parameters, in joint Monte-Carlo errors."""
    sd = weighted.flat.std(axis=0)
    one, other = (np.quantile(draws.flat, [0.025, 0.975], axis=0) for draws in (chains, weighted))
    mine = END_ERROR / np.sqrt(min(chains.diagnostics["ess_tail"], chains.diagnostics["ess_bulk"]))
    theirs = weighted.diagnostics["end_error_sd"]
    return float((np.abs(one - other) / sd).max() / np.hypot(mine, theirs))


def with_end_error(fit: FieldFit, draws: ParameterDraws) -> ParameterDraws:
    """Add the Monte-Carlo error of interval ends in SDs and mm (of the Gaussians: their bias is not included)."""
    found = dict(draws.diagnostics)
    found.setdefault("end_error_sd", END_ERROR / float(np.sqrt(draws.effective_draws)))
    return replace(draws, diagnostics=found | {"end_error_mm": found["end_error_sd"] * width_sd_mm(fit)})


def checkpoint_key(fit: FieldFit, settings: str, rng: np.random.Generator) -> str:
    """Hash of everything that a chain depends on: cells, scene, priors, fields, settings and seed."""
    target = fit.target
    digest = hashlib.sha256()
    cells = target.window.cells
    arrays = [cells.x_mm, cells.y_mm, cells.value, cells.count, target.window.variance, fit.mode, fit.covariance]
    arrays += [] if target.problem.departure is None else [target.problem.departure]
    for values in arrays:
        digest.update(np.ascontiguousarray(values, dtype="<f8").tobytes())
    said = {
        "scene": as_dict(fit.scene),
        "prior": as_dict(target.problem.prior),
        "scale": target.problem.amplitude_scale,
        "bounds": [target.problem.widest_mm, target.problem.radius_mm],
        "fields": target.chosen_fields(),
        "cosines": target.window.cosines,
        "pose_noise": None if cells.pose_noise is None else as_dict(cells.pose_noise),
        "settings": settings,
        "rng": str(rng.bit_generator.state),
    }
    digest.update(json.dumps(said, sort_keys=True).encode())
    return digest.hexdigest()
