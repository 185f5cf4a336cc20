"""Settings of the sampler, and draws of a bump under either noise model by the requested method or the next one."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from typing import Any, Protocol

import numpy as np

from tactile_bayes.declarations import Record, field, names_of, replace
from tactile_bayes.errors import NotConvergedError, UsageError
from tactile_bayes.geometry import FloatArray
from tactile_bayes.inference.draws import END_ERROR, INDEPENDENT_DRAWS, ParameterDraws, SolutionCache, distinct_rows
from tactile_bayes.inference.ensemble import EnsembleOptions, ensemble
from tactile_bayes.inference.importance import TRUSTED_SHAPE, Gaussians, ImportanceOptions, importance
from tactile_bayes.inference.modes import LogDensity
from tactile_bayes.options import FitSettings
from tactile_bayes.presets import FIT_RADIUS_MM, Background, Method, Noise, Rotation, SceneName
from tactile_bayes.progress import Progress
from tactile_bayes.size.draws import BUMP, BumpDraws
from tactile_bayes.size.pooling import SizePriors

# --- Settings of the sampler, and their check.

DETECTED = 0.95
"""Evidence for a bump against smooth errors, as a probability at even odds, below which there is no estimate."""
ROTATION_ODDS = 3.0  #: Odds above which a rotated ellipse is used instead of one along the head's axes.


class SamplerSettings(FitSettings, kw_only=True):
    """Settings of the sampler: the user's with all defaults resolved, and some that users do not set."""

    background: Background = "fixed"
    fit_radius_mm: float = FIT_RADIUS_MM
    noise: Noise = "independent"
    start_width_mm: float | None = None
    """Width of the bump in an earlier fit of the same place; None starts from `START_WIDTHS_MM`."""
    size_priors: SizePriors = field(default_factory=SizePriors)
    """Priors of the size: spread between maps, shape of the lump; only a calibration over bodies uses them."""
    store: Any = None  #: `ChainStore` where an ensemble keeps its state between runs, under a noise field.
    draws: int = INDEPENDENT_DRAWS
    """Number of draws by ``laplace`` under a noise field; of 400 the interval ends have an error of 0.1 SD."""
    step_up: bool = True  #: Under a noise field: try the next method where the requested one fails.

    @property
    def requested_scene(self) -> SceneName:
        """The requested scene; where none is named, the rotation option decides."""
        by_rotation: dict[Rotation, SceneName] = {"on": "rotated", "off": "ellipse", "auto": "auto"}
        return by_rotation[self.rotation] if self.scene == "auto" else self.scene


def check_options(options: SamplerSettings) -> None:
    """`UsageError` for options that contradict each other."""
    if options.method in ("optimise", "laplace") and (options.accuracy_sd or options.accuracy_mm):
        fault = f"method {options.method} draws once, to no stated accuracy; leave out --accuracy-sd and accuracy_mm"
        raise UsageError(f"{fault}, or give --method importance")
    if not options.correlated:
        options_in_use = {
            "a scene": options.scene not in ("auto", "none"),
            "an accuracy in mm": options.accuracy_mm is not None,
            "a checkpoint": options.store is not None,
        }
        for name, in_use in options_in_use.items():
            if in_use:
                raise UsageError(f'{name} needs correlated errors; give noise = "field" in --settings FILE.toml')
        return
    if options.store is not None and options.method != "ensemble":
        raise UsageError("only the ensemble has checkpoints; give --method ensemble")
    if options.method == "optimise":
        raise UsageError(
            "optimise is the paper's least squares and has no noise field, with which this calibration was learned; "
            "give --method laplace, or a calibration learned by least squares"
        )
    if options.background != "free":
        raise UsageError('noise = "field" needs a free background; give background = "free" in --settings FILE.toml')


# --- Joint posterior draws, the result of every method and noise model.


class MapPosterior(BumpDraws, eq=False, kw_only=True):
    """Joint draws of the quantities in Eq 7, each (chain, draw)."""

    x_mm: FloatArray
    y_mm: FloatArray
    background: FloatArray
    noise_sd: FloatArray

    @property
    def medians(self) -> tuple[float, float, float]:
        """Posterior medians of amplitude, sigma_x_mm and sigma_y_mm."""
        amplitude, sigma_x, sigma_y = (float(np.median(getattr(self, name))) for name in BUMP[:3])
        return amplitude, sigma_x, sigma_y

    @property
    def middle(self) -> ModalBump:
        """The bump at the posterior medians."""
        return ModalBump(*(float(np.median(getattr(self, name))) for name in names_of(ModalBump)))


