r"""A fit window: its grid, the noise fields on it, and level, tilt and amplitudes integrated out under them.

For one noise field h (length and share) the map is linear in level, tilt and amplitudes given the places and widths.
With flat priors on level and tilt, a normal one of variance s^2 on each of v amplitudes and the Jeffreys prior on the
noise scale,

.. math::
    p(y \mid \theta, h) \propto |C_h|^{-1/2}\, |X^T C_h^{-1} X|^{-1/2}\, |P|^{-1/2}\,
        \Gamma(\nu/2)\,(\pi S)^{-\nu/2}\; N(\hat a;\, 0,\, s^2 + P^{-1} S / \nu), \qquad \nu = n - c - v,

X the c columns of level and tilt, P the amplitudes' precision and S the generalised least-squares sum of squares. Only
the last factor is approximate: the prior is taken at the mean noise scale. Fields are mixed with their evidence.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from functools import cached_property
from math import lgamma, log, pi
from typing import NamedTuple

import numpy as np

from tactile_bayes.declarations import Record
from tactile_bayes.geometry import FloatArray
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

MARGIN = 1.3  #: Side of the rectangle over that of the window, at whose edge the field then need not be flat.
LENGTHS_MM = (1.5, 3.0, 6.0, 12.0)
SHARES = (0.0, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 300.0, 1000.0)
"""Variances of the field tried, over the mean independent variance of a cell."""
HALF_WAVE_IN_WIDTHS = 0.83
"""Shortest half wave of the cosines, in widths of the bump: widths below 3.5 mm need more than `FIELD_COSINES`."""
LEAST_FIELD_VARIANCE = 1e-2  #: Directions with a smaller variance of the field, over the independent one, are dropped.


def spectrum(frequency2: FloatArray, length_mm: float) -> FloatArray:
    """(k,) variances of cosines of squared frequencies, 1/mm^2, for an exponential correlation; of sum 1."""
    density = (1.0 / length_mm**2 + frequency2) ** -1.5
    return np.asarray(density / density.sum())


class Whitening(Record, eq=False):
    """The noise field of one correlation length, prepared for every share."""

    length_mm: float  #: Correlation length.
    turn: FloatArray
    """(cosines^2, k) array: Takes inner products with the cosines, ``D^-1 Phi``, to directions in which the field's
    precision is diagonal."""
    eigenvalues: FloatArray  #: (k,) array: Of ``S^1/2 Phi' D^-1 Phi S^1/2``.

    @classmethod
    def of(cls, gram: FloatArray, frequency2: FloatArray, *, length_mm: float) -> Whitening:
        """Prepare one length, from the (k, k) gram ``Phi' D^-1 Phi`` and (k,) frequencies squared."""
        root = np.sqrt(spectrum(frequency2, length_mm))
        values, vectors = np.linalg.eigh(root[:, None] * gram * root)
        keep = values > 1e-9 * values[-1]
        return cls(length_mm, root[:, None] * vectors[:, keep], values[keep])

    def pruned(self, share: float) -> Whitening:
        """Copy without the directions that are negligible up to this share."""
        keep = share * self.eigenvalues > LEAST_FIELD_VARIANCE
        return Whitening(self.length_mm, np.ascontiguousarray(self.turn[:, keep]), self.eigenvalues[keep])


def cosine_profiles(axis_mm: FloatArray, *, cosines: int = FIELD_COSINES) -> tuple[FloatArray, FloatArray]:
    """(n, cosines) cosines along one axis, of mean square 1 over it and its margins, and their (cosines,) squared
    angular frequencies, 1/mm^2."""
    phase, side = _phase(axis_mm)
    order = np.arange(cosines)
    profiles = np.cos(np.pi * order * phase[:, None])
    profiles[:, 1:] *= np.sqrt(2.0)
    return profiles, np.asarray((np.pi * order / side) ** 2, dtype=np.float64)


def cosines_for(width_mm: float, axis_mm: FloatArray) -> int:
    """Number of cosines along an axis for a bump's width, from `FIELD_COSINES` to `FINE_FIELD_COSINES`: errors shorter
    than the shortest half wave are modelled as independent."""
    _, side = _phase(axis_mm)
    wanted = np.ceil(side / (HALF_WAVE_IN_WIDTHS * width_mm))
    return int(np.clip(wanted, FIELD_COSINES, FINE_FIELD_COSINES))


