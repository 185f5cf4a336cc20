"""Picture of a fit: the window's data, the fitted values and what is left, side by side."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from tactile_bayes.findings import Finding
from tactile_bayes.geometry import FloatArray
from tactile_bayes.mapping.tactile_map import TactileMap
from tactile_bayes.posterior.fitted import FittedCells
from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.report.figure_file import figure_file
from tactile_bayes.report.map_figure import draw_panel

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# The colours' ends leave these shares of the cells outside, so that one cell at the rim does not take them all.
_ENDS: Final = (0.005, 0.995)
_CAPTION: Final = (
    "Fit: level, slope, bump and what is modelled beside it. Residual: noise that neighbouring cells share, "
    "and what the model lacks."
)


def fit_figure(
    tactile_map: TactileMap,
    fitted: FittedCells,
    path: Path | None,
    *,
    title: str = "",
    findings: Sequence[Finding] = (),
    force: bool = False,
) -> Figure:
    """Draw data, fit and residual of a fit window, data and fit in the same colours; see `figure_file` for the file.

    Parameters
    ----------
    tactile_map
        The map that the window is of.
    fitted
        The window's cells, see `fitted_cells`.
    title
        Above the figure; nothing that identifies a person.
    findings
        What speaks against the fit, told above it.
    """
    window, (value, fit, residual) = _window(tactile_map, fitted)
    low, high = (float(end) for end in np.nanquantile(np.stack([value, fit]), _ENDS))
    most = max(float(np.nanquantile(np.abs(residual), _ENDS[1])), 1e-12)
    words = tactile_map.recipe.value_words
    with figure_file(path, size_in=(12.8, 4.1), force=force, findings=findings) as figure:
        data_axes, fit_axes, residual_axes = figure.subplots(1, 3)
        for axes, values, name in ((data_axes, value, "Data"), (fit_axes, fit, "Fit")):
            draw_panel(axes, values, window, label=words, title=name, cmap="viridis", vmin=low, vmax=high)
        left = f"Residual, SD {float(np.nanstd(residual)):.2g}"
        scale = {"vmin": -most, "vmax": most}
        draw_panel(residual_axes, residual, window, label="data less fit", title=left, cmap="RdBu_r", **scale)
        figure.suptitle(title or "Fit", x=0.01, ha="left", fontsize=11)
        figure.text(0.01, 0.01, f"{_CAPTION}  {RESEARCH_USE}", fontsize=7.5, color="0.3")
    return figure


def _window(tactile_map: TactileMap, fitted: FittedCells) -> tuple[TactileMap, list[FloatArray]]:
    """The map cut to the window, and value, fit and residual on its grid, NaN outside the window."""
    cell = tactile_map.recipe.cell_mm
    columns = np.rint((fitted.x_mm - tactile_map.x_mm[0]) / cell).astype(int)
    rows = np.rint((fitted.y_mm - tactile_map.y_mm[0]) / cell).astype(int)
    part = (slice(rows.min(), rows.max() + 1), slice(columns.min(), columns.max() + 1))
    cut = replace(
        tactile_map,
        mean=tactile_map.mean[part],
        variance=tactile_map.variance[part],
        count=tactile_map.count[part],
        x_mm=tactile_map.x_mm[part[1]],
        y_mm=tactile_map.y_mm[part[0]],
    )
    grids = []
    for values in (fitted.value, fitted.fit, fitted.residual):
        grid = np.full(tactile_map.mean.shape, np.nan)
        grid[rows, columns] = values
        grids.append(grid[part])
    return cut, grids
