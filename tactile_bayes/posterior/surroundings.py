"""Whether what a window's rim hints at stands out on the map around it."""

from __future__ import annotations

import numpy as np

from tactile_bayes.geometry import FloatArray
from tactile_bayes.mapping.tactile_map import TactileMap
from tactile_bayes.posterior.cells import SMOOTHING_MM, smoothed_excess
from tactile_bayes.posterior.scene import Extra
from tactile_bayes.records import dataclass

CLEAR_IN_WIDTHS = 2.0
"""Cells nearer to the bump than this many of its widths say nothing of what lies beside it."""
STRIP_MM = 0.5
LEAST_CELLS = 4.0
"""Of a place's weight: with less of it on the map there is nothing to see."""


@dataclass(frozen=True, slots=True, eq=False)
class Surroundings:
    """The smoothed map's excess over its level, not finite where the map has no data.

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
        """From a map."""
        return cls(tactile_map.x_mm, tactile_map.y_mm, smoothed_excess(tactile_map))

    def rise(
        self,
        extra: Extra,
        places: FloatArray,
        *,
        bump_mm: tuple[float, float],
        bump_width_mm: float,
        amplitude: float,
        middle: tuple[float, float],
    ) -> FloatArray:
        """(g,) mean excess under second lumps or ribs, the bump taken off; -inf where the map does not show the place.

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
        weigh = self._under_lumps if extra == "second lump" else self._under_ribs
        number, total = weigh(places, np.stack([clear.astype(np.float64), excess]), middle)
        return np.where(number > LEAST_CELLS, total / np.maximum(number, 1e-300), -np.inf)

    def _under_lumps(self, places: FloatArray, values: FloatArray, _: tuple[float, float]) -> FloatArray:
        """(2, g) sums of (2, ny, nx) values under round lumps: products of a profile along each axis."""
        x, y, width = places[:, 0, None], places[:, 1, None], np.exp(places[:, 2, None])
        columns = np.exp(-0.5 * ((self.x_mm - x) / width) ** 2)
        rows = np.exp(-0.5 * ((self.y_mm - y) / width) ** 2)
        return np.asarray(np.einsum("vgx,gx->vg", rows @ values, columns))

    def _under_ribs(self, places: FloatArray, values: FloatArray, middle: tuple[float, float]) -> FloatArray:
        """(2, g) sums of (2, ny, nx) values under ridges: those of one direction see the same strips of cells."""
        found, flat = np.empty((2, len(places))), values.reshape(2, -1)
        for angle in np.unique(places[:, 0]):
            these = places[:, 0] == angle
            along = np.cos(angle) * (self.x_mm - middle[0]) + np.sin(angle) * (self.y_mm[:, None] - middle[1])
            strip = np.rint((along - along.min()) / STRIP_MM).astype(np.intp).ravel()
            strips = np.stack([np.bincount(strip, one) for one in flat])
            at = along.min() + STRIP_MM * np.arange(strips.shape[1])
            near = (at - places[these, 1, None]) / np.exp(places[these, 2, None])
            found[:, these] = strips @ np.exp(-0.5 * near**2).T
        return found
