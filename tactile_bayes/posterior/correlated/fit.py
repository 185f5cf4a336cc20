"""The posterior of a scene under correlated errors: its mode, a Gaussian for each field, and draws."""

from __future__ import annotations

import numpy as np

from tactile_bayes.errors import NotConvergedError
from tactile_bayes.forward.gaussian import principal_widths
from tactile_bayes.geometry import FloatArray
from tactile_bayes.inference.derivatives import finite_differences, stencil
from tactile_bayes.inference.draws import INDEPENDENT_DRAWS, ParameterDraws, student_draws
from tactile_bayes.inference.laplace import find_mode, mode_and_covariance
from tactile_bayes.posterior.correlated.marginal import CollapsedTarget, independent_variance
from tactile_bayes.posterior.correlated.problem import Problem
from tactile_bayes.posterior.correlated.scene import Scene
from tactile_bayes.posterior.correlated.window import Window
from tactile_bayes.posterior.white.fit import BumpFit
from tactile_bayes.presets import FIELD_COSINES
from tactile_bayes.records import dataclass

MOST_SETTLINGS = 6
ROUGH, FINE = 0.3, 1e-3
"""Of the last Newton step, in `Scene.steps`: under the start's fields, which are not the mode's; then under those."""
LEAST_SHARE = 1e-2
"""Fields with a smaller share of the posterior have no Gaussian of their own."""


@dataclass(frozen=True, slots=True, eq=False)
class Mixture:
    """One Gaussian for each noise field that matters: what `laplace` draws from.

    Parameters
    ----------
    weight : (h,) array
        Sum 1.
    mean, covariance : (h, p), (h, p, p) arrays
    log_evidence
        Log of the integral of the density that the mixture stands for.
    """

    weight: FloatArray
    mean: FloatArray
    covariance: FloatArray
    log_evidence: float

    def log_density(self, theta: FloatArray) -> FloatArray:
        """(m,) log density of the Gaussians, normalised."""
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


@dataclass(frozen=True, slots=True, eq=False)
class FieldFit:
    """Mode of a collapsed posterior.

    Parameters
    ----------
    target
        Its density, with the noise fields that matter there.
    mode, covariance : (p,), (p, p) arrays
        Of the scene's parameters; the covariance is the mixture's, not the curvature at the mode.
    mixture
        A Gaussian a field.
    """

    target: CollapsedTarget
    mode: FloatArray
    covariance: FloatArray
    mixture: Mixture

    @property
    def scene(self) -> Scene:
        """What the model has."""
        return self.target.scene

    @property
    def rotated(self) -> bool:
        """Whether the ellipse may turn."""
        return self.target.rotated

    @property
    def dof(self) -> float:
        """Degrees of freedom of the noise scale."""
        return float(self.target.dof)

    @property
    def log_evidence(self) -> float:
        """Log evidence of the scene by the Gaussians' volumes."""
        return self.mixture.log_evidence

    def sd(self, name: str) -> float:
        """Posterior standard deviation of one parameter."""
        i = self.scene.names.index(name)
        return float(np.sqrt(self.covariance[i, i]))


def field_window(least_squares: BumpFit, *, cosines: int = FIELD_COSINES) -> Window:
    """The window of a least-squares bump."""
    return Window(least_squares.cells, independent_variance(least_squares.cells), cosines=cosines)


def start_vector(least_squares: BumpFit, scene: Scene) -> FloatArray:
    """Where the search for a scene's mode begins: the least-squares bump."""
    p, q, r = (float(v) for v in least_squares.bump.shape_parameters(least_squares.theta))
    turned = np.array([p + q, p - q, least_squares.theta[1], least_squares.theta[2], r])
    return Scene("rotated").carried(turned, scene)


