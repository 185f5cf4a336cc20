"""A scene fitted under correlated noise: its mode and draws, and the choice of what it holds by the evidence."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from functools import cached_property, partial

import numpy as np

from tactile_bayes.declarations import Record, as_dict, replace
from tactile_bayes.errors import NotConvergedError
from tactile_bayes.geometry import FloatArray
from tactile_bayes.inference.draws import ParameterDraws, Solved, student_draws
from tactile_bayes.inference.importance import Gaussians, smooth_weights
from tactile_bayes.inference.modes import find_mode, finite_differences, mode_and_covariance, stencil
from tactile_bayes.posterior.bump import covariance_from_log_widths, drawn_widths
from tactile_bayes.posterior.draw import ROTATION_ODDS, ModalBump, Sampled, with_beside
from tactile_bayes.posterior.marginal import STEP, CollapsedTarget, Scene
from tactile_bayes.posterior.window import FLOOR, NEGLIGIBLE, Problem, linear_columns
from tactile_bayes.presets import Method, SceneName

# --- Posterior of a scene under correlated errors: its mode, a Gaussian for each noise field, and draws.

MOST_SETTLINGS = 6
ROUGH, FINE = 0.3, 1e-3
"""Last Newton step, in `Scene.steps`: under the start's fields, which are not the mode's; then under those."""
LEAST_SHARE = 1e-2
"""Fields with a smaller share of the density at the mode have no Gaussian of their own in what `laplace` draws."""
CHECKED = 512  #: Draws of the Gaussians that are weighed to judge them.


class Mixture(Gaussians, eq=False):
    """One Gaussian for each noise field that matters: the mixture that `laplace` draws from."""

    log_evidence: float  #: Log of the integral of the density that the mixture stands for.


class FieldFit(Record, eq=False, dict=True):
    """A scene fitted at the mode of its marginal posterior."""

    target: CollapsedTarget  #: Its density, with the noise fields that matter there.
    mode: FloatArray  #: (p,) array: The scene's parameters.
    covariance: FloatArray  #: (p, p) array: The mixture's, not the curvature at the mode.
    mixture: Mixture  #: One Gaussian per noise field.

    @property
    def scene(self) -> Scene:
        """Structures in the model."""
        return self.target.scene

    @cached_property
    def at(self) -> Mapping[str, float]:
        """Parameters at the mode by name, 0 for those that the scene does not have; p, q and r of `Scene.widths`."""
        scene = self.scene
        widths = zip("pqr", scene.widths(self.mode), strict=True)
        named = {name: scene.column(self.mode, name) for name in STEP} | dict(widths)
        return {name: float(value) for name, value in named.items()}

    @property
    def centre_mm(self) -> tuple[float, float]:
        """The bump's centre at the mode."""
        return self.at["x"], self.at["y"]

    @property
    def log_evidence(self) -> float:
        """Log evidence of the scene, from the Gaussians' volumes."""
        return self.mixture.log_evidence

    def modal(self) -> ModalBump:
        """The bump at the mode."""
        sigma_x, sigma_y, _ = (float(one[0]) for one in drawn_widths(*(np.array([self.at[name]]) for name in "pqr")))
        return ModalBump(self.target.amplitude_at(self.mode), *self.centre_mm, sigma_x, sigma_y)

    @property
    def width_sd_mm(self) -> float:
        """Posterior SD of the less certain width, from the Gaussian approximation."""
        sd = dict(zip(self.scene.names, np.sqrt(np.diag(self.covariance)), strict=True))
        return max(float(sd[name]) * float(np.exp(self.at[name])) for name in ("u", "v") if name in sd)

    def at_mode(self, method: Method, number: int, rng: np.random.Generator) -> ParameterDraws:
        """Draw from the fields' Gaussians, with t tails for the noise scale, and the Pareto shape of their weights.

        Where several fields share the evidence one Gaussian was up to 25 % too narrow; a Gaussian for each is within a
        few per cent.
        """
        mixture, dof = self.mixture, float(self.target.dof)
        widen = (dof + len(self.mode)) / dof
        parts = [
            student_draws(mean, widen * covariance, dof=dof, number=int(n), rng=rng)
            for mean, covariance, n in zip(
                mixture.mean, mixture.covariance, rng.multinomial(number, mixture.weight), strict=True
            )
        ]
        flat = rng.permutation(np.concatenate(parts))
        some = flat[:CHECKED]
        _, shape = smooth_weights(self.target(some) - mixture.log_density(some))
        figures = {"draws": float(number), "fields": float(len(parts)), "pareto_k": float(shape)}
        return ParameterDraws(flat[None], method, figures)

    def sampled(self, solved: Solved | None = None) -> Sampled:
        """The density to sample; without a second structure it is the fit's own, and keeps its solutions."""
        mean, covariance = self.mixture.moments()
        k, target = self.scene.own, self.target
        parts = newton_mixture(target, self.mode, self.covariance, least_share=NEGLIGIBLE)
        if k == len(mean):
            density = target if solved is None else partial(target, solved=solved)
            return Sampled(density, mean, covariance, parts, checkpoint_key=self.checkpoint_key)
        across, beside = covariance[:k, k:], self.mode[k:]
        added = across @ np.linalg.solve(covariance[k:, k:], across.T)
        values, vectors = np.linalg.eigh(0.5 * (added + added.T))
        spread = vectors * np.sqrt(np.clip(values, 0.0, None))
        given = None if parts is None else parts.given(beside)
        return Sampled(
            lambda theta: target(with_beside(theta, beside)),
            self.mode[:k],
            covariance[:k, :k] - added,
            given,
            beside,
            spread,
            self.checkpoint_key,
        )

    def checkpoint_key(self, settings: str, rng: np.random.Generator) -> str:
        """Hash of everything that a chain depends on: cells, scene, priors, fields, settings and seed."""
        target, digest = self.target, hashlib.sha256()
        cells = target.window.cells
        arrays = [cells.x_mm, cells.y_mm, cells.value, cells.count, target.window.variance, self.mode, self.covariance]
        arrays += [] if target.problem.departure is None else [target.problem.departure]
        for values in arrays:
            digest.update(np.ascontiguousarray(values, dtype="<f8").tobytes())
        said = {
            "scene": as_dict(self.scene),
            "prior": as_dict(target.problem.prior),
            "scale": target.problem.amplitude_scale,
            "bounds": [target.problem.widest_mm, target.problem.radius_mm],
            "fields": target.chosen_fields(),
            "cosines": target.window.cosines,
            "pose_noise": None if cells.pose_noise is None else as_dict(cells.pose_noise),
            "settings": settings,
            "rng": str(rng.bit_generator.state),
        }
        digest.update(json.dumps(said, sort_keys=True).encode())
        return digest.hexdigest()


