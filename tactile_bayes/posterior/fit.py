"""A scene fitted under correlated noise: its mode and draws, and the selection of its structures by evidence."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from functools import cached_property, partial

import numpy as np

from tactile_bayes.declarations import Record, as_dict, replace
from tactile_bayes.errors import NotConvergedError
from tactile_bayes.geometry import FloatArray
from tactile_bayes.inference.draws import ParameterDraws, SolutionCache, student_draws
from tactile_bayes.inference.importance import Gaussians, smooth_weights
from tactile_bayes.inference.modes import find_mode, finite_differences, mode_and_covariance, stencil
from tactile_bayes.posterior.bump import covariance_from_log_widths, drawn_widths
from tactile_bayes.posterior.draw import ROTATION_ODDS, ModalBump, SamplingTarget, with_beside
from tactile_bayes.posterior.marginal import STEP, CollapsedTarget, Scene
from tactile_bayes.posterior.window import FLOOR, NEGLIGIBLE, Problem, linear_columns
from tactile_bayes.presets import Method, SceneName

# --- Posterior of a scene under correlated errors: its mode, a Gaussian for each noise field, and draws.

MOST_FIELD_SELECTIONS = 6
ROUGH, FINE = 0.3, 1e-3
"""Last Newton step, in `Scene.steps`: under the start's fields, which are not the mode's; then under those."""
LEAST_SHARE = 1e-2
"""Fields with a smaller share of the density at the mode have no Gaussian of their own in what `laplace` draws."""
WEIGHED_DRAWS = 512  #: Draws of the Gaussians whose importance weights are computed.


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

    def draw_at_mode(self, method: Method, number: int, rng: np.random.Generator) -> ParameterDraws:
        """Draw from the fields' Gaussians, with t tails for the noise scale, and the Pareto shape of their weights.

        A single Gaussian was up to 25 % too narrow where several fields share the evidence.
        """
        mixture, dof = self.mixture, float(self.target.dof)
        widen = (dof + len(self.mode)) / dof
        numbers = rng.multinomial(number, mixture.weight).tolist()
        parts = [
            student_draws(mean, widen * covariance, dof=dof, number=n, rng=rng)
            for mean, covariance, n in zip(mixture.mean, mixture.covariance, numbers, strict=True)
        ]
        flat = rng.permutation(np.concatenate(parts))
        checked = flat[:WEIGHED_DRAWS]
        _, shape = smooth_weights(self.target(checked) - mixture.log_density(checked))
        figures = {"draws": float(number), "fields": float(len(parts)), "pareto_k": float(shape)}
        return ParameterDraws(flat[None], method, figures)

    def sampling_target(self, solved: SolutionCache | None = None) -> SamplingTarget:
        """The density to sample: the fit's target, which stores its solutions; with a second structure at its mode."""
        mean, covariance = self.mixture.moments()
        k, target = self.scene.bump_parameters, self.target
        parts = newton_mixture(target, self.mode, self.covariance, least_share=NEGLIGIBLE)
        if k == len(mean):
            density = target if solved is None else partial(target, solved=solved)
            return SamplingTarget(density, mean, covariance, parts, checkpoint_key=self.checkpoint_key)
        cross_covariance, neighbour = covariance[:k, k:], self.mode[k:]
        added_covariance = cross_covariance @ np.linalg.solve(covariance[k:, k:], cross_covariance.T)
        values, vectors = np.linalg.eigh(0.5 * (added_covariance + added_covariance.T))
        spread = vectors * np.sqrt(np.clip(values, 0.0, None))
        conditional_parts = None if parts is None else parts.conditional(neighbour)
        return SamplingTarget(
            lambda theta: target(with_beside(theta, neighbour)),
            self.mode[:k],
            covariance[:k, :k] - added_covariance,
            conditional_parts,
            neighbour,
            spread,
            self.checkpoint_key,
        )

    def checkpoint_key(self, settings: str, rng: np.random.Generator) -> str:
        """Hash of all that a chain depends on: cells, scene, priors, fields, settings and seed."""
        target, digest = self.target, hashlib.sha256()
        cells = target.window.cells
        arrays = [cells.x_mm, cells.y_mm, cells.value, cells.count, target.window.variance, self.mode, self.covariance]
        arrays += [] if target.problem.departure is None else [target.problem.departure]
        for values in arrays:
            digest.update(np.ascontiguousarray(values, dtype="<f8").tobytes())
        facts = {
            "scene": as_dict(self.scene),
            "prior": as_dict(target.problem.prior),
            "scale": target.problem.amplitude_scale,
            "bounds": [target.problem.widest_mm, target.problem.radius_mm],
            "fields": target.selected_fields(),
            "cosines": target.window.cosines,
            "pose_noise": None if cells.pose_noise is None else as_dict(cells.pose_noise),
            "settings": settings,
            "rng": str(rng.bit_generator.state),
        }
        digest.update(json.dumps(facts, sort_keys=True).encode())
        return digest.hexdigest()


