"""Normalise the frames and average them in cells (paper steps ii and iii)."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tactile_bayes.geometry import FloatArray
from tactile_bayes.mapping.cells import CellSums
from tactile_bayes.mapping.engine import Engine
from tactile_bayes.mapping.frames import SelectedFrames, chunks
from tactile_bayes.mapping.project import Projection, Projector
from tactile_bayes.mapping.readout import Readout
from tactile_bayes.scan import CountArray

GAIN_TOLERANCE = 1e-4

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
        """Whether the gains stopped changing."""
        return self.last_change <= GAIN_TOLERANCE


@dataclass(frozen=True, slots=True, eq=False)
class Source:
    """One scan's used frames, ready to be read chunk by chunk any number of times.

    Parameters
    ----------
    selection, readout
        The scan with its used frames, and the taxels that are read.
    projection
        Of the used frames only, in their order.
    """

    selection: SelectedFrames
    readout: Readout
    projection: Projection

    @classmethod
    def of(cls, selection: SelectedFrames, *, plane_from_base: FloatArray, cell_mm: float) -> Source:
        """Project the used frames of a scan."""
        good = selection.good_taxels
        projector = Projector(selection.scan.head, plane_from_base=plane_from_base, taxels=good, cell_mm=cell_mm)
        projection = projector.at(selection.poses.part(selection.used))
        return cls(selection, Readout.of(selection.scan.element_calibration, good), projection)

    @property
    def frames(self) -> NDArray[np.intp]:
        """Indices of the used frames in the scan."""
        return np.flatnonzero(self.selection.used)

    def parts(self, size: int) -> Iterator[tuple[slice, CountArray]]:
        """Stretches of at most `size` used frames, and their (f, k) counts."""
        frames, counts = self.frames, self.selection.scan.frames.counts
        for part in chunks(len(frames), size):
            chosen = frames[part]
            whole = chosen[-1] - chosen[0] == len(chosen) - 1  # a stretch without gaps need not be copied
            yield part, self.readout.counts(counts[chosen[0] : chosen[-1] + 1] if whole else counts[chosen])


def sources_of(selections: list[SelectedFrames], *, plane_from_base: FloatArray, cell_mm: float) -> list[Source]:
    """The scans on one lattice."""
    return [Source.of(part, plane_from_base=plane_from_base, cell_mm=cell_mm) for part in selections]


def accumulate(
    sources: list[Source],
    *,
    cell_mm: float,
    normalise: str,
    engine: Engine,
    progress: Progress = no_progress,
) -> Accumulated:
    """Average the normalised readings of all used frames in cells on the plane.

    Parameters
    ----------
    normalise
        ``"mean"`` divides each frame by its mean over the valid taxels, as the paper does. A lump under the head is
        in that mean, so the map's amplitude and widths come out low by a few per cent. ``"gain"`` solves for one gain
        a frame jointly with the map. ``"none"`` keeps kPa.
    engine
        Which inner loops to use.
    progress
        Called with the frames done and the frames in all, anew in each pass.
    """
    levels = [source.selection.level_kpa[source.selection.used] for source in sources]
    if normalise == "none":
        levels = [np.ones(len(level)) for level in levels]
    if normalise != "gain":
        return Accumulated(add_all(sources, levels, cell_mm=cell_mm, engine=engine, progress=progress), levels)
    from tactile_bayes.mapping.gains import solve_gains

    solved = solve_gains(sources, levels, tolerance=GAIN_TOLERANCE, progress=progress)
    sums = add_all(sources, solved.gains, cell_mm=cell_mm, engine=engine, progress=progress)
    return Accumulated(sums, solved.gains, float(np.nanmedian(sums.mean())), solved.passes, solved.last_change)


def add_all(
    sources: list[Source],
    levels: list[FloatArray],
    *,
    cell_mm: float,
    engine: Engine,
    progress: Progress = no_progress,
) -> CellSums:
    """One pass over all used frames, each divided by its level."""
    sums = CellSums(cell_mm)
    done, total = 0, sum(len(source.projection) for source in sources)
    for source, level in zip(sources, levels, strict=True):
        for part, counts in source.parts(engine.chunk_frames(source.readout.size)):
            engine.add(sums, source.readout, counts, projection=source.projection.part(part), level=level[part])
            done += len(counts)
            progress(done, total)
    return sums