def _phase(axis_mm: FloatArray) -> tuple[FloatArray, float]:
    middle = 0.5 * (axis_mm.max() + axis_mm.min())
    side = MARGIN * max(float(np.ptp(axis_mm)), 1e-6)
    return (axis_mm - middle) / side + 0.5, side


def gram_of_cosines(along: FloatArray, across: FloatArray, *, weight: FloatArray) -> FloatArray:
    """(cosines^2, cosines^2) inner products of the plane's cosines under (ny, nx) weights, y's order first."""
    pairs = [(one[:, :, None] * one[:, None, :]).reshape(len(one), -1) for one in (along, across)]
    cosines = along.shape[1]
    # axes: y, y', x, x'
    products = (pairs[0].T @ weight @ pairs[1]).reshape(cosines, cosines, cosines, cosines)
    return np.asarray(products.transpose(0, 2, 1, 3).reshape(cosines**2, cosines**2))


# --- The fit window as a regular grid, with fast separable inner products of Gaussian templates and the noise basis.
#
# A Gaussian along the grid's axes is a product of two profiles, and so are the cosines: an inner product is computed
# row by row, not cell by cell. Cells that the map does not cover have weight 0.

RESOLVED = 3.0  #: Widths in cells above which the fourth cumulant of a cell is negligible.


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
        self.middle = float(np.mean(cells.x_mm)), float(np.mean(cells.y_mm))  #: Mean of the cells' centres, in mm.
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
            self._fields[length_mm] = Whitening.of(self._gram, frequency2, length_mm=length_mm)
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
            away_x, away_y = self.x_mm - x_mm[:, None], self.y_mm - y_mm[:, None]
            if r is None:
                columns = cell_mean_profile(away_x, sigma_mm=np.exp(p + q), cell_mm=cell, blur_mm=blur_x)
                rows = cell_mean_profile(away_y, sigma_mm=np.exp(p - q), cell_mm=cell, blur_mm=blur_y)
                return Profiles(rows, columns)
            covariance = covariance_from_log_widths(p, q, r)
            blurred = covariance + np.diag([blur_x**2, blur_y**2])
            grid = turned_gaussians(away_x, away_y, covariance_mm2=blurred, cell_mm=cell)
            grid *= np.sqrt(np.linalg.det(covariance) / np.linalg.det(blurred))[:, None, None]
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


def cell_mean_profile(
    distance_mm: FloatArray, *, sigma_mm: FloatArray, cell_mm: float, blur_mm: float = 0.0
) -> FloatArray:
    """(m, k) means over cells of one-dimensional Gaussians, of unit height before a blur of this SD.

    The factors of `cell_mean_gaussian`, to the order of the terms that both leave out: its two corrections are
    multiplied here and added there.
    """
    blurred = np.hypot(sigma_mm, blur_mm)
    wide = (blurred**2 + cell_mm**2 / 12.0)[:, None]
    square = distance_mm**2 / wide
    gaussian = blurred[:, None] / np.sqrt(wide) * np.exp(-0.5 * square)
    fourth = (square * (square - 6.0) + 3.0) / wide**2
    return (sigma_mm / blurred)[:, None] * (gaussian * (1.0 - cell_mm**4 / 2880.0 * fourth))


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


# --- The fit problem that all scenes of one window share: cells, prior and bounds.


class Problem(Record, eq=False, dict=True):
    """A window with its cells, and the assumptions about a bump in it."""

    window: Window  #: The cells; scenes share one, and with it the noise fields.
    prior: BumpPrior  #: On widths and amplitudes.
    radius_mm: float  #: Radius of the window; bounds the centre about the window's middle.
    amplitude_scale: float = 1.0  #: Unit of the amplitudes' prior, see `bump.value_scale`.
    departure: FloatArray | None = None  #: (k, n) array: Further fixed columns, see `fit.add_departure`; None for none.

    @cached_property
    def widest_mm(self) -> float:
        """Upper bound of the widths."""
        return WIDEST_IN_RADII * self.radius_mm


# --- Solutions for the linear parameters (amplitudes, level, tilt) given the shape, for many shapes and noise fields.

FLOOR = 1e-9
"""Least share of the data's sum of squares that is noise, 3e-5 of the signal: for a map without noise the residual sum
of squares would be rounding."""
LEAST_POWER = 1e-9  #: Least power of a template over the precision of its amplitude's prior, against overflow.


