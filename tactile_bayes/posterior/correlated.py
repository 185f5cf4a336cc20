"""The estimate under correlated noise, from a first fit to draws, with what lies beside the lump."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.special import ndtri

from tactile_bayes.declarations import Record, replace
from tactile_bayes.errors import NotConvergedError
from tactile_bayes.geometry import BoolArray, FloatArray
from tactile_bayes.inference.draws import MOST_PAIRED, ParameterDraws, Solved, paired_points
from tactile_bayes.mapping.map import TactileMap
from tactile_bayes.posterior.bump import (
    SMOOTHING_MM,
    Detection,
    covariance_from_log_widths,
    drawn_widths,
    overlap,
    smoothed_excess,
    trusted,
)
from tactile_bayes.posterior.draw import DETECTED, MapPosterior, ModalBump, SamplerSettings, draw_parameters
from tactile_bayes.posterior.fit import (
    ASKING,
    LEAST_ODDS,
    FieldFit,
    SceneChoice,
    Structure,
    ask_departure,
    change_in_sd,
    choose_shape,
    exponent_covariance,
    fit_or_none,
    newton_step_to,
    odds,
    retested,
    tangent_columns,
)
from tactile_bayes.posterior.marginal import APART, BLOCK, REACH_IN_RADII, Neighbour, Scene, neighbour_templates
from tactile_bayes.posterior.verdict import rim_fault
from tactile_bayes.posterior.white import BumpFit, MapDraws
from tactile_bayes.posterior.window import FLOOR, Problem, Window, cosines_for, independent_variance
from tactile_bayes.presets import FIELD_COSINES, SceneName
from tactile_bayes.progress import Progress

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
        x, y, width = places[:, 0, None], places[:, 1, None], np.exp(places[:, 2, None])
        columns = np.exp(-0.5 * ((self.x_mm - x) / width) ** 2)  # round lumps: products of a profile along each axis
        rows = np.exp(-0.5 * ((self.y_mm - y) / width) ** 2)
        number, total = np.einsum("vgx,gx->vg", rows @ values, columns)
        return _mean(number, total, LEAST_CELLS)

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
    choice: SceneChoice, surroundings: Surroundings, *, ridges: FloatArray, scene: SceneName = "auto"
) -> SceneChoice:
    """Test for a second lump or a rib beside the bump, and add it where the evidence or `scene` says so.

    `ridges` are where a rib can be: `rising_ribs`. What is found must stand out on the map by `LEAST_RISE` of the
    bump's amplitude, see `Surroundings.rise`. What is not found is not in the fit, even if `scene` names it.
    """
    plain, wanted, lumps = choice.plain, WANTED.get(scene), second_lumps(choice.plain)
    with_ridges = np.column_stack([np.tile(plain.mode, (len(ridges), 1)), ridges])
    apart = replace(plain.scene, extra="rib").rib_apart(with_ridges, plain.target.window.middle)
    places: dict[Neighbour, FloatArray] = {
        "second lump": lumps[rises(plain, surroundings, "second lump", lumps)],
        "rib": ridges[apart],
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


# --- Outline of a lump: whether its bump is skewed, or rounder inside than outside, more than a ball's is.
#
# With :math:`z` the place in widths along the ellipse's axes and :math:`G = e^{-|z|^2/2}`, the columns are
# :math:`G\,|z|^2 (z_1, z_2)` for skewness and :math:`G\,|z|^2 (z_1^2 - z_2^2, 2 z_1 z_2)` for an axis ratio that
# changes outwards. What they have in common with the bump, its derivatives and its exponent is taken off under the
# noise field.

BALLS_SD = (0.008, 0.01)
"""SDs of skewness and change of balls' maps beyond their noise, over the amplitude (record 0107)."""
NOISE_FACTOR = 2.5  #: Variance of both over that by the residuals: deep and faint lumps are off by more than they say.
MOST_SDS = 2.5  #: Length of either beyond which a ball is unlikely: of two components, in the SD of one.


