"""Normalise the frames and average them in cells (paper steps ii and iii)."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from tactile_bayes.geometry import FloatArray
from tactile_bayes.mapping.cells import CellSums, IntArray, cell_index
from tactile_bayes.mapping.frames import SelectedFrames, chunks
from tactile_bayes.mapping.project import Projection, project

GAIN_TOLERANCE = 1e-4
MAX_GAIN_PASSES = 50

Progress = Callable[[int, int], None]


def no_progress(done: int, total: int) -> None:
    """Tell nobody."""


@dataclass(frozen=True, slots=True, eq=False)
class Accumulated:
    """Sums over all frames, and how the frames' gains were found.

    Parameters
    ----------
    sums
        The cells.
    scale
        What the sums' values must be divided by (1 but for ``gain``, whose level is set afterwards).
    passes
        Passes over the scan.
    last_change
        Largest relative change of a frame's gain in the last pass; 0 unless the gains are solved for.
    """

    sums: CellSums
    scale: float = 1.0
    passes: int = 1
    last_change: float = 0.0

    @property
    def settled(self) -> bool:
        """Whether the gains stopped changing."""
        return self.last_change <= GAIN_TOLERANCE


@dataclass(frozen=True, slots=True, eq=False)
class _Source:
    """One scan's used frames, ready to be read chunk by chunk any number of times."""

    selection: SelectedFrames
    projection: Projection

    def readings(self, cell_mm: float) -> Iterator[tuple[IntArray, FloatArray, IntArray, IntArray]]:
        """Frame indices (f,), pressures (f, k; NaN where saturated), rows and columns of the cells (f, k)."""
        good = self.selection.good_taxels
        for part in chunks(self.selection.scan):
            frames = part.start + np.flatnonzero(self.selection.used[part])
            if not len(frames):
                continue
            pressure = self.selection.scan.pressure_kpa(part.start, part.stop)[frames - part.start][:, good]
            x, y = self.projection.xy(frames)
            yield frames, pressure, cell_index(y, cell_mm), cell_index(x, cell_mm)


def accumulate(
    selections: list[SelectedFrames],
    *,
    plane_from_base: FloatArray,
    cell_mm: float,
    normalise: str,
    progress: Progress = no_progress,
) -> Accumulated:
    """Average the normalised readings of all used frames in cells on the plane.

    Parameters
    ----------
    normalise
        ``"mean"`` divides each frame by its mean over the valid taxels, as the paper does. A lump under the head is
        in that mean, so the map's amplitude and widths come out low by a few per cent. ``"gain"`` solves for one gain
        a frame jointly with the map. ``"none"`` keeps kPa.
    progress
        Called with the frames done and the frames in all, anew in each pass.
    """
    sources = [
        _Source(part, project(part.scan.head, part.poses, plane_from_base=plane_from_base, taxels=part.good_taxels))
        for part in selections
    ]
    if normalise == "none":
        return Accumulated(_one_pass(sources, [np.ones(len(part.used)) for part in selections], cell_mm, progress))
    means = [part.level_kpa for part in selections]
    if normalise == "mean":
        return Accumulated(_one_pass(sources, means, cell_mm, progress))
    return _solve_gains(sources, means, cell_mm, progress)


def _one_pass(sources: list[_Source], gains: list[FloatArray], cell_mm: float, progress: Progress) -> CellSums:
    sums = CellSums(cell_mm)
    done, total = 0, sum(int(source.selection.used.sum()) for source in sources)
    for source, gain in zip(sources, gains, strict=True):
        for frames, pressure, row, column in source.readings(cell_mm):
            _add_valid(sums, row, column, pressure / gain[frames, None])
            done += len(frames)
            progress(done, total)
    return sums


def _add_valid(sums: CellSums, row: IntArray, column: IntArray, value: FloatArray) -> None:
    valid = np.isfinite(value)
    if valid.all():
        sums.add_cells(row, column, value)
    elif valid.any():
        sums.add_cells(row[valid], column[valid], value[valid])


def _solve_gains(sources: list[_Source], gains: list[FloatArray], cell_mm: float, progress: Progress) -> Accumulated:
    """Alternate between the map, given the gains, and each frame's least-squares gain, given the map.

    The model is pressure = gain of the frame x map at the cell. Only the product is determined: the level is set in
    the end so that the median of the map's cells is 1, since most cells lie beside the lump.

    Notes
    -----
    Frames far apart are tied only through those between them, so plain alternation creeps. Every third step goes
    further along the direction of the last two (SQUAREM, Varadhan & Roland 2008, Scand. J. Statist. 35, scheme S3),
    on the logarithms of the gains.
    """
    path = [_joined(sources, gains)]
    passes, change = 0, np.inf
    while change > GAIN_TOLERANCE and passes < MAX_GAIN_PASSES:
        sums = _one_pass(sources, _parted(sources, path[-1]), cell_mm, progress)
        path.append(_joined(sources, [_gains(source, sums) for source in sources]))
        change = float(np.abs(path[-1] - path[-2]).max(initial=0.0))
        passes += 1
        if len(path) == 3:
            path = [_extrapolated(*path)]
    return Accumulated(sums, float(np.nanmedian(sums.mean())), passes, change)


def _joined(sources: list[_Source], gains: list[FloatArray]) -> FloatArray:
    """Logarithms of the used frames' gains, all scans in one array."""
    return np.concatenate([np.log(gain[part.selection.used]) for part, gain in zip(sources, gains, strict=True)])


def _parted(sources: list[_Source], logarithms: FloatArray) -> list[FloatArray]:
    """Back to one array a scan, 1 for frames that are not used."""
    ends = np.cumsum([int(source.selection.used.sum()) for source in sources])[:-1]
    gains = []
    for source, part in zip(sources, np.split(logarithms, ends), strict=True):
        gain = np.ones(len(source.selection.used))
        gain[source.selection.used] = np.exp(part)
        gains.append(gain)
    return gains


def _extrapolated(start: FloatArray, first: FloatArray, second: FloatArray) -> FloatArray:
    """Where the steps from `start` over `first` to `second` lead to."""
    step = first - start
    bend = second - first - step
    size = float(np.linalg.norm(bend))
    if not size > 0:
        return second
    length = max(1.0, float(np.linalg.norm(step)) / size)
    return start + 2 * length * step + length**2 * bend


def _gains(source: _Source, sums: CellSums) -> FloatArray:
    """Least-squares gain of each frame against the map's mean: sum(p m) / sum(m^2) over its valid readings."""
    mean, gain = sums.mean(), np.ones(len(source.selection.used))
    for frames, pressure, row, column in source.readings(sums.cell_mm):
        valid = np.isfinite(pressure)  # cells that only saturated readings hit may lie outside the sums
        expected, measured = np.zeros(pressure.shape), np.where(valid, pressure, 0.0)
        expected[valid] = mean[row[valid] - sums.first[0], column[valid] - sums.first[1]]
        gain[frames] = (measured * expected).sum(axis=1) / (expected * expected).sum(axis=1)
    return gain
