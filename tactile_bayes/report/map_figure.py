"""Picture of a tactile map: its values beside its coverage, with the fitted lump."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from tactile_bayes.declarations import Record
from tactile_bayes.errors import BadDataError
from tactile_bayes.files.reports import EstimateReport, MassReport, PassedOver
from tactile_bayes.findings import Finding
from tactile_bayes.mapping.map import FEW_READINGS, TactileMap
from tactile_bayes.mapping.places import Orientation, orientation_of
from tactile_bayes.report.figure_file import figure_file, load_matplotlib

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_SCALE_BAR_MM = 10.0
_HATCHES = 60  #: Lines of hatching across the longer side of the map.
# The colours span at least this share of the level below and above it, so that noise alone does not look like a lump.
_LEAST_COLOURS = (0.9, 1.3)
# With a fit they end so many amplitudes above the level, so that a rib beside the lump does not take them all.
_AMPLITUDES_SHOWN = 1.25
_AXIS_WORDS: Final = {"x": "across the head, x (mm)", "y": "along the head, y (mm)"}
# Words above a mark, so many points away.
_ABOVE: Final[dict[str, Any]] = {
    "textcoords": "offset points",
    "ha": "center",
    "va": "bottom",
    "color": "white",
    "fontsize": 8,
}
# Of a legend below a picture, where it hides no cell.
_BELOW: Final[dict[str, Any]] = {"loc": "upper left", "bbox_to_anchor": (0.0, 0.0), "borderaxespad": 4.0}
_MOST_IN: Final = (10.0, 9.0)  #: Width of a figure and its height at most: it ends where its panels do.
_EXPLAINED_PLACES: Final = 4  #: Places that were looked at in vain: so many are explained, the others are only marked.


class FitContour(Record):
    """Place and size of a fitted lump on the map."""

    centre_mm: tuple[float, float]  #: x and y on the plane.
    sigma_x_mm: float
    sigma_y_mm: float
    """`sigma_x_mm`, `sigma_y_mm`: Widths along the fit's own axes."""
    angle_deg: float = 0.0  #: From the plane's x axis to the fit's, positive from x towards y.
    size_mm: tuple[float, float] | None = None  #: The lump's size along the same axes; None where the fit gave no size.
    level: float = 1.0
    amplitude: float | None = None
    """`level`, `amplitude`: Of the fitted bump, in the map's values; None leaves the colours to the map."""


def contour_of(report: EstimateReport) -> FitContour | None:
    """Ellipse and size of an estimate's lump, at the posterior medians; None without one."""
    centre, across, along = report.centre_mm, report.sigma_x_mm, report.sigma_y_mm
    level, height, angle = report.background, report.amplitude, report.angle_deg
    if centre is None or across is None or along is None or level is None or height is None:
        return None
    turn = 0.0 if angle is None else angle.median
    widths = across.median, along.median
    return FitContour(centre.median, *widths, turn, _size_mm(report), level.median, height.median)


def _size_mm(told: EstimateReport | MassReport) -> tuple[float, float] | None:
    """Size of a mass along its ellipse's axes; None without one."""
    return None if told.d_x_mm is None or told.d_y_mm is None else (told.d_x_mm.median, told.d_y_mm.median)


def map_figure(
    tactile_map: TactileMap,
    path: Path | None,
    *,
    fit: FitContour | None = None,
    masses: Sequence[MassReport] = (),
    looked_at: Sequence[PassedOver] = (),
    title: str = "",
    note: str = "",
    findings: Sequence[Finding] | None = None,
    force: bool = False,
) -> Figure:
    """Draw a map in mm beside its coverage, and write it as PNG, PDF or SVG by the suffix.

    It is shown as `orientation_of` says, with the patient's sides or the plane's axes named at its edges. Cells with
    fewer than `FEW_READINGS` readings are hatched in both panels, where the readings of cells are known.

    `fit` is drawn as an ellipse of the lump's size, and dashed as one of the fitted bump's sigmas; `masses` are
    numbered where there are several, and those besides the fitted lump get an ellipse of their size. Places `looked_at`
    are numbered crosses, the first few with their reasons below the coverage. The title, which identifies nobody, and
    `findings`, by default the map's own, stand above the map; a `note`, for example why there is no estimate, above the
    whole figure.
    """
    if not tactile_map.covered.any():
        raise BadDataError("the map holds no data to draw", way_out="make it from a scan with frames in the window")
    view = orientation_of(tactile_map)
    told = tactile_map.findings if findings is None else findings
    foot = _caption(tactile_map, view)
    with figure_file(path, size_in=_MOST_IN, trim=True, foot=foot, force=force, findings=told) as figure:
        left, right = figure.subplots(1, 2, width_ratios=(1.55, 1.0))
        _draw_values(left, tactile_map, view, fit)
        _draw_coverage(right, tactile_map, view)
        for axes in (left, right):
            _hatch_few(axes, tactile_map, view)
            _orient(axes, view, tactile_map)
        if fit:
            _draw_fit(left, fit, view)
        if len(masses) > 1:
            _draw_masses(left, masses, fit, view)
        _draw_scale_bar(left)
        draw_edges(left, view)
        _draw_notch(left, view)
        _draw_places(left, looked_at, view)
        _explain(right, tactile_map, looked_at)
        left.set_title(title or "Tactile map", loc="left", fontsize=11)
        if note:
            figure.suptitle(textwrap.fill(note, 130), x=0.01, ha="left", fontsize=9.5)
    return figure


