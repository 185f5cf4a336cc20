"""The estimate under independent noise (paper Eq 7)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial

import numpy as np

from tactile_bayes.declarations import Record, replace
from tactile_bayes.errors import UsageError
from tactile_bayes.geometry import FloatArray
from tactile_bayes.inference import modes
from tactile_bayes.inference.draws import ParameterDraws, Solved
from tactile_bayes.mapping.map import TactileMap
from tactile_bayes.options import BumpPrior
from tactile_bayes.posterior.bump import (
    Bump,
    FitCells,
    block_size,
    candidate_centres,
    covered_share,
    drawn_widths,
    typical_level,
    value_scale,
    window_cells,
)
from tactile_bayes.posterior.detection import (
    Detection,
    ErrorModel,
    count_weights,
    detect,
    error_model,
    independent_errors,
    level_offset,
)
from tactile_bayes.posterior.draw import (
    ROTATION_ODDS,
    MapPosterior,
    ModalBump,
    NoiseFigures,
    Sampled,
    SamplerSettings,
    draw_parameters,
)
from tactile_bayes.presets import Background, Method, Noise
from tactile_bayes.progress import Progress

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

    def __call__(self, theta: FloatArray, solved: Solved | None = None) -> FloatArray:
        """(m,) log density of (m, p) parameter vectors; -inf where the model overflows.

        `solved` keeps the `excess` there for `draw_noise_sd`.
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
CLEAR = 0.8
"""Share of a window's sum of squares: a bump that explains as much is the place, whatever other minima there are."""
LEAST_COVERED_SHARE = 0.6
LEAST_WIDTH_IN_CELLS = 0.5
WIDEST_IN_RADII = 0.75
MOST_AXIS_RATIO = 4.0
CLOSE_IN_RADII = 0.6  #: Beside a rib 16 mm away a window of 12 mm holds more of the lump than of the rib.
PATIENCE = 16  #: Iterations: a clear lump takes 4 to 15.
OUTGROWN, AT_RIM = "wider than the window", "at the rim of the map"
FIT_TOLERANCE = 1e-8
"""Tolerance of the least squares, in units of `Bump.step_scale`: far below any error that a map has."""
PLACE_TOLERANCE = 1e-2  #: The same where least squares only finds the place: the posterior's mode is sought from there.
JOINED = 0.05  #: So near to a minimum, in the same units, a fit ends in it.


class BumpFit(Record, eq=False):
    """A least-squares bump, with all that the methods need."""

    bump: Bump  #: The model.
    cells: FitCells  #: Of the window.
    weight: FloatArray  #: Of the cells.
    fit: modes.LeastSquaresFit  #: The minimum.
    errors: ErrorModel
    covariance: FloatArray
    """(p, p) array: Of the parameters, correlated errors included, but under a noise field: its model has them."""
    covered_share: float  #: Share of the disc of 1.5 widths about the centre that the map covers.

    @property
    def theta(self) -> FloatArray:
        """(p,) least-squares parameters."""
        return self.fit.theta

    def widths(self) -> tuple[float, float, float]:
        """sigma_x_mm, sigma_y_mm, angle_rad of the fit."""
        sigma_x, sigma_y, angle = self.bump.widths(self.theta)
        return float(sigma_x), float(sigma_y), float(angle)

    def modal(self) -> ModalBump:
        """The bump at the fit."""
        amplitude, x, y = (float(value) for value in self.theta[:3])
        return ModalBump(amplitude, x, y, *self.widths()[:2])

    def target(self, prior: BumpPrior) -> Target:
        """Posterior density of the parameters.

        The prior is of the bumps that `lump_fault` accepts: a rise, no wider than the window, its centre within it.
        Without these bounds a background a little off its fixed level is "fitted" by a wide shallow dent.
        """
        x, y = self.theta[1:3]
        radius = float(np.hypot(self.cells.x_mm - x, self.cells.y_mm - y).max())

        def log_prior(theta: FloatArray) -> FloatArray:
            sigma_x, sigma_y, _ = self.bump.widths(theta)
            inside = np.hypot(theta[:, 1] - x, theta[:, 2] - y) <= radius
            inside &= (theta[:, 0] > 0) & (np.maximum(sigma_x, sigma_y) <= WIDEST_IN_RADII * radius)
            return np.where(inside, self.bump.log_prior(theta, prior), -np.inf)

        return Target(
            predict=lambda theta: self.bump.predict(theta, self.cells),
            data=self.cells.value,
            weight=self.weight,
            log_prior=log_prior,
            errors=self.errors,
            sse_min=self.fit.sse,
            dimension=len(self.theta),
        )


