"""Poses at the frames' times, the best-fit plane, and exact sums of readings in the cells of a map on it."""

from __future__ import annotations

from dataclasses import dataclass, field
from operator import add
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_bayes.declarations import Record
from tactile_bayes.errors import BadDataError
from tactile_bayes.geometry import (
    BoolArray,
    FloatArray,
    IndexArray,
    Plane,
    apply,
    fit_plane,
    inverse,
    rotation_from_quaternion,
    unroll_quaternion_signs,
)
from tactile_bayes.presets import PRESSURE_RANGE_KPA
from tactile_bayes.scans import CountArray, ElementCalibration, HeadGeometry, TrackerPoses

# --- Poses of the head at the frames' times, interpolated from the tracker's.

MAX_POSE_GAP_MS = 50.0
# A repeated place or rotation is an old one where it ends in a leap of this size (mm; quaternions, 2 degrees): without
# a leap the head may rest, or a rig may not turn.
_LEAP_MM, _LEAP_TURN = 2.0, 0.0175


class FramePoses(Record, eq=False):
    """Pose of the tracker's sensor at each frame."""

    position_mm: FloatArray  #: (n, 3) array: Tracker sensor in `base`.
    rotation: FloatArray  #: (n, 3, 3) array: ``p_base = position + rotation @ p_tracker``.
    known: BoolArray
    """(n,) bool array: False without poses near in time; position and rotation are then meaningless but finite."""

    def part(self, frames: slice | BoolArray | IndexArray) -> FramePoses:
        """A subset of the frames."""
        return FramePoses(self.position_mm[frames], self.rotation[frames], self.known[frames])

    def places_mm(self, point_mm: FloatArray) -> FloatArray:
        """(n, 3) places in `base` of a (3,) point that is given in the tracker's axes."""
        return np.asarray(self.position_mm + (self.rotation * point_mm).sum(axis=2))


def distinct_poses(poses: TrackerPoses) -> TrackerPoses:
    """Poses without repeats, with quaternion signs unrolled and times strictly rising.

    A repeat is an old pose with a new time stamp, from a tracker that is read faster than it measures: the first of a
    run stays. A repeated place, or rotation, alone is one where it then leaps.
    """
    quaternion = unroll_quaternion_signs(poses.quaternion_wxyz)
    new = np.ones(len(poses), dtype=bool)
    new[1:] = (np.diff(poses.position_mm, axis=0) != 0).any(axis=1) | (np.diff(quaternion, axis=0) != 0).any(axis=1)
    new[1:] &= np.diff(poses.time_s) > 0
    time_s, place_mm, quaternion = poses.time_s[new], poses.position_mm[new], quaternion[new]
    old = _outdated(time_s, place_mm, leap=_LEAP_MM, at_end=True)
    old |= _outdated(time_s, quaternion, leap=_LEAP_TURN, at_end=False)
    return TrackerPoses(time_s[~old], place_mm[~old], quaternion[~old])


def leaps(poses: TrackerPoses) -> BoolArray:
    """(n - 1,) True where place or rotation leaps to the next pose."""
    far = np.linalg.norm(np.diff(poses.position_mm, axis=0), axis=1) >= _LEAP_MM
    return np.asarray(far | (np.linalg.norm(np.diff(poses.quaternion_wxyz, axis=0), axis=1) >= _LEAP_TURN))


def _outdated(time_s: FloatArray, values: FloatArray, *, leap: float, at_end: bool) -> BoolArray:
    """(n,) True for (n, k) values that repeat the one before in a run that ends in a leap.

    A long run that ends in a gap, or is the last, is outdated too if `at_end`.
    """
    old, step, gap_s = np.zeros(len(values), dtype=bool), np.diff(values, axis=0), MAX_POSE_GAP_MS / 1000.0
    edges = np.flatnonzero(np.diff(np.concatenate([[0], (step == 0).all(axis=1), [0]])))
    for first, last in edges.reshape(-1, 2).tolist():
        if last + 1 < len(values) and time_s[last + 1] - time_s[last] <= gap_s:
            old[first + 1 : last + 1] = np.linalg.norm(step[last]) >= leap
        else:
            old[first + 1 : last + 1] = at_end and time_s[last] - time_s[first] > gap_s
    return old


