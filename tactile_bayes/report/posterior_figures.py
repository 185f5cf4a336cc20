"""Pictures of a posterior's draws: traces, ranks of the chains, and a corner of pairs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from tactile_bayes.geometry import FloatArray
from tactile_bayes.report.figure_file import figure_file

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

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
_SHOWN: Final = (0.002, 0.998)


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
            low, high = np.nanquantile(chains, _SHOWN)
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
    ends = [tuple(np.quantile(values, _SHOWN)) for values in columns]
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
