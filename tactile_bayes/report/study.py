"""The forward study in words and figures (paper Figs 5 to 8)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from tactile_bayes.forward.plane import LineFrames, build_line
from tactile_bayes.forward.tissue import Layers
from tactile_bayes.geometry import FloatArray
from tactile_bayes.mapping.map import TactileMap
from tactile_bayes.presets import HEAD_PITCH_MM, THICKNESS_MM
from tactile_bayes.report.figure_file import Axes, figure_file, finish
from tactile_bayes.size.eq6 import AxisCalibration, SizeCalibration
from tactile_bayes.size.learn.eq6 import SizeTable
from tactile_bayes.studies.model_comparison import (
    PHANTOMS,
    FrameAgreement,
    TableScene,
    mean_squared_difference,
    scene_frames,
)
from tactile_bayes.studies.paper import (
    ALIKE,
    DETECTABLE,
    HARD_RATIO,
    PAPER_DIAMETERS_MM,
    PAPER_STIFFNESS_RATIOS,
    CaseSettings,
    Lookalikes,
    StudyRow,
    StudySettings,
    find_lookalikes,
    hard_cases,
    learn_as_printed,
    seat_name,
    stiffness_changes,
    width_changes,
    widths,
)
from tactile_bayes.studies.paper_solid import SolidSettings

# --- A forward study in a few lines.


def study_table(rows: Sequence[StudyRow]) -> str:
    """Amplitude and width of every case, for a reader: the table as CSV is wider than a terminal."""
    lines = [f"{'seat':12}{'d, mm':>7}{'h/d':>7}{'E2/E1':>7}{'amplitude':>11}{'sigma, mm':>11}  shows"]
    for row in rows:
        lump = f"{row.seat:12}{row.d_mm:>7g}{row.depth_ratio:>7g}{row.stiffness_ratio:>7g}"
        bump = f"{row.amplitude:>11.3f}{row.sigma_x_mm:>11.2f}"
        lines.append(f"{lump}{bump}  {'yes' if row.detectable else 'no'}")
    return "\n".join([*lines, "With all columns, to calibrate by: -o TABLE.csv.", ""])


def study_text(rows: Sequence[StudyRow]) -> str:
    """How many cases show; for each seat Eq 6 in two stages along each axis of the head, and Fig 7b in a line."""
    shown = sum(row.detectable for row in rows)
    lines = [f"{len(rows)} cases, {len(rows) - shown} not detectable (amplitude below {DETECTABLE:g}, or not resolved)"]
    heads = dict.fromkeys(row.head for row in rows if row.head is not None)
    if heads:
        lines.append(f"head: {', '.join(heads)}")
    for seat in dict.fromkeys(row.seat for row in rows):
        seated = [row for row in rows if row.seat == seat]
        for axis, words in _axes_of(rows).items():
            learned = learn_as_printed(seated, axis=axis)
            if learned is not None:
                lines.append(
                    f"{seat}, E2/E1 = 100{words and f', {words}'}: d = {learned.m:.2f} (sigma / delta) "
                    f"{learned.b_mm:+.2f} mm, delta = {learned.e:.3f} a^{learned.f:.3f} from {learned.cases} cases "
                    "(Eq 6 in two stages, as printed)"
                )
        changes = stiffness_changes(seated)
        if changes:
            cells = ", ".join(f"{100 * change:.1f} % at {d:g} mm" for d, change in changes.items())
            lines.append(f"{seat}, width at h/d 1 from E2/E1 = 8 on: within {cells}")
    return "\n".join(lines)


# --- Figures 5 to 8 of the paper, drawn from this program's own forward models, in two dimensions and in three.
#
# On one machine and its libraries equal input gives equal bytes. The empirical model (Eqs 1 to 4) is one of cylinders
# and is not drawn for balls, which show the whole head along both of its axes.

# Tell apart in greyscale and by colour-blind eyes.
COLOURS = ("#1f3b73", "#c8641e", "#2a8c6e", "#8a4fa3", "#7a7a7a", "#b8a100")
MARKS = ("o", "s", "^", "D", "v", "P")
_FAT_MM = (5.0, 10.0, 15.0, 20.0, 30.0, 50.0)
_FITTED_FAT_MM = 15.0
_OTHER = (15.0, 1.0)
_BALLS = ((10.0, 0.8), (15.0, 1.0), (20.0, 1.2))
PHANTOM = "phantom 12.5 mm"
_FRAME_PLACES_MM = (0.0, 6.0, 12.0, 20.0)
_SMALL, _SMALL_BALL = (5.0, 1.0), (10.0, 1.0)
_AXES = {"x": "across the head", "y": "along it"}
_ON_HEAD, _ON_SKIN, _SHARE = "position on the head (mm)", "place on the skin (mm)", "pressure / mean of its frame"


def study_figures(
    rows: Sequence[StudyRow],
    settings: StudySettings | SolidSettings,
    paths: Sequence[Path],
    *,
    seat: float,
    phantom: tuple[float, float],
    measured: Sequence[FrameAgreement],
    force: bool,
) -> Lookalikes | None:
    """Draw figures 5 to 8, and in two dimensions the frames of four lumps, as PNG files; returns the pair of lumps that
    figure 5b shows there.

    Figures 7b and 8 show what the table holds of this seat, which is that of the lumps in figures 5b to 7a as well.
    `phantom` is the diameter in mm and h/d of the lump of figure 6; `measured` are frames for figure 6a, in place of
    the places drawn without any.
    """
    of_seat = [row for row in rows if row.seat == seat_name(seat)]
    lookalikes = find_lookalikes(settings, seat=seat) if isinstance(settings, StudySettings) else None
    with _panels(paths[0], _caption("Figure 5", settings, seat), force=force) as panels:
        _draw_figure_5(*panels, settings, seat, lookalikes)
    with _panels(paths[1], _caption("Figure 6", settings, seat), force=force) as panels:
        if isinstance(settings, StudySettings):
            _draw_figure_6(*panels, settings, TableScene(PHANTOM, *phantom, seat), measured)
        else:
            _draw_figure_6_of_ball(*panels, settings, seat)
    with _panels(paths[2], _caption("Figure 7", settings, seat), force=force) as panels:
        _draw_figure_7(*panels, of_seat, settings, seat)
    figure_8(of_seat, paths[3], force=force)
    if isinstance(settings, StudySettings):  # both models for the phantoms of section 2.3: its curves "for four lumps"
        foot = _caption("Dotted: Eq 3", settings, seat)
        with figure_file(paths[4], size_in=(10.0, 7.6), foot=foot, force=force) as four:
            for axes, (d, h) in zip(four.subplots(2, 2).ravel(), PHANTOMS.values(), strict=True):
                frames = scene_frames(TableScene("", d, h, seat), settings)
                theirs, ours = (frame.as_taxels(HEAD_PITCH_MM) for frame in frames)
                share = 100 * mean_squared_difference(ours.pressure_kpa, theirs.pressure_kpa)
                _draw_frames(axes, theirs, ours)
                title = f"d {d:g} mm, h/d {h:g}; MSD of all frames {share:.1f} %"
                finish(axes, title, _ON_HEAD, "pressure (kPa)", headroom=0.15)
    return lookalikes


def lookalikes_text(lookalikes: Lookalikes | None) -> str:
    """Figure 5b's pair in a line, or that there is none."""
    if lookalikes is None:
        return "figure 5b: no two visible lumps of sizes that differ by half"
    lumps = (lookalikes.small, lookalikes.large)
    pair = " and ".join(f"d {lump.d_mm:g} mm at h/d {lump.depth_ratio:.3g}" for lump in lumps)
    share = f"{100 * lookalikes.difference:.1f} % of what the lump adds ({100 * lookalikes.of_mean:.2f} % of the mean)"
    if lookalikes.difference <= ALIKE:
        return f"figure 5b: indistinguishable are {pair}: their frames differ by {share}"
    return f"figure 5b: no pair within {100 * ALIKE:g} %; the most alike frames, {pair}, differ by {share}"


