"""Normalise the frames and average them in cells (paper steps ii and iii)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from tactile_bayes.geometry import FloatArray
from tactile_bayes.mapping.cells import CellSums, IntArray, cell_index
from tactile_bayes.mapping.frames import SelectedFrames, chunks
from tactile_bayes.mapping.project import Projection, project

GAIN_TOLERANCE = 1e-4
MAX_GAIN_PASSES = 50


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
    selections: list[SelectedFrames], *, plane_from_base: FloatArray, cell_mm: float, normalise: str
) -> Accumulated:
    """Average the normalised readings of all used frames in cells on the plane.

    Parameters
    ----------
    normalise
        ``"mean"`` divides each frame by its mean over the valid taxels, as the paper does. A lump under the head is
        in that mean, so the map's amplitude and widths come out low by a few per cent. ``"gain"`` solves for one gain
        a frame jointly with the map. ``"none"`` keeps kPa.
    """
    sources = [
        _Source(
            part,
            project(part.scan.head, part.poses, plane_from_base=plane_from_base, taxels=part.good_taxels),
        )
        for part in selections
    ]
    if normalise == "none":
        return Accumulated(_one_pass(sources, [np.ones(len(part.used)) for part in selections], cell_mm))
    means = [part.level_kpa for part in selections]
    if normalise == "mean":
        return Accumulated(_one_pass(sources, means, cell_mm))
    return _solve_gains(sources, means, cell_mm)


def _one_pass(sources: list[_Source], gains: list[FloatArray], cell_mm: float) -> CellSums:
    sums = CellSums(cell_mm)
    for source, gain in zip(sources, gains, strict=True):
        for frames, pressure, row, column in source.readings(cell_mm):
            _add_valid(sums, row, column, pressure / gain[frames, None])
    return sums


def _add_valid(sums: CellSums, row: IntArray, column: IntArray, value: FloatArray) -> None:
    valid = np.isfinite(value)
    if valid.all():
        sums.add_cells(row, column, value)
    elif valid.any():
        sums.add_cells(row[valid], column[valid], value[valid])


def _solve_gains(sources: list[_Source], gains: list[FloatArray], cell_mm: float) -> Accumulated:
    """Alternate between the map, given the gains, and each frame's least-squares gain, given the map.

    The model is pressure = gain of the frame x map at the cell. Only the product is determined: the level is set in
    the end so that the median of the map's cells is 1, since most cells lie beside the lump.
    """
    sums = _one_pass(sources, gains, cell_mm)
    change = np.inf
    passes = 1
    while change > GAIN_TOLERANCE and passes < MAX_GAIN_PASSES:
        previous, gains = gains, [_gains(source, sums, len(old)) for source, old in zip(sources, gains, strict=True)]
        sums = _one_pass(sources, gains, cell_mm)
        change = max(_change(source, old, new) for source, old, new in zip(sources, previous, gains, strict=True))
        passes += 1
    return Accumulated(sums, float(np.nanmedian(sums.mean())), passes, float(change))


def _gains(source: _Source, sums: CellSums, length: int) -> FloatArray:
    """Least-squares gain of each frame against the map's mean: sum(p m) / sum(m^2) over its valid readings."""
    mean, gain = sums.mean(), np.ones(length)
    for frames, pressure, row, column in source.readings(sums.cell_mm):
        expected = mean[row - sums.first[0], column - sums.first[1]]
        expected = np.where(np.isfinite(pressure), expected, 0.0)
        measured = np.where(np.isfinite(pressure), pressure, 0.0)
        gain[frames] = (measured * expected).sum(axis=1) / (expected * expected).sum(axis=1)
    return gain


def _change(source: _Source, old: FloatArray, new: FloatArray) -> float:
    used = source.selection.used
    return float(np.abs(new[used] / old[used] - 1.0).max(initial=0.0))
