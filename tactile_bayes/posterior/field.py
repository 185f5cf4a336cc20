"""Correlated noise as a field of cosines on a window."""

from __future__ import annotations

import numpy as np

from tactile_bayes.declarations import Record
from tactile_bayes.forward.gaussian import cell_mean_gaussian, covariance_from_log_widths
from tactile_bayes.geometry import FloatArray
from tactile_bayes.posterior.bump import FitCells
from tactile_bayes.presets import FIELD_COSINES, FINE_FIELD_COSINES

# --- Correlated noise model: a Gaussian random field on a cosine basis plus white noise, whitened once for many fits.
#
# The error of cell i is :math:`\tau\,(\epsilon_i + \sqrt{\rho}\, f(x_i))` with independent :math:`\epsilon_i \sim
# N(0, D_i)` and a field f of unit variance and exponential correlation (Matern 1/2) of length l. The field is
# written in cosines on a rectangle around the window, each with the variance that the spectrum gives it. So a
# covariance is diagonal plus low rank, and every share :math:`\rho` comes from one eigen-decomposition a length.
#
# References
# ----------
# Solin & Saerkkae (2020), Statistics and Computing 30:419 (the basis); Rasmussen & Williams (2006), ch. 4 (the
#   spectrum).

MARGIN = 1.3
"""Width of the rectangle in widths of the window: the field need not be flat where the window ends."""
LENGTHS_MM = (1.5, 3.0, 6.0, 12.0)
SHARES = (0.0, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 300.0, 1000.0)
"""Variances of the field tried, over the mean independent variance of a cell."""
HALF_WAVE_IN_WIDTHS = 0.83
"""The shortest half wave that a bump's width calls for: below 3.5 mm, in a window of 20 mm, more than the fewest."""
TOUCHED = 1e-2
"""Directions in which the field's variance is a smaller part of the independent one are dropped."""


class Whitening(Record, eq=False):
    """The noise field of one correlation length, prepared for every share."""

    length_mm: float
    """Correlation length."""
    turn: FloatArray
    """(cosines^2, k) array: Takes inner products with the cosines, ``D^-1 Phi``, to directions in which the field's
    precision is diagonal.
    """
    eigenvalues: FloatArray
    """(k,) array: Of ``S^1/2 Phi' D^-1 Phi S^1/2``."""

    def shrinkage(self, share: float | FloatArray) -> FloatArray:
        """(..., k) weights of the squared projections that the field absorbs: ``rho / (1 + rho lambda)``."""
        rho = np.asarray(share)[..., None]
        return np.asarray(rho / (1.0 + rho * self.eigenvalues))

    def pruned(self, share: float) -> Whitening:
        """Copy without the directions that matter little at this share or a smaller one."""
        keep = share * self.eigenvalues > TOUCHED
        return Whitening(self.length_mm, np.ascontiguousarray(self.turn[:, keep]), self.eigenvalues[keep])

    def log_determinant(self, share: float | FloatArray) -> FloatArray:
        """(...) log determinant of the covariance over that of D."""
        return np.asarray(np.log1p(np.asarray(share)[..., None] * self.eigenvalues).sum(axis=-1))


def no_field(cosines: int) -> Whitening:
    """The share of 0, the same for every length: no directions."""
    return Whitening(float(np.mean(LENGTHS_MM)), np.zeros((cosines**2, 0)), np.zeros(0))


def cosine_profiles(axis_mm: FloatArray, *, cosines: int = FIELD_COSINES) -> tuple[FloatArray, FloatArray]:
    """(n, cosines) cosines along one axis, and their (cosines,) squared angular frequencies, 1/mm^2.

    Of mean square 1 over the axis and its margins.
    """
    phase, side = _phase(axis_mm)
    order = np.arange(cosines)
    profiles = np.cos(np.pi * order * phase[:, None])
    profiles[:, 1:] *= np.sqrt(2.0)
    return profiles, np.asarray((np.pi * order / side) ** 2, dtype=np.float64)