def frames_text(measured: Sequence[FrameAgreement]) -> list[str]:
    """How far measured frames are from both models, a line for each."""
    return [
        f"figure 6: frame at {one.measured.x_c_mm:g} mm, MSD {100 * one.differences[0]:.2f} % of the elastic "
        f"model, {100 * one.differences[1]:.2f} % of the empirical one"
        for one in measured
    ]


@contextmanager
def _panels(path: Path, caption: str, *, force: bool) -> Iterator[tuple[Axes, Axes]]:
    """Two panels side by side over a caption, written when the block ends."""
    with figure_file(path, size_in=(10.0, 4.3), foot=caption, force=force) as figure:
        left, right = figure.subplots(1, 2)
        yield left, right


def _caption(name: str, settings: StudySettings | SolidSettings, seat: float) -> str:
    if isinstance(settings, StudySettings):
        kind, rim, more = "lumps", f"{settings.head.shoulder_mm:g} mm {settings.head.shoulders}", ""
    else:
        kind, rim, more = "balls", f"a {settings.head.rim_mm:g} mm rim", ", flat field" if settings.flat_field else ""
    return (
        f"{name}: {kind} {seat_name(seat)}, head R {settings.head.radius_mm:g} mm with {rim}, mean "
        f"{settings.mean_kpa:g} kPa, nu {settings.poisson:g}, E2/E1 = {HARD_RATIO:g} unless said{more}."
    )


