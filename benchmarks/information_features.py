"""What the frames of one scan might tell beside the map's bump and the head's profile: candidate features.

Every figure is relative to the scan's own lump-free frames or to its own amplitude, so that a head's gain does not
matter. The lump's place under the head comes from a Gaussian fitted to the map.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from tactile_bayes.geometry import FloatArray, apply, inverse
from tactile_bayes.mapping.build import build_map
from tactile_bayes.mapping.frames import select_frames
from tactile_bayes.mapping.tactile_map import TactileMap
from tactile_bayes.presets import PRESSURE_RANGE_KPA, PRESSURE_WINDOW_KPA
from tactile_bayes.scan import Scan

WINDOW_MM = 20.0
LEAST_READINGS = 10
FREE_SHARE = 0.2
"""Share of the frames that feel least of the lump: their mean is the head's own frame."""
NO_CONTACT = 0.05
"""Below this share of the mean a taxel counts as not touching."""
PLACES_MM = (0.0, 2.5, 5.0, 7.5, 10.0, 12.5, 16.0, 20.0)
"""Ends of the bins of the lump's distance from the head's middle, across the head."""
BESIDE_MM = 8.0
"""Frames with the lump further than this from the middle along the head are in no bin."""
EXPANDED_EVERY = 2
"""One frame in so many is expanded."""
WIDTH_STEPS = np.arange(0.25, 4.0, 0.5)
"""Places in widths where the map's bump is read."""


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


def features(
    scan: Scan, *, near_base_mm: FloatArray, sigma_mm: tuple[float, float], amplitude: float
) -> dict[str, FloatArray | float]:
    """All candidate features of one scan.

    Parameters
    ----------
    scan
        With one lump.
    near_base_mm : (3,) array
        About where it is, in `base`: only where the fit begins.
    sigma_mm, amplitude
        Where the fit begins.

    Returns
    -------
    dict
        Figures by name; arrays for the sets that are reduced to principal components.
    """
    tactile_map = build_map(scan, normalise="gain")
    assert tactile_map.plane_from_base is not None
    centre = apply(tactile_map.plane_from_base, near_base_mm)[:2]
    bump, cells = fit_bump(tactile_map, centre, sigma_mm, amplitude)
    frames = HeadFrames.of(scan, tactile_map.plane_from_base, bump)
    return {
        **hermite_figures(bump, cells),
        "map_shape": map_shape(bump, cells),
        **frame_figures(frames, bump),
        **contact_figures(frames),
        **depth_figures(frames),
        "places": mean_frames(frames, bump),
        "fit_amplitude": bump.amplitude,
        "fit_sigma_x_mm": float(bump.sigma_mm[0]),
        "fit_sigma_y_mm": float(bump.sigma_mm[1]),
        "mean_kpa": float(frames.level_kpa.mean()),
        "drift_kpa": float(frames.level_kpa.std()),
    }


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


def map_shape(bump: Bump, cells: Cells) -> FloatArray:
    """(64,) what the map has beside the fitted Gaussian, over its amplitude, every half width, folded on both axes."""
    u = np.abs((cells.xy_mm - bump.centre_mm) / bump.sigma_mm)
    left = (cells.value - bump.level) / bump.amplitude - bump.at(cells.xy_mm)
    bins = np.floor(u / 0.5).astype(int)
    size = len(WIDTH_STEPS)
    inside = (bins < size).all(axis=1)
    flat = bins[inside, 0] * size + bins[inside, 1]
    count = np.bincount(flat, minlength=size**2)
    total = np.bincount(flat, left[inside], minlength=size**2)
    return np.asarray(total / np.maximum(count, 1))


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

    By least squares of the apex's height on a plane, the level, and two bumps of the lump's place under the head, one as
    wide as the head and one half of it; both bumps' sum is the lift over the lump.
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