def cosines_for(width_mm: float, axis_mm: FloatArray) -> int:
    """Number of cosines along an axis for a bump's width, from `FIELD_COSINES` to `FINE_FIELD_COSINES`.

    Errors shorter than the shortest half wave count as independent. For a narrow bump they are not: they have its
    shape.
    """
    _, side = _phase(axis_mm)
    wanted = np.ceil(side / (HALF_WAVE_IN_WIDTHS * max(width_mm, 1e-6)))
    return int(np.clip(wanted, FIELD_COSINES, FINE_FIELD_COSINES))


def _phase(axis_mm: FloatArray) -> tuple[FloatArray, float]:
    middle = 0.5 * (axis_mm.max() + axis_mm.min())
    side = MARGIN * max(float(np.ptp(axis_mm)), 1e-6)
    return (axis_mm - middle) / side + 0.5, side


def gram_of_cosines(along: FloatArray, across: FloatArray, *, weight: FloatArray) -> FloatArray:
    """Inner products of the plane's cosines under (ny, nx) weights: (cosines^2, cosines^2), y's order counted first.

    `along` and `across` are (ny, cosines) and (nx, cosines) arrays from `cosine_profiles`.
    """
    pairs = [(one[:, :, None] * one[:, None, :]).reshape(len(one), -1) for one in (along, across)]
    cosines = along.shape[1]
    # axes: y, y', x, x'
    products = (pairs[0].T @ weight @ pairs[1]).reshape(cosines, cosines, cosines, cosines)
    return np.asarray(products.transpose(0, 2, 1, 3).reshape(cosines**2, cosines**2))


def spectrum(frequency2: FloatArray, length_mm: float) -> FloatArray:
    """(k,) variances of the cosines for an exponential correlation in the plane, scaled to a mean variance of 1."""
    density = (1.0 / length_mm**2 + frequency2) ** -1.5
    return np.asarray(density / density.sum())


def whitening(gram: FloatArray, frequency2: FloatArray, *, length_mm: float) -> Whitening:
    """Prepare the noise field of one length, from the (k, k) gram ``Phi' D^-1 Phi`` and (k,) frequencies squared,
    1/mm^2.
    """
    root = np.sqrt(spectrum(frequency2, length_mm))
    values, vectors = np.linalg.eigh(root[:, None] * gram * root)
    keep = values > 1e-9 * values[-1]
    return Whitening(length_mm, root[:, None] * vectors[:, keep], values[keep])


# --- The fit window as a regular grid, with fast separable inner products of Gaussian templates and the noise basis.
#
# A Gaussian along the grid's axes is a product of two profiles, and so are the cosines: an inner product costs the
# work of the grid's rows, not of its cells times the cosines. Cells that the map does not cover have weight 0.

RESOLVED = 3.0
"""Widths above as many cells need no more than a cell's variance."""


class Projected(Record, eq=False):
    """Inner products of m templates, with cells weighted by their inverse independent variance."""

    low: FloatArray
    """(m, cosines^2) array: With the cosines."""
    plain: FloatArray
    """(m, c) array: With the fixed vectors."""
    square: FloatArray
    """(m,) array: With themselves."""


class Profiles(Record, eq=False):
    """m templates on the grid: products of `rows` (m, ny) and `columns` (m, nx), or `grid` (m, ny, nx) as it is."""

    rows: FloatArray | None = None
    columns: FloatArray | None = None
    grid: FloatArray | None = None

    def full(self) -> FloatArray:
        """(m, ny, nx) templates."""
        if self.grid is not None:
            return self.grid
        assert self.rows is not None
        assert self.columns is not None
        return np.asarray(self.rows[:, :, None] * self.columns[:, None, :])