def fit_scene(
    problem: Problem,
    scene: Scene,
    start: FloatArray,
) -> FieldFit:
    """Find the mode; the fields that matter and the mode are settled in turn, because each depends on the other.

    Parameters
    ----------
    start : (p,) array
        The scene's parameters, for example from least squares.

    Raises
    ------
    NotConvergedError
        When there is no mode.
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
        raise NotConvergedError("the posterior has no density at the fitted bump: there is no rise under this noise")
    mixture = gaussian_mixture(target, mode, covariance)
    return FieldFit(target, mode, mixture.moments()[1], mixture)


def gaussian_mixture(target: CollapsedTarget, mode: FloatArray, covariance: FloatArray) -> Mixture:
    """One Gaussian a field about a common mode; the one common Gaussian where a field has none of its own.

    The common curvature is sharper than the mixture is wide where fields with modes of their own share the evidence.
    """
    found = newton_mixture(target, mode, covariance)
    if found is not None:
        return found
    volume = 0.5 * float(np.linalg.slogdet(2.0 * np.pi * covariance)[1])
    return Mixture(np.ones(1), mode[None], covariance[None], float(target(mode[None])[0]) + volume)


def newton_mixture(target: CollapsedTarget, start: FloatArray, covariance: FloatArray) -> Mixture | None:
    """One Gaussian a field, each by one Newton step from a common start; None where one of them is no maximum."""
    scale = np.sqrt(np.diag(covariance))
    points = stencil(start, step=0.3 * scale)
    by_field = target.by_field(points) + target.log_prior(points)[:, None]
    whole = float(np.logaddexp.reduce(by_field[0]))
    share = np.exp(by_field[0] - whole) if np.isfinite(whole) else np.zeros(by_field.shape[1])
    means, covariances, masses = [], [], []
    for h in np.flatnonzero(share > LEAST_SHARE):
        if not np.isfinite(by_field[:, h]).all():
            return None
        gradient, hessian = finite_differences(by_field[:, h], step=0.3 * scale)
        found = _newton_gaussian(gradient, hessian, scale, limit=covariance)
        if found is None:
            return None
        step, one, gained = found
        means.append(start + step)
        covariances.append(one)
        masses.append(by_field[0, h] + gained + 0.5 * float(np.linalg.slogdet(2.0 * np.pi * one)[1]))
    if not masses:
        return None
    mass = np.array(masses)
    total = float(np.logaddexp.reduce(mass))
    left_out = float(np.log(share[share > LEAST_SHARE].sum()))
    return Mixture(np.exp(mass - total), np.array(means), np.array(covariances), total - left_out)


def _newton_gaussian(
    gradient: FloatArray, hessian: FloatArray, scale: FloatArray, *, limit: FloatArray
) -> tuple[FloatArray, FloatArray, float] | None:
    """Step to a field's own mode, its covariance and what the step gains; None where that is no maximum nearby."""
    values, vectors = np.linalg.eigh(-hessian * np.outer(scale, scale))
    if not values[0] > 0.05:
        return None
    covariance = (vectors / values) @ vectors.T * np.outer(scale, scale)
    step = covariance @ gradient
    if np.sqrt(step @ np.linalg.solve(limit, step)) > 3.0:
        return None
    return step, covariance, 0.5 * float(gradient @ step)


def laplace_mixture(fit: FieldFit, *, rng: np.random.Generator, draws: int = INDEPENDENT_DRAWS) -> ParameterDraws:
    """Draws from the Gaussians of the fields, with the t tails of an estimated noise scale.

    Where several fields share the evidence one Gaussian was up to 25 % too narrow; a Gaussian for each is within a
    few per cent.
    """
    number = rng.multinomial(draws, fit.mixture.weight)
    widen = (fit.dof + len(fit.mode)) / fit.dof
    parts = [
        student_draws(mean, widen * covariance, dof=fit.dof, number=int(n), rng=rng)
        for mean, covariance, n in zip(fit.mixture.mean, fit.mixture.covariance, number, strict=True)
    ]
    flat = rng.permutation(np.concatenate(parts))
    return ParameterDraws(flat[None], "laplace", {"draws": float(draws), "fields": float(len(number))})


def shape_draws(fit: FieldFit, theta: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """sigma_x_mm, sigma_y_mm and angle_rad of (..., p) draws."""
    return principal_widths(*fit.scene.widths(theta))
