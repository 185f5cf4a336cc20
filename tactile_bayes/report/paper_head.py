"""A scan head and a forward model, in words and figures."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tactile_bayes.forward.scene import HeadSection
from tactile_bayes.geometry import FloatArray
from tactile_bayes.presets import RESEARCH_USE, SHOULDERS_INSIDE
from tactile_bayes.report.figure_file import Axes, figure_file, finish, label
from tactile_bayes.report.study import COLOURS
from tactile_bayes.studies.model_comparison import NEAR_MM, MeasuredScan, ModelComparison, centre_row
from tactile_bayes.studies.paper import HomogeneousTissue, Uniformity, centre_line, most_even, narrowest

# --- How evenly heads press, as text and as plain data.


def head_words(head: HeadSection) -> str:
    """A head in a few words."""
    return f"{_arc(head)}, {head.shoulders} of {head.shoulder_mm:g} mm"


def _arc(head: HeadSection) -> str:
    return "flat" if np.isinf(head.radius_mm) else f"R {head.radius_mm:g} mm"


def uniformity_text(head: Uniformity, tissue: HomogeneousTissue, *, limit: float) -> str:
    """One head: a table of moduli and pressures, and whether it meets the limit."""
    words = "within" if head.worst <= limit else "beyond"
    lines = [f"largest departure {100 * head.worst:.1f} %, {words} {100 * limit:g} %"]
    lines.append(f"head: {head_words(head.head)}, face {head.face_mm:.1f} mm wide")
    return "\n".join([*lines, _tissue_line(tissue), *_pressure_table(head, tissue)])


def design_text(heads: Sequence[Uniformity], tissue: HomogeneousTissue, *, limit: float) -> str:
    """The whole search: the answer with its own table, then a table for each place of the shoulders."""

    def words(one: Uniformity, worst: float) -> str:
        return f"{head_words(one.head)}, {100 * worst:.1f} %, face {one.face_mm:.1f} mm wide"

    count = sum(one.worst <= limit for one in heads)
    best = most_even(heads)
    lines = [
        f"{count} of {len(heads)} heads stay within {100 * limit:g} % of the mean",
        f"most even: {words(best, best.worst)}",
    ]
    if (answer := narrowest(heads, limit=limit)) is not None:
        lines += [f"narrowest within the limit: {words(answer, answer.worst)}", *_pressure_table(answer, tissue)]
    if (by_rms := narrowest(heads, limit=limit, by_rms=True)) is not None:
        lines.append(f"narrowest whose root mean square is within it: {words(by_rms, by_rms.worst_rms)}")
    lines.append(_tissue_line(tissue))
    for kind in dict.fromkeys(one.head.shoulders for one in heads):
        lines += ["", *_grid(kind, [one for one in heads if one.head.shoulders == kind], limit=limit)]
    return "\n".join(lines)


def uniformity_document(head: Uniformity, tissue: HomogeneousTissue, *, limit: float) -> dict[str, object]:
    """One head as plain data; departures as shares of the mean."""
    return {
        "schema": "tactile-bayes/head-uniformity/1",
        **_tissue_document(tissue, limit),
        **_head_document(head),
        "largest": head.largest.tolist(),
        "rms": head.rms.tolist(),
        "within_limit": head.worst <= limit,
        "research_use": RESEARCH_USE,
    }


def design_document(heads: Sequence[Uniformity], tissue: HomogeneousTissue, *, limit: float) -> dict[str, object]:
    """The whole search as plain data; `answer` is None where no head meets the limit."""
    answer, by_rms = narrowest(heads, limit=limit), narrowest(heads, limit=limit, by_rms=True)
    return {
        "schema": "tactile-bayes/head-design/1",
        **_tissue_document(tissue, limit),
        "heads": [_head_document(one) for one in heads],
        "most_even": _head_document(most_even(heads)),
        "answer": answer and _head_document(answer),
        "answer_by_rms": by_rms and _head_document(by_rms),
        "research_use": RESEARCH_USE,
    }


def _tissue_line(tissue: HomogeneousTissue) -> str:
    moduli, pressures = tissue.modulus_kpa, tissue.pressure_kpa
    return (
        f"homogeneous tissue of {moduli[0]:g} to {moduli[1]:g} kPa, {tissue.thickness_mm:g} mm thick on a rigid base, "
        f"nu {tissue.poisson:g}; mean pressures of {pressures[0]:g} to {pressures[1]:g} kPa"
    )


def _pressure_table(head: Uniformity, tissue: HomogeneousTissue) -> list[str]:
    columns = "".join(f"{f'{value:g} kPa':>16}" for value in tissue.pressures_kpa)
    lines = ["largest departure of a taxel from its frame's mean, % (root mean square)", f"{'modulus':>9}{columns}"]
    for modulus, largest, rms in zip(tissue.moduli_kpa, head.largest, head.rms, strict=True):
        cells = "".join(f"{f'{100 * a:.1f} ({100 * b:.1f})':>16}" for a, b in zip(largest, rms, strict=True))
        lines.append(f"{f'{modulus:g} kPa':>9}{cells}")
    return lines


def _grid(kind: str, heads: Sequence[Uniformity], *, limit: float) -> list[str]:
    """Radii down, shoulders across; a star marks what meets the limit."""
    where = "cut into the sensing width" if kind == SHOULDERS_INSIDE else "around the sensing width"
    shoulders = sorted({one.head.shoulder_mm for one in heads})
    cells = {(one.head.radius_mm, one.head.shoulder_mm): one.worst for one in heads}
    lines = [
        f"{kind} ({where}): largest departure over all moduli and pressures, %; * within {100 * limit:g} %",
        f"{'R, mm':>8}" + "".join(f"{f'r {value:g}':>6}" for value in shoulders),
    ]
    for radius in sorted({one.head.radius_mm for one in heads}):
        name = "flat" if np.isinf(radius) else f"{radius:g}"
        row = [cells.get((radius, shoulder)) for shoulder in shoulders]
        marked = [
            "-" if one is None else f"{100 * one:.{0 if one >= 1 else 1}f}{'*' if one <= limit else ' '}" for one in row
        ]
        lines.append(f"{name:>8}" + "".join(f"{cell:>6}" for cell in marked))
    return lines


def _tissue_document(tissue: HomogeneousTissue, limit: float) -> dict[str, object]:
    return {
        "modulus_kpa": tissue.moduli_kpa.tolist(),
        "mean_kpa": tissue.pressures_kpa.tolist(),
        "thickness_mm": tissue.thickness_mm,
        "poisson": tissue.poisson,
        "limit": limit,
    }


def _head_document(design: Uniformity) -> dict[str, Any]:
    """JSON has no infinity: a flat head's radius is null."""
    head = design.head
    return {
        "radius_mm": None if np.isinf(head.radius_mm) else head.radius_mm,
        "shoulder_mm": head.shoulder_mm,
        "shoulders": head.shoulders,
        "face_mm": design.face_mm,
        "worst": design.worst,
        "worst_rms": design.worst_rms,
    }