class Window:
    """Grid of one window with its cosines and the noise fields of several lengths (prepared on first use).

    The (k,) `variance` is each cell's independent variance, up to a common factor; `cosines` counts along each axis.
    """

    def __init__(self, cells: FitCells, variance: FloatArray, *, cosines: int = FIELD_COSINES) -> None:
        self.cells, self.variance, self.cosines = cells, variance, cosines
        self.x_mm, self._column = np.unique(cells.x_mm, return_inverse=True)
        self.y_mm, self._row = np.unique(cells.y_mm, return_inverse=True)
        self.weight = self.on_grid(1.0 / variance)
        self._across, self._frequency_x = cosine_profiles(self.x_mm, cosines=cosines)
        self._along, self._frequency_y = cosine_profiles(self.y_mm, cosines=cosines)
        by_row = self.weight.T[:, :, None] * self._across[:, None, :]
        self._weighted_across = by_row.reshape(len(self.x_mm), -1)
        self._fields: dict[float, Whitening] = {}
        self._gram: FloatArray | None = None

    def on_grid(self, values: FloatArray) -> FloatArray:
        """(..., ny, nx) grid of (..., k) cell values, 0 where there is no cell."""
        grid = np.zeros((*values.shape[:-1], len(self.y_mm), len(self.x_mm)))
        grid[..., self._row, self._column] = values
        return grid

    def of_cells(self, grid: FloatArray) -> FloatArray:
        """(..., k) cell values of (..., ny, nx) grids."""
        return np.asarray(grid[..., self._row, self._column])

    def field(self, length_mm: float) -> Whitening:
        """The noise field of one correlation length."""
        if length_mm not in self._fields:
            if self._gram is None:
                self._gram = gram_of_cosines(self._along, self._across, weight=self.weight)
            frequency2 = (self._frequency_y[:, None] + self._frequency_x[None, :]).ravel()
            self._fields[length_mm] = whitening(self._gram, frequency2, length_mm=length_mm)
        return self._fields[length_mm]

    def project(self, templates: Profiles, plain: FloatArray) -> Projected:
        """Inner products of templates with the cosines, with (c, ny, nx) weighted vectors, and with themselves."""
        if templates.grid is not None:
            return self._project_grid(templates.grid, plain)
        rows, columns = templates.rows, templates.columns
        assert rows is not None
        assert columns is not None
        m, c = len(rows), len(plain)
        half = (columns @ self._weighted_across).reshape(m, len(self.y_mm), self.cosines)
        low = np.matmul(self._along.T, half * rows[:, :, None]).reshape(m, -1)
        beside = (columns @ plain.transpose(2, 1, 0).reshape(len(self.x_mm), -1)).reshape(m, -1, c)
        with_plain = np.matmul(rows[:, None, :], beside)[:, 0]
        square = np.einsum("mr,mr->m", rows**2, columns**2 @ self.weight.T)
        return Projected(low, with_plain, square)

    def _project_grid(self, grid: FloatArray, plain: FloatArray) -> Projected:
        m = len(grid)
        weighted = grid * self.weight
        half = (weighted.reshape(-1, len(self.x_mm)) @ self._across).reshape(m, len(self.y_mm), self.cosines)
        low = np.matmul(self._along.T, half).reshape(m, -1)
        with_plain = grid.reshape(m, -1) @ plain.reshape(len(plain), -1).T
        return Projected(low, with_plain, np.einsum("mrc,mrc->m", weighted, grid))

    def product(self, one: Profiles, other: Profiles) -> FloatArray:
        """(m,) inner products of templates with templates, pairwise."""
        if one.grid is None and other.grid is None:
            assert one.rows is not None
            assert one.columns is not None
            assert other.rows is not None
            assert other.columns is not None
            across = (one.columns * other.columns) @ self.weight.T
            return np.asarray(np.einsum("mr,mr->m", one.rows * other.rows, across))
        return np.asarray(np.einsum("mrc,mrc->m", one.full() * self.weight, other.full()))

    def bumps(
        self, x_mm: FloatArray, y_mm: FloatArray, *, p: FloatArray, q: FloatArray, r: FloatArray | None
    ) -> Profiles:
        """Cell means of (m,) blurred Gaussians of unit height; along the grid's axes when r is None."""
        cell, noise = self.cells.cell_mm, self.cells.pose_noise
        blur_x, blur_y = (0.0, 0.0) if noise is None else noise.sd_mm
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            if r is None:
                columns = blurred_profile(self.x_mm - x_mm[:, None], np.exp(p + q), blur_mm=blur_x, cell_mm=cell)
                rows = blurred_profile(self.y_mm - y_mm[:, None], np.exp(p - q), blur_mm=blur_y, cell_mm=cell)
                return Profiles(rows, columns)
            covariance = covariance_from_log_widths(p, q, r)
            blurred = covariance + np.diag([blur_x**2, blur_y**2])
            lower = np.sqrt(np.linalg.det(covariance) / np.linalg.det(blurred))
            across, along = self.x_mm - x_mm[:, None], self.y_mm - y_mm[:, None]
            grid = turned_gaussians(across, along, covariance_mm2=blurred, cell_mm=cell)
            grid *= lower[:, None, None]
            return Profiles(grid=grid)

    def ridges(self, angle_rad: FloatArray, offset_mm: FloatArray, *, log_width: FloatArray) -> Profiles:
        """Straight ridges of unit height, Gaussian across, `offset_mm` from `middle` in direction `angle_rad`."""
        x, y = self.middle
        across_x = np.cos(angle_rad)[:, None] * (self.x_mm - x)
        across_y = np.sin(angle_rad)[:, None] * (self.y_mm - y)
        distance = across_x[:, None, :] + across_y[:, :, None] - offset_mm[:, None, None]
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            # a square cell is as wide as a box of its side in every direction, as far as its variance goes
            variance = np.exp(2.0 * log_width) + self.cells.cell_mm**2 / 12.0
            height = np.exp(log_width) / np.sqrt(variance)
            return Profiles(grid=height[:, None, None] * np.exp(-0.5 * distance**2 / variance[:, None, None]))

    @property
    def middle(self) -> tuple[float, float]:
        """Mean of the cells' centres, in mm."""
        return float(np.mean(self.cells.x_mm)), float(np.mean(self.cells.y_mm))


