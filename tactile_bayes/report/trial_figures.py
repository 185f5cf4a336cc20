"""Figures of a trial as PNG bytes, equal for equal input: sizes, differences, integral transforms, coverage."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from scipy.special import ndtr

from tactile_bayes.trial.calibration import BINS, Calibration, Prediction
from tactile_bayes.trial.readings import FloatArray, ModalitySizes
from tactile_bayes.trial.summary import ModalityReport, TrialReport

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_DPI = 160
_DOTS, _LINE, _SECOND, _GREY = "#1f3b73", "#c8641e", "#2a7f62", "0.45"
_PANEL_IN = 4.1
Corner = Literal["upper left", "lower right"]


def sizes_figure(report: TrialReport) -> bytes:
    """Draw size against ex-vivo size, one panel per modality, as figure 10 of Wellman & Howe (1999).

    Error bars: +- 1 SD of the ex-vivo size where the table gives it, +- 1 SD of a mass's replicates. Dashed: identity;
    solid: line through zero. Hollow: not found, at size 0.
    """
    modalities = [report.sizes[name] for name in report.modalities]
    found = [np.concatenate([one.ex_vivo_mm, one.size_mm + _spread(one)]) for one in modalities]
    reach = 1.06 * float(max((values.max() for values in found if len(values)), default=1.0))

    def draw(axes: Sequence[Axes]) -> None:
        for one, panel in zip(modalities, axes, strict=True):
            _draw_sizes(panel, one, report, reach)

    return _png(draw, len(modalities))


def differences_figure(report: TrialReport) -> bytes:
    """Draw Bland-Altman plots: difference from the ex-vivo size against the mean, with limits and intervals.

    All panels have the same axes, so that modalities can be compared by eye.
    """
    modalities = list(report.modalities.values())
    found = [report.sizes[one.name].only_detected() for one in modalities]

    def draw(axes: Sequence[Axes]) -> None:
        for one, sizes, panel in zip(modalities, found, axes, strict=True):
            _draw_differences(panel, one, sizes)
        _share_limits(axes)

    return _png(draw, len(modalities))


def _share_limits(axes: Sequence[Axes]) -> None:
    """Give all panels the widest range of any."""
    across, up = (np.array([get(panel) for panel in axes]) for get in (type(axes[0]).get_xlim, type(axes[0]).get_ylim))
    for panel in axes:
        panel.set(xlim=(across[:, 0].min(), across[:, 1].max()), ylim=(up[:, 0].min(), up[:, 1].max()))


def calibration_figure(prediction: Prediction, found: Calibration) -> bytes:
    """Draw integral transforms as a histogram and a distribution function with its band, and coverage by level."""

    def draw(axes: Sequence[Axes]) -> None:
        _draw_pit(axes[0], found)
        _draw_ecdf(axes[1], prediction, found)
        _draw_coverage(axes[2], found)

    return _png(draw, 3)


def _png(draw: Callable[[Sequence[Axes]], None], panels: int) -> bytes:
    """Render a figure as PNG bytes, independent of the user's matplotlib settings."""
    import matplotlib
    from matplotlib.figure import Figure

    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        figure = Figure(figsize=(_PANEL_IN * panels, _PANEL_IN), dpi=_DPI, layout="constrained")
        draw(np.atleast_1d(np.asarray(figure.subplots(1, panels))).tolist())
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png", dpi=_DPI, metadata={"Software": None})
    return buffer.getvalue()


def _spread(sizes: ModalitySizes) -> FloatArray:
    return np.array([group.std(ddof=1) if len(group) > 1 else 0.0 for group in sizes.replicates_mm])


def _draw_sizes(axes: Axes, sizes: ModalitySizes, report: TrialReport, reach: float) -> None:
    found = sizes.only_detected()
    axes.plot([0, reach], [0, reach], linestyle="--", color=_GREY, linewidth=1, label="identity")
    slope = report.modalities[sizes.name].figures["slope_through_origin"].value
    if slope is not None:
        end = min(reach, reach / slope) if slope > 0 else reach
        axes.plot([0, end], [0, slope * end], color=_LINE, linewidth=1.5, label=f"through zero, slope {slope:.2f}")
    across = [report.ex_vivo_sd_mm.get(int(mass)) or 0.0 for mass in found.mass]
    bars: dict[str, Any] = {"elinewidth": 0.8, "capsize": 1.5, "ecolor": "0.6"}
    axes.errorbar(
        found.ex_vivo_mm,
        found.size_mm,
        xerr=across if any(across) else None,
        yerr=_spread(found) if _spread(found).any() else None,
        fmt="o",
        markersize=4,
        color=_DOTS,
        label=f"{len(found.size_mm)} masses",
        **bars,
    )
    missed = sizes.ex_vivo_mm[~sizes.detected]
    if len(missed):
        label = f"{len(missed)} not found"
        axes.plot(missed, np.zeros(len(missed)), "o", mfc="white", mec=_DOTS, markersize=5, clip_on=False, label=label)
    axes.set(xlim=(0, reach), ylim=(0, reach))
    _label(axes, sizes.name, "ex-vivo size (mm)", "size (mm)", where="lower right")


