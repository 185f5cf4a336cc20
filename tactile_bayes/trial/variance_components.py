"""Variances of masses, readers and maps from unbalanced readings, by restricted maximum likelihood."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from tactile_bayes.trial.readings import FloatArray

Index = npt.NDArray[np.int64]
_Criterion = Callable[[FloatArray], float]


@dataclass(frozen=True, slots=True)
class Components:
    """Variances of the model y = mean + mass + reader + map, each independent and normal.

    `reader` is None where only one reader read, so that its variance is part of the mean.
    """

    mass: float
    reader: float | None
    map: float
    n: int
    masses: int
    readers: int


def components(y: FloatArray, mass: Index, reader: Index) -> Components:
    """Estimate the variances by REML.

    Parameters
    ----------
    y : (n,) array
    mass, reader : (n,) arrays
        Numbers from 0 without gaps.

    Notes
    -----
    Patterson & Thompson (1971), Biometrika 58, 545. The criterion is profiled over the residual variance and searched
    in the ratios of SDs to the residual SD, in which it is even, so that a variance of 0 is no edge (Bates et al.
    2015, J. Stat. Softw. 67(1)). Masses are eliminated one by one, which leaves a system of the readers' size.
    """
    readers = int(reader.max()) + 1
    problem = _Problem(y - y.mean(), mass, reader)
    start = np.array([1.0, 0.3]) if readers > 1 else np.array([1.0])
    theta = np.abs(_least(problem.criterion, start))
    residual = problem.residual_variance(theta)
    return Components(
        mass=_variance(theta[0], residual),
        reader=_variance(theta[1], residual) if readers > 1 else None,
        map=residual,
        n=len(y),
        masses=int(mass.max()) + 1,
        readers=readers,
    )


def _variance(ratio: float, residual: float) -> float:
    """Variance at a ratio of SDs; 0 where the search ended at its lower limit."""
    return 0.0 if ratio < 1e-6 else float(ratio**2 * residual)


class _Problem:
    """Sums that the REML criterion needs: by mass, by reader and by pair of the two."""

    def __init__(self, y: FloatArray, mass: Index, reader: Index) -> None:
        masses, readers = int(mass.max()) + 1, int(reader.max()) + 1
        self.n = len(y)
        self.yy = float(y @ y)
        self.count = np.bincount(mass, minlength=masses).astype(np.float64)
        self.sum = np.bincount(mass, weights=y, minlength=masses)
        # fixed mean first, then readers: counts and sums of y of each mass in each of these columns
        self.cross = np.zeros((masses, readers + 1))
        np.add.at(self.cross, (mass, reader + 1), 1.0)
        self.cross[:, 0] = self.count
        per_reader = np.bincount(reader, minlength=readers).astype(np.float64)
        self.gram = np.diag(np.concatenate([[self.n], per_reader]))
        self.gram[0, 1:] = self.gram[1:, 0] = per_reader
        self.right = np.concatenate([[y.sum()], np.bincount(reader, weights=y, minlength=readers)])

    def _solved(self, theta: FloatArray) -> tuple[float, float]:
        """Log determinant of the REML criterion and the weighted residual sum of squares, both over variance 1."""
        shrink = theta[0] ** 2 / (1 + theta[0] ** 2 * self.count)
        gram = self.gram - (self.cross * shrink[:, None]).T @ self.cross
        right = self.right - self.cross.T @ (shrink * self.sum)
        squares = self.yy - float(shrink @ self.sum**2)
        scale = np.ones(len(right))
        scale[1:] = theta[1] if len(theta) > 1 else 0.0
        system = gram * np.outer(scale, scale)
        system[1:, 1:] += np.eye(len(scale) - 1)
        beta = np.linalg.solve(system, scale * right)
        _, log_det = np.linalg.slogdet(system)
        return float(log_det + np.sum(np.log1p(theta[0] ** 2 * self.count))), squares - float(beta @ (scale * right))

    def criterion(self, theta: FloatArray) -> float:
        """-2 log restricted likelihood, less a constant."""
        log_det, squares = self._solved(theta)
        return log_det + (self.n - 1) * math.log(max(squares, 1e-300))

    def residual_variance(self, theta: FloatArray) -> float:
        return max(0.0, self._solved(theta)[1]) / (self.n - 1)


def _least(function: _Criterion, start: FloatArray) -> FloatArray:
    """Minimum by Newton's method with finite differences, kept downhill; the best of a few starts."""
    found = [_descend(function, start * factor) for factor in (1.0, 0.2, 5.0)]
    return min(found, key=function)


def _descend(function: _Criterion, theta: FloatArray) -> FloatArray:
    value, k = function(theta), len(theta)
    for _ in range(60):
        h = 1e-4 * np.maximum(np.abs(theta), 1e-2)
        steps = np.diag(h)
        ahead = np.array([function(theta + s) for s in steps])
        behind = np.array([function(theta - s) for s in steps])
        slope = (ahead - behind) / (2 * h)
        bend = np.diag((ahead - 2 * value + behind) / h**2)
        for i in range(k):
            for j in range(i):
                mixed = function(theta + steps[i] + steps[j]) - ahead[i] - ahead[j] + value
                bend[i, j] = bend[j, i] = mixed / (h[i] * h[j])
        values, vectors = np.linalg.eigh(bend)
        step = -vectors @ ((vectors.T @ slope) / np.maximum(np.abs(values), 1e-6))
        theta, moved, value = _downhill(function, theta, step, value)
        if moved < 1e-9 * max(1.0, float(np.abs(theta).max())):
            break
    return theta


def _downhill(
    function: _Criterion, theta: FloatArray, step: FloatArray, value: float
) -> tuple[FloatArray, float, float]:
    size = float(np.abs(step).max())
    step = step * min(1.0, 3 * max(1.0, float(np.abs(theta).max())) / size) if size > 0 else step
    for _ in range(40):
        tried = function(theta + step)
        if tried <= value:
            return theta + step, float(np.abs(step).max()), tried
        step = step / 2
    return theta, 0.0, value
