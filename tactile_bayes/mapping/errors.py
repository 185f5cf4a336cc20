"""Errors of a map from tracker position errors and from frames that readings share."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from tactile_bayes.declarations import Record
from tactile_bayes.geometry import BoolArray, FloatArray, Plane, apply, inverse, rotation_from_quaternion
from tactile_bayes.mapping.accumulate import Source
from tactile_bayes.mapping.cells import VALUE_STEP, CellSums, distinct_poses
from tactile_bayes.mapping.map import FEW_READINGS
from tactile_bayes.mapping.select import SelectedFrames
from tactile_bayes.presets import POSE_NOISE

# --- Tracker position error from frame to frame, estimated from the poses; it blurs the map.
#
# A bump of width sigma is mapped with sigma^2 + s^2, s the SD of a frame's place along that axis. Only errors that
# neighbouring poses do not share can be told from the head's motion, and only those are in the figures.

LEAST_POSES = 50
MOST_MM = 1.5
"""Poses further than this from the path through their neighbours are no tracker's noise: the head itself jumps."""
KEPT = 0.9
"""Share of the departures that count, the smallest: at turning points the head itself leaves the path."""
# A normal distribution's mean square within its inner nine tenths, over its variance: 1 - 2 c phi(c) / 0.9.
_INNER_SQUARE = 0.6230155


def pose_noise_figures(selections: Sequence[SelectedFrames], plane: Plane, *, cell_mm: float) -> dict[str, float]:
    """The figures `POSE_NOISE` of the frames used; empty where the tracker gave too few poses.

    The noise is what a pose departs by from the cubic through the two poses before and the two after it.
    """
    scans = [one for part in selections if (one := _place_noise(part, plane)) is not None]
    if not scans:
        return {}
    variances, frames, independent = (np.array(some) for some in zip(*scans, strict=True))
    variance = np.average(variances, axis=0, weights=frames)
    if variance.max() > MOST_MM**2:
        return {}
    head = selections[0].scan.head
    sides = [taxels * head.pitch_mm for taxels in head.shape]
    figures = [*np.sqrt(variance), *sides, (head.pitch_mm / cell_mm) ** 2 * independent.sum() / frames.sum()]
    return {name: float(f"{value:.4g}") for name, value in zip(POSE_NOISE, figures, strict=True)}


def _place_noise(part: SelectedFrames, plane: Plane) -> tuple[FloatArray, int, float] | None:
    """(2,) variance of a used frame's place along the plane's axes, mm^2, the number of used frames, and how many with
    errors of their own would have a mean known as well: those between two poses share theirs.

    None where a scan has too few poses.
    """
    frames_s = part.scan.frames.time_s[part.used]
    poses = distinct_poses(part.scan.poses)
    if len(poses) < LEAST_POSES or not len(frames_s):
        return None
    lever = inverse(part.scan.head.scanhead_from_tracker)[:3, 3]
    apex = poses.position_mm + rotation_from_quaternion(poses.quaternion_wxyz) @ lever
    departure, weight = _departures(poses.time_s, apply(plane.plane_from_base, apex)[:, :2])
    square = np.sort(departure**2 / weight[:, None], axis=0)
    noise = square[: int(KEPT * len(square))].mean(axis=0) / _INNER_SQUARE
    factor, independent = _interpolation(frames_s, poses.time_s)
    return noise * factor, len(frames_s), independent


