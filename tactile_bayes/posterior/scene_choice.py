"""The simplest scene that a window supports, by evidence under correlated errors, and what was left out of it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from tactile_bayes.errors import NotConvergedError
from tactile_bayes.geometry import FloatArray
from tactile_bayes.posterior.bump import BumpPrior
from tactile_bayes.posterior.collapsed import BLOCK
from tactile_bayes.posterior.field_posterior import FieldFit, Mixture, fit_scene, newton_mixture
from tactile_bayes.posterior.scene import APART, REACH_IN_RADII, BoolArray, Extra, Scene, Shape
from tactile_bayes.posterior.surroundings import Surroundings
from tactile_bayes.posterior.window import Profiles, Window

LEAST_ODDS = 3.0
"""A structure is used when the map favours the scene with it by this factor."""
SECOND_ODDS = 10.0
"""For a second lump or a rib: a bump that is not quite a Gaussian must not bring one."""
LEAST_RISE = 0.05
"""Of the bump's amplitude: beside 15 single simulated lumps the most was 0.01, beside a second one 0.08 and more."""
LONG = 1.5
"""A bump with a larger axis ratio is also tried as two round lumps side by side."""
GRID_MM = 4.0
GRID_WIDTHS_MM = (3.0, 5.0, 8.0)
GRID_ANGLES = 12
ASKING = ("auto", "second-lump", "rib")
SCENES = ("auto", "none", "round", "ellipse", "rotated", "second-lump", "rib")