def irregular(fit: FieldFit) -> bool:
    """True for a lone bump that is more skewed, or whose axis ratio changes more outwards, than a ball's."""
    if fit.scene.extra or fit.scene.shape == "ridge":  # what is left of a neighbour would answer
        return False
    shape, covariance = outline(fit)
    pairs = ((slice(0, 2), BALLS_SD[0]), (slice(2, 4), BALLS_SD[1]))
    return any(
        float(shape[at] @ np.linalg.solve(NOISE_FACTOR * covariance[at, at] + sd**2 * np.eye(2), shape[at]))
        > MOST_SDS**2
        for at, sd in pairs
    )


def outline(fit: FieldFit) -> tuple[FloatArray, FloatArray]:
    """(4,) skewness and change of the axis ratio, over the amplitude, and their (4, 4) covariance."""
    cells, (x, y) = fit.target.window.cells, fit.centre_mm
    root = np.linalg.cholesky(covariance_from_log_widths(*fit.scene.widths(fit.mode)))
    x, y = np.linalg.solve(root, np.stack([cells.x_mm - x, cells.y_mm - y]))
    square = x**2 + y**2
    bump = np.exp(-0.5 * square)
    outer = bump * square
    asked = np.stack([outer * x, outer * y, outer * (x**2 - y**2), outer * 2 * x * y])
    # beside the oblique axis ratio and the exponent
    known = np.concatenate([tangent_columns(fit), np.stack([bump * x * y, outer * square])])
    value = cells.value - cells.value.mean()
    columns = np.concatenate([known, asked, value[None]])
    products = fit.target.products(columns, columns, fit.mode)
    v = len(known)
    shared = np.linalg.lstsq(products[:v, :v], products[:v, v:], rcond=None)[0]
    left = products[v:, v:] - products[v:, :v] @ shared
    coefficients = np.linalg.solve(left[:4, :4], left[:4, 4])
    squares = max(float(left[4, 4] - coefficients @ left[:4, 4]), FLOOR * float(products[-1, -1]))
    variance = squares / max(len(cells) - v - 4, 1)
    amplitude = fit.target.amplitude_at(fit.mode)
    return np.asarray(coefficients / amplitude), np.asarray(np.linalg.inv(left[:4, :4]) * variance / amplitude**2)


# --- Contribution of tracker position error to the posterior of a bump's shape.
#
# A frame that is off by :math:`\delta` maps the bump shifted by it, so a cell's error is :math:`-\nabla g \cdot
# \bar\delta`, the mean over the frames that felt the cell. Cells less than the array's side apart share frames:
# :math:`\bar\delta` is a smooth field of variance :math:`s^2 / n` with the overlap of two arrays, a triangle along
# each axis, as its correlation. Such errors look like another shape of the bump, so no noise found beside it tells
# of them; what they do to the estimate is added to its draws.

LEAST_EIGENVALUE = 3e-3  #: Least eigenvalue of the overlap of two arrays, over its largest: less is left out.


def pose_covariance(fit: FieldFit) -> FloatArray:
    """(p, p) covariance of the bump's parameters from tracker position error; zeros where it is not known."""
    noise = fit.target.window.cells.pose_noise
    p = fit.scene.own
    covariance = np.zeros((len(fit.mode), len(fit.mode)))
    if noise is None or fit.scene.shape == "ridge":
        return covariance
    known, window = tangent_columns(fit), fit.target.window
    across, along = (_roots(axis, side) for axis, side in zip((window.x_mm, window.y_mm), noise.side_mm, strict=True))
    power = np.outer(np.sum(along**2, axis=1), np.sum(across**2, axis=1))
    i, j = np.nonzero(power > LEAST_EIGENVALUE * power.max())
    # columns whose products sum to the share of frames that two cells share, then the independent parts of their errors
    frames = np.maximum(window.cells.count * noise.frames_per_reading, 1.0)
    shared = window.of_cells(along[i][:, :, None] * across[j][:, None, :]) / np.sqrt(frames)
    slopes = [known[1 + fit.scene.names.index(name)] for name in ("x", "y")]
    errors = np.concatenate([sd * slope * shared for sd, slope in zip(noise.sd_mm, slopes, strict=True)])
    products = fit.target.products(known, np.concatenate([known, errors]), fit.mode)
    v = len(known)
    moved = np.linalg.solve(products[:, :v], products[:, v:])[1 : p + 1]
    covariance[:p, :p] = moved @ moved.T
    return covariance