def poses_at(
    poses: TrackerPoses, time_s: FloatArray, *, latency_ms: float = 0.0, max_gap_ms: float = MAX_POSE_GAP_MS
) -> FramePoses:
    """Interpolate distinct poses linearly to the (n,) times of the frames; a pose stamped t is one at ``t - latency``.

    Frames have no pose before the first, after the last, or between two further apart than `max_gap_ms`. Normalised
    quaternions depart from the great arc by less than (angle between poses)^3 / 60: nothing at tracker rates.
    """
    measured_s = poses.time_s - latency_ms / 1000.0
    if len(poses) == 0:
        zeros = np.zeros((len(time_s), 3))
        return FramePoses(zeros, np.broadcast_to(np.eye(3), (len(time_s), 3, 3)), np.zeros(len(time_s), dtype=bool))
    after = np.clip(np.searchsorted(measured_s, time_s, side="left"), 0, len(poses) - 1)
    before = np.clip(after - 1, 0, None)
    exact = measured_s[after] == time_s
    inside = (time_s >= measured_s[0]) & (time_s <= measured_s[-1])
    near = measured_s[after] - measured_s[before] <= max_gap_ms / 1000.0 + 1e-9
    return FramePoses(
        _interpolated(time_s, measured_s, poses.position_mm),
        rotation_from_quaternion(_interpolated(time_s, measured_s, poses.quaternion_wxyz)),
        exact | (inside & near),
    )


def _interpolated(time_s: FloatArray, known_s: FloatArray, values: FloatArray) -> FloatArray:
    return np.stack([np.interp(time_s, known_s, column) for column in values.T], axis=1)


# --- Best-fit plane of a motion from moments that add exactly, in any order and any parts (paper step i).

# Positions are counted in steps of 15 nm, directions and areas in steps of 2^-30 and 2^-24 mm^2: far below any
# tracker, and whole numbers, Python's, add without rounding and without an end. Beyond 2^52 steps floats have gaps.
_POSITION_STEP = 2.0**-16
_SPREAD_STEP = 2.0**-24
_AXIS_STEP = 2.0**-30
_STEPS = np.repeat([_POSITION_STEP, _SPREAD_STEP, _AXIS_STEP], [3, 9, 6])[:, None]
_FARTHEST_STEPS = 2.0**52
# Least length of a mean of unit vectors that has a direction: below it the head was turned by over 90 degrees (SD).
_LEAST_RESULTANT = 0.3


class HeadMoments(Record, eq=False):
    """First two moments of all taxel centres over frames, in whole steps, which add with ``+``."""

    sums: tuple[int, ...] = (0,) * 28
    """Number of frames (1), and sums over them: of the mean taxel centre in `base` (3), of its outer products (9), of
    the covariance of the taxels about their mean (9), and of the head's x axis and its normal (6)."""

    def __add__(self, other: HeadMoments) -> HeadMoments:
        return HeadMoments(tuple(map(add, self.sums, other.sums)))

    @property
    def count(self) -> int:
        """Number of frames."""
        return self.sums[0]

    def plane(self) -> Plane:
        """Best-fit plane of the taxel centres (`geometry.fit_plane`); `BadDataError` for a head turned all round."""
        n, *sums = self.sums
        x, product, spread, axes = np.split(np.array(sums, dtype=object), [3, 12, 21])
        # whole numbers up to the division: positions far from the base lose nothing
        between = (n * product - np.outer(x, x).ravel()) / (n * n) * _POSITION_STEP**2
        covariance = (between + spread / n * _SPREAD_STEP).astype(np.float64).reshape(3, 3)
        head_x, head_z = (axes / n * _AXIS_STEP).astype(np.float64).reshape(2, 3)
        resultant = float(np.linalg.norm(head_x))
        if not resultant > _LEAST_RESULTANT:
            raise BadDataError(
                f"the head was turned in all directions (resultant of its x axis {resultant:.2f} of 1)",
                way_out="keep its direction while scanning, or map the parts of one direction separately",
            )
        mean_mm = (x / n * _POSITION_STEP).astype(np.float64)
        return fit_plane(mean_mm, covariance, head_x=head_x, head_z=head_z)


def head_moments(head: HeadGeometry, poses: FramePoses) -> HeadMoments:
    """Moments of all taxel centres, of faulty taxels too, at the known ones of `poses`.

    A head so far from the tracker's base that steps would have gaps is a `BadDataError`.
    """
    steps = np.rint(np.array(_pose_moments(head, poses.part(poses.known))) * (1.0 / _STEPS))
    farthest = float(np.abs(steps[:3]).max(initial=0.0))
    if not farthest <= _FARTHEST_STEPS:
        raise BadDataError(
            f"the head was {farthest * _POSITION_STEP:.3g} mm from the tracker's base",
            way_out="check the unit of the positions (mm)",
        )
    whole = steps.astype(np.int64)
    centre = whole[:3].astype(object)  # its squares may be above 2^63
    sums = (*centre.sum(axis=1), *(centre @ centre.T).ravel(), *whole[3:].sum(axis=1).tolist())
    return HeadMoments((steps.shape[1], *sums))


