"""Picture of a comparison: the visits' maps on common axes and colours, their difference, and the change of size."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from tactile_bayes.declarations import Record
from tactile_bayes.geometry import FloatArray
from tactile_bayes.mapping.map import TactileMap
from tactile_bayes.mapping.places import PATIENT_WORDS, PLANE_WORDS, Orientation
from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.report.compare import compare_summary
from tactile_bayes.report.figure_file import figure_file, named_exam
from tactile_bayes.report.map_figure import draw_edges

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from tactile_bayes.size.visits import Compared

HALF_MM: Final = 30.0
"""Half the side of the square about the mass that is drawn."""
_STEP_MM: Final = 1.0
_LEAST_COLOURS: Final = (0.9, 1.3)
_MOST_VISITS: Final = 4


class DrawnMap(Record, eq=False):
    """A map and the place of its lump on the plane; None where none was found."""

    tactile_map: TactileMap
    centre_mm: tuple[float, float] | None


class _Laid(Record, eq=False):
    """A visit's maps averaged on a common grid about its mass."""

    values: FloatArray
    """(n, n) array: Rows upwards, columns to the right on the screen; NaN without data."""
    origin_mm: FloatArray
    """(2,) array: Left of and above the xiphoid, where the mass lies; (0, 0) without landmarks."""


def draw_comparison(
    compared: Compared,
    document: Mapping[str, Any],
    visits: Sequence[Sequence[DrawnMap]],
    path: Path | None,
    *,
    force: bool = False,
) -> Figure:
    """Draw the visits' maps, the difference of the last and the first, and the posterior of the change.

    Maps of a visit are averaged about the mass. With landmarks on all maps the axes are the patient's, at the first
    visit's place, and later visits are moved so that the mass lies on itself. Without, they are the plane's.

    Parameters
    ----------
    document
        `compare_document` of the comparison.
    visits
        Maps of each visit.
    path
        Written as PNG, PDF or SVG; None writes nothing.

    Raises
    ------
    UsageError
        When `path` exists and `force` is false, or its suffix is unknown.
    """
    in_patient = all(one.tactile_map.patient_from_plane is not None for maps in visits for one in maps)
    laid = [_averaged(maps, in_patient=in_patient) for maps in visits]
    shown = [0, *range(max(1, len(laid) - _MOST_VISITS + 1), len(laid))]
    with figure_file(path, size_in=(4.0 * (len(shown) + 1), 7.4), force=force) as figure:
        figure.suptitle(_title(document), x=0.01, ha="left", fontsize=11)
        grid = figure.add_gridspec(2, len(shown) + 1, height_ratios=(1.35, 1.0))
        panels = [figure.add_subplot(grid[0, i]) for i in range(len(shown) + 1)]
        words = visits[0][0].tactile_map.recipe.value_words
        _draw_maps(panels, [(i + 1, laid[i]) for i in shown], label=words, in_patient=in_patient)
        _draw_change(figure.add_subplot(grid[1, 0]), compared)
        _write_words(figure.add_subplot(grid[1, 1:]), document)
        figure.text(0.01, 0.01, _caption(in_patient=in_patient), fontsize=7.5, color="0.3")
    return figure


def _title(document: Mapping[str, Any]) -> str:
    """Title with the subject's code and the scans' digests."""
    exam = named_exam("", document.get("provenance", {}).get("scans", ()))
    return f"Comparison: {exam}" if exam else "Comparison"


def _averaged(maps: Sequence[DrawnMap], *, in_patient: bool) -> _Laid:
    """Mean of a visit's maps about its mass, on the screen's axes."""
    along = np.arange(-HALF_MM, HALF_MM + _STEP_MM / 2, _STEP_MM)
    right, up = np.meshgrid(along, along)
    about = np.stack([-right, up])  # x, the patient's and the plane's, runs to the viewer's left, as in every picture
    values, places = [], []
    for drawn in maps:
        one, centre = drawn.tactile_map, drawn.centre_mm
        if centre is None:
            continue
        rotation = np.eye(2)
        if in_patient:
            assert one.patient_from_plane is not None
            rotation = one.patient_from_plane[:2, :2]
            places.append((rotation @ centre + one.patient_from_plane[:2, 3]) * [-1.0, 1.0])
        x, y = np.tensordot(np.linalg.inv(rotation), about, axes=1) + np.reshape(centre, (2, 1, 1))
        values.append(_nearest(one, x, y))
    if not values:
        return _Laid(np.full(right.shape, np.nan), np.zeros(2))
    stack = np.stack(values)
    known = np.isfinite(stack)
    total, count = np.where(known, stack, 0.0).sum(axis=0), known.sum(axis=0)
    mean = np.divide(total, count, out=np.full(right.shape, np.nan), where=count > 0)
    return _Laid(mean, np.mean(places, axis=0) if places else np.zeros(2))


