"""Draws of a lump's bump, and how well they were drawn."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from tactile_bayes.declarations import Record, field
from tactile_bayes.geometry import FloatArray

# --- Joint posterior draws, the result of every method and noise model.


class MapPosterior(Record, eq=False):
    """Joint draws of the quantities in Eq 7, each (chain, draw)."""

    amplitude: FloatArray
    sigma_x_mm: FloatArray
    sigma_y_mm: FloatArray
    x_mm: FloatArray
    y_mm: FloatArray
    angle_rad: FloatArray
    background: FloatArray
    noise_sd: FloatArray
    oblique: tuple[float, float] | None = None
    """Mean and SD of r, the half log axis ratio 45 degrees from the map's x axis, where the draws have none and it was
    measured beside them; None otherwise.
    """
    irregular: bool = False
    """True where the bump is less regular than a ball's, see `correlated.outline`."""

    @property
    def medians(self) -> tuple[float, float, float]:
        """Posterior medians of amplitude, sigma_x_mm and sigma_y_mm."""
        amplitude, x, y = (float(np.median(v)) for v in (self.amplitude, self.sigma_x_mm, self.sigma_y_mm))
        return amplitude, x, y


# --- Diagnostics of an estimate: of the fit, the errors, the method and the size calibration.


class NoiseFigures(Record):
    """Figures of the errors, and the decisions made under them."""

    noise: str
    """``"independent"`` or ``"field"``."""
    rotated: bool
    rotation_odds: float | None
    """Odds of a rotated ellipse; None where that was decided beforehand."""
    figures: Mapping[str, float]
    """Inflation and degrees of freedom, or the noise field's cosines, length and share."""
    level_offset: float | None = None
    """Offset of the cells about the bump from the background, under independent errors; else None."""
    places_share: float | None = None
    """Share of the width variance from tracker position error; None where a map does not give it."""
    passed_over: tuple[str, ...] = ()
    """Methods that could not be trusted, and why."""

    def as_dict(self) -> dict[str, object]:
        """The figures as plain data."""
        decided: dict[str, object] = {"rotation_odds": self.rotation_odds, "rotated": self.rotated}
        if self.level_offset is not None:
            return {"noise": self.noise, **self.figures, "level_offset": self.level_offset, **decided}
        passed: dict[str, object] = {"passed_over": list(self.passed_over)} if self.passed_over else {}
        return {"noise": self.noise, **decided, **self.figures, **passed, "places_share": self.places_share}


class Diagnostics(Record):
    """Diagnostics of an estimate."""

    cells: int
    covered_share: float
    """`cells`, `covered_share`: Cells in the fit window, and the share of it that they cover."""
    fat_mm: float | None
    """Depth of fat that the size is for; None where the map does not give it."""
    method: str
    sampler: Mapping[str, float]
    """`method`, `sampler`: The method that drew, and its own figures."""
    noise: NoiseFigures
    calibration: str = ""
    """Name of the calibration that gave the size, in words; not in the JSON."""
    size_calibration: str = ""
    """Which calibration gave the size and what it cannot know, in words."""
    repeatability: str = ""
    """How far exams of one mass lie apart at the site, in words; empty where nobody learned it."""
    convergence: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    """R-hat, effective draws and Monte-Carlo errors of chains for each size and width, see `arviz_data.convergence`."""

    def as_dict(self) -> dict[str, object]:
        """The diagnostics as plain data."""
        words: dict[str, object] = {"size_calibration": self.size_calibration} if self.size_calibration else {}
        if self.repeatability:
            words["repeatability"] = self.repeatability
        if self.convergence:
            words["convergence"] = {name: dict(one) for name, one in self.convergence.items()}
        return {
            "cells": self.cells,
            "covered_share": self.covered_share,
            "fat_mm": self.fat_mm,
            **self.sampler,
            **self.noise.as_dict(),
            "method": self.method,
            **words,
        }
