"""Search for the lump: candidate places, highest first, each fitted and assessed."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

from tactile_bayes.mapping.tactile_map import TactileMap
from tactile_bayes.posterior.assessment import Assessment, assess
from tactile_bayes.posterior.lump.cells import levelled, window_cells
from tactile_bayes.posterior.lump_probability import NO_EVIDENCE, Weighed, weigh_candidate
from tactile_bayes.posterior.options import DETECTED, EstimateOptions, FitOptions
from tactile_bayes.posterior.white.detection import Detection
from tactile_bayes.posterior.white.fit import (
    LEAST_WIDTH_IN_CELLS,
    OUTGROWN,
    BumpFit,
    Candidate,
    fit_close,
    fitted_candidates,
)

MOST_LOOKS = 3
"""Places that are no lump by the evidence before the search ends: each look is a chance to be wrong."""


def search(tactile_map: TactileMap, options: EstimateOptions) -> tuple[tuple[Candidate, ...], Assessment | None]:
    """Find the highest bump that can be a lump, also under correlated errors, and is one by the evidence.

    Returns
    -------
    candidates
        All that were looked at; the answer is the last one's.
    assessment
        None where no candidate can be a lump. Where none is one by the evidence, that of the first.
    """
    tried: list[Candidate] = []
    first: tuple[Candidate, Assessment] | None = None
    looks = 0
    for candidate in _places(tactile_map, options):
        tried.append(candidate)
        if candidate.fault or candidate.fit is None:
            continue
        seen = assess(tactile_map, candidate.fit, options)
        detection = seen.detection
        if seen.fault:
            tried[-1] = replace(candidate, fault=seen.fault, detection=detection)
            continue
        if detection.probability >= DETECTED:
            return tuple(tried), seen
        first, looks = first or (candidate, seen), looks + 1
        if looks == MOST_LOOKS:
            break
        rather = f": rather {detection.ridge}" if detection.ridge else ""
        fault = f"{NO_EVIDENCE}{rather}"
        tried[-1] = replace(candidate, fault=fault)
    if options.fit.correlated:
        close = _close_search(tactile_map, tried, options)
        if close is not None:
            return close
    if first is None:
        return tuple(tried), None
    return (*(one for one in tried if one.centre_mm != first[0].centre_mm), first[0]), first[1]


def _places(tactile_map: TactileMap, options: EstimateOptions) -> Iterator[Candidate]:
    """Candidate places, highest first, fitted on demand."""
    settings = _search_options(tactile_map, options.fit)
    if not options.fit.correlated:
        yield from fitted_candidates(tactile_map, settings)
        return
    found_on = levelled(tactile_map)
    for one in fitted_candidates(found_on, settings):
        if found_on is tactile_map or one.fit is None:
            yield one
        else:
            yield replace(one, fit=_with_cells_of(tactile_map, one.fit, settings))


def _with_cells_of(tactile_map: TactileMap, fit: BumpFit, settings: FitOptions) -> BumpFit:
    """Replace a fit's cells by the map's cells in the whole window.

    Under a noise field least squares is only a start.
    """
    centre = (float(fit.theta[1]), float(fit.theta[2]))
    return replace(fit, cells=window_cells(tactile_map, centre, radius_mm=settings.radius_mm))


def _close_search(
    tactile_map: TactileMap, tried: list[Candidate], options: EstimateOptions
) -> tuple[tuple[Candidate, ...], Assessment] | None:
    """Search again close to the highest places from which the fit moved away; None where none is a lump.

    Beside a rib, least squares grows over both. Correlated errors can represent the rib, and it is tested for later.
    """
    looks, settings, found_on = 0, _search_options(tactile_map, options.fit), levelled(tactile_map)
    for i, candidate in enumerate(tried):
        if candidate.fit is not None and not candidate.fault.startswith(OUTGROWN):
            continue
        fit, fault = fit_close(found_on, candidate.centre_mm, options=settings)
        if fit is None or fault:
            continue
        fit = _with_cells_of(tactile_map, fit, settings)
        seen = assess(tactile_map, fit, options)
        tried[i] = replace(candidate, detection=seen.detection)
        if seen.scene is None or seen.fault:
            continue
        if seen.detection.probability >= DETECTED:
            return (*tried[:i], *tried[i + 1 :], replace(candidate, fit=fit, fault="")), seen
        looks += 1
        if looks == MOST_LOOKS:
            break
    return None


def best_chance(tactile_map: TactileMap, candidates: Sequence[Candidate], options: EstimateOptions) -> Weighed | None:
    """The most probable lump among rises that cannot be measured; None where none can be assessed.

    Those that the search has weighed count. Where they are fewer than `MOST_LOOKS` the highest others are weighed too,
    from a smaller window where the fit ran away or outgrew its own. A fit to a single cell says nothing of a lump and
    is passed over.
    """
    weighed: list[Weighed] = []
    for candidate in sorted(candidates, key=lambda one: one.detection is None):
        if candidate.detection is None and len(weighed) >= MOST_LOOKS:
            break
        fit, detection = candidate.fit, candidate.detection
        if detection is None:
            fit, detection = _weighed(tactile_map, candidate, options) or (None, None)
        if detection is not None:
            one = weigh_candidate(tactile_map, replace(candidate, fit=fit), detection)
            weighed += [] if one is None else [replace(one, candidate=candidate)]
    return max(weighed, key=lambda one: (one.probability, one.detection.log_bayes_factor), default=None)


def _weighed(
    tactile_map: TactileMap, candidate: Candidate, options: EstimateOptions
) -> tuple[BumpFit, Detection] | None:
    """Odds of a lump at a faulty place, fitted from close by where the first fit moved away or grew too large."""
    fit, settings = candidate.fit, _search_options(tactile_map, options.fit)
    if fit is None or candidate.fault.startswith(OUTGROWN):
        fit, _ = fit_close(levelled(tactile_map), candidate.centre_mm, options=settings)
    if fit is None or min(fit.widths()[:2]) < LEAST_WIDTH_IN_CELLS * fit.cells.cell_mm:
        return None
    return fit, assess(tactile_map, _with_cells_of(tactile_map, fit, settings), options).detection


def _search_options(tactile_map: TactileMap, fit: FitOptions) -> FitOptions:
    """Options of the least-squares search for a lump.

    Under a noise field it only has to find the place: there the known level holds it better than a free one, which a
    rib at the window's rim can lift.
    """
    known = fit.correlated and tactile_map.background is not None
    return replace(fit, background="fixed") if known else fit
