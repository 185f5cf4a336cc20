"""The frames of one scan with the lump's place under the head, for the study of what they tell."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from tactile_bayes.geometry import FloatArray, apply, inverse
from tactile_bayes.mapping.frames import select_frames
from tactile_bayes.mapping.tactile_map import TactileMap
from tactile_bayes.presets import PRESSURE_RANGE_KPA, PRESSURE_WINDOW_KPA
from tactile_bayes.scan import Scan

WINDOW_MM = 20.0
CENTRE_WINDOW_MM = 15.0
LEAST_READINGS, MOST_READINGS = 10, 100
FREE_SHARE = 0.2
"""Share of the frames that feel least of the lump: their mean is the head's own frame."""


@dataclass(frozen=True, slots=True, eq=False)
class Bump:
    """Gaussian on the map by least squares: amplitude, centre, widths, level and slopes."""

    amplitude: float
    centre_mm: FloatArray
    sigma_mm: FloatArray
    level: FloatArray

    def at(self, xy_mm: FloatArray) -> FloatArray:
        """(...) unit Gaussian at (..., 2) places."""
        return np.asarray(np.exp(-0.5 * np.sum(((xy_mm - self.centre_mm) / self.sigma_mm) ** 2, axis=-1)))


@dataclass(frozen=True, slots=True, eq=False)
class Cells:
    """Cells of the map in the window: (n, 2) places and (n,) values."""

    xy_mm: FloatArray
    value: FloatArray


def fit_bump(
    tactile_map: TactileMap, centre_mm: FloatArray, sigma_mm: tuple[float, float], amplitude: float
) -> tuple[Bump, Cells]:
    """Least-squares Gaussian with a sloping level in the window, and the window's cells."""
    x, y = np.meshgrid(tactile_map.x_mm, tactile_map.y_mm)
    kept = (tactile_map.count >= LEAST_READINGS) & (np.hypot(x - centre_mm[0], y - centre_mm[1]) < WINDOW_MM)
    cells = Cells(np.stack([x[kept], y[kept]], axis=-1), tactile_map.mean[kept])
    slope = (cells.xy_mm - centre_mm) / WINDOW_MM

    def left(theta: FloatArray) -> FloatArray:
        u = (cells.xy_mm - theta[1:3]) / np.exp(theta[3:5])
        bump = theta[0] * np.exp(-0.5 * np.sum(u**2, axis=1))
        return np.asarray(bump + theta[5] + slope @ theta[6:8] - cells.value)

    start = np.r_[amplitude, centre_mm, np.log(sigma_mm), 1.0, 0.0, 0.0]
    theta = least_squares(left, start, method="lm", x_scale=np.r_[0.05, 1, 1, 0.2, 0.2, 0.02, 0.02, 0.02]).x
    level = theta[5] + slope @ theta[6:8]
    return Bump(float(theta[0]), theta[1:3], np.exp(theta[3:5]), level), cells


def fixed_bump(tactile_map: TactileMap, centre_mm: FloatArray, sigma_mm: tuple[float, float], amplitude: float) -> Bump:
    """The bump of given amplitude and widths, its centre by least squares; level and slopes are open."""
    x, y = np.meshgrid(tactile_map.x_mm, tactile_map.y_mm)
    near = np.hypot(x - centre_mm[0], y - centre_mm[1]) < CENTRE_WINDOW_MM
    kept = (tactile_map.count >= LEAST_READINGS) & near
    place, value = np.stack([x[kept], y[kept]], axis=-1), tactile_map.mean[kept]
    root = np.sqrt(np.minimum(tactile_map.count[kept], MOST_READINGS))
    slope = (place - centre_mm) / WINDOW_MM

    def left(theta: FloatArray) -> FloatArray:
        u = (place - theta[1:3]) / sigma_mm
        model = theta[0] * np.exp(-0.5 * np.sum(u**2, axis=1)) + theta[3] + slope @ theta[4:6]
        return np.asarray(root * (model - value))

    theta = least_squares(left, np.r_[amplitude, centre_mm, 1.0, 0.0, 0.0], method="lm").x
    return Bump(amplitude, theta[1:3], np.array(sigma_mm), theta[3] + slope @ theta[4:6])