def _draw_figure_5(
    left: Axes, right: Axes, settings: StudySettings | SolidSettings, seat: float, lookalikes: Lookalikes | None
) -> None:
    """Fig 5: frames far from the lump on fat of six thicknesses, and over lumps; in two dimensions with Eq 1, and two
    lumps that look alike."""
    flat = isinstance(settings, StudySettings)
    for colour, fat in zip(COLOURS, _FAT_MM, strict=True):
        layers = Layers(fat, THICKNESS_MM, settings.fat_kpa, settings.gland_ratio, settings.poisson)
        frame = settings.far(layers)
        left.plot(frame.s_mm, frame.at(0.0), color=colour, label=f"fat {fat:g} mm")
        if fat == _FITTED_FAT_MM and isinstance(settings, StudySettings):
            model = settings.empirical(1.0, layers, frame)
            left.plot(frame.s_mm, model.homogeneous(frame.s_mm), "k:", label=f"Eq 1 fitted to taxels, fat {fat:g} mm")
    where, far, title = "position across the head (mm)", "middle of the head", "over the ball, middle of the head"
    cases = zip(COLOURS, ("-", "-", "-"), _BALLS, strict=False)
    if flat:
        where, far, title = _ON_HEAD, "fat over gland, 70 mm in all", "over the lump: no two visible lumps"
        alike = [] if lookalikes is None else [lookalikes.small, lookalikes.large]
        lumps = [*((one.d_mm, one.depth_ratio) for one in alike), _OTHER]
        cases = zip(COLOURS[1:], ("-", "--", "-"), lumps, strict=False)
    if lookalikes is not None:
        title = f"over the lump: two differ by {100 * lookalikes.difference:.1f} % of their rise"
    for colour, style, (d, h) in cases:
        frame = settings.over_lump(settings.body(d, h, seat=seat))
        right.plot(frame.s_mm, frame.at(0.0), style, color=colour, label=f"d {d:g} mm, h/d {h:.3g}")
    finish(left, f"(a) far from the lump, {far}", where, "pressure (kPa)")
    finish(right, f"(b) {title}", where, "pressure (kPa)", headroom=0.15)


def _draw_figure_6(
    left: Axes, right: Axes, settings: StudySettings, scene: TableScene, measured: Sequence[FrameAgreement]
) -> None:
    """Fig 6: frames and map of a phantom, elastic and empirical; measured frames, thick, where there are any."""
    both = scene_frames(scene, settings)
    for colour, one in zip(COLOURS, measured, strict=False):
        s = one.measured.s_mm
        text = f"measured, head at {one.measured.x_c_mm:g} mm"
        left.plot(s, one.measured.pressure_kpa, color=colour, lw=3.5, alpha=0.4, label=text)
        left.plot(s, one.elastic_kpa, color=colour)
        left.plot(s, one.empirical_kpa, ":", color=colour)
    if not measured:
        _draw_frames(left, *both)
    elastic_map, empirical_map = map(build_line, both)
    x = elastic_map.x_mm
    near = np.abs(x) <= 40.0
    elastic, empirical = elastic_map.mean[near], empirical_map.mean[near]
    share = 100 * mean_squared_difference(empirical, elastic)
    right.plot(x[near], elastic, color=COLOURS[0], label="elastic model")
    right.plot(x[near], empirical, ":", color=COLOURS[1], label=f"empirical model (MSD {share:.1f} %)")
    title = f"(a) frames, d {scene.d_mm:g} mm, h/d {scene.depth_ratio:g}; dotted: Eq 3"
    finish(left, title, _ON_HEAD, "pressure (kPa)")
    finish(right, "(b) maps", _ON_SKIN, _SHARE, headroom=0.25)


