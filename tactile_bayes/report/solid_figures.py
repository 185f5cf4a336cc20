"""Figures 5 to 8 of the paper for balls in three dimensions: what the whole head shows, along both of its axes.

The empirical model (Eqs 1 to 4) is one of cylinders and is not drawn here. On one machine and its libraries equal
input gives equal bytes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from tactile_bayes.forward.axisymmetric import LayeredBody
from tactile_bayes.forward.solid import face_of, solid_head
from tactile_bayes.forward.tissue import THICKNESS_MM, Layers
from tactile_bayes.geometry import FloatArray
from tactile_bayes.mapping.map import TactileMap
from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.report.figure_file import figure_file
from tactile_bayes.report.study import COLOURS, FAT_MM, MARKS, PHANTOM, RATIOS, SIZE_IN, finish
from tactile_bayes.studies.paper import (
    DETECTABLE,
    HARD_RATIO,
    StudyRow,
    hard_cases,
    learn_as_printed,
    seat_name,
    width_changes,
    widths,
)
from tactile_bayes.studies.paper_solid import RasterFitter, RasterFrames, SolidSettings, raster_frames
from tactile_bayes.studies.paper_tables import PHANTOMS

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_CENTRED = ((10.0, 0.8), (15.0, 1.0), (20.0, 1.2))
_SMALL = (10.0, 1.0)
_AXES = {"x": "across the head", "y": "along it"}
_SHARE = "pressure / mean of its frame"

Build = Callable[[RasterFrames], TactileMap]
"""Builds the map of a raster."""


def solid_figures(
    rows: Sequence[StudyRow],
    settings: SolidSettings,
    paths: Sequence[Path],
    *,
    seat: float,
    fit: RasterFitter,
    build: Build,
    force: bool = False,
) -> None:
    """Draw the four figures as PNG files.

    Figures 7b and 8 show what the table holds of this seat, which is that of the lumps in figures 5b to 7a as well.
    """
    of_seat = [row for row in rows if row.seat == seat_name(seat)]
    figure_5(settings, paths[0], seat=seat, force=force)
    figure_6(settings, paths[1], seat=seat, build=build, force=force)
    figure_7(of_seat, settings, paths[2], seat=seat, fit=fit, build=build, force=force)
    figure_8(of_seat, paths[3], force=force)


def figure_5(settings: SolidSettings, path: Path, *, seat: float, force: bool = False) -> None:
    """Frames through the middle of the head: far from the lump on fat of several thicknesses, and over three lumps."""
    s = settings.head.surface_mm()[:, 0, 0]
    with figure_file(path, size_in=SIZE_IN, force=force) as figure:
        left, right = figure.subplots(1, 2)
        for colour, fat in zip(COLOURS, FAT_MM, strict=False):
            left.plot(s, _across(_plain_frame(settings, fat)), color=colour, label=f"fat {fat:g} mm")
        for colour, (d, h) in zip(COLOURS, _CENTRED, strict=False):
            right.plot(s, _across(_centred_frame(settings, d, h, seat)), color=colour, label=f"d {d:g} mm, h/d {h:g}")
        where = "position across the head (mm)"
        finish(left, "(a) far from the lump, middle of the head", where, "pressure (kPa)")
        finish(right, "(b) over the ball, middle of the head", where, "pressure (kPa)", headroom=0.15)
        figure.text(0.01, 0.01, _caption("Figure 5", settings, seat), fontsize=7.5, color="0.3")


def figure_6(settings: SolidSettings, path: Path, *, seat: float, build: Build, force: bool = False) -> None:
    """The map of the first phantom, and its sections along both axes of the head."""
    d, h = PHANTOMS[PHANTOM]
    made = build(_raster(settings, d, h, seat, HARD_RATIO))
    with figure_file(path, size_in=SIZE_IN, force=force) as figure:
        left, right = figure.subplots(1, 2)
        read_x, read_y = made.covered.any(axis=0), made.covered.any(axis=1)
        x, y, mean = made.x_mm[read_x], made.y_mm[read_y], made.mean[np.ix_(read_y, read_x)]
        picture = left.pcolormesh(x, y, mean, cmap="viridis", shading="nearest")
        figure.colorbar(picture, ax=left, label=_SHARE)
        left.set_aspect("equal")
        _draw_sections(right, made, 25.0, "")
        finish(left, f"(a) map, d {d:g} mm, h/d {h:g}", "across the head (mm)", "along the head (mm)")
        finish(right, "(b) sections", "distance from the ball's axis (mm)", _SHARE)
        figure.text(0.01, 0.01, _caption("Figure 6", settings, seat), fontsize=7.5, color="0.3")


def figure_7(
    rows: Sequence[StudyRow],
    settings: SolidSettings,
    path: Path,
    *,
    seat: float,
    fit: RasterFitter,
    build: Build,
    force: bool = False,
) -> None:
    """Maps of a small ball of several stiffnesses, and how little the widths depend on stiffness."""
    d, h = _SMALL
    body = settings.body(d, h, seat=seat)
    head, condensed = settings.on(body), settings.condensed(body)
    with figure_file(path, size_in=SIZE_IN, force=force) as figure:
        left, right = figure.subplots(1, 2)
        for colour, ratio in zip(COLOURS, RATIOS, strict=False):
            frames = raster_frames(head, settings.placed(condensed, ratio), settings)
            found, (x, value) = fit(frames, settings), _section(build(frames), "x")
            near = np.abs(x) <= 20.0
            text = f"E2/E1 {ratio:g}: a {found.amplitude:.3f}, sigma {found.sigma_x_mm:.1f} x {found.sigma_y_mm:.1f} mm"
            left.plot(x[near], value[near], color=colour, label=text)
        level = [row for row in rows if abs(row.depth_ratio - 1.0) < 1e-9 and row.detectable]
        for i, diameter in enumerate(dict.fromkeys(row.d_mm for row in level)):
            of_size = [row for row in level if row.d_mm == diameter]
            for axis, line in (("x", "-"), ("y", "--")):
                _draw_stiffness(right, of_size, axis, line, i)
        right.axhspan(0.95, 1.05, color="0.9", zorder=0)
        right.set_xscale("log")
        finish(left, f"(a) across the head, d {d:g} mm, h/d {h:g}", "place on the skin (mm)", _SHARE, headroom=0.4)
        title = "(b) width, h/d 1; full across, dashed along; grey: 5 %"
        finish(right, title, "stiffness ratio E2/E1", f"sigma / sigma at {HARD_RATIO:g}")
        figure.text(0.01, 0.01, _caption("Figure 7", settings, seat), fontsize=7.5, color="0.3")


def figure_8(rows: Sequence[StudyRow], path: Path, *, force: bool = False) -> None:
    """Width change against amplitude and width against diameter, each with its line, for both axes of the head."""
    hard = hard_cases(rows)
    with figure_file(path, size_in=SIZE_IN, force=force) as figure:
        left, right = figure.subplots(1, 2)
        for i, (axis, words) in enumerate(_AXES.items()):
            _draw_eq_6(left, right, hard, axis, words, i)
        left.set_xscale("log")
        right.set_ylim(bottom=0)
        right.set_xlim(left=0)
        finish(left, "(a) width change, referenced to h/d 1", "amplitude a", "sigma / sigma at h/d 1")
        finish(right, "(b) at one diameter depth", "sigma (mm)", "diameter d (mm)")
        seat = rows[0].seat if rows else "no cases"
        text = f"Figure 8, balls: {seat}, E2/E1 = {HARD_RATIO:g}, amplitude at least {DETECTABLE:g}.  {RESEARCH_USE}"
        figure.text(0.01, 0.01, text, fontsize=7.5, color="0.3")


def _draw_eq_6(left: Axes, right: Axes, hard: Sequence[StudyRow], axis: str, words: str, i: int) -> None:
    """Points and lines of one axis of the head."""
    learned, change, sigma = learn_as_printed(hard, axis=axis), width_changes(hard, axis=axis), widths(hard, axis=axis)
    amplitude = np.array([row.amplitude for row in hard])
    level = np.array([abs(row.depth_ratio - 1.0) < 1e-9 for row in hard], dtype=bool)
    d = np.array([row.d_mm for row in hard])
    left.plot(amplitude, change, MARKS[i], color=COLOURS[i], label=words)
    right.plot(sigma[level], d[level], MARKS[i], color=COLOURS[i], label=words)
    if learned is None:
        return
    a = np.geomspace(amplitude.min(), amplitude.max(), 100)
    left.plot(a, learned.e * a**learned.f, color=COLOURS[i], label=f"{learned.e:.2f} a^{learned.f:.2f}")
    line = np.linspace(0.0, float(np.nanmax(sigma[level])) * 1.1, 2)
    text = f"d = {learned.m:.2f} sigma {learned.b_mm:+.2f} mm"
    right.plot(line, learned.m * line + learned.b_mm, color=COLOURS[i], label=text)


def _draw_stiffness(axes: Axes, rows: Sequence[StudyRow], axis: str, line: str, i: int) -> None:
    """Widths of one size of ball over that of the hardest."""
    sigma = widths(rows, axis=axis)
    hardest = [width for row, width in zip(rows, sigma, strict=True) if row.stiffness_ratio == HARD_RATIO]
    if not hardest:
        return
    label = f"d {rows[0].d_mm:g} mm" if axis == "x" else None
    points = sorted(zip((row.stiffness_ratio for row in rows), sigma / hardest[0], strict=True))
    axes.plot(*zip(*points, strict=True), line, marker=MARKS[i % 6], color=COLOURS[i % 6], label=label)


def _draw_sections(axes: Axes, made: TactileMap, reach_mm: float, words: str) -> None:
    for i, (axis, name) in enumerate(_AXES.items()):
        place, value = _section(made, axis)
        near = np.abs(place) <= reach_mm
        axes.plot(place[near], value[near], color=COLOURS[i], label=f"{name}{words}")


def _section(made: TactileMap, axis: str) -> tuple[FloatArray, FloatArray]:
    """The map along one axis of the head, from the two lines of cells nearest to the lump's."""
    across, along = (made.x_mm, made.y_mm) if axis == "x" else (made.y_mm, made.x_mm)
    mean, covered = (made.mean, made.covered) if axis == "x" else (made.mean.T, made.covered.T)
    lines = np.flatnonzero(covered.any(axis=1))
    chosen = lines[np.argsort(np.abs(along[lines]), kind="stable")[:2]]
    read = covered[chosen].all(axis=0)
    return across[read], np.asarray(mean[np.ix_(chosen, read)].mean(axis=0))


