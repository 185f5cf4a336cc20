"""Modes of a density: optimisation, least squares, Laplace's approximation."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from tactile_bayes.declarations import Record
from tactile_bayes.errors import NotConvergedError
from tactile_bayes.geometry import FloatArray
from tactile_bayes.inference.draws import INDEPENDENT_DRAWS, ParameterDraws, student_draws

# --- Gradient and Hessian of a scalar function by central differences, evaluated in one call.


def stencil(theta: FloatArray, *, step: FloatArray) -> FloatArray:
    """(1 + 2 p^2, p) points for central first and second differences, `theta` first."""
    shifts = np.diag(step)
    one, other = (shifts[index] for index in np.tril_indices(len(theta), -1))
    corners = np.stack([one + other, one - other, other - one, -one - other], axis=1).reshape(-1, len(theta))
    return np.concatenate([theta[None], theta + shifts, theta - shifts, theta + corners])


def finite_differences(values: FloatArray, *, step: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(p,) gradient and (p, p) Hessian from a function's values at the points of `stencil`."""
    p = len(step)
    centre, up, down = values[0], values[1 : p + 1], values[p + 1 : 2 * p + 1]
    hessian = np.diag((up - 2 * centre + down) / step**2)
    i, j = np.tril_indices(p, -1)
    a, b, c, d = values[2 * p + 1 :].reshape(-1, 4).T
    hessian[i, j] = hessian[j, i] = (a - b - c + d) / (4 * step[i] * step[j])
    return (up - down) / (2 * step), hessian


# --- The paper's method: least squares (Eq 7) with its covariance and no prior.


def optimise(theta: FloatArray, covariance: FloatArray, *, dof: float, rng: np.random.Generator) -> ParameterDraws:
    """Draw about the (p,) least-squares estimate, with its (p, p) covariance and t tails for the estimated noise.

    Wellman & Howe (1999), section 2.4, minimise the squared error between map and Eq 7; the covariance, which includes
    correlated errors, is this program's addition.
    """
    flat = student_draws(theta, covariance, dof=dof, number=INDEPENDENT_DRAWS, rng=rng)
    return ParameterDraws(flat[None], "optimise", {"draws": float(INDEPENDENT_DRAWS)})


# --- Nonlinear least squares for small models: Levenberg-Marquardt in numpy, which starts fast.

ModelFunction = Callable[[FloatArray], FloatArray]
"""Maps (m, p) parameter vectors to (m, k) predictions, all m at once."""

MOST_ITERATIONS = 200
SETTLED = 0.01  #: Share of the residual variance: a step that lowers the sum of squares by less is within the noise.


