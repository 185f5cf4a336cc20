"""A map as a small picture for a page of many: its values, and a ring where the lump was sized."""

from __future__ import annotations

import io
from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from tactile_bayes.geometry import FloatArray
from tactile_bayes.mapping.orientation import Orientation, orientation_of
from tactile_bayes.mapping.tactile_map import TactileMap

LONGEST_PX: Final = 300
_WIDEST_CELL_PX: Final = 3
# From low to high: five colours of viridis (van der Walt & Smith 2015), which also read in grey.
_COLOURS: Final = np.array([(68, 1, 84), (59, 82, 139), (33, 145, 140), (94, 201, 98), (253, 231, 37)], dtype=float)
_NO_DATA: Final = (235, 235, 235)
_RING: Final = (255, 255, 255)
# Shares of the cells that the colours' ends leave outside, and the least span between the ends, of the middle value.
_ENDS: Final = (0.01, 0.995)
_LEAST_SPAN: Final = 0.2


def thumbnail_png(tactile_map: TactileMap, document: Mapping[str, Any]) -> bytes | None:
    """PNG of a map of up to `LONGEST_PX` pixels a side, oriented as every picture of a map; None without data.

    Parameters
    ----------
    document
        The estimate's JSON object: where it has a size, an ellipse of that size is drawn.
    """
    if not tactile_map.covered.any():
        return None
    view = orientation_of(tactile_map)
    values = view.screen(np.where(tactile_map.covered, tactile_map.mean, np.nan))
    step = -(-max(values.shape) // LONGEST_PX)
    values = values[::step, ::step]
    scale = min(_WIDEST_CELL_PX, max(1, LONGEST_PX // max(values.shape)))
    pixels = _coloured(values).repeat(scale, axis=0).repeat(scale, axis=1)
    _draw_ring(pixels, tactile_map, view, document, px_per_cell=scale / step)
    return _png(pixels)


def _coloured(values: FloatArray) -> NDArray[np.uint8]:
    """(n, m, 3) colours of values; cells without data are grey."""
    covered = np.isfinite(values)
    low, high = np.quantile(values[covered], _ENDS) if covered.any() else (0.0, 1.0)
    high = max(high, low + _LEAST_SPAN * abs(low), low + 1e-12)
    at = np.clip((np.where(covered, values, low) - low) / (high - low), 0.0, 1.0) * (len(_COLOURS) - 1)
    mixed = np.stack([np.interp(at, np.arange(len(_COLOURS)), _COLOURS[:, i]) for i in range(3)], axis=-1)
    return np.where(covered[..., None], np.rint(mixed), np.array(_NO_DATA)).astype(np.uint8)


def _draw_ring(
    pixels: NDArray[np.uint8],
    tactile_map: TactileMap,
    view: Orientation,
    document: Mapping[str, Any],
    *,
    px_per_cell: float,
) -> None:
    """Draw the ellipse of the estimated size at the estimated place."""
    if document["max_size_mm"] is None or document["centre_mm"] is None:
        return
    x, y = (document["centre_mm"][axis]["median"] for axis in "xy")
    angle = 0.0 if document["angle_deg"] is None else np.radians(document["angle_deg"]["median"])
    half_x, half_y = (document[name]["median"] / 2 for name in ("d_x_mm", "d_y_mm"))
    t = np.linspace(0.0, 2 * np.pi, 720)
    along, across = half_x * np.cos(t), half_y * np.sin(t)
    xs = x + along * np.cos(angle) - across * np.sin(angle)
    ys = y + along * np.sin(angle) + across * np.cos(angle)
    places = np.array([view.place(tactile_map, (float(a), float(b))) for a, b in zip(xs, ys, strict=True)])
    columns, rows = np.floor(places * px_per_cell).astype(int).T
    inside = (rows >= 0) & (rows < pixels.shape[0]) & (columns >= 0) & (columns < pixels.shape[1])
    pixels[rows[inside], columns[inside]] = _RING


def _png(pixels: NDArray[np.uint8]) -> bytes:
    from PIL import Image

    out = io.BytesIO()
    Image.fromarray(pixels).quantize(64, dither=Image.Dither.NONE).save(out, "PNG", optimize=True)
    return out.getvalue()
