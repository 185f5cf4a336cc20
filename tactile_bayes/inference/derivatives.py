"""Gradient and Hessian of a scalar function by central differences, evaluated in one call."""

from __future__ import annotations

import numpy as np

from tactile_bayes.geometry import FloatArray


def stencil(theta: FloatArray, *, step: FloatArray) -> FloatArray:
    """(1 + 2 p^2, p) points for central first and second differences, `theta` first."""
    shifts = np.diag(step)
    points = [theta[None], theta + shifts, theta - shifts]
    for i, j in _pairs(len(theta)):
        corners = [shifts[i] + shifts[j], shifts[i] - shifts[j], shifts[j] - shifts[i], -shifts[i] - shifts[j]]
        points.append(theta + np.array(corners))
    return np.concatenate(points)


def finite_differences(values: FloatArray, *, step: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(p,) gradient and (p, p) Hessian from a function's values at the points of `stencil`."""
    p = len(step)
    here, up, down = values[0], values[1 : p + 1], values[p + 1 : 2 * p + 1]
    hessian = np.diag((up - 2 * here + down) / step**2)
    for (i, j), quad in zip(_pairs(p), values[2 * p + 1 :].reshape(-1, 4), strict=True):
        hessian[i, j] = hessian[j, i] = (quad[0] - quad[1] - quad[2] + quad[3]) / (4 * step[i] * step[j])
    return (up - down) / (2 * step), hessian


def _pairs(p: int) -> list[tuple[int, int]]:
    return [(i, j) for i in range(p) for j in range(i)]
