"""Bumps on maps from parts of the head, thirds of its rows and of its columns, from the frames of one scan."""

from __future__ import annotations

import numpy as np
from scipy.optimize import least_squares

from benchmarks.information_frames import Bump, HeadFrames
from tactile_bayes.geometry import FloatArray


def part_figures(frames: HeadFrames, bump: Bump) -> dict[str, float]:
    """Gaussians on maps from parts of the head: thirds of its rows, and of its columns.

    Each reading is over its frame's level and over the head's own frame. From the middle third and as a mean of both
    outer ones: amplitude and widths over the map's, as logs; and how far the outer thirds' bumps lie apart, in widths.
    """
    ratio = frames.kpa / frames.own[:, None, None] / frames.free
    rows, columns = frames.free.shape
    third, quarter = rows // 3, columns // 3
    parts = {
        "rows_low": (slice(0, third), slice(None)),
        "rows_middle": (slice(third, rows - third), slice(None)),
        "rows_high": (slice(rows - third, rows), slice(None)),
        "columns_low": (slice(None), slice(0, quarter)),
        "columns_middle": (slice(None), slice(quarter, columns - quarter)),
        "columns_high": (slice(None), slice(columns - quarter, columns)),
    }
    fits = {name: _part_fit(ratio[:, r, c], frames.offset_mm[:, r, c], bump) for name, (r, c) in parts.items()}
    figures = {}
    for side in ("rows", "columns"):
        low, middle, high = (fits[f"{side}_{place}"] for place in ("low", "middle", "high"))
        for k, name in ((0, "amplitude"), (3, "sigma_x"), (4, "sigma_y")):
            figures[f"{side}_middle_{name}"] = float(middle[k])
            figures[f"{side}_outer_{name}"] = float(0.5 * (low[k] + high[k]))
        figures[f"{side}_apart_x"], figures[f"{side}_apart_y"] = (float(high[k] - low[k]) for k in (1, 2))
    return figures


def _part_fit(ratio: FloatArray, offset_mm: FloatArray, bump: Bump) -> FloatArray:
    """(5,) log amplitude over the map's, shift of the centre in widths, logs of the widths over the map's."""
    bins = np.floor(offset_mm + 15.0).astype(np.int64).reshape(-1, 2)
    inside = ((bins >= 0) & (bins < 30)).all(axis=1)
    flat = bins[inside, 0] * 30 + bins[inside, 1]
    count = np.bincount(flat, minlength=900)
    kept = count >= 5
    value = np.bincount(flat, ratio.reshape(-1)[inside], minlength=900)[kept] / count[kept]
    x, y = np.divmod(np.flatnonzero(kept), 30)
    place = np.stack([x, y], axis=-1) - 14.5
    root = np.sqrt(np.minimum(count[kept], 60))
    soft = np.array([0.3, 0.5, 0.5, 0.25, 0.25])

    def left(theta: FloatArray) -> FloatArray:
        u = place / bump.sigma_mm - theta[1:3]
        shape = np.exp(theta[0] - 0.5 * np.sum((u / np.exp(theta[3:5])) ** 2, axis=1))
        model = bump.amplitude * shape + theta[5] + place @ theta[6:8] / 15.0
        residual: FloatArray = np.r_[root * (model - value) / 0.05, theta[:5] / soft]
        return residual

    start = np.r_[np.zeros(5), 1.0, 0.0, 0.0]
    return np.asarray(least_squares(left, start, method="lm", max_nfev=400).x[:5])
