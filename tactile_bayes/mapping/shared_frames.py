"""Correlation of the errors within a frame: readings share frames, so a map holds less than they would alone.

The figures are of the readings about the map, so whatever neighbours share is in them: the frame's level, the pose, the
slope within a cell, a response that the calibration left.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tactile_bayes.geometry import FloatArray
from tactile_bayes.mapping.cells import VALUE_STEP, CellSums
from tactile_bayes.mapping.source import Source
from tactile_bayes.mapping.tactile_map import FEW_READINGS

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
    """Figures of the error correlation within a frame, from at most `RUNS` x `RUN_FRAMES` frames.

    Parameters
    ----------
    sources, levels
        The used frames, and what each was divided by.
    sums
        The map that all of them made.

    Returns
    -------
    dict
        ``shared_share``: share of a reading's error variance that is common to the neighbours in its frame.
        ``shared_length_mm``: over which distance it falls by e; only where the share is above `LEAST_SHARE`.
        ``effective_readings``: independent readings that the median cell's are worth, by what readings of one cell
        within `RUN_FRAMES` successive frames have in common. ``shared_frames``: frames looked at. Empty where
        that is undetermined: too few frames, or readings without any scatter.

    Notes
    -----
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


@dataclass(frozen=True, slots=True, eq=False)
class _Run:
    """Errors of one run of frames; (f, k) arrays, 0 where not known.

    Parameters
    ----------
    source
        Which of the sources.
    cell, cells
        Where each reading lies in the block of cells that the run covers, and how many those are.
    whole, others
        Errors about the map, and about the map without this run.
    known
        Valid readings in cells that enough readings of other frames fell into.
    """

    source: Source
    cell: NDArray[np.int64]
    cells: int
    whole: FloatArray
    others: FloatArray
    known: NDArray[np.bool_]

    @classmethod
    def of(cls, source: Source, level: FloatArray, sums: CellSums, run: slice) -> _Run:
        """The errors of the frames `run` of a source."""
        counts = source.selection.scan.frames.counts[source.frames[run]]
        pressure, valid = source.readout.pressure_kpa(source.readout.counts(counts))
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
        distance = _distances(source)
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


def _distances(source: Source) -> FloatArray:
    """(k, k) distances between the taxels read, mm."""
    place = source.projection.taxels.place_mm
    square = sum((axis[:, None] - axis[None, :]) ** 2 for axis in place)
    distance: FloatArray = np.sqrt(square)
    return distance


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
