"""The estimate under correlated noise, from a first fit to draws."""

from __future__ import annotations

import numpy as np
from scipy.special import ndtri

from tactile_bayes.declarations import Record, replace
from tactile_bayes.errors import NotConvergedError
from tactile_bayes.geometry import FloatArray
from tactile_bayes.inference.draws import MOST_PAIRED, ParameterDraws, Solved, paired_points
from tactile_bayes.mapping.map import TactileMap
from tactile_bayes.posterior import neighbours
from tactile_bayes.posterior.bump import covariance_from_log_widths, drawn_widths, overlap, smoothed_excess, trusted
from tactile_bayes.posterior.detection import Detection, detection_from_odds
from tactile_bayes.posterior.draw import (
    DETECTED,
    MapPosterior,
    ModalBump,
    NoiseFigures,
    SamplerSettings,
    draw_parameters,
)
from tactile_bayes.posterior.fit import (
    ASKING,
    FieldFit,
    SceneChoice,
    ask_departure,
    choose_shape,
    exponent_covariance,
    newton_step_to,
    tangent_columns,
)
from tactile_bayes.posterior.marginal import Scene
from tactile_bayes.posterior.verdict import rim_fault
from tactile_bayes.posterior.white import BumpFit, MapDraws
from tactile_bayes.posterior.window import FLOOR, Problem, Window, cosines_for, independent_variance
from tactile_bayes.presets import FIELD_COSINES, SceneAsked
from tactile_bayes.progress import Progress

# --- Outline of a lump: whether its bump is skewed, or rounder inside than outside, more than a ball's is.
#
# With :math:`z` the place in widths along the ellipse's axes and :math:`G = e^{-|z|^2/2}`, the columns are
# :math:`G\,|z|^2 (z_1, z_2)` for skewness and :math:`G\,|z|^2 (z_1^2 - z_2^2, 2 z_1 z_2)` for an axis ratio that
# changes outwards. What they have in common with the bump, its derivatives and its exponent is taken off under the
# noise field.

BALLS_SD = (0.008, 0.01)
"""SDs of skewness and change of balls' maps beyond their noise, over the amplitude (record 0107)."""
NOISE_FACTOR = 2.5  #: Variance of both over that by the residuals: deep and faint lumps are off by more than they say.
MOST_SDS = 2.5  #: Length of either beyond which a ball is unlikely: of two components, in the SD of one.


def irregular(fit: FieldFit) -> bool:
    """True for a lone bump that is more skewed, or whose axis ratio changes more outwards, than a ball's."""
    if fit.scene.extra or fit.scene.shape == "ridge":  # what is left of a neighbour would answer
        return False
    shape, covariance = outline(fit)
    pairs = ((slice(0, 2), BALLS_SD[0]), (slice(2, 4), BALLS_SD[1]))
    return any(
        float(shape[at] @ np.linalg.solve(NOISE_FACTOR * covariance[at, at] + sd**2 * np.eye(2), shape[at]))
        > MOST_SDS**2
        for at, sd in pairs
    )


def outline(fit: FieldFit) -> tuple[FloatArray, FloatArray]:
    """(4,) skewness and change of the axis ratio, over the amplitude, and their (4, 4) covariance."""
    cells = fit.target.window.cells
    asked, further = _columns(fit)
    known = np.concatenate([tangent_columns(fit), further])
    value = cells.value - cells.value.mean()
    columns = np.concatenate([known, asked, value[None]])
    products = fit.target.products(columns, columns, fit.mode)
    v = len(known)
    shared = np.linalg.lstsq(products[:v, :v], products[:v, v:], rcond=None)[0]
    left = products[v:, v:] - products[v:, :v] @ shared
    coefficients = np.linalg.solve(left[:4, :4], left[:4, 4])
    squares = max(float(left[4, 4] - coefficients @ left[:4, 4]), FLOOR * float(products[-1, -1]))
    variance = squares / max(len(cells) - v - 4, 1)
    amplitude = fit.target.amplitude_at(fit.mode)
    return np.asarray(coefficients / amplitude), np.asarray(np.linalg.inv(left[:4, :4]) * variance / amplitude**2)


