"""A fit window: the grid of its cells, the noise field on it, and the scenes that it may hold."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final, Literal

import numpy as np

from tactile_bayes.declarations import Record
from tactile_bayes.geometry import BoolArray, FloatArray
from tactile_bayes.options import BumpPrior
from tactile_bayes.posterior.bump import FitCells, cell_mean_gaussian, covariance_from_log_widths
from tactile_bayes.posterior.white import WIDEST_IN_RADII
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

MARGIN = 1.3  #: Width of the rectangle in widths of the window: the field need not be flat where the window ends.
LENGTHS_MM = (1.5, 3.0, 6.0, 12.0)
SHARES = (0.0, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 300.0, 1000.0)
"""Variances of the field tried, over the mean independent variance of a cell."""
HALF_WAVE_IN_WIDTHS = 0.83
"""The shortest half wave that a bump's width calls for: below 3.5 mm, in a window of 20 mm, more than the fewest."""
TOUCHED = 1e-2  #: Directions in which the field's variance is a smaller part of the independent one are dropped.


class Whitening(Record, eq=False):
    """The noise field of one correlation length, prepared for every share."""

    length_mm: float  #: Correlation length.
    turn: FloatArray
    """(cosines^2, k) array: Takes inner products with the cosines, ``D^-1 Phi``, to directions in which the field's
    precision is diagonal."""
    eigenvalues: FloatArray  #: (k,) array: Of ``S^1/2 Phi' D^-1 Phi S^1/2``.

    def pruned(self, share: float) -> Whitening:
        """Copy without the directions that matter little at this share or a smaller one."""
        keep = share * self.eigenvalues > TOUCHED
        return Whitening(self.length_mm, np.ascontiguousarray(self.turn[:, keep]), self.eigenvalues[keep])


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
    1/mm^2."""
    root = np.sqrt(spectrum(frequency2, length_mm))
    values, vectors = np.linalg.eigh(root[:, None] * gram * root)
    keep = values > 1e-9 * values[-1]
    return Whitening(length_mm, root[:, None] * vectors[:, keep], values[keep])


# --- The fit window as a regular grid, with fast separable inner products of Gaussian templates and the noise basis.
#
# A Gaussian along the grid's axes is a product of two profiles, and so are the cosines: an inner product costs the
# work of the grid's rows, not of its cells times the cosines. Cells that the map does not cover have weight 0.

RESOLVED = 3.0  #: Widths above as many cells need no more than a cell's variance.


class Projected(Record, eq=False):
    """Inner products of m templates, with cells weighted by their inverse independent variance."""

    low: FloatArray  #: (m, cosines^2) array: With the cosines.
    plain: FloatArray  #: (m, c) array: With the fixed vectors.
    square: FloatArray  #: (m,) array: With themselves.


class Profiles(Record, eq=False):
    """m templates on the grid that are products of `rows` (m, ny) and `columns` (m, nx)."""

    rows: FloatArray
    columns: FloatArray

    def full(self) -> FloatArray:
        """(m, ny, nx) templates."""
        return np.asarray(self.rows[:, :, None] * self.columns[:, None, :])


Templates = Profiles | FloatArray  #: m templates: products of profiles, or (m, ny, nx) values as they are.


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
        self.middle = float(np.mean(cells.x_mm)), float(np.mean(cells.y_mm))
        """Mean of the cells' centres, in mm."""
        self._fields: dict[float, Whitening] = {}
        self._gram: FloatArray | None = None

    def on_grid(self, values: FloatArray) -> FloatArray:
        """(..., ny, nx) grid of (..., k) cell values, 0 where there is no cell."""
        grid = np.zeros((*values.shape[:-1], len(self.y_mm), len(self.x_mm)))
        grid[..., self._row, self._column] = values
        return grid

    def of_cells(self, templates: Templates) -> FloatArray:
        """(..., k) cell values of templates or (..., ny, nx) grids."""
        grid = templates.full() if isinstance(templates, Profiles) else templates
        return np.asarray(grid[..., self._row, self._column])

    def field(self, length_mm: float) -> Whitening:
        """The noise field of one correlation length."""
        if length_mm not in self._fields:
            if self._gram is None:
                self._gram = gram_of_cosines(self._along, self._across, weight=self.weight)
            frequency2 = (self._frequency_y[:, None] + self._frequency_x[None, :]).ravel()
            self._fields[length_mm] = whitening(self._gram, frequency2, length_mm=length_mm)
        return self._fields[length_mm]

    def project(self, templates: Templates, plain: FloatArray) -> Projected:
        """Inner products of templates with the cosines, with (c, ny, nx) weighted vectors, and with themselves."""
        if not isinstance(templates, Profiles):
            m, weighted = len(templates), templates * self.weight
            half = (weighted.reshape(-1, len(self.x_mm)) @ self._across).reshape(m, len(self.y_mm), self.cosines)
            low = np.matmul(self._along.T, half).reshape(m, -1)
            with_plain = templates.reshape(m, -1) @ plain.reshape(len(plain), -1).T
            return Projected(low, with_plain, np.einsum("mrc,mrc->m", weighted, templates))
        rows, columns = templates.rows, templates.columns
        m, c = len(rows), len(plain)
        half = (columns @ self._weighted_across).reshape(m, len(self.y_mm), self.cosines)
        low = np.matmul(self._along.T, half * rows[:, :, None]).reshape(m, -1)
        beside = (columns @ plain.transpose(2, 1, 0).reshape(len(self.x_mm), -1)).reshape(m, -1, c)
        with_plain = np.matmul(rows[:, None, :], beside)[:, 0]
        square = np.einsum("mr,mr->m", rows**2, columns**2 @ self.weight.T)
        return Projected(low, with_plain, square)

    def projected(self, templates: list[Templates], plain: FloatArray) -> tuple[list[Projected], FloatArray | None]:
        """`project` of one or two structures' templates, and the `product` of two."""
        cross = self.product(*templates) if len(templates) == 2 else None
        return [self.project(one, plain) for one in templates], cross

    def product(self, one: Templates, other: Templates) -> FloatArray:
        """(m,) inner products of templates with templates, pairwise."""
        if isinstance(one, Profiles) and isinstance(other, Profiles):
            across = (one.columns * other.columns) @ self.weight.T
            return np.asarray(np.einsum("mr,mr->m", one.rows * other.rows, across))
        first, second = (two.full() if isinstance(two, Profiles) else two for two in (one, other))
        return np.asarray(np.einsum("mrc,mrc->m", first * self.weight, second))

    def bumps(
        self, x_mm: FloatArray, y_mm: FloatArray, *, p: FloatArray, q: FloatArray, r: FloatArray | None
    ) -> Templates:
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
            return grid

    def ridges(self, angle_rad: FloatArray, offset_mm: FloatArray, *, log_width: FloatArray) -> FloatArray:
        """(m, ny, nx) ridges of unit height, Gaussian across, `offset_mm` from `middle` in direction `angle_rad`."""
        x, y = self.middle
        across_x = np.cos(angle_rad)[:, None] * (self.x_mm - x)
        across_y = np.sin(angle_rad)[:, None] * (self.y_mm - y)
        distance = across_x[:, None, :] + across_y[:, :, None] - offset_mm[:, None, None]
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            # a square cell is as wide as a box of its side in every direction, as far as its variance goes
            variance = np.exp(2.0 * log_width) + self.cells.cell_mm**2 / 12.0
            height = np.exp(log_width) / np.sqrt(variance)
            return np.asarray(height[:, None, None] * np.exp(-0.5 * distance**2 / variance[:, None, None]))


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