# --- The homogeneous-pressure condition as a picture: non-uniformity over radius and shoulder, and the answer's frames.

_LEAST, _MOST = 2.0, 200.0  # per cent, ends of the colours
_MODULUS_COLOURS = (COLOURS[0], COLOURS[2], COLOURS[1])


def design_figure(
    heads: Sequence[Uniformity], tissue: HomogeneousTissue, *, limit: float, path: Path, force: bool = False
) -> None:
    """Draw the search, for the place of the shoulders that holds the answer; `limit` is a share of the mean."""
    answer = narrowest(heads, limit=limit) or most_even(heads)
    drawn = [one for one in heads if one.head.shoulders == answer.head.shoulders]
    cross = head_words(answer.head)
    text = (
        f"Homogeneous tissue of {tissue.modulus_kpa[0]:g} to {tissue.modulus_kpa[1]:g} kPa, {tissue.thickness_mm:g} mm "
        f"thick, {answer.head.shoulders}; black line and grey band: {100 * limit:g} %; cross: {cross}."
    )
    with figure_file(path, size_in=(12.0, 7.4), foot=text, force=force) as figure:
        upper, (every, cross, simulated) = figure.subplots(2, 3)
        for k, (axes, pressure) in enumerate(zip(upper, tissue.pressures_kpa, strict=True)):
            worst = [float(one.largest[:, k].max()) for one in drawn]
            _draw_grid(axes, drawn, worst, f"({'abc'[k]}) {pressure:g} kPa, any modulus", limit, answer)
        worst = [one.worst for one in drawn]
        mesh = _draw_grid(every, drawn, worst, "(d) any modulus and pressure", limit, answer)
        figure.colorbar(mesh, ax=upper[2], label="largest departure from the mean, %")
        _draw_shares(cross, answer, tissue, limit, "(e) cross")
        plain = min(drawn, key=lambda one: (abs(one.head.radius_mm - 35.0), abs(one.head.shoulder_mm - 3.0)))
        _draw_shares(simulated, plain, tissue, limit, "(f) simulated head")


