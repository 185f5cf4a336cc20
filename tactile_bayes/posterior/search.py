"""Where the lump is: the places a map offers, highest first, each fitted, weighed and doubted."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from tactile_bayes.errors import NotConvergedError
from tactile_bayes.mapping.tactile_map import TactileMap
from tactile_bayes.posterior.abstention import missing_strokes
from tactile_bayes.posterior.lump.cells import covered_share, levelled, window_cells
from tactile_bayes.posterior.options import ROTATION_ODDS, EstimateOptions, FitOptions, scene_asked
from tactile_bayes.posterior.white.detection import Detection, detect
from tactile_bayes.posterior.white.fit import (
    LEAST_COVERED_SHARE,
    LEAST_WIDTH_IN_CELLS,
    OUTGROWN,
    BumpFit,
    Candidate,
    fit_close,
    fitted_candidates,
)

if TYPE_CHECKING:
    from tactile_bayes.posterior.correlated.estimate import FieldAnswer
    from tactile_bayes.posterior.options import EstimateOptions

WIDE_IN_RADII = 0.4
ENCLOSED_IN_WIDTHS = 1.6
"""How far the map must reach on every side of a bump wide for its window: a rise to the edge looks like half.

Of 800 simulated exams 46 showed a lump wider than 8 mm, all of them enclosed so; the end of strokes made one more rise.
"""
MOST_LOOKS = 3
"""Places that are no lump by the evidence before the search ends: each look is a chance to be wrong."""


def search(
    tactile_map: TactileMap, options: EstimateOptions
) -> tuple[tuple[Candidate, ...], Detection | FieldAnswer | None]:
    """The highest bump that can be a lump, still can once correlated errors are weighed, and is one by the evidence.

    Returns
    -------
    candidates
        All that were looked at; the answer is the last one's.
    answer
        None where no candidate can be a lump. Where none is one by the evidence, that of the first.
    """
    tried: list[Candidate] = []
    first: tuple[Candidate, Detection | FieldAnswer] | None = None
    looks = 0
    for candidate in _places(tactile_map, options):
        tried.append(candidate)
        if candidate.fault or candidate.fit is None:
            continue
        seen, fault = _look(tactile_map, candidate.fit, options)
        if fault:
            tried[-1] = replace(candidate, fault=fault, detection=_detection(seen))
            continue
        detection = _detection(seen)
        if detection.probability >= options.least_probability:
            return tuple(tried), seen
        first, looks = first or (candidate, seen), looks + 1
        if looks == MOST_LOOKS:
            break
        rather = f": rather {detection.ridge}" if detection.ridge else ""
        fault = f"no lump by the evidence (probability {detection.probability:.2g}){rather}"
        tried[-1] = replace(candidate, fault=fault)
    if options.fit.noise == "field":
        close = _close_search(tactile_map, tried, options)
        if close is not None:
            return close
    if first is None:
        return tuple(tried), None
    return (*(one for one in tried if one.centre_mm != first[0].centre_mm), first[0]), first[1]


def _places(tactile_map: TactileMap, options: EstimateOptions) -> Iterator[Candidate]:
    """The places a map offers, highest first, fitted as they are asked for."""
    settings = _search_options(tactile_map, options.fit)
    if options.fit.noise != "field":
        yield from fitted_candidates(tactile_map, settings)
        return
    found_on = levelled(tactile_map)
    for one in fitted_candidates(found_on, settings):
        if found_on is tactile_map or one.fit is None:
            yield one
        else:
            yield replace(one, fit=_with_cells_of(tactile_map, one.fit, settings))


def _with_cells_of(tactile_map: TactileMap, fit: BumpFit, settings: FitOptions) -> BumpFit:
    """A fit to the levelled map, or in a smaller window, with the map's cells of the whole window.

    Under a noise field least squares is only a start.
    """
    centre = (float(fit.theta[1]), float(fit.theta[2]))
    return replace(fit, cells=window_cells(tactile_map, centre, radius_mm=settings.radius_mm))


def _close_search(
    tactile_map: TactileMap, tried: list[Candidate], options: EstimateOptions
) -> tuple[tuple[Candidate, ...], FieldAnswer] | None:
    """A second look, from close by, at the highest places from which the fit ran away; None where none is a lump.

    Beside a rib least squares grows over both. The posterior has errors that can be a rib, and asks for one after.
    """
    looks, settings, found_on = 0, _search_options(tactile_map, options.fit), levelled(tactile_map)
    for i, candidate in enumerate(tried):
        if candidate.fit is not None and not candidate.fault.startswith(OUTGROWN):
            continue
        fit, fault = fit_close(found_on, candidate.centre_mm, options=settings)
        if fit is None or fault:
            continue
        fit = _with_cells_of(tactile_map, fit, settings)
        seen, fault = _look(tactile_map, fit, options)
        tried[i] = replace(candidate, detection=_detection(seen))
        if isinstance(seen, Detection) or fault:
            continue
        if seen.detection.probability >= options.least_probability:
            return (*tried[:i], *tried[i + 1 :], replace(candidate, fit=fit, fault="")), seen
        looks += 1
        if looks == MOST_LOOKS:
            break
    return None


def best_chance(
    tactile_map: TactileMap, candidates: Sequence[Candidate], options: EstimateOptions
) -> tuple[Candidate, Detection] | None:
    """The likeliest lump among rises none of which can be measured; None where none can be weighed.

    Those that the search has weighed count. Where they are fewer than `MOST_LOOKS` the highest others are weighed too,
    from a smaller window where the fit ran away or outgrew its own. A fit to a single cell says nothing of a lump and
    is passed over.
    """
    weighed = [(one, one.detection) for one in candidates if one.detection is not None]
    for candidate in candidates:
        if len(weighed) >= MOST_LOOKS:
            break
        detection = None if candidate.detection else _weighed(tactile_map, candidate, options)
        if detection is not None:
            weighed.append((candidate, detection))
    return max(weighed, key=lambda one: one[1].probability) if weighed else None


def _weighed(tactile_map: TactileMap, candidate: Candidate, options: EstimateOptions) -> Detection | None:
    """Odds of a lump at a place that has a fault, from close by where its fit ran away or outgrew the window."""
    fit, settings = candidate.fit, _search_options(tactile_map, options.fit)
    if fit is None or candidate.fault.startswith(OUTGROWN):
        fit, _ = fit_close(levelled(tactile_map), candidate.centre_mm, options=settings)
    if fit is None or min(fit.widths()[:2]) < LEAST_WIDTH_IN_CELLS * fit.cells.cell_mm:
        return None
    seen, _ = _look(tactile_map, _with_cells_of(tactile_map, fit, settings), options)
    return _detection(seen)


def _field_fault(tactile_map: TactileMap, seen: FieldAnswer) -> str:
    """Under correlated errors a rise at the map's edge can grow to lie mostly beyond it, or shrink to a single cell."""
    from tactile_bayes.posterior.correlated.fit import shape_draws

    plain, cell = seen.choice.plain, tactile_map.recipe.cell_mm
    sigma_x, sigma_y, _ = (float(values[0]) for values in shape_draws(plain, plain.mode[None]))
    centre = tuple(float(plain.scene.column(plain.mode[None], name)[0]) for name in ("x", "y"))
    wide, narrow = max(sigma_x, sigma_y), min(sigma_x, sigma_y)
    share = covered_share(tactile_map, (centre[0], centre[1]), radius_mm=1.5 * wide)
    if share < LEAST_COVERED_SHARE:
        return f"at the rim of the map ({100 * share:.0f} % of the bump is covered, with a sigma of {wide:.3g} mm)"
    wide_rise = wide > WIDE_IN_RADII * plain.target.radius_mm
    short = missing_strokes(tactile_map, (centre[0], centre[1]), reach_mm=ENCLOSED_IN_WIDTHS * wide)
    if wide_rise and short:
        side, millimetres = max(short.items(), key=lambda one: one[1])
        return (
            f"at the rim of the map (with a sigma of {wide:.3g} mm its flank to {side} is {millimetres:.0f} mm short)"
        )
    if narrow < LEAST_WIDTH_IN_CELLS * cell:
        return f"narrower than a cell (sigma {narrow:.2g} mm on {cell:g} mm cells): not resolved"
    return ""