def fit_scene(problem: Problem, scene: Scene, start: FloatArray) -> FieldFit:
    """Find the mode from (p,) parameters, alternating with the choice of noise fields that matter there, or
    `NotConvergedError`."""
    target = CollapsedTarget(problem, scene)
    target.settle_fields(start)
    mode, _ = find_mode(target, start, scale=scene.steps, tolerance=ROUGH)
    target.settle_fields(mode)
    for _ in range(MOST_SETTLINGS):
        mode, covariance, _ = mode_and_covariance(target, mode, scale=scene.steps, tolerance=FINE)
        if not target.settle_fields(mode):
            break
    if not np.isfinite(target(mode[None])[0]):
        raise NotConvergedError("no posterior mode: the fitted bump does not rise above the correlated noise")
    # the common curvature is sharper than the mixture is wide where fields with modes of their own share the evidence
    mixture = newton_mixture(target, mode, covariance)
    if mixture is None:
        volume = 0.5 * float(np.linalg.slogdet(2.0 * np.pi * covariance)[1])
        mixture = Mixture(np.ones(1), mode[None], covariance[None], float(target(mode[None])[0]) + volume)
    return FieldFit(target, mode, mixture.moments()[1], mixture)


def newton_mixture(
    target: CollapsedTarget, start: FloatArray, covariance: FloatArray, *, least_share: float = LEAST_SHARE
) -> Mixture | None:
    """One Gaussian per field with `least_share` of the density at a start, by one Newton step from there; None where
    one is no maximum. The (p, p) covariance, about theirs, scales the finite differences and limits the step."""
    scale = np.sqrt(np.diag(covariance))
    points = stencil(start, step=0.3 * scale)
    by_field = target.by_field(points) + target.scene.log_prior(points, target.problem)[:, None]
    whole = float(np.logaddexp.reduce(by_field[0]))
    share = np.exp(by_field[0] - whole) if np.isfinite(whole) else np.zeros(by_field.shape[1])
    means, covariances, masses = [], [], []
    for h in np.flatnonzero(share > least_share):
        if not np.isfinite(by_field[:, h]).all():
            return None
        gradient, hessian = finite_differences(by_field[:, h], step=0.3 * scale)
        values, vectors = np.linalg.eigh(-hessian * np.outer(scale, scale))
        one = (vectors / values) @ vectors.T * np.outer(scale, scale)
        step = one @ gradient
        if not values[0] > 0.05 or np.sqrt(step @ np.linalg.solve(covariance, step)) > 3.0:
            return None
        means.append(start + step)
        covariances.append(one)
        gained = 0.5 * float(gradient @ step)
        masses.append(by_field[0, h] + gained + 0.5 * float(np.linalg.slogdet(2.0 * np.pi * one)[1]))
    if not masses:
        return None
    total, kept = float(np.logaddexp.reduce(masses)), float(np.log(share[share > least_share].sum()))
    return Mixture(np.exp(np.array(masses) - total), np.array(means), np.array(covariances), total - kept)


