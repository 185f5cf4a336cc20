"""Shifts of frames by how well they then agree: the tracker's latency, and what moves between strokes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np

from tactile_bayes.declarations import Record, replace
from tactile_bayes.errors import BadDataError
from tactile_bayes.geometry import BoolArray, FloatArray, IndexArray, Plane
from tactile_bayes.mapping import convention
from tactile_bayes.mapping.accumulate import Source
from tactile_bayes.mapping.cells import Projector, poses_at
from tactile_bayes.mapping.convention import CoarseFrames
from tactile_bayes.mapping.map import smooth
from tactile_bayes.mapping.profile import pose_noise_figures
from tactile_bayes.mapping.select import SelectedFrames
from tactile_bayes.presets import POSE_NOISE

# --- Shifts of readings' places found by linear regression on the map's gradient, with all else that varies taken off.
#
# To first order a reading is
#
# .. math:: p = m_s(u) + \nabla m(u) \cdot D \theta + q_f(s, t) + c_{st} + \epsilon
#
# with u its supposed place, D theta by how much that is wrong (D is the velocity for a latency, 1 in one stroke for
# that stroke's shift), and three nuisances: :math:`q_f` a quadratic over the head in each frame (its level, its
# tilt and how deep it sinks), :math:`c_{st}` an offset of each block of taxels (the head's response), and a map
# :math:`m_s` of its own for each pair of the head's rows s, because a row near the head's edge sees the lump lower
# than one in its middle. All three are linear and leave the regression by projection (Frisch & Waugh 1933,
# Econometrica 1).

# Cells of the map, mm: as the averaged frames and taxels are. Slopes within a cell are followed.
CELL_MM = (2.0, 3.0)
_FIT_STEPS = 200
# Of the pull on the groups' values, what may be left: shifts are finer than errors that are only compared.
_FIT_TOLERANCE, COMPARED = 2e-3, 1e-2


class ShiftFit(Record, eq=False):
    """Readings of one or several scans at supposed places, ready for a regression on shifts."""

    parts: tuple[CoarseFrames, ...]  #: The scans.
    cells: Cells  #: Where the readings lie.
    row_cell: IndexArray  #: (n,) int array: Cell of the map of the head's rows that each reading is of.
    levelled: FloatArray  #: (n,) array: Readings without what frames and taxels add to one common map.
    gradient: FloatArray  #: (n, 2) array: Of the map at each reading, 1/mm along x and y.
    data: FloatArray  #: (n,) array: Readings with the nuisances taken off.

    @classmethod
    def of(cls, parts: Sequence[CoarseFrames], places_mm: Sequence[FloatArray]) -> ShiftFit:
        """Find the map's gradient and take the nuisances off the readings."""
        cells = Cells.of(places_mm)
        pressure = np.concatenate([part.pressure.reshape(-1) for part in parts])
        levelled = map_fit(parts, pressure, cells)[1]
        gradient = cells.gradient(levelled)
        row = np.concatenate([np.tile(part.row, len(part.pressure)) for part in parts])
        row_cell = np.unique(row * (cells.number.max() + 1) + cells.number, return_inverse=True)[1]
        data = _fitted(parts, pressure - cells.within(gradient), row_cell)[0]
        return cls(tuple(parts), cells, row_cell, levelled, gradient, data)

    def of_some(self, keep: BoolArray) -> ShiftFit:
        """The same with the gradient of the map that some of the readings make."""
        return replace(self, gradient=self.cells.gradient(self.levelled, keep=keep))

    def frame_numbers(self) -> IndexArray:
        """(n,) averaged frame of each reading, counted through all scans."""
        readings = np.concatenate([np.full(m, k) for m, k in (part.pressure.shape for part in self.parts)])
        return np.repeat(np.arange(len(readings)), readings)

    def design(self, moves: Sequence[FloatArray]) -> FloatArray:
        """(n,) change of the readings when their places move by (m, k, 2), without the nuisances."""
        return _fitted(self.parts, self._changes(moves), self.row_cell)[0]

    def raw_design(self, moves: Sequence[FloatArray]) -> FloatArray:
        """(n,) the same with the map and the taxels' offsets left in."""
        return _by_part(self.parts, CoarseFrames.within_frames, self._changes(moves))

    def _changes(self, moves: Sequence[FloatArray]) -> FloatArray:
        moved = np.concatenate([one.reshape(-1, 2) for one in moves])
        return np.asarray(np.einsum("ni,ni->n", self.gradient, moved))