def _pose_moments(head: HeadGeometry, poses: FramePoses) -> list[FloatArray]:
    """Mean taxel centre (3), covariance of the taxels (9) and axes (6) in `base` at n poses, (n,) each.

    Term by term and not by matrix products: the bits of a frame do not depend on how many others there are.
    """
    r, p = poses.rotation.transpose(1, 2, 0).copy(), poses.position_mm.T.copy()
    tracker_from_head = inverse(head.scanhead_from_tracker)
    taxels = apply(tracker_from_head, head.surface_mm.reshape(-1, 3))
    middle = taxels.mean(axis=0)
    covariance = ((taxels - middle).T @ (taxels - middle) / len(taxels)).T.tolist()
    m0, m1, m2 = middle.tolist()
    centre = [x + (a * m0 + b * m1 + c * m2) for x, (a, b, c) in zip(p, r, strict=True)]
    turned = [[a * x + b * y + c * z for x, y, z in covariance] for a, b, c in r]
    spread = [x * a + y * b + z * c for x, y, z in turned for a, b, c in r]
    directions = tracker_from_head[:3, [0, 2]].T.tolist()
    axes = [a * x + b * y + c * z for x, y, z in directions for a, b, c in r]
    return centre + spread + axes


# --- Sums of readings in square cells that are the same to the bit in any order and any parts.

# Values are counted in steps of 2^-12 and clipped to +-64, so 2^16 squares of a call sum exactly in float64 (2^53).
VALUE_STEP = 2.0**-12
VALUE_LIMIT = 64.0
LIMIT_STEPS = VALUE_LIMIT / VALUE_STEP
READINGS_PER_CALL = 2**16
# Count and sum of a call are packed in one number, count x 2^36 + sum: 2^16 sums of at most 2^18 steps are below 2^34.
_PACK_BITS = 36
MAX_CELLS = 2**22
_GROWTH = 16


def _no_cells() -> IntArray:
    return np.zeros((0, 0), dtype=np.int64)