class LinearSolution(NamedTuple):
    """Conditional posterior of the linear parameters for m shapes and h fields: a multivariate t."""

    evidence: FloatArray  #: (m, h) array: Log of the fields' prior times their evidence.
    amplitude: FloatArray  #: (m, h, v) array: Conditional means under a flat prior.
    power: FloatArray  #: (m, h, v, v) array: Their precision times tau^2.
    level_slope: FloatArray  #: (m, h, v, c) array: Decrease of level and tilt per increase of an amplitude.
    sum_of_squares: FloatArray  #: (m, h) array.


class FieldColumns(Record, eq=False):
    """Fixed columns and data under the noise fields of one length: the part that does not depend on the shape."""

    field: Whitening  #: The length.
    shares: FloatArray  #: (h,) array.
    log_prior: float  #: Log prior probability of each share.
    weight: FloatArray
    """(k, h) array: Weight of the squared projections that the field removes, ``rho / (1 + rho lambda)``, per share."""
    plain: FloatArray  #: (k, h * (c + 1)) array: Projections of the fixed columns and the data, times `weight`.
    gram: FloatArray  #: (h, c + 1, c + 1) array: Inner products of columns and data.
    inverse: FloatArray  #: (h, c, c) array: Inverse of the columns' part of `gram`.
    log_det: FloatArray  #: (h,) array: Log determinant of the covariance (over that of D) and of the columns' part.
    floor: float  #: Least sum of squares, see `FLOOR`.

    def rest(self) -> FloatArray:
        """(h,) residual sum of squares of the fixed columns alone."""
        c = self.inverse.shape[1]
        right = self.gram[:, :c, c]
        return np.asarray(self.gram[:, c, c] - np.einsum("hc,hcd,hd->h", right, self.inverse, right))

    def level(self) -> FloatArray:
        """(h, c) level and tilt at amplitudes of 0."""
        c = self.inverse.shape[1]
        return np.asarray(np.einsum("hcd,hd->hc", self.inverse, self.gram[:, :c, c]))

    def null_evidence(self, *, dof: int) -> FloatArray:
        """(h,) log prior plus log evidence of the fixed columns alone."""
        squares = np.maximum(self.rest(), 0.0) + self.floor
        return self.log_prior - 0.5 * self.log_det + lgamma(dof / 2) - 0.5 * dof * np.log(pi * squares)


class Inner(Record, eq=False):
    """Inner products of m templates under the noise fields of one length with h shares."""

    plain: FloatArray  #: (m, h, c + 1) array: With the fixed columns and the data.
    square: FloatArray  #: (m, h) array: With themselves.
    low: FloatArray  #: (m, k) array: Projections on the field's directions; empty where no `product` is needed.

    @classmethod
    def of(cls, projected: Projected, columns: FieldColumns) -> Inner:
        """Inner products under the fields, from those without a field."""
        low = projected.low @ columns.field.turn
        taken = (low @ columns.plain).reshape(len(low), len(columns.shares), -1)
        return cls(projected.plain[:, None, :] - taken, projected.square[:, None] - low**2 @ columns.weight, low)

    def repeated(self, number: int) -> Inner:
        """Each template's inner products, repeated."""
        return Inner(*(np.repeat(one, number, axis=0) for one in (self.plain, self.square, self.low)))

    def product(self, other: Inner, product: FloatArray, columns: FieldColumns) -> FloatArray:
        """(m, h) inner products with other templates, from their (m,) products without the field."""
        return np.asarray(product[:, None] - (self.low * other.low) @ columns.weight)


NEGLIGIBLE = 1e-3
"""Fields with a smaller share of the evidence are left out of the mixture, and their evidence at the mode is added as a
constant. Lengths are tried from the longest until one has as little, and less than the one before it."""