def _draw_grid(
    axes: Axes, heads: Sequence[Uniformity], worst: Sequence[float], title: str, limit: float, answer: Uniformity
) -> Any:
    """Radius across, shoulder up, colours on a logarithmic scale; the heads within the limit are outlined."""
    radii, shoulders = (sorted({getattr(one.head, name) for one in heads}) for name in ("radius_mm", "shoulder_mm"))
    cells: FloatArray = np.full((len(shoulders), len(radii)), np.nan)
    for one, value in zip(heads, worst, strict=True):
        cells[shoulders.index(one.head.shoulder_mm), radii.index(one.head.radius_mm)] = 100 * value
    places = np.arange(len(radii)), np.arange(len(shoulders))
    mesh = axes.pcolormesh(*places, cells, cmap="cividis", norm="log", vmin=_LEAST, vmax=_MOST)
    for i, j in zip(*np.nonzero(cells <= 100 * limit), strict=True):
        axes.plot([j - 0.5, j + 0.5, j + 0.5, j - 0.5, j - 0.5], [i - 0.5, i - 0.5, i + 0.5, i + 0.5, i - 0.5], "k-")
    place = radii.index(answer.head.radius_mm), shoulders.index(answer.head.shoulder_mm)
    axes.plot(*place, "x", color="white", markersize=9, markeredgewidth=2.5)
    axes.set_xticks(range(len(radii)), ["flat" if np.isinf(r) else f"{r:g}" for r in radii], fontsize=7, rotation=60)
    axes.set_yticks(range(len(shoulders)), [f"{s:g}" for s in shoulders], fontsize=7)
    label(axes, title, "radius of the arc (mm)", "radius of the shoulders (mm)")
    return mesh


def _draw_shares(axes: Axes, one: Uniformity, tissue: HomogeneousTissue, limit: float, title: str) -> None:
    """Pressure over its mean for each modulus (colour) and each mean pressure (line)."""
    for colour, modulus, shares in zip(_MODULUS_COLOURS, tissue.moduli_kpa, one.share, strict=True):
        for line, pressure, share in zip(("-", "--", ":"), tissue.pressures_kpa, shares, strict=True):
            axes.plot(one.s_mm, share, line, color=colour, label=f"{modulus:g} kPa under {pressure:g} kPa")
    axes.axhspan(1 - limit, 1 + limit, color="0.88", zorder=0)
    axes.set_ylim(0.0, 2.6)
    title = f"{title}: {_arc(one.head)}, shoulders {one.head.shoulder_mm:g} mm"
    across, up = "position on the head (mm)", "pressure / mean of its frame"
    finish(axes, title, across, up, loc="upper center", fontsize=6.5, ncols=2)


# --- A scan against forward models, as text and as plain data.

