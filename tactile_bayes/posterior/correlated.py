"""Estimation under correlated noise: detection, structures beside the lump, outline, tracker position error, draws."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.special import ndtri

from tactile_bayes.declarations import Record, replace
from tactile_bayes.errors import NotConvergedError
from tactile_bayes.geometry import BoolArray, FloatArray
from tactile_bayes.inference.draws import MOST_PAIRED, ParameterDraws, SolutionCache, paired_points
from tactile_bayes.mapping.map import TactileMap
from tactile_bayes.posterior.bump import (
    SMOOTHING_MM,
    Detection,
    covariance_from_log_widths,
    drawn_widths,
    overlap,
    smoothed_excess,
    trusted_cells,
)
from tactile_bayes.posterior.draw import DETECTED, MapPosterior, ModalBump, SamplerSettings, draw_parameters
from tactile_bayes.posterior.fit import (
    LEAST_ODDS,
    SCENES_TESTED,
    FieldFit,
    SceneChoice,
    Structure,
    add_departure,
    change_in_sd,
    choose_shape,
    exponent_covariance,
    fit_or_none,
    newton_step_to,
    odds,
    tangent_columns,
    with_new_fit,
)
from tactile_bayes.posterior.marginal import APART, BLOCK, REACH_IN_RADII, Neighbour, Scene, neighbour_templates
from tactile_bayes.posterior.verdict import rim_fault
from tactile_bayes.posterior.white import BumpFit, MapDraws
from tactile_bayes.posterior.window import FLOOR, Problem, Window, cosines_for, independent_variance
from tactile_bayes.presets import FIELD_COSINES, SceneName
from tactile_bayes.progress import Progress

# --- Check of structures at the window's rim against the map around it.

CLEAR_IN_WIDTHS = 2.0  #: Cells nearer to the bump than this many of its widths are left out.
STRIP_MM = 0.5
PIECE_MM = 10.0  #: Length of the pieces of a ridge whose rises are compared.
LEAST_CELLS, LEAST_IN_PIECE = 4.0, 1.0
"""Least summed weight of the cells under a structure, and under a piece of a ridge, for a mean."""


class Surroundings(Record, eq=False):
    """Smoothed map less its level, not finite where the map has no data."""

    x_mm: FloatArray  #: (nx,) array.
    y_mm: FloatArray  #: (ny,) array.
    excess: FloatArray  #: (ny, nx) array.

    def rise(self, extra: Neighbour, places: FloatArray, bump: ModalBump, *, middle: tuple[float, float]) -> FloatArray:
        """(g,) excess of the map, without a round bump, under second lumps or ribs; -inf where the map has no data.

        The (g, 3) places are as in `Scene`: ``x2, y2, w2`` or ``angle, offset, w2`` about the window's `middle`. Under
        a lump the excess is the mean; along a rib the median over pieces of `PIECE_MM` if that is lower, since another
        lump on its line lifts only a piece or two. The far side of the dip beside a lump, a ridge to the window, has
        no excess.
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
            of_angle = places[:, 0] == angle
            across = np.cos(angle) * x + np.sin(angle) * y
            strip = np.rint((across - across.min()) / STRIP_MM).astype(np.intp)
            piece = np.floor((np.cos(angle) * y - np.sin(angle) * x) / PIECE_MM).astype(np.intp)
            piece -= piece.min()
            pieces = int(piece.max()) + 1
            cells, size = (strip * pieces + piece).ravel(), (int(strip.max()) + 1) * pieces
            sums = np.stack([np.bincount(cells, one, minlength=size).reshape(-1, pieces) for one in flat])
            crest = across.min() + STRIP_MM * np.arange(sums.shape[1])
            distance_in_widths = (crest - places[of_angle, 1, None]) / np.exp(places[of_angle, 2, None])
            number, total = np.exp(-0.5 * distance_in_widths**2) @ sums
            mean = _mean(number.sum(axis=1), total.sum(axis=1), LEAST_CELLS)
            excess[of_angle] = np.minimum(mean, _median_piece(number, total))
        return excess


def _mean(number: FloatArray, total: FloatArray, least: float) -> FloatArray:
    """Weighted means; -inf where the weight is too small."""
    return np.where(number > least, total / np.maximum(number, 1e-300), -np.inf)


