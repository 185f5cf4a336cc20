"""Figures of an estimate and of a comparison."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from tactile_bayes.declarations import Record, replace
from tactile_bayes.errors import BadDataError
from tactile_bayes.findings import Finding
from tactile_bayes.geometry import FloatArray
from tactile_bayes.mapping.map import TactileMap
from tactile_bayes.posterior.result import Estimate, FittedCells, fitted_cells
from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.report.estimate_text import exams_label, no_estimate_line
from tactile_bayes.report.figure_file import figure_file, load_matplotlib
from tactile_bayes.report.map_figure import FitContour, NumberedMass, Place, draw_panel, map_figure
from tactile_bayes.report.quantities import leading_size
from tactile_bayes.size.draws import SizePosterior

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


# --- Picture of a fit: the window's data, the fitted values and what is left, side by side.

# The colours' ends leave these shares of the cells outside, so that one cell at the rim does not take them all.
_ENDS: Final = (0.005, 0.995)
_SHARED: Final = (
    "Shared: what neighbouring cells have in common beside the fit, which the model takes for smooth noise. "
    "Rest: noise of single cells."
)
_ALONE: Final = "Fit: level, slope and bump. Rest: noise, and what the model lacks."


def fit_figure(
    tactile_map: TactileMap,
    fitted: FittedCells,
    path: Path | None,
    *,
    title: str = "",
    findings: Sequence[Finding] = (),
    force: bool = False,
) -> Figure:
    """Draw data, fit and what is left of a fit window, data and fit in the same colours; see `figure_file`.

    `tactile_map`: the map that the window is of; `fitted`: the window's cells, see `fitted_cells`; `title`: above the
    figure; nothing that identifies a person; `findings`: what speaks against the fit, told above it. What is left is
    drawn in two parts where the noise is a field: what neighbouring cells share of it, and the rest.
    """
    given = [fitted.value, fitted.fit, *([] if fitted.shared is None else [fitted.shared]), fitted.residual]
    window, (value, fit, *left) = _window(tactile_map, fitted, given)
    low, high = (float(end) for end in np.nanquantile(np.stack([value, fit]), _ENDS))
    most = max(float(np.nanquantile(np.abs(left), _ENDS[1])), 1e-12)
    words, rest = tactile_map.recipe.value_words, left[-1]
    known = rest[np.isfinite(rest)]
    with figure_file(
        path, size_in=(10.0, 7.9) if len(left) > 1 else (12.8, 4.1), force=force, findings=findings
    ) as figure:
        panels = figure.subplots(*((2, 2) if len(left) > 1 else (1, 3))).ravel()
        for axes, values, name in ((panels[0], value, "Data"), (panels[1], fit, "Fit")):
            draw_panel(axes, values, window, label=words, title=name, cmap="viridis", vmin=low, vmax=high)
        titles = [*(["Shared by neighbours"] if len(left) > 1 else []), f"Rest, SD {known.std():.2g}, "
                  f"{100 * np.mean(known > 0):.0f} % of cells above 0"]  # fmt: skip
        for axes, values, name in zip(panels[2:], left, titles, strict=True):
            draw_panel(axes, values, window, label="data less fit", title=name, cmap="RdBu_r", vmin=-most, vmax=most)
        figure.suptitle(title or "Fit", x=0.01, ha="left", fontsize=11)
        caption = _SHARED if len(left) > 1 else _ALONE
        figure.text(0.01, 0.01, f"{caption}  {RESEARCH_USE}", fontsize=7.5, color="0.3")
    return figure


def _window(
    tactile_map: TactileMap, fitted: FittedCells, given: Sequence[FloatArray]
) -> tuple[TactileMap, list[FloatArray]]:
    """The map cut to the window, and values of the window's cells on its grid, NaN outside the window."""
    cell = tactile_map.recipe.cell_mm
    columns = np.rint((fitted.x_mm - tactile_map.x_mm[0]) / cell).astype(int)
    rows = np.rint((fitted.y_mm - tactile_map.y_mm[0]) / cell).astype(int)
    part = (slice(rows.min(), rows.max() + 1), slice(columns.min(), columns.max() + 1))
    cut = replace(
        tactile_map,
        mean=tactile_map.mean[part],
        variance=tactile_map.variance[part],
        count=tactile_map.count[part],
        x_mm=tactile_map.x_mm[part[1]],
        y_mm=tactile_map.y_mm[part[0]],
    )
    grids = []
    for values in given:
        grid = np.full(tactile_map.mean.shape, np.nan)
        grid[rows, columns] = values
        grids.append(grid[part])
    return cut, grids


# --- Picture of a size posterior: densities, medians and intervals of the largest and smallest size.

_MAX_COLOUR, _MIN_COLOUR = "#1f3b73", "#c8641e"  # tell apart in greyscale too
_ALIKE_COLOUR = "0.4"
# The axis ends at these quantiles of the draws, or at an interval's end where that lies farther out.
_SHOWN: Final = (0.005, 0.985)
_ROUND: Final = 0.9
"""Where largest and smallest size are one in so many of the draws, the two densities are one to the eye."""
_KINDS: Final = {"eti": "equal-tailed", "hdi": "highest-density"}


