"""Figures 5 to 8 of the paper, drawn from this program's own forward models.

On one machine and its libraries equal input gives equal bytes.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from tactile_bayes.forward.body import THICKNESS_MM, Layers
from tactile_bayes.forward.plane.empirical import fit_empirical
from tactile_bayes.forward.plane.line import build_line, press_layers
from tactile_bayes.forward.plane.study import (
    DETECTABLE,
    HARD_RATIO,
    Fit,
    StudyRow,
    StudySettings,
    hard_cases,
    learn_as_printed,
    seat_name,
    width_changes,
)
from tactile_bayes.forward.plane.tables import PHANTOMS, Curves, Scene, mean_squared_difference, scene_curves
from tactile_bayes.presets import HEAD_PITCH_MM, RESEARCH_USE
from tactile_bayes.report.figure_file import figure_file

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Tell apart in greyscale and by colour-blind eyes.
_COLOURS = ("#1f3b73", "#c8641e", "#2a8c6e", "#8a4fa3", "#7a7a7a", "#b8a100")
_MARKS = ("o", "s", "^", "D", "v", "P")
_FAT_MM = (5.0, 10.0, 15.0, 25.0, 50.0)
_FITTED_FAT_MM = 15.0
_CENTRED = ((10.0, 0.8), (15.0, 1.0), (20.0, 1.2))
_PHANTOM = "phantom 12.5 mm"
_FRAME_PLACES_MM = (0.0, 6.0, 12.0, 20.0)
_SMALL = (5.0, 1.0)
_RATIOS = (2.0, 5.0, 8.0, 10.0, 100.0)
_SIZE_IN = (10.0, 4.3)


def study_figures(
    rows: Sequence[StudyRow],
    settings: StudySettings,
    paths: Sequence[Path],
    *,
    seat: float,
    fit: Fit,
    force: bool = False,
) -> None:
    """Draw the four figures as PNG files.

    Parameters
    ----------
    rows
        The study's table; figures 7b and 8 show what it holds of this seat.
    seat
        Of the lumps in figures 5b to 7a.
    fit
        Fits Eq 5 to a map.

    paths
        Of figures 5, 6, 7 and 8.

    Raises
    ------
    UsageError
        When one of them exists and `force` is false.
    """
    of_seat = [row for row in rows if row.seat == seat_name(seat)]
    figure_5(settings, paths[0], seat=seat, force=force)
    figure_6(settings, paths[1], seat=seat, force=force)
    figure_7(of_seat, settings, paths[2], seat=seat, fit=fit, force=force)
    figure_8(of_seat, paths[3], force=force)


def figure_5(settings: StudySettings, path: Path, *, seat: float, force: bool = False) -> None:
    """Frames far from the lump on fat of several thicknesses with Eq 1, and frames over three lumps with Eq 3."""
    with figure_file(path, size_in=_SIZE_IN, force=force) as figure:
        left, right = figure.subplots(1, 2)
        for colour, fat in zip(_COLOURS, _FAT_MM, strict=False):
            layers = Layers(fat, THICKNESS_MM, settings.fat_kpa, settings.gland_ratio, settings.poisson)
            frame = press_layers(layers, head=settings.head, mean_kpa=settings.mean_kpa, cell_mm=settings.cell_mm)
            left.plot(frame.s_mm, frame.pressure_kpa[0], color=colour, label=f"fat {fat:g} mm")
            if fat == _FITTED_FAT_MM:
                seen, half = frame.as_taxels(HEAD_PITCH_MM), settings.head.half_width_mm
                model = fit_empirical(seen.s_mm, seen.at(0.0), seen.at(0.0), d_mm=1.0, half_width_mm=half)
                text = f"Eq 1 fitted to taxels, fat {fat:g} mm"
                left.plot(frame.s_mm, model.homogeneous(frame.s_mm), "k:", label=text)
        for colour, (d, h) in zip(_COLOURS, _CENTRED, strict=False):
            curves = scene_curves(Scene("", d, h, seat), settings)
            s = curves.elastic.s_mm
            right.plot(s, curves.elastic.at(0.0), color=colour, label=f"d {d:g} mm, h/d {h:g}")
            right.plot(s, curves.empirical.at(0.0), ":", color=colour)
        _finish(
            left, "(a) far from the lump, fat over gland, 70 mm in all", "position on the head (mm)", "pressure (kPa)"
        )
        _finish(right, "(b) over the lump; dotted: Eq 3", "position on the head (mm)", "pressure (kPa)", headroom=0.15)
        figure.text(0.01, 0.01, _caption("Figure 5", settings, seat), fontsize=7.5, color="0.3")


def figure_6(settings: StudySettings, path: Path, *, seat: float, force: bool = False) -> None:
    """Frames and map of the first phantom, elastic and empirical; the paper's rubber data are not ours to draw."""
    d, h = PHANTOMS[_PHANTOM]
    curves = scene_curves(Scene(_PHANTOM, d, h, seat), settings)
    with figure_file(path, size_in=_SIZE_IN, force=force) as figure:
        left, right = figure.subplots(1, 2)
        for colour, place in zip(_COLOURS, _FRAME_PLACES_MM, strict=False):
            left.plot(curves.elastic.s_mm, curves.elastic.at(place), color=colour, label=f"head at {place:g} mm")
            left.plot(curves.empirical.s_mm, curves.empirical.at(place), ":", color=colour)
        _draw_maps(right, curves)
        _finish(left, f"(a) frames, d {d:g} mm, h/d {h:g}; dotted: Eq 3", "position on the head (mm)", "pressure (kPa)")
        _finish(right, "(b) maps", "place on the skin (mm)", "pressure / mean of its frame", headroom=0.25)
        figure.text(0.01, 0.01, _caption("Figure 6", settings, seat), fontsize=7.5, color="0.3")


