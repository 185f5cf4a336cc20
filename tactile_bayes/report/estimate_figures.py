"""Figures of an estimate: its fit, its size, its map, and its draws."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from tactile_bayes.declarations import replace
from tactile_bayes.errors import BadDataError
from tactile_bayes.files.reports import EstimateReport
from tactile_bayes.findings import Finding
from tactile_bayes.geometry import FloatArray
from tactile_bayes.inference.draws import Quantity
from tactile_bayes.mapping.map import TactileMap
from tactile_bayes.posterior.bump import FitCells
from tactile_bayes.posterior.result import Estimate, fitted_cells
from tactile_bayes.report.estimate_text import exams_label, no_estimate_line
from tactile_bayes.report.figure_file import Axes, Figure, figure_file, finish, load_matplotlib
from tactile_bayes.report.map import draw_panel, map_figure
from tactile_bayes.size.draws import SizePosterior

# --- Picture of a fit: the window's data, the fitted values and what is left, side by side.

# The colours' ends leave these shares of the cells outside, so that one cell at the rim does not take them all.
_ENDS: Final = (0.005, 0.995)
_SHARED: Final = (
    "Shared: what neighbouring cells have in common beside the fit, which the model takes for smooth noise. "
    "Rest: noise of single cells."
)
_ALONE: Final = "Fit: level, slope and bump. Rest: noise, and what the model lacks."


def draw_fit(tactile_map: TactileMap, estimate: Estimate, path: Path | None, *, name: str, force: bool) -> Figure:
    """Draw data, fit and what is left of the fit window, data and fit in the same colours; see `figure_file`.

    What is left is drawn in two parts where the noise is a field: what neighbouring cells share of it, and the rest.
    """
    fitted = fitted_cells(estimate)
    assert fitted is not None
    has_shared = fitted.shared is not None
    layers = [fitted.cells.value, fitted.fit, *([] if fitted.shared is None else [fitted.shared]), fitted.residual]
    window, (value, fit, *left) = _window(tactile_map, fitted.cells, layers)
    low, high = (float(end) for end in np.nanquantile(np.stack([value, fit]), _ENDS))
    limit = max(float(np.nanquantile(np.abs(left), _ENDS[1])), 1e-12)
    rest = fitted.residual
    words = f"Rest, SD {rest.std():.2g}, {100 * np.mean(rest > 0):.0f} % of cells above 0"
    size_in, foot = ((10.0, 7.9), _SHARED) if has_shared else ((12.8, 4.1), _ALONE)
    with figure_file(path, size_in=size_in, foot=foot, force=force, findings=estimate.findings) as figure:
        panels = figure.subplots(*((2, 2) if has_shared else (1, 3))).ravel()
        for axes, values, title in ((panels[0], value, "Data"), (panels[1], fit, "Fit")):
            looks = {"label": tactile_map.recipe.value_words, "title": title, "cmap": "viridis"}
            draw_panel(axes, values, window, **looks, vmin=low, vmax=high)
        titles = [*(["Shared by neighbours"] if has_shared else []), words]
        for axes, values, title in zip(panels[2:], left, titles, strict=True):
            draw_panel(axes, values, window, label="data less fit", title=title, cmap="RdBu_r", vmin=-limit, vmax=limit)
        figure.suptitle(f"Fit: {name}", x=0.01, ha="left", fontsize=11)
    return figure


def _window(
    tactile_map: TactileMap, cells: FitCells, layers: Sequence[FloatArray]
) -> tuple[TactileMap, list[FloatArray]]:
    """The map cut to the window, and values of the window's cells on its grid, NaN outside the window."""
    rows, columns = cells.row, cells.column
    part = (slice(rows.min(), rows.max() + 1), slice(columns.min(), columns.max() + 1))
    cut = replace(
        tactile_map,
        mean=tactile_map.mean[part],
        variance=tactile_map.variance[part],
        count=tactile_map.count[part],
        x_mm=tactile_map.x_mm[part[1]],
        y_mm=tactile_map.y_mm[part[0]],
    )
    inside, *grids = cells.on_grid(np.stack([np.ones(len(cells)), *layers]))
    return cut, [np.where(inside > 0, grid, np.nan) for grid in grids]


# --- Picture of a size posterior: densities, medians and intervals of the largest and smallest size.

_MAX_COLOUR, _MIN_COLOUR = "#1f3b73", "#c8641e"  # tell apart in greyscale too
_ALIKE_COLOUR = "0.4"
# The axis ends at these quantiles of the draws, or at an interval's end where that lies farther out.
_SHOWN: Final = (0.005, 0.985)
_ROUND: Final = 0.9
"""Where largest and smallest size are one in so many of the draws, the two densities are one to the eye."""
_KINDS: Final = {"eti": "equal-tailed", "hdi": "highest-density"}


