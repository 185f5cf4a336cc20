"""Normalise the frames and average them in cells (paper steps ii and iii)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tactile_bayes.geometry import FloatArray
from tactile_bayes.mapping.cells import CellSums
from tactile_bayes.mapping.scatter import add_frames, chunk_frames
from tactile_bayes.mapping.source import Progress, Source, no_progress

GAIN_TOLERANCE = 1e-4


@dataclass(frozen=True, slots=True, eq=False)
class Accumulated:
    """Sums over all frames, and how the gains were solved.

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
    levels
        What the frames were divided by, one array a scan.
    """

    sums: CellSums
    levels: list[FloatArray]
    scale: float = 1.0
    passes: int = 1
    last_change: float = 0.0

    @property
    def settled(self) -> bool:
        """Whether the gains converged."""
        return self.last_change <= GAIN_TOLERANCE


def accumulate(
    sources: list[Source],
    *,
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
    levels = [source.selection.level_kpa[source.selection.used] for source in sources]
    if normalise == "none":
        levels = [np.ones(len(level)) for level in levels]
    if normalise != "gain":
        return Accumulated(add_all(sources, levels, cell_mm=cell_mm, progress=progress), levels)
    from tactile_bayes.mapping.gains import solve_gains

    solved = solve_gains(sources, levels, tolerance=GAIN_TOLERANCE, progress=progress)
    sums = add_all(sources, solved.gains, cell_mm=cell_mm, progress=progress)
    return Accumulated(sums, solved.gains, float(np.nanmedian(sums.mean())), solved.passes, solved.last_change)


def add_all(
    sources: list[Source],
    levels: list[FloatArray],
    *,
    cell_mm: float,
    progress: Progress = no_progress,
) -> CellSums:
    """One pass over all used frames, each divided by its level."""
    sums = CellSums(cell_mm)
    done, total = 0, sum(len(source.projection) for source in sources)
    for source, level in zip(sources, levels, strict=True):
        for part, counts in source.parts(chunk_frames(source.readout.size)):
            pressure, valid = source.readout.pressure_kpa(counts)
            projection = source.projection.part(part)
            add_frames(sums, source.readout, pressure, valid, projection=projection, level=level[part])
            done += len(counts)
            progress(done, total)
    return sums