class SizeInterval(Record):
    """A labelled credible interval: ``SizeInterval(12.1, 15.9, 0.95, "equal-tailed")``, with what it `supposes`."""

    low_mm: float
    high_mm: float
    probability: float
    kind: str
    supposes: str = ""


def size_figure(
    draws_max_mm: FloatArray,
    draws_min_mm: FloatArray,
    path: Path | None,
    *,
    intervals: Mapping[str, SizeInterval],
    title: str = "",
    findings: Sequence[Finding] = (),
    force: bool = False,
) -> Figure:
    """Draw the posterior of a lump's largest and smallest size; with a path, also write it (PNG, PDF or SVG).

    `draws_max_mm`, `draws_min_mm` (n,) arrays: posterior draws; those that are not finite are left out; `intervals`:
    for ``"max"``, ``"min"`` and ``"alike"``, drawn as bars labelled with probability and kind; the last is of the
    largest size if exams differ less; `title`: above the figure; nothing that identifies a person; `findings`: what
    speaks against the size, told above it.
    """
    alike = float(np.mean(np.isclose(draws_max_mm, draws_min_mm))) if len(draws_max_mm) == len(draws_min_mm) else 0.0
    rows = [("largest", draws_max_mm, _MAX_COLOUR, "-", "max"), ("smallest", draws_min_mm, _MIN_COLOUR, "--", "min")]
    more = ""
    if alike >= _ROUND:
        rows, more = rows[:1], f"\n(the smallest is the same in {100 * alike:.0f} % of the draws)"
    bars = len(rows) + ("alike" in intervals)
    with figure_file(path, size_in=(7.0, 3.2 + 0.4 * bars), force=force, findings=findings) as figure:
        axes = figure.subplots()
        for row, (size, draws, colour, dash, key) in enumerate(rows):
            _draw_density(axes, size, draws, colour=colour, dash=dash, more=more)
            if key in intervals:
                _draw_interval(axes, intervals[key], size=size, row=row, colour=colour)
        if "alike" in intervals:
            _draw_interval(axes, intervals["alike"], size="largest", row=len(rows), colour=_ALIKE_COLOUR)
        axes.set_title(title or "Size of the lump", loc="left", fontsize=11)
        axes.set_xlim(_span((draws_max_mm, draws_min_mm), intervals))
        axes.set_xlabel("size (mm)", fontsize=9)
        axes.set_ylabel("posterior density (1/mm)", fontsize=9)
        axes.set_ylim(bottom=0)
        axes.tick_params(labelsize=8)
        axes.spines[["top", "right"]].set_visible(False)
        axes.legend(fontsize=8, frameon=False)
        figure.text(0.01, 0.01, RESEARCH_USE, fontsize=7.5, color="0.3")
    return figure


def _span(draws_mm: Sequence[FloatArray], intervals: Mapping[str, SizeInterval]) -> tuple[float, float]:
    """Ends of the axis: nearly all draws and all intervals, without a heavy tail's outermost draws."""
    ends = [float(end) for one in draws_mm for end in np.quantile(one[np.isfinite(one)], _SHOWN)]
    ends += [end for one in intervals.values() for end in (one.low_mm, one.high_mm)]
    margin = 0.05 * (max(ends) - min(ends)) or 1.0
    return max(0.0, min(ends) - margin) if min(ends) >= 0 else min(ends) - margin, max(ends) + margin