def _pair(view: Orientation, x: Any, y: Any) -> tuple[Any, Any]:
    """Order two values by the picture's horizontal and vertical axes."""
    return (y, x) if view.swapped else (x, y)


def _extent(tactile_map: TactileMap, view: Orientation) -> tuple[float, float, float, float]:
    """Ends of the horizontal and vertical axes, including the outer halves of the cells."""
    half = tactile_map.recipe.cell_mm / 2
    across, up = _pair(view, tactile_map.x_mm, tactile_map.y_mm)
    return (float(across[0]) - half, float(across[-1]) + half, float(up[0]) - half, float(up[-1]) + half)


def draw_cells(axes: Axes, values: Any, extent: Any, **how: Any) -> Any:
    """Draw values as an image between the ends of its axes; masked cells stay grey."""
    axes.set_facecolor("0.85")
    return axes.imshow(values, origin="lower", extent=extent, interpolation="nearest", **how)


def _draw_map(axes: Axes, values: Any, tactile_map: TactileMap, view: Orientation, **how: Any) -> Any:
    return draw_cells(axes, values.T if view.swapped else values, _extent(tactile_map, view), **how)


def draw_panel(axes: Axes, values: Any, tactile_map: TactileMap, *, label: str, title: str, **how: Any) -> None:
    """Draw cells in the map's orientation, with its sides and a colour bar; NaN stays grey."""
    view = orientation_of(tactile_map)
    image = _draw_map(axes, np.ma.masked_invalid(values), tactile_map, view, **how)
    _colour_bar(axes, image, label)
    _orient(axes, view, tactile_map)
    draw_edges(axes, view)
    axes.set_title(title, loc="left", fontsize=11)


def _draw_values(axes: Axes, tactile_map: TactileMap, view: Orientation, fit: FitContour | None) -> None:
    """Draw the heat map."""
    well = tactile_map.covered & (~tactile_map.few)  # one noisy edge cell would hide the lump
    values = tactile_map.mean[well if well.any() else tactile_map.covered]
    level = float(np.median(values))
    lowest = min(float(values.min()), _LEAST_COLOURS[0] * level)
    highest = max(float(values.max()), _LEAST_COLOURS[1] * level)
    top = highest
    if fit is not None and fit.amplitude is not None:
        top = min(highest, max(_LEAST_COLOURS[1] * fit.level, fit.level + _AMPLITUDES_SHOWN * fit.amplitude))
    cells = np.ma.masked_where(~tactile_map.covered, tactile_map.mean)
    image = _draw_map(axes, cells, tactile_map, view, cmap="viridis", vmin=lowest, vmax=top)
    _colour_bar(axes, image, tactile_map.recipe.value_words, extend="max" if top < highest else "neither")


def _draw_coverage(axes: Axes, tactile_map: TactileMap, view: Orientation) -> None:
    """Draw the number of readings per cell."""
    counts = np.ma.masked_equal(tactile_map.count, 0)
    image = _draw_map(axes, counts, tactile_map, view, cmap="cividis", vmin=0)
    known = tactile_map.counts_known
    if known:
        _colour_bar(axes, image, "readings per cell")
    axes.set_title("Coverage" + ("" if known else " (readings per cell unknown)"), loc="left", fontsize=11)