def _departures(time_s: FloatArray, place_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(n - 4, 2) distances of positions from a cubic through their neighbours, and their variance over a position's."""
    n = len(time_s) - 4
    near = [time_s[k : k + n] - time_s[2 : 2 + n] for k in (0, 1, 3, 4)]
    departure, variance = place_mm[2 : 2 + n].copy(), np.ones(n)
    for i, k in enumerate((0, 1, 3, 4)):
        share = np.ones(n)
        for j, other in enumerate(near):
            if j != i:
                share *= other / (other - near[i])
        departure -= share[:, None] * place_mm[k : k + n]
        variance += share**2
    return departure, variance


def _interpolation(frames_s: FloatArray, poses_s: FloatArray) -> tuple[float, float]:
    """Mean variance of linear interpolation between independent poses at the frames' times, over a pose's.

    And how many independent frames of that variance have a mean of the same variance as these have.
    """
    place = np.interp(frames_s, poses_s, np.arange(len(poses_s)))
    before = np.minimum(place.astype(np.int64), len(poses_s) - 2)
    share = place - before
    factor = float(np.mean(share**2 + (1.0 - share) ** 2))
    taken = np.bincount(before, 1.0 - share, len(poses_s)) + np.bincount(before + 1, share, len(poses_s))
    return factor, float(len(frames_s) ** 2 * factor / np.sum(taken**2))


# --- Correlation of the errors within a frame: readings share frames, so a map holds less than they would alone.
#
# The figures are of the readings about the map, so whatever neighbours share is in them: the frame's level, the
# pose, the slope within a cell, a response that the calibration left.

# Runs of successive frames, spread evenly over the scan: enough pairs for a correlation to 0.01, at 400 frames' cost.
RUNS = 16
RUN_FRAMES = 25
# Fewer readings (of about that many frames' worth) than this, about a map that other frames made, say nothing.
LEAST_RUNS = 2
LEAST_READINGS = 1000
# Neighbours are compared up to this distance, in taxel pitches.
REACH_PITCHES = 8
# A length is told only where at least this share is common to neighbours, and none longer than this (mm).
LEAST_SHARE = 0.02
LONGEST_MM = 100.0
_LENGTHS = 400


def shared_frame_figures(sources: Sequence[Source], levels: Sequence[FloatArray], sums: CellSums) -> dict[str, float]:
    """Figures of the error correlation within a frame, from at most `RUNS` x `RUN_FRAMES` of the frames that made
    `sums`.

    ``shared_share`` is the share of a reading's error variance that is common to its neighbours in the frame, and
    ``shared_length_mm`` the distance over which it falls by e (only where the share is above `LEAST_SHARE`).
    ``effective_readings`` is how many independent readings those of the median cell are worth, by what readings of one
    cell within `RUN_FRAMES` successive frames have in common; ``shared_frames`` counts the frames looked at. Empty
    where that is undetermined: too few frames, or readings without any scatter.

    The correlation at distance d is fitted with share x exp(-d / length). A product of errors takes one about the map
    of all frames and one about the map without the run of frames: with independent runs its mean is the covariance
    itself, however few readings a cell has. What lasts longer than a run (a latency, a moving patient) is not in
    ``effective_readings``.
    """
    frames = sum(len(source.projection) for source in sources)
    runs = [
        _Run.of(source, level, sums, run)
        for source, level in zip(sources, levels, strict=True)
        for run in _sampled(source, frames)
    ]
    readings = sum(int(np.count_nonzero(run.known)) for run in runs)
    if len(runs) < LEAST_RUNS or readings < LEAST_READINGS:
        return {}
    variance = sum(float(np.einsum("fk,fk->", run.whole, run.others)) for run in runs) / readings
    if not variance > VALUE_STEP**2:
        return {}
    share, length_mm = _decay(*_correlations(sources, runs, variance))
    figures = {
        "shared_share": share,
        "shared_length_mm": length_mm,
        "effective_readings": float(np.median(sums.count[sums.count > 0])) / _inflation(runs, variance * readings),
        "shared_frames": float(sum(len(run.whole) for run in runs)),
    }
    if share < LEAST_SHARE:
        del figures["shared_length_mm"]
    return {name: float(f"{value:.6g}") for name, value in figures.items()}


def _sampled(source: Source, of_frames: int) -> list[slice]:
    """Runs of successive used frames of a scan, its part of `RUNS`, evenly spaced."""
    frames = len(source.projection)
    length = min(RUN_FRAMES, of_frames // LEAST_RUNS, frames)
    if not length:
        return []
    number = min(round(RUNS * frames / of_frames), frames // length)
    starts = np.linspace(0, frames - length, number).astype(int)
    return [slice(start, start + length) for start in starts.tolist()]


class _Run(Record, eq=False):
    """Errors of one run of frames; (f, k) arrays, 0 where not known."""

    source: Source  #: Which of the sources.
    cell: NDArray[np.int64]
    cells: int
    """`cell`, `cells`: Where each reading lies in the block of cells that the run covers, and how many those are."""
    whole: FloatArray
    others: FloatArray
    """`whole`, `others`: Errors about the map, and about the map without this run."""
    known: BoolArray  #: Valid readings in cells that enough readings of other frames fell into.

    @classmethod
    def of(cls, source: Source, level: FloatArray, sums: CellSums, run: slice) -> _Run:
        """The errors of the frames `run` of a source."""
        counts = source.selection.scan.frames.counts[source.frames[run]]
        pressure, valid = source.selection.readout.pressure_kpa(source.selection.readout.counts(counts))
        value = pressure / level[run, None]
        fine = np.ones(value.shape, dtype=bool) if valid is None else valid
        projection = source.projection.part(run)
        first, shape = projection.block()
        cell, window = projection.flat(first, shape), sums.window(first, shape)
        count, total = sums.count[window].ravel(), sums.total[window].ravel() * VALUE_STEP
        rest = count - np.bincount(cell[fine], minlength=len(count))
        rest_total = total - np.bincount(cell[fine], value[fine], len(count))
        enough = rest >= FEW_READINGS
        known = fine & enough[cell]
        mean = np.divide(total, count, out=np.zeros(len(count)), where=enough)
        without = np.divide(rest_total, rest, out=np.zeros(len(count)), where=enough)
        whole, others = (np.where(known, value - middle[cell], 0.0) for middle in (mean, without))
        return cls(source, cell, len(count), whole, others, known)


def _correlations(
    sources: Sequence[Source], runs: Sequence[_Run], variance: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Distance (mm), correlation and pairs of taxels within a frame, in bins of one pitch; empty bins are left out."""
    totals = np.zeros((3, REACH_PITCHES + 1))
    for source in sources:
        mine = [run for run in runs if run.source is source]
        if not mine:
            continue
        place = source.projection.taxels[:3]
        distance = np.sqrt(sum((axis[:, None] - axis) ** 2 for axis in place))
        bins = np.minimum(np.rint(distance / source.selection.scan.head.pitch_mm).astype(int), REACH_PITCHES + 1)
        # Every other frame will do: one has 86,000 pairs.
        whole, others = (np.concatenate([getattr(run, name)[::2] for run in mine]) for name in ("whole", "others"))
        known = np.concatenate([run.known[::2] for run in mine]).astype(np.float32)
        pairs = (known.T @ known).astype(np.float64)
        for row, weight in enumerate((pairs * distance, whole.T @ others, pairs)):
            totals[row] += np.bincount(bins.ravel(), weight.ravel(), REACH_PITCHES + 2)[: REACH_PITCHES + 1]
    filled = np.flatnonzero(totals[2, 1:] > 0) + 1
    distance_mm, products, pairs = totals[:, filled]
    return distance_mm / pairs, products / pairs / variance, pairs


def _decay(distance_mm: FloatArray, correlation: FloatArray, pairs: FloatArray) -> tuple[float, float]:
    """Share and length of ``share exp(-d / length)``, by least squares over the bins; no shorter than one pitch."""
    if not len(distance_mm):
        return 0.0, float("nan")
    lengths = np.geomspace(float(distance_mm[0]), LONGEST_MM, _LENGTHS)
    shape = np.exp(-distance_mm[None, :] / lengths[:, None])
    share = np.clip((shape * pairs) @ correlation / ((shape**2) @ pairs), 0.0, 1.0)
    misfit = ((correlation - share[:, None] * shape) ** 2) @ pairs
    best = int(np.argmin(misfit))
    return float(share[best]), float(lengths[best])


def _inflation(runs: Sequence[_Run], square: float) -> float:
    """Variance of a cell's mean over that of as many independent readings, at least 1.

    Products between frames n apart are seen in a share 1 - n / `RUN_FRAMES` of a run; the others are made up for.
    """
    more = 0.0
    for run in runs:
        frames = len(run.whole)
        place = (run.cell + np.arange(frames)[:, None] * run.cells).ravel()
        sums = [
            np.bincount(place, error.ravel(), frames * run.cells).reshape(frames, -1)
            for error in (run.whole, run.others)
        ]
        between = sums[0] @ sums[1].T
        apart = np.abs(np.subtract.outer(np.arange(frames), np.arange(frames)))
        more += float((between * (frames / (frames - apart))).sum() - np.einsum("fk,fk->", run.whole, run.others))
    return max(1.0, 1.0 + more / square)
