"""The homogeneous-pressure condition as a picture: non-uniformity over radius and shoulder, and the answer's frames."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from tactile_bayes.forward.plane.head_design import HomogeneousTissue, Uniformity, most_even, narrowest
from tactile_bayes.geometry import FloatArray
from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.report.figure_file import figure_file
from tactile_bayes.report.head_text import named

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.collections import QuadMesh

_SIZE_IN = (12.0, 7.4)
_LEAST, _MOST = 2.0, 200.0  # per cent, ends of the colours
_COLOURS = ("#1f3b73", "#2a8c6e", "#c8641e")


def design_figure(
    found: Sequence[Uniformity], tissue: HomogeneousTissue, *, limit: float, path: Path, force: bool = False
) -> None:
    """Draw the search.

    Parameters
    ----------
    found
        Of `head_design.search_heads`; the place of the shoulders that holds the answer is drawn.
    limit
        Largest allowed departure, as a share of the mean.

    Raises
    ------
    UsageError
        When `path` exists and `force` is false.
    """
    answer = narrowest(found, limit=limit) or most_even(found)
    shown = [one for one in found if one.head.shoulders == answer.head.shoulders]
    with figure_file(path, size_in=_SIZE_IN, force=force) as figure:
        axes = figure.subplots(2, 3)
        pressures = tissue.pressures_kpa
        for k, part in enumerate((axes[0, 0], axes[0, 1], axes[0, 2])):
            worst = {_key(one): float(one.largest[:, k].max()) for one in shown}
            _draw_grid(part, worst, f"({'abc'[k]}) {pressures[k]:g} kPa, any modulus", limit, answer)
        worst = {_key(one): one.worst for one in shown}
        mesh = _draw_grid(axes[1, 0], worst, "(d) any modulus and pressure", limit, answer)
        figure.colorbar(mesh, ax=axes[0, 2], label="largest departure from the mean, %")
        _draw_frames(axes[1, 1], answer, tissue, limit, "(e) cross")
        plain = min(shown, key=lambda one: (abs(one.head.radius_mm - 35.0), abs(one.head.shoulder_mm - 3.0)))
        _draw_frames(axes[1, 2], plain, tissue, limit, "(f) simulated head")
        text = (
            f"Homogeneous tissue of {tissue.young_kpa[0]:g} to {tissue.young_kpa[1]:g} kPa, {tissue.thickness_mm:g} mm "
            f"thick, {answer.head.shoulders}; black line and grey band: {100 * limit:g} %; "
            f"cross: {named(answer.head)}.  {RESEARCH_USE}"
        )
        figure.text(0.01, 0.01, text, fontsize=8, color="0.3")


def _key(one: Uniformity) -> tuple[float, float]:
    return one.head.radius_mm, one.head.shoulder_mm


def _draw_grid(
    axes: Axes, worst: dict[tuple[float, float], float], title: str, limit: float, answer: Uniformity
) -> QuadMesh:
    """Radius across, shoulder up, colours on a logarithmic scale; the heads within the limit are outlined."""
    from matplotlib.colors import LogNorm

    radii = sorted({key[0] for key in worst})
    shoulders = sorted({key[1] for key in worst})
    cells: FloatArray = np.array([[100 * worst.get((r, s), np.nan) for r in radii] for s in shoulders])
    norm = LogNorm(_LEAST, _MOST)
    mesh = axes.pcolormesh(np.arange(len(radii)), np.arange(len(shoulders)), cells, cmap="cividis", norm=norm)
    for i, j in zip(*np.nonzero(cells <= 100 * limit), strict=True):
        axes.plot([j - 0.5, j + 0.5, j + 0.5, j - 0.5, j - 0.5], [i - 0.5, i - 0.5, i + 0.5, i + 0.5, i - 0.5], "k-")
    place = radii.index(answer.head.radius_mm), shoulders.index(answer.head.shoulder_mm)
    axes.plot(*place, "x", color="white", markersize=9, markeredgewidth=2.5)
    axes.set_xticks(range(len(radii)), ["flat" if np.isinf(r) else f"{r:g}" for r in radii], fontsize=7, rotation=60)
    axes.set_yticks(range(len(shoulders)), [f"{s:g}" for s in shoulders], fontsize=7)
    axes.set_title(title, loc="left", fontsize=10)
    axes.set_xlabel("radius of the arc (mm)", fontsize=9)
    axes.set_ylabel("radius of the shoulders (mm)", fontsize=9)
    return mesh


def _draw_frames(axes: Axes, one: Uniformity, tissue: HomogeneousTissue, limit: float, title: str) -> None:
    """Pressure over its mean for each modulus (colour) and each mean pressure (line)."""
    for colour, modulus, shares in zip(_COLOURS, tissue.moduli_kpa, one.share, strict=True):
        for line, pressure, share in zip(("-", "--", ":"), tissue.pressures_kpa, shares, strict=True):
            text = f"{modulus:g} kPa under {pressure:g} kPa"
            axes.plot(one.s_mm, share, line, color=colour, label=text)
    axes.axhspan(1 - limit, 1 + limit, color="0.88", zorder=0)
    axes.set_ylim(0.0, 2.6)
    arc = "flat" if np.isinf(one.head.radius_mm) else f"R {one.head.radius_mm:g} mm"
    axes.set_title(f"{title}: {arc}, shoulders {one.head.shoulder_mm:g} mm", loc="left", fontsize=10)
    axes.set_xlabel("position on the head (mm)", fontsize=9)
    axes.set_ylabel("pressure / mean of its frame", fontsize=9)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(fontsize=6.5, frameon=False, ncols=2, loc="upper center")
