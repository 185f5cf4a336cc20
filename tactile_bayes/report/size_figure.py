"""Picture of a size posterior: densities, medians and intervals of the largest and smallest size."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from tactile_bayes.errors import BadDataError
from tactile_bayes.findings import Finding
from tactile_bayes.geometry import FloatArray
from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.report.figure_file import figure_file

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_MAX_COLOUR, _MIN_COLOUR = "#1f3b73", "#c8641e"  # tell apart in greyscale too
_ALIKE_COLOUR = "0.4"
# The axis ends at these quantiles of the draws, or at an interval's end where that lies farther out.
_SHOWN: Final = (0.005, 0.985)
_SIZES: Final = {"max": "largest", "min": "smallest"}
_KINDS: Final = {"eti": "equal-tailed", "hdi": "highest-density"}


@dataclass(frozen=True, slots=True)
class SizeInterval:
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

    Parameters
    ----------
    draws_max_mm, draws_min_mm : (n,) arrays
        Posterior draws; those that are not finite are left out.
    intervals
        For ``"max"``, ``"min"`` and ``"alike"``, drawn as bars labelled with probability and kind; the last is of the
        largest size if exams differ less.
    title
        Above the figure; nothing that identifies a person.
    findings
        What speaks against the size, told above it.

    Raises
    ------
    BadDataError
        When there are fewer than two finite draws.
    UsageError
        When `path` exists and `force` is false, or its suffix is unknown.
    """
    size_in = (7.0, 4.0 + 0.4 * ("alike" in intervals))
    with figure_file(path, size_in=size_in, force=force, findings=findings) as figure:
        axes = figure.subplots()
        rows = (("max", draws_max_mm, _MAX_COLOUR, "-"), ("min", draws_min_mm, _MIN_COLOUR, "--"))
        for row, (name, draws, colour, dash) in enumerate(rows):
            _draw_density(axes, name, draws, colour=colour, dash=dash)
            if name in intervals:
                _draw_interval(axes, intervals[name], size=_SIZES[name], row=row, colour=colour)
        if "alike" in intervals:
            _draw_interval(axes, intervals["alike"], size=_SIZES["max"], row=len(rows), colour=_ALIKE_COLOUR)
        axes.set_title(title or "Size of the lump", loc="left", fontsize=11)
        axes.set_xlim(_span((draws_max_mm, draws_min_mm), intervals))
        _finish_size(axes)
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
    density: FloatArray = kernel @ weights / (width_mm * np.sqrt(2 * np.pi))
    return density


def _draw_density(axes: Axes, name: str, draws_mm: FloatArray, *, colour: str, dash: str) -> None:
    sizes, density = _density(draws_mm)
    median = float(np.median(draws_mm[np.isfinite(draws_mm)]))
    label = f"{_SIZES[name]} size, median {median:.1f} mm"
    axes.plot(sizes, density, color=colour, linestyle=dash, linewidth=1.8, label=label)
    axes.fill_between(sizes, density, color=colour, alpha=0.15, linewidth=0)
    axes.vlines(median, 0.0, float(np.interp(median, sizes, density)), color=colour, linestyle=dash, linewidth=1.2)


def _draw_interval(axes: Axes, interval: SizeInterval, *, size: str, row: int, colour: str) -> None:
    """Draw a bar below the densities, labelled with the size that it is of, its ends, probability and kind."""
    from matplotlib.transforms import ScaledTranslation, blended_transform_factory

    # in inches below the axes: the layout makes room for what does not grow with them
    below = ScaledTranslation(0.0, -0.52 - 0.32 * row, axes.figure.dpi_scale_trans)
    across = blended_transform_factory(axes.transData, axes.transAxes) + below
    axes.plot(
        [interval.low_mm, interval.high_mm],
        [0.0, 0.0],
        transform=across,
        color=colour,
        linewidth=3,
        solid_capstyle="butt",
        marker="|",
        markersize=10,
        clip_on=False,
    )
    kind = _KINDS.get(interval.kind, interval.kind)
    ends = f"{interval.low_mm:.1f} to {interval.high_mm:.1f} mm"
    text = f"{size}, {ends}: {100 * interval.probability:g} % interval ({kind})"
    text = f"{text} {interval.supposes}".rstrip()
    axes.text(
        (interval.low_mm + interval.high_mm) / 2,
        -0.02,
        text,
        transform=across,
        ha="center",
        va="top",
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
