"""The estimate under independent noise (paper Eq 7)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import cached_property, partial
from math import lgamma, log, pi
from typing import Any

import numpy as np

from tactile_bayes.declarations import Record, replace
from tactile_bayes.errors import Abstention, UsageError
from tactile_bayes.geometry import FloatArray
from tactile_bayes.inference import modes
from tactile_bayes.inference.draws import ParameterDraws, SolutionCache
from tactile_bayes.mapping.map import TactileMap
from tactile_bayes.options import BumpPrior
from tactile_bayes.posterior.bump import (
    Bump,
    Detection,
    ErrorModel,
    FitCells,
    block_size,
    candidate_centres,
    count_weights,
    covered_share,
    drawn_widths,
    inflated_errors,
    level_offset,
    log_normal_density,
    typical_level,
    uncorrelated_errors,
    value_scale,
    window_cells,
)
from tactile_bayes.posterior.draw import (
    ROTATION_ODDS,
    MapPosterior,
    ModalBump,
    SamplerSettings,
    SamplingTarget,
    draw_parameters,
)
from tactile_bayes.presets import Background, Method, Noise
from tactile_bayes.progress import Progress
from tactile_bayes.size.draws import SizePosterior
from tactile_bayes.size.pooling import Calibration

# --- Log posterior density of a least-squares model, with the noise scale integrated out.

LogPrior = Callable[[FloatArray], FloatArray]  #: (m, p) to (m,).


class Target(Record, eq=False):
    r"""Posterior density of a model's parameters, up to a constant.

    With independent errors and the Jeffreys prior on their scale the noise integrates out to
    :math:`\mathrm{SSE}(\theta)^{-k/2}`. Correlated errors divide the log-likelihood by the inflation c and leave
    :math:`\nu` effective degrees of freedom: :math:`[1 + \Delta\mathrm{SSE} / (c\,\nu s^2)]^{-(\nu + p)/2}`, which is
    the former for c = 1 and nu = k - p.
    """

    predict: modes.ModelFunction  #: (m, p) parameter vectors to (m, k) predictions.
    data: FloatArray
    weight: FloatArray  #: (k,) array: Inverse variances up to a common factor.
    log_prior: LogPrior
    errors: ErrorModel  #: Size, correlation and degrees of freedom of the noise.
    sse_min: float  #: Weighted sum of squares at the least-squares estimate.
    dimension: int

    def excess(self, theta: FloatArray) -> FloatArray:
        """(m,) rise of the weighted sum of squares above its minimum, divided by the inflation."""
        size, sse = block_size(len(self.data)), []
        for i in range(0, len(theta), size):
            with np.errstate(over="ignore", invalid="ignore"):
                off = self.data - self.predict(theta[i : i + size])
                off *= off
                sse.append(off @ self.weight)
        rise = np.clip(np.concatenate(sse) - self.sse_min, 0.0, None) / self.errors.inflation
        return np.where(np.isfinite(rise), rise, np.inf)

    def __call__(self, theta: FloatArray, solved: SolutionCache | None = None) -> FloatArray:
        """(m,) log density of (m, p) parameter vectors; -inf where the model overflows.

        `solved` stores the `excess` there for `draw_noise_sd`.
        """
        excess = self.excess(theta)
        if solved is not None:
            solved.add(theta, (excess,))
        exponent = 0.5 * (self.errors.dof + self.dimension)
        total = -exponent * np.log1p(excess / (self.errors.dof * self.errors.noise_sd**2)) + self.log_prior(theta)
        return np.where(np.isfinite(total), total, -np.inf)

    def draw_noise_sd(self, excess: FloatArray, rng: np.random.Generator) -> FloatArray:
        """(m,) draws of the noise scale given `excess` (m,): a scaled inverse chi, exact under this model."""
        chi2 = rng.chisquare(self.errors.dof + self.dimension, size=len(excess))
        return np.sqrt((self.errors.dof * self.errors.noise_sd**2 + excess) / chi2)


# --- Least-squares fit of a bump: candidates, window, weights, error model.

START_WIDTHS_MM = (5.0, 2.0, 10.0)
CLEAR_SHARE = 0.8  #: Share of a window's sum of squares that a bump explains for no other minimum to be sought.
LEAST_COVERED_SHARE = 0.6
LEAST_WIDTH_IN_CELLS = 0.5
WIDEST_IN_RADII = 0.75
MOST_AXIS_RATIO = 4.0
CLOSE_IN_RADII = 0.6  #: Radius of a small window, over the usual one: 12 mm hold less of a rib 16 mm away.
PATIENCE = 16  #: Iterations: a clear lump takes 4 to 15.
OUTGROWN = "wider than the window measures"
AT_RIM = "at the rim of the map"
FEW_CELLS = "too few covered cells"
NARROW = "narrower than a cell (sigma {:.2g} mm on {:g} mm cells): not resolved"
FIT_TOLERANCE = 1e-8
"""Tolerance of the least squares, in units of `Bump.step_scale`: far below any error that a map has."""
PLACE_TOLERANCE = 1e-2  #: The same where least squares only gives a start for the posterior's mode.
SAME_MINIMUM = 0.05  #: A fit this near to a known minimum, in the same units, is stopped.


class BumpFit(Record, eq=False, dict=True):
    """A bump fitted by least squares: its cells, error model and covariance."""

    bump: Bump  #: The model.
    cells: FitCells  #: Of the window.
    weight: FloatArray  #: Of the cells.
    fit: modes.LeastSquaresFit  #: The minimum.
    errors: ErrorModel
    covariance: FloatArray
    """(p, p) array: Of the parameters; with correlated errors, except under a noise field, which models them."""
    covered_share: float  #: Share of the disc of 1.5 widths about the centre that the map covers.
    prior: BumpPrior  #: Of the parameters.
    width_sd_mm: None = None  #: Accuracies in mm are not offered, see `FittedBump`.

    @property
    def theta(self) -> FloatArray:
        """(p,) least-squares parameters."""
        return self.fit.theta

    @property
    def centre_mm(self) -> tuple[float, float]:
        """The bump's centre."""
        return float(self.theta[1]), float(self.theta[2])

    def widths(self) -> tuple[float, float, float]:
        """sigma_x_mm, sigma_y_mm, angle_rad of the fit."""
        sigma_x, sigma_y, angle = self.bump.widths(self.theta)
        return float(sigma_x), float(sigma_y), float(angle)

    def modal(self) -> ModalBump:
        """The bump at the fit."""
        amplitude, x, y = (float(value) for value in self.theta[:3])
        return ModalBump(amplitude, x, y, *self.widths()[:2])

    @cached_property
    def target(self) -> Target:
        """Posterior density of the parameters.

        The prior is bounded as in `lump_fault`: a rise, no wider than the window, its centre within it. Else a wide
        shallow dent fits a background that is a little off its fixed level.
        """
        x, y = self.theta[1:3]
        radius = float(np.hypot(self.cells.x_mm - x, self.cells.y_mm - y).max())

        def log_prior(theta: FloatArray) -> FloatArray:
            sigma_x, sigma_y, _ = self.bump.widths(theta)
            inside = np.hypot(theta[:, 1] - x, theta[:, 2] - y) <= radius
            inside &= (theta[:, 0] > 0) & (np.maximum(sigma_x, sigma_y) <= WIDEST_IN_RADII * radius)
            return np.where(inside, self.bump.log_prior(theta, self.prior), -np.inf)

        return Target(
            predict=lambda theta: self.bump.predict(theta, self.cells),
            data=self.cells.value,
            weight=self.weight,
            log_prior=log_prior,
            errors=self.errors,
            sse_min=self.fit.sse,
            dimension=len(self.theta),
        )

    def draw_at_mode(self, method: Method, number: int, rng: np.random.Generator) -> ParameterDraws:
        """Draw from the least-squares estimate, or from the posterior's mode, and the curvature there."""
        del number
        if method == "optimise":
            return modes.optimise(self.theta, self.covariance, dof=self.errors.dof, rng=rng)
        scale = np.sqrt(np.diag(self.covariance))
        return modes.laplace(self.target, self.theta, scale=scale, dof=self.errors.dof, rng=rng)

    def sampling_target(self, solved: SolutionCache | None = None) -> SamplingTarget:
        """The density to sample, which stores its sums of squares in `solved`."""
        scale = np.sqrt(np.diag(self.covariance))
        mode, covariance, _ = modes.mode_and_covariance(self.target, self.theta, scale=scale)
        density = self.target if solved is None else partial(self.target, solved=solved)
        return SamplingTarget(density, mode, covariance)


