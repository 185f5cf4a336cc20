"""The bump's fit under correlated noise."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from functools import partial

import numpy as np

from tactile_bayes.declarations import Record, as_dict, replace
from tactile_bayes.errors import NotConvergedError
from tactile_bayes.geometry import FloatArray
from tactile_bayes.inference.draws import INDEPENDENT_DRAWS, ParameterDraws, Solved, student_draws
from tactile_bayes.inference.importance import Gaussians, smooth_weights
from tactile_bayes.inference.modes import find_mode, finite_differences, mode_and_covariance, stencil
from tactile_bayes.posterior.bump import drawn_widths
from tactile_bayes.posterior.draw import Sampled, SamplerSettings, with_beside
from tactile_bayes.posterior.marginal import NEGLIGIBLE, CollapsedTarget
from tactile_bayes.posterior.window import Problem, Scene, linear_columns
from tactile_bayes.presets import Method

# --- Posterior of a scene under correlated errors: its mode, a Gaussian for each noise field, and draws.

MOST_SETTLINGS = 6
ROUGH, FINE = 0.3, 1e-3
"""Last Newton step, in `Scene.steps`: under the start's fields, which are not the mode's; then under those."""
LEAST_SHARE = 1e-2
"""Fields with a smaller share of the density at the mode have no Gaussian of their own in what `laplace` draws."""
LADDER: tuple[Method, ...] = ("laplace", "importance", "ensemble")
STEPS_UP = 1
"""Methods tried after the requested one: a user who wants a quick one does not wait minutes for chains."""
CHECKED = 512  #: Draws of the Gaussians that are weighed to judge them.


class Mixture(Gaussians, eq=False):
    """One Gaussian for each noise field that matters: the mixture that `laplace` draws from."""

    log_evidence: float  #: Log of the integral of the density that the mixture stands for.


class FieldFit(Record, eq=False):
    """A scene fitted at the mode of its marginal posterior."""

    target: CollapsedTarget  #: Its density, with the noise fields that matter there.
    mode: FloatArray
    covariance: FloatArray
    """`mode`, `covariance` (p,), (p, p) arrays: Of the scene's parameters; the covariance is the mixture's, not the
    curvature at the mode."""
    mixture: Mixture  #: One Gaussian per noise field.

    @property
    def scene(self) -> Scene:
        """Structures in the model."""
        return self.target.scene

    @property
    def log_evidence(self) -> float:
        """Log evidence of the scene, from the Gaussians' volumes."""
        return self.mixture.log_evidence

    def sd(self, name: str) -> float:
        """Posterior standard deviation of one parameter."""
        i = self.scene.names.index(name)
        return float(np.sqrt(self.covariance[i, i]))

    @property
    def widths_mm(self) -> tuple[float, float]:
        """sigma_x_mm and sigma_y_mm at the mode."""
        sigma_x, sigma_y, _ = drawn_widths(*self.scene.widths(self.mode[None]))
        return float(sigma_x[0]), float(sigma_y[0])

    @property
    def width_sd_mm(self) -> float:
        """Posterior SD of the less certain width, from the Gaussian approximation."""
        names = [name for name in ("u", "v") if name in self.scene.names]
        return max(self.sd(name) * float(np.exp(self.scene.column(self.mode, name))) for name in names)

    def methods(self, options: SamplerSettings) -> Sequence[Method]:
        """The requested method, and the next one where a step up is allowed."""
        first = LADDER.index(options.method)
        return LADDER[first : first + 1 + STEPS_UP * options.step_up]

    def at_mode(self, method: Method, number: int, rng: np.random.Generator) -> ParameterDraws:
        """Draw from the Gaussian mixture, with the Pareto shape of its importance weights."""
        del method
        drawn = laplace_mixture(self, rng=rng, draws=number)
        some = drawn.flat[:CHECKED]
        _, shape = smooth_weights(self.target(some) - self.mixture.log_density(some))
        return replace(drawn, diagnostics=dict(drawn.diagnostics) | {"pareto_k": float(shape)})

    def sampled(self, solved: Solved | None = None) -> Sampled:
        """The density to sample; without a second structure it is the fit's own, and keeps its solutions."""
        mean, covariance = self.mixture.moments()
        k, target = len(self.scene.alone().names), self.target
        parts = newton_mixture(target, self.mode, self.covariance, least_share=NEGLIGIBLE)
        key = partial(checkpoint_key, self)
        if k == len(mean):
            density = target if solved is None else partial(target, solved=solved)
            return Sampled(density, mean, covariance, parts, checkpoint_key=key)
        across, beside = covariance[:k, k:], self.mode[k:]
        added = across @ np.linalg.solve(covariance[k:, k:], across.T)
        values, vectors = np.linalg.eigh(0.5 * (added + added.T))
        spread = vectors * np.sqrt(np.clip(values, 0.0, None))
        given = None if parts is None else parts.given(beside)
        return Sampled(
            lambda theta: target(with_beside(theta, beside)),
            self.mode[:k],
            covariance[:k, :k] - added,
            given,
            beside,
            spread,
            key,
        )


