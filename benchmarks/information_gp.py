r"""Gaussian-process regression of one figure per body on features of its exams, with left-out predictions.

The mean over a body's exams of a function of the exam's features is regressed:
:math:`y_b = \frac{1}{n_b}\sum_{e \in b} f(x_e) + \epsilon_b`. f is a straight line plus a process with a squared
exponential covariance and a length per feature (Rasmussen & Williams 2006, ch. 2 and 5); the variance of the errors is
log-linear in chosen features.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.linalg import cho_solve, cholesky
from scipy.optimize import minimize

from tactile_bayes.geometry import FloatArray

LINE_SD = 1.0
"""Prior SD of the straight line's slopes, over features of SD 1 and a target of SD 1."""
LOG_LENGTH, LOG_LENGTH_SD = np.log(5.0), 1.5
LOG_HEIGHT, LOG_HEIGHT_SD = np.log(0.3), 1.0
SLOPE_SD = 0.3
_JITTER = 1e-8


@dataclass(frozen=True, slots=True, eq=False)
class Exams:
    """Features of exams, and the body of each.

    Parameters
    ----------
    features : (n, k) array
        One row per exam.
    body : (n,) int array
        Number of the body, 0 to b - 1.
    noise_features : int
        So many of the first features may change the variance of the errors.
    """

    features: FloatArray
    body: np.ndarray[Any, np.dtype[np.int64]]
    noise_features: int = 2

    def scaled(self) -> Exams:
        """Features with mean 0 and SD 1."""
        x = self.features
        return Exams((x - x.mean(axis=0)) / x.std(axis=0), self.body, self.noise_features)

    def mean(self, values: FloatArray) -> FloatArray:
        """(b, ...) means of (n, ...) values over each body's exams."""
        total = np.zeros((self.body.max() + 1, *values.shape[1:]))
        np.add.at(total, self.body, values)
        count = np.bincount(self.body)
        return np.asarray(total / count.reshape(-1, *[1] * (values.ndim - 1)))


@dataclass(frozen=True, slots=True, eq=False)
class _Parts:
    """Covariance of the bodies' means, and what its gradient needs."""

    exams: FloatArray
    bodies: FloatArray


