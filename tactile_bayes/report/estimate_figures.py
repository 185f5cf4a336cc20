"""Figures of an estimate and of a comparison."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from tactile_bayes.declarations import Record, replace
from tactile_bayes.errors import BadDataError
from tactile_bayes.files.comparison import CompareReport
from tactile_bayes.findings import Finding
from tactile_bayes.geometry import FloatArray
from tactile_bayes.mapping.map import TactileMap
from tactile_bayes.mapping.places import Orientation
from tactile_bayes.posterior.result import Estimate, FittedCells, fitted_cells
from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.report.compare import compare_summary
from tactile_bayes.report.estimate_text import exams_label, no_estimate_line
from tactile_bayes.report.figure_file import figure_file, load_matplotlib, named_exam
from tactile_bayes.report.growth_page import HALF_MM, STEP_MM, Course, DrawnMap, LaidMap, common_limits, on_common_axes
from tactile_bayes.report.map_figure import FitContour, NumberedMass, Place, draw_edges, draw_panel, map_figure
from tactile_bayes.report.quantities import leading_size
from tactile_bayes.size.draws import SizePosterior
from tactile_bayes.size.visits import Compared

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


# --- Picture of a comparison: the visits' maps on common axes and colours, their difference, and the change of size.

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
    with figure_file(path, size_in=(4.0 * (len(shown) + 1), 7.4), force=force) as figure:
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
        moved = "later visits are moved so that the mass lies on itself; maps of a visit are averaged"
        figure.text(0.01, 0.01, f"{view.words}; {moved}.  {RESEARCH_USE}", fontsize=7.5, color="0.3")
    return figure


def _draw_maps(panels: Sequence[Axes], visits: Sequence[tuple[str, LaidMap]], *, label: str, view: Orientation) -> None:
    """Draw the visits, by their names, with one colour bar, and the difference of the last and the first."""
    first, last = visits[0][1], visits[-1][1]
    low, high = common_limits([one for _, one in visits])
    for axes, (name, one) in zip(panels, visits, strict=False):
        image = _draw_cells(axes, one.values, first.origin_mm, cmap="viridis", vmin=low, vmax=high)
        if one.ring_mm is not None:
            for colour, width in (("black", 3.0), ("white", 1.4)):
                axes.plot(*(one.ring_mm + first.origin_mm[:, None]), color=colour, linewidth=width)
        axes.set_title(name, loc="left", fontsize=11)
        _name_axes(axes, first.origin_mm, view)
    figure = panels[0].figure
    bar = figure.colorbar(image, ax=list(panels[:-1]), shrink=0.8, pad=0.01)
    bar.set_label(label, fontsize=8)
    difference = last.values - first.values
    most = max(0.3 * (high - low), float(np.nanmax(np.abs(difference), initial=0.0)))
    image = _draw_cells(panels[-1], difference, first.origin_mm, cmap="RdBu_r", vmin=-most, vmax=most)
    panels[-1].set_title("Last minus first", loc="left", fontsize=11)
    _name_axes(panels[-1], first.origin_mm, view)
    bars = [bar, figure.colorbar(image, ax=panels[-1], shrink=0.8, pad=0.01)]
    bars[1].set_label(f"difference of {label}", fontsize=8)
    for each in bars:
        each.ax.tick_params(labelsize=7)


def _draw_cells(axes: Axes, values: FloatArray, origin_mm: FloatArray, **how: Any) -> Any:
    """Draw values about the mass; places without data stay grey."""
    axes.set_facecolor("0.85")
    half = HALF_MM + STEP_MM / 2
    extent = (origin_mm[0] - half, origin_mm[0] + half, origin_mm[1] - half, origin_mm[1] + half)
    shown = np.ma.masked_invalid(values)
    return axes.imshow(shown, origin="lower", extent=extent, interpolation="nearest", **how)


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