class ModalBump(Record):
    """The bump at the mode: its amplitude, its centre and its widths along the ellipse's axes."""

    amplitude: float
    x_mm: float
    y_mm: float
    sigma_x_mm: float
    sigma_y_mm: float


# --- Posterior draws of a bump under either noise model, by the requested method or the next one where it fails.

METHOD_ORDER: tuple[Method, ...] = ("laplace", "importance", "ensemble")
DISAGREEMENT = 5.0
"""Ends of intervals by two methods differ by more than this many of their joint Monte-Carlo errors: one is wrong."""
START_ACCURACY_SD = 0.05


class SamplingTarget(Record, eq=False):
    """Density of the bump's parameters to be sampled, with a second structure's parameters fixed at their mode.

    Offset and width of a rib that shows only a flank are correlated along a curve that no sampler follows cheaply; the
    variance that they add to the bump's parameters is taken from the Gaussian approximation.
    """

    log_density: LogDensity  #: (m,) of (m, k) parameters of the bump.
    mean: FloatArray
    covariance: FloatArray  #: (k,), (k, k) arrays: About those of the density.
    parts: Gaussians | None = None
    """A Gaussian for each noise field, down to small shares of the density at the mode: a field with 0.3 % there had
    4 % of the posterior, and all of its tails. None where one has no maximum, and under independent errors."""
    beside: FloatArray = field(default_factory=lambda: np.zeros(0))  #: (j,) array: The second structure's parameters.
    spread: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    """(k, k) array: Root of the covariance that the second structure's uncertainty adds."""
    checkpoint_key: Callable[[str, np.random.Generator], str] | None = None
    """Hash of all that chains depend on, from their settings and random numbers; None under independent errors, where
    chains start about the mode and are neither stored nor compared with importance draws."""

    def with_second_structure(self, draws: ParameterDraws, rng: np.random.Generator) -> ParameterDraws:
        """Draws of the whole scene, from draws of the sampled density."""
        if not len(self.beside):
            return draws
        # copies of a resampled point get the same shift: each new point costs a linear solution
        distinct, index = distinct_rows(draws.flat)
        moved = (distinct + rng.standard_normal(distinct.shape) @ self.spread.T)[index]
        return replace(draws, theta=with_beside(moved, self.beside).reshape(*draws.theta.shape[:2], -1))


def with_beside(theta: FloatArray, beside: FloatArray) -> FloatArray:
    """(..., p) parameters of the whole scene, from (..., k) of the bump and (j,) of the second structure."""
    return np.concatenate([theta, np.broadcast_to(beside, (*theta.shape[:-1], len(beside)))], axis=-1)


class FittedBump(Protocol):
    """A bump fitted under one noise model."""

    @property
    def width_sd_mm(self) -> float | None:
        """Posterior SD of the less certain width in mm; None where `accuracy_mm` is not supported."""

    def draw_at_mode(self, method: Method, number: int, rng: np.random.Generator) -> ParameterDraws:
        """Draw from the Gaussian approximation at the mode; under a noise field `number` draws."""

    def sampling_target(self, solved: SolutionCache | None = None) -> SamplingTarget:
        """The density to sample; it stores its solutions in `solved`, for methods whose draws are evaluated points."""


def draw_parameters(
    fit: FittedBump,
    options: SamplerSettings,
    *,
    rng: np.random.Generator,
    progress: Progress | None = None,
    solved: SolutionCache | None = None,
) -> tuple[ParameterDraws, tuple[str, ...]]:
    """Draw by the requested method, or by the next one if its diagnostics fail; and the faults of methods that failed.

    `NotConvergedError` with all faults when the last method fails, too.
    """
    passed_over: list[str] = []
    figures: Mapping[str, float] = {}
    accuracy = accuracy_in_sd(options, fit.width_sd_mm)
    for method in methods(options):
        try:
            if method in ("optimise", "laplace"):
                draws = fit.draw_at_mode(method, options.draws, rng)
            elif method == "importance":
                density = fit.sampling_target(solved)
                draws = density.with_second_structure(importance_draws(density, rng=rng, accuracy_sd=accuracy), rng)
            else:
                density = fit.sampling_target()
                chains = ensemble_draws(density, rng=rng, accuracy_sd=accuracy, options=options, progress=progress)
                draws = density.with_second_structure(chains, rng)
        except NotConvergedError as error:
            passed_over.append(f"{method}: {error}")
            figures = error.diagnostics
            continue
        figures = draws.diagnostics
        shape = figures.get("pareto_k", 0.0)
        if shape <= TRUSTED_SHAPE:
            if fit.width_sd_mm is not None:  # of the Gaussians without their bias
                error_sd = figures.get("end_error_sd", END_ERROR / float(np.sqrt(draws.effective_draws)))
                errors = {"end_error_sd": error_sd, "end_error_mm": error_sd * fit.width_sd_mm}
                draws = replace(draws, diagnostics={**figures, **errors})
            return draws, tuple(passed_over)
        passed_over.append(f"{method}: Pareto shape {shape:.2f} (trusted up to {TRUSTED_SHAPE:g})")
    raise NotConvergedError("; ".join(passed_over), diagnostics=dict(figures))


