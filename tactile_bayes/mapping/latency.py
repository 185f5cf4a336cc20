"""Shifts of frames by how well they then agree: the tracker's latency, and what moves between strokes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np

from tactile_bayes.declarations import Record, replace
from tactile_bayes.errors import BadDataError
from tactile_bayes.geometry import BoolArray, FloatArray, IndexArray, Plane
from tactile_bayes.mapping import convention
from tactile_bayes.mapping.accumulate import FrameSource
from tactile_bayes.mapping.cells import Projector, poses_at
from tactile_bayes.mapping.convention import CoarseFrames
from tactile_bayes.mapping.map import smooth
from tactile_bayes.mapping.profile import pose_noise_figures
from tactile_bayes.mapping.select import SelectedFrames
from tactile_bayes.presets import POSE_NOISE

# --- Linear regression of readings on shifts of their places, through the map's gradient.
#
# To first order a reading is
#
# .. math:: p = m_s(u) + \nabla m(u) \cdot D \theta + q_f(s, t) + c_{st} + \epsilon
#
# with u its supposed place, D theta the error of that (D is the velocity for a latency, 1 in one stroke for that
# stroke's shift), and three nuisances: :math:`q_f` a quadratic over the head in each frame (its level, its tilt and
# how deep it sinks), :math:`c_{st}` an offset of each block of taxels (the head's response), and a map :math:`m_s`
# for each pair of the head's rows s, because a row near the head's edge sees the lump lower than one in its middle.
# All three are linear and leave the regression by projection (Frisch & Waugh 1933, Econometrica 1).

CELL_MM = (2.0, 3.0)  #: Cells of the map, as wide as the averaged frames and taxels.
_FIT_STEPS = 200
# Relative tolerance of the conjugate gradients: for shifts, and for what is only compared or warned of.
_FIT_TOLERANCE, COMPARED_TOLERANCE = 2e-3, 1e-2


class ShiftFit(Record, eq=False):
    """Readings of one or several scans at supposed places, ready for a regression on shifts."""

    parts: tuple[CoarseFrames, ...]  #: The scans.
    cells: Cells  #: Cells of the readings.
    row_cell: IndexArray  #: (n,) int array: Cell of each reading in the map of its pair of the head's rows.
    levelled: FloatArray  #: (n,) array: Readings less the frames' and taxels' part, about one common map.
    gradient: FloatArray  #: (n, 2) array: Of the map at each reading, 1/mm along x and y.
    data: FloatArray  #: (n,) array: Readings less their projection on the nuisances.
    tolerance: float  #: Of the projections.

    @classmethod
    def of(
        cls, parts: Sequence[CoarseFrames], places_mm: Sequence[FloatArray], *, tolerance: float = _FIT_TOLERANCE
    ) -> ShiftFit:
        """Fit the map's gradient and the nuisances to the readings."""
        cells = Cells.of(places_mm)
        pressure = np.concatenate([part.pressure.reshape(-1) for part in parts])
        levelled = map_fit(parts, pressure, cells, tolerance=tolerance)[1]
        gradient = cells.gradient(levelled)
        row = np.concatenate([np.tile(part.row, len(part.pressure)) for part in parts])
        row_cell = np.unique(row * (cells.number.max() + 1) + cells.number, return_inverse=True)[1]
        data = _fit_groups(parts, pressure - cells.within(gradient), row_cell, tolerance=tolerance)[0]
        return cls(tuple(parts), cells, row_cell, levelled, gradient, data, tolerance)

    def with_gradient_of(self, keep: BoolArray) -> ShiftFit:
        """Copy with the gradient of the map of some of the readings."""
        return replace(self, gradient=self.cells.gradient(self.levelled, keep=keep))

    def frame_numbers(self) -> IndexArray:
        """(n,) averaged frame of each reading, counted through all scans."""
        readings = np.concatenate([np.full(m, k) for m, k in (part.pressure.shape for part in self.parts)])
        return np.repeat(np.arange(len(readings)), readings)

    def blocks(self) -> IndexArray:
        """(n,) stretch of `convention.SHARED_S` of each reading, counted through all scans."""
        starts = np.cumsum([0, *(int(part.block.max()) + 1 for part in self.parts)])
        block = np.concatenate([part.block + start for part, start in zip(self.parts, starts, strict=False)])
        return block[self.frame_numbers()]

    def design(self, moves: Sequence[FloatArray]) -> FloatArray:
        """(n,) change of the readings when their places move by (m, k, 2), less its projection on the nuisances."""
        return _fit_groups(self.parts, self._changes(moves), self.row_cell, tolerance=self.tolerance)[0]

    def raw_design(self, moves: Sequence[FloatArray]) -> FloatArray:
        """(n,) change of the readings less its projection on the frames' quadratics alone."""
        return _by_scan(self.parts, CoarseFrames.within_frames, self._changes(moves))

    def _changes(self, moves: Sequence[FloatArray]) -> FloatArray:
        moved = np.concatenate([move.reshape(-1, 2) for move in moves])
        return np.asarray(np.einsum("ni,ni->n", self.gradient, moved))


