"""A scan against forward models, as Fig 6 of the paper: frames, the map's centre line, both maps and the residual."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from tactile_bayes.geometry import FloatArray
from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.report.figure_file import figure_file
from tactile_bayes.report.study_figures import finish
from tactile_bayes.studies.model_comparison import (
    NEAR_MM,
    MeasuredFrames,
    ModelComparison,
    centre_line,
    centre_row,
    residual_map,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.collections import QuadMesh

_SIZE_IN = (12.0, 8.0)
_COLOURS = ("#1f3b73", "#c8641e", "#2a8c6e", "#8a4fa3")
_LINES = ("-", ":", "--", "-.")
_PLACES_MM = (0.0, 6.0)
# Frames this near to a place, and this near to the lump along the head, are averaged.
_BESIDE_MM = 1.0
_ALONG_MM = 6.0


def comparison_figure(
    measured: MeasuredFrames, found: Sequence[ModelComparison], path: Path, *, title: str, force: bool = False
) -> None:
    """Draw the comparison; maps and residual are those of the first model.

    Raises
    ------
    UsageError
        When `path` exists and `force` is false.
    """
    with figure_file(path, size_in=_SIZE_IN, force=force) as figure:
        (frames, line, beside), (seen, model, left) = figure.subplots(2, 3)
        _draw_frames(frames, measured, found, _PLACES_MM[0], "(a)")
        _draw_frames(line, measured, found, _PLACES_MM[1], "(b)")
        _draw_line(beside, measured, found)
        ours, theirs = measured.tactile_map.mean, found[0].tactile_map.mean
        ends = np.nanmin(theirs), np.nanmax(theirs)
        for axes, values, name in ((seen, ours, "(d) measured"), (model, theirs, f"(e) {found[0].fidelity}")):
            mesh = _draw_map(axes, measured, values, name, ends, "viridis")
        figure.colorbar(mesh, ax=model, shrink=0.7, label="pressure / mean of its frame")
        residual = residual_map(measured, found[0])
        most = float(np.nanmax(np.abs(residual)))
        mesh = _draw_map(left, measured, residual, "(f) measured less modelled", (-most, most), "RdBu_r")
        figure.colorbar(mesh, ax=left, shrink=0.7, label="difference")
        figure.text(0.01, 0.01, f"{title}.  {RESEARCH_USE}", fontsize=8, color="0.3")


def _draw_frames(
    axes: Axes, measured: MeasuredFrames, found: Sequence[ModelComparison], place_mm: float, letter: str
) -> None:
    """The centre line of frames whose middle lies at a distance from the lump across it, averaged."""
    off = measured.origin_mm[:, :2] - measured.place_mm
    near = (np.abs(off[:, 0] - place_mm) <= _BESIDE_MM) & (np.abs(off[:, 1]) <= _ALONG_MM)
    pitch = measured.scan.head.pitch_mm
    count = measured.pressure_kpa.shape[1]
    s: FloatArray = pitch * (np.arange(count) - 0.5 * (count - 1))
    if near.any():
        axes.plot(s, centre_line(measured.pressure_kpa)[near].mean(axis=0), color="0.55", lw=3.5, label="measured")
        for one, colour, style in zip(found, _COLOURS, _LINES, strict=False):
            axes.plot(s, centre_line(one.pressure_kpa)[near].mean(axis=0), style, color=colour, label=one.fidelity)
    words = f"head {place_mm:g} mm from the lump, {near.sum()} frames"
    finish(axes, f"{letter} {words}", "position on the head (mm)", "pressure (kPa)")


def _draw_line(axes: Axes, measured: MeasuredFrames, found: Sequence[ModelComparison]) -> None:
    """The map across the lump."""
    x, mean = centre_row(measured, measured.tactile_map)
    near = np.abs(x) <= NEAR_MM
    axes.plot(x[near], mean[near], "x", color="0.45", markersize=4, label="measured")
    for one, colour, style in zip(found, _COLOURS, _LINES, strict=False):
        x, mean = centre_row(measured, one.tactile_map)
        near = np.abs(x) <= NEAR_MM
        axes.plot(x[near], mean[near], style, color=colour, label=f"{one.fidelity} (MSD {100 * one.map_centre:.2f} %)")
    low, high = axes.get_ylim()
    axes.set_ylim(low, high + 0.35 * (high - low))
    finish(axes, "(c) the map across the lump", "distance from the lump (mm)", "pressure / mean of its frame")


def _draw_map(
    axes: Axes, measured: MeasuredFrames, values: FloatArray, title: str, ends: tuple[float, float], colours: str
) -> QuadMesh:
    made = measured.tactile_map
    mesh = axes.pcolormesh(made.x_mm, made.y_mm, values, cmap=colours, vmin=ends[0], vmax=ends[1], shading="nearest")
    axes.plot(*measured.place_mm, "+", color="black", markersize=10)
    axes.set_aspect("equal")
    axes.set_title(title, loc="left", fontsize=10)
    axes.set_xlabel("x of the map (mm)", fontsize=9)
    axes.set_ylabel("y of the map (mm)", fontsize=9)
    return mesh