# --- Derivatives of a window's cells by all free parameters of a fitted scene.

_STEP = 1e-4


def tangent_columns(fit: FieldFit) -> FloatArray:
    """(v, n) the unit bump, its derivatives by its own parameters first, then level and tilt."""
    window, scene, mode = fit.target.window, fit.scene, fit.mode
    p = scene.own
    steps = _STEP * np.eye(p, len(mode))
    bump = scene.templates(np.concatenate([mode[None], mode + steps, mode - steps]), window)[0]
    values = window.of_cells(bump)
    slopes = (values[1 : p + 1] - values[p + 1 :]) / (2 * _STEP)
    return np.concatenate([values[:1], slopes, linear_columns(window.cells, tilt=scene.tilt)])


# --- Model selection: the simplest scene that a window's evidence supports, and what it leaves out.

LEAST_ODDS = 3.0  #: A structure is used when the map favours the scene with it by this factor.
ASKING = ("auto", "second-lump", "rib")


class Structure(Record):
    """A question about the scene, with its answer."""

    name: str
    """``"ellipse"`` (against round), ``"rotated"``, ``"tilt"``, ``"second lump"``, ``"rib"``, ``"departure"`` (from a
    Gaussian)."""
    odds: float  #: Bayes factor of the scene with it against the scene without; an upper bound where `bound`.
    supported: bool  #: The odds exceed a threshold.
    used: bool  #: The draws have it.
    bound: bool = False  #: The odds are a bound from the best of a grid of templates.
    change_x_sd: float | None = None
    change_y_sd: float | None = None
    """`change_x_sd`, `change_y_sd`: By how many posterior SDs the median of ln sigma_x and ln sigma_y would change, had
    it been decided the other way; None where that was not fitted."""
    place: str = ""  #: Where it lies or what it is like, in words; empty when there is nothing to say.


class SceneChoice(Record, eq=False):
    """The scene chosen for the draws, and the evidence for it."""

    fit: FieldFit  #: Its mode.
    plain: FieldFit  #: The fit without a second structure, by which a lump is detected.
    structures: tuple[Structure, ...] = ()  #: Every question asked.

    @property
    def supported(self) -> str:
        """The simplest shape that the map supports: ``"round"``, ``"ellipse"`` or ``"rotated"``."""
        if self.fit.scene.shape != "ellipse":
            return self.fit.scene.shape
        return "ellipse" if any(one.name == "ellipse" and one.supported for one in self.structures) else "round"


