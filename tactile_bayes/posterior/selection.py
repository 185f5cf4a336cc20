"""Choice of a scene's terms by evidence."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import islice
from math import lgamma, log, pi

import numpy as np

from tactile_bayes.declarations import Record, field, replace
from tactile_bayes.errors import NotConvergedError
from tactile_bayes.geometry import FloatArray
from tactile_bayes.posterior.bump import covariance_from_log_widths
from tactile_bayes.posterior.draw import ROTATION_ODDS
from tactile_bayes.posterior.fit import FieldFit, Mixture, fit_scene, newton_mixture, tangent_columns
from tactile_bayes.posterior.marginal import FLOOR, CollapsedTarget
from tactile_bayes.posterior.window import Problem, Scene, Shape, linear_columns
from tactile_bayes.presets import SceneAsked

# --- Density of a window's cells under correlated errors: the density of each given the others.
#
# A likelihood with correlated errors is no product over cells. What takes the place of a cell's factor is the
# density of its value given all the others, with level, tilt, amplitudes and the noise scale integrated out as in
# `marginal`. For one field, with :math:`Q = C^{-1} - C^{-1} X (X^T C^{-1} X)^{-1} X^T C^{-1}`,
#
# .. math::
#     y_i \mid y_{-i}, \theta \sim t_{\nu - 1}\Bigl(y_i - (Qy)_i / Q_{ii},\; S_{-i} / ((\nu - 1)\, Q_{ii})\Bigr),
#     \qquad S_{-i} = y^T Q y - (Qy)_i^2 / Q_{ii}.
#
# Fields are mixed with their evidence without the cell. The sum over cells is not the log likelihood of the map.
#
# References
# ----------
# Buerkner, Gabry & Vehtari (2021), Computational Statistics 36:1243 (non-factorised models).

LEAST_SHARE = 1e-6  #: Fields with a smaller share of the evidence at a draw add nothing there.


def pointwise_log_likelihood(target: CollapsedTarget, theta: FloatArray) -> FloatArray:
    """(m, n) log density of each cell's value given the other cells, at (m, p) draws of the scene's parameters."""
    evidence = target.by_field(theta)
    log_share = evidence - np.logaddexp.reduce(evidence, axis=1)[:, None]
    window, fixed = target.window, _fixed_columns(target)
    templates = [window.of_cells(one) for one in target.scene.templates(theta, window)]
    inverse = np.full((len(theta), len(window.cells)), -np.inf)
    for h, precision in enumerate(_fields(target)):
        for m in np.flatnonzero(log_share[:, h] > log(LEAST_SHARE)):
            regressors = np.stack([*fixed, *(one[m] for one in templates)])
            log_density = _without_each(precision, regressors, window.cells.value)
            # p(field | the others) is its share over the cell's density under it
            inverse[m] = np.logaddexp(inverse[m], log_share[m, h] - log_density)
    return -inverse


def fitted_values(target: CollapsedTarget, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(n,) values of the model without noise at a (p,) shape, by generalised least squares in the likeliest field.

    And the (n,) field's expectation given the data: the part of what is left that neighbouring cells share.
    """
    window, at = target.window, theta[None]
    likeliest = int(np.argmax(target.by_field(at)[0]))
    templates = [window.of_cells(one)[0] for one in target.scene.templates(at, window)]
    regressors = np.stack([*_fixed_columns(target), *templates])
    precision = next(islice(_fields(target), likeliest, None))
    middle = window.cells.value.mean()
    across = precision.times(regressors)
    solved = np.linalg.solve(across @ regressors.T, across @ (window.cells.value - middle))
    fit = np.asarray(middle + solved @ regressors)
    left = window.cells.value - fit
    return fit, left - precision.times(left[None])[0] * window.variance