_BESIDE = 3  #: Models that stand side by side in 80 columns.
DEFINITION = "MSD = sum of squared differences over the sum of squares of the model (docs/decisions/0007)"
_PRINTED = {"frames_centre": "below 15", "map_centre": "below 2.6"}
# Figures of a model by name: in words, what they are multiplied by, and decimals.
_DIFFERENCES = {
    "frames_all": ("frames, all taxels, MSD %", 100, 2),
    "frames_centre": ("frames, centre line, MSD %", 100, 2),
    "frames_near": ("frames within 12 mm of the lump, MSD %", 100, 2),
    "map_all": (f"map within {NEAR_MM:g} mm, MSD %", 100, 2),
    "map_centre": ("map, centre line, MSD %", 100, 2),
    "map_strict": ("map over (map - 1), MSD %", 100, 2),
    "rms_kpa": ("taxel, root mean square difference, kPa", 1, 3),
    "slope_x_per_10mm": ("map: residual's slope in x, per 10 mm", 1, 4),
    "slope_y_per_10mm": ("the same in y", 1, 4),
    "rms_beside_slope": ("RMS beside the slope", 1, 4),
}
# Figures of the measured map and of a model's, below a title each.
_BUMPS = {
    "Eq 7 on the map, level 1": {
        "amplitude": "amplitude",
        "sigma_x_mm": "sigma across the head, mm",
        "sigma_y_mm": "sigma along it, mm",
    },
    "Eq 5 on its centre line across the lump, level 1": {"line_amplitude": "amplitude", "line_sigma_mm": "sigma, mm"},
}


def comparison_text(measured: MeasuredScan, models: Sequence[ModelComparison]) -> str:
    """How far each model is off, then frames, maps and the bumps on them, with a few models side by side."""
    lines = [
        f"{one.fidelity}: frames differ by {100 * one.figures['frames_all']:.2f} % MSD, "
        f"the map by {100 * one.figures['map_all']:.2f} %"
        for one in models
    ]
    x, y = measured.place_mm
    pressed = f"{len(measured.level_kpa)} frames, mean pressure {measured.level_kpa.mean():.2f} kPa"
    lines += [f"{pressed}; lump at {x:.1f}, {y:.1f} mm of the map", DEFINITION, ""]
    for first in range(0, len(models), _BESIDE):
        lines += _columns(measured, models[first : first + _BESIDE])
    return "\n".join(line.rstrip() for line in lines)


def _columns(measured: MeasuredScan, models: Sequence[ModelComparison]) -> Iterator[str]:
    names = [one.fidelity.partition("-") for one in models]
    yield _cells("", "paper", *(first for first, _, _ in names))
    if any(second for _, _, second in names):
        yield _cells("", "", *(second for _, _, second in names))
    for name, (words, times, digits) in _DIFFERENCES.items():
        yield _cells(words, _PRINTED.get(name, ""), *(f"{times * one.figures[name]:.{digits}f}" for one in models))
    yield ""
    every = [measured.figures, *(one.figures for one in models)]
    for beside, (title, rows) in zip(("measured", ""), _BUMPS.items(), strict=True):
        yield _cells(title, beside)
        for name, words in rows.items():
            # a model without a bump in the map's plane, such as a cylinder, has none to show
            yield _cells(words, *(f"{one[name]:.3f}" if np.isfinite(one[name]) else "none" for one in every))


def _cells(words: str, beside: str, *models: str) -> str:
    return f"{words:<39}{beside:>10}{''.join(f'{cell:>10}' for cell in models)}"


def finite(value: float) -> float | None:
    """The number; null in a file for what is none."""
    return float(value) if np.isfinite(value) else None


def comparison_document(
    measured: MeasuredScan, models: Sequence[ModelComparison], *, inputs: dict[str, Any]
) -> dict[str, Any]:
    """The same as plain data; differences as shares, null where no bump was fitted."""
    return {
        "schema": "tactile-bayes/compare-model/1",
        "definition": DEFINITION,
        "inputs": inputs,
        "frames": len(measured.level_kpa),
        "place_mm": list(measured.place_mm),
        "measured": {name: finite(value) for name, value in measured.figures.items()},
        "models": [
            {"fidelity": one.fidelity, **{name: finite(value) for name, value in one.figures.items()}} for one in models
        ],
        "research_use": RESEARCH_USE,
    }


# --- A scan against forward models, as Fig 6 of the paper: frames, the map's centre line, both maps and the residual.

