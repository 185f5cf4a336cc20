"""The tracker's latency, from how well frames fit when shifted."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np

from tactile_bayes.declarations import Record, replace
from tactile_bayes.errors import BadDataError
from tactile_bayes.geometry import BoolArray, FloatArray, IndexArray, Plane
from tactile_bayes.mapping.cells import FramePoses, Projector, poses_at
from tactile_bayes.mapping.convention import CoarseFrames, numbered_on, stroke_starts
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

    Gauss-Newton steps on the regression of `tactile_bayes.mapping.latency`, with the head's velocity v as design: the
    information on the latency is :math:`\sum (v \cdot \nabla m)^2 / s^2` over what the nuisances leave of it. In
    strokes one way at one speed they leave nothing, since a map shifted by v tau looks the same.

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
        used = selection.used.copy()
        for edge in RANGE_MS:
            used &= _poses(selection, edge, gap_ms).known
        coarse = CoarseFrames.of(selection, np.flatnonzero(used)[:MOST_FRAMES])
        projector = selection.projector(plane_from_base=plane.plane_from_base, cell_mm=cell_mm)
        return cls(selection, coarse, projector, gap_ms)

    def places_mm(self, latency_ms: float) -> FloatArray:
        """(m, k, 2) places of the averaged readings at a latency."""
        poses = _poses(self.selection, latency_ms, self.gap_ms).part(self.coarse.frames)
        return self.coarse.places_mm(self.projector.at(poses))

    def moves_mm(self, latency_ms: float) -> FloatArray:
        """(m, k, 2) change of these places when the pose is a millisecond later, mm."""
        late, early = (self.places_mm(latency_ms + way * _VELOCITY_STEP_MS) for way in (1, -1))
        return np.asarray((late - early) / (2 * _VELOCITY_STEP_MS))


def _poses(selection: SelectedFrames, latency_ms: float, gap_ms: float) -> FramePoses:
    return poses_at(selection.fresh, selection.scan.frames.time_s, latency_ms=latency_ms, max_gap_ms=gap_ms)


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
        starts = stroke_starts(along)
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
    block = numbered_on([part.coarse.blocks(part.selection.scan.frames.time_s) for part in parts])[frame]
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