def _search_options(tactile_map: TactileMap, fit: FitOptions) -> FitOptions:
    """Options of the least squares that looks for a lump.

    Under a noise field it only has to find the place: there the known level holds it better than a free one, which a
    rib at the window's rim can lift.
    """
    known = fit.noise == "field" and tactile_map.background is not None
    return replace(fit, background="fixed") if known else fit


def _detection(seen: Detection | FieldAnswer) -> Detection:
    return seen if isinstance(seen, Detection) else seen.detection


def _look(tactile_map: TactileMap, fit: BumpFit, options: EstimateOptions) -> tuple[Detection | FieldAnswer, str]:
    """Whether there is a lump, under a noise field with the fit that says so; and why it can be none all the same."""
    if options.fit.noise != "field":
        return detect(tactile_map, fit.bump, theta=fit.theta, covariance=fit.covariance, prior=options.prior), ""
    from tactile_bayes.posterior.correlated.estimate import look, with_neighbours

    scene = scene_asked(options)
    try:
        seen = look(
            tactile_map,
            fit,
            prior=options.prior,
            radius_mm=options.fit.radius_mm,
            scene=scene,
            least_odds=ROTATION_ODDS,
            cosines=options.fit.field_cosines,
        )
    except NotConvergedError:
        # no mode: under these errors nothing stands out that could be weighed
        return Detection(0.0, -np.inf), ""
    fault = _field_fault(tactile_map, seen)
    if fault or seen.detection.probability < options.least_probability:
        return seen, fault
    return with_neighbours(seen, tactile_map, scene=scene), ""