def turned_gaussians(x_mm: FloatArray, y_mm: FloatArray, *, covariance_mm2: FloatArray, cell_mm: float) -> FloatArray:
    """(m, ny, nx) cell means of rotated Gaussians, from (m, nx) and (m, ny) distances.

    Where every width is above `RESOLVED` cells the fourth cumulant of a cell is left out: below 3e-5 of the height.
    """
    wide = covariance_mm2 + cell_mm**2 / 12.0 * np.eye(2)
    narrow = covariance_mm2[:, 0, 0] * covariance_mm2[:, 1, 1] - covariance_mm2[:, 0, 1] ** 2
    mean = 0.5 * (covariance_mm2[:, 0, 0] + covariance_mm2[:, 1, 1])
    least = mean - np.sqrt(np.maximum(mean**2 - narrow, 0.0))
    if not np.nanmin(least) > (RESOLVED * cell_mm) ** 2:
        x, y = x_mm[:, None, :], y_mm[:, :, None]
        return cell_mean_gaussian(x, y, covariance_mm2=covariance_mm2[:, None], cell_mm=cell_mm)
    det = wide[:, 0, 0] * wide[:, 1, 1] - wide[:, 0, 1] ** 2
    half = -0.5 / det
    square = (2.0 * half * -wide[:, 0, 1])[:, None, None] * y_mm[:, :, None] * x_mm[:, None, :]
    square += (half * wide[:, 1, 1])[:, None, None] * np.square(x_mm)[:, None, :]
    square += ((half * wide[:, 0, 0])[:, None] * np.square(y_mm))[:, :, None]
    np.exp(square, out=square)
    square *= np.sqrt(np.clip(narrow, 0.0, None) / det)[:, None, None]
    return square


def blurred_profile(distance_mm: FloatArray, sigma_mm: FloatArray, *, blur_mm: float, cell_mm: float) -> FloatArray:
    """As `cell_mean_profile`, for Gaussians of unit height before a blur of this SD."""
    wide = np.hypot(sigma_mm, blur_mm)
    return (sigma_mm / wide)[:, None] * cell_mean_profile(distance_mm, sigma_mm=wide, cell_mm=cell_mm)


def cell_mean_profile(distance_mm: FloatArray, *, sigma_mm: FloatArray, cell_mm: float) -> FloatArray:
    """(m, k) means over cells of one-dimensional unit Gaussians, the factors of `cell_mean_gaussian`.

    The two corrections of that function's series are multiplied here and added there: a difference of the order of
    the terms that both leave out.
    """
    wide = (sigma_mm**2 + cell_mm**2 / 12.0)[:, None]
    square = distance_mm**2 / wide
    gaussian = sigma_mm[:, None] / np.sqrt(wide) * np.exp(-0.5 * square)
    fourth = (square * (square - 6.0) + 3.0) / wide**2
    return np.asarray(gaussian * (1.0 - cell_mm**4 / 2880.0 * fourth))