def fit_scene(problem: Problem, scene: Scene, start: FloatArray) -> FieldFit:
    """Fit from (p,) start parameters: the mode in turn with the selection of noise fields; `NotConvergedError` without
    a mode."""
    target = CollapsedTarget(problem, scene)
    target.select_fields(start)
    mode, _ = find_mode(target, start, scale=scene.steps, tolerance=ROUGH)
    target.select_fields(mode)
    for _ in range(MOST_FIELD_SELECTIONS):
        mode, covariance, _ = mode_and_covariance(target, mode, scale=scene.steps, tolerance=FINE)
        if not target.select_fields(mode):
            break
    # the curvature at the mode is too narrow where fields with different modes share the evidence
    mixture = newton_mixture(target, mode, covariance)
    if mixture is None:
        volume = 0.5 * float(np.linalg.slogdet(2.0 * np.pi * covariance)[1])
        mixture = Mixture(np.ones(1), mode[None], covariance[None], float(target(mode[None])[0]) + volume)
    return FieldFit(target, mode, mixture.moments()[1], mixture)


def newton_mixture(
    target: CollapsedTarget, start: FloatArray, covariance: FloatArray, *, least_share: float = LEAST_SHARE
) -> Mixture | None:
    """One Gaussian per field with `least_share` of the density at a start, by one Newton step from there; None where
    a field has no maximum. The (p, p) covariance scales the finite differences and limits the step."""
    scale = np.sqrt(np.diag(covariance))
    points = stencil(start, step=0.3 * scale)
    by_field = target.by_field(points) + target.scene.log_prior(points, target.problem)[:, None]
    log_total = float(np.logaddexp.reduce(by_field[0]))
    share = np.exp(by_field[0] - log_total) if np.isfinite(log_total) else np.zeros(by_field.shape[1])
    means, covariances, masses = [], [], []
    for h in np.flatnonzero(share > least_share):
        if not np.isfinite(by_field[:, h]).all():
            return None
        gradient, hessian = finite_differences(by_field[:, h], step=0.3 * scale)
        values, vectors = np.linalg.eigh(-hessian * np.outer(scale, scale))
        field_covariance = (vectors / values) @ vectors.T * np.outer(scale, scale)
        step = field_covariance @ gradient
        if not values[0] > 0.05 or np.sqrt(step @ np.linalg.solve(covariance, step)) > 3.0:
            return None
        means.append(start + step)
        covariances.append(field_covariance)
        gain = 0.5 * float(gradient @ step)
        masses.append(by_field[0, h] + gain + 0.5 * float(np.linalg.slogdet(2.0 * np.pi * field_covariance)[1]))
    if not masses:
        return None
    total, log_share = float(np.logaddexp.reduce(masses)), float(np.log(share[share > least_share].sum()))
    return Mixture(np.exp(np.array(masses) - total), np.array(means), np.array(covariances), total - log_share)


# --- Derivatives of a window's cells by all free parameters of a fitted scene.

_STEP = 1e-4


def tangent_columns(fit: FieldFit) -> FloatArray:
    """(v, n) the unit bump, its derivatives by its own parameters first, then level and tilt."""
    window, scene, mode = fit.target.window, fit.scene, fit.mode
    p = scene.bump_parameters
    steps = _STEP * np.eye(p, len(mode))
    bump = scene.templates(np.concatenate([mode[None], mode + steps, mode - steps]), window)[0]
    values = window.of_cells(bump)
    slopes = (values[1 : p + 1] - values[p + 1 :]) / (2 * _STEP)
    return np.concatenate([values[:1], slopes, linear_columns(window.cells, tilt=scene.tilt)])


# --- Model selection: tests of each structure by the window's evidence.

LEAST_ODDS = 3.0  #: A structure is used when the map favours the scene with it by this factor.
SCENES_TESTED = ("auto", "second-lump", "rib")


