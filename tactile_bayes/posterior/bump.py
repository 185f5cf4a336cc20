"""The Gaussian bump of a lump on a map, candidates and windows for its fit, and the error model from the residuals."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property, lru_cache

import numpy as np
from scipy.special import expit

from tactile_bayes.declarations import Record, replace
from tactile_bayes.geometry import BoolArray, FloatArray, IndexArray
from tactile_bayes.inference.modes import LeastSquaresFit, inverse_information
from tactile_bayes.mapping.map import TactileMap
from tactile_bayes.options import BumpPrior
from tactile_bayes.presets import POSE_NOISE
from tactile_bayes.size.draws import first_axis

# --- The Gaussian bump of the map (Eqs 5 and 7), averaged over the map's square cells.


def cell_mean_gaussian(x_mm: FloatArray, y_mm: FloatArray, *, covariance_mm2: FloatArray, cell_mm: float) -> FloatArray:
    r"""Mean over a square cell of a Gaussian of unit height, at cell centres relative to its centre, in mm.

    Leading axes of x and y are those of the (..., 2, 2) covariance, whose diagonal is sigma_x^2, sigma_y^2 when the
    axes agree. A cell of 0 gives the Gaussian at the centres.

    Averaging over a cell is a convolution with a box, which adds :math:`h^2/12` to each variance and brings a fourth
    cumulant of :math:`-h^4/120` along each axis of the grid. Both are kept (Edgeworth series); the first term left out
    is :math:`h^6/(12096\,\sigma^6)` for each axis, below 3e-5 of the height at :math:`h = 0.75\,\sigma`. Wellman & Howe
    (1999) eq. 7 is the case ``cell_mm=0`` and a diagonal covariance.
    """
    wide = covariance_mm2 + (cell_mm**2 / 12.0) * np.eye(2)
    sxx, sxy, syy = wide[..., 0, 0, None], wide[..., 0, 1, None], wide[..., 1, 1, None]
    wide_det = sxx * syy - sxy**2
    narrow_det = covariance_mm2[..., 0, 0] * covariance_mm2[..., 1, 1] - covariance_mm2[..., 0, 1] ** 2
    pxx, pxy, pyy = syy / wide_det, -sxy / wide_det, sxx / wide_det
    u = pxx * x_mm + pxy * y_mm
    v = pxy * x_mm + pyy * y_mm
    height = np.sqrt(np.clip(narrow_det, 0.0, None))[..., None] / np.sqrt(wide_det)
    gaussian = height * np.exp(-0.5 * (x_mm * u + y_mm * v))
    u2, v2 = u * u, v * v
    fourth = u2 * (u2 - 6.0 * pxx) + v2 * (v2 - 6.0 * pyy) + 3.0 * (pxx**2 + pyy**2)
    return np.asarray(gaussian * (1.0 - cell_mm**4 / 2880.0 * fourth))


def covariance_from_log_widths(p: FloatArray, q: FloatArray, r: FloatArray) -> FloatArray:
    r"""Covariance in mm^2, (..., 2, 2), of a Gaussian from free coordinates that are smooth through the round case.

    :math:`\Sigma^{1/2} = \exp\begin{pmatrix}p+q & r\\ r & p-q\end{pmatrix}` with lengths in mm: p is the log of the
    geometric mean width, ``(q, r)`` the log axis ratio and its direction. For r = 0, sigma_x = exp(p + q) and sigma_y =
    exp(p - q).
    """
    ratio = np.hypot(q, r)
    scale = np.exp(2.0 * p)
    even = scale * np.cosh(2.0 * ratio)
    # sinh(2 rho) / rho, finite at rho = 0
    odd = scale * 2.0 * np.where(ratio > 1e-8, np.sinh(2.0 * ratio) / np.where(ratio > 1e-8, 2.0 * ratio, 1.0), 1.0)
    rows = [even + odd * q, odd * r], [odd * r, even - odd * q]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def principal_widths(
    p: FloatArray, q: FloatArray, r: FloatArray, *, first: Sequence[float] | FloatArray = (1.0, 0.0)
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Widths (mm) along the ellipse's own axes, and the angle of the first.

    ``sigma_x_mm`` is the standard deviation along the axis within 45 degrees of `first`, by default x, ``sigma_y_mm``
    the one at right angles to it; ``angle_rad`` goes from x to the axis of ``sigma_x_mm``, 0 for a round Gaussian.
    """
    ratio, sign = np.hypot(q, r), np.where(q * first[0] + r * first[1] >= 0, 1.0, -1.0)
    angle = np.where(ratio > 0, 0.5 * np.arctan2(sign * r, sign * q), 0.0)
    return np.exp(p + sign * ratio), np.exp(p - sign * ratio), angle


