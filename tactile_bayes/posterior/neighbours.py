"""Structures beside a lump: other bumps, ridges, their surroundings."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from tactile_bayes.declarations import Record, replace
from tactile_bayes.geometry import BoolArray, FloatArray
from tactile_bayes.posterior.bump import SMOOTHING_MM
from tactile_bayes.posterior.draw import ModalBump
from tactile_bayes.posterior.fit import (
    LEAST_ODDS,
    FieldFit,
    SceneChoice,
    Structure,
    change_in_sd,
    fit_or_none,
    odds,
    retested,
)
from tactile_bayes.posterior.marginal import APART, BLOCK, REACH_IN_RADII, Neighbour, Scene, neighbour_templates
from tactile_bayes.posterior.window import Problem
from tactile_bayes.presets import SceneAsked

# --- Check of structures at the window's rim against the map around it.

CLEAR_IN_WIDTHS = 2.0  #: Cells nearer to the bump than this many of its widths say nothing of what lies beside it.
STRIP_MM = 0.5
PIECE_MM = 10.0  #: Length of the pieces of a ridge whose rises are compared.
LEAST_CELLS, LEAST_IN_PIECE = 4.0, 1.0
"""Least weight of a place, and of a piece: with less of it on the map there is nothing to see."""


class Surroundings(Record, eq=False):
    """Smoothed map less its level, not finite where the map has no data."""

    x_mm: FloatArray  #: (nx,) array.
    y_mm: FloatArray  #: (ny,) array.
    excess: FloatArray  #: (ny, nx) array.

    def rise(self, extra: Neighbour, places: FloatArray, bump: ModalBump, *, middle: tuple[float, float]) -> FloatArray:
        """(g,) excess of the map, without a round bump, under second lumps or ribs; -inf where the map has no data.

        The (g, 3) places are as in `Scene`: ``x2, y2, w2`` or ``angle, offset, w2`` about the window's `middle`. Under
        a lump the excess is the mean. Along a rib it is the median over pieces of `PIECE_MM` if that is lower: a rib
        rises along its whole length, while another lump on its line lifts the mean and only a piece or two.

        A head under constant force presses less beside a lump: the map dips there and comes back to its level. In a
        window that looks like a ridge along its rim. A rib or a lump rises above the level; a dip's far side does not.
        """
        away, width_mm = np.hypot(self.x_mm - bump.x_mm, (self.y_mm - bump.y_mm)[:, None]), bump.sigma_x_mm
        clear = np.isfinite(self.excess) & (away > CLEAR_IN_WIDTHS * width_mm)
        wide = width_mm**2 + SMOOTHING_MM**2
        height = bump.amplitude * width_mm**2 / wide * np.exp(-0.5 * away**2 / wide)
        excess = np.where(clear, self.excess - height, 0.0)
        values = np.stack([clear.astype(np.float64), excess])
        if extra == "rib":
            return self._along_ribs(places, values, middle)
        number, total = self._under_lumps(places, values)
        return _mean(number, total, LEAST_CELLS)

    def _under_lumps(self, places: FloatArray, values: FloatArray) -> FloatArray:
        """(2, g) sums of (2, ny, nx) values under round lumps: products of a profile along each axis."""
        x, y, width = places[:, 0, None], places[:, 1, None], np.exp(places[:, 2, None])
        columns = np.exp(-0.5 * ((self.x_mm - x) / width) ** 2)
        rows = np.exp(-0.5 * ((self.y_mm - y) / width) ** 2)
        return np.asarray(np.einsum("vgx,gx->vg", rows @ values, columns))

    def _along_ribs(self, places: FloatArray, values: FloatArray, middle: tuple[float, float]) -> FloatArray:
        """(g,) median excess over a ridge's pieces; ridges of one direction share strips of cells."""
        excess, flat = np.empty(len(places)), values.reshape(2, -1)
        x, y = self.x_mm - middle[0], self.y_mm[:, None] - middle[1]
        for angle in np.unique(places[:, 0]):
            these = places[:, 0] == angle
            across = np.cos(angle) * x + np.sin(angle) * y
            strip = np.rint((across - across.min()) / STRIP_MM).astype(np.intp)
            piece = np.floor((np.cos(angle) * y - np.sin(angle) * x) / PIECE_MM).astype(np.intp)
            piece -= piece.min()
            pieces = int(piece.max()) + 1
            cells, size = (strip * pieces + piece).ravel(), (int(strip.max()) + 1) * pieces
            sums = np.stack([np.bincount(cells, one, minlength=size) for one in flat]).reshape(2, -1, pieces)
            at = across.min() + STRIP_MM * np.arange(sums.shape[1])
            near = (at - places[these, 1, None]) / np.exp(places[these, 2, None])
            number, total = np.exp(-0.5 * near**2) @ sums
            mean = _mean(number.sum(axis=1), total.sum(axis=1), LEAST_CELLS)
            excess[these] = np.minimum(mean, _median_piece(number, total))
        return excess