def mean_frames(frames: HeadFrames, bump: Bump) -> FloatArray:
    """(7, r, c / 2) what the lump adds to the mean frame over its amplitude, by its place across the head.

    Frames are folded such that the lump lies towards the last row and column; pairs of columns are averaged. 0 where no
    frame is in a bin.
    """
    ends, (rows, columns) = np.array(PLACES_MM), frames.free.shape
    found = np.zeros((len(ends) - 1, rows, columns))
    added = (frames.kpa / frames.own[:, None, None] - frames.free) / bump.amplitude
    for axis in (0, 1):
        back = frames.lump_mm[:, axis] < 0
        added[back] = np.flip(added[back], axis=axis + 1)
    place = np.abs(frames.lump_mm)
    bins = np.where(place[:, 1] < BESIDE_MM, np.searchsorted(ends, place[:, 0], side="right") - 1, -1)
    for k in range(len(found)):
        if (bins == k).any():
            found[k] = added[bins == k].mean(axis=0)
    return np.asarray(found.reshape(len(found), rows, columns // 2, 2).mean(axis=3), dtype=np.float32)


def expansion(frames: HeadFrames, bump: Bump, pitch_mm: float = 1.5) -> FloatArray:
    """(25,) coefficients of what the lump adds to the frames, over its amplitude.

    Least squares over all readings of the frames that have the lump near the head, each over its frame's level, with the
    level and two slopes of the head's own frame open in every frame. The functions are Gauss-Hermite functions of the
    taxel's distance from the lump in widths, of even order up to 4, and a Gaussian twice as wide; each times 1, X^2 and
    Y^2 of the lump's place under the head in halves of its size; and odd ones times X or Y: how the bump is shifted and
    skewed where the lump is off the head's middle.
    """
    half = 0.5 * pitch_mm * np.array(frames.free.shape)
    place = frames.lump_mm / half
    near = np.flatnonzero((np.abs(place) < (1.6, 1.3)).all(axis=1))[::EXPANDED_EVERY]
    place, square = place[near], np.minimum(place[near] ** 2, 2.0)
    offset = _offsets(frames, bump)[near].astype(np.float32)
    n, t = offset.shape[:2]
    u, v = offset[..., 0], offset[..., 1]
    g = np.exp(-0.5 * (u**2 + v**2))
    wide = np.exp(-0.125 * (u**2 + v**2))
    x2, y2 = (u**2 - 1) / 1.4142, (v**2 - 1) / 1.4142
    x4, y4 = ((w**4 - 6 * w**2 + 3) / 4.899 for w in (u, v))
    even = [g, g * x2, g * y2, g * x2 * y2, g * x4, g * y4, wide]
    columns = [one * by for one in even for by in (1.0, square[:, :1], square[:, 1:])]
    px, py = place[:, :1], place[:, 1:]
    columns += [g * u * px, g * v * py, g * u * (x2 - 1.4142) * px, g * v * (y2 - 1.4142) * py]
    value = (frames.kpa[near] / frames.own[near, None, None]).reshape(n, t)
    across, along = (np.linspace(-1, 1, size) for size in frames.free.shape)
    shared = np.stack([frames.free, frames.free * across[:, None], frames.free * along]).reshape(3, -1)
    root = np.linalg.qr(shared.T)[0]
    left = np.array([*columns, value], dtype=np.float32)
    left -= (left @ root.astype(np.float32)) @ root.T.astype(np.float32)
    flat = left.reshape(len(left), -1)
    products = (flat @ flat.T).astype(np.float64)
    gram = products[:-1, :-1]
    gram = gram + np.diag(1e-4 * np.diag(gram) + 1e-9)
    return np.asarray(np.linalg.solve(gram, products[:-1, -1]) / bump.amplitude)


def _offsets(frames: HeadFrames, bump: Bump) -> FloatArray:
    """(n, t, 2) distances of the taxels from the lump, in widths of the bump."""
    return frames.offset_mm.reshape(len(frames.kpa), -1, 2) / bump.sigma_mm