def _nearest(tactile_map: TactileMap, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
    """Values of the nearest cells; NaN outside and in cells without data."""
    cell = tactile_map.recipe.cell_mm
    column = np.rint((x_mm - tactile_map.x_mm[0]) / cell).astype(int)
    row = np.rint((y_mm - tactile_map.y_mm[0]) / cell).astype(int)
    ny, nx = tactile_map.mean.shape
    inside = (column >= 0) & (column < nx) & (row >= 0) & (row < ny)
    filled = np.where(tactile_map.covered, tactile_map.mean, np.nan)
    found = filled[np.clip(row, 0, ny - 1), np.clip(column, 0, nx - 1)]
    return np.where(inside, found, np.nan)


def _draw_maps(panels: Sequence[Axes], visits: Sequence[tuple[int, _Laid]], *, label: str, in_patient: bool) -> None:
    """Draw the visits, by their numbers, with one colour bar, and the difference of the last and the first."""
    (earlier, first), (later, last) = visits[0], visits[-1]
    every = np.concatenate([one.values[np.isfinite(one.values)] for _, one in visits])
    every = every if len(every) else np.ones(1)
    level = float(np.median(every))
    low, high = min(_LEAST_COLOURS[0] * level, float(every.min())), max(_LEAST_COLOURS[1] * level, float(every.max()))
    for axes, (number, one) in zip(panels, visits, strict=False):
        image = _draw_cells(axes, one.values, first.origin_mm, cmap="viridis", vmin=low, vmax=high)
        axes.set_title(f"Visit {number}", loc="left", fontsize=11)
        _name_axes(axes, first.origin_mm, in_patient=in_patient)
    figure = panels[0].figure
    bar = figure.colorbar(image, ax=list(panels[:-1]), shrink=0.8, pad=0.01)
    bar.set_label(label, fontsize=8)
    difference = last.values - first.values
    most = max(0.1 * level, float(np.nanmax(np.abs(difference), initial=0.0)))
    image = _draw_cells(panels[-1], difference, first.origin_mm, cmap="RdBu_r", vmin=-most, vmax=most)
    panels[-1].set_title(f"Visit {later} minus visit {earlier}", loc="left", fontsize=11)
    _name_axes(panels[-1], first.origin_mm, in_patient=in_patient)
    bars = [bar, figure.colorbar(image, ax=panels[-1], shrink=0.8, pad=0.01)]
    bars[1].set_label(f"difference of {label}", fontsize=8)
    for each in bars:
        each.ax.tick_params(labelsize=7)


def _draw_cells(axes: Axes, values: FloatArray, origin_mm: FloatArray, **how: Any) -> Any:
    """Draw values about the mass; places without data stay grey."""
    axes.set_facecolor("0.85")
    half = HALF_MM + _STEP_MM / 2
    extent = (origin_mm[0] - half, origin_mm[0] + half, origin_mm[1] - half, origin_mm[1] + half)
    shown = np.ma.masked_invalid(values)
    return axes.imshow(shown, origin="lower", extent=extent, interpolation="nearest", **how)


def _name_axes(axes: Axes, origin_mm: FloatArray, *, in_patient: bool) -> None:
    """Name the axes and the edges; of a mass right of the xiphoid the mm are told to the patient's right."""
    words = ("-x (mm)", "y (mm)")
    if in_patient:
        side = "left"
        if origin_mm[0] < 0:
            side = "right"
            axes.xaxis.set_major_formatter(lambda value, _: f"{0.0 - value:g}")
        words = (f"to the patient's {side} of the xiphoid (mm)", "above the xiphoid (mm)")
    axes.set_xlabel(words[0], fontsize=8)
    axes.set_ylabel(words[1], fontsize=8)
    axes.tick_params(labelsize=7)
    draw_edges(
        axes, Orientation("-x", "+y", PATIENT_WORDS, (0.0, 1.0)) if in_patient else Orientation("-x", "+y", PLANE_WORDS)
    )


def _draw_change(axes: Axes, compared: Compared) -> None:
    """Draw the posterior of the change from the first visit to the last."""
    axes.set_yticks([])
    joint = compared.joint
    if joint is None:
        axes.set_axis_off()
        return
    percent = 100.0 * np.expm1(joint.change(0, len(joint.log_size) - 1).log_ratio)
    low, high = np.nanquantile(percent, [0.001, 0.999])
    axes.hist(percent[(percent > low) & (percent < high)], bins=60, color="0.6")
    axes.axvline(0.0, color="black", linewidth=1.2)
    axes.set_xlabel("change of the diameter (%)", fontsize=9)
    axes.set_title("Posterior of the change", loc="left", fontsize=11)


def _write_words(axes: Axes, document: Mapping[str, Any]) -> None:
    """The short report."""
    axes.set_axis_off()
    lines = [part for line in compare_summary(document).splitlines()[:-1] for part in textwrap.wrap(line, 96)]
    lines = [line for line in lines if not line.startswith("More (")]
    axes.text(0.0, 1.0, "\n".join(lines), va="top", fontsize=8.5, transform=axes.transAxes)


def _caption(*, in_patient: bool) -> str:
    frame = "patient's axes, seen facing the patient: head up, patient's left on the right"
    words = frame if in_patient else "no landmarks on every map: the plane's axes, y (along the head) up"
    moved = "later visits are moved so that the mass lies on itself; maps of a visit are averaged"
    return f"{words}; {moved}.  {RESEARCH_USE}"