class Cells(Record, eq=False):
    """Cells of the map with the readings in them."""

    number: IndexArray  #: (n,) int array: Cell of each reading, row by row of a block of `shape`.
    offset_mm: FloatArray  #: (n, 2) array: Place of each reading from the centre of its cell.
    shape: tuple[int, int]  #: Rows and columns.

    @classmethod
    def of(cls, places_mm: Sequence[FloatArray]) -> Cells:
        size = np.reshape(CELL_MM, (2, 1))
        place = np.concatenate([one.reshape(-1, 2) for one in places_mm]).T.copy()
        index = np.floor(place / size)
        x, y = (index - index.min(axis=1, keepdims=True)).astype(np.intp)
        columns, rows = int(x.max()) + 1, int(y.max()) + 1
        return cls(y * columns + x, (place - (index + 0.5) * size).T, (rows, columns))

    def within(self, gradient: FloatArray) -> FloatArray:
        """(n,) change of the map from the cell's centre to each reading, by (n, 2) gradients."""
        return np.asarray(np.einsum("ni,ni->n", gradient, self.offset_mm))

    def gradient(self, values: FloatArray, *, keep: BoolArray | None = None) -> FloatArray:
        """(n, 2) gradient at each reading of the values' map, smoothed once; 0 beside a cell without values."""
        size = self.shape[0] * self.shape[1]
        weight = np.ones(len(values)) if keep is None else keep.astype(np.float64)
        count = smooth(np.bincount(self.number, weight, size).reshape(self.shape), passes=1)
        total = smooth(np.bincount(self.number, weight * values, size).reshape(self.shape), passes=1)
        mean = np.divide(total, count, out=np.full_like(total, np.nan), where=count > 0)
        if min(self.shape) < 2:
            return np.zeros((len(self.number), 2))
        along_y, along_x = np.gradient(mean, CELL_MM[1], CELL_MM[0])
        slopes = np.stack([along_x.reshape(-1), along_y.reshape(-1)], axis=1)
        return np.asarray(np.nan_to_num(slopes)[self.number])


def map_fit(
    parts: Sequence[CoarseFrames],
    values: FloatArray,
    cells: Cells,
    *,
    tolerance: float = _FIT_TOLERANCE,
    within: bool = True,
) -> tuple[FloatArray, FloatArray]:
    """(n,) residuals of readings about frames, taxels and one map, and (n,) readings less the frames' and taxels' part.

    `within` carries the readings to their cells' centres along the map's gradient.
    """
    residual, mapped = _fit_groups(parts, values, cells.number, tolerance=tolerance)
    if within:
        at_centres = values - cells.within(cells.gradient(residual + mapped))
        residual, mapped = _fit_groups(parts, at_centres, cells.number, start=mapped, tolerance=tolerance)
    return residual, residual + mapped