def draw_size(
    size: SizePosterior, path: Path | None, *, name: str, probability: float, findings: Sequence[Finding], force: bool
) -> Figure:
    """Draw the posterior of the largest and smallest size with their intervals, and what speaks against them.

    Where the largest size has two intervals, the densities are of the one that leads, and a bar below has the other,
    with what it supposes. Draws that are not finite are left out. `name`: nothing that identifies a person.
    """
    leads = size.leading
    rows = [("largest", "max_size_mm", _MAX_COLOUR, "-"), ("smallest", "min_size_mm", _MIN_COLOUR, "--")]
    both = [getattr(leads, which).ravel() for _, which, _, _ in rows]
    alike, more = float(np.mean(np.isclose(*both))), ""
    drawn = {which: draws[np.isfinite(draws)] for (_, which, _, _), draws in zip(rows, both, strict=True)}
    if alike >= _ROUND:
        rows, more = rows[:1], f"\n(the smallest is the same in {100 * alike:.0f} % of the draws)"
    bars = [(words, leads.summarise(which, probability=probability), colour, "") for words, which, colour, _ in rows]
    if size.another_exam is not None:
        supposes = exams_label(size.figures.get("between_map_sd"))
        bars.append(("largest", size.summarise("max_size_mm", probability=probability), _ALIKE_COLOUR, supposes))
    with figure_file(path, size_in=(7.0, 3.2 + 0.4 * len(bars)), force=force, findings=findings) as figure:
        axes = figure.subplots()
        for words, which, colour, dash in rows:
            (sizes, density), median = _density(drawn[which]), float(np.median(drawn[which]))
            looks: dict[str, Any] = {"color": colour, "linestyle": dash}
            axes.plot(sizes, density, linewidth=1.8, label=f"{words} size, median {median:.1f} mm{more}", **looks)
            axes.fill_between(sizes, density, color=colour, alpha=0.15, linewidth=0)
            axes.vlines(median, 0.0, float(np.interp(median, sizes, density)), linewidth=1.2, **looks)
        for row, (words, q, colour, supposes) in enumerate(bars):
            _draw_interval(axes, q, size=words, row=row, colour=colour, supposes=supposes)
        # nearly all draws and all intervals, without a heavy tail's outermost draws
        ends = [float(end) for one in drawn.values() for end in np.quantile(one, _SHOWN)]
        ends += [end for _, q, _, _ in bars for end in (q.low, q.high)]
        margin = 0.05 * (max(ends) - min(ends)) or 1.0
        axes.set_xlim(max(0.0, min(ends) - margin), max(ends) + margin)
        axes.set_ylim(bottom=0)
        finish(axes, f"Size of the lump: {name}", "size (mm)", "posterior density (1/mm)", fontsize=8)
    return figure


def _density(draws: FloatArray) -> tuple[FloatArray, FloatArray]:
    """400 sizes in mm and their smoothed density per mm: a histogram convolved with a Gaussian, mirrored at 0.

    `draws` are above 0, as finite sizes are.
    """
    if len(draws) < 2:
        raise BadDataError(f"{len(draws)} finite draws cannot be drawn as a density", way_out="give two or more")
    spread = min(float(draws.std()), float(np.subtract(*np.quantile(draws, [0.75, 0.25]))) / 1.349 or np.inf)
    width = max(0.9 * spread * len(draws) ** -0.2, 1e-3 * max(1.0, float(np.abs(draws).max())))
    low, high = np.quantile(draws, [0.001, 0.999])
    edges = np.linspace(max(low - 4 * width, 0.0), high + 4 * width, 401)
    middle = (edges[1:] + edges[:-1]) / 2
    weights = np.histogram(draws, edges)[0] / len(draws)
    kernel = np.exp(-0.5 * (np.subtract.outer(middle, middle) / width) ** 2)
    kernel += np.exp(-0.5 * (np.add.outer(middle, middle) / width) ** 2)
    return middle, kernel @ weights / (width * np.sqrt(2 * np.pi))


