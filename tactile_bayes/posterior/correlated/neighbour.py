"""Structures beside the bump: a second lump or a rib, in or just beyond the window."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tactile_bayes.geometry import FloatArray
from tactile_bayes.posterior.correlated.fit import FieldFit
from tactile_bayes.posterior.correlated.marginal import BLOCK
from tactile_bayes.posterior.correlated.problem import Problem
from tactile_bayes.posterior.correlated.scene import (
    APART,
    REACH_IN_RADII,
    BoolArray,
    Neighbour,
    neighbour_templates,
)
from tactile_bayes.posterior.correlated.selection import (
    ASKING,
    LEAST_ODDS,
    SceneChoice,
    Structure,
    asked_again,
    change_in_sd,
    fit_or_none,
    odds,
)
from tactile_bayes.posterior.correlated.surroundings import Surroundings
from tactile_bayes.presets import SceneAsked

SECOND_ODDS = 10.0
"""For a second lump or a rib: a bump that is not quite a Gaussian must not bring one."""
LEAST_RISE = 0.05
"""Of the bump's amplitude: beside 15 single simulated lumps the most was 0.01, beside a second one 0.08 and more."""
LONG = 1.5
"""A bump with a larger axis ratio is also tried as two round lumps side by side."""
GRID_MM = 4.0
GRID_WIDTHS_MM = (3.0, 5.0, 8.0)
GRID_ANGLES = 12
WANTED: dict[str, Neighbour] = {"second-lump": "second lump", "rib": "rib"}


def add_beside(
    choice: SceneChoice, surroundings: Surroundings, *, ridges: FloatArray, scene: SceneAsked = "auto"
) -> SceneChoice:
    """Test for a second lump or a rib beside the bump, and add it where the evidence or `scene` says so.

    `ridges` are where a rib can be: `rising_ribs`. What is found must stand out on the map by `LEAST_RISE` of the
    bump's amplitude, see `Surroundings.rise`. What is not found is not in the fit, even if `scene` names it.
    """
    if scene not in ASKING:
        return choice
    fit, beside = _beside_questions(choice.plain.target.problem, choice.plain, surroundings, ridges, scene)
    found = choice if fit is choice.plain else asked_again(choice, fit)
    return replace(found, structures=(*found.structures, *beside))


def _beside_questions(
    problem: Problem, plain: FieldFit, surroundings: Surroundings, ridges: FloatArray, scene: SceneAsked
) -> tuple[FieldFit, list[Structure]]:
    """Test a second lump and a rib, each against the scene without; returns the better supported fit."""
    lumps = second_lumps(plain, problem)
    places: dict[Neighbour, FloatArray] = {
        "second lump": lumps[rises(plain, surroundings, "second lump", lumps)],
        "rib": _apart(plain, ridges),
    }
    fits = {
        extra: _fit_beside(problem, plain, surroundings, extra, rising, forced=WANTED.get(scene) == extra)
        for extra, rising in places.items()
    }
    asked = [extra for extra, (fit, log_odds, _) in fits.items() if fit is not None and log_odds > np.log(SECOND_ODDS)]
    likeliest = max(asked, key=lambda extra: fits[extra][1], default=None)
    used = WANTED.get(scene, likeliest)
    chosen = fits[used][0] if used else plain
    answers = []
    for extra, (fit, log_odds, bound) in fits.items():
        answer = Structure(extra, odds(log_odds), extra in asked, fit is not None and extra == used, bound)
        if fit is not None:
            sign = -1.0 if extra == used else 1.0
            x, y = change_in_sd(plain, fit.scene.carried(fit.mode, plain.scene))
            answer = replace(answer, change_x_sd=sign * x, change_y_sd=sign * y, place=_place(fit))
        answers.append(answer)
    return chosen or plain, answers