def choose_shape(problem: Problem, start: FloatArray, *, scene: SceneName = "auto") -> SceneChoice:
    """Fit the bump from (5,) ``(u, v, x, y, r)``; test whether it is round, rotated and on a slope.

    Level and tilt are always integrated out, and the axis ratio stays free unless `scene` says round: dropping either
    where the evidence does not support it costs coverage and gains little (docs/decisions/0055). Their odds are
    reported all the same.
    """
    wanted = Scene(scene if scene == "round" or scene == "rotated" else "ellipse")
    chosen = fit_scene(problem, wanted, Scene("rotated").carried(start, wanted))
    questions = [_ellipse_question(chosen)] if wanted.shape == "ellipse" else []
    if scene in ASKING:
        chosen, turned = _rotation_question(problem, chosen, start)
        questions.append(turned)
    return SceneChoice(chosen, chosen, (*questions, _tilt_question(chosen)))


def retested(choice: SceneChoice, fit: FieldFit) -> SceneChoice:
    """The choice with another fit and its tests for an ellipse and a slope: to a model without what lies beside a bump
    its flank looks like one."""
    answers = {one.name: one for one in choice.structures}
    if fit.scene.shape == "ellipse":
        answers["ellipse"] = _ellipse_question(fit)
    answers["tilt"] = _tilt_question(fit)
    return replace(choice, fit=fit, structures=tuple(answers.values()))


def fit_or_none(problem: Problem, scene: Scene, start: FloatArray) -> FieldFit | None:
    """As `fit_scene`; None where there is no mode."""
    try:
        return fit_scene(problem, scene, start)
    except NotConvergedError:
        return None


def newton_step_to(fit: FieldFit, scene: Scene) -> Mixture | None:
    """Gaussians of another scene by one Newton step from a fit's mode; None where they are not close together."""
    target = fit.target.of_scene(scene)
    start = fit.scene.carried(fit.mode, scene)
    target.settle_fields(start)
    scale = np.diag(np.square(scene.steps))
    names, wanted = fit.scene.names, scene.names
    there, here = zip(*((i, names.index(name)) for i, name in enumerate(wanted) if name in names), strict=True)
    scale[np.ix_(there, there)] = fit.covariance[np.ix_(here, here)]
    return newton_mixture(target, start, scale)


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
    mixture = newton_step_to(straight, scene)
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
    x, y = change_in_sd(straight, mixture.moments()[0])
    if turned is not None and log_odds > np.log(ROTATION_ODDS):
        return turned, Structure("rotated", odds(log_odds), True, True, False, -x, -y)
    return straight, Structure("rotated", odds(log_odds), False, False, False, x, y)


def _tilt_question(fit: FieldFit) -> Structure:
    log_odds = fit.target.tilt_log_odds(fit.mode)
    level_only = newton_step_to(fit, replace(fit.scene, tilt=False))
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


# --- Non-Gaussian lumps: an extra regressor for the profile's exponent, used when the Bayes factor exceeds 3.
#
# The column is how :math:`\exp(-h^e)` with :math:`h = u^2/2`, u in widths, changes with its exponent e at the
# Gaussian's 1: :math:`-h \ln h\, e^{-h}`. What it has in common with a change of amplitude, widths, centre, level
# and tilt is taken off under the noise fields, so it leaves the widths those of the nearest Gaussian, as they are
# without it (White 1982, Econometrica 50:1). But without it the misfit of the bump counts as noise, and intervals
# hold too often. Which Gaussian is nearest depends on the noise field, so that the widths are as uncertain as it is
# (record 0066).

EXPONENT_SD = 0.25  #: Prior SD of e - 1, about 0.
SETTLINGS = 2
"""Fits with the column: the first still has the column as orthogonal under the noise that held the misfit."""