def _draw_differences(axes: Axes, report: ModalityReport, found: ModalitySizes) -> None:
    mean, off = (found.ex_vivo_mm + found.size_mm) / 2, found.size_mm - found.ex_vivo_mm
    axes.plot(mean, off, "o", markersize=4, color=_DOTS)
    axes.axhline(0, color=_GREY, linestyle="--", linewidth=1)
    one = report.methods.limits.get("mm")
    if one is not None:
        axes.axhline(one.bias, color=_LINE, linewidth=1.5, label=f"bias {one.bias:.1f}")
        figures = report.methods.figures
        for value, side in ((one.low, "low"), (one.high, "high")):
            ends = figures[f"limit_{side}_mm"].interval
            axes.axhline(value, color=_SECOND, linewidth=1.2, label=f"limit {value:.1f}")
            if ends is not None:
                axes.axhspan(*ends, color=_SECOND, alpha=0.13, linewidth=0)
        axes.legend(fontsize=7.5, loc="upper left", framealpha=0.85)
    axes.tick_params(labelsize=8)
    _label(axes, report.name, "mean of both (mm)", "size - ex vivo (mm)", legend=False)


def _draw_pit(axes: Axes, found: Calibration) -> None:
    edges = np.linspace(0, 1, BINS + 1)
    axes.bar(edges[:-1], found.pit, width=1 / BINS, align="edge", color=_DOTS, edgecolor="white", alpha=0.85)
    axes.axhline(found.n / BINS, color=_LINE, linewidth=1.2, label="if calibrated")
    axes.set_xlim(0, 1)
    _label(axes, "Integral transforms", "share of the stated distribution below excision", "readings")


def _draw_ecdf(axes: Axes, prediction: Prediction, found: Calibration) -> None:
    pit = np.sort(ndtr(prediction.z))
    share = np.arange(1, len(pit) + 1) / len(pit)
    line = np.array([0.0, 1.0])
    axes.fill_between(line, line - found.ecdf_band, line + found.ecdf_band, color=_LINE, alpha=0.15, linewidth=0)
    axes.plot(line, line, color=_LINE, linewidth=1.2, label=f"if calibrated, band for {found.masses} masses")
    axes.step(np.concatenate([[0], pit, [1]]), np.concatenate([[0], share, [1]]), where="post", color=_DOTS)
    axes.set(xlim=(0, 1), ylim=(0, 1))
    _label(axes, "Their distribution", "integral transform", "share of readings")


def _draw_coverage(axes: Axes, found: Calibration) -> None:
    nominal = np.array([one.probability for one in found.levels])
    share = np.array([one.covered / one.n for one in found.levels])
    low, high = (np.array([one.interval[i] for one in found.levels]) for i in (0, 1))
    axes.plot([0, 1], [0, 1], color=_LINE, linewidth=1.2, label="if calibrated")
    reach = np.stack([np.maximum(share - low, 0), np.maximum(high - share, 0)])
    axes.errorbar(
        nominal, share, yerr=reach, fmt="o", color=_DOTS, markersize=5, capsize=3, label="found, exact interval"
    )
    axes.set(xlim=(0.4, 1), ylim=(0, 1.02))
    _label(axes, "Coverage", "nominal probability of the interval", "share covered", where="lower right")


def _label(
    axes: Axes,
    title: str,
    across: str,
    up: str,
    *,
    legend: bool = True,
    where: Corner = "upper left",
) -> None:
    axes.set_title(title, loc="left", fontsize=10.5)
    axes.set_xlabel(across, fontsize=9)
    axes.set_ylabel(up, fontsize=9)
    axes.tick_params(labelsize=8)
    axes.spines[["top", "right"]].set_visible(False)
    if legend:
        axes.legend(fontsize=7.5, loc=where, framealpha=0.85)