def _roots(axis_mm: FloatArray, side_mm: float) -> FloatArray:
    """(n, n) rows whose products sum to the overlap of two equal intervals about points of an axis."""
    values, vectors = np.linalg.eigh(overlap(axis_mm, side_mm))
    return np.asarray((vectors * np.sqrt(np.maximum(values, 0.0))).T)


# --- Estimation under correlated errors: detection, scene and draws from a least-squares fit.

LEAST_VARIANCE = 1e-12
"""Directions in which errors of the frames' places spread less, as a share of the largest, are left out."""


class Correlated(Record, eq=False):
    """A place on a map under correlated errors."""

    tactile_map: TactileMap
    fit: BumpFit
    detection: Detection
    scene: SceneChoice | None = None
    """None where the density has no mode: no bump stands out from the correlated noise."""
    fault: str = ""

    @classmethod
    def of(cls, tactile_map: TactileMap, fit: BumpFit, options: SamplerSettings) -> Correlated:
        """Compare a bump with no bump, and where it is a lump by the evidence with neighbouring structures."""
        try:
            scene, detection = fit_and_test(tactile_map, fit, options)
        except NotConvergedError:
            return cls(tactile_map, fit, Detection(-np.inf))
        fault = rim_fault(tactile_map, scene.plain.modal(), radius_mm=options.fit_radius_mm)
        if not fault and detection.probability >= DETECTED:
            scene, detection = with_neighbours(scene, detection, tactile_map, asked=options.scene_asked)
        return cls(tactile_map, fit, detection, scene, fault)

    def bump(self) -> ModalBump:
        """The bump at the scene's mode, which there is where the detection has any odds."""
        assert self.scene is not None
        return self.scene.fit.modal()

    def draw(self, options: SamplerSettings, *, rng: np.random.Generator, progress: Progress | None) -> MapDraws:
        """Draw from the posterior; `NotConvergedError` also when the scene's neighbour was not found."""
        choice, asked = self.scene, options.scene_asked
        assert choice is not None
        wanted = WANTED.get(asked, "")
        if wanted and choice.fit.scene.extra != wanted:
            raise NotConvergedError(f"no {wanted} found beside the bump", advice=f"leave out --scene {asked}")
        fit, target = choice.fit, choice.fit.target
        solved = Solved(target.conditional)
        draws, passed_over = draw_parameters(fit, options, rng=rng, progress=progress, solved=solved)
        detection = self.detection
        if fit is choice.plain and not detection.ridge and "log_evidence" in draws.diagnostics:
            detection = field_detection(fit, self.tactile_map, draws.diagnostics["log_evidence"])
        places = pose_covariance(fit)
        share = None
        if target.window.cells.pose_noise is not None:
            widths = [fit.scene.names.index(name) for name in ("u", "v") if name in fit.scene.names]
            added, other = (float(np.diag(one)[widths].sum()) for one in (places, fit.covariance))
            share = added / (added + other)
        figures = {
            "noise": "field",
            "rotation_odds": next((one.odds for one in choice.structures if one.name == "rotated"), None),
            "rotated": fit.scene.shape == "rotated",
            "field_cosines": target.window.cosines,
            **target.field_summary(fit.mode),
            **({"passed_over": list(passed_over)} if passed_over else {}),
            "places_share": share,
        }
        return MapDraws(detection, self.fit, draws, _posterior(fit, draws, rng, solved, places), figures)