class BodyProcess:
    """Regression on the exams of `exams`; features should be scaled.

    Parameters
    ----------
    exams
        Scaled features.
    target : (b,) array
        One figure per body; scaled inside.
    """

    def __init__(self, exams: Exams, target: FloatArray) -> None:
        self.exams, self.target = exams, target
        self.middle, self.spread = float(target.mean()), float(target.std())
        self.y = (target - self.middle) / self.spread
        count = np.bincount(exams.body)
        self.weight = 1.0 / count[exams.body]
        self.means = exams.mean(exams.features)
        self.noise = np.c_[np.ones(len(target)), self.means[:, : exams.noise_features]]
        self.line = np.c_[np.ones(len(target)), self.means]

    def start(self) -> FloatArray:
        """Parameters to begin with: log lengths, log height, coefficients of the log variance."""
        lengths = np.full(self.exams.features.shape[1], LOG_LENGTH)
        start: FloatArray = np.r_[lengths, LOG_HEIGHT, np.log(0.02), np.zeros(self.exams.noise_features)]
        return start

    def covariance(self, theta: FloatArray) -> _Parts:
        """Covariance of the process between exams, and between the means of bodies."""
        k = self.exams.features.shape[1]
        x = self.exams.features / np.exp(theta[:k])
        square = np.einsum("ij,ij->i", x, x)
        between = np.exp(2 * theta[k] - 0.5 * np.maximum(square[:, None] + square - 2 * x @ x.T, 0.0))
        weighted = between * self.weight[:, None] * self.weight
        order = np.argsort(self.exams.body, kind="stable")
        starts = np.searchsorted(self.exams.body[order], np.arange(len(self.y)))
        rows = np.add.reduceat(weighted[order][:, order], starts, axis=0)
        return _Parts(weighted, np.add.reduceat(rows, starts, axis=1))

    def objective(self, theta: FloatArray, kept: np.ndarray[Any, np.dtype[np.bool_]]) -> tuple[float, FloatArray]:
        """Negative log posterior of the parameters given the kept bodies, and its gradient."""
        k, e = self.exams.features.shape[1], len(theta) - self.noise.shape[1]
        parts, index = self.covariance(theta), np.flatnonzero(kept)
        variance = np.exp(self.noise[index] @ theta[e:])
        full = self._full(parts.bodies, index) + np.diag(variance)
        root = cholesky(full, lower=True)
        inverse = cho_solve((root, True), np.eye(len(index)))
        alpha = inverse @ self.y[index]
        inner = 0.5 * (inverse - np.outer(alpha, alpha))
        value = 0.5 * float(self.y[index] @ alpha) + float(np.log(np.diag(root)).sum())
        gradient = np.zeros_like(theta)
        wide = np.zeros((len(self.y), len(self.y)))
        wide[np.ix_(index, index)] = inner
        product = wide[np.ix_(self.exams.body, self.exams.body)] * parts.exams
        x = self.exams.features
        rows = product.sum(axis=1)
        apart = 2 * (rows @ x**2 - np.einsum("ik,ik->k", x, product @ x))
        gradient[:k] = apart / np.exp(2 * theta[:k])
        gradient[k] = 2 * product.sum()
        gradient[e:] = self.noise[index].T @ (np.diag(inner) * variance)
        prior, slope = self._prior(theta, k)
        return value + prior, gradient + slope

    def _full(self, process: FloatArray, index: np.ndarray[Any, np.dtype[np.int64]]) -> FloatArray:
        line = self.line[index] * LINE_SD
        return np.asarray(process[np.ix_(index, index)] + line @ line.T + _JITTER * np.eye(len(index)))

    def _prior(self, theta: FloatArray, k: int) -> tuple[float, FloatArray]:
        """Negative log prior and its gradient; the level of the errors has none."""
        middle = np.r_[np.full(k, LOG_LENGTH), LOG_HEIGHT, np.zeros(len(theta) - k - 1)]
        spread = np.r_[np.full(k, LOG_LENGTH_SD), LOG_HEIGHT_SD, np.inf, np.full(len(theta) - k - 2, SLOPE_SD)]
        away = (theta - middle) / spread
        return 0.5 * float(away @ away), away / spread

    def fit(
        self, kept: np.ndarray[Any, np.dtype[np.bool_]], *, start: FloatArray | None = None, steps: int = 60
    ) -> FloatArray:
        """Parameters at the mode given the kept bodies."""
        first = self.start() if start is None else start
        found = minimize(self.objective, first, args=(kept,), jac=True, method="L-BFGS-B", options={"maxiter": steps})
        return np.asarray(found.x)

    def predict(self, theta: FloatArray, kept: np.ndarray[Any, np.dtype[np.bool_]]) -> tuple[FloatArray, FloatArray]:
        """Predictions and their SD for the bodies that are not kept."""
        e = len(theta) - self.noise.shape[1]
        process, variance = self.covariance(theta).bodies, np.exp(self.noise @ theta[e:])
        index, other = np.flatnonzero(kept), np.flatnonzero(~kept)
        full = self._full(process, np.arange(len(self.y)))
        root = cholesky(full[np.ix_(index, index)] + np.diag(variance[index]), lower=True)
        cross = full[np.ix_(index, other)]
        solved = cho_solve((root, True), cross)
        mean = solved.T @ self.y[index]
        left = np.diag(full)[other] - np.einsum("ij,ij->j", cross, solved) + variance[other]
        return self.middle + self.spread * mean, self.spread * np.sqrt(left)


def left_out(
    exams: Exams,
    target: FloatArray,
    *,
    folds: int = 5,
    seed: int = 0,
    start: FloatArray | None = None,
    steps: int = 60,
    refit_steps: int = 10,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Predict each body from the others.

    Parameters
    ----------
    exams, target
        Features per exam, and one figure per body.
    folds, seed
        Bodies are divided into so many parts at random.
    start
        Parameters to begin with.
    steps, refit_steps
        Steps of the fit to all bodies, and of each fold's, which starts there.

    Returns
    -------
    error, sd : (b,) arrays
        Prediction less truth, and its stated SD.
    theta : array
        Parameters of the fit to all bodies.
    """
    process = BodyProcess(exams.scaled(), target)
    count = len(target)
    whole = process.fit(np.ones(count, dtype=bool), start=start, steps=steps)
    part = np.random.default_rng(seed).permutation(count) % folds
    error, sd = np.empty(count), np.empty(count)
    for fold in range(folds):
        kept = part != fold
        theta = process.fit(kept, start=whole, steps=refit_steps) if refit_steps else whole
        mean, stated = process.predict(theta, kept)
        error[~kept], sd[~kept] = mean - target[~kept], stated
    return error, sd, whole
