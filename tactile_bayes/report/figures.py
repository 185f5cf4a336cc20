"""Pictures for people: a tactile map with its coverage, and a size with its uncertainty. Equal input, equal bytes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tactile_bayes.errors import BadDataError
from tactile_bayes.files.atomic import atomic_path
from tactile_bayes.geometry import FloatArray
from tactile_bayes.mapping.tactile_map import FEW_READINGS, TactileMap
from tactile_bayes.presets import RESEARCH_USE

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_DPI = 150
_SCALE_BAR_MM = 10.0
# Lines of hatching across the longer side of the map.
_HATCHES = 60
# The colours span at least this share of the level below and above it, so that noise alone does not look like a lump.
_LEAST_COLOURS = (0.9, 1.3)
_VALUE_LABELS = {
    "mean": "pressure / mean of its frame",
    "gain": "pressure / level beside a lump",
    "none": "mean pressure (kPa)",
}
_MAX_COLOUR, _MIN_COLOUR = "#1f3b73", "#c8641e"  # tell apart in greyscale too


@dataclass(frozen=True, slots=True)
class FitContour:
    """Where a fit saw the lump on the map.

    Parameters
    ----------
    centre_mm
        x and y on the plane.
    sigma_x_mm, sigma_y_mm
        Widths along the fit's own axes.
    angle_deg
        From the plane's x axis to the fit's, positive from x towards y.
    """

    centre_mm: tuple[float, float]
    sigma_x_mm: float
    sigma_y_mm: float
    angle_deg: float = 0.0


@dataclass(frozen=True, slots=True)
class SizeInterval:
    """A credible interval as it is labelled: ``SizeInterval(12.1, 15.9, 0.95, "equal-tailed")``."""

    low_mm: float
    high_mm: float
    probability: float
    kind: str


def map_figure(
    tactile_map: TactileMap, path: Path, *, fit: FitContour | None = None, title: str = "", force: bool = False
) -> None:
    """Draw a map in mm beside its coverage, and write it as PNG.

    A map on a plane is drawn as the examiner sees the breast, z into the page: x runs to the left when y runs up. With
    landmarks the sternal notch is in the upper half, and an arrow points to it.

    Cells with fewer than `FEW_READINGS` readings are hatched in both panels.

    Parameters
    ----------
    fit
        Drawn as its 1- and 2-sigma ellipses.
    title
        Above the map; nothing that identifies a person.

    Raises
    ------
    BadDataError
        When no cell holds data.
    UsageError
        When `path` exists and `force` is false.
    """
    if not tactile_map.covered.any():
        raise BadDataError("the map holds no data to draw", way_out="make it from a scan with frames in the window")
    with _figure(path, size_in=(10.0, 4.5), force=force) as figure:
        left, right = figure.subplots(1, 2, width_ratios=(1.55, 1.0))
        _draw_values(left, tactile_map)
        _draw_coverage(right, tactile_map)
        for axes in (left, right):
            _hatch_few(axes, tactile_map)
            _orient(axes, tactile_map)
        _explain_hatching(right, tactile_map)
        if fit:
            _draw_fit(left, fit)
        _draw_scale_bar(left)
        _draw_notch(left, tactile_map)
        left.set_title(title or "Tactile map", loc="left", fontsize=11)
        figure.text(0.01, 0.01, _caption(tactile_map), fontsize=7.5, color="0.3")


def size_figure(
    draws_max_mm: FloatArray,
    draws_min_mm: FloatArray,
    path: Path,
    *,
    intervals: Mapping[str, SizeInterval],
    truth: tuple[float, float] | None = None,
    force: bool = False,
) -> None:
    """Draw the posterior of a lump's largest and smallest size, and write it as PNG.

    Parameters
    ----------
    draws_max_mm, draws_min_mm : (n,) arrays
        Posterior draws; those that are not finite are left out.
    intervals
        For ``"max"`` and ``"min"``, drawn as bars labelled with probability and kind.
    truth
        Known (largest, smallest) size in mm, drawn as lines.

    Raises
    ------
    BadDataError
        When there are fewer than two finite draws.
    UsageError
        When `path` exists and `force` is false.
    """
    with _figure(path, size_in=(7.0, 4.0), force=force) as figure:
        axes = figure.subplots()
        rows = (("max", draws_max_mm, _MAX_COLOUR, "-"), ("min", draws_min_mm, _MIN_COLOUR, "--"))
        for row, (name, draws, colour, dash) in enumerate(rows):
            _draw_density(axes, name, draws, colour=colour, dash=dash)
            if name in intervals:
                _draw_interval(axes, intervals[name], row=row, colour=colour)
            if truth is not None:
                known = "known size" if row == 0 else None
                axes.axvline(truth[row], color=colour, linestyle=":", linewidth=1.2, label=known)
        _finish_size(axes)
        figure.text(0.01, 0.01, RESEARCH_USE, fontsize=7.5, color="0.3")


@contextmanager
def _figure(path: Path, *, size_in: tuple[float, float], force: bool) -> Iterator[Figure]:
    """A figure that is written when the block ends; the user's own matplotlib settings do not reach it."""
    import matplotlib
    from matplotlib.figure import Figure

    with matplotlib.rc_context(), atomic_path(path, force=force) as partial:
        matplotlib.rcdefaults()
        figure = Figure(figsize=size_in, dpi=_DPI, layout="constrained")
        figure.get_layout_engine().set(rect=(0.0, 0.04, 1.0, 0.96))  # type: ignore[union-attr,call-arg]
        yield figure
        figure.savefig(partial, format="png", dpi=_DPI, metadata={"Software": None})