def _mean(number: FloatArray, total: FloatArray, least: float) -> FloatArray:
    """Weighted means; -inf where the weight is too small."""
    return np.where(number > least, total / np.maximum(number, 1e-300), -np.inf)


def _median_piece(number: FloatArray, total: FloatArray) -> FloatArray:
    """(g,) lower median over (g, pieces) means where the map has data; inf where it has none."""
    shown = number > LEAST_IN_PIECE
    ordered = np.sort(np.where(shown, _mean(number, total, LEAST_IN_PIECE), np.inf), axis=1)
    middle = np.maximum(shown.sum(axis=1) - 1, 0) // 2
    return np.take_along_axis(ordered, middle[:, None], axis=1)[:, 0]


# --- Structures beside the bump: a second lump or a rib, in or just beyond the window.

SECOND_ODDS = 10.0  #: For a second lump or a rib: a bump that is not quite a Gaussian must not bring one.
LEAST_RISE = 0.05
"""Share of the bump's amplitude: beside 15 single simulated lumps at most 0.01, beside a second one 0.08 and more."""
LONG = 1.5  #: A bump with a larger axis ratio is also tried as two round lumps side by side.
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
    plain, wanted = choice.plain, WANTED.get(scene)
    lumps = second_lumps(plain)
    places: dict[Neighbour, FloatArray] = {
        "second lump": lumps[rises(plain, surroundings, "second lump", lumps)],
        "rib": _apart(plain, ridges),
    }
    fits = {
        extra: _fit_beside(plain, surroundings, extra, rising, forced=wanted == extra)
        for extra, rising in places.items()
    }
    asked = [extra for extra, (fit, log_odds, _) in fits.items() if fit is not None and log_odds > np.log(SECOND_ODDS)]
    likeliest = max(asked, key=lambda extra: fits[extra][1], default=None)
    used = wanted or likeliest
    answers = []
    for extra, (fit, log_odds, bound) in fits.items():
        answer = Structure(extra, odds(log_odds), extra in asked, fit is not None and extra == used, bound)
        if fit is not None:
            sign = -1.0 if extra == used else 1.0
            x, y = change_in_sd(plain, fit.scene.carried(fit.mode, plain.scene))
            answer = replace(answer, change_x_sd=sign * x, change_y_sd=sign * y, place=_place(fit))
        answers.append(answer)
    chosen = fits[used][0] if used else None
    retold = choice if chosen is None else retested(choice, chosen)
    return replace(retold, structures=(*retold.structures, *answers))


def _fit_beside(
    plain: FieldFit, surroundings: Surroundings, extra: Neighbour, rising: FloatArray, *, forced: bool
) -> tuple[FieldFit | None, float, bool]:
    """Fit a second structure: the fit, its log odds, and whether these are only a bound (without a fit)."""
    scene = replace(plain.scene, extra=extra)
    starts, bound = _starts(plain, extra, rising)
    if not starts or (bound < np.log(LEAST_ODDS) and not forced):
        return None, min(bound, 0.0), True
    found = (fit_or_none(plain.target.problem, scene, start) for start in starts)
    fits = [fit for fit in found if fit is not None]
    standing = [fit for fit in fits if rises(fit, surroundings, extra, fit.mode[None, -3:])[0]]
    if not standing:
        return None, -np.inf, True
    best = max(standing, key=lambda fit: fit.log_evidence)
    return best, best.log_evidence - plain.log_evidence, False


