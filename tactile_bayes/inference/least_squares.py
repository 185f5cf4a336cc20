"""Nonlinear least squares for small models: Levenberg-Marquardt in numpy, which starts fast."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from tactile_bayes.geometry import FloatArray
from tactile_bayes.records import dataclass

ModelFunction = Callable[[FloatArray], FloatArray]
"""Maps (m, p) parameter vectors to (m, k) predictions, all m at once."""

MOST_ITERATIONS = 200
SETTLED = 0.01
"""Of the residual variance: a step that lowers the sum of squares by less moves nothing that the data could tell."""


@dataclass(frozen=True, slots=True, eq=False)
class LeastSquaresFit:
    """The minimum of a weighted sum of squares.

    Parameters
    ----------
    theta : (p,) array
        Parameters at the minimum.
    jacobian : (k, p) array
        Derivatives of the predictions there.
    residual : (k,) array
        Data minus prediction.
    sse
        Weighted sum of squared residuals.
    converged
        Whether the relative step fell below the tolerance.
    """

    theta: FloatArray
    jacobian: FloatArray
    residual: FloatArray
    sse: float
    converged: bool
    iterations: int

    def covariance(self, weight: FloatArray) -> FloatArray:
        """(p, p) least-squares covariance, residual variance SSE / (k - p) included; inf where undetermined."""
        k, p = self.jacobian.shape
        inverse = inverse_information(self.jacobian, weight)
        return self.sse / max(k - p, 1) * inverse if np.isfinite(inverse).all() else inverse


def inverse_information(jacobian: FloatArray, weight: FloatArray) -> FloatArray:
    """``(J' W J)^-1``, scaled to unit columns first; a (p, p) matrix of inf when it is singular."""
    p = jacobian.shape[1]
    scale = np.sqrt(np.einsum("kp,k,kp->p", jacobian, weight, jacobian))
    if not np.isfinite(scale).all() or (scale <= 0).any():
        return np.full((p, p), np.inf)
    unit = jacobian / scale
    values, vectors = np.linalg.eigh(unit.T @ (weight[:, None] * unit))
    if values[0] <= 1e-13 * values[-1]:
        return np.full((p, p), np.inf)
    return np.asarray((vectors / values) @ vectors.T / np.outer(scale, scale))


def numerical_jacobian(model: ModelFunction, theta: FloatArray, *, scale: FloatArray) -> FloatArray:
    """(k, p) Jacobian by central differences; `scale` (p,) is the model's typical length in each parameter."""
    step = 1e-5 * scale
    shifts = np.diag(step)
    values = model(np.concatenate([theta + shifts, theta - shifts]))
    p = len(theta)
    return np.asarray((values[:p] - values[p:]).T / (2.0 * step))


def fit_least_squares(
    model: ModelFunction,
    start: FloatArray,
    *,
    data: FloatArray,
    weight: FloatArray,
    scale: FloatArray,
    tolerance: float = 1e-10,
    abandon: Callable[[FloatArray], bool] | None = None,
    patience: int | None = None,
) -> LeastSquaresFit:
    """Minimise ``sum(weight * (data - model(theta))**2)`` by Levenberg-Marquardt.

    Parameters
    ----------
    model
        Vectorised over parameter vectors, see `ModelFunction`.
    start, scale : (p,) arrays
        Where to begin, and the typical size of a change of each parameter (steps are damped in these units).
    data, weight : (k,) arrays
        Weights are inverse variances up to one common factor.
    tolerance
        Stop when the Gauss-Newton step is this small in units of `scale`.
    abandon
        Stop, not converged, at parameters from which no useful minimum can follow.
    patience
        After so many iterations a minimum is good enough once a step lowers the sum of squares by less than
        `SETTLED` of the residual variance. Beside large residuals steps shrink by a few per cent each.

    Notes
    -----
    Marquardt (1963); the gain ratio controls the damping as in Madsen, Nielsen & Tingleff (2004), section 3.2.
    """
    theta = np.array(start, dtype=np.float64)
    residual = data - model(theta[None])[0]
    sse = float(weight @ residual**2)
    damping, grow = 1e-3, 2.0
    jacobian = numerical_jacobian(model, theta, scale=scale)
    for iteration in range(1, MOST_ITERATIONS + 1):
        step = _damped_step(jacobian, residual, weight=weight, scale=scale, damping=damping)
        if not np.isfinite(step).all():
            break
        trial = theta + step * scale
        trial_residual = data - model(trial[None])[0]
        trial_sse = float(weight @ trial_residual**2)
        if trial_sse <= sse and np.isfinite(trial_sse):
            small = float(np.abs(step).max()) < tolerance or sse - trial_sse <= 1e-15 * sse
            small |= patience is not None and iteration > patience and sse - trial_sse <= SETTLED * sse / len(data)
            theta, residual, sse = trial, trial_residual, trial_sse
            jacobian = numerical_jacobian(model, theta, scale=scale)
            damping, grow = max(damping / 5.0, 1e-14), 2.0
            if small:
                return LeastSquaresFit(theta, jacobian, residual, sse, True, iteration)
            if abandon is not None and abandon(theta):
                return LeastSquaresFit(theta, jacobian, residual, sse, False, iteration)
        else:
            if float(np.abs(step).max()) < tolerance:
                return LeastSquaresFit(theta, jacobian, residual, sse, True, iteration)
            damping, grow = damping * grow, grow * 2.0
    return LeastSquaresFit(theta, jacobian, residual, sse, False, MOST_ITERATIONS)


def _damped_step(
    jacobian: FloatArray, residual: FloatArray, *, weight: FloatArray, scale: FloatArray, damping: float
) -> FloatArray:
    """Step in units of `scale`; each column is damped by its own curvature and by a floor."""
    scaled = jacobian * scale
    information = scaled.T @ (weight[:, None] * scaled)
    gradient = scaled.T @ (weight * residual)
    diagonal = np.diag(information)
    floor = 1e-12 * max(float(diagonal.max()), np.finfo(float).tiny)
    try:
        step = np.linalg.solve(information + damping * np.diag(np.maximum(diagonal, floor)), gradient)
    except np.linalg.LinAlgError:
        return np.full(len(gradient), np.nan)
    return np.clip(step, -3.0, 3.0)
