"""Model selection: the simplest scene that a window's evidence supports, and what it leaves out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import field, replace
from typing import assert_never

import numpy as np

from tactile_bayes.errors import NotConvergedError
from tactile_bayes.geometry import FloatArray
from tactile_bayes.posterior.correlated.fit import FieldFit, Mixture, fit_scene, newton_mixture
from tactile_bayes.posterior.correlated.problem import Problem
from tactile_bayes.posterior.correlated.scene import Scene, Shape
from tactile_bayes.posterior.options import ROTATION_ODDS
from tactile_bayes.presets import SceneAsked
from tactile_bayes.records import dataclass

LEAST_ODDS = 3.0
"""A structure is used when the map favours the scene with it by this factor."""
ASKING = ("auto", "second-lump", "rib")


@dataclass(frozen=True, slots=True)
class Structure:
    """A question about the scene, with its answer.

    Parameters
    ----------
    name
        ``"ellipse"`` (against round), ``"rotated"``, ``"tilt"``, ``"second lump"``, ``"rib"``, ``"departure"`` (from a
        Gaussian).
    odds
        Bayes factor of the scene with it against the scene without; an upper bound where `bound`.
    supported
        Whether the evidence supports it: the odds exceed a threshold.
    used
        Whether the draws have it.
    bound
        Whether the odds are a bound from the best of a grid of templates.
    change_x_sd, change_y_sd
        By how many posterior SDs the median of ln sigma_x and ln sigma_y would change, had it been decided the other
        way; None where that was not fitted.
    place
        Where it lies or what it is like, in words; empty when there is nothing to say.
    """

    name: str
    odds: float
    supported: bool
    used: bool
    bound: bool = False
    change_x_sd: float | None = None
    change_y_sd: float | None = None
    place: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class SceneChoice:
    """The scene chosen for the draws, and the evidence for it.

    Parameters
    ----------
    fit
        Its mode.
    plain
        The fit without a second structure, by which a lump is detected.
    supported
        The simplest shape that the map supports: ``"round"``, ``"ellipse"`` or ``"rotated"``.
    structures
        Every question asked.
    """

    fit: FieldFit
    plain: FieldFit
    supported: str
    structures: tuple[Structure, ...] = field(default_factory=tuple)


def choose_shape(problem: Problem, start: FloatArray, *, scene: SceneAsked = "auto") -> SceneChoice:
    """Fit the bump, and test whether it is round, rotated and on a slope.

    Parameters
    ----------
    start : (5,) array
        ``(u, v, x, y, r)`` of a rotated ellipse.
    scene
        One of `presets.SCENES`: ``"auto"``, or what the draws shall have.

    Notes
    -----
    Level and tilt are always integrated out, and the axis ratio stays free unless `scene` says round: dropping either
    where the evidence does not ask for it costs coverage and gains little (docs/decisions/0055). What the evidence says
    of them is reported all the same.
    """
    wanted = Scene(_shape_asked(scene))
    chosen = fit_scene(problem, wanted, Scene("rotated").carried(start, wanted))
    found = [_ellipse_question(chosen)] if wanted.shape == "ellipse" else []
    if scene in ASKING:
        chosen, turned = _rotation_question(problem, chosen, start)
        found.append(turned)
    return SceneChoice(chosen, chosen, _supported_shape(chosen, found), (*found, _tilt_question(chosen)))


def _shape_asked(scene: SceneAsked) -> Shape:
    """Shape of the bump in the first fit for a scene."""
    match scene:
        case "round" | "rotated":
            return scene
        case "auto" | "none" | "ellipse" | "second-lump" | "rib":
            return "ellipse"
    assert_never(scene)


def asked_again(choice: SceneChoice, fit: FieldFit) -> SceneChoice:
    """Copy the choice with another fit, and repeat the tests for an ellipse and a slope.

    The flank of what lies beside a bump looks like a slope to a model without it.
    """
    answers = {one.name: one for one in choice.structures}
    if fit.scene.shape == "ellipse":
        answers["ellipse"] = _ellipse_question(fit)
    answers["tilt"] = _tilt_question(fit)
    structures = tuple(answers.values())
    return replace(choice, fit=fit, supported=_supported_shape(fit, structures), structures=structures)


def fit_or_none(problem: Problem, scene: Scene, start: FloatArray) -> FieldFit | None:
    """As `fit_scene`; None where there is no mode."""
    try:
        return fit_scene(problem, scene, start)
    except NotConvergedError:
        return None


def near(fit: FieldFit, scene: Scene) -> Mixture | None:
    """Gaussians of another scene by one Newton step from a fit's mode; None where they are not close together."""
    target = fit.target.of_scene(scene)
    start = fit.scene.carried(fit.mode, scene)
    target.settle_fields(start)
    scale = np.diag(np.square(scene.steps))
    shared = [name for name in scene.names if name in fit.scene.names]
    here, there = ([s.names.index(n) for n in shared] for s in (fit.scene, scene))
    scale[np.ix_(there, there)] = fit.covariance[np.ix_(here, here)]
    return newton_mixture(target, start, scale)