def _fit_groups(
    parts: Sequence[CoarseFrames],
    values: FloatArray,
    group: IndexArray,
    *,
    start: FloatArray | None = None,
    tolerance: float = _FIT_TOLERANCE,
) -> tuple[FloatArray, FloatArray]:
    """(n,) residuals of readings about frames, taxels and a value per group, and (n,) values of the readings' groups.

    Least squares: frames and taxels are eliminated, and the groups' values come from conjugate gradients (Hestenes &
    Stiefel 1952), preconditioned by their numbers of readings, from those of `start` on.
    """
    scale = 1 / np.sqrt(np.maximum(np.bincount(group), 1))
    residual = _by_scan(parts, CoarseFrames.without_head, values)
    first = scale * np.bincount(group, residual)
    if start is not None:
        residual = _by_scan(parts, CoarseFrames.without_head, values - start)
    added, step, square = np.zeros_like(scale), np.zeros_like(scale), np.inf
    for _ in range(_FIT_STEPS):
        gradient, before = scale * np.bincount(group, residual), square
        square = float(gradient @ gradient)
        if square <= tolerance**2 * float(first @ first):
            break
        step = gradient + square / before * step
        change = _by_scan(parts, CoarseFrames.without_head, (scale * step)[group])
        length = square / float(change @ change)
        residual -= length * change
        added += length * scale * step
    return residual, added[group] if start is None else start + added[group]


def _by_scan(
    parts: Sequence[CoarseFrames], method: Callable[[CoarseFrames, FloatArray], FloatArray], values: FloatArray
) -> FloatArray:
    """(n,) values after a method of each scan's frames is applied to those of the scan."""
    if len(parts) == 1:
        return method(parts[0], values.reshape(parts[0].pressure.shape)).reshape(-1)
    ends = np.cumsum([part.pressure.size for part in parts])[:-1]
    split = zip(parts, np.split(values, ends), strict=True)
    return np.concatenate([method(part, some.reshape(part.pressure.shape)).reshape(-1) for part, some in split])


# --- Latency of the tracker against the array: the delay at which opposite strokes show a lump at one place.

RANGE_MS = (-50.0, 100.0)
MOST_SD_MS = 2.0  #: Standard error above which a latency is called undetermined.
LEAST_STROKES = 4  #: Two each way: with fewer the spread between strokes says nothing about the error.
MOST_FRAMES = 24_000  #: More would add minutes and no accuracy that matters.
# Readings change cells as the latency does: whole steps may end in a cycle of a tenth of a millisecond, half steps not.
_ROUNDS, _WHOLE_STEPS, _SETTLED_MS, _VELOCITY_STEP_MS = 12, 4, 0.02, 5.0
_CROSSES = 0.1  #: A stroke with this share of the best one's information crosses a lump.
_NEEDED = "scan back and forth over a lump for 20 s, or give the number of the instrument"


class LatencyEstimate(Record):
    """Estimated latency of the poses' time stamps."""

    latency_ms: float
    sd_ms: float
    """`latency_ms`, `sd_ms`: Delay at which strokes both ways agree, and its standard error."""
    bound_ms: float  #: Standard error by independent errors of the readings and by the tracker's noise alone.
    frames: int  #: Frames that were used.
    crossings: tuple[int, int]  #: Strokes that cross a lump, towards +x of the plane (or along +y) and back.


def estimate_latency(
    selections: Sequence[SelectedFrames], *, plane: Plane, cell_mm: float, max_pose_gap_ms: float
) -> LatencyEstimate:
    r"""Latency at which strokes there and back show a lump at one place; `BadDataError` where a scan leaves it open.

    Gauss-Newton steps on the regression of `ShiftFit`, with the head's velocity v as design; the information is
    :math:`\sum (v \cdot \nabla m)^2 / s^2` over what the nuisances leave of it (record 0097).
    """
    parts = [_TimedFrames.of(one, plane=plane, cell_mm=cell_mm, gap_ms=max_pose_gap_ms) for one in selections]
    parts = [part for part in parts if len(part.coarse.frames)]
    if not parts:
        raise _undetermined("no frame has a pose at every delay")
    latency, fit = _solve_latency(parts)
    estimate = _with_error(latency, fit, parts, pose_noise_figures(selections, plane, cell_mm=cell_mm))
    if not estimate.sd_ms < MOST_SD_MS:
        raise _undetermined(_lack(estimate))
    return estimate