def _hatch_few(axes: Axes, tactile_map: TactileMap, view: Orientation) -> None:
    """Hatch the cells with few readings in white with black edges, visible on every colour."""
    if not tactile_map.few.any():
        return
    outline = load_matplotlib().path.Path
    half = tactile_map.recipe.cell_mm / 2
    rows, columns = np.nonzero(tactile_map.few)
    middle = np.stack(_pair(view, tactile_map.x_mm[columns], tactile_map.y_mm[rows]), axis=1)
    corners = half * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0]])
    codes = [outline.MOVETO, outline.LINETO, outline.LINETO, outline.LINETO, outline.CLOSEPOLY]
    cells = outline((middle[:, None] + corners).reshape(-1, 2), np.tile(codes, len(middle)))
    left, right, bottom, top = _extent(tactile_map, view)
    height = top - bottom
    starts = np.arange(left - height, right, max(right - left, height) / _HATCHES)
    slants = [[(start, bottom), (start + height, top)] for start in starts]
    looks: dict[str, Any] = {"colors": "white", "linewidths": 0.7, "path_effects": _outlined(1.6)}
    lines = load_matplotlib().collections.LineCollection(slants, **looks)
    axes.add_collection(lines, autolim=False)
    lines.set_clip_path(cells, axes.transData)


def _explain(axes: Axes, tactile_map: TactileMap, places: Sequence[PassedOver]) -> None:
    """Explain hatching and places below the coverage panel, where no cell is hidden."""
    at = "({:.0f}, {:.0f}) mm"
    lines = [f"{i}  {at.format(place.x_mm, place.y_mm)}: {place.fault}" for i, place in enumerate(places, start=1)]
    wrapped = [textwrap.wrap(line, 66, subsequent_indent="    ", max_lines=2) for line in lines[:_EXPLAINED_PLACES]]
    shown = ["\n".join(line) for line in wrapped]
    if len(lines) > len(shown):
        shown.append(f"and {len(lines) - len(shown)} lower ones")
    if shown:
        below_the_legend: dict[str, Any] = {"xytext": (0, -54), "textcoords": "offset points", "va": "top"}
        axes.annotate("\n".join(shown), (0.0, 0.0), xycoords="axes fraction", fontsize=7, **below_the_legend)
    if not tactile_map.few.any():
        return
    sample = load_matplotlib().patches.Patch(facecolor="0.35", edgecolor="white", hatch="////", linewidth=0)
    label = f"fewer than {FEW_READINGS} readings: noisy"
    axes.legend([sample], [label], fontsize=8, frameon=False, **_BELOW)


def _colour_bar(axes: Axes, image: Any, label: str, *, extend: Any = "neither") -> None:
    """Draw a colour bar as high as the panel."""
    bar = axes.figure.colorbar(image, cax=axes.inset_axes((1.02, 0.0, 0.035, 1.0)), extend=extend)
    bar.set_label(label, fontsize=9)
    bar.ax.tick_params(labelsize=8)


def _orient(axes: Axes, view: Orientation, tactile_map: TactileMap) -> None:
    """Label the plane's axes and orient them."""
    axes.set_anchor("N")
    words = _AXIS_WORDS if tactile_map.recipe.source == "scan" else {"x": "x (mm)", "y": "y (mm)"}
    back = {view.right: "larger to the left", view.up: "larger downwards"}
    across, up = (
        words[axis[1]] if axis[0] == "+" else f"{words[axis[1]].removesuffix(')')}, {how})"
        for axis, how in back.items()
    )
    axes.set_xlabel(across, fontsize=9)
    axes.set_ylabel(up, fontsize=9)
    axes.tick_params(labelsize=8)
    if view.right[0] == "-":
        axes.invert_xaxis()
    if view.up[0] == "-":
        axes.invert_yaxis()


def _outlined(width: float) -> list[Any]:
    """Black outline, so that white is visible on every colour."""
    return [load_matplotlib().patheffects.withStroke(linewidth=width, foreground="black")]


def draw_edges(axes: Axes, view: Orientation) -> None:
    """Label the edges: the patient's R, L, H (head) and F (feet), or else axes."""
    places = {"left": (0.015, 0.5), "right": (0.985, 0.5), "top": (0.5, 0.975), "bottom": (0.5, 0.025)}
    aligned = {"left": ("left", "center"), "right": ("right", "center"), "top": ("center", "top")}
    for side, name in view.edges.items():
        across, up = aligned.get(side, ("center", "bottom"))
        looks: dict[str, Any] = {"ha": across, "va": up, "color": "white", "fontsize": 10}
        axes.text(*places[side], name, transform=axes.transAxes, path_effects=_outlined(2.5), **looks)


def _draw_fit(axes: Axes, fit: FitContour, view: Orientation) -> None:
    """Draw the lump's size where there is one, and the fitted bump, which is wider than the lump, dashed."""
    bump = (2 * fit.sigma_x_mm, 2 * fit.sigma_y_mm)
    ellipses = [(bump, "--", 1.2, "fitted bump, 1 sigma (not the lump's edge)")]
    if fit.size_mm is not None:
        ellipses.insert(0, (fit.size_mm, "-", 1.8, "size, median {:.1f} by {:.1f} mm".format(*fit.size_mm)))
    centre = _pair(view, *fit.centre_mm)
    for size_mm, dash, width, label in ellipses:
        _draw_ellipse(axes, centre, size_mm, fit.angle_deg, view, linewidth=width, linestyle=dash, label=label)
    axes.plot(*centre, "+", color="white", markersize=9, markeredgewidth=1.6, path_effects=_outlined(3.2))
    axes.legend(fontsize=8, facecolor="0.4", labelcolor="white", **_BELOW)