def _starts(plain: FieldFit, extra: Neighbour, rising: FloatArray) -> tuple[list[FloatArray], float]:
    """Starts for the fit of a second structure, and a bound on the log evidence that it gains."""
    window, gains = plain.target.window, np.array([-np.inf])
    if len(rising):
        templates = (neighbour_templates(window, extra, *rising[i : i + BLOCK].T) for i in range(0, len(rising), BLOCK))
        gains = np.concatenate([plain.target.gains(one, plain.mode) for one in templates])
    best = int(np.argmax(gains))
    starts, bound = [np.concatenate([plain.mode, one]) for one in rising[best : best + 1]], float(gains[best])
    if extra == "second lump" and (halves := _split(plain)) is not None:
        # two lumps that one long bump was laid over: no template beside that bump would find them
        return [*starts, halves], np.inf
    return starts, bound


def _split(plain: FieldFit) -> FloatArray | None:
    """Start with two round lumps in place of one long bump; None where it is not long."""
    scene, mode = plain.scene, plain.mode
    p, q, r = (plain.at[name] for name in "pqr")
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
    width_mm = float(np.exp(fit.at["p"]))
    bump = ModalBump(fit.target.amplitude_at(fit.mode), *fit.centre_mm, width_mm, width_mm)
    rise = surroundings.rise(extra, places, bump, middle=fit.target.window.middle)
    return np.asarray(rise > LEAST_RISE * bump.amplitude)


def second_lumps(plain: FieldFit) -> FloatArray:
    """(g, 3) grid of second lumps to try, apart from the first: centres and log widths."""
    problem = plain.target.problem
    reach = REACH_IN_RADII * problem.radius_mm
    axis = np.arange(-reach, reach + 1e-9, GRID_MM)
    x, y, w = (v.ravel() for v in np.meshgrid(axis, axis, np.log(GRID_WIDTHS_MM), indexing="ij"))
    middle, centre, wider = problem.window.middle, plain.centre_mm, np.exp(np.maximum(plain.at["p"], w))
    apart = np.hypot(x + middle[0] - centre[0], y + middle[1] - centre[1]) > (APART + 0.5) * wider
    keep = apart & (np.hypot(x, y) < reach)
    return np.asarray(np.stack([x + middle[0], y + middle[1], w], axis=1)[keep])


def _apart(plain: FieldFit, ridges: FloatArray) -> FloatArray:
    """Ridges that a scene allows beside the bump, by `Scene.rib_apart`."""
    scene = replace(plain.scene, extra="rib")
    theta = np.column_stack([np.tile(plain.mode, (len(ridges), 1)), ridges])
    return np.asarray(ridges[scene.rib_apart(theta, plain.target.window.middle)])


def rising_ribs(plain: FieldFit, surroundings: Surroundings) -> FloatArray:
    """(g, 3) angles, offsets and log widths, of a grid, of ridges along which the map rises beside a bump."""
    reach = REACH_IN_RADII * plain.target.problem.radius_mm
    offsets = np.arange(-reach + 0.5 * GRID_MM, reach, GRID_MM)
    angles = np.pi * np.arange(GRID_ANGLES) / GRID_ANGLES
    grids = np.meshgrid(angles, offsets, np.log(GRID_WIDTHS_MM), indexing="ij")
    places = np.stack([v.ravel() for v in grids], axis=1)
    return np.asarray(places[rises(plain, surroundings, "rib", places)])