def _undetermined(why: str) -> BadDataError:
    return BadDataError(f"the scan does not determine the tracker's latency ({why})", way_out=_NEEDED)


def _lack(estimate: LatencyEstimate) -> str:
    """Clause on why the scan does not determine the latency."""
    forth, back = estimate.crossings
    if not np.isfinite(estimate.sd_ms):
        lack = "no lump or other slope stands out of the noise"
    elif min(forth, back) == 0:
        lack = f"a lump is crossed {max(forth, back)} times in one direction and never in the other"
    else:
        lack = f"a lump is crossed {forth} times forth and {back} times back"
    if forth + back < LEAST_STROKES:
        return f"{lack}; at least two strokes each way are needed"
    error = f"; it would be known to +-{estimate.sd_ms:.0f} ms only" if np.isfinite(estimate.sd_ms) else ""
    return f"{lack}{error}, within {MOST_SD_MS:g} ms are needed"


class _TimedFrames(Record, eq=False):
    """Averaged frames of one scan, whose pose is known at every latency in `RANGE_MS`."""

    selection: SelectedFrames
    coarse: CoarseFrames
    projector: Projector
    gap_ms: float

    @classmethod
    def of(cls, selection: SelectedFrames, *, plane: Plane, cell_mm: float, gap_ms: float) -> _TimedFrames:
        used, time_s = selection.used.copy(), selection.scan.frames.time_s
        for edge in RANGE_MS:
            used &= poses_at(selection.fresh, time_s, latency_ms=edge, max_gap_ms=gap_ms).known
        coarse = CoarseFrames.of(selection, np.flatnonzero(used)[:MOST_FRAMES])
        projector = selection.projector(plane_from_base=plane.plane_from_base, cell_mm=cell_mm)
        return cls(selection, coarse, projector, gap_ms)

    def places_mm(self, latency_ms: float) -> FloatArray:
        """(m, k, 2) places of the averaged readings at a latency."""
        time_s = self.selection.scan.frames.time_s[self.coarse.frames]
        poses = poses_at(self.selection.fresh, time_s, latency_ms=latency_ms, max_gap_ms=self.gap_ms)
        return self.coarse.places_mm(self.projector.at(poses))

    def moves_mm(self, latency_ms: float) -> FloatArray:
        """(m, k, 2) derivative of `places_mm` by the latency, mm per ms."""
        late, early = (self.places_mm(latency_ms + sign * _VELOCITY_STEP_MS) for sign in (1, -1))
        return np.asarray((late - early) / (2 * _VELOCITY_STEP_MS))


def _solve_latency(parts: Sequence[_TimedFrames]) -> tuple[float, ShiftFit]:
    """Latency at which the regression's step is zero, and the regression there."""
    latency, coarse = 0.0, [part.coarse for part in parts]
    for number in range(_ROUNDS):
        fit = ShiftFit.of(coarse, [part.places_mm(latency) for part in parts])
        design = fit.design([part.moves_mm(latency) for part in parts])
        information = float(design @ design)
        step = float(design @ fit.data) / information if information > 0 else 0.0
        if abs(step) < _SETTLED_MS:
            break
        if not RANGE_MS[0] < latency + step < RANGE_MS[1]:
            raise _undetermined(f"no delay from {RANGE_MS[0]:g} to {RANGE_MS[1]:g} ms lets its strokes agree")
        latency += step if number < _WHOLE_STEPS else 0.5 * step
    return latency, fit