def _draw_frames(axes: Axes, elastic: LineFrames, empirical: LineFrames) -> None:
    """Frames of both models at a few places of the head, the empirical ones dotted."""
    for colour, place in zip(COLOURS, _FRAME_PLACES_MM, strict=False):
        axes.plot(elastic.s_mm, elastic.at(place), color=colour, label=f"head at {place:g} mm")
        axes.plot(empirical.s_mm, empirical.at(place), ":", color=colour)


def _draw_figure_6_of_ball(left: Axes, right: Axes, settings: SolidSettings, seat: float) -> None:
    """Fig 6: the map of the first phantom, and its sections along both axes of the head."""
    d, h = PHANTOMS[PHANTOM]
    made = settings.maps(settings.body(d, h, seat=seat))(HARD_RATIO)
    read_x, read_y = made.covered.any(axis=0), made.covered.any(axis=1)
    x, y, mean = made.x_mm[read_x], made.y_mm[read_y], made.mean[np.ix_(read_y, read_x)]
    picture = left.pcolormesh(x, y, mean, cmap="viridis", shading="nearest")
    left.figure.colorbar(picture, ax=left, label=_SHARE)
    left.set_aspect("equal")
    for colour, (axis, name) in zip(COLOURS, _AXES.items(), strict=False):
        place, value = _section(made, axis)
        near = np.abs(place) <= 25.0
        right.plot(place[near], value[near], color=colour, label=name)
    finish(left, f"(a) map, d {d:g} mm, h/d {h:g}", "across the head (mm)", "along the head (mm)")
    finish(right, "(b) sections", "distance from the ball's axis (mm)", _SHARE)


def _section(made: TactileMap, axis: str) -> tuple[FloatArray, FloatArray]:
    """The map along one axis of the head, from the two lines of cells nearest to the lump's."""
    across, along = (made.x_mm, made.y_mm) if axis == "x" else (made.y_mm, made.x_mm)
    mean, covered = (made.mean, made.covered) if axis == "x" else (made.mean.T, made.covered.T)
    lines = np.flatnonzero(covered.any(axis=1))
    chosen = lines[np.argsort(np.abs(along[lines]), kind="stable")[:2]]
    read = covered[chosen].all(axis=0)
    return across[read], np.asarray(mean[np.ix_(chosen, read)].mean(axis=0))


def _draw_figure_7(left: Axes, right: Axes, rows: Sequence[StudyRow], settings: CaseSettings, seat: float) -> None:
    """Maps of a small lump of several stiffnesses with Eq 5 or 7 fitted to them, of a ball across the head, and how
    little the widths depend on stiffness."""
    flat = isinstance(settings, StudySettings)
    d, h = _SMALL if flat else _SMALL_BALL
    maps = settings.maps(settings.body(d, h, seat=seat))
    for colour, ratio in zip(COLOURS, PAPER_STIFFNESS_RATIOS, strict=False):
        made = maps(ratio)
        bump = settings.fitted(made)
        x, value = (made.x_mm, made.mean) if flat else _section(made, "x")
        both = " x ".join(f"{width:.{2 if flat else 1}f}" for width in bump.widths_mm if width is not None)
        near = np.abs(x) <= 20.0
        left.plot(x[near], value[near], color=colour, label=f"E2/E1 {ratio:g}: a {bump.amplitude:.3f}, sigma {both} mm")
    level = [row for row in rows if abs(row.depth_ratio - 1.0) < 1e-9 and row.detectable]
    for i, diameter in enumerate(dict.fromkeys(row.d_mm for row in hard_cases(level))):
        of_size = [row for row in level if row.d_mm == diameter]
        ratios = [row.stiffness_ratio for row in of_size]
        for axis, line in zip(_axes_of(rows), ("-", "--"), strict=False):
            sigma = widths(of_size, axis=axis)
            points = sorted(zip(ratios, sigma / sigma[ratios.index(HARD_RATIO)], strict=True))
            looks: dict[str, Any] = {"marker": MARKS[i % 6], "color": COLOURS[i % 6]}
            right.plot(*zip(*points, strict=True), line, label=f"d {diameter:g} mm" if axis == "x" else None, **looks)
    right.axhspan(0.95, 1.05, color="0.9", zorder=0)
    right.set_xscale("log")
    shown = "maps" if flat else "across the head"
    finish(left, f"(a) {shown}, d {d:g} mm, h/d {h:g}", _ON_SKIN, _SHARE, headroom=0.4)
    which = "; full across, dashed along" if len(_axes_of(rows)) > 1 else ""
    finish(right, f"(b) width, h/d 1{which}; grey: 5 %", "stiffness ratio E2/E1", f"sigma / sigma at {HARD_RATIO:g}")