class Candidate(Record, eq=False):
    """A candidate place."""

    centre_mm: tuple[float, float]  #: Where the search began.
    fit: BumpFit | None  #: None where least squares found no minimum.
    fault: str  #: Reason why the place cannot be a lump; empty without one.
    detection: Detection | None = None  #: Odds of a bump there; None where they were not computed.
    assessed: ModalBump | None = None  #: The bump that the odds are of; None where it is the fit's.

    @property
    def bump(self) -> ModalBump | None:
        """The bump that the odds are of; None without a fit."""
        return None if self.fit is None else self.assessed or self.fit.modal()


def fitted_candidates(tactile_map: TactileMap, options: SamplerSettings) -> Iterator[Candidate]:
    """Candidate places, highest first, each fitted on demand."""
    centres = [options.centre_mm] if options.centre_mm is not None else candidate_centres(tactile_map)
    for centre in centres:
        yield Candidate(centre, *fit_bump(tactile_map, centre, options=options))


def fit_bump(
    tactile_map: TactileMap, centre_mm: tuple[float, float], *, options: SamplerSettings
) -> tuple[BumpFit | None, str]:
    """Fit of a bump near `centre_mm`, which the window follows, or None; and the fault for which it cannot be a lump,
    or empty."""
    check_background(tactile_map, options)
    level = None if options.background == "free" else tactile_map.background
    bump = Bump(rotated=options.rotation == "on", background=level, scale=value_scale(tactile_map))
    centre, starts, weight_variance = centre_mm, list[FloatArray](), None
    widths = START_WIDTHS_MM if options.start_width_mm is None else (options.start_width_mm,)
    for _ in range(6):
        cells = window_cells(tactile_map, centre, radius_mm=options.fit_radius_mm)
        if len(cells) < (least := len(bump.names) + 2):
            return None, f"{FEW_CELLS} ({len(cells)}, at least {least} needed)"
        if min(np.ptp(cells.row), np.ptp(cells.column)) == 0:
            return None, f"{FEW_CELLS} (all in one line)"
        weight = np.ones(len(cells)) if weight_variance is None else count_weights(cells, weight_variance)
        starts = starts or [_start_vector(tactile_map, bump, cells, centre, width) for width in widths]
        fit = _best_fit(bump, cells, starts, weight=weight, centre=centre, options=options)
        shift = float(np.hypot(fit.theta[1] - centre[0], fit.theta[2] - centre[1]))
        if not fit.converged or shift > options.fit_radius_mm / 2:
            return None, f"no bump with a flank on every side within {options.fit_radius_mm:g} mm"
        settled = weight_variance is not None and shift < 0.25 * cells.cell_mm
        centre, starts = (float(fit.theta[1]), float(fit.theta[2])), [fit.theta]
        weight_variance = float(np.mean(fit.residual**2))
        if settled:
            break
    errors = uncorrelated_errors(fit, weight) if options.correlated else inflated_errors(cells, fit, weight)
    # a map without any noise still has the rounding of its numbers
    rounding = 1e-9 * bump.scale + 1e-14 * float(np.abs(cells.value).max())
    errors = replace(errors, noise_sd=max(errors.noise_sd, rounding))
    covariance = errors.noise_sd**2 * errors.inflation * modes.inverse_information(fit.jacobian, weight)
    sigma_x, sigma_y, _ = bump.widths(fit.theta)
    share = covered_share(tactile_map, centre, radius_mm=1.5 * float(max(sigma_x, sigma_y)))
    result = BumpFit(bump, cells, weight, fit, errors, covariance, share, options.prior)
    return result, lump_fault(result, options)