class Cells(Record, eq=False):
    """The cells of the map that readings fall in."""

    number: IndexArray  #: (n,) int array: Cell of each reading, row by row of a block of `shape`.
    offset_mm: FloatArray  #: (n, 2) array: From the cell's centre.
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
        """(n,) rise from the cell's centre to each reading along (n, 2) gradients there."""
        return np.asarray(np.einsum("ni,ni->n", gradient, self.offset_mm))

    def gradient(self, values: FloatArray, *, keep: BoolArray | None = None) -> FloatArray:
        """(n, 2) gradient at each reading of the values' map, smoothed once; 0 beside a cell without kept values."""
        size = self.shape[0] * self.shape[1]
        kept = np.ones(len(values)) if keep is None else keep.astype(np.float64)
        count = smooth(np.bincount(self.number, kept, size).reshape(self.shape), passes=1)
        total = smooth(np.bincount(self.number, kept * values, size).reshape(self.shape), passes=1)
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
    """(n,) what frames, taxels and one map leave of the readings of some scans, and (n,) the readings without frames
    and taxels, at their cells' centres: the map's gradient is followed `within` cells.
    """
    rest, mapped = _fitted(parts, values, cells.number, tolerance=tolerance)
    if within:
        at_centres = values - cells.within(cells.gradient(rest + mapped))
        rest, mapped = _fitted(parts, at_centres, cells.number, start=mapped, tolerance=tolerance)
    return rest, rest + mapped


def _fitted(
    parts: Sequence[CoarseFrames],
    values: FloatArray,
    group: IndexArray,
    *,
    start: FloatArray | None = None,
    tolerance: float = _FIT_TOLERANCE,
) -> tuple[FloatArray, FloatArray]:
    """(n,) what frames, taxels and groups leave of the readings of some scans, and (n,) what their group adds.

    The least-squares fit of all three: frames and taxels are eliminated, and the groups' values, scaled by their number
    of readings, found by conjugate gradients (Hestenes & Stiefel 1952) from those of `start` on.
    """
    scale = 1 / np.sqrt(np.maximum(np.bincount(group), 1))
    rest = _by_part(parts, CoarseFrames.without_head, values)
    whole = scale * np.bincount(group, rest)
    if start is not None:
        rest = _by_part(parts, CoarseFrames.without_head, values - start)
    found, step, square = np.zeros_like(scale), np.zeros_like(scale), np.inf
    for _ in range(_FIT_STEPS):
        left, before = scale * np.bincount(group, rest), square
        square = float(left @ left)
        if square <= tolerance**2 * float(whole @ whole):
            break
        step = left + square / before * step
        change = _by_part(parts, CoarseFrames.without_head, (scale * step)[group])
        length = square / float(change @ change)
        rest -= length * change
        found += length * scale * step
    return rest, found[group] if start is None else start + found[group]


def _by_part(
    parts: Sequence[CoarseFrames], method: Callable[[CoarseFrames, FloatArray], FloatArray], values: FloatArray
) -> FloatArray:
    """(n,) values with a method of each scan applied to its own."""
    if len(parts) == 1:
        return method(parts[0], values.reshape(parts[0].pressure.shape)).reshape(-1)
    ends = np.cumsum([part.pressure.size for part in parts])[:-1]
    split = zip(parts, np.split(values, ends), strict=True)
    return np.concatenate([method(part, some.reshape(part.pressure.shape)).reshape(-1) for part, some in split])


# --- Latency of the tracker against the array: the delay at which opposite strokes show a lump at one place.

