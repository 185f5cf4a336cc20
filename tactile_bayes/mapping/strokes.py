"""Partial maps of single strokes, shifted onto each other: a lump that moves with the head is seen where it was."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from tactile_bayes.errors import BadDataError
from tactile_bayes.geometry import FloatArray
from tactile_bayes.mapping.cells import CellSums
from tactile_bayes.mapping.engine import Engine
from tactile_bayes.mapping.frames import chunks
from tactile_bayes.mapping.project import Projection
from tactile_bayes.mapping.source import Source

# A stroke is a run in one direction over at least this far.
LEAST_REACH_MM = 10.0
# A stroke's shift counts as known when its standard error is below this; none is taken to be longer than that.
KNOWN_SD_MM = 0.5
LONGEST_SHIFT_MM = 8.0
_ROUNDS = 4
# Squared slopes of the others' map must exceed those of its noise this many times.
_LEAST_SLOPE = 4.0


@dataclass(frozen=True, slots=True)
class StrokeShift:
    """Where one stroke saw the tissue, against all the others.

    Parameters
    ----------
    start, stop
        Among the used frames of its scan.
    scan
        Number of the scan, from 0.
    direction
        +1 where the head moved along +x of the plane, else -1.
    shift_mm, sd_mm
        x and y of the shift and its standard errors.
    known
        Whether the stroke crossed something that fixes a shift; else the shift is 0.
    """

    start: int
    stop: int
    scan: int
    direction: int
    shift_mm: tuple[float, float] = (0.0, 0.0)
    sd_mm: tuple[float, float] = (np.inf, np.inf)
    known: bool = False


def find_strokes(source: Source, number: int) -> list[StrokeShift]:
    """Runs of a scan's used frames in one direction along x; what lies at the turns is part of the run before."""
    x = source.projection.shift[:, 0] * source.projection.cell_mm
    ends, start, far = [0], 0, 0
    for i in range(len(x)):
        rising = x[far] >= x[start]
        if (x[i] - x[far]) * (1 if rising else -1) >= 0:
            far = i
        elif abs(x[far] - x[i]) >= LEAST_REACH_MM / 2 and abs(x[far] - x[start]) >= LEAST_REACH_MM:
            ends.append(far)
            start, far = far, i
    ends = [*ends, len(x)]
    return [StrokeShift(a, b, number, 1 if x[min(b, len(x) - 1)] >= x[a] else -1) for a, b in pairwise(ends) if b > a]


def register_strokes(
    sources: Sequence[Source], levels: Sequence[FloatArray], *, cell_mm: float, engine: Engine
) -> tuple[list[Source], list[StrokeShift]]:
    """Find each stroke's shift against the others, and put its frames where they fit.

    Returns
    -------
    sources
        With the projections of the known strokes shifted; shifts are about their mean, so the map stays where it is.
    strokes
        With their shifts.

    Raises
    ------
    BadDataError
        When there are fewer than two strokes, or no stroke crossed anything.

    Notes
    -----
    To first order a stroke's map is the others' map minus shift times gradient, so the shift is a weighted linear
    least-squares fit over the cells that both cover, with a level of its own; a few rounds make it exact.
    """
    strokes = [stroke for number, source in enumerate(sources) for stroke in find_strokes(source, number)]
    if len(strokes) < 2:
        raise BadDataError(
            f"the scan has {len(strokes)} stroke over {LEAST_REACH_MM:g} mm", way_out="scan back and forth"
        )
    shifts, errors = np.zeros((len(strokes), 2)), np.full((len(strokes), 2), np.inf)
    known = np.zeros(len(strokes), dtype=bool)
    for _ in range(_ROUNDS):
        maps = [
            _stroke_map(sources[one.scan], levels[one.scan], one, shift, cell_mm=cell_mm, engine=engine)
            for one, shift in zip(strokes, shifts, strict=True)
        ]
        steps, errors = _steps(maps, cell_mm)
        known = np.asarray((errors < KNOWN_SD_MM).all(axis=1))
        if not known.any():
            raise BadDataError(
                "no stroke crossed anything that fixes a shift", way_out="leave out the registration of strokes"
            )
        steps[~known] = 0.0
        shifts = shifts + steps
        shifts[known] -= shifts[known].mean(axis=0)
        shifts = np.clip(shifts, -LONGEST_SHIFT_MM, LONGEST_SHIFT_MM)
    found = [
        StrokeShift(one.start, one.stop, one.scan, one.direction, _pair(shift), _pair(error), bool(sure))
        for one, shift, error, sure in zip(strokes, shifts, errors, known, strict=True)
    ]
    return [_moved(source, [one for one in found if one.scan == n]) for n, source in enumerate(sources)], found


def mobility(strokes: Sequence[StrokeShift]) -> tuple[float, float]:
    """By how much the lump follows the head, mm, and its standard error; NaN without known strokes both ways.

    Half the difference between the mean shifts of strokes towards +x and towards -x. A tracker's latency left in the
    poses gives the same picture: v tau.
    """
    ways = [[one for one in strokes if one.known and one.direction == way] for way in (1, -1)]
    if not all(ways):
        return float("nan"), float("nan")
    means = [np.mean([one.shift_mm[0] for one in way]) for way in ways]
    # The spread between strokes of one way says more than the errors of single ones, where there are several.
    errors = [
        max(
            float(np.std([one.shift_mm[0] for one in way], ddof=1)) if len(way) > 1 else 0.0,
            float(np.mean([one.sd_mm[0] for one in way])),
        )
        / np.sqrt(len(way))
        for way in ways
    ]
    return float(means[0] - means[1]) / 2, float(np.hypot(*errors)) / 2