def fit_and_test(tactile_map: TactileMap, fit: BumpFit, options: SamplerSettings) -> tuple[SceneChoice, Detection]:
    """Fit the bump under correlated errors, and compare it with no bump; `NotConvergedError` without a mode.

    Where `field_cosines` is "auto", a narrow bump that may be a lump is fitted once more, with a finer field.
    """

    def under(number: int, start: FloatArray) -> tuple[SceneChoice, Detection]:
        window = Window(fit.cells, independent_variance(fit.cells), cosines=number)
        problem = Problem(window, options.prior, options.fit_radius_mm, fit.bump.scale)
        choice = choose_shape(problem, start, scene=options.scene_asked)
        return choice, field_detection(choice.plain, tactile_map, choice.plain.log_evidence)

    p, q, r = (float(one) for one in fit.bump.shape_parameters(fit.theta))
    start, asked = np.array([p + q, p - q, *fit.theta[1:3], r]), options.field_cosines
    choice, detection = under(FIELD_COSINES if asked == "auto" else asked, start)
    if asked != "auto" or not detection.log_bayes_factor > 0:
        return choice, detection
    plain, bump = choice.plain, choice.plain.modal()
    axes = plain.target.window.x_mm, plain.target.window.y_mm
    wanted = max(cosines_for(min(bump.sigma_x_mm, bump.sigma_y_mm), axis) for axis in axes)
    if wanted <= FIELD_COSINES:
        return choice, detection
    return under(wanted, plain.scene.carried(plain.mode, Scene("rotated")))


def field_detection(plain: FieldFit, tactile_map: TactileMap, log_evidence: float) -> Detection:
    """Odds of a bump somewhere on the map against level, tilt and the same noise fields alone.

    The window's evidence has the centre anywhere in the window; the search over the rest of the map is paid for.
    """
    return Detection(log_evidence - plain.target.null_log_evidence() - _searched(plain, tactile_map))


def _searched(plain: FieldFit, tactile_map: TactileMap) -> float:
    """Log number of windows in the map's area."""
    area = float(trusted(tactile_map).sum()) * tactile_map.recipe.cell_mm**2
    return float(np.log(max(area / (np.pi * plain.target.problem.radius_mm**2), 1.0)))


def with_neighbours(
    choice: SceneChoice, detection: Detection, tactile_map: TactileMap, *, asked: SceneName
) -> tuple[SceneChoice, Detection]:
    """Add a second structure where the evidence supports it, and compare the lump with a ridge where one rises.

    A bump alone is tested for a departure from a Gaussian. Only scenes in `ASKING` are compared with a ridge:
    without a rib in the model a lump beside one would lose to it.
    """
    if asked not in ASKING:
        return ask_departure(choice), detection
    surroundings = Surroundings(tactile_map.x_mm, tactile_map.y_mm, smoothed_excess(tactile_map))
    ridges = rising_ribs(choice.plain, surroundings)
    choice = add_beside(choice, surroundings, ridges=ridges, scene=asked)
    ridge = ridge_instead(choice, ridges)
    if ridge is not None and ridge.log_evidence >= choice.plain.target.null_log_evidence():
        against = ridge.log_evidence + _searched(choice.plain, tactile_map)
        detection = Detection(choice.fit.log_evidence - against, ridge=ridge_text(ridge))
        if detection.probability < DETECTED and (both := beside_ridge(choice, ridge)) is not None:
            detection = Detection(both.log_evidence - against, ridge=detection.ridge)
    return ask_departure(choice), detection


def _posterior(
    fit: FieldFit, draws: ParameterDraws, rng: np.random.Generator, solved: Solved, places: FloatArray
) -> MapPosterior:
    """Draws by name, with tracker position error and what the noise field leaves open of a non-Gaussian bump added."""
    shape = draws.theta.shape[:2]
    theta = draws.theta + _displaced(fit, draws, places + exponent_covariance(fit), rng).reshape(draws.theta.shape)
    sigma_x, sigma_y, angle = drawn_widths(*fit.scene.widths(theta))
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
        labels=draws.replicates,
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
    mixture = newton_step_to(fit, scene)
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
    return np.asarray(ndtri(points) @ (vectors[:, kept] * np.sqrt(values[kept])).T)