def _strokes(parts: Sequence[_TimedFrames], latency_ms: float) -> tuple[IndexArray, FloatArray]:
    """Stroke of each averaged frame, counted through all scans, and each stroke's direction, 1 or -1."""
    labels: list[IndexArray] = []
    directions: list[FloatArray] = []
    for part in parts:
        head = part.places_mm(latency_ms).mean(axis=1)
        axis = np.linalg.svd(part.moves_mm(latency_ms).mean(axis=1), full_matrices=False)[2][0]
        along = head @ (axis if axis[int(np.argmax(np.abs(axis)))] > 0 else -axis)
        starts = convention.stroke_starts(along)
        lengths = np.diff(starts)
        labels.append(np.repeat(np.arange(len(lengths)), lengths) + sum(map(len, directions)))
        directions.append(np.sign([along[b - 1] - along[a] for a, b in pairwise(starts)]))
    return np.concatenate(labels), np.concatenate(directions)


def _with_error(
    latency_ms: float, fit: ShiftFit, parts: Sequence[_TimedFrames], noise: dict[str, float]
) -> LatencyEstimate:
    """The latency with its standard error, bound, and crossings of a lump.

    The standard error is the largest of a jackknife over strokes, the regression's own with errors shared over 0.2 s,
    and the bound, widened as Student's t. Noise has slopes too: the information is the product of two gradients, from
    alternate stretches of the scan.
    """
    frames = sum(len(part.coarse.frames) for part in parts)
    moves, block = [part.moves_mm(latency_ms) for part in parts], fit.blocks()
    label, directions = _strokes(parts, latency_ms)
    stroke, count = label[fit.frame_numbers()], len(directions)
    design = fit.design(moves)
    information = float(design @ design)
    halves = [fit.with_gradient_of(block % 2 == half).design(moves) for half in (0, 1)]
    true_share = min(1.0, float(halves[0] @ halves[1]) / information) if information > 0 else 0.0
    raw_information = np.bincount(stroke, fit.raw_design(moves) ** 2, count)
    crosses = raw_information > _CROSSES * raw_information.max()
    crossings = (int(np.sum(crosses & (directions > 0))), int(np.sum(crosses & (directions < 0))))
    if true_share <= 0.0 or count < LEAST_STROKES:
        return LatencyEstimate(latency_ms, np.inf, np.inf, frames, crossings)
    bound = _bound(fit, design, noise)
    scores = np.bincount(stroke, design * fit.data, count)
    stroke_information = np.bincount(stroke, design**2, count)
    left_out = (scores.sum() - scores) / np.maximum(information - stroke_information, 1e-300)
    between_strokes = float(np.sqrt((count - 1) / count * float(np.sum((left_out - left_out.mean()) ** 2))))
    between_blocks = float(np.linalg.norm(np.bincount(block, design * fit.data))) / information
    error = np.sqrt((count - 1) / (count - 3)) * max(bound, between_strokes, between_blocks)
    return LatencyEstimate(latency_ms, error / true_share, bound / true_share, frames, crossings)


def _bound(fit: ShiftFit, design: FloatArray, noise: dict[str, float]) -> float:
    """Standard error from independent errors of readings and from the tracker position error."""
    information = float(design @ design)
    reading_variance = float(fit.data.var()) / information
    leverage = [np.bincount(fit.frame_numbers(), design * slope) for slope in fit.gradient.T]
    pairs = zip(POSE_NOISE[:2], leverage, strict=True)
    position = sum(noise.get(name, 0.0) ** 2 * float(axis @ axis) for name, axis in pairs)
    return float(np.sqrt(reading_variance + position / information**2))


# --- Registration of single strokes: shifts along x that put a lump that moves with the head back in one place.

KNOWN_SD_MM = 0.5  #: A stroke's shift counts as known when its standard error is below this.
EXPECTED_MM = 4.0  #: SD of the shifts' prior; none is taken to be longer than twice that.
MISFIT_MM = 0.06  #: SD of shifts between strokes over still lumps of the solid model, beyond noise.
_STROKE_ROUNDS = 4
_MOST_NUMBERS = 3e7  #: Frames are thinned out until all strokes' designs together have no more numbers than this.


