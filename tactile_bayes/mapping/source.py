"""Used frames of a scan on the map's lattice, which can be read any number of times."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tactile_bayes.geometry import FloatArray
from tactile_bayes.mapping.frames import SelectedFrames, chunks
from tactile_bayes.mapping.project import Projection, Projector
from tactile_bayes.mapping.readout import Readout
from tactile_bayes.scan import CountArray

Progress = Callable[[int, int], None]


def no_progress(done: int, total: int) -> None:
    """Report no progress."""


@dataclass(frozen=True, slots=True, eq=False)
class Source:
    """Used frames of one scan, which can be read chunk by chunk any number of times.

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
        """Iterate over stretches of at most `size` used frames and their (f, k) counts."""
        frames, counts = self.frames, self.selection.scan.frames.counts
        for part in chunks(len(frames), size):
            chosen = frames[part]
            whole = chosen[-1] - chosen[0] == len(chosen) - 1  # a stretch without gaps need not be copied
            yield part, self.readout.counts(counts[chosen[0] : chosen[-1] + 1] if whole else counts[chosen])


def sources_of(selections: list[SelectedFrames], *, plane_from_base: FloatArray, cell_mm: float) -> list[Source]:
    """Put the scans on one lattice."""
    return [Source.of(part, plane_from_base=plane_from_base, cell_mm=cell_mm) for part in selections]