def figure_7(
    rows: Sequence[StudyRow], settings: StudySettings, path: Path, *, seat: float, fit: Fit, force: bool = False
) -> None:
    """Maps of a small lump of several stiffnesses, and how little the width depends on stiffness."""
    d, h = _SMALL
    surface = settings.surface(settings.body(d, h, seat=seat))
    with figure_file(path, size_in=_SIZE_IN, force=force) as figure:
        left, right = figure.subplots(1, 2)
        for colour, ratio in zip(_COLOURS, _RATIOS, strict=False):
            line = build_line(settings.frames(surface, ratio))
            found = fit(line, settings.fit_radius_mm)
            near = np.abs(line.x_mm) <= 20.0
            text = f"E2/E1 {ratio:g}: a {found.amplitude:.3f}, sigma {found.sigma_mm:.2f} mm"
            left.plot(line.x_mm[near], line.mean[near], color=colour, label=text)
        level = [row for row in rows if abs(row.depth_ratio - 1.0) < 1e-9 and row.detectable]
        hardest = {row.d_mm: row.sigma_x_mm for row in level if row.stiffness_ratio == HARD_RATIO}
        for i, diameter in enumerate(hardest):
            points = sorted((r.stiffness_ratio, r.sigma_x_mm / hardest[diameter]) for r in level if r.d_mm == diameter)
            right.plot(
                *zip(*points, strict=True), marker=_MARKS[i % 6], color=_COLOURS[i % 6], label=f"d {diameter:g} mm"
            )
        right.axhspan(0.95, 1.05, color="0.9", zorder=0)
        right.set_xscale("log")
        _finish(
            left,
            f"(a) maps, d {d:g} mm, h/d {h:g}",
            "place on the skin (mm)",
            "pressure / mean of its frame",
            headroom=0.4,
        )
        _finish(right, "(b) width, h/d 1; grey: 5 %", "stiffness ratio E2/E1", f"sigma / sigma at {HARD_RATIO:g}")
        figure.text(0.01, 0.01, _caption("Figure 7", settings, seat), fontsize=7.5, color="0.3")