def _raster(settings: SolidSettings, d_mm: float, depth_ratio: float, seat: float, ratio: float) -> RasterFrames:
    body = settings.body(d_mm, depth_ratio, seat=seat)
    return raster_frames(settings.on(body), settings.placed(settings.condensed(body), ratio), settings)


def _centred_frame(settings: SolidSettings, d_mm: float, depth_ratio: float, seat: float) -> FloatArray:
    """(rows, columns) the frame with the middle of the head over the lump."""
    body = settings.body(d_mm, depth_ratio, seat=seat)
    lump = settings.placed(settings.condensed(body), HARD_RATIO)
    frame = settings.on(body).frame([lump], rotation=np.eye(3), x_mm=0.0, y_mm=0.0, mean_kpa=settings.mean_kpa)
    return frame.pressure_kpa


def _plain_frame(settings: SolidSettings, fat_mm: float) -> FloatArray:
    """(rows, columns) the frame far from any lump."""
    layers = Layers(fat_mm, THICKNESS_MM, settings.fat_kpa, settings.gland_ratio, settings.poisson)
    moduli = (layers.fat_kpa, layers.fat_kpa * layers.gland_ratio)
    body = LayeredBody(moduli, (layers.fat_mm, layers.thickness_mm - layers.fat_mm), layers.poisson)
    head = solid_head(face_of(settings.head), body)
    return head.frame([], rotation=np.eye(3), x_mm=0.0, y_mm=0.0, mean_kpa=settings.mean_kpa).pressure_kpa


def _across(frame: FloatArray) -> FloatArray:
    """(rows,) the mean of the two middle columns."""
    middle = frame.shape[1] // 2
    return np.asarray(frame[:, middle - 1 : middle + 1].mean(axis=1))


def _caption(name: str, settings: SolidSettings, seat: float) -> str:
    head = settings.head
    return (
        f"{name}: balls {seat_name(seat)}, head R {head.radius_mm:g} mm with a {head.rim_mm:g} mm rim, "
        f"mean {settings.mean_kpa:g} kPa, nu {settings.poisson:g}, E2/E1 = {HARD_RATIO:g} unless said"
        f"{', flat field' if settings.flat_field else ''}.  {RESEARCH_USE}"
    )