def _median_piece(number: FloatArray, total: FloatArray) -> FloatArray:
    """(g,) lower median over (g, pieces) means where the map has data; inf where it has none."""
    has_data = number > LEAST_IN_PIECE
    ordered = np.sort(np.where(has_data, _mean(number, total, LEAST_IN_PIECE), np.inf), axis=1)
    middle = np.maximum(has_data.sum(axis=1) - 1, 0) // 2
    return np.take_along_axis(ordered, middle[:, None], axis=1)[:, 0]


# --- Structures beside the bump: a second lump or a rib, in or just beyond the window.

SECOND_ODDS = 10.0  #: For a second lump or a rib: a bump that is not quite a Gaussian must not bring one.
LEAST_RISE = 0.05
"""Share of the bump's amplitude: beside 15 single simulated lumps at most 0.01, beside a second one 0.08 and more."""
LONG = 1.5  #: A bump with a larger axis ratio is also tried as two round lumps side by side.
GRID_MM = 4.0
GRID_WIDTHS_MM = (3.0, 5.0, 8.0)
GRID_ANGLES = 12
NEIGHBOUR_OF_SCENE: dict[str, Neighbour] = {"second-lump": "second lump", "rib": "rib"}


def add_neighbour(
    choice: SceneChoice, surroundings: Surroundings, *, ridges: FloatArray, scene: SceneName = "auto"
) -> SceneChoice:
    """Test for a second lump or a rib beside the bump, and add it where the evidence or `scene` says so.

    `ridges` are possible ribs, see `rising_ribs`. A structure must rise by `LEAST_RISE` of the bump's amplitude
    (`Surroundings.rise`) to be fitted, even if `scene` names it.
    """
    plain, requested, lumps = choice.plain, NEIGHBOUR_OF_SCENE.get(scene), second_lumps(choice.plain)
    with_ridges = np.column_stack([np.tile(plain.mode, (len(ridges), 1)), ridges])
    clear = replace(plain.scene, extra="rib").rib_apart(with_ridges, plain.target.window.middle)
    places: dict[Neighbour, FloatArray] = {
        "second lump": lumps[rises(plain, surroundings, "second lump", lumps)],
        "rib": ridges[clear],
    }
    fits = {
        extra: _fit_neighbour(plain, surroundings, extra, rising, forced=requested == extra)
        for extra, rising in places.items()
    }
    supported = [extra for extra, (_, log_odds, _) in fits.items() if log_odds > np.log(SECOND_ODDS)]
    likeliest = max(supported, key=lambda extra: fits[extra][1], default=None)
    chosen_extra = requested or likeliest
    tests = []
    for extra, (fit, log_odds, bound) in fits.items():
        test = Structure(extra, odds(log_odds), extra in supported, fit is not None and extra == chosen_extra, bound)
        if fit is not None:
            sign = -1.0 if extra == chosen_extra else 1.0
            x, y = change_in_sd(plain, fit.scene.converted(fit.mode, plain.scene))
            test = replace(test, change_sigma_x_sd=sign * x, change_sigma_y_sd=sign * y, place=_place_text(fit))
        tests.append(test)
    chosen_fit = fits[chosen_extra][0] if chosen_extra else None
    updated = choice if chosen_fit is None else with_new_fit(choice, chosen_fit)
    return replace(updated, structures=(*updated.structures, *tests))


def _fit_neighbour(
    plain: FieldFit, surroundings: Surroundings, extra: Neighbour, rising_places: FloatArray, *, forced: bool
) -> tuple[FieldFit | None, float, bool]:
    """Fit of a second structure with its log odds; without a fit, an upper bound of the log odds and True."""
    scene = replace(plain.scene, extra=extra)
    starts, bound = _starts(plain, extra, rising_places)
    if bound < np.log(LEAST_ODDS) and not forced:
        return None, min(bound, 0.0), True
    attempts = (fit_or_none(plain.target.problem, scene, start) for start in starts)
    fits = [fit for fit in attempts if fit is not None]
    rising_fits = [fit for fit in fits if rises(fit, surroundings, extra, fit.mode[None, -3:])[0]]
    if not rising_fits:
        return None, -np.inf, True
    best = max(rising_fits, key=lambda fit: fit.log_evidence)
    return best, best.log_evidence - plain.log_evidence, False


