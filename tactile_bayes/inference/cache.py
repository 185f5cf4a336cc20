"""Cache of conditional (linear) solutions by parameter vector, reused when those points become draws."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from tactile_bayes.geometry import FloatArray

IntArray = np.ndarray[tuple[int, ...], np.dtype[np.intp]]
Solution = tuple[FloatArray, ...]
"""Arrays with a row a parameter vector; see `CollapsedTarget.conditional`."""


class Solved:
    """Cache of solutions by parameter vector.

    Importance sampling evaluates the density at points that its draws are then chosen from. Solving those a second
    time for the amplitude, level and noise scale of the draws cost as much as the sampling.

    Parameters
    ----------
    solve
        (m, p) parameter vectors to arrays of m rows.
    """

    def __init__(self, solve: Callable[[FloatArray], Solution]) -> None:
        self._solve = solve
        self._theta: list[FloatArray] = []
        self._solutions: list[Solution] = []
        self._index: tuple[FloatArray, Solution] | None = None

    def add(self, theta: FloatArray, solution: Solution) -> None:
        """Keep the solution at (m, p) parameter vectors."""
        self._theta.append(theta)
        self._solutions.append(solution)
        self._index = None

    def __call__(self, theta: FloatArray) -> Solution:
        """Solutions at (m, p) parameter vectors: cached where all are known, else computed."""
        if not self._theta:
            return self._solve(theta)
        points, kept = self._sorted()
        row = np.minimum(np.searchsorted(points[:, 0], theta[:, 0]), len(points) - 1)
        if not np.array_equal(points[row], theta):
            return self._solve(theta)
        return tuple(one[row] for one in kept)

    def _sorted(self) -> tuple[FloatArray, Solution]:
        """All points in order of their first coordinate, which random points never share, and their solutions."""
        if self._index is None:
            theta = np.concatenate(self._theta)
            order = np.argsort(theta[:, 0], kind="stable")
            together = (np.concatenate(parts) for parts in zip(*self._solutions, strict=True))
            self._index = theta[order], tuple(one[order] for one in together)
        return self._index


def distinct_rows(rows: FloatArray) -> tuple[FloatArray, IntArray]:
    """Distinct rows in order, and the index of each row among them: ``np.unique``, quicker for random points.

    No two of those agree in their first coordinate; where some do, rows are compared as a whole.
    """
    _, first, back = np.unique(rows[:, 0], return_index=True, return_inverse=True)
    if np.array_equal(rows[first[back]], rows):
        return rows[first], back
    distinct, back = np.unique(rows, axis=0, return_inverse=True)
    return distinct, back.reshape(-1)
