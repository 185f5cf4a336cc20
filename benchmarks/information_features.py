"""What the frames of one scan might tell beside the map's bump and the head's profile: candidate features.

Every figure is relative to the scan's own lump-free frames or to its own amplitude, so that a head's gain does not
matter. The lump's place under the head comes from a Gaussian fitted to the map.
"""

from __future__ import annotations

import numpy as np

from benchmarks.information_frames import WINDOW_MM, Bump, Cells, HeadFrames

NO_CONTACT = 0.05
"""Below this share of the mean a taxel counts as not touching."""


def hermite_figures(bump: Bump, cells: Cells) -> dict[str, float]:
    """Fourth-order Gauss-Hermite coefficients of the bump over its amplitude, and the ring around it.

    Fitted by least squares together with amplitude, centre, widths and a sloping level. The ring is the mean of the map
    between 2.3 and 3.3 widths less that of the Gaussian, over the amplitude; steep is the peak's share above the fit.
    """
    u = (cells.xy_mm - bump.centre_mm) / bump.sigma_mm
    g, radius = bump.at(cells.xy_mm), np.hypot(*u.T)
    x, y = u.T
    four = [(v**4 - 6 * v**2 + 3) / np.sqrt(24.0) for v in (x, y)]
    two = [(v**2 - 1) / np.sqrt(2.0) for v in (x, y)]
    level = np.stack([np.ones(len(x)), *((cells.xy_mm - bump.centre_mm) / WINDOW_MM).T], axis=1)
    shapes = np.stack([np.ones(len(x)), x, y, *two, x * y, *four, two[0] * two[1]], axis=1) * g[:, None]
    coefficients = np.linalg.lstsq(np.c_[shapes, level], cells.value - bump.level, rcond=None)[0] / bump.amplitude
    left = (cells.value - bump.level - bump.amplitude * g) / bump.amplitude
    ring, peak = (radius > 2.3) & (radius < 3.3), radius < 0.6
    return {
        "h40": float(coefficients[6]),
        "h04": float(coefficients[7]),
        "h22": float(coefficients[8]),
        "ring": float(left[ring].mean()) if ring.sum() > 5 else 0.0,
        "peak": float(left[peak].mean()) if peak.any() else 0.0,
    }


def frame_figures(frames: HeadFrames, bump: Bump) -> dict[str, float]:
    """How the amplitude depends on the lump's place under the head and on the pressure.

    By weighted least squares of the frames' amplitudes over the map's: on the square of the place across and along the
    head, in halves of its size, and on the log of the level; and the head's own profile against the level.
    """
    half = 0.75 * np.array(frames.free.shape)
    place = (frames.lump_mm / half) ** 2
    inside = (place < 1.0).all(axis=1)
    level = np.log(frames.own / frames.own.mean())
    columns = np.c_[np.ones(len(level)), place, level][inside]
    root = np.sqrt(frames.weight[inside])
    known = np.linalg.lstsq(columns * root[:, None], frames.amplitude[inside] / bump.amplitude * root, rcond=None)[0]
    return {
        "amplitude_middle": float(known[0]),
        "amplitude_across": float(known[1]),
        "amplitude_along": float(known[2]),
        "amplitude_pressure": float(known[3]),
        "profile_pressure": _profile_slope(frames),
    }


def _profile_slope(frames: HeadFrames) -> float:
    """Change of the second-order profile across the head with the log of the level, in frames that feel least."""
    least = frames.bump.sum(axis=(1, 2))
    chosen = least <= np.quantile(least, 0.5)
    across = np.linspace(-1, 1, frames.free.shape[0])
    curve = np.polynomial.legendre.legval(across, [0, 0, 1])
    own = (frames.kpa[chosen] / frames.level_kpa[chosen, None, None]).mean(axis=2) @ curve
    level = np.log(frames.level_kpa[chosen])
    level = level - level.mean()
    return float(level @ own / max(level @ level, 1e-6))


def contact_figures(frames: HeadFrames) -> dict[str, float]:
    """Share of the head that does not touch, and the pressure of its border, away from the lump and over it."""
    half = 0.75 * np.array(frames.free.shape)
    over = (np.abs(frames.lump_mm) < 0.35 * half).all(axis=1)
    if over.sum() < 5:
        over = np.sum((frames.lump_mm / half) ** 2, axis=1) < 0.5
    middle = (frames.kpa[over] / frames.level_kpa[over, None, None]).mean(axis=0) if over.any() else frames.free
    border = np.zeros(frames.free.shape, dtype=bool)
    border[[0, -1]] = border[:, [0, -1]] = True
    corner = np.zeros(frames.free.shape, dtype=bool)
    corner[np.ix_([0, 1, -2, -1], [0, 1, -2, -1])] = True
    return {
        "border": float(frames.free[border].mean()),
        "corner": float(frames.free[corner].mean()),
        "no_contact": float((frames.free < NO_CONTACT).mean()),
        "border_over": float((middle - frames.free)[border].mean()),
        "corner_over": float((middle - frames.free)[corner].mean()),
        "no_contact_over": float((middle < NO_CONTACT).mean() - (frames.free < NO_CONTACT).mean()),
    }


def depth_figures(frames: HeadFrames) -> dict[str, float]:
    """How far the lump lifts the head, and how the head sinks with pressure.

    By least squares of the apex's height on a plane, the level, and two bumps of the lump's place under the head, one
    as wide as the head and one half of it; both bumps' sum is the lift over the lump.
    """
    z = frames.apex_mm[:, 2]
    half = 0.75 * np.array(frames.free.shape)
    square = np.sum((frames.lump_mm / half) ** 2, axis=1)
    level = frames.level_kpa - frames.level_kpa.mean()
    place = frames.apex_mm[:, :2] / 30.0
    columns = np.c_[np.ones(len(z)), place, level, np.exp(-square), np.exp(-4 * square)]
    known = np.linalg.lstsq(columns, z, rcond=None)[0]
    return {
        "lift_wide": float(-known[4]),
        "lift_narrow": float(-known[5]),
        "lift": float(-known[4] - known[5]),
        "sinks_mm_per_kpa": float(known[3]),
        "depth_noise_mm": float((z - columns @ known).std()),
    }