def figure_8(rows: Sequence[StudyRow], path: Path, *, force: bool = False) -> None:
    """Width change against amplitude with its power law, and width against diameter with its line."""
    hard = hard_cases(rows)
    learned = learn_as_printed(rows)
    with figure_file(path, size_in=_SIZE_IN, force=force) as figure:
        left, right = figure.subplots(1, 2)
        change = width_changes(hard)
        for i, d in enumerate(dict.fromkeys(row.d_mm for row in hard)):
            mine = [k for k, row in enumerate(hard) if row.d_mm == d]
            amplitude = [hard[k].amplitude for k in mine]
            left.plot(amplitude, change[mine], _MARKS[i % 6], color=_COLOURS[i % 6], label=f"d {d:g} mm")
        level = [row for row in hard if abs(row.depth_ratio - 1.0) < 1e-9]
        right.plot([row.sigma_x_mm for row in level], [row.d_mm for row in level], "o", color=_COLOURS[0])
        if learned is not None:
            a = np.geomspace(min(row.amplitude for row in hard), max(row.amplitude for row in hard), 100)
            power = f"{learned.e:.2f} a^{learned.f:.2f}"
            left.plot(a, learned.e * a**learned.f, "k-", label=power)
            sigma = np.linspace(0.0, max(row.sigma_x_mm for row in level) * 1.1, 2)
            line = f"d = {learned.m:.2f} sigma {learned.b_mm:+.2f} mm"
            right.plot(sigma, learned.m * sigma + learned.b_mm, "k-", label=line)
        left.set_xscale("log")
        right.set_ylim(bottom=0)
        right.set_xlim(left=0)
        _finish(left, "(a) width change, referenced to h/d 1", "amplitude a", "sigma / sigma at h/d 1")
        _finish(right, "(b) at one diameter depth", "sigma (mm)", "diameter d (mm)")
        seat = rows[0].seat if rows else "no cases"
        text = f"Figure 8: {seat}, E2/E1 = {HARD_RATIO:g}, amplitude at least {DETECTABLE:g}.  {RESEARCH_USE}"
        figure.text(0.01, 0.01, text, fontsize=7.5, color="0.3")


def _draw_maps(axes: Axes, curves: Curves) -> None:
    """Both maps within 40 mm, and their mean squared difference."""
    near = np.abs(curves.elastic_map.x_mm) <= 40.0
    elastic, empirical = curves.elastic_map.mean[near], curves.empirical_map.mean[near]
    share = 100 * mean_squared_difference(empirical, elastic)
    axes.plot(curves.elastic_map.x_mm[near], elastic, color=_COLOURS[0], label="elastic model")
    text = f"empirical model (MSD {share:.1f} %)"
    axes.plot(curves.empirical_map.x_mm[near], empirical, ":", color=_COLOURS[1], label=text)


def _caption(name: str, settings: StudySettings, seat: float) -> str:
    head = settings.head
    return (
        f"{name}: lumps {seat_name(seat)}, head R {head.radius_mm:g} mm with {head.shoulder_mm:g} mm {head.shoulders}, "
        f"mean {settings.mean_kpa:g} kPa, nu {settings.poisson:g}, E2/E1 = {HARD_RATIO:g} unless said.  {RESEARCH_USE}"
    )


def _finish(axes: Axes, title: str, x_label: str, y_label: str, *, headroom: float = 0.0) -> None:
    """Title, labels and a legend; `headroom` is space above the curves for it, as a share of their height."""
    low, high = axes.get_ylim()
    axes.set_ylim(low, high + headroom * (high - low))
    axes.set_title(title, loc="left", fontsize=10)
    axes.set_xlabel(x_label, fontsize=9)
    axes.set_ylabel(y_label, fontsize=9)
    axes.tick_params(labelsize=8)
    axes.spines[["top", "right"]].set_visible(False)
    if axes.get_legend_handles_labels()[0]:
        axes.legend(fontsize=7.5, frameon=False)
