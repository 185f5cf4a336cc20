"""Draws of one map's amplitude and shape, as sizes are made from them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from tactile_bayes.geometry import FloatArray
from tactile_bayes.inference.draws import Labels, even_replicates, picked_rows
from tactile_bayes.records import dataclass


@dataclass(frozen=True, slots=True, eq=False)
class ShapeDraws:
    """Joint draws of one map's amplitude and shape, each (n,).

    Parameters
    ----------
    log_amplitude, log_width
        ln a, and p, the log of the geometric mean width in mm.
    q, r
        Half log axis ratio along the map's x axis and 45 degrees from it.
    turn_rad
        From the axes that the maps of a mass share to this map's.
    oblique
        Mean and SD of r where the draws have none, as `MapPosterior`'s.
    irregular
        Whether the map is that of an irregular lump.
    profile
        `presets.HEAD_PROFILE` of the map; None where it has none.
    labels
        Of the draws' independent replicates, as `ParameterDraws.labels`.
    """

    log_amplitude: FloatArray
    log_width: FloatArray
    q: FloatArray
    r: FloatArray
    turn_rad: float = 0.0
    profile: tuple[float, ...] | None = None
    labels: Labels | None = None
    oblique: tuple[float, float] | None = None
    irregular: bool = False

    @property
    def replicates(self) -> Labels:
        """(n,) label of the independent replicate of each draw."""
        return even_replicates(len(self.q)) if self.labels is None else self.labels

    @property
    def order(self) -> tuple[float, ...]:
        """Sort key of maps before pooling."""
        return tuple(float(np.nansum(v)) for v in (self.log_width, self.log_amplitude, self.q, self.r))

    @classmethod
    def of(
        cls,
        amplitude: FloatArray,
        sigma_x_mm: FloatArray,
        sigma_y_mm: FloatArray,
        angle_rad: FloatArray,
        *,
        turn_rad: float = 0.0,
        profile: tuple[float, ...] | None = None,
        labels: Labels | None = None,
        oblique: tuple[float, float] | None = None,
        irregular: bool = False,
    ) -> ShapeDraws:
        """Prepare from draws of Eq 7 of any shape; a draw without a rise becomes NaN."""
        with np.errstate(invalid="ignore", divide="ignore"):
            log_a = np.log(np.where(amplitude > 0, amplitude, np.nan)).ravel()
        half = 0.5 * np.log(sigma_x_mm / sigma_y_mm).ravel()
        angle = angle_rad.ravel()
        p = 0.5 * np.log(sigma_x_mm * sigma_y_mm).ravel()
        q, r = half * np.cos(2 * angle), half * np.sin(2 * angle)
        return cls(log_a, p, q, r, turn_rad, profile, labels, oblique, irregular)

    @property
    def middle(self) -> tuple[float, float]:
        """Medians of the amplitude and of the geometric mean width, mm."""
        amplitude, sigma_mm = (float(np.exp(np.nanmedian(v))) for v in (self.log_amplitude, self.log_width))
        return amplitude, sigma_mm

    def rows(self, index: Labels) -> ShapeDraws:
        """Subset of the draws, treated as independent."""
        drawn = {name: getattr(self, name)[index] for name in ("log_amplitude", "log_width", "q", "r")}
        return replace(self, **drawn, labels=None)


def matched_draws(
    maps: Sequence[ShapeDraws], number: int | None, rng: np.random.Generator
) -> tuple[Sequence[ShapeDraws], Labels]:
    """As many draws of each map, matched by replicate, with their labels; one map's own where no number is given."""
    if number is None and len(maps) == 1:
        return maps, maps[0].replicates
    replicates = even_replicates(len(maps[0].q) if number is None else number)
    return [m.rows(picked_rows(m.replicates, replicates, rng)) for m in maps], replicates