def _starts(plain: FieldFit, extra: Neighbour, rising: FloatArray) -> tuple[list[FloatArray], float]:
    """Start vectors for the fit of a second structure, and an upper bound of the log evidence gained."""
    window, gains = plain.target.window, np.array([-np.inf])
    if len(rising):
        templates = (neighbour_templates(window, extra, *rising[i : i + BLOCK].T) for i in range(0, len(rising), BLOCK))
        gains = np.concatenate([plain.target.gains(template, plain.mode) for template in templates])
    best = int(np.argmax(gains))
    starts, bound = [np.concatenate([plain.mode, template]) for template in rising[best : best + 1]], float(gains[best])
    if extra == "second lump" and (halves := _split(plain)) is not None:
        # one long bump may cover two lumps, which no template beside it would match
        return [*starts, halves], np.inf
    return starts, bound


def _split(plain: FieldFit) -> FloatArray | None:
    """Start vector of two round lumps in place of one long bump; None where it is not long."""
    scene, mode = plain.scene, plain.mode
    p, q, r = (plain.at[name] for name in "pqr")
    ratio = float(np.hypot(q, r))
    if ratio < np.log(LONG) / 2.0:
        return None
    along = 0.5 * np.arctan2(r, q)
    step = 0.9 * np.exp(p + ratio) * np.array([np.cos(along), np.sin(along)])
    halves = dict(zip(scene.names, mode, strict=True))
    halves |= {"u": p - ratio, "v": p - ratio, "r": 0.0}
    halves |= {"x": halves["x"] - step[0], "y": halves["y"] - step[1]}
    second = [halves["x"] + 2.0 * step[0], halves["y"] + 2.0 * step[1], p - ratio]
    return np.array([*(halves[name] for name in scene.names), *second])


def rises(fit: FieldFit, surroundings: Surroundings, extra: Neighbour, places: FloatArray) -> BoolArray:
    """(g,) True where the map rises by `LEAST_RISE` of the bump's amplitude at places of second lumps or ribs."""
    width_mm = float(np.exp(fit.at["p"]))
    bump = ModalBump(fit.target.amplitude_at(fit.mode), *fit.centre_mm, width_mm, width_mm)
    rise = surroundings.rise(extra, places, bump, middle=fit.target.window.middle)
    return np.asarray(rise > LEAST_RISE * bump.amplitude)


def second_lumps(plain: FieldFit) -> FloatArray:
    """(g, 3) grid of centres and log widths of second lumps, apart from the first."""
    problem = plain.target.problem
    reach = REACH_IN_RADII * problem.radius_mm
    axis = np.arange(-reach, reach + 1e-9, GRID_MM)
    x, y, w = (v.ravel() for v in np.meshgrid(axis, axis, np.log(GRID_WIDTHS_MM), indexing="ij"))
    middle, centre, wider = problem.window.middle, plain.centre_mm, np.exp(np.maximum(plain.at["p"], w))
    apart = np.hypot(x + middle[0] - centre[0], y + middle[1] - centre[1]) > (APART + 0.5) * wider
    allowed = apart & (np.hypot(x, y) < reach)
    return np.asarray(np.stack([x + middle[0], y + middle[1], w], axis=1)[allowed])


def rising_ribs(plain: FieldFit, surroundings: Surroundings) -> FloatArray:
    """(g, 3) angles, offsets and log widths of the ridges of a grid along which the map rises beside a bump."""
    reach = REACH_IN_RADII * plain.target.problem.radius_mm
    offsets = np.arange(-reach + 0.5 * GRID_MM, reach, GRID_MM)
    angles = np.pi * np.arange(GRID_ANGLES) / GRID_ANGLES
    grids = np.meshgrid(angles, offsets, np.log(GRID_WIDTHS_MM), indexing="ij")
    places = np.stack([v.ravel() for v in grids], axis=1)
    return np.asarray(places[rises(plain, surroundings, "rib", places)])


def _place_text(fit: FieldFit) -> str:
    at, width = fit.at, np.exp(fit.at["w2"])
    if fit.scene.extra == "second lump":
        return f"at ({at['x2']:.1f}, {at['y2']:.1f}) mm, sigma {width:.1f} mm"
    angle, middle = at["angle"], fit.target.window.middle
    distance = abs(at["offset"] - (at["x"] - middle[0]) * np.cos(angle) - (at["y"] - middle[1]) * np.sin(angle))
    along = (np.degrees(angle) + 90.0) % 180.0
    return f"{distance:.1f} mm from the lump's centre, along {along:.0f} deg, sigma {width:.1f} mm"


