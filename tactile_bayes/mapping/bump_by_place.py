r"""How what a lump adds to the frames depends on where under the head it lies: six figures of a bump on a map.

The map averages over those places. A rigid curved head squeezes a lump under its middle otherwise than one under its
side, and how much otherwise depends on what the lump rests on, so the figures tell its seat (docs/decisions/0104).

With the bump's amplitude a, widths and centre; X, Y the lump's place across and along the head, in halves of the head's
size; u, v a taxel's distance from the lump in widths; and :math:`g = e^{-(u^2 + v^2) / 2}`,
:math:`H = (u^2 - 1) / \sqrt 2`: the pressures of a frame over its level are regressed on g, :math:`g X^2`, g H,
:math:`g H X^2`, g u X and g v Y, with the head's own frame and two slopes over the head taken off. The coefficients
over a are shrunk to the usual ones.
"""

from __future__ import annotations

import numpy as np

from tactile_bayes.geometry import FloatArray
from tactile_bayes.head_shape import HeadShape
from tactile_bayes.mapping.frame_sample import POOL_TAXELS, FrameSample
from tactile_bayes.records import dataclass

LEAST_FRAMES = 20
"""Frames with the lump near the head that six coefficients need."""
FREE_SHARE = 0.2
"""Share of the frames that feel least of the lump: their mean is the head's own frame."""
NEAR = (1.6, 1.3)
"""Frames with the lump further from the head's middle, across and along in halves of its size, are left out."""
MOST_SQUARE = 2.0
"""Beyond the head's edge the square of the place across stays at this."""
USUAL = (1.03, -0.42, -0.21, 0.17, -0.57, -0.23)
"""Medians over simulated exams of clear lumps: what a faint lump's figures are shrunk to."""
SHRINKAGE = 10.0
"""Over the square of the amplitude it is added to the normal equations' diagonal."""


@dataclass(frozen=True, slots=True)
class Bump:
    """A Gaussian on a map.

    Parameters
    ----------
    amplitude
    x_mm, y_mm
        Its centre in `plane`.
    sigma_x_mm, sigma_y_mm
        Widths along the axes of `plane`.
    """

    amplitude: float
    x_mm: float
    y_mm: float
    sigma_x_mm: float
    sigma_y_mm: float


def by_place(frames: FrameSample, head: HeadShape, bump: Bump) -> tuple[float, ...] | None:
    """The six figures, in the order of `presets.BY_PLACE`.

    Parameters
    ----------
    frames
        Of the map, which is normalised.
    head
        That made the scan.
    bump
        Lump on the map.

    Returns
    -------
    tuple or None
        None for a bump that is no rise, and where fewer than `LEAST_FRAMES` frames have it near the head.
    """
    if not (bump.amplitude > 0 and min(bump.sigma_x_mm, bump.sigma_y_mm) > 0):
        return None
    half_mm = 0.5 * head.pitch_mm * np.array([head.rows, head.columns])
    lump = frames.under_head_mm((bump.x_mm, bump.y_mm)) / half_mm
    near = (np.abs(lump) < NEAR).all(axis=1)
    if np.count_nonzero(near) < LEAST_FRAMES:
        return None
    sigma_mm = np.array([bump.sigma_x_mm, bump.sigma_y_mm])
    wider_mm = np.hypot(sigma_mm, _block_sd_mm(head))
    offset = (frames.places_mm() - (bump.x_mm, bump.y_mm)) / wider_mm
    felt = np.exp(-0.5 * np.einsum("mki,mki->mk", offset, offset))
    own = _own_frames(frames, felt, half_mm)
    level = _levels(frames.pressure[near], felt[near], own)
    columns = np.stack([*_columns(offset[near], felt[near], lump[near]), frames.pressure[near] / level[:, None]])
    return _shrunk(_products(columns, own), bump.amplitude * float(np.prod(sigma_mm / wider_mm)))


def _block_sd_mm(head: HeadShape) -> float:
    """SD of the places of a block's taxels about its centre: blocks see a bump that much wider."""
    return head.pitch_mm * float(np.sqrt((POOL_TAXELS**2 - 1) / 12))


def _own_frames(frames: FrameSample, felt: FloatArray, half_mm: FloatArray) -> FloatArray:
    """(3, k) the head's own frame, and it with a slope across and along the head."""
    least = felt.sum(axis=1)
    free = frames.pressure[least <= np.quantile(least, FREE_SHARE)]
    own = (free / free.mean(axis=1, keepdims=True)).mean(axis=0)
    across, along = (frames.place_mm[:, :2] / half_mm).T
    return np.stack([own, own * across, own * along])


def _levels(pressure: FloatArray, felt: FloatArray, own: FloatArray) -> FloatArray:
    """(n,) amount of the head's own frame in each frame, by least squares with two slopes and the bump."""
    solve = np.linalg.inv(own @ own.T)
    left = felt - (felt @ own.T) @ solve @ own
    weight = np.einsum("nk,nk->n", left, left)
    height = np.einsum("nk,nk->n", left, pressure) / np.maximum(weight, 1e-9)
    return np.asarray(((pressure - height[:, None] * felt) @ own.T @ solve)[:, 0])


def _columns(offset: FloatArray, felt: FloatArray, lump: FloatArray) -> list[FloatArray]:
    """Six (n, k) functions of the distances from the lump, in widths, and of its (n, 2) place under the head."""
    u, v = offset[..., 0], offset[..., 1]
    width = felt * (u * u - 1.0) / np.sqrt(2.0)
    square = np.minimum(lump[:, :1] ** 2, MOST_SQUARE)
    return [felt, felt * square, width, width * square, felt * u * lump[:, :1], felt * v * lump[:, 1:]]


def _products(columns: FloatArray, own: FloatArray) -> FloatArray:
    """(7, 7) inner products of (7, n, k) columns over all frames, the head's own frame and slopes taken off each."""
    basis = np.linalg.qr(own.T)[0]
    flat = (columns - (columns @ basis) @ basis.T).reshape(len(columns), -1)
    return np.asarray(POOL_TAXELS**2 * flat @ flat.T)


def _shrunk(products: FloatArray, amplitude: float) -> tuple[float, ...] | None:
    """Coefficients over the amplitude from the inner products of the six columns and the pressures."""
    usual, gram, right = np.array(USUAL), products[:-1, :-1], products[:-1, -1] / amplitude
    left = np.linalg.solve(gram + SHRINKAGE / amplitude**2 * np.eye(len(usual)), right - gram @ usual)
    found = usual + left
    return tuple(float(value) for value in found) if np.isfinite(found).all() else None