@dataclass(frozen=True, slots=True)
class Structure:
    """One question about the scene, and its answer.

    Parameters
    ----------
    name
        ``"ellipse"`` (against round), ``"rotated"``, ``"tilt"``, ``"second lump"``, ``"rib"``.
    odds
        Bayes factor of the scene with it against the scene without; an upper bound where `bound`.
    supported
        Whether the map asks for it.
    used
        Whether the draws have it.
    bound
        Whether the odds are a bound from the best of a grid of templates.
    change_x_sd, change_y_sd
        By how many posterior SDs the median of ln sigma_x and ln sigma_y would change, had it been decided the other
        way; None where that was not fitted.
    place
        Where it lies, in words; empty when it has no place.
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
    """The scene whose posterior is drawn from, and how it came to be chosen.

    Parameters
    ----------
    fit
        Its mode.
    plain
        The fit without a second structure: what "is there a lump?" is asked of.
    supported
        The simplest shape that the map supports: ``"round"``, ``"ellipse"`` or ``"rotated"``.
    structures
        Every question asked.
    """

    fit: FieldFit
    plain: FieldFit
    supported: str
    structures: tuple[Structure, ...] = field(default_factory=tuple)


def choose_shape(
    window: Window,
    start: FloatArray,
    *,
    prior: BumpPrior,
    radius_mm: float,
    amplitude_scale: float = 1.0,
    scene: str = "auto",
    least_odds: float = LEAST_ODDS,
) -> SceneChoice:
    """Fit the bump, and ask whether it is round, turned, and on a slope.

    Parameters
    ----------
    start : (5,) array
        ``(u, v, x, y, r)`` of a rotated ellipse.
    scene
        One of `SCENES`: ``"auto"``, or what the draws shall have.

    Notes
    -----
    Level and tilt are always integrated out, and the axis ratio stays free unless `scene` says round: dropping either
    where the evidence does not ask for it costs coverage and gains little (docs/decisions/0055). What the evidence says
    of them is reported all the same.
    """
    fitter = _Fitter(window, prior, radius_mm, amplitude_scale)
    shapes: dict[str, Shape] = {"round": "round", "rotated": "rotated"}
    wanted = Scene(shapes.get(scene, "ellipse"))
    chosen = fitter.fit(wanted, Scene("rotated").carried(start, wanted))
    found = [_ellipse_question(chosen)] if wanted.shape == "ellipse" else []
    if scene in ASKING:
        chosen, turned = _rotation_question(fitter, chosen, start, least_odds)
        found.append(turned)
    return SceneChoice(chosen, chosen, _supported_shape(chosen, found), (*found, _tilt_question(fitter, chosen)))


def add_beside(choice: SceneChoice, surroundings: Surroundings, *, scene: str = "auto") -> SceneChoice:
    """Ask for a second lump or a rib beside the bump; the draws have it where the map asks for it, or `scene` does.

    It must stand out on the map by `LEAST_RISE` of the bump's amplitude, see `Surroundings.rise`.
    """
    if scene not in ASKING:
        return choice
    target = choice.plain.target
    fitter = _Fitter(target.window, target.prior, target.radius_mm, target.amplitude_scale)
    fit, beside = _beside_questions(fitter, choice.plain, surroundings, scene)
    return replace(choice, fit=fit, structures=(*choice.structures, *beside))


@dataclass(frozen=True, slots=True)
class _Fitter:
    window: Window
    prior: BumpPrior
    radius_mm: float
    amplitude_scale: float

    def fit(self, scene: Scene, start: FloatArray) -> FieldFit:
        return fit_scene(
            self.window,
            scene,
            start,
            prior=self.prior,
            radius_mm=self.radius_mm,
            amplitude_scale=self.amplitude_scale,
        )

    def near(self, fit: FieldFit, scene: Scene) -> Mixture | None:
        """Another scene's Gaussians by one step from a fit's mode; None where they do not lie close together."""
        target = fit.target.of_scene(scene)
        start = fit.scene.carried(fit.mode, scene)
        target.settle_fields(start)
        scale = np.diag(np.square(scene.steps))
        shared = [name for name in scene.names if name in fit.scene.names]
        here, there = ([s.names.index(n) for n in shared] for s in (fit.scene, scene))
        scale[np.ix_(there, there)] = fit.covariance[np.ix_(here, here)]
        return newton_mixture(target, start, scale)


def _supported_shape(chosen: FieldFit, found: list[Structure]) -> str:
    if chosen.scene.shape != "ellipse":
        return chosen.scene.shape
    return "ellipse" if any(one.name == "ellipse" and one.supported for one in found) else "round"


def _ellipse_question(fit: FieldFit) -> Structure:
    """Ellipse against round: the Savage-Dickey ratio at q = 0, and the conditional means there."""
    direction = np.zeros(len(fit.mode))
    direction[:2] = 0.5, -0.5
    log_odds = savage_dickey(fit.mixture, direction, prior_sd=fit.target.prior.log_ratio_sd)
    mean, covariance = fit.mixture.moments()
    along = covariance @ direction
    shift = -along * (direction @ mean) / (direction @ along)
    x, y = shift[:2] / np.sqrt(np.diag(covariance)[:2])
    return Structure("ellipse", _odds(log_odds), bool(log_odds > np.log(LEAST_ODDS)), True, False, float(x), float(y))


def _rotation_question(
    fitter: _Fitter, straight: FieldFit, start: FloatArray, least_odds: float
) -> tuple[FieldFit, Structure]:
    """Turned against straight: one step first, the mode only where that leaves it open."""
    scene = replace(straight.scene, shape="rotated")
    mixture = fitter.near(straight, scene)
    axis = np.eye(5)[4]
    log_odds = np.inf if mixture is None else savage_dickey(mixture, axis, prior_sd=fitter.prior.log_ratio_sd)
    turned = None
    if log_odds > -1.5:
        begin = straight.scene.carried(straight.mode, scene)
        begin[4] = start[4] if mixture is None else mixture.moments()[0][4]
        turned = _fit_or_none(fitter, scene, begin)
        if turned is not None:
            mixture = turned.mixture
            log_odds = savage_dickey(mixture, axis, prior_sd=fitter.prior.log_ratio_sd)
    if mixture is None:
        return straight, Structure("rotated", 0.0, False, False)
    used = turned is not None and log_odds > np.log(least_odds)
    x, y = _change(straight, mixture.moments()[0])
    if used and turned is not None:
        return turned, Structure("rotated", _odds(log_odds), True, True, False, -x, -y)
    return straight, Structure("rotated", _odds(log_odds), False, False, False, x, y)


def _tilt_question(fitter: _Fitter, fit: FieldFit) -> Structure:
    log_odds = fit.target.tilt_log_odds(fit.mode)
    level_only = fitter.near(fit, replace(fit.scene, tilt=False))
    x, y = (None, None) if level_only is None else _change(fit, level_only.moments()[0])
    return Structure("tilt", _odds(log_odds), bool(log_odds > np.log(LEAST_ODDS)), True, False, x, y)


def _beside_questions(
    fitter: _Fitter, plain: FieldFit, surroundings: Surroundings, scene: str
) -> tuple[FieldFit, list[Structure]]:
    """A second lump and a rib, each against the scene without; the likelier of those that the map asks for."""
    wanted: dict[str, Extra] = {"second-lump": "second lump", "rib": "rib"}
    extras: tuple[Extra, ...] = ("second lump", "rib")
    fits = {
        extra: _fit_beside(fitter, plain, surroundings, extra, forced=wanted.get(scene) == extra) for extra in extras
    }
    asked = [extra for extra, (fit, log_odds, _) in fits.items() if fit is not None and log_odds > np.log(SECOND_ODDS)]
    likeliest: Extra = max(asked, key=lambda extra: fits[extra][1]) if asked else ""
    used = wanted.get(scene, likeliest)
    chosen = fits[used][0] if used else plain
    if chosen is None:
        raise NotConvergedError(f"no {used} found beside the bump; leave out --scene {scene}")
    answers = []
    for extra, (fit, log_odds, bound) in fits.items():
        answer = Structure(extra, _odds(log_odds), extra in asked, extra == used, bound)
        if fit is not None:
            sign = -1.0 if extra == used else 1.0
            x, y = _change(plain, fit.scene.carried(fit.mode, plain.scene))
            answer = replace(answer, change_x_sd=sign * x, change_y_sd=sign * y, place=_place(fit))
        answers.append(answer)
    return chosen, answers


def _fit_beside(
    fitter: _Fitter, plain: FieldFit, surroundings: Surroundings, extra: Extra, *, forced: bool
) -> tuple[FieldFit | None, float, bool]:
    """The fit with a second structure, its log odds, and whether these are only a bound (then there is no fit)."""
    scene = replace(plain.scene, extra=extra)
    starts, bound = _starts(fitter, plain, surroundings, extra)
    if not starts or (bound < np.log(LEAST_ODDS) and not forced):
        return None, min(bound, 0.0), True
    fits = [fit for start in starts if (fit := _fit_or_none(fitter, scene, start)) is not None]
    standing = [fit for fit in fits if _rises(fit, surroundings, extra, fit.mode[None, -3:])[0]]
    if not standing:
        return None, -np.inf, True
    best = max(standing, key=lambda fit: fit.log_evidence)
    return best, best.log_evidence - plain.log_evidence, False


def _starts(
    fitter: _Fitter, plain: FieldFit, surroundings: Surroundings, extra: Extra
) -> tuple[list[FloatArray], float]:
    """Where to look for the mode with a second structure, and a bound on the log evidence gained there."""
    grid = second_lumps(plain, fitter) if extra == "second lump" else ribs(fitter)
    rising = grid[_rises(plain, surroundings, extra, grid)]
    gains = _gains(plain, rising, extra)
    best = int(np.argmax(gains))
    starts, bound = [np.concatenate([plain.mode, one]) for one in rising[best : best + 1]], float(gains[best])
    if extra == "second lump" and (halves := _split(plain)) is not None:
        # two lumps that one long bump was laid over: no template beside that bump would find them
        return [*starts, halves], np.inf
    return starts, bound


def _split(plain: FieldFit) -> FloatArray | None:
    """Two round lumps in the place of one long one; None where it is not long."""
    scene, mode = plain.scene, plain.mode
    p, q, r = (float(v) for v in scene.widths(mode))
    ratio = float(np.hypot(q, r))
    if ratio < np.log(LONG) / 2.0 or scene.shape == "round":
        return None
    along = 0.5 * np.arctan2(r, q)
    step = 0.9 * np.exp(p + ratio) * np.array([np.cos(along), np.sin(along)])
    halves = dict(zip(scene.names, mode, strict=True))
    halves |= {"u": p - ratio, "v": p - ratio, "r": 0.0}
    halves |= {"x": halves["x"] - step[0], "y": halves["y"] - step[1]}
    beside = [halves["x"] + 2.0 * step[0], halves["y"] + 2.0 * step[1], p - ratio]
    return np.array([*(halves[name] for name in scene.names), *beside])


def _rises(fit: FieldFit, surroundings: Surroundings, extra: Extra, places: FloatArray) -> BoolArray:
    """(g,) whether the map rises there by a share of the bump's amplitude."""
    scene, target = fit.scene, fit.target
    amplitude = target.amplitude_at(fit.mode)
    rise = surroundings.rise(
        extra,
        places,
        bump_mm=(float(scene.column(fit.mode, "x")), float(scene.column(fit.mode, "y"))),
        bump_width_mm=float(np.exp(scene.widths(fit.mode)[0])),
        amplitude=amplitude,
        middle=target.window.middle,
    )
    return np.asarray(rise > LEAST_RISE * amplitude)