def _extent(tactile_map: TactileMap) -> tuple[float, float, float, float]:
    half = tactile_map.recipe.cell_mm / 2
    x, y = tactile_map.x_mm, tactile_map.y_mm
    return (float(x[0]) - half, float(x[-1]) + half, float(y[0]) - half, float(y[-1]) + half)


def _draw_values(axes: Axes, tactile_map: TactileMap) -> None:
    """The heat map; cells without data stay grey."""
    low, high = _colour_range(tactile_map)
    axes.set_facecolor("0.85")
    image = axes.imshow(
        np.ma.masked_where(~tactile_map.covered, tactile_map.mean),
        origin="lower",
        extent=_extent(tactile_map),
        cmap="viridis",
        vmin=low,
        vmax=high,
        interpolation="nearest",
    )
    _colour_bar(axes, image, _VALUE_LABELS[tactile_map.recipe.normalise])


def _colour_range(tactile_map: TactileMap) -> tuple[float, float]:
    """Cells with few readings do not set the range: one noisy edge cell would wash out the lump."""
    well = tactile_map.covered & (~tactile_map.few)
    values = tactile_map.mean[well if well.any() else tactile_map.covered]
    level = float(np.median(values))
    return min(float(values.min()), _LEAST_COLOURS[0] * level), max(float(values.max()), _LEAST_COLOURS[1] * level)


def _draw_coverage(axes: Axes, tactile_map: TactileMap) -> None:
    """Readings a cell: where the map can be trusted."""
    axes.set_facecolor("0.85")
    counts = np.ma.masked_equal(tactile_map.count, 0)
    image = axes.imshow(
        counts, origin="lower", extent=_extent(tactile_map), cmap="cividis", vmin=0, interpolation="nearest"
    )
    _colour_bar(axes, image, "readings a cell")
    axes.set_title("Coverage", loc="left", fontsize=11)


def _hatch_few(axes: Axes, tactile_map: TactileMap) -> None:
    """White lines with black edges over the cells with few readings: to be seen on every colour, and without any."""
    if not tactile_map.few.any():
        return
    from matplotlib import patheffects
    from matplotlib.collections import LineCollection
    from matplotlib.path import Path as Outline

    half = tactile_map.recipe.cell_mm / 2
    rows, columns = np.nonzero(tactile_map.few)
    middle = np.stack([tactile_map.x_mm[columns], tactile_map.y_mm[rows]], axis=1)
    corners = half * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0]])
    codes = [Outline.MOVETO, Outline.LINETO, Outline.LINETO, Outline.LINETO, Outline.CLOSEPOLY]
    cells = Outline((middle[:, None] + corners).reshape(-1, 2), np.tile(codes, len(middle)))
    left, right, bottom, top = _extent(tactile_map)
    height = top - bottom
    starts = np.arange(left - height, right, max(right - left, height) / _HATCHES)
    lines = LineCollection(
        [[(start, bottom), (start + height, top)] for start in starts],
        colors="white",
        linewidths=0.7,
        path_effects=[patheffects.withStroke(linewidth=1.6, foreground="black")],
    )
    axes.add_collection(lines, autolim=False)
    lines.set_clip_path(cells, axes.transData)


