"""The smallest lump that a map would have shown, as small inline SVG maps: one a depth, a number at each place."""

from __future__ import annotations

import html
from collections.abc import Iterator, Mapping
from typing import Any, Final

import numpy as np

from tactile_bayes.mapping.tactile_map import TactileMap
from tactile_bayes.report.exam_picture import Frame

_ROOM_MM: Final = (34.0, 30.0)
_SHADES: Final = ((10.0, "#ffffff"), (15.0, "#e0e0e0"), (20.0, "#bdbdbd"), (np.inf, "#8f8f8f"))
"""Grey of a place by the diameter in mm below which it lies: darker where only larger lumps show."""


def smallest_pictures(tactile_map: TactileMap, smallest: Mapping[str, Any]) -> Iterator[str]:
    """One picture a depth, with its caption.

    Parameters
    ----------
    smallest
        As `SmallestLumps.as_dict` has it.
    """
    frame = Frame.within(tactile_map, width_mm=_ROOM_MM[0], height_mm=_ROOM_MM[1])
    for number, depth in enumerate(smallest["depths_mm"]):
        caption = f"{depth:g} mm deep"
        yield f"<figure>{_picture(frame, smallest, number, caption)}<figcaption>{caption}</figcaption></figure>"


def _picture(frame: Frame, smallest: Mapping[str, Any], number: int, caption: str) -> str:
    (width, height), side = frame.size_mm, frame.scale * smallest["spacing_mm"]
    label = html.escape(f"Smallest lump that would have shown, {caption}")
    parts = [
        f'<svg role="img" aria-label="{label}" viewBox="0 0 {width:.2f} {height:.2f}" width="{width:.2f}mm" '
        f'height="{height:.2f}mm"><rect width="{width:.2f}" height="{height:.2f}" fill="#fff" stroke="#333" '
        'stroke-width="0.3"/>'
    ]
    for one in smallest["places"]:
        (x, y), d = frame.at((one["x_mm"], one["y_mm"])), one["d_mm"][number]
        shade = next(grey for most, grey in _SHADES if (np.inf if d is None else d) <= most)
        box = f'x="{x - side / 2:.2f}" y="{y - side / 2:.2f}" width="{side:.2f}" height="{side:.2f}"'
        text = "–" if d is None else f"{np.ceil(d):.0f}"
        parts.append(f'<rect {box} fill="{shade}" stroke="#777" stroke-width="0.1"/>')
        parts.append(f'<text x="{x:.2f}" y="{y + 0.9:.2f}" text-anchor="middle" font-size="2.6">{text}</text>')
    return "".join([*parts, "</svg>"])
