"""The joint draws that every method and noise model ends in."""

from __future__ import annotations

from tactile_bayes.geometry import FloatArray
from tactile_bayes.records import dataclass


@dataclass(frozen=True, slots=True, eq=False)
class MapPosterior:
    """Joint draws of what Eq 7 describes, each (chain, draw)."""

    amplitude: FloatArray
    sigma_x_mm: FloatArray
    sigma_y_mm: FloatArray
    x_mm: FloatArray
    y_mm: FloatArray
    angle_rad: FloatArray
    background: FloatArray
    noise_sd: FloatArray