class StrokeShift(Record):
    """Shift of one stroke against all others."""

    start: int
    stop: int
    """`start`, `stop`: Among the used frames of its scan."""
    scan: int  #: Number of the scan, from 0.
    direction: int  #: +1 where the head moved along +x of the plane, else -1.
    shift_mm: float = 0.0
    sd_mm: float = np.inf
    """`shift_mm`, `sd_mm`: Along x of the plane, and its standard error."""
    known: bool = False  #: True where the stroke crossed a lump or an edge that fixes a shift; else the shift is 0.


def find_strokes(sources: Sequence[FrameSource]) -> list[StrokeShift]:
    """Runs of the scans' used frames in one direction along x, their shifts unknown yet; a turn ends a run."""
    paths = [source.projection.shift[:, 0] * source.projection.cell_mm for source in sources]
    return [
        StrokeShift(start, stop, number, direction)
        for number, path in enumerate(paths)
        for start, stop, direction in convention.strokes_along(path)
    ]


def stroke_count(sources: Sequence[FrameSource], *, axis: int = 0) -> int:
    """Number of strokes along x, or y (1); runs less than half as long as the longest are turns or corrections."""
    paths = [source.projection.shift[:, axis] * source.projection.cell_mm for source in sources]
    lengths = [float(np.ptp(path[a:b])) for path in paths for a, b, _ in convention.strokes_along(path)]
    longest = max(lengths, default=0.0)
    return sum(length >= longest / 2 for length in lengths)


def register_strokes(sources: Sequence[FrameSource]) -> tuple[list[FrameSource], list[StrokeShift]]:
    """Scans with their strokes shifted onto each other along x, and the shifts, whose mean is 0.

    The regression of `ShiftFit` with one unknown per stroke, a few rounds (record 0097). `BadDataError` when fewer than
    two strokes crossed a lump or an edge that fixes a shift.
    """
    strokes = find_strokes(sources)
    if len(strokes) < 2:
        what = f"the scan has {len(strokes)} stroke over {convention.LEAST_REACH_MM:g} mm"
        raise BadDataError(what, way_out="scan back and forth")
    numbers = [len(one.frames) * 5e-3 / convention.POOL_S * one.selection.readout.size / 4 for one in sources]
    every = [max(1, int(np.ceil(len(strokes) * readings / _MOST_NUMBERS))) for readings in numbers]
    parts, shifts = _stroke_frames(sources, strokes, every), np.zeros(len(strokes))
    for _ in range(_STROKE_ROUNDS):
        regression = _ShiftRegression.of(parts, shifts)
        shifts = np.clip(shifts + regression.step(shifts), -2 * EXPECTED_MM, 2 * EXPECTED_MM)
    known, errors = regression.errors()
    if known.sum() < 2:
        best = float(regression.conditional_errors().min())
        why = f"the best is known to +-{best:.1f} mm" if np.isfinite(best) else "no slope stands out of the noise"
        raise BadDataError(
            f"{int(known.sum())} of {len(known)} strokes crossed a lump or an edge that fixes a shift to "
            f"{KNOWN_SD_MM:g} mm ({why})",
            way_out="scan back and forth over a lump, or leave out the option",
        )
    shifts = np.where(known, shifts - shifts[known].mean(), 0.0)
    shifted = [
        replace(stroke, shift_mm=float(shift), sd_mm=float(error), known=bool(sure))
        for stroke, shift, error, sure in zip(strokes, shifts, errors, known, strict=True)
    ]
    moved = [_shifted_back(source, [one for one in shifted if one.scan == n]) for n, source in enumerate(sources)]
    return moved, shifted


