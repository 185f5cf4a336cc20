"""Maps with a known bump and known errors, for the tests of estimation."""

from __future__ import annotations

from functools import cache

import numpy as np

from tactile_bayes.mapping.map import MapRecipe, TactileMap
from tactile_bayes.posterior.bump import cell_mean_gaussian
from tactile_bayes.posterior.draw import SamplerSettings
from tactile_bayes.posterior.white import Candidate, fitted_candidates

TRUTH = {"amplitude": 0.3, "x": 1.3, "y": -0.8, "sigma_x": 6.0, "sigma_y": 4.5}


def covariance(sigma_x: float, sigma_y: float, angle_deg: float = 0.0) -> np.ndarray:
    """(2, 2) covariance of an ellipse whose axis of sigma_x is turned by an angle."""
    c, s = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    turn = np.array([[c, -s], [s, c]])
    return turn @ np.diag([sigma_x**2, sigma_y**2]) @ turn.T


def grid_map(
    mean: np.ndarray,
    *,
    cell_mm: float = 1.0,
    count: np.ndarray | int = 40,
    background: float | None = 1.0,
    normalise: str = "mean",
    variance: float = 0.0,
) -> TactileMap:
    """A map from a grid of values, NaN where there are none, about the origin."""
    ny, nx = mean.shape
    n = np.where(np.isfinite(mean), count, 0).astype(np.int64)
    return TactileMap(
        mean=mean,
        variance=np.where(n > 0, variance, np.nan),
        count=n,
        x_mm=(np.arange(nx) - (nx - 1) / 2) * cell_mm,
        y_mm=(np.arange(ny) - (ny - 1) / 2) * cell_mm,
        recipe=MapRecipe("grid", normalise, cell_mm),
        background=background,
    )


def bump_values(
    *,
    half_mm: float = 25.0,
    cell_mm: float = 1.0,
    amplitude: float = TRUTH["amplitude"],
    x: float = TRUTH["x"],
    y: float = TRUTH["y"],
    sigma_x: float = TRUTH["sigma_x"],
    sigma_y: float = TRUTH["sigma_y"],
    angle_deg: float = 0.0,
    level: float = 1.0,
) -> np.ndarray:
    """(n, n) cell means of a level and a bump, without errors."""
    n = 2 * round(half_mm / cell_mm) + 1
    axis = (np.arange(n) - (n - 1) / 2) * cell_mm
    u, v = np.meshgrid(axis, axis)
    shape = covariance(sigma_x, sigma_y, angle_deg)
    bump = cell_mean_gaussian((u - x).ravel(), (v - y).ravel(), covariance_mm2=shape, cell_mm=cell_mm)
    return level + amplitude * bump.reshape(n, n)


def bump_map(*, noise: np.ndarray | float = 0.0, cell_mm: float = 1.0, **bump: float) -> TactileMap:
    """A map with a level of 1, a bump, and errors to add."""
    return grid_map(bump_values(cell_mm=cell_mm, **bump) + noise, cell_mm=cell_mm)


@cache
def _field_spectrum(n: int, length_cells: float) -> np.ndarray:
    """Eigenvalues of the exponential covariance on a torus big enough that its wrap-around does not matter."""
    size = n + int(np.ceil(10 * length_cells))
    lag = np.fft.fftfreq(size, 1 / size)
    spectrum = np.fft.fft2(np.exp(-np.hypot(lag[:, None], lag[None, :]) / length_cells)).real
    return np.clip(spectrum, 0.0, None)


def correlated_field(rng: np.random.Generator, n: int, *, length_cells: float) -> np.ndarray:
    """(n, n) Gaussian field of variance 1 whose correlation falls as exp(-distance / length)."""
    spectrum = _field_spectrum(n, length_cells)
    white = rng.standard_normal(spectrum.shape)
    return np.fft.ifft2(np.fft.fft2(white) * np.sqrt(spectrum)).real[:n, :n]


def find_bump(tactile_map: TactileMap, options: SamplerSettings) -> list[Candidate]:
    """Fit the candidates, highest first, up to and including the first that can be a lump.

    Returns
    -------
    list of Candidate
        All that were tried. The last has no fault when a bump was found. Empty when nothing rises above the
        background.
    """
    tried: list[Candidate] = []
    for candidate in fitted_candidates(tactile_map, options):
        tried.append(candidate)
        if not candidate.fault:
            break
    return tried