RANGE_MS = (-50.0, 100.0)
# A latency known no better than this is called undetermined (ms).
MOST_SD_MS = 2.0
# Two each way: with fewer the spread between strokes says nothing about the error.
LEAST_STROKES = 4
# Frames looked at: more would add minutes and no accuracy that matters.
MOST_FRAMES = 24_000
# Readings change cells as the latency does, so whole steps may go round in circles of a tenth of a millisecond.
_ROUNDS, _WHOLE_STEPS, _SETTLED_MS, _VELOCITY_STEP_MS = 12, 4, 0.02, 5.0
# A stroke that tells this share of what the best one does crosses a lump.
_CROSSES = 0.1
_NEEDED = "scan back and forth over a lump for 20 s, or give the number of the instrument"


class LatencyEstimate(Record):
    """Estimated latency of the poses' time stamps."""

    latency_ms: float
    sd_ms: float
    """`latency_ms`, `sd_ms`: The delay at which strokes both ways agree, and its standard error."""
    bound_ms: float
    """Standard error that independent errors of the readings and the tracker's noise alone would leave."""
    frames: int  #: Frames it was found from.
    crossings: tuple[int, int]  #: Strokes that cross a lump, towards +x of the plane (or along +y) and back.


def estimate_latency(
    selections: Sequence[SelectedFrames], *, plane: Plane, cell_mm: float, max_pose_gap_ms: float
) -> LatencyEstimate:
    r"""Estimate the latency at which strokes there and back show a lump at one place.

    The scans may be selected with any latency, which hardly moves the plane. `BadDataError` names what a scan lacks
    that does not determine the latency.

    Gauss-Newton steps on the regression of `ShiftFit`, with the head's velocity v as design: the information on the
    latency is :math:`\sum (v \cdot \nabla m)^2 / s^2` over what the nuisances leave of it. In strokes one way at one
    speed they leave nothing, since a map shifted by v tau looks the same.

    The standard error is the largest of three: leaving out a stroke at a time (jackknife), the regression's own with
    errors shared over 0.2 s, and the bound; widened as Student's t of that many strokes is. Noise has slopes too: the
    information is the product of two gradients, from alternate stretches of the scan. A lump that follows the head by
    delta looks like a latency of -delta / v.
    """
    parts = [_Part.of(one, plane=plane, cell_mm=cell_mm, gap_ms=max_pose_gap_ms) for one in selections]
    parts = [part for part in parts if len(part.coarse.frames)]
    if not parts:
        raise _undetermined("no frame has a pose at every delay")
    latency, fit = _solved(parts)
    estimate = _with_error(latency, fit, parts, pose_noise_figures(selections, plane, cell_mm=cell_mm))
    if not estimate.sd_ms < MOST_SD_MS:
        raise _undetermined(_lack(estimate))
    return estimate


def _undetermined(why: str) -> BadDataError:
    return BadDataError(f"the scan does not determine the tracker's latency ({why})", way_out=_NEEDED)


def _lack(estimate: LatencyEstimate) -> str:
    """The scan's deficiency, in one line."""
    forth, back = estimate.crossings
    if not np.isfinite(estimate.sd_ms):
        lack = "no lump or other slope stands out of the noise"
    elif min(forth, back) == 0:
        lack = f"a lump is crossed {max(forth, back)} times in one direction and never in the other"
    else:
        lack = f"a lump is crossed {forth} times forth and {back} times back"
    if forth + back < LEAST_STROKES:
        return f"{lack}; at least two strokes each way are needed"
    known = f"; it would be known to +-{estimate.sd_ms:.0f} ms only" if np.isfinite(estimate.sd_ms) else ""
    return f"{lack}{known}, within {MOST_SD_MS:g} ms are needed"


