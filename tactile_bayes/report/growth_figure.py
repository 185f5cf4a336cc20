"""Picture of a comparison: the visits' maps on common axes and colours, their difference, and the change of size."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from tactile_bayes.files.comparison import CompareReport
from tactile_bayes.geometry import FloatArray
from tactile_bayes.mapping.places import Orientation
from tactile_bayes.report.compare import compare_summary
from tactile_bayes.report.figure_file import figure_file, named_exam
from tactile_bayes.report.growth_page import HALF_MM, STEP_MM, Course, DrawnMap, LaidMap, common_limits, on_common_axes
from tactile_bayes.report.map_figure import draw_cells, draw_edges
from tactile_bayes.size.visits import Compared

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_MOST_VISITS: Final = 4


def draw_comparison(
    compared: Compared,
    report: CompareReport,
    visits: Sequence[Sequence[DrawnMap]],
    path: Path | None,
    *,
    force: bool = False,
) -> Figure:
    """Draw the visits' maps, the difference of the last and the first, and the posterior of the change.

    Maps of a visit are averaged about the mass. With landmarks on all maps the axes are the patient's, at the first
    visit's place, and later visits are moved so that the mass lies on itself. Without, they are the plane's.

    `visits`: maps of each visit; `path`: written as PNG, PDF or SVG; None writes nothing.
    """
    laid, view = on_common_axes(report, visits)
    shown = [0, *range(max(1, len(laid) - _MOST_VISITS + 1), len(laid))]
    foot = f"{view.words}; later visits are moved so that the mass lies on itself; maps of a visit are averaged."
    with figure_file(path, size_in=(4.0 * (len(shown) + 1), 7.4), foot=foot, force=force) as figure:
        exam = named_exam("", report.provenance.get("scans", ()))
        figure.suptitle(f"Comparison: {exam}" if exam else "Comparison", x=0.01, ha="left", fontsize=11)
        grid = figure.add_gridspec(2, len(shown) + 1, height_ratios=(1.35, 1.0))
        panels = [figure.add_subplot(grid[0, i]) for i in range(len(shown) + 1)]
        words = visits[0][0].tactile_map.recipe.value_words
        _draw_maps(panels, [(Course().of(report.visits[i]), laid[i]) for i in shown], label=words, view=view)
        _draw_change(figure.add_subplot(grid[1, 0]), compared)
        words_axes = figure.add_subplot(grid[1, 1:])
        words_axes.set_axis_off()
        lines = [part for line in compare_summary(report).splitlines()[:-1] for part in textwrap.wrap(line, 96)]
        text = "\n".join(line for line in lines if not line.startswith("More ("))
        words_axes.text(0.0, 1.0, text, va="top", fontsize=8.5, transform=words_axes.transAxes)
    return figure


def _draw_maps(panels: Sequence[Axes], visits: Sequence[tuple[str, LaidMap]], *, label: str, view: Orientation) -> None:
    """Draw the visits, by their names, with one colour bar, and the difference of the last and the first."""
    first, last = visits[0][1], visits[-1][1]
    low, high = common_limits([one for _, one in visits])
    difference = last.values - first.values
    most = max(0.3 * (high - low), float(np.nanmax(np.abs(difference), initial=0.0)))
    half = HALF_MM + STEP_MM / 2
    extent = tuple(middle + side for middle in first.origin_mm for side in (-half, half))
    pictures = [(name, one.values, {"cmap": "viridis", "vmin": low, "vmax": high}) for name, one in visits]
    pictures.append(("Last minus first", difference, {"cmap": "RdBu_r", "vmin": -most, "vmax": most}))
    drawn = []
    for axes, (name, values, how) in zip(panels, pictures, strict=True):
        drawn.append(draw_cells(axes, np.ma.masked_invalid(values), extent, **how))
        axes.set_title(name, loc="left", fontsize=11)
        _name_axes(axes, first.origin_mm, view)
    for axes, (_, one) in zip(panels, visits, strict=False):
        if one.ring_mm is not None:
            for colour, width in (("black", 3.0), ("white", 1.4)):
                axes.plot(*(one.ring_mm + first.origin_mm[:, None]), color=colour, linewidth=width)
    for image, beside, words in ((drawn[0], panels[:-1], label), (drawn[-1], panels[-1:], f"difference of {label}")):
        bar = panels[0].figure.colorbar(image, ax=list(beside), shrink=0.8, pad=0.01)
        bar.set_label(words, fontsize=8)
        bar.ax.tick_params(labelsize=7)


def _name_axes(axes: Axes, origin_mm: FloatArray, view: Orientation) -> None:
    """Name the axes and the edges; of a mass right of the xiphoid the mm are told to the patient's right."""
    words = (f"{view.right} from the mass (mm)", f"{view.up} from the mass (mm)")
    if view.notch is not None:
        side = "left"
        if origin_mm[0] < 0:
            side = "right"
            axes.xaxis.set_major_formatter(lambda value, _: f"{0.0 - value:g}")
        words = (f"to the patient's {side} of the xiphoid (mm)", "above the xiphoid (mm)")
    axes.set_xlabel(words[0], fontsize=8)
    axes.set_ylabel(words[1], fontsize=8)
    axes.tick_params(labelsize=7)
    draw_edges(axes, view)


def _draw_change(axes: Axes, compared: Compared) -> None:
    """Draw the posterior of the change from the first visit to the last."""
    axes.set_yticks([])
    joint = compared.joint
    if joint is None:
        axes.set_axis_off()
        return
    percent = 100.0 * np.expm1(joint.change(0, len(joint.log_size) - 1).log_ratio)
    low, high = np.nanquantile(percent, [0.001, 0.999])
    axes.hist(percent[(percent > low) & (percent < high)], bins=60, color="0.6")
    axes.axvline(0.0, color="black", linewidth=1.2)
    axes.set_xlabel("change of the diameter (%)", fontsize=9)
    axes.set_title("Posterior of the change", loc="left", fontsize=11)
