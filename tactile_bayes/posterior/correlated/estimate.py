"""A bump under correlated errors: detection, scene and draws from its least-squares fit."""

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
from tactile_bayes.posterior.correlated.fit import FieldFit, field_window, shape_draws, start_vector
from tactile_bayes.posterior.correlated.neighbour import WANTED, add_beside, rising_ribs
from tactile_bayes.posterior.correlated.noise import cosines_for
from tactile_bayes.posterior.correlated.peakedness import ask_departure
from tactile_bayes.posterior.correlated.pose_error import pose_covariance
from tactile_bayes.posterior.correlated.problem import Problem
from tactile_bayes.posterior.correlated.ridge import ridge_instead, ridge_text
from tactile_bayes.posterior.correlated.scene import Scene
from tactile_bayes.posterior.correlated.selection import ASKING, SceneChoice, choose_shape
from tactile_bayes.posterior.correlated.surroundings import Surroundings
from tactile_bayes.posterior.lump.bump import BumpPrior
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
    """What the map says under correlated errors.

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
    """Draws under correlated errors: of the scene's parameters, by name, and figures of the fit and the noise."""

    detection: Detection
    choice: SceneChoice
    draws: ParameterDraws
    posterior: MapPosterior
    figures: NoiseFigures


def look(
    tactile_map: TactileMap,
    fit: BumpFit,
    *,
    prior: BumpPrior,
    radius_mm: float,
    scene: SceneAsked = "auto",
    least_odds: float,
    cosines: int | None = None,
) -> FieldAnswer:
    """Fit the bump under correlated errors and weigh it against none.

    Parameters
    ----------
    cosines
        As `FitOptions.field_cosines`. Without a number a bump that may be a lump and is narrow is fitted once more,
        with a finer field.

    Raises
    ------
    NotConvergedError
        When the density has no mode.
    """

    def under(number: int, start: FloatArray) -> FieldAnswer:
        problem = Problem(field_window(fit, cosines=number), prior, radius_mm, fit.bump.scale)
        choice = choose_shape(problem, start, scene=scene, least_odds=least_odds)
        return FieldAnswer(field_detection(choice.plain, tactile_map, choice.plain.log_evidence), choice)

    full = Scene("rotated")
    answer = under(cosines or FIELD_COSINES, start_vector(fit, full))
    if cosines is not None or not answer.detection.log_bayes_factor > 0:
        return answer
    wanted = _called_for(answer.choice.plain)
    if wanted <= FIELD_COSINES:
        return answer
    return under(wanted, answer.choice.plain.scene.carried(answer.choice.plain.mode, full))


def _called_for(plain: FieldFit) -> int:
    """Cosines that the fitted bump's narrower width calls for."""
    sigma_x, sigma_y, _ = (float(values[0]) for values in shape_draws(plain, plain.mode[None]))
    window = plain.target.window
    return max(cosines_for(min(sigma_x, sigma_y), axis) for axis in (window.x_mm, window.y_mm))


def field_detection(plain: FieldFit, tactile_map: TactileMap, log_evidence: float) -> Detection:
    """Odds of a bump somewhere on the map against level, tilt and the same noise fields alone.

    The window's evidence has the centre anywhere in the window; the search over the rest of the map is paid for.
    """
    return detection_from_odds(log_evidence - plain.target.null_log_evidence() - _searched(plain, tactile_map))


def _searched(plain: FieldFit, tactile_map: TactileMap) -> float:
    """Log of how many windows the map has."""
    area = float(trusted(tactile_map).sum()) * tactile_map.recipe.cell_mm**2
    return float(np.log(max(area / (np.pi * plain.target.problem.radius_mm**2), 1.0)))


def with_neighbours(answer: FieldAnswer, tactile_map: TactileMap, *, scene: SceneAsked = "auto") -> FieldAnswer:
    """The same with a second structure where the map asks for one, the lump weighed against a ridge where one rises.

    A bump alone is asked whether it is a Gaussian. Only scenes that ask what lies beside the lump are weighed so:
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
    """Draws of what was found.

    Raises
    ------
    NotConvergedError
        When no method converges, or the neighbour that the scene asks for was not found.
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
    return FieldDraws(detection, choice, draws, _posterior(choice.fit, draws, rng, solved, places), figures)


def _posterior(
    fit: FieldFit, draws: ParameterDraws, rng: np.random.Generator, solved: Solved, places: FloatArray
) -> MapPosterior:
    """Draws by name, with what errors of the frames' places add to them."""
    shape = draws.theta.shape[:2]
    theta = draws.theta + _displaced(fit, draws, places, rng).reshape(draws.theta.shape)
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
    )


def _displaced(fit: FieldFit, draws: ParameterDraws, places: FloatArray, rng: np.random.Generator) -> FloatArray:
    """(chain * draw, p) normal draws of a covariance, spread evenly over the draws in order of their mean width."""
    values, vectors = np.linalg.eigh(places)
    kept = np.flatnonzero(values > LEAST_VARIANCE * values[-1])[-MOST_PAIRED:]
    if not values[-1] > 0:
        return np.zeros_like(draws.flat)
    width = fit.scene.column(draws.flat, "u") + fit.scene.column(draws.flat, "v")
    points = paired_points(width, draws.replicates, len(kept), rng)
    return np.asarray(normal_quantile(points) @ (vectors[:, kept] * np.sqrt(values[kept])).T)


def _places_share(fit: FieldFit, places: FloatArray) -> float | None:
    """Share of the variance of the log widths that errors of the frames' places make; None where they are not told."""
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