def _fit_or_none(fitter: _Fitter, scene: Scene, start: FloatArray) -> FieldFit | None:
    try:
        return fitter.fit(scene, start)
    except NotConvergedError:
        return None


def second_lumps(plain: FieldFit, fitter: _Fitter) -> FloatArray:
    """(g, 3) centres and log widths of the second lumps that are tried, apart from the first."""
    reach = REACH_IN_RADII * fitter.radius_mm
    axis = np.arange(-reach, reach + 1e-9, GRID_MM)
    x, y, w = (v.ravel() for v in np.meshgrid(axis, axis, np.log(GRID_WIDTHS_MM), indexing="ij"))
    middle = fitter.window.middle
    p = float(plain.scene.widths(plain.mode)[0])
    centre = [float(plain.scene.column(plain.mode, name)) for name in "xy"]
    apart = np.hypot(x + middle[0] - centre[0], y + middle[1] - centre[1]) > (APART + 0.5) * np.exp(np.maximum(p, w))
    keep = apart & (np.hypot(x, y) < reach)
    return np.asarray(np.stack([x + middle[0], y + middle[1], w], axis=1)[keep])


def ribs(fitter: _Fitter) -> FloatArray:
    """(g, 3) angles, offsets and log widths of the ridges that are tried."""
    reach = REACH_IN_RADII * fitter.radius_mm
    offsets = np.arange(-reach + 0.5 * GRID_MM, reach, GRID_MM)
    angles = np.pi * np.arange(GRID_ANGLES) / GRID_ANGLES
    grids = np.meshgrid(angles, offsets, np.log(GRID_WIDTHS_MM), indexing="ij")
    return np.stack([v.ravel() for v in grids], axis=1)