# --- Lump or ridge: evidence for a lump against a rib-like ridge, where the map rises along a line.


def best_ridge(choice: SceneChoice, ridges: FloatArray) -> FieldFit | None:
    """Best scene with a ridge in place of the bump, alone or with the choice's neighbour.

    Only tried where there are (g, 3) `ridges` along which the map rises beyond the bump, see `rising_ribs`; else None.
    """
    if not len(ridges):
        return None
    problem = choice.plain.target.problem
    starts = _ridge_starts(choice, problem, ridges)
    fits = [fit for scene, start in starts if (fit := fit_or_none(problem, scene, start)) is not None]
    fits = [fit for fit in fits if not _second_lump_on_bump(fit, choice.plain)]
    return max(fits, key=lambda fit: fit.log_evidence) if fits else None


def _second_lump_on_bump(ridge: FieldFit, plain: FieldFit) -> bool:
    """True where the second lump of a ridge's scene has moved onto the bump: it is no scene without the lump."""
    if ridge.scene.extra != "second lump":
        return False
    x, y = (ridge.at[f"{name}2"] - plain.at[name] for name in "xy")
    return bool(np.hypot(x, y) < APART * np.exp(plain.at["p"]))


def bump_beside_ridge(choice: SceneChoice, ridge: FieldFit) -> FieldFit | None:
    """Fit of the bump beside the ridge of `best_ridge`; None where they touch, or the ridge has a neighbour."""
    plain = choice.plain
    if ridge.scene.extra:
        return None
    scene, start = replace(plain.scene, extra="rib"), np.concatenate([plain.mode, ridge.mode[[1, 2, 0]]])
    if not scene.rib_clear(start, plain.target.window.middle):
        return None
    fit = fit_or_none(plain.target.problem, scene, start)
    return fit if fit is not None and scene.rib_clear(fit.mode, plain.target.window.middle) else None


def _ridge_starts(choice: SceneChoice, problem: Problem, places: FloatArray) -> Iterator[tuple[Scene, FloatArray]]:
    """Scenes and start vectors: the densest of `places`; with a neighbour, also a ridge through the bump."""
    alone = Scene("ridge")
    yield alone, _densest(choice, alone, places[:, [2, 0, 1]])
    extra = choice.fit.scene.extra
    if extra:
        scene, neighbour = Scene("ridge", extra=extra), choice.fit.mode[-3:]
        # ridges of the bump's width through its centre, in all directions
        angle, at = np.pi * np.arange(GRID_ANGLES) / GRID_ANGLES, choice.fit.at
        x, y = (at[name] - m for name, m in zip("xy", problem.window.middle, strict=True))
        through = [np.full(GRID_ANGLES, at["p"]), angle, x * np.cos(angle) + y * np.sin(angle)]
        yield scene, _densest(choice, scene, np.column_stack([*through, np.tile(neighbour, (GRID_ANGLES, 1))]))


def _densest(choice: SceneChoice, scene: Scene, starts: FloatArray) -> FloatArray:
    """The start vector of highest density."""
    density = choice.plain.target.of_scene(scene)(starts)
    return np.asarray(starts[int(np.argmax(density))])


# --- Irregular outline: a bump more skewed, or rounder inside than outside, than a ball's.
#
# With :math:`z` the place in widths along the ellipse's axes and :math:`G = e^{-|z|^2/2}`, the columns are
# :math:`G\,|z|^2 (z_1, z_2)` for skewness and :math:`G\,|z|^2 (z_1^2 - z_2^2, 2 z_1 z_2)` for an axis ratio that
# changes outwards, made orthogonal under the noise field to the bump, its derivatives and its exponent.

BALLS_SD = (0.008, 0.01)
"""SDs of skewness and change of balls' maps beyond their noise, over the amplitude (record 0107)."""
NOISE_FACTOR = 2.5  #: Variance of both over that by the residuals, which is too small for deep and faint lumps.
MOST_SDS = 2.5  #: Length of either, in the SD of one of its two components, beyond which a ball is unlikely.