def methods(options: SamplerSettings) -> Sequence[Method]:
    """The requested method, and the next of `METHOD_ORDER` where `step_up` allows it; not two further, for chains take
    minutes. Under independent errors ``laplace`` has no next method, and ``importance`` always has."""
    order = METHOD_ORDER if options.correlated else METHOD_ORDER[1:]
    if options.method not in order:
        return (options.method,)
    first = order.index(options.method)
    return order[first : first + 1 + (options.step_up or not options.correlated)]


def accuracy_in_sd(options: SamplerSettings, width_sd_mm: float | None) -> float | None:
    """Requested accuracy in posterior SDs of the widths: the finer of `accuracy_sd` and `accuracy_mm`."""
    if options.accuracy_mm is None or width_sd_mm is None:
        return options.accuracy_sd
    return min(max(options.accuracy_mm / width_sd_mm, 1e-3), options.accuracy_sd or 0.5)


def importance_draws(
    density: SamplingTarget, *, rng: np.random.Generator, accuracy_sd: float | None = None
) -> ParameterDraws:
    """Draw by importance sampling, with one Gaussian or one for each noise field as proposal."""
    options = ImportanceOptions() if accuracy_sd is None else ImportanceOptions(accuracy_sd)
    about = density.log_density, density.mean, density.covariance
    return importance(*about, rng=rng, options=options, parts=density.parts)


def ensemble_draws(
    density: SamplingTarget,
    *,
    rng: np.random.Generator,
    options: SamplerSettings,
    accuracy_sd: float | None = None,
    progress: Progress | None = None,
) -> ParameterDraws:
    """Draw by MCMC; under a noise field the chains start from importance draws, where these converge.
    `NotConvergedError` when chains disagree with each other or with those draws."""
    settings = EnsembleOptions()
    if options.max_steps is not None:
        settings = replace(settings, max_steps=options.max_steps)
    start, key = None, ""
    if density.checkpoint_key is not None:
        if accuracy_sd is not None:
            settings = replace(settings, least_ess=(END_ERROR / accuracy_sd) ** 2)
        key = density.checkpoint_key(settings.identity(), rng)
        with suppress(NotConvergedError):
            start = importance_draws(density, rng=rng, accuracy_sd=START_ACCURACY_SD)
    draws = ensemble(
        density.log_density,
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
    figures = dict(draws.diagnostics) | {"disagreement": gap}
    if gap > DISAGREEMENT:
        raise NotConvergedError(
            f"ensemble and importance sampling disagree: an interval's end by {gap:.1f} of its Monte-Carlo errors "
            f"(at most {DISAGREEMENT:g} is chance)",
            diagnostics=figures,
        )
    return replace(draws, diagnostics=figures)


def disagreement(chains: ParameterDraws, weighted: ParameterDraws) -> float:
    """Largest difference of the ends of 95 % intervals over the parameters, in joint Monte-Carlo errors."""
    sd = weighted.flat.std(axis=0)
    chain_ends, weighted_ends = (np.quantile(draws.flat, [0.025, 0.975], axis=0) for draws in (chains, weighted))
    chain_error = END_ERROR / np.sqrt(min(chains.diagnostics["ess_tail"], chains.diagnostics["ess_bulk"]))
    weighted_error = weighted.diagnostics["end_error_sd"]
    return float((np.abs(chain_ends - weighted_ends) / sd).max() / np.hypot(chain_error, weighted_error))