class LeastSquaresFit(Record, eq=False):
    """The minimum of a weighted sum of squares."""

    theta: FloatArray  #: (p,) array: Parameters at the minimum.
    jacobian: FloatArray  #: (k, p) array: Derivatives of the predictions there.
    residual: FloatArray  #: (k,) array: Data minus prediction.
    sse: float  #: Weighted sum of squared residuals.
    converged: bool  #: The relative step fell below the tolerance.
    iterations: int


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
    step, p = 1e-5 * scale, len(theta)
    values = model(np.concatenate([theta + np.diag(step), theta - np.diag(step)]))
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

    The (k,) weights are inverse variances up to a common factor; steps are damped in units of the (p,) `scale`, a
    typical change of each parameter. It stops when the step is smaller than `tolerance` in these units, after
    `patience` iterations also when a step lowers the sum of squares by less than `SETTLED` of the residual variance,
    and, not converged, at parameters where `abandon` is true. Marquardt (1963); damping as in Madsen, Nielsen &
    Tingleff (2004), section 3.2.
    """
    theta = np.array(start, dtype=np.float64)
    residual = data - model(theta[None])[0]
    sse, damping, growth = float(weight @ residual**2), 1e-3, 2.0
    jacobian = numerical_jacobian(model, theta, scale=scale)
    for iteration in range(1, MOST_ITERATIONS + 1):
        step = _damped_step(jacobian, residual, weight=weight, scale=scale, damping=damping)
        if not np.isfinite(step).all():
            break
        trial = theta + step * scale
        trial_residual = data - model(trial[None])[0]
        trial_sse = float(weight @ trial_residual**2)
        if trial_sse <= sse and np.isfinite(trial_sse):
            settled = float(np.abs(step).max()) < tolerance or sse - trial_sse <= 1e-15 * sse
            settled |= patience is not None and iteration > patience and sse - trial_sse <= SETTLED * sse / len(data)
            theta, residual, sse = trial, trial_residual, trial_sse
            jacobian = numerical_jacobian(model, theta, scale=scale)
            damping, growth = max(damping / 5.0, 1e-14), 2.0
            if settled:
                return LeastSquaresFit(theta, jacobian, residual, sse, True, iteration)
            if abandon is not None and abandon(theta):
                return LeastSquaresFit(theta, jacobian, residual, sse, False, iteration)
        else:
            if float(np.abs(step).max()) < tolerance:
                return LeastSquaresFit(theta, jacobian, residual, sse, True, iteration)
            damping, growth = damping * growth, growth * 2.0
    return LeastSquaresFit(theta, jacobian, residual, sse, False, MOST_ITERATIONS)


def _damped_step(
    jacobian: FloatArray, residual: FloatArray, *, weight: FloatArray, scale: FloatArray, damping: float
) -> FloatArray:
    """Step in units of `scale`; each column is damped by its own curvature and by a floor."""
    scaled = jacobian * scale
    information, gradient = scaled.T @ (weight[:, None] * scaled), scaled.T @ (weight * residual)
    diagonal = np.diag(information)
    floor = 1e-12 * max(float(diagonal.max()), np.finfo(float).tiny)
    try:
        step = np.linalg.solve(information + damping * np.diag(np.maximum(diagonal, floor)), gradient)
    except np.linalg.LinAlgError:
        return np.full(len(gradient), np.nan)
    return np.clip(step, -3.0, 3.0)


# --- Laplace approximation, from mode and curvature: normal given the noise scale.

LogDensity = Callable[[FloatArray], FloatArray]
MOST_STEPS = 100


def laplace(
    log_density: LogDensity, start: FloatArray, *, scale: FloatArray, dof: float, rng: np.random.Generator
) -> ParameterDraws:
    """Draw from the t density with the mode and curvature of a log density, as `mode_and_covariance` finds them.

    Given the noise scale, of `dof` degrees of freedom, the approximation is normal. For a linear model it is exact.
    """
    mode, covariance, steps = mode_and_covariance(log_density, start, scale=scale)
    widened = covariance * (dof + len(mode)) / dof
    flat = student_draws(mode, widened, dof=dof, number=INDEPENDENT_DRAWS, rng=rng)
    return ParameterDraws(flat[None], "laplace", {"draws": float(INDEPENDENT_DRAWS), "newton_steps": float(steps)})


def mode_and_covariance(
    log_density: LogDensity, start: FloatArray, *, scale: FloatArray, tolerance: float = 1e-4
) -> tuple[FloatArray, FloatArray, int]:
    """Mode of a log density by damped Newton steps, the inverse of its negative Hessian there, and the number of steps.

    The (p,) scale is about one posterior standard deviation of each parameter. `NotConvergedError` when no mode is
    found or the curvature there is not that of a maximum.
    """
    mode, steps = find_mode(log_density, start, scale=scale, tolerance=tolerance)
    _, hessian = _gradient_and_hessian(log_density, mode, step=5e-2 * scale)
    values, vectors = np.linalg.eigh(-hessian * np.outer(scale, scale))
    if not values[0] > 1e-9 * values[-1]:
        raise NotConvergedError("the posterior has no maximum in every direction; try --method ensemble")
    return mode, np.asarray((vectors / values) @ vectors.T * np.outer(scale, scale)), steps


def find_mode(
    log_density: LogDensity, start: FloatArray, *, scale: FloatArray, tolerance: float = 1e-4
) -> tuple[FloatArray, int]:
    """Mode, and number of steps, as `mode_and_covariance`; the last step is below `tolerance` in units of `scale`, and
    the mode nearer still: Newton steps converge quadratically, down to the error of differences."""
    theta = np.array(start, dtype=np.float64)
    value = float(log_density(theta[None])[0])
    damping = 1e-8
    for steps in range(1, MOST_STEPS + 1):
        gradient, hessian = _gradient_and_hessian(log_density, theta, step=1e-2 * scale)
        # uphill in standardised units; directions of negative curvature are flipped
        values, vectors = np.linalg.eigh(-hessian * np.outer(scale, scale))
        curvature = np.maximum(np.abs(values), 1e-3) + damping * max(1.0, float(np.abs(values).max()))
        step = scale * np.clip(vectors @ ((vectors.T @ (gradient * scale)) / curvature), -2.0, 2.0)
        trial = theta + step
        trial_value = float(log_density(trial[None])[0])
        small = np.abs(step / scale).max() < tolerance
        if trial_value >= value:
            gained, theta, value, damping = trial_value - value, trial, trial_value, max(damping / 10, 1e-8)
            if small and gained < tolerance**2:
                return theta, steps
        elif small:
            return theta, steps
        else:
            damping = max(damping * 10, 1e-4)
    raise NotConvergedError(f"no posterior mode found in {MOST_STEPS} Newton steps; try --method ensemble")


def _gradient_and_hessian(
    log_density: LogDensity, theta: FloatArray, *, step: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Gradient and Hessian; `NotConvergedError` where a neighbouring point has no density."""
    values = log_density(stencil(theta, step=step))
    if not np.isfinite(values).all():
        raise NotConvergedError(
            "the posterior's mode lies at the edge of what the window allows; try --method ensemble"
        )
    return finite_differences(values, step=step)