def _axes_of(rows: Sequence[StudyRow]) -> dict[str, str]:
    """The head's axes, in words; of a line, which has one, without."""
    return _AXES if any(row.sigma_y_mm is not None for row in rows) else {"x": ""}


def figure_8(rows: Sequence[StudyRow], path: Path, *, force: bool = False) -> None:
    """Width change against amplitude and width against diameter, each with its line, for the axes that rows have."""
    seat, kind = rows[0].seat if rows else "no cases", ", balls" if len(_axes_of(rows)) > 1 else ""
    text = f"Figure 8{kind}: {seat}, E2/E1 = {HARD_RATIO:g}, amplitude at least {DETECTABLE:g}."
    with _panels(path, text, force=force) as (left, right):
        for i, (axis, words) in enumerate(_axes_of(rows).items()):
            _draw_printed_eq6(left, right, hard_cases(rows), axis, words, i)
        left.set_xscale("log")
        right.set_ylim(bottom=0)
        right.set_xlim(left=0)
        finish(left, "(a) width change, referenced to h/d 1", "amplitude a", "sigma / sigma at h/d 1")
        finish(right, "(b) at one diameter depth", "sigma (mm)", "diameter d (mm)")


def _draw_printed_eq6(left: Axes, right: Axes, hard: Sequence[StudyRow], axis: str, words: str, i: int) -> None:
    """Points and lines of one axis of the head; the points of a line's one axis have a colour for each diameter."""
    learned, change, sigma = learn_as_printed(hard, axis=axis), width_changes(hard, axis=axis), widths(hard, axis=axis)
    amplitude, d = np.array([row.amplitude for row in hard]), np.array([row.d_mm for row in hard])
    level = np.array([abs(row.depth_ratio - 1.0) < 1e-9 for row in hard], dtype=bool)
    if words:
        left.plot(amplitude, change, MARKS[i], color=COLOURS[i], label=words)
    for k, diameter in enumerate(() if words else dict.fromkeys(d.tolist())):
        mine = d == diameter
        left.plot(amplitude[mine], change[mine], MARKS[k % 6], color=COLOURS[k % 6], label=f"d {diameter:g} mm")
    right.plot(sigma[level], d[level], MARKS[i], color=COLOURS[i], label=words or None)
    if learned is None:
        return
    colour = COLOURS[i] if words else "k"
    a = np.geomspace(amplitude.min(), amplitude.max(), 100)
    left.plot(a, learned.e * a**learned.f, color=colour, label=f"{learned.e:.2f} a^{learned.f:.2f}")
    line = np.linspace(0.0, float(np.nanmax(sigma[level])) * 1.1, 2)
    text = f"d = {learned.m:.2f} sigma {learned.b_mm:+.2f} mm"
    right.plot(line, learned.m * line + learned.b_mm, color=colour, label=text)


# --- Fig 8 of the paper for any table of lumps: Eq 6 with the points that it was learned from.