class Candidate(Record, eq=False):
    """A candidate place."""

    centre_mm: tuple[float, float]  #: Where the search began.
    fit: BumpFit | None  #: None where least squares found no minimum.
    fault: str  #: Why the place cannot be a lump; empty when it can.
    detection: Detection | None = None  #: Odds of a lump there; None where nobody has weighed them.
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
    """Fit a bump near `centre_mm`; the window follows the fitted centre.

    The fit is None when none can be made at all; the fault says why the bump cannot be a lump, and is empty when it
    can.
    """
    check_background(tactile_map, options)
    level = None if options.background == "free" else tactile_map.background
    bump = Bump(rotated=options.rotation == "on", background=level, scale=value_scale(tactile_map))
    centre, start, weight_variance = centre_mm, None, None
    widths = START_WIDTHS_MM if options.start_width_mm is None else (options.start_width_mm,)
    for _ in range(6):
        cells = window_cells(tactile_map, centre, radius_mm=options.fit_radius_mm)
        if len(cells) < len(bump.names) + 2:
            return None, f"{len(cells)} covered cells for {len(bump.names)} parameters"
        weight = np.ones(len(cells)) if weight_variance is None else count_weights(cells, weight_variance)
        starts = [start] if start is not None else [_start(tactile_map, bump, cells, centre, width) for width in widths]
        fit = _best_fit(bump, cells, starts, weight=weight, centre=centre, options=options)
        moved = float(np.hypot(fit.theta[1] - centre[0], fit.theta[2] - centre[1]))
        if not fit.converged or moved > options.fit_radius_mm / 2:
            return None, "no bump that the window holds: the fit ran away"
        settled = weight_variance is not None and moved < 0.25 * cells.cell_mm
        centre, start = (float(fit.theta[1]), float(fit.theta[2])), fit.theta
        weight_variance = float(np.mean(fit.residual**2))
        if settled:
            break
    if options.correlated:
        errors = independent_errors(jacobian=fit.jacobian, residual=fit.residual, weight=weight)
    else:
        errors = error_model(cells, jacobian=fit.jacobian, residual=fit.residual, weight=weight)
    # a map without any noise still has the rounding of its numbers
    rounding = 1e-9 * bump.scale + 1e-14 * float(np.abs(cells.value).max())
    errors = replace(errors, noise_sd=max(errors.noise_sd, rounding))
    covariance = errors.noise_sd**2 * errors.inflation * modes.inverse_information(fit.jacobian, weight)
    sigma_x, sigma_y, _ = bump.widths(fit.theta)
    share = covered_share(tactile_map, centre, radius_mm=1.5 * float(max(sigma_x, sigma_y)))
    result = BumpFit(bump, cells, weight, fit, errors, covariance, share)
    return result, lump_fault(result, options)


def fit_close(
    tactile_map: TactileMap, centre_mm: tuple[float, float], *, options: SamplerSettings
) -> tuple[BumpFit | None, str]:
    """Fit in a window of `CLOSE_IN_RADII`, where a neighbour would pull the bump away.

    The ellipse may turn, so that a ridge shows as one.
    """
    near = replace(options, fit_radius_mm=CLOSE_IN_RADII * options.fit_radius_mm, rotation="on")
    return fit_bump(tactile_map, centre_mm, options=near)


def default_errors(tactile_map: TactileMap) -> tuple[Background, Noise]:
    """Default background and noise, where neither an option nor a size calibration decides.

    As the paper printed it where the level is known. Without a level the background is free, under correlated errors,
    which also take a sloping level: least squares alone then takes a slope for errors and its intervals grow several
    times too wide. A grid of single values, such as a picture, says nothing of its errors; there what the field would
    take up is the shape itself, so its errors are independent (docs/decisions/0071).
    """
    if tactile_map.background is not None:
        return "fixed", "independent"
    return "free", "field" if bool((tactile_map.count > 1).any()) else "independent"