def _place(fit: FieldFit) -> str:
    at, width = fit.at, np.exp(fit.at["w2"])
    if fit.scene.extra == "second lump":
        return f"at ({at['x2']:.1f}, {at['y2']:.1f}) mm, sigma {width:.1f} mm"
    angle, middle = at["angle"], fit.target.window.middle
    away = abs(at["offset"] - (at["x"] - middle[0]) * np.cos(angle) - (at["y"] - middle[1]) * np.sin(angle))
    along = (np.degrees(angle) + 90.0) % 180.0
    return f"{away:.1f} mm from the lump's centre, along {along:.0f} deg, sigma {width:.1f} mm"


# --- Lump or ridge: evidence for a lump against a rib-like ridge, where the map rises along a line.


def ridge_instead(choice: SceneChoice, ridges: FloatArray) -> FieldFit | None:
    """Best scene with a ridge in place of the bump, alone or with the neighbour that the choice has.

    Ridges (g, 3) are where the map rises along a line beyond the bump, see `rising_ribs`. None without such a place:
    then a ridge need not be feared, and no time is spent on it.
    """
    if not len(ridges):
        return None
    problem = choice.plain.target.problem
    starts = _ridge_starts(choice, problem, ridges)
    fits = [fit for scene, start in starts if (fit := fit_or_none(problem, scene, start)) is not None]
    fits = [fit for fit in fits if not _holds_the_bump(fit, choice.plain)]
    return max(fits, key=lambda fit: fit.log_evidence) if fits else None


def _holds_the_bump(ridge: FieldFit, plain: FieldFit) -> bool:
    """True where the second lump of a ridge's scene has moved onto the bump: that scene is not without the lump."""
    if ridge.scene.extra != "second lump":
        return False
    x, y = (ridge.at[f"{name}2"] - plain.at[name] for name in "xy")
    return bool(np.hypot(x, y) < APART * np.exp(plain.at["p"]))


def beside_ridge(choice: SceneChoice, ridge: FieldFit) -> FieldFit | None:
    """The bump with a ridge of `ridge_instead` beside it; None where the ridge touches the bump, or is not alone.

    A ridge that runs clear of the bump does not stand in its place, and a map may show both.
    """
    plain = choice.plain
    if ridge.scene.extra:
        return None
    scene, start = replace(plain.scene, extra="rib"), np.concatenate([plain.mode, ridge.mode[[1, 2, 0]]])
    if not scene.rib_clear(start, plain.target.window.middle):
        return None
    fit = fit_or_none(plain.target.problem, scene, start)
    return fit if fit is not None and scene.rib_clear(fit.mode, plain.target.window.middle) else None


def _ridge_starts(choice: SceneChoice, problem: Problem, places: FloatArray) -> Iterator[tuple[Scene, FloatArray]]:
    """Starts: the ridge along which the map rises most; with a neighbour, also one through the bump."""
    alone = Scene("ridge")
    yield alone, _best(choice, alone, places[:, [2, 0, 1]])
    extra = choice.fit.scene.extra
    if extra:
        scene, beside = Scene("ridge", extra=extra), choice.fit.mode[-3:]
        # ridges of the bump's width through its centre, in all directions
        angle, at = np.pi * np.arange(GRID_ANGLES) / GRID_ANGLES, choice.fit.at
        x, y = (at[name] - m for name, m in zip("xy", problem.window.middle, strict=True))
        through = [np.full(GRID_ANGLES, at["p"]), angle, x * np.cos(angle) + y * np.sin(angle)]
        yield scene, _best(choice, scene, np.column_stack([*through, np.tile(beside, (GRID_ANGLES, 1))]))


def _best(choice: SceneChoice, scene: Scene, starts: FloatArray) -> FloatArray:
    """The vector of a scene with the highest density."""
    density = choice.plain.target.of_scene(scene)(starts)
    return np.asarray(starts[int(np.argmax(density))])


def ridge_text(fit: FieldFit) -> str:
    """Direction and width of a ridge in words."""
    angle = (np.degrees(fit.at["along"]) + 90.0) % 180.0
    return f"a ridge along {angle:.0f} deg, sigma {np.exp(fit.at['p']):.1f} mm"