def _draw_interval(axes: Axes, q: Quantity, *, size: str, row: int, colour: str, supposes: str) -> None:
    """Draw a bar below the densities, labelled with the size that it is of, its ends, probability and kind."""
    transforms = load_matplotlib().transforms
    # in inches below the axes: the layout makes room for what does not grow with them
    below = transforms.ScaledTranslation(0.0, -0.52 - 0.32 * row, axes.figure.dpi_scale_trans)
    across = transforms.blended_transform_factory(axes.transData, axes.transAxes) + below
    bar: dict[str, Any] = {"linewidth": 3, "solid_capstyle": "butt", "marker": "|", "markersize": 10}
    axes.plot([q.low, q.high], [0.0, 0.0], transform=across, color=colour, clip_on=False, **bar)
    text = f"{size}, {q.low:.1f} to {q.high:.1f} mm: {100 * q.probability:g} % interval ({_KINDS[q.kind]}) {supposes}"
    place = ((q.low + q.high) / 2, -0.02)
    axes.text(*place, text.rstrip(), transform=across, ha="center", va="top", fontsize=8, color=colour)


# --- The map of an estimate: with the lump, or with the places looked at.


def draw_map(tactile_map: TactileMap, report: EstimateReport, path: Path | None, *, name: str, force: bool) -> Figure:
    """Draw the map with the lump's ellipse and size, or with the places looked at and the reason for no number."""
    note = ""
    if report.reason and report.max_size_mm is None:
        note = no_estimate_line(report.reason) if report.status == "no_estimate" else f"No size: {report.reason}."
    return map_figure(tactile_map, path, report=report, title=f"Tactile map: {name}", note=note, force=force)


# --- Pictures of a posterior's draws: traces, ranks of the chains, and a corner of pairs.

LABELS: Final = {
    "max_size_mm": "largest size, mm",
    "min_size_mm": "smallest size, mm",
    "amplitude": "amplitude",
    "sigma_x_mm": "sigma x, mm",
    "sigma_y_mm": "sigma y, mm",
    "x_mm": "centre x, mm",
    "y_mm": "centre y, mm",
}
"""Quantities that are drawn, in this order, where the posterior has them."""
_COLOURS: Final = ("#1f3b73", "#c8641e", "#4f8f5b", "#8a5aa3")
_RANK_BINS: Final = 20
_BAND_SD: Final = 3.0
_TRACED: Final = 2000  #: Points of a trace, at most: more are not told apart.
_SHOWN_DRAWS: Final = (0.002, 0.998)