def irregular(fit: FieldFit) -> bool:
    """True for a lone bump that is more skewed, or whose axis ratio changes more outwards, than a ball's."""
    if fit.scene.extra:  # the misfit of a neighbour would be tested
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
    tested = np.stack([outer * x, outer * y, outer * (x**2 - y**2), outer * 2 * x * y])
    # beside the oblique axis ratio and the exponent
    tangents = np.concatenate([tangent_columns(fit), np.stack([bump * x * y, outer * square])])
    value = cells.value - cells.value.mean()
    columns = np.concatenate([tangents, tested, value[None]])
    products = fit.target.products(columns, columns, fit.mode)
    v = len(tangents)
    shared = np.linalg.lstsq(products[:v, :v], products[:v, v:], rcond=None)[0]
    remainder = products[v:, v:] - products[v:, :v] @ shared
    coefficients = np.linalg.solve(remainder[:4, :4], remainder[:4, 4])
    squares = max(float(remainder[4, 4] - coefficients @ remainder[:4, 4]), FLOOR * float(products[-1, -1]))
    variance = squares / max(len(cells) - v - 4, 1)
    amplitude = fit.target.amplitude_at(fit.mode)
    return np.asarray(coefficients / amplitude), np.asarray(np.linalg.inv(remainder[:4, :4]) * variance / amplitude**2)


# --- Contribution of tracker position error to the posterior of a bump's shape.
#
# A frame that is off by :math:`\delta` maps the bump shifted by it, so a cell's error is :math:`-\nabla g \cdot
# \bar\delta`, the mean over the frames that felt the cell. Cells less than the array's side apart share frames:
# :math:`\bar\delta` is a smooth field of variance :math:`s^2 / n` with the overlap of two arrays, a triangle along
# each axis, as its correlation. Such errors change the shape of the bump and not the map beside it, so the noise model
# does not contain them: their effect on the parameters is added to the draws.

LEAST_EIGENVALUE = 3e-3  #: Smaller eigenvalues of the overlap of two arrays, over the largest, are left out.


def pose_covariance(fit: FieldFit) -> FloatArray:
    """(p, p) covariance of the bump's parameters from tracker position error; zeros where it is not known."""
    noise = fit.target.window.cells.pose_noise
    p = fit.scene.bump_parameters
    covariance = np.zeros((len(fit.mode), len(fit.mode)))
    if noise is None:
        return covariance
    tangents, window = tangent_columns(fit), fit.target.window
    across, along = map(_overlap_roots, (window.x_mm, window.y_mm), noise.side_mm)
    power = np.outer(np.sum(along**2, axis=1), np.sum(across**2, axis=1))
    i, j = np.nonzero(power > LEAST_EIGENVALUE * power.max())
    # columns whose products sum to the share of frames that two cells have in common
    frames = np.maximum(window.cells.count * noise.frames_per_reading, 1.0)
    shared = window.of_cells(along[i][:, :, None] * across[j][:, None, :]) / np.sqrt(frames)
    slopes = [tangents[1 + fit.scene.names.index(name)] for name in ("x", "y")]
    errors = np.concatenate([sd * slope * shared for sd, slope in zip(noise.sd_mm, slopes, strict=True)])
    products = fit.target.products(tangents, np.concatenate([tangents, errors]), fit.mode)
    v = len(tangents)
    shifts = np.linalg.solve(products[:, :v], products[:, v:])[1 : p + 1]
    covariance[:p, :p] = shifts @ shifts.T
    return covariance


def _overlap_roots(axis_mm: FloatArray, side_mm: float) -> FloatArray:
    """(n, n) rows whose products sum to the overlap of two equal intervals about points of an axis."""
    values, vectors = np.linalg.eigh(overlap(axis_mm, side_mm))
    return np.asarray((vectors * np.sqrt(np.maximum(values, 0.0))).T)


# --- Estimation under correlated errors: detection, scene and draws from a least-squares fit.

LEAST_VARIANCE = 1e-12  #: Directions with a smaller variance of tracker position error, over the largest, are left out.