def _columns(fit: FieldFit) -> tuple[FloatArray, FloatArray]:
    """(4, n) columns of the outline, and (2, n) of the oblique axis ratio and the exponent."""
    cells, (x, y) = fit.target.window.cells, fit.centre_mm
    root = np.linalg.cholesky(covariance_from_log_widths(*fit.scene.widths(fit.mode)))
    x, y = np.linalg.solve(root, np.stack([cells.x_mm - x, cells.y_mm - y]))
    square = x**2 + y**2
    bump = np.exp(-0.5 * square)
    outer = bump * square
    return np.stack([outer * x, outer * y, outer * (x**2 - y**2), outer * 2 * x * y]), np.stack(
        [bump * x * y, outer * square]
    )


# --- Contribution of tracker position error to the posterior of a bump's shape.
#
# A frame that is off by :math:`\delta` maps the bump shifted by it, so a cell's error is :math:`-\nabla g \cdot
# \bar\delta`, the mean over the frames that felt the cell. Cells less than the array's side apart share frames:
# :math:`\bar\delta` is a smooth field of variance :math:`s^2 / n` with the overlap of two arrays, a triangle along
# each axis, as its correlation. Such errors look like another shape of the bump, so no noise found beside it tells
# of them; what they do to the estimate is added to its draws.

LEAST_EIGENVALUE = 3e-3  #: Least eigenvalue of the overlap of two arrays, over its largest: less is left out.


def pose_covariance(fit: FieldFit) -> FloatArray:
    """(p, p) covariance of the bump's parameters from tracker position error; zeros where it is not known."""
    noise = fit.target.window.cells.pose_noise
    p = fit.scene.own
    covariance = np.zeros((len(fit.mode), len(fit.mode)))
    if noise is None or fit.scene.shape == "ridge":
        return covariance
    known, window = tangent_columns(fit), fit.target.window
    across, along = (_roots(axis, side) for axis, side in zip((window.x_mm, window.y_mm), noise.side_mm, strict=True))
    power = np.outer(np.sum(along**2, axis=1), np.sum(across**2, axis=1))
    i, j = np.nonzero(power > LEAST_EIGENVALUE * power.max())
    # columns whose products sum to the share of frames that two cells share, then the independent parts of their errors
    frames = np.maximum(window.cells.count * noise.frames_per_reading, 1.0)
    shared = window.of_cells(along[i][:, :, None] * across[j][:, None, :]) / np.sqrt(frames)
    slopes = [known[1 + fit.scene.names.index(name)] for name in ("x", "y")]
    errors = np.concatenate([sd * slope * shared for sd, slope in zip(noise.sd_mm, slopes, strict=True)])
    products = fit.target.products(known, np.concatenate([known, errors]), fit.mode)
    v = len(known)
    moved = np.linalg.solve(products[:, :v], products[:, v:])[1 : p + 1]
    covariance[:p, :p] = moved @ moved.T
    return covariance


def _roots(axis_mm: FloatArray, side_mm: float) -> FloatArray:
    """(n, n) rows whose products sum to the overlap of two equal intervals about points of an axis."""
    values, vectors = np.linalg.eigh(overlap(axis_mm, side_mm))
    return np.asarray((vectors * np.sqrt(np.maximum(values, 0.0))).T)


# --- Estimation under correlated errors: detection, scene and draws from a least-squares fit.

LEAST_VARIANCE = 1e-12
"""Directions in which errors of the frames' places spread less, as a share of the largest, are left out."""