def mobility(strokes: Sequence[StrokeShift]) -> tuple[float, float]:
    """Distance by which the lump follows the head, mm, and its standard error; NaN without strokes both ways.

    Half the difference between the mean shifts of strokes towards +x and towards -x. A latency tau left in the poses
    gives the same: v tau.
    """
    groups = [[stroke for stroke in strokes if stroke.known and stroke.direction == direction] for direction in (1, -1)]
    if not all(groups):
        return float("nan"), float("nan")
    means, errors = [], []
    for group in groups:
        shifts_mm, sd_mm = [one.shift_mm for one in group], float(np.mean([one.sd_mm for one in group]))
        if len(group) > 1:  # the spread between strokes of one direction says more than the errors of single ones
            sd_mm = max(sd_mm, float(np.std(shifts_mm, ddof=1)))
        means.append(float(np.mean(shifts_mm)))
        errors.append(sd_mm / np.sqrt(len(group)))
    return (means[0] - means[1]) / 2, float(np.hypot(*errors)) / 2


class _StrokeFrames(Record, eq=False):
    """Averaged frames of one scan with their strokes."""

    coarse: CoarseFrames  #: The averages, thinned out.
    places_mm: FloatArray  #: (m, k, 2) array.
    stroke: IndexArray  #: (m,) int array: Number of each average's stroke among those of all scans.

    def along_x(self, values: FloatArray) -> FloatArray:
        """(m, k, 2) moves along x by the value of each average's stroke, from one value for each of all strokes."""
        moves = np.zeros_like(self.places_mm)
        moves[:, :, 0] = values[self.stroke, None]
        return moves

    def shifted_mm(self, shifts_mm: FloatArray) -> FloatArray:
        """(m, k, 2) places with each stroke moved back by its shift."""
        return np.asarray(self.places_mm - self.along_x(shifts_mm))


def _stroke_frames(
    sources: Sequence[FrameSource], strokes: Sequence[StrokeShift], every: Sequence[int]
) -> list[_StrokeFrames]:
    """Averages of the scans with used frames, over every `every`-th stretch of each."""
    parts = []
    for number, source in enumerate(sources):
        if not len(source.frames):
            continue
        sample = convention.every_stretch(source.selection.scan.frames.time_s[source.frames], every[number])
        coarse = CoarseFrames.of(source.selection, source.frames[sample])
        numbers = [n for n, stroke in enumerate(strokes) if stroke.scan == number]
        starts = [strokes[n].start for n in numbers]
        stroke = np.searchsorted(starts, sample[coarse.first], side="right") - 1 + numbers[0]
        parts.append(_StrokeFrames(coarse, coarse.places_mm(source.projection.part(sample)), stroke))
    return parts


class _ShiftRegression(Record, eq=False):
    """Normal equations of the strokes' shifts at given ones."""

    normal: FloatArray  #: (K, K) array: Products of the strokes' designs, over the residual variance.
    score: FloatArray  #: (K,) array: Products of the designs and the readings, over the same.
    widening: FloatArray  #: (K,) array: Ratio of the standard errors to those of independent errors and exact slopes.

    @classmethod
    def of(cls, parts: Sequence[_StrokeFrames], shifts_mm: FloatArray) -> _ShiftRegression:
        fit = ShiftFit.of([part.coarse for part in parts], [part.shifted_mm(shifts_mm) for part in parts])
        block = fit.blocks()
        even = block % 2 == 0
        halves = [fit.with_gradient_of(keep) for keep in (even, ~even)]
        columns, true_shares = [], []
        for unit in np.eye(len(shifts_mm)):
            moves = [part.shifted_mm(unit) - part.places_mm for part in parts]
            columns.append(fit.design(moves))
            raw, first, second = (half.raw_design(moves) for half in (fit, *halves))
            true_shares.append(float(first @ second) / max(float(raw @ raw), 1e-300))
        design = np.array(columns)
        normal, variance = design @ design.T, float(fit.data.var())
        best = np.linalg.lstsq(normal, design @ fit.data, rcond=1e-9)[0]
        inflation = _block_inflation(design, fit.data - best @ design, block)
        share = np.clip(true_shares, 0.0, 1.0)
        widening = np.sqrt(max(1.0, inflation)) / np.where(share > 0, share, np.nan)
        return cls(normal / variance, design @ fit.data / variance, np.nan_to_num(widening, nan=np.inf))

    def step(self, shifts_mm: FloatArray) -> FloatArray:
        """(K,) further shifts of the strokes; the prior draws those to 0 on which the readings say nothing."""
        precision = self.normal + np.eye(len(self.normal)) / EXPECTED_MM**2
        return np.asarray(np.linalg.solve(precision, self.score - shifts_mm / EXPECTED_MM**2))

    def conditional_errors(self) -> FloatArray:
        """(K,) standard error of each stroke's shift if all the others' were known."""
        return np.asarray(self.widening / np.sqrt(np.maximum(np.diag(self.normal), 1e-300)))

    def errors(self) -> tuple[BoolArray, FloatArray]:
        """(K,) strokes whose shift about the known strokes' mean is known, and the (K,) standard errors."""
        covariance = np.linalg.inv(self.normal + np.eye(len(self.normal)) / EXPECTED_MM**2)
        known, errors = self.conditional_errors() < KNOWN_SD_MM, np.full(len(self.normal), np.inf)
        for _ in range(2):
            if known.sum() < 2:
                return known, errors
            centring = np.eye(len(known)) - known / known.sum()
            errors = np.hypot(np.sqrt(np.diag(centring @ covariance @ centring.T)) * self.widening, MISFIT_MM)
            known = known & (errors < KNOWN_SD_MM)
        return known, errors