def _explain_hatching(axes: Axes, tactile_map: TactileMap) -> None:
    """Below the panel, where it hides no cell."""
    if not tactile_map.few.any():
        return
    from matplotlib.patches import Patch

    sample = Patch(facecolor="0.35", edgecolor="white", hatch="////", linewidth=0)
    label = f"fewer than {FEW_READINGS} readings: noisy"
    axes.legend([sample], [label], loc="upper center", bbox_to_anchor=(0.5, -0.2), fontsize=8, frameon=False)


def _colour_bar(axes: Axes, image: Any, label: str) -> None:
    bar = axes.figure.colorbar(image, ax=axes, shrink=0.75, pad=0.02)
    bar.set_label(label, fontsize=9)
    bar.ax.tick_params(labelsize=8)


def _notch_direction(tactile_map: TactileMap) -> FloatArray | None:
    """(2,) direction of the sternal notch on the plane, or None without a patient frame."""
    if tactile_map.patient_from_plane is None:
        return None
    direction: FloatArray = tactile_map.patient_from_plane[1, :2]
    length = float(np.linalg.norm(direction))
    return direction / length if length > 0 else None


def _orient(axes: Axes, tactile_map: TactileMap) -> None:
    """Turn the axes so that the viewer looks along z, into the tissue."""
    axes.set_xlabel("across the head, x (mm)", fontsize=9)
    axes.set_ylabel("along the head, y (mm)", fontsize=9)
    axes.tick_params(labelsize=8)
    if tactile_map.plane_from_base is None and tactile_map.patient_from_plane is None:
        return
    notch = _notch_direction(tactile_map)
    if notch is not None and notch[1] < 0:
        axes.invert_yaxis()
    else:
        axes.invert_xaxis()


def _draw_fit(axes: Axes, fit: FitContour) -> None:
    from matplotlib import patheffects
    from matplotlib.patches import Ellipse

    outline: list[patheffects.AbstractPathEffect] = [patheffects.withStroke(linewidth=3.2, foreground="black")]
    for sigmas, dash in ((1, "-"), (2, "--")):
        ellipse = Ellipse(
            fit.centre_mm,
            2 * sigmas * fit.sigma_x_mm,
            2 * sigmas * fit.sigma_y_mm,
            angle=fit.angle_deg,
            fill=False,
            edgecolor="white",
            linewidth=1.6,
            linestyle=dash,
            label=f"fit, {sigmas} sigma",
        )
        ellipse.set_path_effects(outline)
        axes.add_patch(ellipse)
    axes.plot(*fit.centre_mm, "+", color="white", markersize=9, markeredgewidth=1.6, path_effects=outline)
    axes.legend(loc="upper right", fontsize=8, facecolor="0.5", labelcolor="white", framealpha=0.8)