@dataclass(slots=True, eq=False)
class CellSums:
    """Count, sum and sum of squares of the readings in each cell, in whole steps."""

    cell_mm: float
    first: tuple[int, int] = (0, 0)  #: Row (y) and column (x) index of ``count[0, 0]`` on the lattice.
    count: IntArray = field(default_factory=_no_cells)
    total: IntArray = field(default_factory=_no_cells)
    square: IntArray = field(default_factory=_no_cells)
    """`count`, `total`, `square`: (ny, nx) int64 arrays of readings, their sum in `VALUE_STEP` and the sum of their
    squares in `VALUE_STEP` squared."""
    clipped: int = 0  #: Readings beyond `VALUE_LIMIT` that were added at the limit.
    negative: int = 0  #: Readings below 0, by noise; they are added as they are, or the mean would be too high.

    def add_steps(self, first: tuple[int, int], shape: tuple[int, int], flat: IntArray, steps: FloatArray) -> None:
        """Add at most `READINGS_PER_CALL` values in whole steps to cells of the block `first`, `shape`; overwrites
        `steps`.

        `flat` is the cell of each in the block, row by row. Values beyond `LIMIT_STEPS` either way are clipped and
        counted.
        """
        self._make_room(first, shape)
        if (lowest := float(steps.min())) < 0:
            self.negative += int((steps < 0).sum())
        if max(float(steps.max()), -lowest) > LIMIT_STEPS:
            self.clipped += int((np.abs(steps) > LIMIT_STEPS).sum())
            np.clip(steps, -LIMIT_STEPS, LIMIT_STEPS, out=steps)
        cells, weights, index = shape[0] * shape[1], steps.ravel(), flat.ravel()
        square = np.bincount(index, weights * weights, cells).astype(np.int64)
        weights += 2.0**_PACK_BITS
        packed = np.bincount(index, weights, cells).astype(np.int64)
        count = (packed + (1 << (_PACK_BITS - 1))) >> _PACK_BITS
        window = self.window(first, shape)
        for sums, block in ((self.count, count), (self.total, packed - (count << _PACK_BITS)), (self.square, square)):
            sums[window] += block.reshape(shape)

    def trimmed(self) -> CellSums:
        """A copy without the empty rows and columns around the data."""
        filled = self.count > 0
        rows, columns = np.flatnonzero(filled.any(axis=1)), np.flatnonzero(filled.any(axis=0))
        if not len(rows):
            return CellSums(self.cell_mm, clipped=self.clipped, negative=self.negative)
        window = (slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1))
        first = (self.first[0] + int(rows[0]), self.first[1] + int(columns[0]))
        parts = (self.count[window].copy(), self.total[window].copy(), self.square[window].copy())
        return CellSums(self.cell_mm, first, *parts, clipped=self.clipped, negative=self.negative)

    def mean(self) -> FloatArray:
        """(ny, nx) mean of each cell; NaN without readings."""
        return self._per_reading(self.total, VALUE_STEP)

    def variance(self) -> FloatArray:
        """(ny, nx) variance of the readings about their cell's mean (divided by n); NaN without readings."""
        spread = self._per_reading(self.square, VALUE_STEP**2)
        spread -= np.square(self.mean())
        return np.maximum(spread, 0.0, out=spread)

    def x_mm(self) -> FloatArray:
        """(nx,) centres of the columns."""
        return np.asarray((self.first[1] + np.arange(self.count.shape[1])) * self.cell_mm, dtype=np.float64)

    def y_mm(self) -> FloatArray:
        """(ny,) centres of the rows."""
        return np.asarray((self.first[0] + np.arange(self.count.shape[0])) * self.cell_mm, dtype=np.float64)

    def map_arrays(self, scale: float = 1.0) -> dict[str, Any]:
        """Keyword arguments of a `TactileMap`: centres, counts, and mean and variance of the values over `scale`."""
        mean, variance = self.mean() / scale, self.variance() / scale**2
        return {"mean": mean, "variance": variance, "count": self.count, "x_mm": self.x_mm(), "y_mm": self.y_mm()}

    def _per_reading(self, sums: IntArray, step: float) -> FloatArray:
        ratio = np.full(sums.shape, np.nan)
        np.divide(sums, self.count, out=ratio, where=self.count > 0)
        ratio *= step
        return ratio

    def window(self, first: tuple[int, int], shape: tuple[int, int]) -> tuple[slice, slice]:
        """Slices of the arrays for a block of the lattice."""
        top, left = first[0] - self.first[0], first[1] - self.first[1]
        return slice(top, top + shape[0]), slice(left, left + shape[1])

    def _make_room(self, first: tuple[int, int], shape: tuple[int, int]) -> None:
        """Grow the arrays, with a margin, to contain a block of the lattice."""
        (top, left), (bottom, right) = first, (first[0] + shape[0], first[1] + shape[1])
        (rows, columns), (old_top, old_left) = self.count.shape, self.first
        if self.count.size:
            old_bottom, old_right = old_top + rows, old_left + columns
            if top >= old_top and left >= old_left and bottom <= old_bottom and right <= old_right:
                return
            top, left = min(top, old_top), min(left, old_left)
            bottom, right = max(bottom, old_bottom), max(right, old_right)
        refuse_vast(bottom - top, right - left, self.cell_mm)
        self.first = (top - _GROWTH, left - _GROWTH)
        for name in ("count", "total", "square"):
            larger = np.zeros((bottom - top + 2 * _GROWTH, right - left + 2 * _GROWTH), dtype=np.int64)
            if rows:
                larger[self.window((old_top, old_left), (rows, columns))] = getattr(self, name)
            setattr(self, name, larger)


def refuse_vast(rows: int, columns: int, cell_mm: float, *, most: int = MAX_CELLS) -> None:
    """Raise `BadDataError` for a map of more than `MAX_CELLS` cells, or more than `most` along one axis."""
    if rows * columns > MAX_CELLS or max(rows, columns) > most:
        raise BadDataError(
            f"the map would have {rows} x {columns} cells of {cell_mm:g} mm ({rows * columns} in all)",
            way_out=f"use larger cells (at most {MAX_CELLS} fit) or cut out poses far from the breast",
        )


# --- Projection of each frame's taxels onto the cells of a map.

IntArray = NDArray[np.int64]