class CorrelatedAssessment(Record, eq=False):
    """Assessment of a place on a map under correlated errors."""

    tactile_map: TactileMap
    fit: BumpFit
    detection: Detection
    scene: SceneChoice | None = None
    """None where the density has no mode: no bump stands out from the correlated noise."""
    fault: str = ""

    @classmethod
    def of(cls, tactile_map: TactileMap, fit: BumpFit, options: SamplerSettings) -> CorrelatedAssessment:
        """Test a bump against none and, where the evidence is for it, against neighbouring structures."""
        try:
            scene, detection = fit_and_test(tactile_map, fit, options)
        except NotConvergedError:
            return cls(tactile_map, fit, Detection(-np.inf))
        fault = rim_fault(tactile_map, scene.plain.modal(), radius_mm=options.fit_radius_mm)
        if not fault and detection.probability >= DETECTED:
            scene, detection = with_neighbours(scene, detection, tactile_map, requested=options.requested_scene)
        return cls(tactile_map, fit, detection, scene, fault)

    def bump(self) -> ModalBump:
        """The bump at the scene's mode; only with a scene."""
        assert self.scene is not None
        return self.scene.fit.modal()

    def draw(self, options: SamplerSettings, *, rng: np.random.Generator, progress: Progress | None) -> MapDraws:
        """Draw from the posterior; `NotConvergedError` also when the requested neighbour is not on the map."""
        choice, requested = self.scene, options.requested_scene
        assert choice is not None
        required = NEIGHBOUR_OF_SCENE.get(requested, "")
        if required and choice.fit.scene.extra != required:
            raise NotConvergedError(f"no {required} found beside the bump", advice=f"leave out --scene {requested}")
        fit, target = choice.fit, choice.fit.target
        cache = SolutionCache(target.conditional)
        draws, passed_over = draw_parameters(fit, options, rng=rng, progress=progress, solved=cache)
        detection = self.detection
        if fit is choice.plain and not detection.ridge and "log_evidence" in draws.diagnostics:
            detection = field_detection(fit, self.tactile_map, draws.diagnostics["log_evidence"])
        position_covariance = pose_covariance(fit)
        position_share = None
        if target.window.cells.pose_noise is not None:
            widths = [fit.scene.names.index(name) for name in ("u", "v") if name in fit.scene.names]
            from_positions, from_noise = (
                float(np.diag(one)[widths].sum()) for one in (position_covariance, fit.covariance)
            )
            position_share = from_positions / (from_positions + from_noise)
        figures = {
            "noise": options.noise,
            "rotation_odds": next((one.odds for one in choice.structures if one.name == "rotated"), None),
            "rotated": fit.scene.shape == "rotated",
            "field_cosines": target.window.cosines,
            **target.field_figures(fit.mode),
            **({"passed_over": list(passed_over)} if passed_over else {}),
            "places_share": position_share,
        }
        return MapDraws(detection, self.fit, draws, _posterior(fit, draws, rng, cache, position_covariance), figures)


def fit_and_test(tactile_map: TactileMap, fit: BumpFit, options: SamplerSettings) -> tuple[SceneChoice, Detection]:
    """Fit the bump under correlated errors, and test it against none; `NotConvergedError` without a mode.

    Where `field_cosines` is "auto", a narrow bump that may be a lump is fitted again with more cosines.
    """

    def choose_with(number: int, start: FloatArray) -> tuple[SceneChoice, Detection]:
        window = Window(fit.cells, independent_variance(fit.cells), cosines=number)
        problem = Problem(window, options.prior, options.fit_radius_mm, fit.bump.scale)
        choice = choose_shape(problem, start, scene=options.requested_scene)
        return choice, field_detection(choice.plain, tactile_map, choice.plain.log_evidence)

    p, q, r = (float(parameter) for parameter in fit.bump.shape_parameters(fit.theta))
    start, cosines = np.array([p + q, p - q, *fit.theta[1:3], r]), options.field_cosines
    choice, detection = choose_with(FIELD_COSINES if cosines == "auto" else cosines, start)
    if cosines != "auto" or not detection.log_bayes_factor > 0:
        return choice, detection
    plain, bump = choice.plain, choice.plain.modal()
    axes = plain.target.window.x_mm, plain.target.window.y_mm
    finer = max(cosines_for(min(bump.sigma_x_mm, bump.sigma_y_mm), axis) for axis in axes)
    if finer <= FIELD_COSINES:
        return choice, detection
    return choose_with(finer, plain.scene.converted(plain.mode, Scene("rotated")))