class LinearModel:
    """Level, tilt and data of a window, and what is linear in them with templates, under each noise field."""

    def __init__(self, problem: Problem, *, tilt: bool) -> None:
        self.window = window = problem.window
        self.amplitude_sd = problem.prior.amplitude_sd * problem.amplitude_scale
        # centred, so that a large level costs no digits of the bump
        self.mean = float(np.mean(window.cells.value))
        fixed_columns = [linear_columns(window.cells, tilt=tilt)]
        fixed_columns += [] if problem.departure is None else [problem.departure]
        self.plain = np.concatenate([*fixed_columns, (window.cells.value - self.mean)[None]])
        weighted_columns = self.plain / window.variance
        self.weighted = window.on_grid(weighted_columns)
        self._gram = self.plain @ weighted_columns.T
        self._low = window.project(window.on_grid(self.plain), self.weighted).low
        self._lengths: dict[float, FieldColumns] = {}

    def dof(self, structures: int) -> int:
        """Degrees of freedom of the noise scale with so many structures."""
        return max(len(self.plain[0]) - len(self.plain) + 1 - structures, 1)

    def columns(self, field: Whitening, shares: FloatArray) -> FieldColumns:
        """Level, tilt and data under the fields of one length; shares of 0 count once for all lengths."""
        log_prior = -float(np.log(len(LENGTHS_MM) * len(SHARES)))
        log_prior += 0.0 if shares.any() else float(np.log(len(LENGTHS_MM)))
        low, power = self._low @ field.turn, shares[:, None] * field.eigenvalues
        weight = shares[:, None] / (1.0 + power)
        weighted = low * weight[:, None, :]
        gram = self._gram - weighted @ low.T
        c = len(self.plain) - 1
        inverse: FloatArray = np.asarray(np.linalg.inv(gram[:, :c, :c]), dtype=np.float64)
        volume: FloatArray = np.asarray(np.linalg.slogdet(gram[:, :c, :c])[1], dtype=np.float64)
        plain = np.ascontiguousarray(weighted.reshape(len(shares) * (c + 1), low.shape[1]).T)
        log_det = np.log1p(power).sum(axis=-1) + volume
        floor = FLOOR * float(self._gram[c, c]) + 1e-300
        removed = np.ascontiguousarray(weight.T)
        return FieldColumns(field, shares, log_prior, removed, plain, gram, inverse, log_det, floor)

    def every_field(self) -> Iterator[FieldColumns]:
        """No field, then each length from the longest on with all shares, computed when reached."""
        shares = np.array(SHARES)
        for length in (0.0, *sorted(LENGTHS_MM, reverse=True)):
            of_length = shares[(shares > 0) == (length > 0)]
            if length not in self._lengths:
                cosines = self.window.cosines**2  # a share of 0, the same for every length, has no directions
                no_field = Whitening(float(np.mean(LENGTHS_MM)), np.zeros((cosines, 0)), np.zeros(0))
                self._lengths[length] = self.columns(self.window.field(length) if length else no_field, of_length)
            yield self._lengths[length]

    def with_evidence(self, templates: list[Templates]) -> tuple[list[FieldColumns] | None, float]:
        """The fields with evidence for one template of each structure, and the log evidence that the others add; None
        and 0 where no field has any."""
        projected, cross = self.projected(templates)
        by_length, total = self._evidence_by_length(lambda columns: self.under(projected, cross, columns).evidence[0])
        if not np.isfinite(total):
            return None, 0.0
        selected = [(columns, evidence > total + np.log(NEGLIGIBLE)) for columns, evidence in by_length]
        fields = [
            self.columns(columns.field.pruned(float(columns.shares[keep].max())), columns.shares[keep])
            for columns, keep in selected
            if keep.any()
        ]
        kept_evidence = np.concatenate([self.under(projected, cross, columns).evidence[0] for columns in fields])
        return fields, total - float(np.logaddexp.reduce(kept_evidence))

    def without_structure(self) -> tuple[list[FieldColumns], float]:
        """The lengths with evidence for level and tilt alone, with all their shares, and the log evidence of all."""
        by_length, total = self._evidence_by_length(lambda columns: columns.null_evidence(dof=self.dof(0)))
        return [columns for columns, evidence in by_length if evidence.max() > total + np.log(NEGLIGIBLE)], total

    def _evidence_by_length(
        self, evidence: Callable[[FieldColumns], FloatArray]
    ) -> tuple[list[tuple[FieldColumns, FloatArray]], float]:
        """Evidence without a field, then from the longest length down until it is negligible; and its log sum."""
        by_length: list[tuple[FieldColumns, FloatArray]] = []
        best = previous = -np.inf
        for columns in self.every_field():
            of_length = evidence(columns)
            by_length.append((columns, of_length))
            if of_length.max() < min(previous, best + np.log(NEGLIGIBLE)):
                break
            best = max(best, float(of_length.max()))
            previous = float(of_length.max()) if columns.shares[0] > 0 else -np.inf
        return by_length, float(np.logaddexp.reduce(np.concatenate([of_length for _, of_length in by_length])))

    def projected(self, templates: list[Templates]) -> tuple[list[Projected], FloatArray | None]:
        """Inner products of one or two structures' templates, and those of two with each other."""
        cross = self.window.product(*templates) if len(templates) == 2 else None
        return [self.window.project(template, self.weighted) for template in templates], cross

    def under_each(self, templates: list[Templates], fields: list[FieldColumns]) -> LinearSolution:
        """Solutions for each structure's (m,) templates under all fields."""
        projected, cross = self.projected(templates)
        return concatenated([self.under(projected, cross, columns) for columns in fields], axis=1)

    def under(self, projected: list[Projected], cross: FloatArray | None, columns: FieldColumns) -> LinearSolution:
        """Solutions under one length, from inner products without a field."""
        inner = [Inner.of(one, columns) for one in projected]
        return self.solve(inner, None if cross is None else inner[0].product(inner[1], cross, columns), columns)

    def solve(self, inner: list[Inner], cross: FloatArray | None, columns: FieldColumns) -> LinearSolution:
        """Solutions under one length, from products of each structure's (m,) templates, (m, h) `cross` of both."""
        c, dof = columns.inverse.shape[1], self.dof(len(inner))
        plain = [one.plain for one in inner]
        to_level = [np.matmul(one[:, :, None, :c], columns.inverse)[:, :, 0] for one in plain]
        right = columns.gram[:, :c, c]
        along = [one[:, :, c] - np.sum(t * right, axis=2) for one, t in zip(plain, to_level, strict=True)]

        def power(i: int, j: int, product: FloatArray) -> FloatArray:
            return np.asarray(product - np.sum(to_level[i] * plain[j][:, :, :c], axis=2))

        rest, floor = columns.rest(), columns.floor
        # a template with hardly any weight in the window leaves the prior unchanged
        least = LEAST_POWER * (np.maximum(rest, 0.0) + floor) / dof / self.amplitude_sd**2
        diagonal = [np.maximum(power(i, i, one.square), least) for i, one in enumerate(inner)]
        if cross is None:
            structures = _one_structure(along[0], diagonal[0], rest, floor, dof=dof, amplitude_sd=self.amplitude_sd)
        else:
            between = power(0, 1, cross)
            structures = _two_structures(along, diagonal, between, rest, floor, dof=dof, amplitude_sd=self.amplitude_sd)
        log_factor, amplitude, matrix, squares = structures
        constant = columns.log_prior - 0.5 * columns.log_det + lgamma(dof / 2) - 0.5 * dof * log(pi)
        evidence = constant + log_factor - 0.5 * dof * np.log(squares)
        # only rises have density
        evidence = np.where((amplitude > 0).all(axis=2), evidence, -np.inf)
        return LinearSolution(evidence, amplitude, matrix, np.stack(to_level, axis=2), squares)