def _fields(target: CollapsedTarget) -> Iterator[_Precision]:
    """The precision of each field and share, in the order of `CollapsedTarget.by_field`."""
    window = target.window
    # a row for each cell: its products with the cosines, over its independent variance
    unit = window.on_grid(np.eye(len(window.cells)))
    cosines = window.project(unit, np.zeros((1, *window.weight.shape))).low
    for columns in target.fields:
        low = cosines @ columns.field.turn
        for index in range(len(columns.shares)):
            yield _Precision(1.0 / window.variance, low, columns.weight[:, index])


def _fixed_columns(target: CollapsedTarget) -> FloatArray:
    """(c, n) level, tilt and the departure from a Gaussian where there is one."""
    columns = linear_columns(target.window.cells, tilt=target.scene.tilt)
    departure = target.problem.departure
    return columns if departure is None else np.concatenate([columns, departure])


class _Precision:
    """Inverse covariance of the cells under one field and share, up to the noise scale."""

    def __init__(self, weight: FloatArray, low: FloatArray, taken: FloatArray) -> None:
        self._weight, self._low, self._taken = weight, low, taken
        self.diagonal = weight - np.square(low) @ taken

    def times(self, rows: FloatArray) -> FloatArray:
        """(v, n) products with (v, n) vectors."""
        return np.asarray(rows * self._weight - ((rows @ self._low) * self._taken) @ self._low.T)


def _without_each(precision: _Precision, regressors: FloatArray, value: FloatArray) -> FloatArray:
    """(n,) log density of each value given the others, for (v, n) columns with free coefficients."""
    # without its mean, a large level does not cost the digits that the bump is in
    centred = value - value.mean()
    weighted = precision.times(np.concatenate([regressors, centred[None]]))
    across, data = weighted[:-1], weighted[-1]
    inverse = np.linalg.inv(across @ regressors.T)
    residual = data - (inverse @ (across @ centred)) @ across
    power = precision.diagonal - np.einsum("vn,vw,wn->n", across, inverse, across)
    dof = len(value) - len(regressors) - 1
    squares = float(residual @ centred) - residual**2 / power
    scale = squares / (dof * power)
    constant = lgamma((dof + 1) / 2) - lgamma(dof / 2) - 0.5 * log(dof * pi)
    return np.asarray(
        constant - 0.5 * np.log(scale) - 0.5 * (dof + 1) * np.log1p((residual / power) ** 2 / (dof * scale))
    )


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
    supported: str  #: The simplest shape that the map supports: ``"round"``, ``"ellipse"`` or ``"rotated"``.
    structures: tuple[Structure, ...] = field(default_factory=tuple)  #: Every question asked.


def choose_shape(problem: Problem, start: FloatArray, *, scene: SceneAsked = "auto") -> SceneChoice:
    """Fit the bump from (5,) ``(u, v, x, y, r)`` of a rotated ellipse; test whether it is round, rotated and on a
    slope.

    Level and tilt are always integrated out, and the axis ratio stays free unless `scene` says round: dropping either
    where the evidence does not support it costs coverage and gains little (docs/decisions/0055). Their odds are
    reported all the same.
    """
    shape: Shape = "round" if scene == "round" else "rotated" if scene == "rotated" else "ellipse"
    wanted = Scene(shape)
    chosen = fit_scene(problem, wanted, Scene("rotated").carried(start, wanted))
    questions = [_ellipse_question(chosen)] if wanted.shape == "ellipse" else []
    if scene in ASKING:
        chosen, turned = _rotation_question(problem, chosen, start)
        questions.append(turned)
    return SceneChoice(chosen, chosen, _supported_shape(chosen, questions), (*questions, _tilt_question(chosen)))


def retested(choice: SceneChoice, fit: FieldFit) -> SceneChoice:
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


def newton_step_to(fit: FieldFit, scene: Scene) -> Mixture | None:
    """Gaussians of another scene by one Newton step from a fit's mode; None where they are not close together."""
    target = fit.target.of_scene(scene)
    start = fit.scene.carried(fit.mode, scene)
    target.settle_fields(start)
    scale = np.diag(np.square(scene.steps))
    shared = [name for name in scene.names if name in fit.scene.names]
    here, there = ([s.names.index(n) for n in shared] for s in (fit.scene, scene))
    scale[np.ix_(there, there)] = fit.covariance[np.ix_(here, here)]
    return newton_mixture(target, start, scale)


