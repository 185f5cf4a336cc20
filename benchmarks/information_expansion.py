"""How a lump's bump depends on where under the head the lump lies: two sets of figures from the frames of one scan."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from benchmarks.information_frames import Bump, HeadFrames
from tactile_bayes.geometry import FloatArray
from tactile_bayes.presets import HEAD_PITCH_MM

Floats = NDArray[np.floating[Any]]

EXPANDED_EVERY = 2
"""One frame in so many is expanded."""
NEAR = (1.6, 1.3)
"""Frames with the lump further from the head's middle, across and along in halves of its size, are left out."""
MOST_SQUARE = 2.0
"""Beyond the head's edge the square of the place stays at this."""
CHOSEN = (
    "by_place_height",
    "by_place_height_across",
    "by_place_width",
    "by_place_width_across",
    "by_place_shift_across",
    "by_place_shift_along",
)
"""Names of the six figures, in the order of `expansion_columns`."""
USUAL = (1.03, -0.42, -0.21, 0.17, -0.57, -0.23)
"""Medians over simulated exams of clear lumps: what a faint lump's figures are shrunk to."""
SHRINKAGE = 10.0
"""Over the square of the amplitude it is added to the normal equations' diagonal."""


def expansion_columns(u: Floats, v: Floats, place: Floats) -> list[Floats]:
    """Functions of the taxels' distances from the lump and of the lump's place.

    Parameters
    ----------
    u, v : (n, t) arrays
        Distances of the taxels from the lump across and along the head, in widths of the map's bump.
    place : (n, 2) array
        Place of the lump under the head across and along, in halves of the head's size.

    Returns
    -------
    list of (n, t) arrays
        The Gaussian g, its second Hermite function across, both times the square of the place across; g u and g v times
        the place across and along: the shift of a bump whose lump lies off the head's middle.
    """
    g = np.exp(-0.5 * (u**2 + v**2))
    width = g * (u**2 - 1.0) / np.sqrt(2.0)
    square = np.minimum(place[:, :1] ** 2, MOST_SQUARE)
    return [g, g * square, width, width * square, g * u * place[:, :1], g * v * place[:, 1:]]


def expansion(frames: HeadFrames, bump: Bump, pitch_mm: float = HEAD_PITCH_MM) -> dict[str, float]:
    r"""How what the lump adds to the frames depends on its place under the head: the six figures `CHOSEN`.

    Least squares over the readings of the frames that have the lump near the head, each over its frame's level; the
    level and two slopes of the head's own frame are taken off readings and columns in every frame. With A and b of the
    normal equations, a the bump's amplitude and :math:`c_0` the usual figures,
    :math:`(A + \lambda a^{-2} I)(c - c_0) = b / a - A c_0`.
    """
    half = 0.5 * pitch_mm * np.array(frames.free.shape)
    place = frames.lump_mm / half
    near = np.flatnonzero((np.abs(place) < NEAR).all(axis=1))[::EXPANDED_EVERY]
    offset = (frames.offset_mm[near] / bump.sigma_mm).reshape(len(near), -1, 2).astype(np.float32)
    value = (frames.kpa[near] / frames.own[near, None, None]).reshape(len(near), -1)
    columns = expansion_columns(offset[..., 0], offset[..., 1], place[near].astype(np.float32))
    left = np.array([*columns, value], dtype=np.float32)
    across, along = (np.linspace(-1, 1, size) for size in frames.free.shape)
    shared = np.stack([frames.free, frames.free * across[:, None], frames.free * along]).reshape(3, -1)
    root = np.linalg.qr(shared.T)[0].astype(np.float32)
    left -= (left @ root) @ root.T
    flat = left.reshape(len(left), -1)
    products = (flat @ flat.T).astype(np.float64)
    gram, right = products[:-1, :-1], products[:-1, -1] / bump.amplitude
    usual = np.array(USUAL)
    shrunk = gram + SHRINKAGE / bump.amplitude**2 * np.eye(len(usual))
    found = usual + np.linalg.solve(shrunk, right - gram @ usual)
    return dict(zip(CHOSEN, found.tolist(), strict=True))


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