class Structure(Record):
    """Test of one structure of the scene, with its result."""

    name: str
    """``"ellipse"`` (against round), ``"rotated"``, ``"tilt"``, ``"second lump"``, ``"rib"``, ``"departure"`` (from a
    Gaussian)."""
    odds: float  #: Bayes factor of the scene with it against the scene without.
    supported: bool  #: The odds exceed a threshold.
    used: bool  #: The draws have it.
    odds_are_a_bound: bool = False  #: They are an upper bound, from the best of a grid of templates.
    change_sigma_x_sd: float | None = None
    change_sigma_y_sd: float | None = None
    """`change_sigma_x_sd`, `change_sigma_y_sd`: Change of the medians of ln sigma_x and ln sigma_y, in posterior SDs,
    under the opposite decision; None where that was not fitted."""
    place: str = ""  #: Its place or shape in words; empty for most.


class SceneChoice(Record, eq=False):
    """The scene chosen for the draws, and the evidence for it."""

    fit: FieldFit  #: The fit of the chosen scene.
    plain: FieldFit  #: The fit without a second structure, by which a lump is detected.
    structures: tuple[Structure, ...] = ()  #: Every test made.

    @property
    def supported(self) -> str:
        """The simplest shape that the map supports: ``"round"``, ``"ellipse"`` or ``"rotated"``."""
        if self.fit.scene.shape != "ellipse":
            return self.fit.scene.shape
        return "ellipse" if any(one.name == "ellipse" and one.supported for one in self.structures) else "round"


def choose_shape(problem: Problem, start: FloatArray, *, scene: SceneName = "auto") -> SceneChoice:
    """Fit the bump from (5,) ``(u, v, x, y, r)``; test whether it is round, rotated and on a slope.

    The axis ratio stays free unless `scene` says round, and the tilt always, whatever their odds: dropping them costs
    coverage and gains little (docs/decisions/0055).
    """
    first_scene = Scene(scene if scene == "round" or scene == "rotated" else "ellipse")
    chosen = fit_scene(problem, first_scene, Scene("rotated").converted(start, first_scene))
    tests = [_ellipse_test(chosen)] if first_scene.shape == "ellipse" else []
    if scene in SCENES_TESTED:
        chosen, test = _rotation_test(problem, chosen, start)
        tests.append(test)
    return SceneChoice(chosen, chosen, (*tests, _tilt_test(chosen)))


def with_new_fit(choice: SceneChoice, fit: FieldFit) -> SceneChoice:
    """The choice with another fit and its tests for ellipse and tilt: without the neighbour in the model its flank
    looks like either."""
    tests = {structure.name: structure for structure in choice.structures}
    if fit.scene.shape == "ellipse":
        tests["ellipse"] = _ellipse_test(fit)
    tests["tilt"] = _tilt_test(fit)
    return replace(choice, fit=fit, structures=tuple(tests.values()))


def fit_or_none(problem: Problem, scene: Scene, start: FloatArray) -> FieldFit | None:
    """As `fit_scene`; None where there is no mode."""
    try:
        return fit_scene(problem, scene, start)
    except NotConvergedError:
        return None


def newton_step_to(fit: FieldFit, scene: Scene) -> Mixture | None:
    """Gaussians of another scene by one Newton step from a fit's mode; None where that leads to no maximum close by."""
    target = fit.target.of_scene(scene)
    start = fit.scene.converted(fit.mode, scene)
    target.select_fields(start)
    scale = np.diag(np.square(scene.steps))
    names, to_names = fit.scene.names, scene.names
    to, from_ = zip(*((i, names.index(name)) for i, name in enumerate(to_names) if name in names), strict=True)
    scale[np.ix_(to, to)] = fit.covariance[np.ix_(from_, from_)]
    return newton_mixture(target, start, scale)


def _ellipse_test(fit: FieldFit) -> Structure:
    """Test an ellipse against a round bump by the Savage-Dickey ratio at q = 0, and the conditional means there."""
    direction = np.zeros(len(fit.mode))
    direction[:2] = 0.5, -0.5
    log_odds = savage_dickey(fit.mixture, direction, prior_sd=fit.target.problem.prior.log_ratio_sd)
    mean, covariance = fit.mixture.moments()
    along = covariance @ direction
    shift = -along * (direction @ mean) / (direction @ along)
    x, y = shift[:2] / np.sqrt(np.diag(covariance)[:2])
    return Structure("ellipse", odds(log_odds), bool(log_odds > np.log(LEAST_ODDS)), True, False, float(x), float(y))