# --- The fit problem that all scenes of one window share: cells, prior and bounds.


class Problem(Record, eq=False):
    """A window with its cells, and the assumptions about a bump in it."""

    window: Window  #: The cells; scenes share one, and with it the noise fields.
    prior: BumpPrior  #: On widths and amplitudes.
    radius_mm: float  #: Radius of the window; bounds the centre about the window's middle.
    amplitude_scale: float = 1.0  #: Unit of the amplitudes' prior, see `bump.value_scale`.
    departure: FloatArray | None = None  #: (k, n) array: Further fixed columns, see `fit.ask_departure`; None for none.

    @property
    def widest_mm(self) -> float:
        """Upper bound of the widths."""
        return WIDEST_IN_RADII * self.radius_mm


# --- Scenes: the structures that a fit window may hold, with their parameters and prior.
#
# Or a ridge in the bump's place: what a lump's evidence is held against where a ridge is to be feared.

Shape = Literal["round", "ellipse", "rotated", "ridge"]
Neighbour = Literal["second lump", "rib"]
Extra = Literal[Neighbour, ""]
REACH_IN_RADII = 1.5
"""How far from the window's middle a second structure is looked for: beyond its rim a flank still shows."""
APART = 2.0
"""A second lump lies at least this many widths from the first: closer, two Gaussians have one top. A rib may run under
the bump if it is no more than this many times as wide: a wider one is the level's own curve."""
STEP = {
    "u": 0.06,
    "v": 0.06,
    "r": 0.06,
    "x": 0.3,
    "y": 0.3,
    "x2": 0.6,
    "y2": 0.6,
    "w2": 0.15,
    "angle": 0.08,
    "offset": 0.6,
    "along": 0.08,
    "across": 0.6,
}
"""About one posterior standard deviation of each parameter: steps of the search for the mode."""