# Directions (in cells per mm), taxels (mm about their middle) and shifts (in cells) are rounded to these steps, 2e-5 mm
# at the most on the plane. Their products and sums then fit float64 exactly up to 2^15 cells, so that a matrix product
# of any width, a loop and a compiled loop put every reading into the same cell.
_TURN_STEP = 2.0**-22
_TAXEL_STEP_MM = 2.0**-15
_SHIFT_STEP = 2.0**-30
_MATRIX_STEPS = np.array([_TURN_STEP, _TURN_STEP, _TURN_STEP, _SHIFT_STEP])[:, None]
_MOST_CELLS = 2**15


class Projection(Record, eq=False):
    """Taxels of frames on the lattice of cells: ``uv = matrix @ taxels``, whose floor is the cell."""

    taxels: FloatArray
    """(4, k) array: Centres of the taxels on the curved face, in the tracker's axes, mm about their middle, over a row
    of ones."""
    matrix: FloatArray
    """(n, 2, 4) array: First two rows of the rotation from the tracker to the plane, in cells per mm, beside the place
    of the taxels' middle on the lattice, in cells. Half a cell is added, so that cell k is centred on k."""
    cell_mm: float  #: Side of a cell.

    def __len__(self) -> int:
        return len(self.matrix)

    @property
    def shift(self) -> FloatArray:
        """(n, 2) shifts, in cells."""
        return self.matrix[:, :, 3]

    def part(self, frames: slice | IndexArray | BoolArray) -> Projection:
        """The projection of some of the frames."""
        return Projection(self.taxels, self.matrix[frames], self.cell_mm)

    def moved(self, cells: FloatArray) -> Projection:
        """Shift each frame by (n, 2) cells, or all by (2,); whole multiples of the shifts' step."""
        matrix = self.matrix.copy()
        matrix[:, :, 3] += cells
        return Projection(self.taxels, matrix, self.cell_mm)

    def block(self) -> tuple[tuple[int, int], tuple[int, int]]:
        """First row and column, and shape, of the block of the lattice with every reading.

        A block too wide for exact cells is a `BadDataError`.
        """
        reach = np.append(np.abs(self.taxels[:3]).max(axis=1, initial=0.0), 0.0)
        reach = (np.abs(self.matrix).reshape(-1, 4) @ reach).reshape(-1, 2)  # numpy's product is fast in 2 dimensions
        left, top = np.floor((self.shift - reach).min(axis=0)).tolist()
        right, bottom = np.floor((self.shift + reach).max(axis=0)).tolist()
        columns, rows = right - left + 1, bottom - top + 1
        if max(abs(left), abs(top), columns, rows) > _MOST_CELLS:
            refuse_vast(int(rows + abs(top)), int(columns + abs(left)), self.cell_mm, most=_MOST_CELLS)
        return (int(top), int(left)), (int(rows), int(columns))

    def flat(self, first: tuple[int, int], shape: tuple[int, int]) -> IntArray:
        """(n, k) indices of the readings' cells in a block given by its first row and column and its shape."""
        # Not negative inside the block: cutting off is floor. Blocks have at most 2^30 cells, so 32 bits hold an index.
        row = self._coordinate(1, first[0]).astype(np.int32)
        row *= np.int32(shape[1])
        row += self._coordinate(0, first[1]).astype(np.int32)
        return row.astype(np.int64)

    def _coordinate(self, axis: int, first: int) -> FloatArray:
        rows = self.matrix[:, axis].copy()
        rows[:, 3] -= first
        return np.asarray(rows @ self.taxels)


class Projector(Record, eq=False):
    """Projects taxels, in row order, onto the cells of a plane."""

    head: HeadGeometry
    plane_from_base: FloatArray
    taxels: BoolArray  #: (rows, columns) mask of those to project.
    cell_mm: float

    def at(self, poses: FramePoses) -> Projection:
        """Project the frames at `poses`.

        Term by term and not by matrix products: the bits of a frame do not depend on how many others there are.
        """
        tracker_from_head = inverse(self.head.scanhead_from_tracker)
        middle = apply(tracker_from_head, self.head.surface_mm.reshape(-1, 3).mean(axis=0))
        centres = apply(tracker_from_head, self.head.surface_mm[self.taxels]) - middle
        steps = np.rint(centres * (1.0 / _TAXEL_STEP_MM)).T
        r = poses.rotation.transpose(1, 2, 0).copy()
        # first of all: bases may lie far away
        x, y, z = (poses.position_mm - inverse(self.plane_from_base)[:3, 3]).T.copy()
        (m0, m1, m2), columns = middle.tolist(), []
        for a, b, c in self.plane_from_base[:2, :3].tolist():
            t0, t1, t2 = (a * r[0][j] + b * r[1][j] + c * r[2][j] for j in range(3))
            columns += [t0, t1, t2, a * x + b * y + c * z + (t0 * m0 + t1 * m1 + t2 * m2)]
        matrix = np.array(columns).reshape(2, 4, -1)
        matrix /= self.cell_mm
        matrix[:, 3] += 0.5
        matrix *= 1.0 / _MATRIX_STEPS
        np.rint(matrix, out=matrix)
        matrix *= _MATRIX_STEPS
        taxels = np.vstack([steps * _TAXEL_STEP_MM, np.ones(len(centres))])
        return Projection(taxels, np.ascontiguousarray(matrix.transpose(2, 0, 1)), self.cell_mm)