def ask_departure(choice: SceneChoice) -> SceneChoice:
    """Test whether a bump that stands alone is a Gaussian; add the regressor where the evidence supports it."""
    fit = choice.fit
    if fit.scene.extra or fit.scene.shape == "ridge":  # what is left of a neighbour would answer
        return choice
    _, exponent, log_odds = _regression(fit)
    answer = Structure("departure", odds(log_odds), bool(log_odds > np.log(LEAST_ODDS)), False)
    if answer.supported:
        refitted = _fitted(fit)
        if refitted is not None:
            x, y = change_in_sd(refitted, fit.mode)
            middle, power = "flatter" if exponent > 0 else "sharper", 2 * (1 + exponent)
            likeness = f"({middle} in the middle, exponent about {power:.1f} for 2)"
            answer = replace(answer, used=True, change_x_sd=x, change_y_sd=y, place=likeness)
            fit = refitted
    return replace(choice, fit=fit, structures=(*choice.structures, answer))


def _fitted(fit: FieldFit) -> FieldFit | None:
    """Refit with the regressor, made orthogonal on average over the new noise fields; None where there is no mode."""
    refitted: FieldFit | None = fit
    for _ in range(SETTLINGS):
        if refitted is not None:
            problem = replace(fit.target.problem, departure=_departure(refitted)[None])
            refitted = fit_or_none(problem, fit.scene, refitted.mode)
    return refitted


def exponent_covariance(fit: FieldFit) -> FloatArray:
    """(p, p) covariance of the scene's parameters from the unknown noise field; zeros without the regressor.

    A bump that is no Gaussian has other nearest widths under each noise field, by the exponent times what the raw
    column shares with a change of them. Draws have the mean over the fields; this is the spread about it.
    """
    covariance = np.zeros((len(fit.mode), len(fit.mode)))
    if fit.target.problem.departure is None:
        return covariance
    shared, exponent, _ = _regression(fit)
    weight, p = fit.target.field_weights(fit.mode), fit.scene.own
    moved = exponent * (shared - weight @ shared)[:, 1 : p + 1]
    covariance[:p, :p] = (weight[:, None] * moved).T @ moved
    return covariance


def _departure(fit: FieldFit) -> FloatArray:
    """(n,) regressor at a fit's mode, of largest value 1."""
    mean = fit.target.field_weights(fit.mode) @ _regression(fit)[0]
    column = _raw_column(fit) - mean @ tangent_columns(fit)
    return np.asarray(column / np.abs(column).max())


def _regression(fit: FieldFit) -> tuple[FloatArray, float, float]:
    """(h, v) parts of the raw column in the tangent columns under each field; e - 1 by least squares under the
    likeliest one, and its log odds against 0."""
    cells = fit.target.window.cells
    known, raw = tangent_columns(fit), _raw_column(fit)
    value = cells.value - cells.value.mean()
    columns = np.concatenate([known, raw[None], value[None]])
    by_field = fit.target.products_by_field(columns, columns)
    v = len(known)
    shared = np.linalg.solve(by_field[:, :v, :v], by_field[:, :v, v:])
    best = int(np.argmax(fit.target.field_weights(fit.mode)))
    products = by_field[best]
    left = products[v:, v:] - products[v:, :v] @ shared[best]
    exponent = float(left[0, 1] / left[0, 0])
    dof = max(len(cells) - v - 1, 1)
    amplitude = fit.target.amplitude_at(fit.mode)
    squares = max(float(left[1, 1] - exponent * left[0, 1]), FLOOR * float(products[-1, -1]))
    variance = squares / dof / float(left[0, 0]) / amplitude**2
    exponent, prior = exponent / amplitude, EXPONENT_SD**2
    # Savage-Dickey, for a normal likelihood and the normal prior
    log_odds = 0.5 * (exponent**2 / variance * prior / (prior + variance) - np.log1p(prior / variance))
    return np.asarray(shared[:, :, 0]), exponent, float(log_odds)


def _raw_column(fit: FieldFit) -> FloatArray:
    """(n,) derivative of the bump by its exponent, at the cells' centres."""
    cells, (x, y) = fit.target.window.cells, fit.centre_mm
    away = np.stack([cells.x_mm - x, cells.y_mm - y], axis=-1)
    covariance = covariance_from_log_widths(*fit.scene.widths(fit.mode))
    h = 0.5 * np.einsum("ni,ij,nj->n", away, np.linalg.inv(covariance), away)
    return np.asarray(-h * np.log(np.maximum(h, 1e-12)) * np.exp(-h))
