"""A clock face of the breast with the masses on it, as inline SVG: what charts of a breast exam show."""

from __future__ import annotations

import html
import math
from collections.abc import Sequence
from typing import Final

from tactile_bayes.report.exam import ExamMass

_RADIUS: Final = 13.0
_LEAST_MM: Final = 60.0
"""The face's rim is this far from the nipple, or as far as the farthest mass lies."""


def breast_dial(masses: Sequence[ExamMass]) -> str:
    """Clock face as the examiner sees it who faces the patient; empty without a place about the nipple."""
    known = [(mass.number, mass.place) for mass in masses if mass.place is not None]
    if not known:
        return ""
    side, rim_mm = known[0][1].side, max(_LEAST_MM, *(1.1 * place.distance_mm for _, place in known))
    outer = ("R", "L")  # the patient's right is on the viewer's left
    parts = [f'<circle r="{_RADIUS}" fill="none" stroke="#111" stroke-width="0.4"/>', '<circle r="0.9" fill="#111"/>']
    for hour in range(1, 13):
        x, y = _on(hour * 30.0, _RADIUS)
        inner = _on(hour * 30.0, _RADIUS - (2.0 if hour % 3 == 0 else 1.0))
        parts.append(f'<path d="M{x:.2f} {y:.2f}L{inner[0]:.2f} {inner[1]:.2f}" stroke="#111" stroke-width="0.3"/>')
        if hour % 3 == 0:
            a, b = _on(hour * 30.0, _RADIUS + 2.4)
            parts.append(f'<text x="{a:.2f}" y="{b + 1:.2f}" text-anchor="middle" font-size="2.8">{hour}</text>')
    for number, place in known:
        x, y = _on(place.angle_deg, _RADIUS * place.distance_mm / rim_mm)
        parts.append(f'<circle class="lump" cx="{x:.2f}" cy="{y:.2f}" r="1.3" fill="#111"/>')
        if len(known) > 1:
            parts.append(f'<text x="{x + 1.8:.2f}" y="{y + 1:.2f}" font-size="2.8">{number}</text>')
    for letter, x in zip(outer, (-19.5, 19.5), strict=True):
        parts.append(f'<text x="{x}" y="1" text-anchor="middle" font-size="3" font-weight="600">{letter}</text>')
    label = f"Clock face of the {side} breast, rim {rim_mm:.0f} mm from the nipple"
    return (
        f'<svg class="dial" role="img" aria-label="{html.escape(label)}" viewBox="-22 -17.5 44 39" width="44mm" '
        f'height="39mm">{"".join(parts)}<text x="0" y="20.6" text-anchor="middle" font-size="2.8">'
        f"{html.escape(side)} breast, rim at {rim_mm:.0f} mm</text></svg>"
    )


def _on(angle_deg: float, radius: float) -> tuple[float, float]:
    """Point at an angle clockwise from the top, y downwards."""
    angle = math.radians(angle_deg)
    return radius * math.sin(angle), -radius * math.cos(angle)