def _rotation_test(problem: Problem, straight: FieldFit, start: FloatArray) -> tuple[FieldFit, Structure]:
    """Test a rotated ellipse against a straight one: by one Newton step, or where that is unclear by a fit."""
    scene = replace(straight.scene, shape="rotated")
    mixture = newton_step_to(straight, scene)
    axis = np.eye(5)[4]
    log_odds = np.inf if mixture is None else savage_dickey(mixture, axis, prior_sd=problem.prior.log_ratio_sd)
    rotated = None
    if log_odds > -1.5:
        rotated_start = straight.scene.converted(straight.mode, scene)
        rotated_start[4] = start[4] if mixture is None else mixture.moments()[0][4]
        rotated = fit_or_none(problem, scene, rotated_start)
        if rotated is not None:
            mixture = rotated.mixture
            log_odds = savage_dickey(mixture, axis, prior_sd=problem.prior.log_ratio_sd)
    if mixture is None:
        return straight, Structure("rotated", 0.0, False, False)
    x, y = change_in_sd(straight, mixture.moments()[0])
    if rotated is not None and log_odds > np.log(ROTATION_ODDS):
        return rotated, Structure("rotated", odds(log_odds), True, True, False, -x, -y)
    return straight, Structure("rotated", odds(log_odds), False, False, False, x, y)


def _tilt_test(fit: FieldFit) -> Structure:
    """Test a sloping level against a constant one."""
    log_odds = fit.target.tilt_log_odds(fit.mode)
    level_only = newton_step_to(fit, replace(fit.scene, tilt=False))
    x, y = (None, None) if level_only is None else change_in_sd(fit, level_only.moments()[0])
    return Structure("tilt", odds(log_odds), bool(log_odds > np.log(LEAST_ODDS)), True, False, x, y)


def change_in_sd(fit: FieldFit, mode: FloatArray) -> tuple[float, float]:
    """Change of ln sigma_x and ln sigma_y from a fit to another `mode`, which begins with u and v, in SDs."""
    if fit.scene.shape == "round":
        change = float((mode[0] - fit.mode[0]) / np.sqrt(fit.covariance[0, 0]))
        return change, change
    x, y = (mode[:2] - fit.mode[:2]) / np.sqrt(np.diag(fit.covariance)[:2])
    return float(x), float(y)


def savage_dickey(mixture: Mixture, direction: FloatArray, *, prior_sd: float) -> float:
    """Log Bayes factor against ``direction @ theta = 0``, by the Savage-Dickey ratio with a normal prior about 0."""
    mean = mixture.mean @ direction
    variance = np.einsum("p,hpq,q->h", direction, mixture.covariance, direction)
    posterior = np.log(mixture.weight) - 0.5 * (mean**2 / variance + np.log(2.0 * np.pi * variance))
    return float(-0.5 * np.log(2.0 * np.pi * prior_sd**2) - np.logaddexp.reduce(posterior))


def odds(log_odds: float) -> float:
    """Bayes factor of its logarithm, kept finite."""
    return float(np.exp(np.clip(log_odds, -700.0, 700.0)))


# --- Non-Gaussian lumps: an extra regressor for the profile's exponent, used when the Bayes factor exceeds 3.
#
# The column is how :math:`\exp(-h^e)` with :math:`h = u^2/2`, u in widths, changes with its exponent e at the
# Gaussian's 1: :math:`-h \ln h\, e^{-h}`, made orthogonal under the noise fields to changes of amplitude, widths,
# centre, level and tilt. So the widths remain those of the nearest Gaussian (White 1982, Econometrica 50:1), but the
# misfit of the bump no longer counts as noise, which made intervals too wide. The nearest Gaussian depends on the
# noise field: that spread is added to the draws (record 0066).

EXPONENT_SD = 0.25  #: Prior SD of e - 1, about 0.
DEPARTURE_REFITS = 2  #: Fits with the column: for the first it is orthogonal under noise that contains the misfit.