def fit_in_small_window(
    tactile_map: TactileMap, centre_mm: tuple[float, float], *, options: SamplerSettings
) -> tuple[BumpFit | None, str]:
    """Fit in a window of `CLOSE_IN_RADII`, beside a neighbour that would attract the bump; rotated, to show a ridge."""
    near = replace(options, fit_radius_mm=CLOSE_IN_RADII * options.fit_radius_mm, rotation="on")
    return fit_bump(tactile_map, centre_mm, options=near)


def default_errors(tactile_map: TactileMap) -> tuple[Background, Noise]:
    """Default background and noise, where neither an option nor a size calibration decides (docs/decisions/0071).

    The paper's where the level is known. Else a free background under correlated errors, or under independent ones for
    a grid of single values, where a noise field would fit the shape itself.
    """
    if tactile_map.background is not None:
        return "fixed", "independent"
    return "free", "field" if bool((tactile_map.count > 1).any()) else "independent"


def check_background(tactile_map: TactileMap, options: SamplerSettings) -> None:
    """`UsageError` for a fixed background of a map whose level is not known: fixed at the map's median, intervals of
    widths cover 0 to 49 % instead of 90 % (docs/coverage.md)."""
    if options.background == "fixed" and tactile_map.background is None:
        raise UsageError(
            f"the map's level far from a lump is not known (normalise {tactile_map.recipe.normalise}), so a background "
            'cannot be fixed at it; give background = "free"'
        )