def _supported_shape(chosen: FieldFit, found: Sequence[Structure]) -> str:
    if chosen.scene.shape != "ellipse":
        return chosen.scene.shape
    return "ellipse" if any(one.name == "ellipse" and one.supported for one in found) else "round"


def _ellipse_question(fit: FieldFit) -> Structure:
    """Test ellipse against round by the Savage-Dickey ratio at q = 0, with the conditional means there."""
    direction = np.zeros(len(fit.mode))
    direction[:2] = 0.5, -0.5
    log_odds = savage_dickey(fit.mixture, direction, prior_sd=fit.target.problem.prior.log_ratio_sd)
    mean, covariance = fit.mixture.moments()
    along = covariance @ direction
    shift = -along * (direction @ mean) / (direction @ along)
    x, y = shift[:2] / np.sqrt(np.diag(covariance)[:2])
    return Structure("ellipse", odds(log_odds), bool(log_odds > np.log(LEAST_ODDS)), True, False, float(x), float(y))


def _rotation_question(problem: Problem, straight: FieldFit, start: FloatArray) -> tuple[FieldFit, Structure]:
    """Test a rotated ellipse against a straight one: by one Newton step, or by its mode where that is not clear."""
    scene = replace(straight.scene, shape="rotated")
    mixture = near(straight, scene)
    axis = np.eye(5)[4]
    log_odds = np.inf if mixture is None else savage_dickey(mixture, axis, prior_sd=problem.prior.log_ratio_sd)
    turned = None
    if log_odds > -1.5:
        begin = straight.scene.carried(straight.mode, scene)
        begin[4] = start[4] if mixture is None else mixture.moments()[0][4]
        turned = fit_or_none(problem, scene, begin)
        if turned is not None:
            mixture = turned.mixture
            log_odds = savage_dickey(mixture, axis, prior_sd=problem.prior.log_ratio_sd)
    if mixture is None:
        return straight, Structure("rotated", 0.0, False, False)
    used = turned is not None and log_odds > np.log(ROTATION_ODDS)
    x, y = change_in_sd(straight, mixture.moments()[0])
    if used and turned is not None:
        return turned, Structure("rotated", odds(log_odds), True, True, False, -x, -y)
    return straight, Structure("rotated", odds(log_odds), False, False, False, x, y)


def _tilt_question(fit: FieldFit) -> Structure:
    log_odds = fit.target.tilt_log_odds(fit.mode)
    level_only = near(fit, replace(fit.scene, tilt=False))
    x, y = (None, None) if level_only is None else change_in_sd(fit, level_only.moments()[0])
    return Structure("tilt", odds(log_odds), bool(log_odds > np.log(LEAST_ODDS)), True, False, x, y)


def change_in_sd(fit: FieldFit, other: FloatArray) -> tuple[float, float]:
    """Other minus fit in ln sigma_x and ln sigma_y, in the fit's SDs; `other` begins with its own u and v."""
    if fit.scene.shape == "round":
        change = float((other[0] - fit.mode[0]) / np.sqrt(fit.covariance[0, 0]))
        return change, change
    x, y = (other[:2] - fit.mode[:2]) / np.sqrt(np.diag(fit.covariance)[:2])
    return float(x), float(y)


def savage_dickey(mixture: Mixture, direction: FloatArray, *, prior_sd: float) -> float:
    """Log Bayes factor against ``direction @ theta = 0``, whose prior is normal about 0."""
    mean = mixture.mean @ direction
    variance = np.einsum("p,hpq,q->h", direction, mixture.covariance, direction)
    posterior = np.log(mixture.weight) - 0.5 * (mean**2 / variance + np.log(2.0 * np.pi * variance))
    return float(-0.5 * np.log(2.0 * np.pi * prior_sd**2) - np.logaddexp.reduce(posterior))


def odds(log_odds: float) -> float:
    """Convert a log Bayes factor to a finite Bayes factor."""
    return float(np.exp(np.clip(log_odds, -700.0, 700.0)))