def _fit_beside(
    problem: Problem, plain: FieldFit, surroundings: Surroundings, extra: Neighbour, rising: FloatArray, *, forced: bool
) -> tuple[FieldFit | None, float, bool]:
    """Fit a second structure: the fit, its log odds, and whether these are only a bound (without a fit)."""
    scene = replace(plain.scene, extra=extra)
    starts, bound = _starts(plain, extra, rising)
    if not starts or (bound < np.log(LEAST_ODDS) and not forced):
        return None, min(bound, 0.0), True
    fits = [fit for start in starts if (fit := fit_or_none(problem, scene, start)) is not None]
    standing = [fit for fit in fits if rises(fit, surroundings, extra, fit.mode[None, -3:])[0]]
    if not standing:
        return None, -np.inf, True
    best = max(standing, key=lambda fit: fit.log_evidence)
    return best, best.log_evidence - plain.log_evidence, False


def _starts(plain: FieldFit, extra: Neighbour, rising: FloatArray) -> tuple[list[FloatArray], float]:
    """Starts for the fit of a second structure, and a bound on the log evidence that it gains."""
    gains = _gains(plain, rising, extra)
    best = int(np.argmax(gains))
    starts, bound = [np.concatenate([plain.mode, one]) for one in rising[best : best + 1]], float(gains[best])
    if extra == "second lump" and (halves := _split(plain)) is not None:
        # two lumps that one long bump was laid over: no template beside that bump would find them
        return [*starts, halves], np.inf
    return starts, bound


def _split(plain: FieldFit) -> FloatArray | None:
    """Start with two round lumps in place of one long bump; None where it is not long."""
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


def rises(fit: FieldFit, surroundings: Surroundings, extra: Neighbour, places: FloatArray) -> BoolArray:
    """(g,) whether the map rises by a share of the bump's amplitude at places of second lumps or ribs."""
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


def second_lumps(plain: FieldFit, problem: Problem) -> FloatArray:
    """(g, 3) grid of second lumps to try, apart from the first: centres and log widths."""
    reach = REACH_IN_RADII * problem.radius_mm
    axis = np.arange(-reach, reach + 1e-9, GRID_MM)
    x, y, w = (v.ravel() for v in np.meshgrid(axis, axis, np.log(GRID_WIDTHS_MM), indexing="ij"))
    middle = problem.window.middle
    p = float(plain.scene.widths(plain.mode)[0])
    centre = [float(plain.scene.column(plain.mode, name)) for name in "xy"]
    apart = np.hypot(x + middle[0] - centre[0], y + middle[1] - centre[1]) > (APART + 0.5) * np.exp(np.maximum(p, w))
    keep = apart & (np.hypot(x, y) < reach)
    return np.asarray(np.stack([x + middle[0], y + middle[1], w], axis=1)[keep])


def ribs(problem: Problem) -> FloatArray:
    """(g, 3) grid of ridges to try: angles, offsets and log widths."""
    reach = REACH_IN_RADII * problem.radius_mm
    offsets = np.arange(-reach + 0.5 * GRID_MM, reach, GRID_MM)
    angles = np.pi * np.arange(GRID_ANGLES) / GRID_ANGLES
    grids = np.meshgrid(angles, offsets, np.log(GRID_WIDTHS_MM), indexing="ij")
    return np.stack([v.ravel() for v in grids], axis=1)


def _apart(plain: FieldFit, ridges: FloatArray) -> FloatArray:
    """Ridges that a scene allows beside the bump, by `Scene.rib_apart`."""
    scene = replace(plain.scene, extra="rib")
    theta = np.column_stack([np.tile(plain.mode, (len(ridges), 1)), ridges])
    return np.asarray(ridges[scene.rib_apart(theta, plain.target.window.middle)])


def rising_ribs(plain: FieldFit, surroundings: Surroundings) -> FloatArray:
    """(g, 3) ridges of `ribs` along which the map rises beside a bump."""
    places = ribs(plain.target.problem)
    return np.asarray(places[rises(plain, surroundings, "rib", places)])


def _gains(plain: FieldFit, grid: FloatArray, extra: Neighbour) -> FloatArray:
    """(g,) log evidence gained by each template beside the bump at its mode."""
    window = plain.target.window
    parts = []
    for i in range(0, len(grid), BLOCK):
        templates = neighbour_templates(window, extra, *grid[i : i + BLOCK].T)
        parts.append(plain.target.gains(templates, plain.mode))
    return np.asarray(np.concatenate(parts)) if parts else np.array([-np.inf])


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