def drawn_quantities(draws: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
    """(chain, draw) arrays of what is drawn, by label."""
    return {label: draws[name] for name, label in LABELS.items() if name in draws}


def trace_figure(draws: Mapping[str, FloatArray], path: Path | None, *, title: str = "", force: bool = False) -> Figure:
    """Draw the density of each quantity by chain, and its draws in their order; see `figure_file` for the file.

    `draws` are (chain, draw) arrays by name; those of `LABELS` are drawn.
    """
    shown = drawn_quantities(draws)
    with figure_file(path, size_in=(9.0, 1.25 * len(shown) + 1.0), force=force) as figure:
        figure.suptitle(title or "Traces", fontsize=11)
        grid = figure.subplots(len(shown), 2, squeeze=False, width_ratios=(1, 2))
        for (density, trace), (label, chains) in zip(grid, shown.items(), strict=True):
            low, high = np.nanquantile(chains, _SHOWN_DRAWS)
            for chain, colour in _by_chain(chains):
                number, edges = np.histogram(chain[np.isfinite(chain)], bins=40, range=(low, high), density=True)
                density.stairs(number, edges, color=colour, linewidth=1.0)
                step = max(1, len(chain) // _TRACED)
                trace.plot(np.arange(0, len(chain), step), chain[::step], color=colour, linewidth=0.4, alpha=0.8)
            density.set_yticks([])
            density.set_xlim(low, high)
            density.set_xlabel(label, fontsize=8)
            trace.margins(x=0.0)
            for axes in (density, trace):
                _bare(axes)
        several = len(next(iter(shown.values()))) > 1
        grid[-1, 1].set_xlabel("draw of a chain, walker after walker" if several else "draw")
    return figure


def rank_figure(draws: Mapping[str, FloatArray], path: Path | None, *, title: str = "", force: bool = False) -> Figure:
    """Draw how each chain's draws rank among all: level bars where the chains agree.

    The band holds a bar but for chance, were draws independent (3 SD); chains are not, and stray a little more.
    """
    shown = drawn_quantities(draws)
    chains = len(next(iter(shown.values())))
    with figure_file(path, size_in=(1.9 * chains + 1.6, 1.05 * len(shown) + 1.0), force=force) as figure:
        figure.suptitle(f"{title or 'Chains'}: ranks among all chains, grey: 3 SD of chance", fontsize=11)
        grid = figure.subplots(len(shown), chains, squeeze=False, sharex=True, sharey=True)
        for row, (label, values) in zip(grid, shown.items(), strict=True):
            ranks = np.argsort(np.argsort(values, axis=None)).reshape(values.shape) / values.size
            expected = values.shape[1] / _RANK_BINS
            spread = _BAND_SD * np.sqrt(expected * (1.0 - 1.0 / _RANK_BINS)) / expected
            for axes, chain, (_, colour) in zip(row, ranks, _by_chain(values), strict=True):
                counts, edges = np.histogram(chain, bins=_RANK_BINS, range=(0.0, 1.0))
                axes.axhspan(1.0 - spread, 1.0 + spread, color="0.9", zorder=0)
                axes.stairs(counts / expected, edges, fill=True, color=colour, alpha=0.8)
                _bare(axes)
                axes.set_ylim(0.0, None)
            row[0].set_ylabel(label.replace(", ", ",\n"), rotation=0, ha="right", va="center")
        for number, axes in enumerate(grid[0]):
            axes.set_title(f"chain {number + 1}", fontsize=9)
        for axes in grid[-1]:
            axes.set_xlabel("rank")
    return figure


def corner_figure(
    draws: Mapping[str, FloatArray], path: Path | None, *, title: str = "", force: bool = False
) -> Figure:
    """Draw each quantity's density on the diagonal, and each pair's with the regions of 50 and 90 % below it."""
    shown = {label: values.ravel() for label, values in drawn_quantities(draws).items()}
    finite = np.all([np.isfinite(values) for values in shown.values()], axis=0)
    labels, columns = [label.replace(", ", ",\n") for label in shown], [values[finite] for values in shown.values()]
    ends = [tuple(np.quantile(values, _SHOWN_DRAWS)) for values in columns]
    number, side = len(labels), 1.35
    with figure_file(path, size_in=(side * number + 1.0, side * number + 1.0), force=force) as figure:
        figure.suptitle(f"{title or 'Corner'}: dark 50 %, light 90 % of the draws", fontsize=11)
        grid: Any = figure.subplots(number, number, squeeze=False)
        for i, j in np.ndindex(number, number):
            axes = grid[i, j]
            if j > i:
                axes.axis("off")
                continue
            if i == j:
                axes.hist(columns[i], bins=40, range=ends[i], color=_COLOURS[0], histtype="stepfilled", alpha=0.8)
                axes.set_yticks([])
            else:
                _pair(axes, columns[j], columns[i], ends[j], ends[i])
            axes.set_xlim(*ends[j])
            lowest, leftmost = i == number - 1, j == 0 < i
            axes.tick_params(labelsize=7, labelbottom=lowest, labelleft=leftmost)
            axes.locator_params(axis="x", nbins=3)
            if i != j:
                axes.locator_params(axis="y", nbins=3)
            if lowest:
                axes.set_xlabel(labels[j], fontsize=8)
                axes.tick_params(axis="x", rotation=45)
            if leftmost:
                axes.set_ylabel(labels[i], fontsize=8)
    return figure


def _pair(axes: Axes, x: FloatArray, y: FloatArray, x_ends: tuple[float, ...], y_ends: tuple[float, ...]) -> None:
    """The smallest regions of a grid that hold 50 and 90 % of the draws, and a cloud beneath them."""
    density, x_edges, y_edges = np.histogram2d(x, y, bins=24, range=(x_ends, y_ends))
    # averaged with the neighbours, once along each axis: a grid of few draws is ragged
    padded = np.pad(density, 1, mode="edge")
    along = 0.25 * padded[:-2] + 0.5 * padded[1:-1] + 0.25 * padded[2:]
    smooth = 0.25 * along[:, :-2] + 0.5 * along[:, 1:-1] + 0.25 * along[:, 2:]
    ordered = np.sort(smooth, axis=None)[::-1]
    inside = np.cumsum(ordered) / ordered.sum()
    levels = sorted({float(ordered[np.searchsorted(inside, share)]) for share in (0.9, 0.5)})
    middles = [(edges[1:] + edges[:-1]) / 2 for edges in (x_edges, y_edges)]
    axes.plot(x[:2000], y[:2000], ".", color="0.75", markersize=1, rasterized=True, zorder=0)
    colours = ["#9fb3d9", _COLOURS[0]][-len(levels) :]
    axes.contourf(*middles, smooth.T, levels=[*levels, np.inf], colors=colours, zorder=1)
    axes.set_ylim(*y_ends)


def _by_chain(chains: FloatArray) -> Iterator[tuple[FloatArray, str]]:
    for number, chain in enumerate(chains):
        yield chain, _COLOURS[number % len(_COLOURS)]


def _bare(axes: Axes) -> None:
    axes.tick_params(labelsize=7)
    axes.spines[["top", "right"]].set_visible(False)