def drawn_widths(p: FloatArray, q: FloatArray, r: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """`principal_widths` of draws of one ellipse, the first width along the same axis for all."""
    return principal_widths(p, q, r, first=first_axis(q, r))


# --- Candidate places for a lump, and the cells of the window about one of them.

SMOOTHING_MM = 3.0
"""SD of the Gaussian that smooths a map before the search for candidates: about that of a small lump's bump."""
RIM_MM, RIM_SHARE = 6.0, 0.6
"""A place is at the map's rim where less than this share of the disc of this radius about it is covered."""
FEW_READINGS = 0.1  #: A cell with a smaller share of the median count is left out of the fit.
CACHED_MAPS = 4  #: Maps whose results are cached: the map, its levelled one, and both without the measured lump.


class PoseNoise(Record):
    """Tracker position error of a map, one error per frame: the figures `presets.POSE_NOISE`."""

    sd_mm: tuple[float, float]  #: SD of a frame's place along x and y: bumps are that much wider on the map.
    side_mm: tuple[float, float]
    """Sides of the array along x and y: cells closer together than these share frames, and with them errors."""
    frames_per_reading: float  #: Frames with an error of their own that felt a cell, over the readings in it.

    @classmethod
    def of(cls, tactile_map: TactileMap) -> PoseNoise | None:
        """Read from a map; None where it lacks a figure."""
        figures = [float(tactile_map.quality.get(name, np.nan)) for name in POSE_NOISE]
        if not (np.isfinite(figures).all() and min(figures[:2]) >= 0 and min(figures[2:]) > 0):
            return None
        return cls((figures[0], figures[1]), (figures[2], figures[3]), figures[4])


class FitCells(Record, eq=False, dict=True):
    """The cells of one window, flattened."""

    x_mm: FloatArray
    y_mm: FloatArray  #: (k,) arrays: Cell centres in `plane`.
    value: FloatArray  #: (k,) array: Mean of the readings.
    variance: FloatArray  #: (k,) array: Within a cell; NaN where it is not known.
    count: FloatArray  #: (k,) array: Number of readings.
    row: IndexArray
    column: IndexArray  #: (k,) int arrays: Where the cells lie in the map's grid.
    cell_mm: float  #: Side of a cell.
    pose_noise: PoseNoise | None = None  #: Tracker position error of the frames; None where the map does not give it.

    def __len__(self) -> int:
        return len(self.value)

    def on_grid(self, values: FloatArray) -> FloatArray:
        """(..., ny, nx) smallest grid that contains the cells, of (..., k) values; 0 where there is no cell."""
        row, column = self.row - self.row.min(), self.column - self.column.min()
        grid = np.zeros((*values.shape[:-1], int(row.max()) + 1, int(column.max()) + 1))
        grid[..., row, column] = values
        return grid

    @cached_property
    def lattice(self) -> tuple[FloatArray, FloatArray, IndexArray]:
        """Coordinates of the smallest grid's columns and rows, and each cell's index in it."""
        column, row = self.column - self.column.min(), self.row - self.row.min()
        x_axis, y_axis = np.zeros(int(column.max()) + 1), np.zeros(int(row.max()) + 1)
        x_axis[column], y_axis[row] = self.x_mm, self.y_mm
        return x_axis, y_axis, row * len(x_axis) + column

    @property
    def reading_variance(self) -> float:
        """Variance of a reading within its cell, pooled over the cells that have one; 0 without any."""
        known = np.isfinite(self.variance)
        readings = float(np.sum(self.count[known]))
        return float(np.sum(self.variance[known] * self.count[known])) / readings if readings > 0 else 0.0


@lru_cache(maxsize=CACHED_MAPS)
def trusted_cells(tactile_map: TactileMap) -> BoolArray:
    """(ny, nx) True for covered cells with at least `FEW_READINGS` of the median count; read-only.

    The few readings of a cell at the rim come from one side of the head, and share their errors.
    """
    covered = well_read_cells(tactile_map, FEW_READINGS)
    covered.flags.writeable = False
    return covered


def well_read_cells(tactile_map: TactileMap, share: float) -> BoolArray:
    """(ny, nx) True for covered cells with at least a share of the median count."""
    covered = tactile_map.covered
    typical = np.median(tactile_map.count[covered]) if covered.any() else 0.0
    return np.asarray(covered & (tactile_map.count >= share * typical))


def window_cells(tactile_map: TactileMap, centre_mm: tuple[float, float], *, radius_mm: float) -> FitCells:
    """The trusted cells whose centres lie within `radius_mm` of `centre_mm`."""
    dx, dy = tactile_map.x_mm - centre_mm[0], tactile_map.y_mm[:, None] - centre_mm[1]
    inside = trusted_cells(tactile_map) & (dx**2 + dy**2 <= radius_mm**2)
    row, column = np.nonzero(inside)
    return FitCells(
        x_mm=tactile_map.x_mm[column],
        y_mm=tactile_map.y_mm[row],
        value=tactile_map.mean[inside].astype(np.float64),
        variance=tactile_map.variance[inside],
        count=tactile_map.count[inside].astype(np.float64),
        row=row,
        column=column,
        cell_mm=tactile_map.recipe.cell_mm,
        pose_noise=PoseNoise.of(tactile_map),
    )


def map_ends(tactile_map: TactileMap) -> dict[str, tuple[float, float]]:
    """Ends of the map's outermost cells along x and y, mm."""
    half = tactile_map.recipe.cell_mm / 2.0
    axes = {"x": tactile_map.x_mm, "y": tactile_map.y_mm}
    return {name: (float(axis[0]) - half, float(axis[-1]) + half) for name, axis in axes.items()}


def on_map(tactile_map: TactileMap, x_mm: float, y_mm: float) -> bool:
    """True for a place on the map's cells, covered or not."""
    ends = map_ends(tactile_map)
    return ends["x"][0] <= x_mm <= ends["x"][1] and ends["y"][0] <= y_mm <= ends["y"][1]


def covered_share(tactile_map: TactileMap, centre_mm: tuple[float, float], *, radius_mm: float) -> float:
    """Share of the disc about `centre_mm` that the map covers; beyond its edge nothing is covered."""
    cell = tactile_map.recipe.cell_mm
    radius_mm = max(radius_mm, 0.75 * cell)
    return min(1.0, len(window_cells(tactile_map, centre_mm, radius_mm=radius_mm)) / (np.pi * radius_mm**2 / cell**2))


def typical_level(tactile_map: TactileMap) -> float:
    """Level away from the lump: fixed by normalising, else the median of the covered cells."""
    if tactile_map.background is not None:
        return tactile_map.background
    return float(np.median(tactile_map.mean[trusted_cells(tactile_map)]))


def value_scale(tactile_map: TactileMap) -> float:
    """Scale of amplitudes: 1 for a normalised map, else the largest departure from its level."""
    if tactile_map.background is not None:
        return 1.0
    covered = tactile_map.mean[tactile_map.covered]
    scale = float(np.abs(covered - np.median(covered)).max())
    return scale if scale > 0 else 1.0


def candidate_centres(tactile_map: TactileMap, *, limit: int = 16, rim_limit: int = 8) -> list[tuple[float, float]]:
    """Local maxima (x_mm, y_mm) of the smoothed map, the candidates for a lump, highest first.

    At most `limit` inside the map and `rim_limit` at its rim, which on deep fat may rise above the lump since the
    head's rim presses hardest. Empty where no covered cell rises above the background.
    """
    excess = smoothed_excess(tactile_map)
    neighbours = np.lib.stride_tricks.sliding_window_view(np.pad(excess, 1, constant_values=-np.inf), (3, 3))
    rows, columns = np.nonzero(np.isfinite(excess) & (excess > 0) & (excess >= neighbours.max(axis=(2, 3))))
    centres: list[tuple[float, float]] = []
    remaining = {False: limit, True: rim_limit}
    for i in np.argsort(-excess[rows, columns], kind="stable"):
        centre = (float(tactile_map.x_mm[columns[i]]), float(tactile_map.y_mm[rows[i]]))
        if any(np.hypot(centre[0] - x, centre[1] - y) <= 2 * SMOOTHING_MM for x, y in centres):
            continue
        at_rim = covered_share(tactile_map, centre, radius_mm=RIM_MM) < RIM_SHARE
        if remaining[at_rim]:
            centres.append(centre)
            remaining[at_rim] -= 1
        if not remaining[False]:
            break
    return centres


@lru_cache(maxsize=CACHED_MAPS)
def smoothed_excess(tactile_map: TactileMap) -> FloatArray:
    """(ny, nx) count-weighted Gaussian smoothing of map minus background; -inf where there is no data. Read-only."""
    covered = trusted_cells(tactile_map)
    excess = np.where(covered, tactile_map.mean - typical_level(tactile_map), 0.0)
    weight = np.where(covered, np.sqrt(tactile_map.count.astype(np.float64)), 0.0)
    cell = tactile_map.recipe.cell_mm
    top, bottom = (_gaussian_smoothed(one, SMOOTHING_MM / cell) for one in (excess * weight, weight))
    with np.errstate(invalid="ignore", divide="ignore"):
        smoothed = np.where(covered & (bottom > 0), top / bottom, -np.inf)
    smoothed.setflags(write=False)
    return smoothed


@lru_cache(maxsize=CACHED_MAPS)
def levelled(tactile_map: TactileMap) -> TactileMap:
    """The map less its local mean over the head's area, as dividing by frame means would leave it: without wide rises,
    as of a stiff layer. Only maps with a gain per frame are changed."""
    noise = PoseNoise.of(tactile_map)
    if tactile_map.recipe.normalise != "gain" or noise is None:
        return tactile_map
    covered = trusted_cells(tactile_map)
    excess = np.where(covered, tactile_map.mean - typical_level(tactile_map), 0.0)
    across, along = overlap(tactile_map.x_mm, noise.side_mm[0]), overlap(tactile_map.y_mm, noise.side_mm[1])
    local_mean = (along @ excess @ across) / np.maximum(along @ covered @ across, 1.0)
    return replace(tactile_map, mean=np.where(covered, tactile_map.mean - local_mean, tactile_map.mean))


def overlap(axis_mm: FloatArray, side_mm: float) -> FloatArray:
    """(n, n) overlap of two equal intervals about points of an axis, as a share of one."""
    distance: FloatArray = np.abs(np.subtract.outer(axis_mm, axis_mm))
    return np.clip(1.0 - distance / side_mm, 0.0, None)


def _gaussian_smoothed(array: FloatArray, width_cells: float) -> FloatArray:
    """Gaussian smoothing with zeros beyond the edge, and beyond four widths."""
    kernels = []
    for n in array.shape:
        distance = np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
        weight = np.exp(-0.5 * (distance / max(width_cells, 0.3)) ** 2)
        kernels.append(np.where(distance <= np.ceil(4 * width_cells), weight, 0.0))
    return np.asarray(kernels[0] @ array @ kernels[1])


# --- The paper's model of a map: one Gaussian bump on a level background (Eq 7), with its priors.

BLOCK, LEAST_BLOCK = 64, 4
"""Parameter vectors predicted at a time, so that intermediate arrays stay in a processor's cache; and the least."""
BLOCK_VALUES = 512 * 1024  #: Cells times vectors in a block: for more than 8192 cells a block has fewer vectors.


def block_size(cells: int) -> int:
    """Number of parameter vectors to predict at a time, for a window of this many cells."""
    return min(BLOCK, max(LEAST_BLOCK, BLOCK_VALUES // max(cells, 1)))


class Bump(Record):
    """The model's parameters, ``(amplitude, x, y, p, q[, r][, background])``: mm for the centre, p, q and r as of
    `covariance_from_log_widths`."""

    rotated: bool = False  #: The axes of the ellipse may turn (adds r).
    background: float | None = 1.0  #: Fixed level (1 in Eq 7), or None to fit it.
    scale: float = 1.0  #: Unit of amplitude for priors and steps, see `bump.value_scale`.

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
            _, x_mm, y_mm, p, q = theta[:, :5].T
            if self.rotated:
                covariance = covariance_from_log_widths(*self.shape_parameters(theta))
                away = cells.x_mm - x_mm[:, None], cells.y_mm - y_mm[:, None]
                return cell_mean_gaussian(*away, covariance_mm2=covariance, cell_mm=cells.cell_mm)
            # along the grid's axes: a product of what rows and columns have, with a fourth cumulant that is their sum
            x_axis, y_axis, place = cells.lattice
            x, x_fourth = _profile(x_axis - x_mm[:, None], sigma_mm=np.exp(p + q), cell_mm=cells.cell_mm)
            y, y_fourth = _profile(y_axis - y_mm[:, None], sigma_mm=np.exp(p - q), cell_mm=cells.cell_mm)
            bump = (1.0 - y_fourth)[:, :, None] - x_fourth[:, None, :]
            bump *= x[:, None, :]
            bump *= y[:, :, None]
            return np.asarray(bump.reshape(len(bump), -1).take(place, axis=1))

    def predict(self, theta: FloatArray, cells: FitCells) -> FloatArray:
        """(m, k) map values of (m, p) parameter vectors: Eq 7 averaged over the cells."""
        values = self.unit_bump(theta, cells)
        values *= theta[:, 0, None]
        values += self.level(theta)[:, None]
        return values

    def log_prior(self, theta: FloatArray, prior: BumpPrior) -> FloatArray:
        """(m,) log prior density, flat in the background; the centre's prior belongs to the window."""
        p, q, r = self.shape_parameters(theta)
        total = log_normal_density(theta[..., 0], 0.0, prior.amplitude_sd * self.scale)
        total = total + log_normal_density(p, np.log(prior.width_median_mm), prior.log_width_sd)
        for ratio in (q, r) if self.rotated else (q,):
            total = total + log_normal_density(ratio, 0.0, prior.log_ratio_sd)
        return np.asarray(total)


def log_normal_density(value: FloatArray, mean: float, sd: float) -> FloatArray:
    """(...) log density of a normal distribution."""
    return np.asarray(-0.5 * ((value - mean) / sd) ** 2 - np.log(sd * np.sqrt(2.0 * np.pi)))


def _profile(distance_mm: FloatArray, *, sigma_mm: FloatArray, cell_mm: float) -> tuple[FloatArray, FloatArray]:
    """(m, n) cell means of Gaussians along an axis to second order, and their fourth-order correction."""
    wide = (sigma_mm**2 + cell_mm**2 / 12.0)[:, None]
    square = distance_mm**2 / wide
    gaussian = sigma_mm[:, None] / np.sqrt(wide) * np.exp(-0.5 * square)
    return gaussian, cell_mm**4 / 2880.0 * (square * (square - 6.0) + 3.0) / wide**2


# --- Error model from a fit's residuals: variance, weights by count, correlation.


class ErrorModel(Record):
    """Size and correlation of a map's errors, from a fit's residuals."""

    noise_sd: float  #: Standard deviation of a cell of unit weight.
    inflation: float
    """Factor by which correlated errors widen the parameters' variance over that of independent cells; at least 1."""
    dof: float  #: Effective degrees of freedom of `noise_sd`.


MINIMUM_DOF = 6.0
"""Tails no heavier than a t with this many degrees of freedom: below it the draws' variance would mean nothing."""


def count_weights(cells: FitCells, residual_variance: float) -> FloatArray:
    """(k,) weights from counts, of mean 1: the variance of a cell is ``v / n + delta^2``.

    v is the pooled within-cell variance of a reading, n the count; delta^2 is the rest of `residual_variance`, the mean
    squared residual of a fit with equal weights: the model's own misfit, that more readings do not reduce.
    """
    reading = cells.reading_variance
    if not reading > 0:
        return np.ones(len(cells))
    misfit = max(residual_variance - reading * float(np.mean(1.0 / cells.count)), 1e-3 * residual_variance)
    weight = 1.0 / (reading / cells.count + misfit)
    return np.asarray(weight / weight.mean())


def uncorrelated_errors(fit: LeastSquaresFit, weight: FloatArray) -> ErrorModel:
    """Error model under ``noise = "field"``, whose fits contain the correlation themselves."""
    k, p = fit.jacobian.shape
    return ErrorModel(float(np.sqrt(weight @ fit.residual**2 / (k - p))), 1.0, float(k - p))


def inflated_errors(cells: FitCells, fit: LeastSquaresFit, weight: FloatArray) -> ErrorModel:
    """Error model under ``noise = "independent"``, from a fit's residuals.

    `inflation` is the mean factor over the parameters by which the sandwich :math:`H^{-1} J^T W C W J H^{-1}`, with C
    from the residuals' autocorrelation, widens their covariance. Dividing the log-likelihood by it is the magnitude
    adjustment of composite likelihoods (Chandler & Bate 2007, Biometrika 94:167; Pauli, Racugno & Ventura 2011,
    Statistica Sinica 21:149). Level and tilt of the residuals, the misfit of a fixed background, are subtracted first:
    calibration maps share it, and `level_offset` reports it.
    """
    k, p = fit.jacobian.shape
    dof = k - p
    residual = fit.residual - fitted_tilt(cells, fit.residual, weight=weight)
    noise_variance = float(weight @ residual**2) / dof
    information = inverse_information(fit.jacobian, weight)
    if not noise_variance > 0 or not np.isfinite(information).all():
        return ErrorModel(float(np.sqrt(max(noise_variance, 0.0))), 1.0, float(dof))
    white = residual * np.sqrt(weight / noise_variance)
    correlation, half = residual_autocorrelation(*cells.on_grid(np.stack([white, np.ones(k)])))
    root = fit.jacobian * np.sqrt(weight)[:, None]
    correlated = _correlate_columns(cells, root, correlation, half)
    inflation = float(np.trace(information @ (root.T @ correlated)) / p)
    inflation = float(np.clip(inflation, 1.0, k / (p + MINIMUM_DOF)))
    return ErrorModel(float(np.sqrt(noise_variance)), inflation, max(dof / inflation, MINIMUM_DOF))


def fitted_tilt(cells: FitCells, residual: FloatArray, *, weight: FloatArray) -> FloatArray:
    """(k,) weighted least-squares plane through the residuals; zeros where there are too few cells."""
    if len(cells) < 12:
        return np.zeros(len(cells))
    design = np.stack([np.ones(len(cells)), cells.x_mm - cells.x_mm.mean(), cells.y_mm - cells.y_mm.mean()], axis=1)
    root = np.sqrt(weight)
    solution = np.linalg.lstsq(design * root[:, None], residual * root, rcond=None)[0]
    return np.asarray(design @ solution)


def level_offset(residual: FloatArray, *, weight: FloatArray) -> float:
    """Mean residual of the window: distance of the map's level from the assumed background."""
    return float(weight @ residual / weight.sum())


def residual_autocorrelation(grid: FloatArray, mask: FloatArray) -> tuple[FloatArray, int]:
    """Radial autocorrelation of whitened residuals, (2 half + 1, 2 half + 1) by lag in cells, and the largest lag kept.

    1 in the middle, isotropic, and 0 beyond the first lag that is not clearly above its noise.
    """
    ny, nx = grid.shape
    size = (2 * ny, 2 * nx)
    spectrum = np.fft.rfft2(grid, size)
    cover = np.fft.rfft2(mask, size)
    products = np.fft.irfft2(np.abs(spectrum) ** 2, size)
    pairs = np.round(np.fft.irfft2(np.abs(cover) ** 2, size))
    lag_y = np.fft.fftfreq(2 * ny, 1 / (2 * ny))[:, None]
    lag_x = np.fft.fftfreq(2 * nx, 1 / (2 * nx))[None, :]
    ring = np.round(np.hypot(lag_y, lag_x)).astype(int)
    largest = max(1, min(ny, nx) // 2)
    used = (ring <= largest) & (pairs > 0)
    total = np.bincount(ring[used], products[used], largest + 1)
    number = np.bincount(ring[used], pairs[used], largest + 1)
    radial = total / np.maximum(number, 1)
    radial = radial / radial[0]
    below_noise = np.flatnonzero(radial < 2.0 / np.sqrt(np.maximum(number / 2.0, 1.0)))
    half = int(below_noise[0]) - 1 if len(below_noise) else largest
    axis = np.arange(-half, half + 1)
    lag = np.round(np.hypot(axis[:, None], axis[None, :])).astype(int)
    return np.where(lag <= half, radial[np.minimum(lag, largest)], 0.0), half


def _correlate_columns(cells: FitCells, columns: FloatArray, correlation: FloatArray, half: int) -> FloatArray:
    """``C @ columns`` for the stationary correlation on the cells' grid."""
    if half == 0:
        return columns
    grid = cells.on_grid(columns.T)
    size = (grid.shape[1] + 2 * half, grid.shape[2] + 2 * half)
    full = np.fft.irfft2(np.fft.rfft2(grid, size) * np.fft.rfft2(correlation, size), size)
    return full[:, cells.row - cells.row.min() + half, cells.column - cells.column.min() + half].T


# --- Odds of a bump.


class Detection(Record):
    """Odds of a bump against smooth errors alone; see `verdict` for whether it is a lump."""

    log_bayes_factor: float  #: Natural log of the evidence ratio.
    ridge: str = ""
    """Text of the ridge against which the lump was tested; empty where it was tested against noise alone."""

    @property
    def probability(self) -> float:
        """Probability of a bump, at even odds and if there were only bumps and smooth errors."""
        return float(expit(self.log_bayes_factor))
