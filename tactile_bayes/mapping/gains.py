"""Gains per frame, solved jointly with the map: dividing by the mean would lower the lump."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tactile_bayes.geometry import FloatArray
from tactile_bayes.mapping.source import Progress, Source, no_progress

MAX_GAIN_PASSES = 50
# Cells of this many readings are kept between passes (4 bytes each); beyond, they are found anew in every pass.
KEPT_READINGS = 2**26
_CHUNK = 128

# Of pressures (f, k), which are valid, and the frames they are of: what is added up.
_Weight = Callable[[FloatArray, "NDArray[np.bool_] | None", slice], "NDArray[np.generic]"]


@dataclass(frozen=True, slots=True, eq=False)
class SolvedGains:
    """Gains of the used frames, one array per scan, and the course of the solution."""

    gains: list[FloatArray]
    passes: int
    last_change: float


def solve_gains(
    sources: list[Source], levels: list[FloatArray], *, tolerance: float, progress: Progress = no_progress
) -> SolvedGains:
    """Alternate between the map, given the gains, and each frame's least-squares gain, given the map.

    The model is pressure = gain of the frame x map at the cell. Only the product is determined: the level is set in
    the end so that the median of the map's cells is 1, since most cells lie beside the lump.

    Notes
    -----
    Frames far apart are tied only through those between them, so plain alternation creeps. Every third step goes
    further along the direction of the last two (SQUAREM, Varadhan & Roland 2008, Scand. J. Statist. 35, scheme S3),
    on the logarithms of the gains.
    """
    system = _System(sources, progress)
    ends = np.cumsum([len(level) for level in levels])[:-1]
    path = [np.log(np.concatenate(levels))]
    passes, change = 0, np.inf
    while change > tolerance and passes < MAX_GAIN_PASSES:
        path.append(np.log(system.improved(np.exp(path[-1]))))
        change = float(np.abs(path[-1] - path[-2]).max(initial=0.0))
        passes += 1
        if len(path) == 3 and change > tolerance:
            path = [_extrapolated(*path)]
    return SolvedGains(np.split(np.exp(path[-1]), ends), passes, change)


def _extrapolated(start: FloatArray, first: FloatArray, second: FloatArray) -> FloatArray:
    """Limit of the steps from `start` over `first` to `second`, by extrapolation."""
    step = first - start
    bend = second - first - step
    size = float(np.linalg.norm(bend))
    if not size > 0:
        return second
    length = max(1.0, float(np.linalg.norm(step)) / size)
    return start + 2 * length * step + length**2 * bend


class _System:
    """All used frames of all scans on one block of cells."""

    def __init__(self, sources: list[Source], progress: Progress) -> None:
        self._sources, self._progress = sources, progress
        blocks = [source.projection.block() for source in sources if len(source.projection)]
        self._first = (min(first[0] for first, _ in blocks), min(first[1] for first, _ in blocks))
        self._shape = (
            max(first[0] + shape[0] for first, shape in blocks) - self._first[0],
            max(first[1] + shape[1] for first, shape in blocks) - self._first[1],
        )
        readings = sum(len(source.projection) * len(source.readout.taxels) for source in sources)
        self._kept: dict[tuple[int, int], NDArray[np.int32]] | None = {} if readings <= KEPT_READINGS else None
        self._count = self._sum(lambda pressure, valid, _: np.ones_like(pressure) if valid is None else valid)

    def improved(self, gains: FloatArray) -> FloatArray:
        """Least-squares gain of each frame against the map of all frames with `gains`: sum(p m) / sum(m^2)."""
        total = self._sum(lambda pressure, _, frames: pressure / gains[frames, None])
        mean = np.divide(total, self._count, out=np.zeros_like(total), where=self._count > 0)
        better = np.empty(len(gains))
        for frames, flat, pressure, valid in self._parts():
            expected = mean[flat]
            if valid is not None:
                expected *= valid
            products = np.einsum("fk,fk->f", pressure, expected)
            better[frames] = products / np.einsum("fk,fk->f", expected, expected)
        return better

    def _sum(self, weight: _Weight) -> FloatArray:
        """Sum of a weight over all readings of each cell."""
        cells = self._shape[0] * self._shape[1]
        total = np.zeros(cells)
        for frames, flat, pressure, valid in self._parts():
            total += np.bincount(flat.ravel(), weight(pressure, valid, frames).ravel(), cells)
        return total

    def _parts(self) -> Iterator[tuple[slice, NDArray[np.integer], FloatArray, NDArray[np.bool_] | None]]:
        """Chunks: frames' indices, their cells, pressures (0 where not valid) and which are valid."""
        start, total = 0, sum(len(source.projection) for source in self._sources)
        for number, source in enumerate(self._sources):
            for part, counts in source.parts(_CHUNK):
                pressure, valid = source.readout.pressure_kpa(counts)
                if valid is not None:
                    pressure *= valid
                yield slice(start, start + len(counts)), self._flat(number, part), pressure, valid
                start += len(counts)
                self._progress(start, total)

    def _flat(self, number: int, part: slice) -> NDArray[np.integer]:
        if self._kept is not None and (number, part.start) in self._kept:
            return self._kept[number, part.start]
        flat = self._sources[number].projection.part(part).flat(self._first, self._shape)
        if self._kept is not None:
            self._kept[number, part.start] = flat.astype(np.int32)
        return flat