def _supported_shape(chosen: FieldFit, questions: Sequence[Structure]) -> str:
    if chosen.scene.shape != "ellipse":
        return chosen.scene.shape
    return "ellipse" if any(one.name == "ellipse" and one.supported for one in questions) else "round"


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
    used = turned is not None and log_odds > np.log(ROTATION_ODDS)
    x, y = change_in_sd(straight, mixture.moments()[0])
    if used and turned is not None:
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
    """Test whether the bump is a Gaussian; add the regressor where the evidence supports it.

    A bump with something beside it is not asked: what is left of the neighbour would answer.
    """
    fit = choice.fit
    if fit.scene.extra or fit.scene.shape == "ridge":
        return choice
    column, exponent, log_odds = _departure(fit)
    answer = Structure("departure", odds(log_odds), bool(log_odds > np.log(LEAST_ODDS)), False)
    if answer.supported:
        refitted = _fitted(fit, column)
        if refitted is not None:
            x, y = change_in_sd(refitted, fit.mode)
            middle, power = "flatter" if exponent > 0 else "sharper", 2 * (1 + exponent)
            likeness = f"({middle} in the middle, exponent about {power:.1f} for 2)"
            answer = replace(answer, used=True, change_x_sd=x, change_y_sd=y, place=likeness)
            fit = refitted
    return replace(choice, fit=fit, structures=(*choice.structures, answer))


def _fitted(fit: FieldFit, column: FloatArray) -> FieldFit | None:
    """Refit with the regressor, made orthogonal on average over the new noise fields; None where there is no mode."""
    refitted: FieldFit | None = fit
    for left in reversed(range(SETTLINGS)):
        assert refitted is not None
        refitted = fit_or_none(replace(fit.target.problem, departure=column[None]), fit.scene, refitted.mode)
        if refitted is None or not left:
            break
        column = _departure(refitted)[0]
    return refitted


def exponent_covariance(fit: FieldFit) -> FloatArray:
    """(p, p) covariance of the scene's parameters from the unknown noise field, of a bump with the regressor.

    A bump that is no Gaussian has other nearest widths under each noise field, by the exponent times what the raw
    column shares with a change of them. Draws have the mean over the fields; this is the spread about it.
    """
    covariance = np.zeros((len(fit.mode), len(fit.mode)))
    if fit.target.problem.departure is None:
        return covariance
    shared, exponent, _ = _regression(fit)
    weight, p = fit.target.field_weights(fit.mode), len(fit.scene.alone().names)
    moved = exponent * (shared - weight @ shared)[:, 1 : p + 1]
    covariance[:p, :p] = (weight[:, None] * moved).T @ moved
    return covariance


def _departure(fit: FieldFit) -> tuple[FloatArray, float, float]:
    """Regressor at a fit's mode, e - 1 by least squares under the likeliest noise, and the log odds against 0."""
    shared, exponent, log_odds = _regression(fit)
    mean = fit.target.field_weights(fit.mode) @ shared
    column = _raw_column(fit) - mean @ tangent_columns(fit)
    return column / np.abs(column).max(), exponent, log_odds


def _regression(fit: FieldFit) -> tuple[FloatArray, float, float]:
    """(h, v) parts of the raw column in the tangent columns under each field; e - 1 and its log odds as above."""
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
    scene, mode, cells = fit.scene, fit.mode, fit.target.window.cells
    p, q, r = scene.widths(mode)
    away = np.stack([cells.x_mm - scene.column(mode, "x"), cells.y_mm - scene.column(mode, "y")], axis=-1)
    covariance = covariance_from_log_widths(p, q, r)
    h = 0.5 * np.einsum("ni,ij,nj->n", away, np.linalg.inv(covariance), away)
    return np.asarray(-h * np.log(np.maximum(h, 1e-12)) * np.exp(-h))
