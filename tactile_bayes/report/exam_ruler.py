"""Intervals of a size on a scale in mm, as inline SVG."""

from __future__ import annotations

import html
import math
from collections.abc import Iterator, Sequence
from typing import Final

from tactile_bayes.report.exam import Quantity

_LENGTH_MM: Final = 70.0
_ROW_MM: Final = 7.5
_MOST_TICKS: Final = 8
_STEPS_MM: Final = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)


def size_ruler(rows: Sequence[tuple[str, Quantity]]) -> str:
    """A bar for each interval with its median, the first the thickest, above a scale from 0 mm.

    Parameters
    ----------
    rows
        What an interval supposes, and the interval as the estimate's JSON has it.
    """
    end = max(q["high"] for _, q in rows) * 1.08
    bottom = _ROW_MM * len(rows) + 1.5
    parts = [
        *(part for i, (words, q) in enumerate(rows) for part in _bar(i, words, q, _LENGTH_MM / end)),
        *_scale(end, bottom),
    ]
    box = f'viewBox="-2 -1 {_LENGTH_MM + 4:g} {bottom + 6:g}" width="{_LENGTH_MM + 4:g}mm" height="{bottom + 6:g}mm"'
    label = "Intervals of the largest diameter"
    return f'<svg class="ruler" role="img" aria-label="{label}" {box}>{"".join(parts)}</svg>'


def _bar(row: int, words: str, q: Quantity, scale: float) -> Iterator[str]:
    y, left, right = 4.0 + _ROW_MM * row, scale * q["low"], scale * q["high"]
    middle = min(max((left + right) / 2, 12.0), _LENGTH_MM - 12.0)
    yield _text(middle, y - 1.7, words)
    yield f'<path d="M{left:.2f} {y:g}H{right:.2f}" stroke="#111" stroke-width="{1.6 / (1 + 0.6 * row):.2f}"/>'
    yield f'<path d="M{scale * q["median"]:.2f} {y - 1:g}v2" stroke="#111" stroke-width="0.7"/>'


def _scale(end_mm: float, y: float) -> Iterator[str]:
    longest = int(10 ** math.ceil(math.log10(end_mm / _MOST_TICKS))) if end_mm > _MOST_TICKS else 1
    step = next((one for one in _STEPS_MM if end_mm / one <= _MOST_TICKS), longest)
    yield f'<path d="M0 {y:g}H{_LENGTH_MM:g}" stroke="#111" stroke-width="0.25"/>'
    for tick in range(0, int(end_mm) + 1, step):
        x = _LENGTH_MM * tick / end_mm
        yield f'<path d="M{x:.2f} {y:g}v1" stroke="#111" stroke-width="0.25"/>'
        yield _text(x, y + 4, f"{tick}")
    yield _text(_LENGTH_MM - 1.5, y - 0.8, "mm")


def _text(x: float, y: float, text: str) -> str:
    return f'<text x="{x:.2f}" y="{y:g}" text-anchor="middle" font-size="2.7">{html.escape(text)}</text>'
