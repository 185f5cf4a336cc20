"""Laplace approximation, from mode and curvature: normal given the noise scale."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from tactile_bayes.errors import NotConvergedError
from tactile_bayes.geometry import FloatArray
from tactile_bayes.inference.derivatives import finite_differences, stencil
from tactile_bayes.inference.draws import INDEPENDENT_DRAWS, ParameterDraws, student_draws

LogDensity = Callable[[FloatArray], FloatArray]
MOST_STEPS = 100


def laplace(
    log_density: LogDensity,
    start: FloatArray,
    *,
    scale: FloatArray,
    dof: float,
    rng: np.random.Generator,
) -> ParameterDraws:
    """Draw from the t density with the mode and curvature of a log density.

    Given the noise scale the approximation is normal; that scale has `dof` degrees of freedom, so the draws are those
    of a multivariate t. For a linear model this is exact. `log_density`, `start` and `scale` as in
    `mode_and_covariance`.
    """
    mode, covariance, steps = mode_and_covariance(log_density, start, scale=scale)
    widened = covariance if np.isinf(dof) else covariance * (dof + len(mode)) / dof
    flat = student_draws(mode, widened, dof=dof, number=INDEPENDENT_DRAWS, rng=rng)
    return ParameterDraws(flat[None], "laplace", {"draws": float(INDEPENDENT_DRAWS), "newton_steps": float(steps)})


def mode_and_covariance(
    log_density: LogDensity, start: FloatArray, *, scale: FloatArray, tolerance: float = 1e-4
) -> tuple[FloatArray, FloatArray, int]:
    """Find the mode of a log density by damped Newton steps, and the inverse of its negative Hessian there.

    Parameters
    ----------
    log_density
        Vectorised: (m, p) to (m,).
    start, scale : (p,) arrays
        Where to begin, and about one posterior standard deviation of each parameter.
    tolerance
        See `find_mode`.

    Returns
    -------
    mode : (p,) array
    covariance : (p, p) array
    steps
        Newton steps taken.

    Raises
    ------
    NotConvergedError
        When no mode is found or the curvature there is not that of a maximum.
    """
    mode, taken = find_mode(log_density, start, scale=scale, tolerance=tolerance)
    return mode, _covariance(log_density, mode, scale=scale), taken


def find_mode(
    log_density: LogDensity, start: FloatArray, *, scale: FloatArray, tolerance: float = 1e-4
) -> tuple[FloatArray, int]:
    """As `mode_and_covariance`, without the curvature.

    Parameters
    ----------
    tolerance
        Of the last step taken, in units of `scale`. A mode is nearer than that: steps shrink as their squares, down to
        the error of differences.
    """
    theta = np.array(start, dtype=np.float64)
    value = float(log_density(theta[None])[0])
    damping = 1e-8
    for taken in range(1, MOST_STEPS + 1):
        gradient, hessian = _slopes(log_density, theta, step=1e-2 * scale)
        step = scale * _newton_step(gradient * scale, -hessian * np.outer(scale, scale), damping)
        trial = theta + step
        trial_value = float(log_density(trial[None])[0])
        small = np.abs(step / scale).max() < tolerance
        if trial_value >= value:
            gained, theta, value, damping = trial_value - value, trial, trial_value, max(damping / 10, 1e-8)
            if small and gained < tolerance**2:
                return theta, taken
        elif small:
            return theta, taken
        else:
            damping = max(damping * 10, 1e-4)
    raise NotConvergedError(f"no posterior mode found in {MOST_STEPS} Newton steps; try --method ensemble")


def _slopes(log_density: LogDensity, theta: FloatArray, *, step: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Gradient and Hessian; an error where a neighbouring point has no density."""
    values = log_density(stencil(theta, step=step))
    if not np.isfinite(values).all():
        raise NotConvergedError(
            "the posterior's mode lies at the edge of what the window allows; try --method ensemble"
        )
    return finite_differences(values, step=step)


def _newton_step(gradient: FloatArray, curvature: FloatArray, damping: float) -> FloatArray:
    """Uphill step in standardised units; directions of negative curvature are flipped."""
    values, vectors = np.linalg.eigh(curvature)
    safe = np.maximum(np.abs(values), 1e-3) + damping * max(1.0, float(np.abs(values).max()))
    return np.asarray(np.clip(vectors @ ((vectors.T @ gradient) / safe), -2.0, 2.0))


def _covariance(log_density: LogDensity, theta: FloatArray, *, scale: FloatArray) -> FloatArray:
    _, hessian = _slopes(log_density, theta, step=5e-2 * scale)
    values, vectors = np.linalg.eigh(-hessian * np.outer(scale, scale))
    if not values[0] > 1e-9 * values[-1]:
        raise NotConvergedError("the posterior has no maximum in every direction; try --method ensemble")
    return np.asarray((vectors / values) @ vectors.T * np.outer(scale, scale))