class Correlated(Record, eq=False):
    """A place on a map under correlated errors."""

    tactile_map: TactileMap
    fit: BumpFit
    detection: Detection
    scene: SceneChoice | None = None
    """None where the density has no mode: no bump stands out from the correlated noise."""
    fault: str = ""

    @classmethod
    def of(cls, tactile_map: TactileMap, fit: BumpFit, options: SamplerSettings) -> Correlated:
        """Compare a bump with no bump, and where it is a lump by the evidence with neighbouring structures."""
        try:
            scene, detection = fit_and_test(tactile_map, fit, options)
        except NotConvergedError:
            return cls(tactile_map, fit, Detection(0.0, -np.inf))
        fault = rim_fault(tactile_map, scene.plain.modal(), radius_mm=options.fit_radius_mm)
        if not fault and detection.probability >= DETECTED:
            scene, detection = with_neighbours(scene, detection, tactile_map, asked=options.scene_asked)
        return cls(tactile_map, fit, detection, scene, fault)

    def bump(self) -> ModalBump:
        """The bump at the scene's mode, which there is where the detection has any odds."""
        assert self.scene is not None
        return self.scene.fit.modal()

    def draw(self, options: SamplerSettings, *, rng: np.random.Generator, progress: Progress | None) -> MapDraws:
        """Draw from the posterior; `NotConvergedError` also when the scene's neighbour was not found."""
        choice, asked = self.scene, options.scene_asked
        assert choice is not None
        wanted = neighbours.WANTED.get(asked, "")
        if wanted and choice.fit.scene.extra != wanted:
            raise NotConvergedError(f"no {wanted} found beside the bump", advice=f"leave out --scene {asked}")
        fit, target = choice.fit, choice.fit.target
        solved = Solved(target.conditional)
        draws, passed_over = draw_parameters(fit, options, rng=rng, progress=progress, solved=solved)
        detection = self.detection
        if fit is choice.plain and not detection.ridge and "log_evidence" in draws.diagnostics:
            detection = field_detection(fit, self.tactile_map, draws.diagnostics["log_evidence"])
        places = pose_covariance(fit)
        share = None
        if target.window.cells.pose_noise is not None:
            widths = [fit.scene.names.index(name) for name in ("u", "v") if name in fit.scene.names]
            added, other = (float(np.diag(one)[widths].sum()) for one in (places, fit.covariance))
            share = added / (added + other)
        figures = NoiseFigures(
            "field",
            fit.scene.shape == "rotated",
            next((one.odds for one in choice.structures if one.name == "rotated"), None),
            {"field_cosines": target.window.cosines, **target.field_summary(fit.mode)},
            places_share=share,
            passed_over=passed_over,
        )
        return MapDraws(detection, self.fit, draws, _posterior(fit, draws, rng, solved, places), figures)


def fit_and_test(tactile_map: TactileMap, fit: BumpFit, options: SamplerSettings) -> tuple[SceneChoice, Detection]:
    """Fit the bump under correlated errors, and compare it with no bump; `NotConvergedError` without a mode.

    Where `field_cosines` is "auto", a narrow bump that may be a lump is fitted once more, with a finer field.
    """

    def under(number: int, start: FloatArray) -> tuple[SceneChoice, Detection]:
        window = Window(fit.cells, independent_variance(fit.cells), cosines=number)
        problem = Problem(window, options.prior, options.fit_radius_mm, fit.bump.scale)
        choice = choose_shape(problem, start, scene=options.scene_asked)
        return choice, field_detection(choice.plain, tactile_map, choice.plain.log_evidence)

    p, q, r = (float(one) for one in fit.bump.shape_parameters(fit.theta))
    start, asked = np.array([p + q, p - q, *fit.theta[1:3], r]), options.field_cosines
    choice, detection = under(FIELD_COSINES if asked == "auto" else asked, start)
    if asked != "auto" or not detection.log_bayes_factor > 0:
        return choice, detection
    plain, bump = choice.plain, choice.plain.modal()
    axes = plain.target.window.x_mm, plain.target.window.y_mm
    wanted = max(cosines_for(min(bump.sigma_x_mm, bump.sigma_y_mm), axis) for axis in axes)
    if wanted <= FIELD_COSINES:
        return choice, detection
    return under(wanted, plain.scene.carried(plain.mode, Scene("rotated")))


def field_detection(plain: FieldFit, tactile_map: TactileMap, log_evidence: float) -> Detection:
    """Odds of a bump somewhere on the map against level, tilt and the same noise fields alone.

    The window's evidence has the centre anywhere in the window; the search over the rest of the map is paid for.
    """
    return detection_from_odds(log_evidence - plain.target.null_log_evidence() - _searched(plain, tactile_map))


def _searched(plain: FieldFit, tactile_map: TactileMap) -> float:
    """Log number of windows in the map's area."""
    area = float(trusted(tactile_map).sum()) * tactile_map.recipe.cell_mm**2
    return float(np.log(max(area / (np.pi * plain.target.problem.radius_mm**2), 1.0)))