def _gains(plain: FieldFit, grid: FloatArray, extra: Extra) -> FloatArray:
    """(g,) log evidence gained by each template beside the bump at its mode."""
    window = plain.target.window
    parts = []
    for i in range(0, len(grid), BLOCK):
        one, two, width = grid[i : i + BLOCK].T
        templates: Profiles = (
            window.bumps(one, two, p=width, q=np.zeros_like(width), r=None)
            if extra == "second lump"
            else window.ridges(one, two, log_width=width)
        )
        parts.append(plain.target.gains(templates, plain.mode))
    return np.asarray(np.concatenate(parts)) if parts else np.array([-np.inf])


def _change(fit: FieldFit, other: FloatArray) -> tuple[float, float]:
    """Other minus fit in ln sigma_x and ln sigma_y, over the fit's SDs; `other` begins with its own u and v."""
    if fit.scene.shape == "round":
        change = float((other[0] - fit.mode[0]) / np.sqrt(fit.covariance[0, 0]))
        return change, change
    x, y = (other[:2] - fit.mode[:2]) / np.sqrt(np.diag(fit.covariance)[:2])
    return float(x), float(y)


def _place(fit: FieldFit) -> str:
    scene, mode = fit.scene, fit.mode
    width = float(np.exp(scene.column(mode, "w2")))
    if scene.extra == "second lump":
        x, y = float(scene.column(mode, "x2")), float(scene.column(mode, "y2"))
        return f"at ({x:.1f}, {y:.1f}) mm, sigma {width:.1f} mm"
    angle = float(np.degrees(scene.column(mode, "angle")) + 90.0) % 180.0
    offset = float(scene.column(mode, "offset"))
    middle, direction = fit.target.window.middle, float(scene.column(mode, "angle"))
    centre = [float(scene.column(mode, name)) - m for name, m in zip("xy", middle, strict=True)]
    away = abs(offset - centre[0] * np.cos(direction) - centre[1] * np.sin(direction))
    return f"{away:.1f} mm from the lump's centre, along {angle:.0f} deg, sigma {width:.1f} mm"


def savage_dickey(mixture: Mixture, direction: FloatArray, *, prior_sd: float) -> float:
    """Log Bayes factor against ``direction @ theta = 0``, whose prior is normal about 0."""
    mean = mixture.mean @ direction
    variance = np.einsum("p,hpq,q->h", direction, mixture.covariance, direction)
    posterior = np.log(mixture.weight) - 0.5 * (mean**2 / variance + np.log(2.0 * np.pi * variance))
    return float(-0.5 * np.log(2.0 * np.pi * prior_sd**2) - np.logaddexp.reduce(posterior))


def _odds(log_odds: float) -> float:
    return float(np.exp(np.clip(log_odds, -700.0, 700.0)))
