"""Whether what a window's rim hints at stands out on the map around it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tactile_bayes.geometry import FloatArray
from tactile_bayes.mapping.tactile_map import TactileMap
from tactile_bayes.posterior.cells import SMOOTHING_MM, smoothed_excess
from tactile_bayes.posterior.scene import Extra

CLEAR_IN_WIDTHS = 2.0
"""Cells nearer to the bump than this many of its widths say nothing of what lies beside it."""


@dataclass(frozen=True, slots=True, eq=False)
class Surroundings:
    """The smoothed map's excess over its level, everywhere the map has data.

    Parameters
    ----------
    x_mm, y_mm, excess : (k,) arrays
    """

    x_mm: FloatArray
    y_mm: FloatArray
    excess: FloatArray

    @classmethod
    def of(cls, tactile_map: TactileMap) -> Surroundings:
        """From a map."""
        excess = smoothed_excess(tactile_map)
        row, column = np.nonzero(np.isfinite(excess))
        return cls(tactile_map.x_mm[column], tactile_map.y_mm[row], excess[row, column])

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
        away = np.hypot(self.x_mm - bump_mm[0], self.y_mm - bump_mm[1])
        clear = away > CLEAR_IN_WIDTHS * bump_width_mm
        x, y = self.x_mm[clear], self.y_mm[clear]
        wide = bump_width_mm**2 + SMOOTHING_MM**2
        bump = amplitude * bump_width_mm**2 / wide * np.exp(-0.5 * away[clear] ** 2 / wide)
        excess = self.excess[clear] - bump
        one, two, width = places[:, 0, None], places[:, 1, None], np.exp(places[:, 2, None])
        if extra == "second lump":
            square = (x - one) ** 2 + (y - two) ** 2
        else:
            square = (np.cos(one) * (x - middle[0]) + np.sin(one) * (y - middle[1]) - two) ** 2
        weight = np.exp(-0.5 * square / width**2)
        total = weight.sum(axis=1)
        return np.where(total > 4.0, weight @ excess / np.maximum(total, 1e-300), -np.inf)
