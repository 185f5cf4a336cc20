"""The Pareto picture of a trade-off: distance of interval ends against CPU time, both logarithmic."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

from tactile_bayes.posterior.lump_probability import LIKELY
from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.report.figure_file import figure_file
from tactile_bayes.studies.cost_ladder import Ladder, Priced

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_SIZE_IN = (10.0, 6.0)
_MARKS = ("o", "^", "s", "D", "v", "P")
_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
_LETTER, _LINE = 3.95, 9.0
"""Width of a letter and height of a line of a name, points."""
Box = tuple[float, float, float, float]
_LEAST_MM = 1e-3
"""Smaller distances are drawn here: below rounding of what anybody reads."""


def draw_ladder(ladder: Ladder, path: Path, *, title: str, force: bool = False) -> None:
    """Draw every setting as a point, with the frontier and the lines that say what matters.

    Without a reference there is no distance: then the probability of a lump is drawn.

    Raises
    ------
    UsageError
        When the file exists and `force` is false.
    """
    shown = [one for one in ladder.rows if math.isfinite(_height(one, ladder))]
    with figure_file(path, size_in=_SIZE_IN, force=force) as figure:
        axes = figure.subplots()
        for i, axis in enumerate(dict.fromkeys(one.axis for one in shown)):
            rows = [one for one in shown if one.axis == axis]
            axes.plot(*_places(rows, ladder), _MARKS[i % 6], color=_COLOURS[i % 6], label=axis, zorder=3)
        default = [one for one in shown if one.default]
        axes.plot(*_places(default, ladder), "o", ms=15, mfc="none", mec="k", mew=1.5, label="the default", zorder=4)
        if ladder.reference.answer is not None:
            axes.step(
                *_places(ladder.frontier(), ladder), where="post", color="0.3", lw=1.0, label="frontier", zorder=2
            )
            axes.set_ylabel("distance of the interval's ends from the reference, mm (rms)")
            axes.set_yscale("log")
            axes.yaxis.set_major_formatter("{x:g}")
        else:
            axes.set_ylabel("probability of a lump (no size to compare)")
            axes.set_ylim(-0.05, 1.15)
        _lines(axes, ladder)
        if shown:
            axes.set_xscale("log")
            axes.xaxis.set_major_formatter("{x:g}")
            axes.xaxis.set_minor_formatter(lambda x, _: f"{x:g}" if f"{x:e}"[0] in "235" else "")
            axes.margins(x=0.12, y=0.08)
            _names(axes, shown, ladder)
        axes.set_xlabel("CPU time, s")
        axes.set_title(title, fontsize=10)
        figure.legend(loc="outside right upper", fontsize=8, frameon=False)
        figure.text(0.01, 0.01, RESEARCH_USE, fontsize=7, color="0.3")


def _height(one: Priced, ladder: Ladder) -> float:
    """Distance from the reference, mm; without a reference the probability of a lump."""
    if ladder.reference.answer is not None:
        return max(one.off.ends, _LEAST_MM)
    return float("nan") if one.answer.probability is None else one.answer.probability


def _places(rows: list[Priced], ladder: Ladder) -> tuple[list[float], list[float]]:
    return [max(one.seconds, 1e-4) for one in rows], [_height(one, ladder) for one in rows]


def _lines(axes: Axes, ladder: Ladder) -> None:
    """The interval's half width, the tolerance and the reference's own error, each named at the right."""
    answer = ladder.reference.answer
    if answer is None:
        axes.axhline(LIKELY, color="0.5", ls="--", lw=1.0, label=f"needed for a size, {LIKELY:g}")
        return
    named = (
        (answer.half_width_mm, "k", "-", "half width of the interval"),
        (ladder.tolerance_mm, "0.5", "--", "tolerance"),
        (ladder.reference.error_mm, "0.5", ":", "the reference's own error"),
    )
    for value, colour, style, name in named:
        if value > 0:
            shown = max(value, _LEAST_MM)
            axes.axhline(shown, color=colour, ls=style, lw=1.0, zorder=1)
            axes.annotate(
                f"{name}, {value:.2g} mm",
                (1.0, shown),
                xycoords=("axes fraction", "data"),
                xytext=(-4, 3),
                textcoords="offset points",
                fontsize=8,
                ha="right",
                color=colour,
            )


def _names(axes: Axes, shown: list[Priced], ladder: Ladder) -> None:
    """A name beside each point, moved up or down until it covers no other name and no point."""
    figure = axes.figure
    figure.draw_without_rendering()  # type: ignore[union-attr]
    scale = 72.0 / figure.dpi
    right = axes.get_window_extent().x1 * scale
    places = [[float(v) * scale for v in axes.transData.transform(point)] for point in _points(shown, ladder)]
    taken: list[Box] = [(x - 4, y - 4, x + 4, y + 4) for x, y in places]
    for one, (x, y) in sorted(zip(shown, places, strict=True), key=lambda pair: pair[1][1]):
        text = one.label.removeprefix("--method ").removeprefix("--")
        box = _free_place(x, y, _LETTER * len(text), taken, right=right)
        taken.append(box)
        axes.annotate(
            text,
            (one.seconds, _height(one, ladder)),
            xytext=(box[0] - x, box[1] + 2 - y),
            textcoords="offset points",
            fontsize=7,
            zorder=5,
            bbox={"facecolor": "w", "edgecolor": "none", "alpha": 0.7, "pad": 0.3},
        )


def _points(shown: list[Priced], ladder: Ladder) -> list[tuple[float, float]]:
    return list(zip(*_places(shown, ladder), strict=True))


def _free_place(x: float, y: float, wide: float, taken: list[Box], *, right: float) -> Box:
    """Where a name of so many points of width goes: at the right of its point, or the left where the picture ends."""
    begin = x - 8 - wide if x + wide + 8 > right else x + 8
    for step in (0, 1, -1, 2, -2, 3, -3, 4, -4, 5, -5, 6, -6):
        low = y - 4.5 + step * _LINE
        box = (begin, low, begin + wide, low + _LINE)
        if not any(_cover(box, other) for other in taken):
            break
    return box


def _cover(one: Box, other: Box) -> bool:
    return one[0] < other[2] and other[0] < one[2] and one[1] < other[3] and other[1] < one[3]