class _Part(Record, eq=False):
    """Frames of one scan whose pose is known at every latency tried."""

    selection: SelectedFrames
    coarse: CoarseFrames
    projector: Projector
    gap_ms: float

    @classmethod
    def of(cls, selection: SelectedFrames, *, plane: Plane, cell_mm: float, gap_ms: float) -> _Part:
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
        """(m, k, 2) change of these places when the pose is a millisecond later, mm."""
        late, early = (self.places_mm(latency_ms + way * _VELOCITY_STEP_MS) for way in (1, -1))
        return np.asarray((late - early) / (2 * _VELOCITY_STEP_MS))


def _solved(parts: Sequence[_Part]) -> tuple[float, ShiftFit]:
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


def _strokes(parts: Sequence[_Part], latency_ms: float) -> tuple[IndexArray, FloatArray]:
    """Stroke of each averaged frame, counted through all scans, and each stroke's way: +1 or -1 along the motion."""
    labels: list[IndexArray] = []
    ways: list[FloatArray] = []
    for part in parts:
        head = part.places_mm(latency_ms).mean(axis=1)
        axis = np.linalg.svd(part.moves_mm(latency_ms).mean(axis=1), full_matrices=False)[2][0]
        along = head @ (axis if axis[int(np.argmax(np.abs(axis)))] > 0 else -axis)
        starts = convention.stroke_starts(along)
        lengths = np.diff(starts)
        labels.append(np.repeat(np.arange(len(lengths)), lengths) + sum(len(one) for one in ways))
        ways.append(np.sign([along[b - 1] - along[a] for a, b in pairwise(starts)]))
    return np.concatenate(labels), np.concatenate(ways)


def _with_error(latency_ms: float, fit: ShiftFit, parts: Sequence[_Part], noise: dict[str, float]) -> LatencyEstimate:
    """The latency with its standard error, bound, and crossings of a lump."""
    frames = sum(len(part.coarse.frames) for part in parts)
    moves, frame = [part.moves_mm(latency_ms) for part in parts], fit.frame_numbers()
    label, ways = _strokes(parts, latency_ms)
    stroke, count = label[frame], len(ways)
    block = convention.numbered_on([part.coarse.block for part in parts])[frame]
    design = fit.design(moves)
    information = float(design @ design)
    halves = [fit.of_some(block % 2 == half).design(moves) for half in (0, 1)]
    true_share = min(1.0, float(halves[0] @ halves[1]) / information) if information > 0 else 0.0
    felt = np.bincount(stroke, fit.raw_design(moves) ** 2, count)
    crosses = felt > _CROSSES * felt.max()
    crossings = (int(np.sum(crosses & (ways > 0))), int(np.sum(crosses & (ways < 0))))
    if true_share <= 0.0 or count < LEAST_STROKES:
        return LatencyEstimate(latency_ms, np.inf, np.inf, frames, crossings)
    bound = _bound(fit, design, noise)
    scores = np.bincount(stroke, design * fit.data, count)
    told = np.bincount(stroke, design**2, count)
    without = (scores.sum() - scores) / np.maximum(information - told, 1e-300)  # each stroke: the others' information
    between_strokes = float(np.sqrt((count - 1) / count * float(np.sum((without - without.mean()) ** 2))))
    between_blocks = float(np.linalg.norm(np.bincount(block, design * fit.data))) / information
    error = np.sqrt((count - 1) / (count - 3)) * max(bound, between_strokes, between_blocks)
    return LatencyEstimate(latency_ms, error / true_share, bound / true_share, frames, crossings)


def _bound(fit: ShiftFit, design: FloatArray, noise: dict[str, float]) -> float:
    """Standard error from independent errors of readings, and of the frames' places as the tracker tells them."""
    information = float(design @ design)
    readings = float(fit.data.var()) / information
    if POSE_NOISE[0] not in noise:
        return float(np.sqrt(readings))
    leverage = [np.bincount(fit.frame_numbers(), design * slope) for slope in fit.gradient.T]
    places = sum(noise[name] ** 2 * float(one @ one) for name, one in zip(POSE_NOISE[:2], leverage, strict=True))
    return float(np.sqrt(readings + places / information**2))


# --- Registration of single strokes: shifts along x that put a lump that moves with the head back in one place.

