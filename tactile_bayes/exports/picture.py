"""The map's figure as pixels, drawn from what an estimate's file says."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from tactile_bayes.exports.exam import EstimateFile, MapFile

_MOST_NOTE: Final = 400
"""Characters that have a place above the figure."""

if TYPE_CHECKING:
    from tactile_bayes.report.map_figure import FitContour, Place


def map_picture(source: MapFile, estimate: EstimateFile | None) -> NDArray[np.uint8]:
    """(rows, columns, 3) red, green and blue of the map's figure; of an estimate of this map alone with its ellipse.

    No file name is in it, because those may hold patients' names.
    """
    from matplotlib import rc_context, rcdefaults
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    from tactile_bayes.report.map_figure import map_figure

    document = estimate.document if estimate is not None and estimate.kind == "estimate" else None
    side = source.facts.get("side")
    with rc_context():
        rcdefaults()
        figure = map_figure(
            source.tactile_map,
            None,
            fit=None if document is None else _contour(document),
            looked_at=() if document is None else _places(document),
            title="Tactile map" + (f" of the {side} breast" if side in ("left", "right") else ""),
            note="" if estimate is None else _note(estimate),
            findings=None if estimate is None else estimate.findings,
        )
        canvas: Any = FigureCanvasAgg(figure)
        canvas.draw()
        pixels = np.asarray(canvas.buffer_rgba())
    return np.ascontiguousarray(pixels[:, :, :3])


def _note(estimate: EstimateFile) -> str:
    from tactile_bayes.report.estimate_text import no_estimate_line

    reasons = [one.reason for one in estimate.masses if one.largest is None]
    return no_estimate_line(reasons[0][:_MOST_NOTE]) if reasons and not estimate.sized else ""


def _places(document: Any) -> list[Place]:
    from tactile_bayes.report.map_figure import Place

    return [Place((one["x_mm"], one["y_mm"]), one["fault"]) for one in document["candidates"] if one["fault"]]


def _contour(document: Any) -> FitContour | None:
    """Ellipse and size at the medians."""
    from tactile_bayes.report.map_figure import FitContour

    names = ("sigma_x_mm", "sigma_y_mm", "background", "amplitude")
    centre = document["centre_mm"] or {"x": None}
    if centre["x"] is None or centre["y"] is None or any(document[name] is None for name in names):
        return None
    middle = {name: document[name]["median"] for name in names}
    size = None
    if document["d_x_mm"] is not None and document["d_y_mm"] is not None:
        size = (document["d_x_mm"]["median"], document["d_y_mm"]["median"])
    return FitContour(
        (centre["x"]["median"], centre["y"]["median"]),
        middle["sigma_x_mm"],
        middle["sigma_y_mm"],
        0.0 if document["angle_deg"] is None else document["angle_deg"]["median"],
        size,
        middle["background"],
        middle["amplitude"],
    )