def _block_inflation(design: FloatArray, residual: FloatArray, block: IndexArray) -> float:
    """Ratio by which errors shared within blocks raise the variance of the designs' coefficients, over all of them."""
    scores = np.array([np.bincount(block, column * residual) for column in design])
    free = max(1.0, scores.shape[1] - len(design))
    inflation = float(np.sum(scores**2) / (residual.var() * np.sum(design**2)))
    return float(inflation * scores.shape[1] / free)


def _shifted_back(source: FrameSource, strokes: list[StrokeShift]) -> FrameSource:
    """FrameSource with its strokes moved back by their shifts."""
    shift = np.zeros_like(source.projection.shift)
    for stroke in strokes:
        shift[stroke.start : stroke.stop, 0] = -stroke.shift_mm
    exact = np.rint(shift / source.projection.cell_mm * 2.0**30) / 2.0**30  # on the grid that keeps cells exact
    return replace(source, projection=source.projection.moved(exact))


# --- Lag between strokes in opposite directions: a lump that is dragged along, or poses that come late.
#
# Either moves the lump's image ahead in one direction and behind in the other, and the map is too wide. One unknown of
# `ShiftFit`, in one round: enough for a warning.

LAG_FRAMES = 160  #: Averaged frames, spread evenly: more would cost as much as the map itself.


def stroke_lag_figures(sources: Sequence[FrameSource]) -> dict[str, float]:
    """Figures ``stroke_lag_mm``, half the distance between the lump as strokes to +x and to -x see it, and its ``_sd``.

    Above 0 strokes see the lump ahead, as if dragged along; a pose that is late by t gives -v t. Empty where strokes
    went one way only, or nothing in the map has a slope. One linear step from no shift: above 1 mm it is rough.
    """
    times_s = (source.selection.scan.frames.time_s[source.frames] for source in sources)
    every = convention.thinning(times_s, most=LAG_FRAMES)
    strokes = find_strokes(sources)
    parts = _stroke_frames(sources, strokes, [every] * len(sources))
    directions = np.array([stroke.direction for stroke in strokes])
    if len({direction for part in parts for direction in directions[part.stroke].tolist()}) < 2:
        return {}
    coarse, places = [part.coarse for part in parts], [part.places_mm for part in parts]
    fit = ShiftFit.of(coarse, places, tolerance=COMPARED_TOLERANCE)
    design = fit.design([part.along_x(directions) for part in parts])
    information = float(design @ design)
    if not information > 0:
        return {}
    # a lump that is ahead of its place is seen at places that are behind theirs
    lag = -float(design @ fit.data) / information
    scores = np.bincount(fit.blocks(), design * (fit.data + lag * design))
    return {"stroke_lag_mm": lag, "stroke_lag_sd_mm": float(np.sqrt(np.sum(scores**2))) / information}
