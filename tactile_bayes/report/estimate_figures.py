"""The figures of `estimate`: the size posterior, and the map with the lump or the places looked at."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from tactile_bayes.findings import Finding
    from tactile_bayes.mapping.tactile_map import TactileMap
    from tactile_bayes.posterior.result import Estimate, Mass
    from tactile_bayes.report.map_figure import FitContour, NumberedMass
    from tactile_bayes.size.draws import SizePosterior


def draw_figures(
    tactile_map: TactileMap,
    estimate: Estimate,
    figure: Path | None,
    map_figure: Path | None,
    fit_figure: Path | None = None,
    *,
    name: str,
    probability: float,
    force: bool,
) -> None:
    """Draw the requested figures. Without a size, or a fit, they show the map, the places looked at and the reason.

    Parameters
    ----------
    figure, map_figure, fit_figure
        Where to; None draws nothing. A map without data cannot be drawn.
    name
        Of the map, for the titles.
    probability
        Of the interval of the size.
    """
    if figure is not None and estimate.size is not None:
        draw_size(estimate.size, figure, name=name, probability=probability, findings=estimate.findings, force=force)
        figure = None
    if fit_figure is not None and estimate.draws is not None:
        draw_fit(tactile_map, estimate, fit_figure, name=name, force=force)
        fit_figure = None
    if tactile_map.covered.any():
        for path in (figure, map_figure, fit_figure):
            if path is not None:
                draw_map(tactile_map, estimate, path, name=name, force=force)


def draw_size(
    size: SizePosterior,
    path: Path | None,
    *,
    name: str,
    probability: float,
    findings: Sequence[Finding],
    force: bool,
) -> Figure:
    """Draw the posterior of the largest and smallest size with their intervals, and what speaks against them."""
    from tactile_bayes.report.quantities import leading_size
    from tactile_bayes.report.size_figure import SizeInterval, size_figure
    from tactile_bayes.report.size_text import exams_label

    leads = leading_size(size)
    quantities = {which: leads.summarise(f"{which}_size_mm", probability=probability) for which in ("max", "min")}
    intervals = {which: SizeInterval(q.low, q.high, q.probability, q.kind) for which, q in quantities.items()}
    if size.another_exam is not None:
        q = size.summarise("max_size_mm", probability=probability)
        supposes = exams_label(size.figures.get("between_map_sd"))
        intervals["alike"] = SizeInterval(q.low, q.high, q.probability, q.kind, supposes)
    return size_figure(
        leads.max_size_mm.ravel(),
        leads.min_size_mm.ravel(),
        path,
        intervals=intervals,
        title=f"Size of the lump: {name}",
        findings=findings,
        force=force,
    )


def draw_fit(tactile_map: TactileMap, estimate: Estimate, path: Path | None, *, name: str, force: bool) -> Figure:
    """Draw data, fit and residual of the fit window side by side."""
    from tactile_bayes.posterior.fitted import fitted_cells
    from tactile_bayes.report.fit_figure import fit_figure

    fitted = fitted_cells(estimate)
    assert fitted is not None
    return fit_figure(tactile_map, fitted, path, title=f"Fit: {name}", findings=estimate.findings, force=force)


def draw_map(tactile_map: TactileMap, estimate: Estimate, path: Path | None, *, name: str, force: bool) -> Figure:
    """Draw the map with the lump's ellipse and size, or with the places looked at and the reason for no number."""
    from tactile_bayes.report.estimate_text import no_estimate_line
    from tactile_bayes.report.map_figure import Place, map_figure

    places = [Place(one.centre_mm, one.fault) for one in estimate.candidates if one.fault]
    note = ""
    if estimate.reason and estimate.size is None:
        gone = estimate.status == "no_estimate"
        note = no_estimate_line(estimate.reason) if gone else f"No size: {estimate.reason}."
    return map_figure(
        tactile_map,
        path,
        fit=_contour(estimate),
        masses=[_numbered(number, mass) for number, mass in enumerate(estimate.masses, start=1)],
        looked_at=places,
        title=f"Tactile map: {name}",
        note=note,
        findings=estimate.findings,
        force=force,
    )


def _contour(estimate: Estimate) -> FitContour | None:
    """Ellipse and size at the posterior medians."""
    import numpy as np

    from tactile_bayes.report.map_figure import FitContour

    found, size = estimate.map_posterior, estimate.size
    if found is None:
        return None
    names = ("x_mm", "y_mm", "sigma_x_mm", "sigma_y_mm", "angle_rad", "background", "amplitude")
    x, y, sigma_x, sigma_y, angle, level, amplitude = (float(np.median(getattr(found, name))) for name in names)
    sizes = None if size is None else (float(np.nanmedian(size.d_x_mm)), float(np.nanmedian(size.d_y_mm)))
    return FitContour((x, y), sigma_x, sigma_y, float(np.degrees(angle)), sizes, level, amplitude)


def _numbered(number: int, mass: Mass) -> NumberedMass:
    """A mass for the picture, its size at the medians."""
    from tactile_bayes.report.map_figure import NumberedMass

    contour = _contour(mass.estimate)
    if contour is None:
        return NumberedMass(number, (mass.x_mm, mass.y_mm))
    return NumberedMass(number, contour.centre_mm, contour.size_mm, contour.angle_deg)