_BUMP_NAMES: Final[Mapping[Shape, tuple[str, ...]]] = {
    "round": ("u", "x", "y"),
    "ellipse": ("u", "v", "x", "y"),
    "rotated": ("u", "v", "x", "y", "r"),
    "ridge": ("u", "along", "across"),
}
_NEIGHBOUR_NAMES: Final[Mapping[Extra, tuple[str, ...]]] = {
    "": (),
    "second lump": ("x2", "y2", "w2"),
    "rib": ("angle", "offset", "w2"),
}


class Scene(Record):
    """Structures in a model.

    The parameters are ``u, v, x, y`` (logs of the widths while nothing is turned, and the centre), without v for a
    round bump, with r for a turned one; then ``x2, y2, w2`` (centre and log width of a second round lump) or
    ``angle, offset, w2`` (a ridge). A ridge in the bump's place has ``u, along, across``: log width, angle, offset.
    """

    shape: Shape = "ellipse"  #: Shape of the bump.
    tilt: bool = True  #: The level may slope.
    extra: Extra = ""  #: Structure beside the bump.

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the shape parameters, the most important first (see `importance`)."""
        return _BUMP_NAMES[self.shape] + _NEIGHBOUR_NAMES[self.extra]

    @property
    def steps(self) -> FloatArray:
        """(p,) typical small step of each parameter."""
        return np.array([STEP[name] for name in self.names])

    @property
    def own(self) -> int:
        """Number of the bump's own parameters, which are the first."""
        return len(_BUMP_NAMES[self.shape])

    def column(self, theta: FloatArray, name: str) -> FloatArray:
        """(...) values of one parameter of (..., p) vectors; those that the scene does not have are 0, v is u."""
        if name in self.names:
            return np.asarray(theta[..., self.names.index(name)])
        return self.column(theta, "u") if name == "v" else np.zeros(theta.shape[:-1])

    def widths(self, theta: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """p, q, r (see `covariance_from_log_widths`) of (..., p) vectors."""
        u, v = self.column(theta, "u"), self.column(theta, "v")
        return (u + v) / 2.0, (u - v) / 2.0, self.column(theta, "r")

    def carried(self, theta: FloatArray, other: Scene) -> FloatArray:
        """Convert a vector to another scene: shared parameters keep their values, others are 0."""
        p, _, _ = self.widths(theta)
        values = {name: self.column(theta, name) for name in other.names}
        if other.shape == "round":
            values["u"] = p
        return np.array([values[name] for name in other.names])

    @property
    def separable(self) -> bool:
        """True for a scene that is only a bump along the grid's axes: the product of a profile along each."""
        return self.shape in ("round", "ellipse") and not self.extra

    def templates(self, theta: FloatArray, window: Window) -> list[Templates]:
        """Templates of the bump, and of the second structure if there is one, for (m, p) vectors."""
        p, q, r = self.widths(theta)
        if self.shape == "ridge":
            along, across = self.column(theta, "along"), self.column(theta, "across")
            templates: list[Templates] = [window.ridges(along, across, log_width=p)]
        else:
            x, y = self.column(theta, "x"), self.column(theta, "y")
            templates = [window.bumps(x, y, p=p, q=q, r=r if self.shape == "rotated" else None)]
        if self.extra:
            beside = (self.column(theta, name) for name in _NEIGHBOUR_NAMES[self.extra])
            templates.append(neighbour_templates(window, self.extra, *beside))
        return templates

    def log_prior(self, theta: FloatArray, problem: Problem) -> FloatArray:
        """(m,) normalised log prior of the shape; -inf outside the window and where a bump is wider than it."""
        prior, middle, radius_mm = problem.prior, problem.window.middle, problem.radius_mm
        p, q, r = self.widths(theta)
        ratio = np.hypot(q, r)
        total = log_normal_density(p, np.log(prior.width_median_mm), prior.log_width_sd)
        if self.shape == "ridge":
            inside, volume = ridge_place(self.column(theta, "across"), radius_mm)
        else:
            x, y = self.column(theta, "x") - middle[0], self.column(theta, "y") - middle[1]
            inside, volume = np.hypot(x, y) <= radius_mm, np.pi * radius_mm**2
        inside, total = inside & (p + ratio <= np.log(problem.widest_mm)), total - np.log(volume)
        if self.shape in ("ellipse", "rotated"):
            # q is half of u - v, p half of their sum: the volume of (u, v) is twice that of (p, q)
            total = total + log_normal_density(q, 0.0, prior.log_ratio_sd) - np.log(2.0)
        if self.shape == "rotated":
            total = total + log_normal_density(r, 0.0, prior.log_ratio_sd)
        if self.extra:
            beside, allowed = self._log_prior_beside(theta, problem)
            total, inside = total + beside, inside & allowed & (self.column(theta, "w2") <= np.log(problem.widest_mm))
        return np.where(inside, total, -np.inf)

    def _log_prior_beside(self, theta: FloatArray, problem: Problem) -> tuple[FloatArray, BoolArray]:
        """Log prior of the second structure (its amplitude's is in the target), and whether its place is allowed."""
        prior, middle, radius_mm = problem.prior, problem.window.middle, problem.radius_mm
        w, reach = self.column(theta, "w2"), REACH_IN_RADII * radius_mm
        total = log_normal_density(w, np.log(prior.width_median_mm), prior.log_width_sd)
        if self.extra == "rib":
            allowed, volume = ridge_place(self.column(theta, "offset"), radius_mm)
            if self.shape != "ridge":
                allowed &= self.rib_apart(theta, middle)
            return total - np.log(volume), allowed
        x2, y2 = self.column(theta, "x2"), self.column(theta, "y2")
        allowed = np.hypot(x2 - middle[0], y2 - middle[1]) <= reach
        if self.shape != "ridge":
            away = np.hypot(x2 - self.column(theta, "x"), y2 - self.column(theta, "y"))
            p, _, _ = self.widths(theta)
            allowed &= away >= APART * np.exp(np.maximum(p, w))
        return total - np.log(np.pi * reach**2), allowed

    def rib_apart(self, theta: FloatArray, middle: tuple[float, float]) -> BoolArray:
        """(m,) whether a rib is clear of the bump, or at most `APART` times as wide."""
        p, _, _ = self.widths(theta)
        return np.asarray(self.rib_clear(theta, middle) | (self.column(theta, "w2") - p <= np.log(APART)))

    def rib_clear(self, theta: FloatArray, middle: tuple[float, float]) -> BoolArray:
        """(m,) whether a rib lies `APART` widths, of it or the bump, from the bump's centre."""
        angle, (p, _, _) = self.column(theta, "angle"), self.widths(theta)
        x, y = self.column(theta, "x") - middle[0], self.column(theta, "y") - middle[1]
        away = np.abs(self.column(theta, "offset") - x * np.cos(angle) - y * np.sin(angle))
        return np.asarray(away >= APART * np.exp(np.maximum(p, self.column(theta, "w2"))))


def neighbour_templates(
    window: Window, extra: Neighbour, one: FloatArray, two: FloatArray, log_width: FloatArray
) -> Templates:
    """Templates of m second structures: lumps at ``x2, y2``, or ribs of ``angle, offset``, each an (m,) array."""
    if extra == "rib":
        return window.ridges(one, two, log_width=log_width)
    return window.bumps(one, two, p=log_width, q=np.zeros_like(log_width), r=None)


def ridge_place(offset: FloatArray, radius_mm: float) -> tuple[BoolArray, float]:
    """(m,) whether ridges may lie this far from the window's middle, and the volume of angles and offsets."""
    reach = REACH_IN_RADII * radius_mm
    return np.abs(offset) <= reach, float(np.pi * 2.0 * reach)


def log_normal_density(value: FloatArray, mean: float, sd: float) -> FloatArray:
    """(...) log density of a normal distribution."""
    return np.asarray(-0.5 * ((value - mean) / sd) ** 2 - np.log(sd * np.sqrt(2.0 * np.pi)))


def independent_variance(cells: FitCells) -> FloatArray:
    """(n,) independent variance of the cells, mean 1: reading variance over count where readings were counted."""
    variance = 1.0 / cells.count if cells.reading_variance > 0 else np.ones(len(cells))
    return np.asarray(variance / variance.mean())


def linear_columns(cells: FitCells, *, tilt: bool) -> FloatArray:
    """(c, n) columns of level and tilt across the window, in units of its half width."""
    ones = np.ones_like(cells.value)[None]
    if not tilt:
        return ones
    x, y = cells.x_mm - cells.x_mm.mean(), cells.y_mm - cells.y_mm.mean()
    size = max(float(np.abs(x).max()), float(np.abs(y).max()), 1e-6)
    return np.concatenate([ones, np.stack([x, y]) / size])
