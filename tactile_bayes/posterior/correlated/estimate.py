"""Estimation under correlated errors: detection, scene and draws from a least-squares fit."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from tactile_bayes.errors import NotConvergedError
from tactile_bayes.geometry import FloatArray
from tactile_bayes.inference.cache import Solved
from tactile_bayes.inference.draws import ParameterDraws
from tactile_bayes.inference.normal import normal_quantile
from tactile_bayes.inference.paired import MOST_PAIRED, paired_points
from tactile_bayes.mapping.tactile_map import TactileMap
from tactile_bayes.posterior.correlated.draw import draw_scene
from tactile_bayes.posterior.correlated.fit import FieldFit, field_window, modal_widths, shape_draws, start_vector
from tactile_bayes.posterior.correlated.neighbour import WANTED, add_beside, rising_ribs
from tactile_bayes.posterior.correlated.noise import cosines_for
from tactile_bayes.posterior.correlated.outline import irregular
from tactile_bayes.posterior.correlated.peakedness import ask_departure, exponent_covariance
from tactile_bayes.posterior.correlated.pose_error import pose_covariance
from tactile_bayes.posterior.correlated.problem import Problem
from tactile_bayes.posterior.correlated.ridge import ridge_instead, ridge_text
from tactile_bayes.posterior.correlated.scene import Scene
from tactile_bayes.posterior.correlated.selection import ASKING, SceneChoice, choose_shape, near
from tactile_bayes.posterior.correlated.surroundings import Surroundings
from tactile_bayes.posterior.lump.cells import trusted
from tactile_bayes.posterior.lump.diagnostics import NoiseFigures
from tactile_bayes.posterior.lump.posterior import MapPosterior
from tactile_bayes.posterior.options import EstimateOptions, scene_asked
from tactile_bayes.posterior.white.detection import Detection, detection_from_odds
from tactile_bayes.posterior.white.fit import BumpFit
from tactile_bayes.presets import FIELD_COSINES, SceneAsked
from tactile_bayes.records import dataclass

Progress = Callable[[int, int], None]
LEAST_VARIANCE = 1e-12
"""Directions in which errors of the frames' places spread less, as a share of the largest, are left out."""


@dataclass(frozen=True, slots=True, eq=False)
class FieldAnswer:
    """Detection and scene of a map under correlated errors.

    Parameters
    ----------
    detection
        Whether there is a lump.
    choice
        The scene.
    """

    detection: Detection
    choice: SceneChoice


@dataclass(frozen=True, slots=True, eq=False)
class FieldDraws:
    """Draws under correlated errors: of the scene's parameters, by name, and figures of fit and noise."""

    detection: Detection
    draws: ParameterDraws
    posterior: MapPosterior
    figures: NoiseFigures


def look(tactile_map: TactileMap, fit: BumpFit, options: EstimateOptions) -> FieldAnswer:
    """Fit the bump under correlated errors, and compare it with no bump.

    Where the options give no `field_cosines`, a narrow bump that may be a lump is fitted once more, with a finer field.

    Raises
    ------
    NotConvergedError
        When the density has no mode.
    """

    def under(number: int, start: FloatArray) -> FieldAnswer:
        problem = Problem(field_window(fit, cosines=number), options.prior, options.fit.radius_mm, fit.bump.scale)
        choice = choose_shape(problem, start, scene=scene_asked(options))
        return FieldAnswer(field_detection(choice.plain, tactile_map, choice.plain.log_evidence), choice)

    full, cosines = Scene("rotated"), options.fit.field_cosines
    answer = under(cosines or FIELD_COSINES, start_vector(fit, full))
    if cosines is not None or not answer.detection.log_bayes_factor > 0:
        return answer
    wanted = _called_for(answer.choice.plain)
    if wanted <= FIELD_COSINES:
        return answer
    return under(wanted, answer.choice.plain.scene.carried(answer.choice.plain.mode, full))


def _called_for(plain: FieldFit) -> int:
    """Number of cosines for the narrower width of the fitted bump."""
    narrower, window = min(modal_widths(plain)), plain.target.window
    return max(cosines_for(narrower, axis) for axis in (window.x_mm, window.y_mm))


def field_detection(plain: FieldFit, tactile_map: TactileMap, log_evidence: float) -> Detection:
    """Odds of a bump somewhere on the map against level, tilt and the same noise fields alone.

    The window's evidence has the centre anywhere in the window; the search over the rest of the map is paid for.
    """
    return detection_from_odds(log_evidence - plain.target.null_log_evidence() - _searched(plain, tactile_map))


