"""Largest cell that measures the map's highest bump well, and what finer cells would cost."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from tactile_bayes.geometry import FloatArray
from tactile_bayes.mapping.smoothing import smooth
from tactile_bayes.mapping.tactile_map import TactileMap

_FWHM = 2.3548  # of a Gaussian, in sigmas
# Cells of up to this many sigmas moved no width by more than one posterior SD (record 0074).
_CELL_PER_SIGMA = 0.5
_SMOOTHED_CELLS = 2.0  # variance that `smooth` adds, in cells squared
# A peak lower than this many times the spread of the smoothed map (by its quartiles) is no bump to take a width from.
_LEAST_RISE = 4.0


@dataclass(frozen=True, slots=True)
class CellAdvice:
    """Advice on the size of the cells.

    Parameters
    ----------
    sigma_mm
        Width of the narrower side of the map's highest bump, from its half height.
    coarsest_mm
        Largest cell that leaves its widths within one posterior SD of those by cells of 1 mm.
    cell_mm
        The map's own.
    readings
        Median readings a cell.
    """

    sigma_mm: float
    coarsest_mm: float
    cell_mm: float
    readings: float

    def text(self) -> str:
        """One line: which cells measure the bump, and what cells of half the present size would cost."""
        half = self.cell_mm / 2
        head = f"bump of sigma {self.sigma_mm:.1f} mm: measured well by cells of up to {self.coarsest_mm:.1f} mm"
        if self.cell_mm > self.coarsest_mm:
            return f"{head}, these are too coarse; use --cell-mm {math.floor(10 * self.coarsest_mm) / 10:g}"
        return f"{head}; {half:g} mm would take 4 times the cells with {self.readings / 4:.0f} readings each"


def advise_cell(tactile_map: TactileMap) -> CellAdvice | None:
    """Advise on the cell from a map's highest bump; None where nothing stands out.

    Notes
    -----
    The rule is h <= 0.5 sigma_min, by what the widths of simulated bodies change with the cell (record 0074). For a
    Gaussian bump the fit, which integrates its model over the cells, is exact to 0.1 % at 0.75 sigma; but lumps are not
    quite Gaussian, and errors of the map change with the cell as well.
    """
    mean = _smoothed(tactile_map)
    known = np.isfinite(mean)
    if np.count_nonzero(known) < 25:
        return None
    low, level, high = np.quantile(mean[known], [0.25, 0.5, 0.75])
    row, column = np.unravel_index(int(np.nanargmax(mean)), mean.shape)
    rise = float(mean[row, column] - level)
    if not rise > _LEAST_RISE * float(high - low) / 2:
        return None
    extents = [_extent(line - level, at) for line, at in ((mean[row], int(column)), (mean[:, column], int(row)))]
    if not all(np.isfinite(extents)):
        return None
    cell = tactile_map.recipe.cell_mm
    variances = [(extent * cell / _FWHM) ** 2 - _SMOOTHED_CELLS * cell**2 - cell**2 / 12 for extent in extents]
    sigma = float(np.sqrt(max(min(variances), (cell / 2) ** 2)))
    count = tactile_map.count[tactile_map.covered]
    return CellAdvice(sigma, _CELL_PER_SIGMA * sigma, cell, float(np.median(count)))


def _smoothed(tactile_map: TactileMap) -> FloatArray:
    """The map, smoothed with its counts as weights; NaN where readings are few."""
    count = np.where(tactile_map.covered, tactile_map.count, 0).astype(np.float64)
    weight = smooth(count)
    total = smooth(np.where(tactile_map.covered, tactile_map.mean, 0.0) * count)
    enough = tactile_map.covered & ~tactile_map.few
    mean: FloatArray = np.divide(total, weight, out=np.full(weight.shape, np.nan), where=enough & (weight > 0))
    return mean


def _extent(excess: FloatArray, at: int) -> float:
    """Full width at half height about an index, in cells, by linear interpolation; NaN where it reaches the rim."""
    half = excess[at] / 2
    width = 0.0
    for way in (1, -1):
        i = at
        while 0 <= i + way < len(excess) and excess[i + way] > half:
            i += way
        if not 0 <= i + way < len(excess) or not np.isfinite(excess[i + way]):
            return float("nan")
        width += abs(i - at) + float((excess[i] - half) / (excess[i] - excess[i + way]))
    return width
