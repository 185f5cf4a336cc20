r"""Learning of what Eq 6 leaves of a population's sizes, see `size.process`, and of the spread between bodies.

Given the kernel and the spread of B, the weights have a normal posterior in closed form, and with them each body's
size as the others predict it. Kernel and spread are those by which bodies left out are most probable, with weak priors
(Rasmussen & Williams 2006, sec. 5.4.2), so that intervals hold on bodies never seen.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np
from scipy.optimize import minimize

from tactile_bayes.declarations import Record
from tactile_bayes.geometry import FloatArray
from tactile_bayes.inference.modes import mode_and_covariance
from tactile_bayes.size.process import Kernel, Residual

POINTS: Final = 100
"""Points of the kernel; with fewer bodies a quarter of their number."""
BODIES_PER_POINT: Final = 4
SEED: Final = 1
"""Of the bodies that are the points."""
_LENGTH, _SCALE, _BODY_SD = (np.log(2.0), 1.0), (np.log(0.3), 1.0), (np.log(0.1), 1.0)
"""Centre and width of the normal priors on the logs of lengths, scale and SD(B) at the centre."""
_SLOPE_SD = 0.3
"""Width of the prior on the other coefficients of ln SD(B)."""
_START_LENGTHS = (2.0, 0.7)
"""There are modes where what is smooth is taken for scatter, and the other way round."""
_MOST_ITERATIONS = 200
_DIFFERENCE = 1e-4
"""Step of the gradient: below it the rounding of the solutions shows."""


class BodiesLeft(Record, eq=False):
    """What Eq 6 leaves of b bodies."""

    x: FloatArray
    """(b, 3) means of u, v and w over each body's exams: they differ little."""
    features: FloatArray
    """(b, s) of ln SD(B)."""
    left: FloatArray
    """(b,) ln d less Eq 6's, each body left out of its fit."""
    noise: FloatArray
    """(b,) variance of `left` by the body's exams and by the error of Eq 6's coefficients."""


class FittedResidual(Record, eq=False):
    """The residual given its kernel and the spread of B: (m,), (m, m) moments of its weights.

    `predicted` and `variance` are (b,): what the other bodies lead one to expect of each body's residual, and the
    variance by the weights.
    """

    kernel: Kernel
    mean: FloatArray
    covariance: FloatArray
    predicted: FloatArray
    variance: FloatArray

    def at(self, x: FloatArray) -> FloatArray:
        """(n,) the residual at (n, 3) values."""
        return np.asarray(self.kernel.functions(x) @ self.mean)

    @property
    def residual(self) -> Residual:
        """As part of a calibration."""
        factor = np.linalg.cholesky(self.covariance).tolist()
        rows = tuple(tuple(row[: i + 1]) for i, row in enumerate(factor))
        return Residual(self.kernel.points, self.kernel.lengths, self.kernel.scale, self.mean, rows)