def _best_fit(
    bump: Bump,
    cells: FitCells,
    starts: list[FloatArray],
    *,
    weight: FloatArray,
    centre: tuple[float, float],
    options: SamplerSettings,
) -> modes.LeastSquaresFit:
    """The lowest minimum from several starts.

    A fit that leaves the window, outgrows it or comes to a known minimum is abandoned. Under a noise field least
    squares only finds the place: it has little `PATIENCE`, and ends with a minimum of `CLEAR_SHARE`.
    """
    radius_mm, place_only = options.fit_radius_mm, options.correlated
    fits: list[modes.LeastSquaresFit] = []

    def is_abandoned(theta: FloatArray) -> bool:
        outside = np.hypot(theta[1] - centre[0], theta[2] - centre[1]) > radius_mm
        outgrown = max(bump.widths(theta)[:2]) > 4.0 * radius_mm
        minima = [fit_.theta for fit_ in fits if fit_.converged]
        joins = any((np.abs(theta - fit_) < SAME_MINIMUM * bump.step_scale).all() for fit_ in minima)
        return bool(outside or outgrown or joins)

    mean = float(weight @ cells.value) / float(weight.sum())
    about_mean = float(weight @ (cells.value - mean) ** 2)
    for start in starts:
        fit = modes.fit_least_squares(
            lambda theta: bump.predict(theta, cells),
            start,
            data=cells.value,
            weight=weight,
            scale=bump.step_scale,
            tolerance=PLACE_TOLERANCE if place_only else FIT_TOLERANCE,
            abandon=is_abandoned,
            patience=PATIENCE if place_only else None,
        )
        fits.append(fit)
        if place_only and fit.converged and fit.sse < (1.0 - CLEAR_SHARE) * about_mean:
            break
    return min(fits, key=lambda fit: (not fit.converged, fit.sse))