_LINES = ("-", ":", "--", "-.")
_PLACES_MM = (0.0, 6.0)
# Frames this near to a place, and this near to the lump along the head, are averaged.
_BESIDE_MM = 1.0
_ALONG_MM = 6.0


def comparison_figure(
    measured: MeasuredScan, models: Sequence[ModelComparison], path: Path, *, title: str, force: bool = False
) -> None:
    """Draw the comparison; maps and residual are those of the first model."""
    with figure_file(path, size_in=(12.0, 8.0), foot=f"{title}.", force=force) as figure:
        (frames, line, beside), (seen, modelled, left) = figure.subplots(2, 3)
        _draw_frames(frames, measured, models, _PLACES_MM[0], "(a)")
        _draw_frames(line, measured, models, _PLACES_MM[1], "(b)")
        _draw_line(beside, measured, models)
        ours, theirs = measured.tactile_map.mean, models[0].tactile_map.mean
        ends = np.nanmin(theirs), np.nanmax(theirs)
        for axes, values, name in ((seen, ours, "(d) measured"), (modelled, theirs, f"(e) {models[0].fidelity}")):
            mesh = _draw_map(axes, measured, values, name, ends, "viridis")
        figure.colorbar(mesh, ax=modelled, shrink=0.7, label="pressure / mean of its frame")
        residual = ours - theirs
        most = float(np.nanmax(np.abs(residual)))
        mesh = _draw_map(left, measured, residual, "(f) measured less modelled", (-most, most), "RdBu_r")
        figure.colorbar(mesh, ax=left, shrink=0.7, label="difference")


def _draw_frames(
    axes: Axes, measured: MeasuredScan, models: Sequence[ModelComparison], place_mm: float, letter: str
) -> None:
    """The centre line of frames whose middle lies at a distance from the lump across it, averaged."""
    off = measured.origin_mm[:, :2] - measured.place_mm
    near = (np.abs(off[:, 0] - place_mm) <= _BESIDE_MM) & (np.abs(off[:, 1]) <= _ALONG_MM)
    count = measured.pressure_kpa.shape[1]
    s: FloatArray = measured.scan.head.pitch_mm * (np.arange(count) - 0.5 * (count - 1))
    if near.any():
        axes.plot(s, centre_line(measured.pressure_kpa)[near].mean(axis=0), color="0.55", lw=3.5, label="measured")
        for one, colour, style in zip(models, COLOURS, _LINES, strict=False):
            axes.plot(s, centre_line(one.pressure_kpa)[near].mean(axis=0), style, color=colour, label=one.fidelity)
    words = f"head {place_mm:g} mm from the lump, {near.sum()} frames"
    finish(axes, f"{letter} {words}", "position on the head (mm)", "pressure (kPa)")


def _draw_line(axes: Axes, measured: MeasuredScan, models: Sequence[ModelComparison]) -> None:
    x, mean = centre_row(measured, measured.tactile_map)
    near = np.abs(x) <= NEAR_MM
    axes.plot(x[near], mean[near], "x", color="0.45", markersize=4, label="measured")
    for one, colour, style in zip(models, COLOURS, _LINES, strict=False):
        x, mean = centre_row(measured, one.tactile_map)
        near = np.abs(x) <= NEAR_MM
        text = f"{one.fidelity} (MSD {100 * one.figures['map_centre']:.2f} %)"
        axes.plot(x[near], mean[near], style, color=colour, label=text)
    across, up = "distance from the lump (mm)", "pressure / mean of its frame"
    finish(axes, "(c) the map across the lump", across, up, headroom=0.35)


def _draw_map(
    axes: Axes, measured: MeasuredScan, values: FloatArray, title: str, ends: tuple[float, float], colours: str
) -> Any:
    made = measured.tactile_map
    mesh = axes.pcolormesh(made.x_mm, made.y_mm, values, cmap=colours, vmin=ends[0], vmax=ends[1], shading="nearest")
    axes.plot(*measured.place_mm, "+", color="black", markersize=10)
    axes.set_aspect("equal")
    label(axes, title, "x of the map (mm)", "y of the map (mm)")
    return mesh