def fit_residual(bodies: BodiesLeft) -> FittedResidual:
    """Kernel and spread with half of the points, then with all, by the better of two starts."""
    count = max(min(POINTS, len(bodies.left) // BODIES_PER_POINT), 1)
    starts = [_start(bodies, length) for length in _START_LENGTHS]
    for points_now in (max(count // 2, 1), count):
        points = drawn_points(bodies.x, points_now)
        fits = [_best(bodies, one, points) for one in starts]
        theta, _ = min(fits, key=lambda one: one[1])
        starts = [theta]
    return given(bodies, points, theta)


def drawn_points(x: FloatArray, count: int) -> FloatArray:
    """(m, k) of the (b, k) values, drawn at random: they lie as the bodies do, so most where most sizes are asked for.

    Notes
    -----
    Pivots of the kernel's incomplete Cholesky factor (Fine & Scheinberg 2001) lie at the table's ends first, and left
    bodies out with larger errors (record 0122).
    """
    return x[np.random.default_rng(SEED).choice(len(x), count, replace=False)]


def given(bodies: BodiesLeft, points: FloatArray, theta: FloatArray) -> FittedResidual:
    """Posterior of the weights for one kernel and spread, and each body as the others predict it.

    `theta` holds the logs of the lengths and of the scale, and the coefficients of ln SD(B).
    """
    k = bodies.x.shape[1]
    kernel = Kernel(points, np.exp(theta[:k]), float(np.exp(theta[k])))
    terms = kernel.functions(bodies.x)
    total = np.exp(2.0 * bodies.features @ theta[k + 1 :]) + bodies.noise
    scaled = terms / np.sqrt(total)[:, None]
    inverse = np.linalg.inv(np.linalg.cholesky(scaled.T @ scaled + np.eye(len(points))))
    covariance = inverse.T @ inverse
    mean = covariance @ (scaled.T @ (bodies.left / np.sqrt(total)))
    weight = np.sum(scaled @ covariance * scaled, axis=1)
    off = (bodies.left - terms @ mean) / (1.0 - weight)
    return FittedResidual(kernel, mean, covariance, bodies.left - off, total * weight / (1.0 - weight))


def left_out_density(features: FloatArray, error: FloatArray, noise: FloatArray) -> Callable[[FloatArray], float]:
    """Log density of all bodies, each left out, with the prior, by (s,) coefficients of ln SD(B).

    `error` and `noise` are (b,): of each body as the others predict it, and its variance without B's.
    """

    def density(log_spread: FloatArray) -> float:
        return _log_density(features, error, noise, log_spread) + _spread_prior(log_spread)

    return density


def body_spread(features: FloatArray, error: FloatArray, noise: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(s,) coefficients of ln SD(B) by which bodies left out are most probable, and their (s, s) covariance."""
    density, s = left_out_density(features, error, noise), features.shape[1]

    def many(spreads: FloatArray) -> FloatArray:
        return np.array([density(one) for one in spreads])

    start = np.zeros(s)
    start[0] = _BODY_SD[0]
    mode, covariance, _ = mode_and_covariance(many, start, scale=np.full(s, 0.05))
    return np.asarray(mode), np.asarray(covariance)


def _log_density(features: FloatArray, error: FloatArray, noise: FloatArray, log_spread: FloatArray) -> float:
    variance = np.exp(2.0 * features @ log_spread) + noise
    return float(-0.5 * np.sum(np.log(variance) + error**2 / variance))


def _best(bodies: BodiesLeft, start: FloatArray, points: FloatArray) -> tuple[FloatArray, float]:
    """Logs of kernel and spread at the mode next to a start, and the mode's negative log density."""
    k = bodies.x.shape[1]

    def cost(theta: FloatArray) -> float:
        fitted, spread = given(bodies, points, theta), theta[k + 1 :]
        error, noise = bodies.left - fitted.predicted, bodies.noise + fitted.variance
        of_kernel = np.sum(((theta[:k] - _LENGTH[0]) / _LENGTH[1]) ** 2) + ((theta[k] - _SCALE[0]) / _SCALE[1]) ** 2
        prior = -0.5 * float(of_kernel) + _spread_prior(spread)
        return -_log_density(bodies.features, error, noise, spread) - prior

    bounds = [(-2.0, 4.0)] * k + [(-4.0, 2.0)] + [(-5.0, 1.0)]
    bounds += [(-1.5, 1.5)] * (len(start) - len(bounds))
    found = minimize(
        cost, start, method="L-BFGS-B", bounds=bounds, options={"maxiter": _MOST_ITERATIONS, "eps": _DIFFERENCE}
    )
    return np.asarray(found.x, dtype=np.float64), float(found.fun)


def _spread_prior(log_spread: FloatArray) -> float:
    at_centre = ((log_spread[0] - _BODY_SD[0]) / _BODY_SD[1]) ** 2
    return float(-0.5 * (at_centre + np.sum((log_spread[1:] / _SLOPE_SD) ** 2)))


def _start(bodies: BodiesLeft, length: float) -> FloatArray:
    lengths, spread = np.full(bodies.x.shape[1], np.log(length)), np.zeros(bodies.features.shape[1])
    spread[0] = _BODY_SD[0]
    return np.concatenate([lengths, [_SCALE[0]], spread])