def _pair(values: FloatArray) -> tuple[float, float]:
    return float(values[0]), float(values[1])


def _stroke_map(
    source: Source, level: FloatArray, stroke: StrokeShift, shift_mm: FloatArray, *, cell_mm: float, engine: Engine
) -> CellSums:
    """The cells of one stroke, moved back by its shift."""
    sums = CellSums(cell_mm)
    frames = source.frames[stroke.start : stroke.stop]
    for part in chunks(len(frames), engine.chunk_frames(source.readout.size)):
        used = np.arange(stroke.start, stroke.stop)[part]
        projection = _shifted(source.projection.part(used), -shift_mm)
        counts = source.readout.counts(source.selection.scan.frames.counts[frames[part]])
        engine.add(sums, source.readout, counts, projection=projection, level=level[used])
    return sums


def _shifted(projection: Projection, by_mm: FloatArray) -> Projection:
    whole = np.rint(by_mm / projection.cell_mm * 2.0**30) / 2.0**30  # on the grid that keeps cells exact
    return projection.moved(whole)


def _moved(source: Source, strokes: list[StrokeShift]) -> Source:
    """The source with the shifts of its strokes taken off."""
    shift = np.zeros_like(source.projection.shift)
    for one in strokes:
        shift[one.start : one.stop] = one.shift_mm
    return Source(source.selection, source.readout, _shifted(source.projection, -shift))


def _steps(maps: list[CellSums], cell_mm: float) -> tuple[FloatArray, FloatArray]:
    """(strokes, 2) shifts of each stroke's map against the sum of the others', and their standard errors, mm."""
    whole = CellSums(cell_mm)
    for one in maps:
        whole.merge(one)
    count, total = np.zeros((2, len(maps), *whole.count.shape))
    for index, one in enumerate(maps):
        window = whole.window(one.first, (one.count.shape[0], one.count.shape[1]))
        count[index][window], total[index][window] = one.count, one.total
    results = [
        _step(count[i], total[i], whole.count - count[i], whole.total - total[i], cell_mm) for i in range(len(maps))
    ]
    return np.array([step for step, _ in results]), np.array([error for _, error in results])


def _step(
    count: FloatArray, total: FloatArray, others: FloatArray, others_total: FloatArray, cell_mm: float
) -> tuple[FloatArray, FloatArray]:
    """Shift of one stroke's cells against the others', after both were smoothed alike."""
    n, m = smooth(count), smooth(others)
    both = (n > 1) & (m > 1)
    here = np.divide(smooth(total), n, out=np.zeros_like(n), where=both)
    there = np.divide(smooth(others_total), m, out=np.full_like(m, np.nan), where=both)
    gradient_y, gradient_x = np.gradient(there, cell_mm)
    sound = both & np.isfinite(gradient_x) & np.isfinite(gradient_y)
    if np.count_nonzero(sound) < 20:
        return np.zeros(2), np.full(2, np.inf)
    weight = np.sqrt(n[sound] * m[sound] / (n[sound] + m[sound]))
    design = np.stack([-gradient_x[sound], -gradient_y[sound], np.ones(np.count_nonzero(sound))], axis=1)
    design, data = design * weight[:, None], (here - there)[sound] * weight
    information = design.T @ design
    if np.linalg.cond(information / np.sqrt(np.outer(*[np.diag(information) + 1e-300] * 2))) > 1e6:
        return np.zeros(2), np.full(2, np.inf)
    inverse = np.linalg.inv(information)
    best = inverse @ (design.T @ data)
    misfit = np.square(data - design @ best)
    # The others' map has noise of its own, and so has its gradient: without much more than that there is no slope.
    noise_slope = (weight**2 / m[sound]).sum() * float(misfit.mean()) / (2 * cell_mm**2)
    if not np.diag(information)[:2].min() > _LEAST_SLOPE * noise_slope:
        return np.zeros(2), np.full(2, np.inf)
    # Neighbours share readings after smoothing, and the misfit is one of shape: a tenth of the cells count.
    noise = float(misfit.sum()) / max(1.0, 0.1 * len(data) - 3)
    return best[:2], np.sqrt(noise * np.diag(inverse)[:2])


def smooth(values: NDArray[np.generic]) -> FloatArray:
    """Binomial smoothing along both axes, two cells (SD 1.4) wide."""
    smooth = np.asarray(values, dtype=np.float64)
    for axis in (0, 1):
        for _ in range(4):
            padded = np.pad(smooth, [(1, 1) if a == axis else (0, 0) for a in (0, 1)])
            low, middle, high = (np.take(padded, range(k, k + smooth.shape[axis]), axis=axis) for k in range(3))
            smooth = 0.25 * low + 0.5 * middle + 0.25 * high
    return smooth
