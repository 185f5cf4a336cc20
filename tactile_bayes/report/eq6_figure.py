"""Fig 8 of the paper for any table of lumps: Eq 6 with the points that it was learned from."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from tactile_bayes.geometry import FloatArray
from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.report.figure_file import figure_file
from tactile_bayes.report.study_figures import finish
from tactile_bayes.size.eq6 import AxisCalibration, SizeCalibration
from tactile_bayes.size.learn.eq6 import SizeTable

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_SIZE_IN = (13.0, 4.6)
_COLOURS = {"x": "#1f3b73", "y": "#c8641e"}
_MARKS = {"x": "o", "y": "s"}
_NAMES = {"x": "across the head", "y": "along it"}
_BAND = (0.05, 0.95)
_DIAMETERS_MM = (5.0, 10.0, 15.0, 20.0, 25.0)


def eq6_figure(
    calibration: SizeCalibration, lumps: SizeTable, path: Path, *, title: str = "", force: bool = False
) -> None:
    """Draw width change against amplitude, diameter against corrected width, and the plane of amplitude and width.

    Parameters
    ----------
    lumps
        What the calibration was learned from; rows without a positive amplitude take no part.
    title
        Name of the table, for the caption.

    Raises
    ------
    UsageError
        When `path` exists and `force` is false.
    """
    rising = lumps.amplitude > 0
    axes = [("x", calibration.x, lumps.sigma_x_mm, lumps.width_change_x)]
    if lumps.sigma_y_mm is not None:
        axes.append(("y", calibration.y, lumps.sigma_y_mm, lumps.width_change_y))
    with figure_file(path, size_in=_SIZE_IN, force=force) as figure:
        change, line, plane = figure.subplots(1, 3)
        for name, axis, sigma, ratio in axes:
            known = None if ratio is None else ratio[rising]
            _draw_change(change, name, axis, lumps.amplitude[rising], known)
            _draw_line(line, name, axis, lumps.d_mm[rising], lumps.amplitude[rising], sigma[rising])
        _draw_plane(plane, calibration.x, lumps.d_mm[rising], lumps.amplitude[rising], lumps.sigma_x_mm[rising])
        change.set_xscale("log")
        finish(change, "(a) width change: posterior mean and 90 %", "amplitude a", "width change e a^f")
        finish(line, "(b) diameter, posterior mean and 90 %", "sigma / (e a^f) (mm)", "diameter d (mm)")
        line.set_ylim(bottom=0)
        finish(plane, "(c) lines of equal d, across the head", "amplitude a", "sigma (mm)")
        text = f"Eq 6 learned from {title or 'the table'}, {int(rising.sum())} lumps.  {RESEARCH_USE}"
        figure.text(0.01, 0.01, text, fontsize=7.5, color="0.3")


def _draw_change(axes: Axes, name: str, axis: AxisCalibration, amplitude: FloatArray, ratio: FloatArray | None) -> None:
    """The power law, and the ratios of widths where the table has depths to take them from."""
    a = np.geomspace(amplitude.min(), amplitude.max(), 100)
    e, f = axis.draws[:, 2:3], axis.draws[:, 3:4]
    words = f"{e.mean():.2f} a^{f.mean():.2f}, {_NAMES[name]}"
    low, high = np.quantile(e * a**f, _BAND, axis=0)
    axes.plot(a, e.mean() * a ** f.mean(), color=_COLOURS[name], label=words)
    axes.fill_between(a, low, high, color=_COLOURS[name], alpha=0.15, lw=0)
    if ratio is not None:
        axes.plot(amplitude, ratio, _MARKS[name], color=_COLOURS[name], markersize=4)


def _draw_line(
    axes: Axes, name: str, axis: AxisCalibration, d_mm: FloatArray, amplitude: FloatArray, sigma: FloatArray
) -> None:
    """d on sigma / (e a^f): the points by the posterior mean's e and f, the line with the band of m and b alone."""
    m, b, e, f = (axis.draws[:, k : k + 1] for k in range(4))
    corrected = sigma / (e.mean() * amplitude ** f.mean())
    x = np.linspace(0.0, 1.05 * corrected.max(), 100)
    # m and e trade against each other: a draw's own width change at the mean amplitude brings it to the same abscissa.
    middle = np.exp(np.log(amplitude).mean())
    scale = (e.mean() * middle ** f.mean()) / (e * middle**f)
    low, high = np.quantile(m * scale * x + b, _BAND, axis=0)
    mean = np.mean(m * scale * x + b, axis=0)
    axes.plot(corrected, d_mm, _MARKS[name], color=_COLOURS[name], markersize=4)
    axes.plot(x, mean, color=_COLOURS[name], label=f"m {m.mean():.2f}, b {b.mean():+.2f} mm, {_NAMES[name]}")
    axes.fill_between(x, low, high, color=_COLOURS[name], alpha=0.15, lw=0)


def _draw_plane(axes: Axes, axis: AxisCalibration, d_mm: FloatArray, amplitude: FloatArray, sigma: FloatArray) -> None:
    """Where Eq 6 puts each diameter in the plane of amplitude and width; points in the colour of their true d."""
    from matplotlib import colormaps
    from matplotlib.colors import Normalize

    norm, colours = Normalize(min(_DIAMETERS_MM), max(_DIAMETERS_MM)), colormaps["viridis"]
    m, b, e, f = axis.draws.mean(axis=0)[:4]
    a = np.geomspace(amplitude.min(), amplitude.max(), 100)
    for d in _DIAMETERS_MM:
        width = (d - b) / m * e * a**f
        if (width > 0).any():
            axes.plot(a, np.where(width > 0, width, np.nan), color=colours(norm(d)), label=f"d {d:g} mm")
    axes.scatter(amplitude, sigma, c=d_mm, norm=norm, cmap=colours, s=22, edgecolors="black", linewidths=0.4)
    axes.set_xscale("log")
    axes.set_ylim(0.0, 1.15 * sigma.max())