def _draw_scale_bar(axes: Axes) -> None:
    """10 mm, whatever way the axes run."""
    from matplotlib import patheffects

    (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
    sign = 1.0 if right > left else -1.0
    start = left + 0.05 * (right - left)
    height = bottom + 0.06 * (top - bottom)
    outline = [patheffects.withStroke(linewidth=4, foreground="black")]
    axes.plot([start, start + sign * _SCALE_BAR_MM], [height, height], color="white", linewidth=3, path_effects=outline)
    axes.annotate(
        f"{_SCALE_BAR_MM:g} mm",
        (start + sign * _SCALE_BAR_MM / 2, height),
        xytext=(0, 4),
        textcoords="offset points",
        ha="center",
        va="bottom",
        color="white",
        fontsize=8,
        path_effects=[patheffects.withStroke(linewidth=2, foreground="black")],
    )


def _draw_notch(axes: Axes, tactile_map: TactileMap) -> None:
    """An arrow towards the sternal notch."""
    from matplotlib import patheffects

    direction = _notch_direction(tactile_map)
    if direction is None:
        return
    (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
    tail = (left + 0.88 * (right - left), bottom + 0.06 * (top - bottom))
    length = 0.14 * abs(top - bottom)
    tip = (tail[0] + length * float(direction[0]), tail[1] + length * float(direction[1]))
    outline = [patheffects.withStroke(linewidth=3, foreground="black")]
    axes.annotate(
        "", tip, tail, arrowprops={"arrowstyle": "-|>", "color": "white", "linewidth": 1.8, "path_effects": outline}
    )
    axes.annotate(
        "to sternal\nnotch",
        tip,
        xytext=(0, 3),
        textcoords="offset points",
        ha="center",
        va="bottom",
        color="white",
        fontsize=8,
        path_effects=[patheffects.withStroke(linewidth=2, foreground="black")],
    )


def _caption(tactile_map: TactileMap) -> str:
    recipe = tactile_map.recipe
    facts = [f"cells {recipe.cell_mm:g} mm", f"normalise {recipe.normalise}"]
    if recipe.pressure_window_kpa:
        facts.append("window {:g} to {:g} kPa".format(*recipe.pressure_window_kpa))
    if tactile_map.frame_count:
        facts.append(f"{tactile_map.frame_count} frames")
    if tactile_map.plane_from_base is not None:
        facts.append("seen from outside, as the examiner does")
    return f"{', '.join(facts)}.  {RESEARCH_USE}"


def _density(draws_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Smoothed density of positive draws on 400 points: a histogram under a Gaussian, mirrored at 0.

    Returns
    -------
    sizes in mm and density per mm, each (400,).
    """
    draws = draws_mm[np.isfinite(draws_mm)]
    if len(draws) < 2:
        raise BadDataError(f"{len(draws)} finite draws cannot be drawn as a density", way_out="give two or more")
    spread = min(float(draws.std()), float(np.subtract(*np.quantile(draws, [0.75, 0.25]))) / 1.349 or np.inf)
    width = max(0.9 * spread * len(draws) ** -0.2, 1e-3 * max(1.0, float(np.abs(draws).max())))
    low, high = np.quantile(draws, [0.001, 0.999])
    low = low - 4 * width
    edges = np.linspace(max(low, 0.0) if draws.min() >= 0 else low, high + 4 * width, 401)
    middle = (edges[1:] + edges[:-1]) / 2
    weights = np.histogram(draws, edges)[0] / len(draws)
    density = _smoothed(middle, middle, weights, width)
    if draws.min() >= 0:
        density = density + _smoothed(-middle, middle, weights, width)
    return middle, density


def _smoothed(at_mm: FloatArray, middle_mm: FloatArray, weights: FloatArray, width_mm: float) -> FloatArray:
    kernel = np.exp(-0.5 * ((at_mm[:, None] - middle_mm[None, :]) / width_mm) ** 2)
    density: FloatArray = kernel @ weights / (width_mm * np.sqrt(2 * np.pi))
    return density


def _draw_density(axes: Axes, name: str, draws_mm: FloatArray, *, colour: str, dash: str) -> None:
    sizes, density = _density(draws_mm)
    median = float(np.median(draws_mm[np.isfinite(draws_mm)]))
    label = f"{'largest' if name == 'max' else 'smallest'} size, median {median:.1f} mm"
    axes.plot(sizes, density, color=colour, linestyle=dash, linewidth=1.8, label=label)
    axes.fill_between(sizes, density, color=colour, alpha=0.15, linewidth=0)


def _draw_interval(axes: Axes, interval: SizeInterval, *, row: int, colour: str) -> None:
    """A bar below the densities, labelled with its ends, probability and kind."""
    from matplotlib.transforms import blended_transform_factory

    across = blended_transform_factory(axes.transData, axes.transAxes)
    height = -0.24 - 0.11 * row
    axes.plot(
        [interval.low_mm, interval.high_mm],
        [height, height],
        transform=across,
        color=colour,
        linewidth=3,
        solid_capstyle="butt",
        marker="|",
        markersize=10,
        clip_on=False,
    )
    text = (
        f"{interval.low_mm:.1f} to {interval.high_mm:.1f} mm, {100 * interval.probability:g} % {interval.kind} interval"
    )
    axes.text(
        (interval.low_mm + interval.high_mm) / 2,
        height + 0.02,
        text,
        transform=across,
        ha="center",
        va="bottom",
        fontsize=8,
        color=colour,
    )


def _finish_size(axes: Axes) -> None:
    axes.set_xlabel("size (mm)", fontsize=9)
    axes.set_ylabel("posterior density (1/mm)", fontsize=9)
    axes.set_ylim(bottom=0)
    axes.tick_params(labelsize=8)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(fontsize=8, frameon=False)