def _start_vector(
    tactile_map: TactileMap, bump: Bump, cells: FitCells, centre: tuple[float, float], width_mm: float
) -> FloatArray:
    """Start parameters: a round bump of this width at a centre, as high as the map there."""
    level = typical_level(tactile_map)
    nearest = np.argmin((cells.x_mm - centre[0]) ** 2 + (cells.y_mm - centre[1]) ** 2)
    height = float(cells.value[nearest]) - level
    values = {"amplitude": height or bump.scale, "x_mm": centre[0], "y_mm": centre[1], "background": level}
    values["p"] = float(np.log(max(width_mm, 0.6 * cells.cell_mm)))
    return np.array([values.get(name, 0.0) for name in bump.names])


def lump_fault(result: BumpFit, options: SamplerSettings) -> str:
    """Reason why a fitted bump is not measured, with the figure and the limit; empty if it can be."""
    (narrow, wide), cell = sorted(result.widths()[:2]), result.cells.cell_mm
    if not result.theta[0] > 0:
        return f"a depression (amplitude {result.theta[0]:.3g})"
    if not np.isfinite(result.covariance).all():
        return "its cells do not determine a bump"
    if narrow < LEAST_WIDTH_IN_CELLS * cell:
        return NARROW.format(narrow, cell)
    if wide > WIDEST_IN_RADII * options.fit_radius_mm:
        return f"{OUTGROWN} (sigma {wide:.3g} mm, at most {WIDEST_IN_RADII * options.fit_radius_mm:g} mm)"
    if result.covered_share < LEAST_COVERED_SHARE:
        return f"{AT_RIM} ({100 * result.covered_share:.0f} % of the bump is covered)"
    if wide / narrow > MOST_AXIS_RATIO:
        return f"a ridge, not a lump (sigma {wide:.3g} by {narrow:.3g} mm)"
    return ""


def rotation_odds(
    tactile_map: TactileMap, unrotated: BumpFit, *, options: SamplerSettings
) -> tuple[float, BumpFit | None]:
    """Bayes factor of a rotated ellipse against one along the head's axes, and the rotated fit.

    The Savage-Dickey ratio at r = 0 of the larger model: prior over posterior density there.
    """
    rotated, fault = fit_bump(tactile_map, unrotated.centre_mm, options=replace(options, rotation="on"))
    if rotated is None or fault:
        return 0.0, None
    r, sd = float(rotated.theta[5]), float(np.sqrt(rotated.covariance[5, 5]))
    log_odds = np.log(sd / options.log_ratio_sd) + 0.5 * (r / sd) ** 2
    return float(np.exp(np.clip(log_odds, -700, 700))), rotated


# --- Detection of a lump: evidence for a bump against noise alone, over the whole map.

LENGTHS_IN_WIDTHS = (0.35, 0.7, 1.4, 2.8, 5.6)  #: Correlation lengths of the noise, in widths of the bump under test.
FIELD_SHARES = (0.5, 0.9, 0.99)
"""Shares of the error variance that is correlated; at every length 0 is as likely a priori as each of them."""
MOST_BLOCKS = 480


class _Blocks(Record, eq=False):
    """The map about a candidate, averaged over square blocks of cells."""

    x_mm: FloatArray
    y_mm: FloatArray
    value: FloatArray
    template: FloatArray
    reading_variance: FloatArray


def detect(tactile_map: TactileMap, fit: BumpFit) -> Detection:
    """Bayes factor of a bump of this shape somewhere on the map against correlated noise on a level background.

    The noise of both models is an exponentially correlated field plus independent errors, averaged over a grid of
    lengths and shares; the field's variance is constant or goes with 1 / count, as that of errors which a frame's
    readings share. Level, amplitude and noise scale are integrated out; position and widths enter by their Laplace
    volume over the map's area and the prior: the Occam factor, MacKay (2003), Information Theory, Inference, and
    Learning Algorithms, ch. 28.
    """
    blocks = _block_means(tactile_map, fit)
    if len(blocks.value) < 8 or fit.theta[0] <= 0:
        return Detection(-np.inf)
    sigma_x, sigma_y, _ = fit.widths()
    width = float(np.sqrt(sigma_x * sigma_y))
    null, lump = _log_evidences(blocks, width, amplitude_sd=fit.prior.amplitude_sd * fit.bump.scale)
    return Detection(lump - null + _log_occam_factor(tactile_map, fit))