def fit_scene(problem: Problem, scene: Scene, start: FloatArray) -> FieldFit:
    """Find the mode from (p,) parameters, alternating with the choice of noise fields that matter there.

    `NotConvergedError` when there is no mode.
    """
    target = CollapsedTarget(problem, scene)
    target.settle_fields(start)
    mode, _ = find_mode(target, start, scale=scene.steps, tolerance=ROUGH)
    target.settle_fields(mode)
    for _ in range(MOST_SETTLINGS):
        mode, covariance, _ = mode_and_covariance(target, mode, scale=scene.steps, tolerance=FINE)
        if not target.settle_fields(mode):
            break
    if not np.isfinite(target(mode[None])[0]):
        raise NotConvergedError("no posterior mode: the fitted bump does not rise above the correlated noise")
    # the common curvature is sharper than the mixture is wide where fields with modes of their own share the evidence
    mixture = newton_mixture(target, mode, covariance)
    if mixture is None:
        volume = 0.5 * float(np.linalg.slogdet(2.0 * np.pi * covariance)[1])
        mixture = Mixture(np.ones(1), mode[None], covariance[None], float(target(mode[None])[0]) + volume)
    return FieldFit(target, mode, mixture.moments()[1], mixture)


def newton_mixture(
    target: CollapsedTarget, start: FloatArray, covariance: FloatArray, *, least_share: float = LEAST_SHARE
) -> Mixture | None:
    """One Gaussian per field, each by one Newton step from a common start; None where one of them is no maximum.

    The (p,) start is near the mode of all; the (p, p) covariance, about theirs, scales the finite differences and
    limits the step. A field has a Gaussian from `least_share` of the density at the start on.
    """
    scale = np.sqrt(np.diag(covariance))
    points = stencil(start, step=0.3 * scale)
    by_field = target.by_field(points) + target.scene.log_prior(points, target.problem)[:, None]
    whole = float(np.logaddexp.reduce(by_field[0]))
    share = np.exp(by_field[0] - whole) if np.isfinite(whole) else np.zeros(by_field.shape[1])
    means, covariances, masses = [], [], []
    for h in np.flatnonzero(share > least_share):
        if not np.isfinite(by_field[:, h]).all():
            return None
        gradient, hessian = finite_differences(by_field[:, h], step=0.3 * scale)
        gaussian = _newton_gaussian(gradient, hessian, scale, limit=covariance)
        if gaussian is None:
            return None
        step, one, gained = gaussian
        means.append(start + step)
        covariances.append(one)
        masses.append(by_field[0, h] + gained + 0.5 * float(np.linalg.slogdet(2.0 * np.pi * one)[1]))
    if not masses:
        return None
    mass = np.array(masses)
    total = float(np.logaddexp.reduce(mass))
    left_out = float(np.log(share[share > least_share].sum()))
    return Mixture(np.exp(mass - total), np.array(means), np.array(covariances), total - left_out)


def _newton_gaussian(
    gradient: FloatArray, hessian: FloatArray, scale: FloatArray, *, limit: FloatArray
) -> tuple[FloatArray, FloatArray, float] | None:
    """Newton step to a field's mode, its covariance and the gain; None without a maximum nearby."""
    values, vectors = np.linalg.eigh(-hessian * np.outer(scale, scale))
    if not values[0] > 0.05:
        return None
    covariance = (vectors / values) @ vectors.T * np.outer(scale, scale)
    step = covariance @ gradient
    if np.sqrt(step @ np.linalg.solve(limit, step)) > 3.0:
        return None
    return step, covariance, 0.5 * float(gradient @ step)


def laplace_mixture(fit: FieldFit, *, rng: np.random.Generator, draws: int = INDEPENDENT_DRAWS) -> ParameterDraws:
    """Draw from the fields' Gaussians, with t tails for the estimated noise scale.

    Where several fields share the evidence one Gaussian was up to 25 % too narrow; a Gaussian for each is within a
    few per cent.
    """
    number = rng.multinomial(draws, fit.mixture.weight)
    dof = float(fit.target.dof)
    widen = (dof + len(fit.mode)) / dof
    parts = [
        student_draws(mean, widen * covariance, dof=dof, number=int(n), rng=rng)
        for mean, covariance, n in zip(fit.mixture.mean, fit.mixture.covariance, number, strict=True)
    ]
    flat = rng.permutation(np.concatenate(parts))
    return ParameterDraws(flat[None], "laplace", {"draws": float(draws), "fields": float(len(number))})


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


# --- Derivatives of a window's cells by all free parameters of a fitted scene.

_STEP = 1e-4


def tangent_columns(fit: FieldFit) -> FloatArray:
    """(v, n) the unit bump, its derivatives by its own parameters first, then level and tilt."""
    window, scene, mode = fit.target.window, fit.scene, fit.mode
    p = len(scene.alone().names)
    steps = _STEP * np.eye(p, len(mode))
    bump = scene.templates(np.concatenate([mode[None], mode + steps, mode - steps]), window)[0]
    values = window.of_cells(bump)
    slopes = (values[1 : p + 1] - values[p + 1 :]) / (2 * _STEP)
    return np.concatenate([values[:1], slopes, linear_columns(window.cells, tilt=scene.tilt)])
