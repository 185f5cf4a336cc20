"""Check of structures at the window's rim against the map around it."""

from __future__ import annotations

import numpy as np

from tactile_bayes.geometry import FloatArray
from tactile_bayes.mapping.tactile_map import TactileMap
from tactile_bayes.posterior.correlated.scene import Neighbour
from tactile_bayes.posterior.lump.cells import SMOOTHING_MM, smoothed_excess
from tactile_bayes.records import dataclass

CLEAR_IN_WIDTHS = 2.0
"""Cells nearer to the bump than this many of its widths say nothing of what lies beside it."""
STRIP_MM = 0.5
PIECE_MM = 10.0
"""Length of the pieces of a ridge whose rises are compared."""
LEAST_CELLS, LEAST_IN_PIECE = 4.0, 1.0
"""Of a place's weight, and of a piece's: with less of it on the map there is nothing to see."""


@dataclass(frozen=True, slots=True, eq=False)
class Surroundings:
    """Smoothed map less its level, not finite where the map has no data.

    Parameters
    ----------
    x_mm : (nx,) array
    y_mm : (ny,) array
    excess : (ny, nx) array
    """

    x_mm: FloatArray
    y_mm: FloatArray
    excess: FloatArray

    @classmethod
    def of(cls, tactile_map: TactileMap) -> Surroundings:
        """Prepare from a map."""
        return cls(tactile_map.x_mm, tactile_map.y_mm, smoothed_excess(tactile_map))

    def rise(
        self,
        extra: Neighbour,
        places: FloatArray,
        *,
        bump_mm: tuple[float, float],
        bump_width_mm: float,
        amplitude: float,
        middle: tuple[float, float],
    ) -> FloatArray:
        """(g,) excess of the map, without the bump, under second lumps or ribs; -inf where the map has no data.

        Under a lump it is the mean. Along a rib it is the median over pieces of `PIECE_MM` if that is lower: a rib
        rises along its whole length, while another lump on its line lifts the mean and only a piece or two.

        A head under constant force presses less beside a lump: the map dips there and comes back to its level. In a
        window that looks like a ridge along its rim. A rib or a lump rises above the level; a dip's far side does not.

        Parameters
        ----------
        places : (g, 3) array
            As in `Scene`: ``x2, y2, w2`` or ``angle, offset, w2``; `middle` is the window's.
        """
        away = np.hypot(self.x_mm - bump_mm[0], (self.y_mm - bump_mm[1])[:, None])
        clear = np.isfinite(self.excess) & (away > CLEAR_IN_WIDTHS * bump_width_mm)
        wide = bump_width_mm**2 + SMOOTHING_MM**2
        bump = amplitude * bump_width_mm**2 / wide * np.exp(-0.5 * away**2 / wide)
        excess = np.where(clear, self.excess - bump, 0.0)
        values = np.stack([clear.astype(np.float64), excess])
        if extra == "rib":
            return self._along_ribs(places, values, middle)
        number, total = self._under_lumps(places, values)
        return _mean(number, total, LEAST_CELLS)

    def _under_lumps(self, places: FloatArray, values: FloatArray) -> FloatArray:
        """(2, g) sums of (2, ny, nx) values under round lumps: products of a profile along each axis."""
        x, y, width = places[:, 0, None], places[:, 1, None], np.exp(places[:, 2, None])
        columns = np.exp(-0.5 * ((self.x_mm - x) / width) ** 2)
        rows = np.exp(-0.5 * ((self.y_mm - y) / width) ** 2)
        return np.asarray(np.einsum("vgx,gx->vg", rows @ values, columns))

    def _along_ribs(self, places: FloatArray, values: FloatArray, middle: tuple[float, float]) -> FloatArray:
        """(g,) median excess over a ridge's pieces; ridges of one direction share strips of cells."""
        found, flat = np.empty(len(places)), values.reshape(2, -1)
        x, y = self.x_mm - middle[0], self.y_mm[:, None] - middle[1]
        for angle in np.unique(places[:, 0]):
            these = places[:, 0] == angle
            across = np.cos(angle) * x + np.sin(angle) * y
            strip = np.rint((across - across.min()) / STRIP_MM).astype(np.intp)
            piece = np.floor((np.cos(angle) * y - np.sin(angle) * x) / PIECE_MM).astype(np.intp)
            piece -= piece.min()
            pieces = int(piece.max()) + 1
            cells, size = (strip * pieces + piece).ravel(), (int(strip.max()) + 1) * pieces
            sums = np.stack([np.bincount(cells, one, minlength=size) for one in flat]).reshape(2, -1, pieces)
            at = across.min() + STRIP_MM * np.arange(sums.shape[1])
            near = (at - places[these, 1, None]) / np.exp(places[these, 2, None])
            number, total = np.exp(-0.5 * near**2) @ sums
            mean = _mean(number.sum(axis=1), total.sum(axis=1), LEAST_CELLS)
            found[these] = np.minimum(mean, _median_piece(number, total))
        return found


def _mean(number: FloatArray, total: FloatArray, least: float) -> FloatArray:
    """Weighted means; -inf where the weight is too small."""
    return np.where(number > least, total / np.maximum(number, 1e-300), -np.inf)


def _median_piece(number: FloatArray, total: FloatArray) -> FloatArray:
    """(g,) lower median over (g, pieces) means where the map has data; inf where it has none."""
    shown = number > LEAST_IN_PIECE
    ordered = np.sort(np.where(shown, _mean(number, total, LEAST_IN_PIECE), np.inf), axis=1)
    middle = np.maximum(shown.sum(axis=1) - 1, 0) // 2
    return np.take_along_axis(ordered, middle[:, None], axis=1)[:, 0]