# --- Conversion of counts to pressures in whole multiples of a tiny step, so that sums have no rounding error.

# Gains and offsets are rounded to this (kPa): 6e-11. Counts below 2^16 times such a gain, plus such an offset, and the
# sum of a thousand of them fit float64 exactly: a frame's level does not depend on the order of addition.
PRESSURE_STEP_KPA = 2.0**-34


class Readout(Record, eq=False):
    """The taxels used, and the conversion of their counts to pressures."""

    taxels: IndexArray  #: (k,) int array: Flat indices of the used taxels, rising.
    size: int  #: Taxels of the whole array.
    gain_kpa: FloatArray
    offset_kpa: FloatArray
    """`gain_kpa`, `offset_kpa` (k,) arrays: On the grid of `PRESSURE_STEP_KPA`."""
    full_count: int  #: Readings at or above it carry no pressure.

    @classmethod
    def of(cls, calibration: ElementCalibration, good: BoolArray) -> Readout:
        """Readout of the good taxels of an array."""
        gain, offset = (
            np.rint(values[good] / PRESSURE_STEP_KPA) * PRESSURE_STEP_KPA
            for values in (calibration.gain_kpa_per_count, calibration.offset_kpa)
        )
        return cls(np.flatnonzero(good), good.size, gain, offset, calibration.saturation_count)

    def counts(self, counts: CountArray) -> CountArray:
        """(f, k) contiguous counts of the used taxels from (f, rows, columns)."""
        flat = counts.reshape(len(counts), -1)
        return np.ascontiguousarray(flat if len(self.taxels) == self.size else flat[:, self.taxels])

    def pressure_kpa(self, counts: CountArray) -> tuple[FloatArray, BoolArray | None]:
        """Pressures (f, k) of (f, k) counts, and a mask of the unsaturated ones; None where all are.

        A reading is saturated at the full count, or at the sensor's 34 kPa.
        """
        pressure = np.multiply(counts, self.gain_kpa, dtype=np.float64)
        pressure += self.offset_kpa
        valid = (counts < self.full_count) & (pressure < PRESSURE_RANGE_KPA[1])
        return pressure, None if valid.all() else valid

    def levels(self, pressure: FloatArray, valid: BoolArray | None) -> tuple[FloatArray, FloatArray]:
        """(n,) mean over the valid taxels, NaN without any, and (n,) share of the whole array that is valid."""
        # sums of whole steps have the same bits in any order, so a matrix product may add
        number = np.full(len(pressure), len(self.taxels)) if valid is None else valid.sum(axis=1)
        total = (pressure if valid is None else np.where(valid, pressure, 0.0)) @ np.ones(len(self.taxels))
        level = np.full(len(total), np.nan)
        np.divide(total, number, out=level, where=number > 0)
        return level, number / self.size


# --- Frames added to the cells of a map, in chunks that stay in the processor's cache.


def chunk_frames(taxels: int) -> int:
    """Number of frames per call, few enough for exact sums."""
    return max(1, min(128, READINGS_PER_CALL // max(1, taxels)))


def add_frames(
    sums: CellSums, pressure_kpa: FloatArray, valid: BoolArray | None, *, projection: Projection, level: FloatArray
) -> None:
    """Add the valid ones of (f, k) pressures, each over its frame's `level`, to their cells; overwrites the pressures.

    `pressure_kpa` and `valid` come from `Readout.pressure_kpa`.
    """
    steps = pressure_kpa
    steps *= (1.0 / VALUE_STEP / level)[:, None]
    np.rint(steps, out=steps)
    first, shape = projection.block()
    flat = projection.flat(first, shape)
    if valid is None:
        sums.add_steps(first, shape, flat, steps)
    elif valid.any():
        sums.add_steps(first, shape, flat[valid], steps[valid])
