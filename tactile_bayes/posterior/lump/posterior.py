"""Joint posterior draws, the result of every method and noise model."""

from __future__ import annotations

import numpy as np

from tactile_bayes.geometry import FloatArray
from tactile_bayes.records import dataclass


@dataclass(frozen=True, slots=True, eq=False)
class MapPosterior:
    """Joint draws of the quantities in Eq 7, each (chain, draw).

    Parameters
    ----------
    oblique
        Mean and SD of r, the half log axis ratio 45 degrees from the map's x axis, where the draws have none and it was
        measured beside them; None otherwise.
    irregular
        Whether the bump is less regular than a ball's, see `correlated.outline`.
    """

    amplitude: FloatArray
    sigma_x_mm: FloatArray
    sigma_y_mm: FloatArray
    x_mm: FloatArray
    y_mm: FloatArray
    angle_rad: FloatArray
    background: FloatArray
    noise_sd: FloatArray
    oblique: tuple[float, float] | None = None
    irregular: bool = False

    @property
    def medians(self) -> tuple[float, float, float]:
        """Posterior medians of amplitude, sigma_x_mm and sigma_y_mm."""
        amplitude, x, y = (float(np.median(v)) for v in (self.amplitude, self.sigma_x_mm, self.sigma_y_mm))
        return amplitude, x, y