def eq6_figure(
    calibration: SizeCalibration, lumps: SizeTable, path: Path, *, title: str = "", force: bool = False
) -> None:
    """Draw width change against amplitude, diameter against corrected width, and the plane of amplitude and width.

    Rows of `lumps` without a positive amplitude take no part.
    """
    rising = lumps.amplitude > 0
    d_mm, amplitude = lumps.d_mm[rising], lumps.amplitude[rising]
    axes = [(calibration.x, lumps.sigma_x_mm, lumps.width_change_x)]
    if lumps.sigma_y_mm is not None:
        axes.append((calibration.y, lumps.sigma_y_mm, lumps.width_change_y))
    foot = f"Eq 6 learned from {title or 'the table'}, {int(rising.sum())} lumps."
    with figure_file(path, size_in=(13.0, 4.6), foot=foot, force=force) as figure:
        change, line, plane = figure.subplots(1, 3)
        a = np.geomspace(amplitude.min(), amplitude.max(), 100)
        for i, (axis, sigma, ratio) in enumerate(axes):
            m, b, e, f = (axis.draws[:, k : k + 1] for k in range(4))
            e_mean, f_mean, words = e.mean(), f.mean(), tuple(_AXES.values())[i]
            label = f"{e_mean:.2f} a^{f_mean:.2f}, {words}"
            _draw_banded(change, i, a, e_mean * a**f_mean, e * a**f, label)
            if ratio is not None:
                change.plot(amplitude, ratio[rising], MARKS[i], color=COLOURS[i], markersize=4)
            # d on sigma / (e a^f): points by the posterior mean's e and f, the line with the band of m and b alone.
            # m and e trade against each other: a draw's own width change at the mean amplitude brings it to the same
            # abscissa.
            corrected = sigma[rising] / (e_mean * amplitude**f_mean)
            x, middle = np.linspace(0.0, 1.05 * corrected.max(), 100), np.exp(np.log(amplitude).mean())
            lines = m * (e_mean * middle**f_mean) / (e * middle**f) * x + b
            label = f"m {m.mean():.2f}, b {b.mean():+.2f} mm, {words}"
            line.plot(corrected, d_mm, MARKS[i], color=COLOURS[i], markersize=4)
            _draw_banded(line, i, x, np.mean(lines, axis=0), lines, label)
        _draw_plane(plane, calibration.x, d_mm, amplitude, lumps.sigma_x_mm[rising])
        change.set_xscale("log")
        line.set_ylim(bottom=0)
        finish(change, "(a) width change: posterior mean and 90 %", "amplitude a", "width change e a^f")
        finish(line, "(b) diameter, posterior mean and 90 %", "sigma / (e a^f) (mm)", "diameter d (mm)")
        finish(plane, "(c) lines of equal d, across the head", "amplitude a", "sigma (mm)")


def _draw_banded(axes: Axes, i: int, x: FloatArray, mean: FloatArray, draws: FloatArray, label: str) -> None:
    """A line with the band that holds 90 % of the draws."""
    axes.plot(x, mean, color=COLOURS[i], label=label)
    axes.fill_between(x, *np.quantile(draws, (0.05, 0.95), axis=0), color=COLOURS[i], alpha=0.15, lw=0)


def _draw_plane(axes: Axes, axis: AxisCalibration, d_mm: FloatArray, amplitude: FloatArray, sigma: FloatArray) -> None:
    """Where Eq 6 puts each diameter in the plane of amplitude and width; points in the colour of their true d."""
    low, high = min(PAPER_DIAMETERS_MM), max(PAPER_DIAMETERS_MM)
    looks: dict[str, Any] = {"vmin": low, "vmax": high, "cmap": "viridis", "edgecolors": "black", "linewidths": 0.4}
    points = axes.scatter(amplitude, sigma, c=d_mm, s=22, **looks)
    m, b, e, f = axis.draws.mean(axis=0)[:4]
    a = np.geomspace(amplitude.min(), amplitude.max(), 100)
    for d, colour in zip(PAPER_DIAMETERS_MM, points.to_rgba(np.array(PAPER_DIAMETERS_MM)), strict=True):
        width = (d - b) / m * e * a**f
        if (width > 0).any():
            axes.plot(a, np.where(width > 0, width, np.nan), color=colour, label=f"d {d:g} mm")
    axes.set_xscale("log")
    axes.set_ylim(0.0, 1.15 * sigma.max())