def add_departure(choice: SceneChoice) -> SceneChoice:
    """Test whether a bump that stands alone is a Gaussian; add the regressor where the evidence supports it."""
    fit = choice.fit
    if fit.scene.extra:  # the misfit of a neighbour would be tested
        return choice
    _, exponent, log_odds = _exponent_regression(fit)
    test = Structure("departure", odds(log_odds), bool(log_odds > np.log(LEAST_ODDS)), False)
    if test.supported:
        refitted = _refitted_with_regressor(fit)
        if refitted is not None:
            x, y = change_in_sd(refitted, fit.mode)
            middle, power = "flatter" if exponent > 0 else "sharper", 2 * (1 + exponent)
            likeness = f"({middle} in the middle, exponent about {power:.1f} for 2)"
            test = replace(test, used=True, change_sigma_x_sd=x, change_sigma_y_sd=y, place=likeness)
            fit = refitted
    return replace(choice, fit=fit, structures=(*choice.structures, test))


def _refitted_with_regressor(fit: FieldFit) -> FieldFit | None:
    """Refit with the regressor, made orthogonal on average over the new noise fields; None where there is no mode."""
    refitted: FieldFit | None = fit
    for _ in range(DEPARTURE_REFITS):
        if refitted is not None:
            problem = replace(fit.target.problem, departure=_departure(refitted)[None])
            refitted = fit_or_none(problem, fit.scene, refitted.mode)
    return refitted


def exponent_covariance(fit: FieldFit) -> FloatArray:
    """(p, p) covariance of the scene's parameters from the unknown noise field; zeros without the regressor.

    The nearest Gaussian to another bump differs between noise fields, by the exponent times the projection of its
    column on the tangent columns. Draws have the mean over the fields; this is the spread about it.
    """
    covariance = np.zeros((len(fit.mode), len(fit.mode)))
    if fit.target.problem.departure is None:
        return covariance
    shared, exponent, _ = _exponent_regression(fit)
    weight, p = fit.target.field_weights(fit.mode), fit.scene.bump_parameters
    shifts = exponent * (shared - weight @ shared)[:, 1 : p + 1]
    covariance[:p, :p] = (weight[:, None] * shifts).T @ shifts
    return covariance


def _departure(fit: FieldFit) -> FloatArray:
    """(n,) orthogonal regressor at a fit's mode, of largest value 1."""
    mean = fit.target.field_weights(fit.mode) @ _exponent_regression(fit)[0]
    column = _exponent_column(fit) - mean @ tangent_columns(fit)
    return np.asarray(column / np.abs(column).max())


def _exponent_regression(fit: FieldFit) -> tuple[FloatArray, float, float]:
    """(h, v) projections of the exponent's column on the tangent columns under each field; e - 1 by least squares under
    the likeliest field, and its log odds against 0."""
    cells = fit.target.window.cells
    tangents, column = tangent_columns(fit), _exponent_column(fit)
    value = cells.value - cells.value.mean()
    columns = np.concatenate([tangents, column[None], value[None]])
    by_field = fit.target.products_by_field(columns, columns)
    v = len(tangents)
    shared = np.linalg.solve(by_field[:, :v, :v], by_field[:, :v, v:])
    likeliest = int(np.argmax(fit.target.field_weights(fit.mode)))
    products = by_field[likeliest]
    remainder = products[v:, v:] - products[v:, :v] @ shared[likeliest]
    exponent = float(remainder[0, 1] / remainder[0, 0])
    dof = max(len(cells) - v - 1, 1)
    amplitude = fit.target.amplitude_at(fit.mode)
    squares = max(float(remainder[1, 1] - exponent * remainder[0, 1]), FLOOR * float(products[-1, -1]))
    variance = squares / dof / float(remainder[0, 0]) / amplitude**2
    exponent, prior = exponent / amplitude, EXPONENT_SD**2
    # Savage-Dickey, for a normal likelihood and the normal prior
    log_odds = 0.5 * (exponent**2 / variance * prior / (prior + variance) - np.log1p(prior / variance))
    return np.asarray(shared[:, :, 0]), exponent, float(log_odds)


def _exponent_column(fit: FieldFit) -> FloatArray:
    """(n,) derivative of the bump by its exponent, at the cells' centres."""
    cells, (x, y) = fit.target.window.cells, fit.centre_mm
    offset = np.stack([cells.x_mm - x, cells.y_mm - y], axis=-1)
    covariance = covariance_from_log_widths(*fit.scene.widths(fit.mode))
    h = 0.5 * np.einsum("ni,ij,nj->n", offset, np.linalg.inv(covariance), offset)
    return np.asarray(-h * np.log(np.maximum(h, 1e-12)) * np.exp(-h))