KNOWN_SD_MM = 0.5  #: A stroke's shift counts as known when its standard error is below this.
# Shifts are taken to scatter by this (SD) before the scan is looked at; none is taken to be longer than twice that.
EXPECTED_MM = 4.0
# By this (SD) strokes over still lumps of the solid model differ, beyond noise: the frames are not the map's alone.
MISFIT_MM = 0.06
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


def find_strokes(sources: Sequence[Source]) -> list[StrokeShift]:
    """Find runs of the scans' used frames in one direction along x; a turn belongs to the run before it."""
    return [
        StrokeShift(start, stop, number, way)
        for number, source in enumerate(sources)
        for start, stop, way in convention.strokes_along(source.projection.shift[:, 0] * source.projection.cell_mm)
    ]


def stroke_count(sources: Sequence[Source]) -> int:
    """How many strokes the head made along x; runs less than half as long as the longest are turns or corrections."""
    reach = [
        float(np.ptp(sources[one.scan].projection.shift[one.start : one.stop, 0])) for one in find_strokes(sources)
    ]
    longest = max(reach, default=0.0)
    return sum(one >= longest / 2 for one in reach)


def register_strokes(sources: Sequence[Source]) -> tuple[list[Source], list[StrokeShift]]:
    """Estimate each stroke's shift along x against the others, and shift its frames back.

    Shifts are about their mean, so the map stays where it is. `BadDataError` when there are fewer than two strokes, or
    fewer than two crossed a lump or an edge that fixes a shift.

    The regression of `ShiftFit` with one unknown per stroke, a few rounds. Along y nothing is shifted: each line lies
    at another y, so other columns of the head pass the lump, and their different readings look like a shift of half a
    millimetre (record 0097). Standard errors are those of the regression, widened for errors shared by neighbouring
    frames and for the part of the slopes that is noise; their floor is 0.06 mm.
    """
    strokes = find_strokes(sources)
    if len(strokes) < 2:
        raise BadDataError(
            f"the scan has {len(strokes)} stroke over {convention.LEAST_REACH_MM:g} mm", way_out="scan back and forth"
        )
    numbers = [len(one.frames) * 5e-3 / convention.POOL_S * one.selection.readout.size / 4 for one in sources]
    every = [max(1, int(np.ceil(len(strokes) * readings / _MOST_NUMBERS))) for readings in numbers]
    parts, shifts = _in_strokes(sources, strokes, every), np.zeros(len(strokes))
    for _ in range(_STROKE_ROUNDS):
        round_ = _Round.of(parts, shifts)
        shifts = np.clip(shifts + round_.step(shifts), -2 * EXPECTED_MM, 2 * EXPECTED_MM)
    known, errors = round_.errors()
    if known.sum() < 2:
        best = float(round_.own_errors().min())
        told = f"the best is known to +-{best:.1f} mm" if np.isfinite(best) else "no slope stands out of the noise"
        fixed = f"crossed a lump or an edge that fixes a shift to {KNOWN_SD_MM:g} mm"
        what = f"{int(known.sum())} of {len(known)} strokes {fixed} ({told})"
        raise BadDataError(what, way_out="scan back and forth over a lump, or leave out the option")
    shifts = np.where(known, shifts - shifts[known].mean(), 0.0)
    shifted = [
        replace(one, shift_mm=float(shift), sd_mm=float(error), known=bool(sure))
        for one, shift, error, sure in zip(strokes, shifts, errors, known, strict=True)
    ]
    return [_moved(source, [one for one in shifted if one.scan == n]) for n, source in enumerate(sources)], shifted