@dataclass(frozen=True, slots=True, eq=False)
class HeadFrames:
    """Used frames of a scan, with the lump's place under the head.

    Parameters
    ----------
    kpa : (n, r, c) array
        Saturated readings at the end of the range.
    level_kpa : (n,) array
        Means of the frames.
    lump_mm : (n, 2) array
        Place of the lump in `scanhead`.
    apex_mm : (n, 3) array
        Place of the head's apex in the map's plane.
    bump : (n, r, c) array
        Unit Gaussian of the map at the taxels.
    offset_mm : (n, r, c, 2) array
        Place of the taxels from the lump, in the map's plane.
    free : (r, c) array
        Mean of the frames that feel least of the lump, each over its mean.
    own : (n,) array
        Amount of `free` in each frame, kPa: its level beside the lump.
    amplitude, weight : (n,) arrays
        Amplitude of the bump in each frame over `own`, and the sum of squares that tells it.
    """

    kpa: FloatArray
    level_kpa: FloatArray
    lump_mm: FloatArray
    apex_mm: FloatArray
    bump: FloatArray
    offset_mm: FloatArray
    free: FloatArray
    own: FloatArray
    amplitude: FloatArray
    weight: FloatArray

    @classmethod
    def of(cls, scan: Scan, plane_from_base: FloatArray, bump: Bump) -> HeadFrames:
        """Read a scan's frames."""
        part = select_frames(scan, pressure_window_kpa=PRESSURE_WINDOW_KPA)
        kpa = np.nan_to_num(scan.element_calibration.to_kpa(scan.frames.counts[part.used]), nan=PRESSURE_RANGE_KPA[1])
        poses, lever = part.used_poses.part(part.used), inverse(scan.head.scanhead_from_tracker)
        to_plane = plane_from_base[:3, :3]
        turn = to_plane @ poses.rotation @ lever[:3, :3]
        apex = apply(plane_from_base, poses.position_mm + poses.rotation @ lever[:3, 3])
        places = np.einsum("nij,rcj->nrci", turn[:, :2], scan.head.surface_mm) + apex[:, None, None, :2]
        felt = bump.at(places)
        away = np.c_[bump.centre_mm - apex[:, :2], np.zeros(len(apex))]
        lump = np.einsum("nji,nj->ni", turn, away)[:, :2]
        level = kpa.mean(axis=(1, 2))
        least = felt.sum(axis=(1, 2))
        free = (kpa / level[:, None, None])[least <= np.quantile(least, FREE_SHARE)].mean(axis=0)
        own, amplitude, weight = _frame_amplitudes(kpa, felt, free)
        return cls(kpa, level, lump, apex, felt, places - bump.centre_mm, free, own, amplitude, weight)


def _frame_amplitudes(kpa: FloatArray, felt: FloatArray, free: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Least squares in each frame: level, two slopes over the head, and the bump; returns as `HeadFrames`."""
    n = len(kpa)
    across, along = (np.linspace(-1, 1, size) for size in free.shape)
    shared = np.stack([free, free * across[:, None], free * along]).reshape(3, -1)
    bump, value = felt.reshape(n, -1), kpa.reshape(n, -1)
    solve = np.linalg.inv(shared @ shared.T)
    bump_left = bump - (bump @ shared.T) @ solve @ shared
    weight = np.einsum("nt,nt->n", bump_left, bump_left)
    height = np.einsum("nt,nt->n", bump_left, value) / np.maximum(weight, 1e-9)
    own = ((value - height[:, None] * bump) @ shared.T @ solve)[:, 0]
    return own, height / own, weight