def _density(draws_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Smoothed density of positive draws on 400 points: a histogram convolved with a Gaussian, mirrored at 0.

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
    return np.asarray(kernel @ weights / (width_mm * np.sqrt(2 * np.pi)))


def _draw_density(axes: Axes, size: str, draws_mm: FloatArray, *, colour: str, dash: str, more: str) -> None:
    sizes, density = _density(draws_mm)
    median = float(np.median(draws_mm[np.isfinite(draws_mm)]))
    label = f"{size} size, median {median:.1f} mm{more}"
    axes.plot(sizes, density, color=colour, linestyle=dash, linewidth=1.8, label=label)
    axes.fill_between(sizes, density, color=colour, alpha=0.15, linewidth=0)
    axes.vlines(median, 0.0, float(np.interp(median, sizes, density)), color=colour, linestyle=dash, linewidth=1.2)


def _draw_interval(axes: Axes, interval: SizeInterval, *, size: str, row: int, colour: str) -> None:
    """Draw a bar below the densities, labelled with the size that it is of, its ends, probability and kind."""
    transforms = load_matplotlib().transforms
    # in inches below the axes: the layout makes room for what does not grow with them
    below = transforms.ScaledTranslation(0.0, -0.52 - 0.32 * row, axes.figure.dpi_scale_trans)
    across = transforms.blended_transform_factory(axes.transData, axes.transAxes) + below
    bar: dict[str, Any] = {"linewidth": 3, "solid_capstyle": "butt", "marker": "|", "markersize": 10}
    axes.plot([interval.low_mm, interval.high_mm], [0.0, 0.0], transform=across, color=colour, clip_on=False, **bar)
    kind = _KINDS.get(interval.kind, interval.kind)
    ends = f"{interval.low_mm:.1f} to {interval.high_mm:.1f} mm"
    text = f"{size}, {ends}: {100 * interval.probability:g} % interval ({kind})"
    text = f"{text} {interval.supposes}".rstrip()
    middle = (interval.low_mm + interval.high_mm) / 2
    axes.text(middle, -0.02, text, transform=across, ha="center", va="top", fontsize=8, color=colour)


# --- The figures of `estimate`: the size posterior, and the map with the lump or the places looked at.


def draw_figures(
    tactile_map: TactileMap,
    estimate: Estimate,
    figure: Path | None,
    map_figure: Path | None,
    fit_figure: Path | None = None,
    *,
    name: str,
    probability: float,
    force: bool,
) -> None:
    """Draw the requested figures. Without a size, or a fit, they show the map, the places looked at and the reason.

    `figure`, `map_figure`, `fit_figure`: where to; None draws nothing. A map without data cannot be drawn; `name`: of
    the map, for the titles; `probability`: of the interval of the size.
    """
    if figure is not None and estimate.size is not None:
        draw_size(estimate.size, figure, name=name, probability=probability, findings=estimate.findings, force=force)
        figure = None
    if fit_figure is not None and estimate.draws is not None:
        draw_fit(tactile_map, estimate, fit_figure, name=name, force=force)
        fit_figure = None
    if tactile_map.covered.any():
        for path in (figure, map_figure, fit_figure):
            if path is not None:
                draw_map(tactile_map, estimate, path, name=name, force=force)


def draw_size(
    size: SizePosterior, path: Path | None, *, name: str, probability: float, findings: Sequence[Finding], force: bool
) -> Figure:
    """Draw the posterior of the largest and smallest size with their intervals, and what speaks against them."""
    leads = leading_size(size)
    quantities = {which: leads.summarise(f"{which}_size_mm", probability=probability) for which in ("max", "min")}
    intervals = {which: SizeInterval(q.low, q.high, q.probability, q.kind) for which, q in quantities.items()}
    if size.another_exam is not None:
        q = size.summarise("max_size_mm", probability=probability)
        supposes = exams_label(size.figures.get("between_map_sd"))
        intervals["alike"] = SizeInterval(q.low, q.high, q.probability, q.kind, supposes)
    draws, title = (leads.max_size_mm.ravel(), leads.min_size_mm.ravel()), f"Size of the lump: {name}"
    return size_figure(*draws, path, intervals=intervals, title=title, findings=findings, force=force)


def draw_fit(tactile_map: TactileMap, estimate: Estimate, path: Path | None, *, name: str, force: bool) -> Figure:
    """Draw data, fit and residual of the fit window side by side."""
    fitted = fitted_cells(estimate)
    assert fitted is not None
    return fit_figure(tactile_map, fitted, path, title=f"Fit: {name}", findings=estimate.findings, force=force)


def draw_map(tactile_map: TactileMap, estimate: Estimate, path: Path | None, *, name: str, force: bool) -> Figure:
    """Draw the map with the lump's ellipse and size, or with the places looked at and the reason for no number."""
    places = [Place(one.centre_mm, one.fault) for one in estimate.candidates if one.fault]
    masses, note = [], ""
    for number, mass in enumerate(estimate.masses, start=1):
        contour = _contour(mass.estimate)
        if contour is None:
            masses.append(NumberedMass(number, (mass.x_mm, mass.y_mm)))
        else:
            masses.append(NumberedMass(number, contour.centre_mm, contour.size_mm, contour.angle_deg))
    if estimate.reason and estimate.size is None:
        gone = estimate.status == "no_estimate"
        note = no_estimate_line(estimate.reason) if gone else f"No size: {estimate.reason}."
    return map_figure(
        tactile_map,
        path,
        fit=_contour(estimate),
        masses=masses,
        looked_at=places,
        title=f"Tactile map: {name}",
        note=note,
        findings=estimate.findings,
        force=force,
    )


def _contour(estimate: Estimate) -> FitContour | None:
    """Ellipse and size at the posterior medians."""
    found, size = estimate.map_posterior, estimate.size
    if found is None:
        return None
    names = ("x_mm", "y_mm", "sigma_x_mm", "sigma_y_mm", "angle_rad", "background", "amplitude")
    x, y, sigma_x, sigma_y, angle, level, amplitude = (float(np.median(getattr(found, name))) for name in names)
    sizes = None if size is None else (float(np.nanmedian(size.d_x_mm)), float(np.nanmedian(size.d_y_mm)))
    return FitContour((x, y), sigma_x, sigma_y, float(np.degrees(angle)), sizes, level, amplitude)