def mobility(strokes: Sequence[StrokeShift]) -> tuple[float, float]:
    """Distance by which the lump follows the head, mm, and its standard error; NaN without strokes both ways.

    Half the difference between the mean shifts of strokes towards +x and towards -x. A tracker's latency left in the
    poses gives the same picture: v tau.
    """
    ways = [[one for one in strokes if one.known and one.direction == way] for way in (1, -1)]
    if not all(ways):
        return float("nan"), float("nan")
    means = [np.mean([one.shift_mm for one in way]) for way in ways]
    # The spread between strokes of one way says more than the errors of single ones, where there are several.
    errors = [
        max(
            float(np.std([one.shift_mm for one in way], ddof=1)) if len(way) > 1 else 0.0,
            float(np.mean([one.sd_mm for one in way])),
        )
        / np.sqrt(len(way))
        for way in ways
    ]
    return float(means[0] - means[1]) / 2, float(np.hypot(*errors)) / 2


class _Strokes(Record, eq=False):
    """One scan's averaged frames."""

    coarse: CoarseFrames  #: Of every so many-th stretch of the used frames.
    places_mm: FloatArray  #: (m, k, 2) array.
    stroke: IndexArray  #: (m,) int array: Among the strokes of all scans.

    def along_x(self, values: FloatArray) -> FloatArray:
        """(m, k, 2) moves along x, of each stroke by its value, one for each of all strokes."""
        moves = np.zeros_like(self.places_mm)
        moves[:, :, 0] = values[self.stroke, None]
        return moves

    def shifted_mm(self, shifts_mm: FloatArray) -> FloatArray:
        """(m, k, 2) places with each stroke moved back by its shift."""
        return np.asarray(self.places_mm - self.along_x(shifts_mm))


def _in_strokes(sources: Sequence[Source], strokes: Sequence[StrokeShift], every: Sequence[int]) -> list[_Strokes]:
    """The scans with a used frame, averaged over every so many-th stretch."""
    parts = []
    for number, source in enumerate(sources):
        if not len(source.frames):
            continue
        kept = convention.every_stretch(source.selection.scan.frames.time_s[source.frames], every[number])
        coarse = CoarseFrames.of(source.selection, source.frames[kept])
        mine = [n for n, one in enumerate(strokes) if one.scan == number]
        stroke = np.searchsorted([strokes[n].start for n in mine], kept[coarse.first], side="right") - 1 + mine[0]
        parts.append(_Strokes(coarse, coarse.places_mm(source.projection.part(kept)), stroke))
    return parts


class _Round(Record, eq=False):
    """The regression at some shifts."""

    normal: FloatArray  #: (K, K) array: Product of the strokes' designs over the variance of what is left.
    score: FloatArray  #: (K,) array: Their product with what is left, over the same.
    widened: FloatArray  #: (K,) array: By how much standard errors exceed those of independent errors and exact slopes.

    @classmethod
    def of(cls, parts: Sequence[_Strokes], shifts_mm: FloatArray) -> _Round:
        fit = ShiftFit.of([part.coarse for part in parts], [part.shifted_mm(shifts_mm) for part in parts])
        frame = fit.frame_numbers()
        block = convention.numbered_on([part.coarse.block for part in parts])
        even = (block % 2 == 0)[frame]
        halves = [fit.of_some(keep) for keep in (even, ~even)]
        columns, told = [], []
        for unit in np.eye(len(shifts_mm)):
            moves = [part.shifted_mm(unit) - part.places_mm for part in parts]
            columns.append(fit.design(moves))
            raw, one, other = (some.raw_design(moves) for some in (fit, *halves))
            told.append(float(one @ other) / max(float(raw @ raw), 1e-300))
        design = np.array(columns)
        normal, left = design @ design.T, float(fit.data.var())
        best = np.linalg.lstsq(normal, design @ fit.data, rcond=1e-9)[0]
        shared = _shared(design, fit.data - best @ design, block[frame])
        share = np.clip(told, 0.0, 1.0)
        widened = np.sqrt(max(1.0, shared)) / np.where(share > 0, share, np.nan)
        return cls(normal / left, design @ fit.data / left, np.nan_to_num(widened, nan=np.inf))

    def step(self, shifts_mm: FloatArray) -> FloatArray:
        """(K,) by how much further the strokes are shifted; shifts that nothing tells are drawn to 0."""
        precision = self.normal + np.eye(len(self.normal)) / EXPECTED_MM**2
        pull = self.score - shifts_mm / EXPECTED_MM**2
        return np.asarray(np.linalg.solve(precision, pull))

    def own_errors(self) -> FloatArray:
        """(K,) standard error of each stroke's shift if all the others' were known."""
        return np.asarray(self.widened / np.sqrt(np.maximum(np.diag(self.normal), 1e-300)))

    def errors(self) -> tuple[BoolArray, FloatArray]:
        """(K,) strokes whose shift about the known strokes' mean is known, and the (K,) standard errors."""
        covariance = np.linalg.inv(self.normal + np.eye(len(self.normal)) / EXPECTED_MM**2)
        known, errors = self.own_errors() < KNOWN_SD_MM, np.full(len(self.normal), np.inf)
        for _ in range(2):
            if known.sum() < 2:
                return known, errors
            about = np.eye(len(known)) - known / known.sum()
            errors = np.hypot(np.sqrt(np.diag(about @ covariance @ about.T)) * self.widened, MISFIT_MM)
            known = known & (errors < KNOWN_SD_MM)
        return known, errors