def with_neighbours(
    choice: SceneChoice, detection: Detection, tactile_map: TactileMap, *, asked: SceneAsked
) -> tuple[SceneChoice, Detection]:
    """Add a second structure where the evidence supports it, and compare the lump with a ridge where one rises.

    A bump alone is tested for a departure from a Gaussian. Only scenes in `ASKING` are compared with a ridge:
    without a rib in the model a lump beside one would lose to it.
    """
    if asked not in ASKING:
        return ask_departure(choice), detection
    surroundings = neighbours.Surroundings(tactile_map.x_mm, tactile_map.y_mm, smoothed_excess(tactile_map))
    ridges = neighbours.rising_ribs(choice.plain, surroundings)
    choice = neighbours.add_beside(choice, surroundings, ridges=ridges, scene=asked)
    ridge = neighbours.ridge_instead(choice, ridges)
    if ridge is not None and ridge.log_evidence >= choice.plain.target.null_log_evidence():
        against = ridge.log_evidence + _searched(choice.plain, tactile_map)
        detection = detection_from_odds(choice.fit.log_evidence - against, ridge=neighbours.ridge_text(ridge))
        if detection.probability < DETECTED and (both := neighbours.beside_ridge(choice, ridge)) is not None:
            detection = detection_from_odds(both.log_evidence - against, ridge=detection.ridge)
    return ask_departure(choice), detection


def _posterior(
    fit: FieldFit, draws: ParameterDraws, rng: np.random.Generator, solved: Solved, places: FloatArray
) -> MapPosterior:
    """Draws by name, with tracker position error and what the noise field leaves open of a non-Gaussian bump added."""
    shape = draws.theta.shape[:2]
    theta = draws.theta + _displaced(fit, draws, places + exponent_covariance(fit), rng).reshape(draws.theta.shape)
    sigma_x, sigma_y, angle = drawn_widths(*fit.scene.widths(theta))
    amplitude, level, noise_sd = fit.target.draw_linear(draws.flat, rng, solved=solved)
    return MapPosterior(
        amplitude=amplitude[:, 0].reshape(shape),
        sigma_x_mm=sigma_x,
        sigma_y_mm=sigma_y,
        x_mm=fit.scene.column(theta, "x"),
        y_mm=fit.scene.column(theta, "y"),
        angle_rad=angle,
        background=level.reshape(shape),
        noise_sd=noise_sd.reshape(shape),
        labels=draws.replicates,
        oblique=_oblique(fit, places),
        irregular=irregular(fit),
    )


def _oblique(fit: FieldFit, places: FloatArray) -> tuple[float, float] | None:
    """Mean and SD of the half log axis ratio 45 degrees from the map's x axis, where the scene has none.

    By one Newton step from the mode, to that of the scene with it; None where that does not lead to one. Errors of the
    frames' places are taken to spread it as they spread the ratio along the axes.
    """
    if fit.scene.shape != "ellipse":
        return None
    scene = replace(fit.scene, shape="rotated")
    mixture = newton_step_to(fit, scene)
    if mixture is None:
        return None
    mean, covariance = mixture.moments()
    r = scene.names.index("r")
    along = np.array([0.5 * ((name == "u") - (name == "v")) for name in fit.scene.names])
    return float(mean[r]), float(np.sqrt(covariance[r, r] + along @ places @ along))


def _displaced(fit: FieldFit, draws: ParameterDraws, places: FloatArray, rng: np.random.Generator) -> FloatArray:
    """(chain * draw, p) normal draws with a covariance, spread evenly over the draws in order of mean width."""
    values, vectors = np.linalg.eigh(places)
    kept = np.flatnonzero(values > LEAST_VARIANCE * values[-1])[-MOST_PAIRED:]
    if not values[-1] > 0:
        return np.zeros_like(draws.flat)
    width = fit.scene.column(draws.flat, "u") + fit.scene.column(draws.flat, "v")
    points = paired_points(width, draws.replicates, len(kept), rng)
    return np.asarray(ndtri(points) @ (vectors[:, kept] * np.sqrt(values[kept])).T)