def _block_means(tactile_map: TactileMap, fit: BumpFit) -> _Blocks:
    cell = tactile_map.recipe.cell_mm
    side = max(1, int(min(fit.widths()[:2]) / cell))
    radius = np.sqrt(MOST_BLOCKS / pi) * side * cell
    cells = window_cells(tactile_map, fit.centre_mm, radius_mm=float(radius))
    if not len(cells):
        return _Blocks(*[np.zeros(0)] * 5)
    key = (cells.row // side) * (int(cells.column.max()) // side + 1) + cells.column // side
    _, index, number = np.unique(key, return_inverse=True, return_counts=True)
    is_full = number >= 0.5 * side**2
    columns = (cells.x_mm, cells.y_mm, cells.value, fit.bump.unit_bump(fit.theta[None], cells)[0], 1.0 / cells.count)
    x, y, value, template, reading_variance = ((np.bincount(index, column) / number)[is_full] for column in columns)
    return _Blocks(x, y, value, template, reading_variance / number[is_full])


def _log_evidences(blocks: _Blocks, width_mm: float, *, amplitude_sd: float) -> tuple[float, float]:
    """Log evidence without and with the bump, averaged over the noise fields, up to a common constant."""
    distance = np.hypot(blocks.x_mm[:, None] - blocks.x_mm, blocks.y_mm[:, None] - blocks.y_mm)
    nugget = blocks.reading_variance / blocks.reading_variance.mean()
    scales = (np.ones_like(nugget), np.sqrt(nugget))
    white = _log_evidence_pair(blocks, np.diag(nugget), amplitude_sd=amplitude_sd)
    pairs = [np.array(white) + log(len(scales) * len(LENGTHS_IN_WIDTHS))]
    for length in LENGTHS_IN_WIDTHS:
        correlation = np.exp(-distance / (length * width_mm))
        for scale in scales:
            field = correlation * scale[:, None] * scale
            for share in FIELD_SHARES:
                errors = share * field + (1.0 - share) * np.diag(nugget)
                pairs.append(np.array(_log_evidence_pair(blocks, errors, amplitude_sd=amplitude_sd)))
    null, lump = np.logaddexp.reduce(pairs, axis=0)
    return float(null), float(lump)


def _log_evidence_pair(blocks: _Blocks, errors: FloatArray, *, amplitude_sd: float) -> tuple[float, float]:
    """Log evidence without and with the bump for errors of one covariance (n, n), up to a common constant."""
    n = len(blocks.value)
    factor = np.linalg.cholesky(errors + 1e-9 * np.eye(n))
    whitened = np.linalg.solve(factor, np.stack([np.ones(n), blocks.value, blocks.template], axis=1))
    ones, y, g = whitened.T
    half_log_det = float(np.log(np.diag(factor)).sum())
    level = ones @ ones
    y = y - ones * (ones @ y) / level
    g = g - ones * (ones @ g) / level
    tiny = np.finfo(float).tiny
    rss = max(float(y @ y), tiny)
    null = -half_log_det - 0.5 * log(level) + lgamma((n - 1) / 2) - (n - 1) / 2 * log(pi * rss)
    power = float(g @ g)
    amplitude = float(g @ y) / power if power > 0 else 0.0
    if not power > 1e-12 or amplitude <= 0:
        return null, -np.inf
    residual = max(rss - power * amplitude**2, 1e-12 * rss)
    prior = -0.5 * (amplitude / amplitude_sd) ** 2 - log(amplitude_sd) - 0.5 * log(2 * pi)
    lump = -half_log_det - 0.5 * log(level * power) + lgamma((n - 2) / 2) - (n - 2) / 2 * log(pi * residual) + prior
    return null, lump


def _log_occam_factor(tactile_map: TactileMap, fit: BumpFit) -> float:
    """Log of the posterior volume of position and widths over their prior volume."""
    block, prior = fit.covariance[1:5, 1:5], fit.prior
    if not np.isfinite(block).all():
        return -np.inf
    _, log_det = np.linalg.slogdet(block)
    area = float(tactile_map.covered.sum()) * tactile_map.recipe.cell_mm**2
    p, q, _ = fit.bump.shape_parameters(fit.theta)
    density = log_normal_density(p, log(prior.width_median_mm), prior.log_width_sd) - log(area)
    density = density + log_normal_density(q, 0.0, prior.log_ratio_sd)
    return float(min(2 * log(2 * pi) + 0.5 * log_det + density, 0.0))


# --- Estimation under independent errors: assessment, rotation and draws from a least-squares fit.


class MapDraws(Record, eq=False):
    """Posterior draws of one lump under a noise model, and its size."""

    detection: Detection  #: The odds of a bump, with the evidence from the draws where they give it.
    fit: BumpFit  #: The least-squares fit that the draws started from.
    draws: ParameterDraws  #: Draws of the model's own parameters.
    posterior: MapPosterior  #: The joint draws by name.
    figures: Mapping[str, Any]  #: Of the noise, and the decisions made under it, as in `Estimate.diagnostics`.
    calibration: Calibration | None = None  #: The one that gave the size, at the map's depth.
    size: SizePosterior | None = None
    fault: Abstention | None = None  #: Why there is no size; None also without a calibration.


class WhiteAssessment(Record, eq=False):
    """Assessment of a place on a map under independent errors."""

    tactile_map: TactileMap
    fit: BumpFit
    detection: Detection
    fault: str = ""
    scene: None = None

    def bump(self) -> ModalBump:
        """The bump of the least-squares fit."""
        return self.fit.modal()

    def draw(self, options: SamplerSettings, *, rng: np.random.Generator, progress: Progress | None) -> MapDraws:
        """Draw from the posterior, rotated where the odds favour it."""
        fit, odds = self.fit, None
        if options.rotation == "auto":
            odds, rotated = rotation_odds(self.tactile_map, fit, options=options)
            fit = rotated if rotated is not None and odds > ROTATION_ODDS else fit
        cache = SolutionCache(lambda theta: (fit.target.excess(theta),))
        draws, _ = draw_parameters(fit, options, rng=rng, progress=progress, solved=cache)
        theta = draws.theta
        sigma_x, sigma_y, angle = drawn_widths(*fit.bump.shape_parameters(theta))
        # optimise and laplace are linear about the mode: the exact excess would cost more than all the rest
        if draws.method in ("ensemble", "importance"):
            excess = cache(draws.flat)[0]
        else:
            information = fit.fit.jacobian.T @ (fit.weight[:, None] * fit.fit.jacobian)
            offset = draws.flat - fit.theta
            excess = np.einsum("mp,pq,mq->m", offset, information, offset) / fit.errors.inflation
        posterior = MapPosterior(
            amplitude=theta[..., 0],
            sigma_x_mm=sigma_x,
            sigma_y_mm=sigma_y,
            x_mm=theta[..., 1],
            y_mm=theta[..., 2],
            angle_rad=angle,
            background=fit.bump.level(theta),
            noise_sd=fit.target.draw_noise_sd(excess, rng).reshape(theta.shape[:2]),
            labels=draws.replicates,
        )
        figures = {
            "noise": options.noise,
            "noise_inflation": fit.errors.inflation,
            "noise_dof": fit.errors.dof,
            "level_offset": level_offset(fit.fit.residual, weight=fit.weight),
            "rotation_odds": odds,
            "rotated": fit.bump.rotated,
        }
        return MapDraws(self.detection, fit, draws, posterior, figures)
