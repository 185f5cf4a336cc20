"""The paper's model of a map: one Gaussian bump on a level background (Eq 7), with its priors."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from tactile_bayes.declarations import Record
from tactile_bayes.forward.gaussian import cell_mean_gaussian, covariance_from_log_widths, principal_widths
from tactile_bayes.geometry import FloatArray
from tactile_bayes.options import BumpPrior
from tactile_bayes.posterior.fit_window import FitCells

BLOCK, LEAST_BLOCK = 64, 4
"""Parameter vectors predicted at a time: few enough for the intermediate arrays to stay in a processor's cache."""
BLOCK_VALUES = 512 * 1024
"""Cells times vectors in a block: beyond 8192 cells a block has fewer vectors, but `LEAST_BLOCK`."""

IntArray = np.ndarray[tuple[int, ...], np.dtype[np.intp]]


def block_size(cells: int) -> int:
    """Number of parameter vectors to predict at a time, for a window of this many cells."""
    return min(BLOCK, max(LEAST_BLOCK, BLOCK_VALUES // max(cells, 1)))


class Bump(Record):
    """The parameters of the model: rotation and a free background are optional.

    The parameter vector is ``(amplitude, x, y, p, q[, r][, background])``: mm for the centre, p and q the log widths
    of `covariance_from_log_widths`.
    """

    rotated: bool = False
    """Whether the axes of the ellipse may turn (adds r)."""
    background: float | None = 1.0
    """Fixed level (1 in Eq 7), or None to fit it."""
    scale: float = 1.0
    """Unit of amplitude for priors and steps, see `cells.value_scale`."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters, in order."""
        rotation = ("r",) if self.rotated else ()
        level = ("background",) if self.background is None else ()
        return ("amplitude", "x_mm", "y_mm", "p", "q", *rotation, *level)

    @property
    def step_scale(self) -> FloatArray:
        """(p,) typical length of each parameter; the fit's steps are limited in these units."""
        sizes = {"amplitude": self.scale, "background": self.scale, "x_mm": 2.0, "y_mm": 2.0}
        return np.array([sizes.get(name, 0.3) for name in self.names])

    def shape_parameters(self, theta: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """p, q, r of (..., p) parameter vectors; r is 0 without rotation."""
        r = theta[..., 5] if self.rotated else np.zeros(theta.shape[:-1])
        return theta[..., 3], theta[..., 4], r

    def widths(self, theta: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """sigma_x_mm, sigma_y_mm and angle_rad of (..., p) parameter vectors."""
        return principal_widths(*self.shape_parameters(theta))

    def level(self, theta: FloatArray) -> FloatArray:
        """Background of (..., p) parameter vectors."""
        if self.background is None:
            return np.asarray(theta[..., -1])
        return np.full(theta.shape[:-1], self.background)

    def unit_bump(self, theta: FloatArray, cells: FitCells) -> FloatArray:
        """(m, k) bump of unit amplitude, averaged over each cell, for (m, p) parameter vectors."""
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            if not self.rotated:
                return straight_bump(theta[:, 1], theta[:, 2], p=theta[:, 3], q=theta[:, 4], cells=cells)
            return cell_mean_gaussian(
                cells.x_mm - theta[:, 1, None],
                cells.y_mm - theta[:, 2, None],
                covariance_mm2=covariance_from_log_widths(*self.shape_parameters(theta)),
                cell_mm=cells.cell_mm,
            )

    def predict(self, theta: FloatArray, cells: FitCells) -> FloatArray:
        """(m, k) map values of (m, p) parameter vectors: Eq 7 averaged over the cells."""
        size = block_size(len(cells))
        if len(theta) > size:
            return np.concatenate([self.predict(theta[i : i + size], cells) for i in range(0, len(theta), size)])
        values = self.unit_bump(theta, cells)
        values *= theta[:, 0, None]
        values += self.level(theta)[:, None]
        return values

    def log_prior(self, theta: FloatArray, prior: BumpPrior) -> FloatArray:
        """(m,) log prior density, flat in the background; the centre's prior belongs to the window."""
        p, q, r = self.shape_parameters(theta)
        z = [
            (theta[..., 0] / self.scale / prior.amplitude_sd, prior.amplitude_sd * self.scale),
            ((p - np.log(prior.width_median_mm)) / prior.log_width_sd, prior.log_width_sd),
            (q / prior.log_ratio_sd, prior.log_ratio_sd),
        ]
        if self.rotated:
            z.append((r / prior.log_ratio_sd, prior.log_ratio_sd))
        total = sum(-0.5 * value**2 - np.log(sd * np.sqrt(2 * np.pi)) for value, sd in z)
        return np.asarray(total)


def straight_bump(x_mm: FloatArray, y_mm: FloatArray, *, p: FloatArray, q: FloatArray, cells: FitCells) -> FloatArray:
    """(m, k) cell means of Gaussians along the grid's axes: products of row and column profiles.

    It is the same formula. Its exponential is a product and its fourth cumulant a sum of what rows and columns have.
    """
    x_axis, y_axis, place = _lattice(cells)
    x, x_fourth = _profile(x_axis, centre_mm=x_mm, sigma_mm=np.exp(p + q), cell_mm=cells.cell_mm)
    y, y_fourth = _profile(y_axis, centre_mm=y_mm, sigma_mm=np.exp(p - q), cell_mm=cells.cell_mm)
    bump = (1.0 - y_fourth)[:, :, None] - x_fourth[:, None, :]
    bump *= x[:, None, :]
    bump *= y[:, :, None]
    return np.asarray(bump.reshape(len(bump), -1).take(place, axis=1))


@lru_cache(maxsize=2)
def _lattice(cells: FitCells) -> tuple[FloatArray, FloatArray, IntArray]:
    """Coordinates of the window's columns and rows, and each cell's index in their grid; cached."""
    column, row = cells.column - cells.column.min(), cells.row - cells.row.min()
    x_axis, y_axis = np.zeros(int(column.max()) + 1), np.zeros(int(row.max()) + 1)
    x_axis[column], y_axis[row] = cells.x_mm, cells.y_mm
    return x_axis, y_axis, row * len(x_axis) + column


def _profile(
    axis_mm: FloatArray, *, centre_mm: FloatArray, sigma_mm: FloatArray, cell_mm: float
) -> tuple[FloatArray, FloatArray]:
    """(m, n) cell means of Gaussians along an axis to second order, and their fourth-order correction."""
    wide = (sigma_mm**2 + cell_mm**2 / 12.0)[:, None]
    square = (axis_mm - centre_mm[:, None]) ** 2 / wide
    gaussian = sigma_mm[:, None] / np.sqrt(wide) * np.exp(-0.5 * square)
    return gaussian, cell_mm**4 / 2880.0 * (square * (square - 6.0) + 3.0) / wide**2