def check_background(tactile_map: TactileMap, options: SamplerSettings) -> None:
    """Refuse a fixed background for a map whose level is not known.

    The map's median, which is the nearest guess, moves with the lump itself: nominal 90 % intervals of widths then
    cover 4 to 29 % (docs/coverage.md).
    """
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

    One that leaves the window, outgrows it or comes to a minimum that another has found is not followed further. Under
    a noise field least squares only finds the place: it need not dwell on a rise that is hardly one, nor look for
    another minimum beside one that is `CLEAR`.
    """
    radius_mm, place_only = options.fit_radius_mm, options.correlated
    fits: list[modes.LeastSquaresFit] = []

    def lost(theta: FloatArray) -> bool:
        away = np.hypot(theta[1] - centre[0], theta[2] - centre[1]) > radius_mm
        outgrown = max(bump.widths(theta)[:2]) > 4.0 * radius_mm
        reached = [other.theta for other in fits if other.converged]
        joins = any((np.abs(theta - other) < JOINED * bump.step_scale).all() for other in reached)
        return bool(away or outgrown or joins)

    mean = float(weight @ cells.value) / float(weight.sum())
    about_mean = float(weight @ (cells.value - mean) ** 2)
    for begin in starts:
        fit = modes.fit_least_squares(
            lambda theta: bump.predict(theta, cells),
            begin,
            data=cells.value,
            weight=weight,
            scale=bump.step_scale,
            tolerance=PLACE_TOLERANCE if place_only else FIT_TOLERANCE,
            abandon=lost,
            patience=PATIENCE if place_only else None,
        )
        fits.append(fit)
        if place_only and fit.converged and fit.sse < (1.0 - CLEAR) * about_mean:
            break
    return min(fits, key=lambda fit: (not fit.converged, fit.sse))


def _start(
    tactile_map: TactileMap, bump: Bump, cells: FitCells, centre: tuple[float, float], width_mm: float
) -> FloatArray:
    level = typical_level(tactile_map)
    near = np.argmin((cells.x_mm - centre[0]) ** 2 + (cells.y_mm - centre[1]) ** 2)
    height = float(cells.value[near]) - level
    values = {"amplitude": height or bump.scale, "x_mm": centre[0], "y_mm": centre[1], "background": level}
    values["p"] = float(np.log(max(width_mm, 0.6 * cells.cell_mm)))
    return np.array([values.get(name, 0.0) for name in bump.names])


def lump_fault(result: BumpFit, options: SamplerSettings) -> str:
    """Reason why a fitted bump is not measured, with the figure and the limit; empty if it can be."""
    sigma_x, sigma_y, _ = result.widths()
    cell = result.cells.cell_mm
    wide, narrow = max(sigma_x, sigma_y), min(sigma_x, sigma_y)
    if not result.theta[0] > 0:
        return f"a depression (amplitude {result.theta[0]:.3g})"
    if not np.isfinite(result.covariance).all():
        return "the map does not determine the bump (singular fit)"
    if narrow < LEAST_WIDTH_IN_CELLS * cell:
        return f"narrower than a cell (sigma {narrow:.2g} mm on {cell:g} mm cells): not resolved"
    if wide > WIDEST_IN_RADII * options.fit_radius_mm:
        return f"{OUTGROWN} (sigma {wide:.3g} mm in a radius of {options.fit_radius_mm:g} mm)"
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
    centre = (float(unrotated.theta[1]), float(unrotated.theta[2]))
    turned, fault = fit_bump(tactile_map, centre, options=replace(options, rotation="on"))
    if turned is None or fault:
        return 0.0, None
    r, sd = float(turned.theta[5]), float(np.sqrt(turned.covariance[5, 5]))
    log_odds = np.log(sd / options.log_ratio_sd) + 0.5 * (r / sd) ** 2
    return float(np.exp(np.clip(log_odds, -700, 700))), turned


# --- Estimation under independent errors: assessment, rotation and draws from a least-squares fit.


class MapDraws(Record, eq=False):
    """Posterior draws of one lump under a noise model."""

    detection: Detection  #: The odds of a lump, as the draws left them.
    fit: BumpFit  #: The least-squares fit that the draws started from.
    draws: ParameterDraws  #: Draws of the model's own parameters.
    posterior: MapPosterior  #: The joint draws by name.
    figures: NoiseFigures  #: Figures of the fit and the noise, for the report.


class White(Record, eq=False):
    """A place on a map under independent errors."""

    tactile_map: TactileMap
    fit: BumpFit
    detection: Detection
    fault: str = ""
    scene: None = None

    @classmethod
    def of(cls, tactile_map: TactileMap, fit: BumpFit, options: SamplerSettings) -> White:
        """Compare a fitted bump with no bump."""
        detection = detect(tactile_map, fit.bump, theta=fit.theta, covariance=fit.covariance, prior=options.prior)
        return cls(tactile_map, fit, detection)

    def bump(self) -> ModalBump:
        """The bump of the least-squares fit."""
        return self.fit.modal()

    def draw(self, options: SamplerSettings, *, rng: np.random.Generator, progress: Progress | None) -> MapDraws:
        """Draw from the posterior, rotated where the odds favour it."""
        fit, odds = self.fit, None
        if options.rotation == "auto":
            odds, turned = rotation_odds(self.tactile_map, fit, options=options)
            fit = turned if turned is not None and odds > ROTATION_ODDS else fit
        target = fit.target(options.prior)
        solved = Solved(lambda theta: (target.excess(theta),))
        draws, _ = draw_parameters(_Independent(fit, target), options, rng=rng, progress=progress, solved=solved)
        theta = draws.theta
        sigma_x, sigma_y, angle = drawn_widths(*fit.bump.shape_parameters(theta))
        # two of the methods are linear about the mode: for them the exact figure would cost more than all the rest
        if draws.method in ("ensemble", "importance"):
            excess = solved(draws.flat)[0]
        else:
            information = fit.fit.jacobian.T @ (fit.weight[:, None] * fit.fit.jacobian)
            off = draws.flat - fit.theta
            excess = np.einsum("mp,pq,mq->m", off, information, off) / fit.errors.inflation
        posterior = MapPosterior(
            amplitude=theta[..., 0],
            sigma_x_mm=sigma_x,
            sigma_y_mm=sigma_y,
            x_mm=theta[..., 1],
            y_mm=theta[..., 2],
            angle_rad=angle,
            background=fit.bump.level(theta),
            noise_sd=target.draw_noise_sd(excess, rng).reshape(theta.shape[:2]),
            labels=draws.replicates,
        )
        figures = {"noise_inflation": fit.errors.inflation, "noise_dof": fit.errors.dof}
        offset = level_offset(fit.fit.residual, weight=fit.weight)
        noise = NoiseFigures("independent", fit.bump.rotated, odds, figures, level_offset=offset)
        return MapDraws(self.detection, fit, draws, posterior, noise)


class _Independent(Record, eq=False):
    """A least-squares fit to be drawn, see `Drawable`."""

    fit: BumpFit
    target: Target
    width_sd_mm: None = None

    def methods(self, options: SamplerSettings) -> Sequence[Method]:
        # weights that cannot be trusted are no matter of chains, which need none
        return ("importance", "ensemble") if options.method == "importance" else (options.method,)

    def at_mode(self, method: Method, number: int, rng: np.random.Generator) -> ParameterDraws:
        del number
        fit = self.fit
        if method == "optimise":
            return modes.optimise(fit.theta, fit.covariance, dof=fit.errors.dof, rng=rng)
        return modes.laplace(
            self.target, fit.theta, scale=np.sqrt(np.diag(fit.covariance)), dof=fit.errors.dof, rng=rng
        )

    def sampled(self, solved: Solved | None = None) -> Sampled:
        scale = np.sqrt(np.diag(self.fit.covariance))
        mode, covariance, _ = modes.mode_and_covariance(self.target, self.fit.theta, scale=scale)
        density = self.target if solved is None else partial(self.target, solved=solved)
        return Sampled(density, mode, covariance)