def _searched(plain: FieldFit, tactile_map: TactileMap) -> float:
    """Log number of windows in the map's area."""
    area = float(trusted(tactile_map).sum()) * tactile_map.recipe.cell_mm**2
    return float(np.log(max(area / (np.pi * plain.target.problem.radius_mm**2), 1.0)))


def with_neighbours(answer: FieldAnswer, tactile_map: TactileMap, *, scene: SceneAsked = "auto") -> FieldAnswer:
    """Add a second structure where the evidence supports it, and compare the lump with a ridge where one rises.

    A bump alone is tested for a departure from a Gaussian. Only scenes in `ASKING` are compared with a ridge:
    without a rib in the model a lump beside one would lose to it.
    """
    if scene not in ASKING:
        return replace(answer, choice=ask_departure(answer.choice))
    surroundings = Surroundings.of(tactile_map)
    ridges = rising_ribs(answer.choice.plain, surroundings)
    choice = add_beside(answer.choice, surroundings, ridges=ridges, scene=scene)
    ridge = ridge_instead(choice, ridges)
    found = replace(answer, choice=ask_departure(choice))
    if ridge is None or ridge.log_evidence < choice.plain.target.null_log_evidence():
        return found
    log_factor = choice.fit.log_evidence - ridge.log_evidence - _searched(choice.plain, tactile_map)
    return replace(found, detection=detection_from_odds(log_factor, ridge=ridge_text(ridge)))


def draw(
    answer: FieldAnswer,
    tactile_map: TactileMap,
    options: EstimateOptions,
    *,
    rng: np.random.Generator,
    progress: Progress | None = None,
) -> FieldDraws:
    """Draw from the posterior of an answer.

    Raises
    ------
    NotConvergedError
        When no method converges, or the scene's neighbour was not found.
    """
    scene = scene_asked(options)
    choice, wanted = answer.choice, WANTED.get(scene, "")
    if wanted and choice.fit.scene.extra != wanted:
        raise NotConvergedError(f"no {wanted} found beside the bump; leave out --scene {scene}")
    solved = Solved(choice.fit.target.conditional)
    draws, passed_over = draw_scene(choice.fit, options, rng=rng, progress=progress, solved=solved)
    detection = answer.detection
    if choice.fit is choice.plain and not detection.ridge and "log_evidence" in draws.diagnostics:
        detection = field_detection(choice.plain, tactile_map, draws.diagnostics["log_evidence"])
    places = pose_covariance(choice.fit)
    figures = _figures(choice, _places_share(choice.fit, places), passed_over)
    return FieldDraws(detection, draws, _posterior(choice.fit, draws, rng, solved, places), figures)


def _posterior(
    fit: FieldFit, draws: ParameterDraws, rng: np.random.Generator, solved: Solved, places: FloatArray
) -> MapPosterior:
    """Draws by name, with tracker position error and what the noise field leaves open of a non-Gaussian bump added."""
    shape = draws.theta.shape[:2]
    theta = draws.theta + _displaced(fit, draws, places + exponent_covariance(fit), rng).reshape(draws.theta.shape)
    sigma_x, sigma_y, angle = shape_draws(fit, theta)
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
    mixture = near(fit, scene)
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
    return np.asarray(normal_quantile(points) @ (vectors[:, kept] * np.sqrt(values[kept])).T)


def _places_share(fit: FieldFit, places: FloatArray) -> float | None:
    """Share of the log widths' variance from tracker position error; None where that is not known."""
    if fit.target.window.cells.pose_noise is None:
        return None
    widths = [fit.scene.names.index(name) for name in ("u", "v") if name in fit.scene.names]
    added = float(np.diag(places)[widths].sum())
    return added / (added + float(np.diag(fit.covariance)[widths].sum()))


def _figures(choice: SceneChoice, places_share: float | None, passed_over: tuple[str, ...]) -> NoiseFigures:
    odds = {one.name: one.odds for one in choice.structures}
    target = choice.fit.target
    figures = {"field_cosines": target.window.cosines, **target.field_summary(choice.fit.mode)}
    return NoiseFigures(
        "field",
        choice.fit.rotated,
        odds.get("rotated"),
        figures,
        places_share=places_share,
        passed_over=passed_over,
    )