def _shared(design: FloatArray, left: FloatArray, block: IndexArray) -> float:
    """By how much errors shared within blocks widen the variance of the designs' coefficients, over all of them."""
    scores = np.array([np.bincount(block, column * left) for column in design])
    free = max(1.0, scores.shape[1] - len(design))
    widening = float(np.sum(scores**2) / (left.var() * np.sum(design**2)))
    return float(widening * scores.shape[1] / free)


def _moved(source: Source, strokes: list[StrokeShift]) -> Source:
    """Source with its strokes moved back by their shifts."""
    shift = np.zeros_like(source.projection.shift)
    for one in strokes:
        shift[one.start : one.stop, 0] = -one.shift_mm
    whole = np.rint(shift / source.projection.cell_mm * 2.0**30) / 2.0**30  # on the grid that keeps cells exact
    return replace(source, projection=source.projection.moved(whole))


# --- How far apart strokes in opposite directions see the lump: one that is dragged along, or poses that come late.
#
# Either puts the lump's image ahead in one direction and behind in the other, and the map, which holds both, is too
# wide. One unknown of `ShiftFit`, in one round: enough for a warning.

LAG_FRAMES = 160  #: Averaged frames that are used, spread evenly: more would cost as much as the map itself.


def stroke_lag_figures(sources: Sequence[Source]) -> dict[str, float]:
    """Figures ``stroke_lag_mm`` and ``stroke_lag_sd_mm``: half the way between where strokes to +x and to -x see a
    lump.

    Above 0 the lump is ahead of its mean place in the direction of the stroke, as if dragged along; a pose that is late
    by t against the frames gives -v t. Empty where strokes went one way only, or nothing in the map has a slope. One
    linear step from no shift, so a figure above 1 mm is rough. The standard error holds errors that frames share over
    0.2 s.
    """
    every = convention.thinning(
        (source.selection.scan.frames.time_s[source.frames] for source in sources), most=LAG_FRAMES
    )
    strokes = find_strokes(sources)
    parts, ways = _in_strokes(sources, strokes, [every] * len(sources)), np.array([one.direction for one in strokes])
    if len({way for part in parts for way in ways[part.stroke].tolist()}) < 2:
        return {}
    fit = ShiftFit.of([part.coarse for part in parts], [part.places_mm for part in parts])
    design = fit.design([part.along_x(ways) for part in parts])
    whole = float(design @ design)
    if not whole > 0:
        return {}
    # a lump that is ahead of its place is seen at places that are behind theirs
    lag = -float(design @ fit.data) / whole
    block = convention.numbered_on([part.coarse.block for part in parts])[fit.frame_numbers()]
    scores = np.bincount(block, design * (fit.data + lag * design))
    return {"stroke_lag_mm": lag, "stroke_lag_sd_mm": float(np.sqrt(np.sum(scores**2))) / whole}
