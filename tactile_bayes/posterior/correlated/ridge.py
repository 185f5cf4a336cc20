"""Lump or ridge: evidence for a lump against a rib-like ridge, where the map rises along a line."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from tactile_bayes.geometry import FloatArray
from tactile_bayes.posterior.correlated.fit import FieldFit
from tactile_bayes.posterior.correlated.neighbour import GRID_ANGLES
from tactile_bayes.posterior.correlated.problem import Problem
from tactile_bayes.posterior.correlated.scene import Scene
from tactile_bayes.posterior.correlated.selection import SceneChoice, fit_or_none


def ridge_instead(choice: SceneChoice, ridges: FloatArray) -> FieldFit | None:
    """Best scene with a ridge in place of the bump, alone or with the neighbour that the choice has.

    Parameters
    ----------
    ridges : (g, 3) array
        Where the map rises along a line beyond the bump, see `neighbour.rising_ribs`.

    Returns
    -------
    FieldFit or None
        None where there is no such place: then a ridge need not be feared, and no time is spent on it.
    """
    if not len(ridges):
        return None
    problem = choice.plain.target.problem
    starts = _starts(choice, problem, ridges)
    fits = [fit for scene, start in starts if (fit := fit_or_none(problem, scene, start)) is not None]
    return max(fits, key=lambda fit: fit.log_evidence) if fits else None


def _starts(choice: SceneChoice, problem: Problem, places: FloatArray) -> Iterator[tuple[Scene, FloatArray]]:
    """Starts: the ridge along which the map rises most; with a neighbour, also one through the bump."""
    alone = Scene("ridge")
    yield alone, _best(choice, alone, places[:, [2, 0, 1]])
    extra = choice.fit.scene.extra
    if extra:
        scene, beside = Scene("ridge", extra=extra), choice.fit.mode[-3:]
        through = _through_bump(choice.fit, problem)
        yield scene, _best(choice, scene, np.column_stack([through, np.tile(beside, (len(through), 1))]))


def _through_bump(fit: FieldFit, problem: Problem) -> FloatArray:
    """(g, 3) ridges of the bump's width through its centre, in all directions."""
    angle = np.pi * np.arange(GRID_ANGLES) / GRID_ANGLES
    x, y = (float(fit.scene.column(fit.mode, name)) - m for name, m in zip("xy", problem.window.middle, strict=True))
    width = np.full(GRID_ANGLES, float(fit.scene.widths(fit.mode)[0]))
    return np.stack([width, angle, x * np.cos(angle) + y * np.sin(angle)], axis=1)


def _best(choice: SceneChoice, scene: Scene, starts: FloatArray) -> FloatArray:
    """The vector of a scene with the highest density."""
    density = choice.plain.target.of_scene(scene)(starts)
    return np.asarray(starts[int(np.argmax(density))])


def ridge_text(fit: FieldFit) -> str:
    """Direction and width of a ridge in words."""
    angle = float(np.degrees(fit.scene.column(fit.mode, "along")) + 90.0) % 180.0
    return f"a ridge along {angle:.0f} deg, sigma {float(np.exp(fit.scene.widths(fit.mode)[0])):.1f} mm"