def _draw_ellipse(
    axes: Axes, centre: Any, size_mm: tuple[float, float], angle_deg: float, view: Orientation, **line: Any
) -> None:
    """Draw an ellipse of the given diameters, outlined in black."""
    angle = -angle_deg if view.swapped else angle_deg
    ellipse = load_matplotlib().patches.Ellipse(
        centre, *_pair(view, *size_mm), angle=angle, fill=False, edgecolor="white", **line
    )
    ellipse.set_path_effects(_outlined(line["linewidth"] + 1.6))
    axes.add_patch(ellipse)


def _draw_masses(axes: Axes, masses: Sequence[MassReport], fit: FitContour | None, view: Orientation) -> None:
    """Draw the number of each mass, and a cross and the size of those besides the fitted lump."""
    for mass in masses:
        centre, size_mm = _pair(view, *mass.centre_mm.median), _size_mm(mass)
        above = max(size_mm or (0.0, 0.0)) / 2.0
        top = centre[1] + (above if axes.get_ylim()[1] > axes.get_ylim()[0] else -above)
        words = f"mass {mass.number}"
        axes.annotate(words, (centre[0], top), xytext=(0, 4), path_effects=_outlined(2.5), **_ABOVE)
        if fit is not None and mass.reported:
            continue
        axes.plot(*centre, "+", color="white", markersize=7, markeredgewidth=1.4, path_effects=_outlined(3.0))
        if size_mm is not None:
            angle = 0.0 if mass.angle_deg is None else mass.angle_deg.median
            _draw_ellipse(axes, centre, size_mm, angle, view, linewidth=1.0)


def _draw_places(axes: Axes, places: Sequence[PassedOver], view: Orientation) -> None:
    """Draw a numbered cross at each place where no lump was measured."""
    for number, place in enumerate(places, start=1):
        at = _pair(view, place.x_mm, place.y_mm)
        axes.plot(*at, "x", color="white", markersize=6, markeredgewidth=1.4, path_effects=_outlined(3.0))
        if number <= _EXPLAINED_PLACES:
            beside = _ABOVE | {"ha": "left", "va": "center", "fontsize": 9, "path_effects": _outlined(2.5)}
            axes.annotate(f"{number}", at, xytext=(6, 0), **beside)


def _draw_scale_bar(axes: Axes) -> None:
    """Draw a scale bar of 10 mm."""
    (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
    sign = 1.0 if right > left else -1.0
    start = left + 0.05 * (right - left)
    height = bottom + 0.06 * (top - bottom)
    ends = [start, start + sign * _SCALE_BAR_MM]
    axes.plot(ends, [height, height], color="white", linewidth=3, path_effects=_outlined(4))
    middle = (start + sign * _SCALE_BAR_MM / 2, height)
    axes.annotate(f"{_SCALE_BAR_MM:g} mm", middle, xytext=(0, 4), path_effects=_outlined(2), **_ABOVE)


def _draw_notch(axes: Axes, view: Orientation) -> None:
    """Draw an arrow towards the sternal notch."""
    if view.notch is None:
        return
    (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
    tail, length = (0.86, 0.08), 0.16
    across, up = view.notch
    tip = (tail[0] + length * across * abs((top - bottom) / (right - left)), tail[1] + length * up)
    arrow = {"arrowstyle": "-|>", "color": "white", "linewidth": 1.8, "path_effects": _outlined(3)}
    axes.annotate("", tip, tail, xycoords="axes fraction", arrowprops=arrow)
    words: dict[str, Any] = {"xycoords": "axes fraction", "path_effects": _outlined(2)} | _ABOVE
    axes.annotate("to sternal\nnotch", tip, xytext=(0, 3), **words)


def _caption(tactile_map: TactileMap, view: Orientation) -> str:
    recipe = tactile_map.recipe
    facts = [f"cells {recipe.cell_mm:g} mm", f"normalise {recipe.normalise}"]
    if recipe.pressure_window_kpa:
        facts.append("window {:g} to {:g} kPa".format(*recipe.pressure_window_kpa))
    if tactile_map.frame_count:
        facts.append(f"{tactile_map.frame_count} frames")
    return f"{view.words}.  {', '.join(facts)}."