def concatenated(solutions: Iterable[LinearSolution], *, axis: int) -> LinearSolution:
    """Concatenate the fields of several lengths (1), or blocks of shapes (0)."""
    return LinearSolution(*(np.concatenate(parts, axis=axis) for parts in zip(*solutions, strict=True)))


def _one_structure(
    along: FloatArray, power: FloatArray, rest: FloatArray, floor: float, *, dof: int, amplitude_sd: float
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Log factor, amplitudes, precision and sum of squares for one structure."""
    amplitude = along / power
    squares = np.maximum(rest - along * amplitude, 0.0) + floor
    variance = amplitude_sd**2 + squares / dof / power
    log_factor = -0.5 * (np.log(power) + np.log(2 * pi * variance) + (amplitude / np.sqrt(variance)) ** 2)
    return log_factor, amplitude[..., None], power[..., None, None], squares


def _two_structures(
    along: list[FloatArray],
    diagonal: list[FloatArray],
    off: FloatArray,
    rest: FloatArray,
    floor: float,
    *,
    dof: int,
    amplitude_sd: float,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """As `_one_structure` for two structures, with the two by two matrices written out."""
    one, two = diagonal
    det = np.maximum(one * two - off**2, 1e-12 * one * two)
    first, second = (two * along[0] - off * along[1]) / det, (one * along[1] - off * along[0]) / det
    squares = np.maximum(rest - along[0] * first - along[1] * second, 0.0) + floor
    tau2 = squares / dof
    a, b, between = amplitude_sd**2 + tau2 * two / det, amplitude_sd**2 + tau2 * one / det, -tau2 * off / det
    volume = a * b - between**2
    square = (b * first**2 + a * second**2 - 2 * between * first * second) / volume
    log_factor = -0.5 * (np.log(det) + np.log((2 * pi) ** 2 * volume) + square)
    matrix = np.stack([np.stack([one, off], axis=-1), np.stack([off, two], axis=-1)], axis=-2)
    return log_factor, np.stack([first, second], axis=-1), matrix, squares