def field_detection(plain: FieldFit, tactile_map: TactileMap, log_evidence: float) -> Detection:
    """Odds of a bump somewhere on the map against level, tilt and the same noise fields alone.

    The window's evidence has the centre anywhere in the window; dividing by the number of windows on the map allows for
    the search.
    """
    return Detection(log_evidence - plain.target.null_log_evidence() - _log_windows(plain, tactile_map))


def _log_windows(plain: FieldFit, tactile_map: TactileMap) -> float:
    """Log number of windows in the map's area."""
    area = float(trusted_cells(tactile_map).sum()) * tactile_map.recipe.cell_mm**2
    return float(np.log(max(area / (np.pi * plain.target.problem.radius_mm**2), 1.0)))


def with_neighbours(
    choice: SceneChoice, detection: Detection, tactile_map: TactileMap, *, requested: SceneName
) -> tuple[SceneChoice, Detection]:
    """Add a second structure where the evidence supports it, test the lump against a ridge where one rises, and a lone
    bump against a Gaussian profile.

    Only scenes in `SCENES_TESTED` are tested against a ridge: without a rib in the model a lump beside one would lose.
    """
    if requested not in SCENES_TESTED:
        return add_departure(choice), detection
    surroundings = Surroundings(tactile_map.x_mm, tactile_map.y_mm, smoothed_excess(tactile_map))
    ridges = rising_ribs(choice.plain, surroundings)
    choice = add_neighbour(choice, surroundings, ridges=ridges, scene=requested)
    ridge = best_ridge(choice, ridges)
    if ridge is not None and ridge.log_evidence >= choice.plain.target.null_log_evidence():
        against = ridge.log_evidence + _log_windows(choice.plain, tactile_map)
        angle_deg = (np.degrees(ridge.at["along"]) + 90.0) % 180.0
        words = f"a ridge along {angle_deg:.0f} deg, sigma {np.exp(ridge.at['p']):.1f} mm"
        detection = Detection(choice.fit.log_evidence - against, ridge=words)
        if detection.probability < DETECTED and (with_rib := bump_beside_ridge(choice, ridge)) is not None:
            detection = Detection(with_rib.log_evidence - against, ridge=detection.ridge)
    return add_departure(choice), detection


def _posterior(
    fit: FieldFit,
    draws: ParameterDraws,
    rng: np.random.Generator,
    cache: SolutionCache,
    position_covariance: FloatArray,
) -> MapPosterior:
    """Draws by name, with tracker position error added, and for a non-Gaussian bump the spread over noise fields."""
    shape = draws.theta.shape[:2]
    shifts = _random_shifts(fit, draws, position_covariance + exponent_covariance(fit), rng)
    theta = draws.theta + shifts.reshape(draws.theta.shape)
    sigma_x, sigma_y, angle = drawn_widths(*fit.scene.widths(theta))
    amplitude, level, noise_sd = fit.target.draw_linear(draws.flat, rng, solve=cache)
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
        oblique=_oblique(fit, position_covariance),
        irregular=irregular(fit),
    )


def _oblique(fit: FieldFit, position_covariance: FloatArray) -> tuple[float, float] | None:
    """Mean and SD of the half log axis ratio 45 degrees from the map's x axis, for a scene without it.

    By one Newton step from the mode to that of the rotated scene; None where that has no maximum. Tracker position
    error is taken to spread it as it spreads the ratio along the axes.
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
    return float(mean[r]), float(np.sqrt(covariance[r, r] + along @ position_covariance @ along))


def _random_shifts(
    fit: FieldFit, draws: ParameterDraws, covariance: FloatArray, rng: np.random.Generator
) -> FloatArray:
    """(chain * draw, p) normal draws with this covariance, stratified over the draws in order of mean width."""
    values, vectors = np.linalg.eigh(covariance)
    directions = np.flatnonzero(values > LEAST_VARIANCE * values[-1])[-MOST_PAIRED:]
    if not values[-1] > 0:
        return np.zeros_like(draws.flat)
    width = fit.scene.column(draws.flat, "u") + fit.scene.column(draws.flat, "v")
    points = paired_points(width, draws.replicates, len(directions), rng)
    return np.asarray(ndtri(points) @ (vectors[:, directions] * np.sqrt(values[directions])).T)
