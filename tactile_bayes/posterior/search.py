"""Search for a lump: candidate places, their assessment, draws of the one that is a lump."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial

import numpy as np

from tactile_bayes.declarations import Record, replace
from tactile_bayes.errors import Abstention, NotConvergedError
from tactile_bayes.mapping.map import TactileMap
from tactile_bayes.posterior.abstention import shape_fault
from tactile_bayes.posterior.bump import levelled, window_cells
from tactile_bayes.posterior.correlated import Correlated
from tactile_bayes.posterior.detection import Detection
from tactile_bayes.posterior.draw import DETECTED, ModalBump, SamplerSettings
from tactile_bayes.posterior.lump_probability import NO_EVIDENCE, Weighed, weigh
from tactile_bayes.posterior.white import (
    LEAST_WIDTH_IN_CELLS,
    OUTGROWN,
    BumpFit,
    Candidate,
    MapDraws,
    White,
    fit_close,
    fitted_candidates,
)
from tactile_bayes.presets import INTERVAL
from tactile_bayes.progress import Progress
from tactile_bayes.size.draws import EXTREMES, SizePosterior
from tactile_bayes.size.pooling import Calibration, draw_sizes

# --- Both noise models have the same way: assess a place on a map, then draw from its posterior.

Assessment = White | Correlated


def assess(tactile_map: TactileMap, fit: BumpFit, options: SamplerSettings) -> Assessment:
    """Assess whether there is a lump at a fitted place, under the noise model of the options."""
    return (Correlated if options.correlated else White).of(tactile_map, fit, options)


# --- Posterior draws of a map and its size, refined until the size interval is as exact as requested.

DEFAULT_ACCURACY_SD = {"importance": 0.02, "ensemble": 0.1}
"""Accuracy of interval ends of sizes, where none is given; the methods have the same for the widths."""
MOST_REFINEMENTS, SAFETY, LEAST_ACCURACY_SD = 3, 0.8, 1e-3


class SizedDraws(Record, eq=False):
    """Draws of one map with its size by `calibration`; `fault` and `extrapolation_faults` say why there is none."""

    made: MapDraws
    size: SizePosterior | None
    fault: Abstention | None
    calibration: Calibration | None
    extrapolation_faults: tuple[str, ...] = ()


def draw_until_accurate(
    tactile_map: TactileMap,
    seen: Assessment,
    calibration: Calibration | None,
    options: SamplerSettings,
    *,
    rng: np.random.Generator,
    progress: Progress | None,
) -> SizedDraws:
    """Draw until the size interval is as accurate as requested.

    The method stops when the widths are exact enough, which mostly makes the size so too. Where a method cannot draw
    more finely the last draws stand, with their error.
    """
    draw = partial(draw_with_size, tactile_map, seen, calibration, rng=rng, progress=progress)
    sized = draw(options)
    for _ in range(MOST_REFINEMENTS):
        finer = _finer(sized, options)
        if finer is None:
            break
        options = replace(options, accuracy_sd=finer)
        try:
            sized = draw(options)
        except NotConvergedError:
            break
    return sized


def _finer(sized: SizedDraws, options: SamplerSettings) -> float | None:
    """Accuracy in SDs for the next draws; None where the size is accurate enough, or no accuracy is requested."""
    wanted = options.accuracy_sd or DEFAULT_ACCURACY_SD.get(sized.made.draws.method)
    if sized.size is None or wanted is None:
        return None
    ends = [sized.size.summarise(name, probability=INTERVAL) for name in EXTREMES]
    short = min(wanted * one.sd / one.mc_error for one in ends)
    if options.accuracy_mm is not None:
        short = min(short, *(options.accuracy_mm / one.mc_error for one in ends))
    return None if short >= 1.0 else max(SAFETY * short * wanted, LEAST_ACCURACY_SD)


def draw_with_size(
    tactile_map: TactileMap,
    seen: Assessment,
    calibration: Calibration | None,
    options: SamplerSettings,
    *,
    rng: np.random.Generator,
    progress: Progress | None,
) -> SizedDraws:
    """Draw once, and size the draws where the calibration reaches so far."""
    made = seen.draw(options, rng=rng, progress=progress)
    posterior = made.posterior
    fault = shape_fault(
        posterior.sigma_x_mm, posterior.sigma_y_mm, cell_mm=tactile_map.recipe.cell_mm, prior=options.prior
    )
    if calibration is None:
        return SizedDraws(made, None, fault, None)
    calibration = calibration.at_depth_or_fallback(*posterior.medians)
    far = tuple(calibration.extrapolation_faults(*posterior.medians))
    if fault or far:
        return SizedDraws(made, None, fault, calibration, far)
    size = draw_sizes(posterior, calibration=calibration, priors=options.size_priors, rng=rng)
    return SizedDraws(made, size, None, calibration)


# --- Search for the lump: candidate places, highest first, each fitted and assessed.

MOST_LOOKS = 3
"""Places that are no lump by the evidence before the search ends: each look is a chance to be wrong."""


def search(tactile_map: TactileMap, options: SamplerSettings) -> tuple[tuple[Candidate, ...], Assessment | None]:
    """Find the highest bump that can be a lump, also under correlated errors, and is one by the evidence.

    Returns all candidates that were looked at, the answer's last, and its assessment: None where none can be a lump,
    that of the first where none is one by the evidence.
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
            tried[-1] = replace(candidate, fault=seen.fault, detection=detection, assessed=seen.bump())
            continue
        if detection.probability >= DETECTED:
            return tuple(tried), seen
        first, looks = first or (candidate, seen), looks + 1
        if looks == MOST_LOOKS:
            break
        rather = f": rather {detection.ridge}" if detection.ridge else ""
        fault = f"{NO_EVIDENCE}{rather}"
        tried[-1] = replace(candidate, fault=fault)
    if options.correlated:
        close = _close_search(tactile_map, tried, options)
        if close is not None:
            return close
    if first is None:
        return tuple(tried), None
    return (*(one for one in tried if one.centre_mm != first[0].centre_mm), first[0]), first[1]


def _places(tactile_map: TactileMap, options: SamplerSettings) -> Iterator[Candidate]:
    """Candidate places, highest first, fitted on demand."""
    settings = _search_options(tactile_map, options)
    if not options.correlated:
        yield from fitted_candidates(tactile_map, settings)
        return
    found_on = levelled(tactile_map)
    for one in fitted_candidates(found_on, settings):
        if found_on is tactile_map or one.fit is None:
            yield one
        else:
            yield replace(one, fit=_with_cells_of(tactile_map, one.fit, settings))


def _with_cells_of(tactile_map: TactileMap, fit: BumpFit, settings: SamplerSettings) -> BumpFit:
    """Replace a fit's cells by the map's cells in the whole window.

    Under a noise field least squares is only a start.
    """
    centre = (float(fit.theta[1]), float(fit.theta[2]))
    return replace(fit, cells=window_cells(tactile_map, centre, radius_mm=settings.fit_radius_mm))


def _close_search(
    tactile_map: TactileMap, tried: list[Candidate], options: SamplerSettings
) -> tuple[tuple[Candidate, ...], Assessment] | None:
    """Search again close to the highest places from which the fit moved away; None where none is a lump.

    Beside a rib, least squares grows over both. Correlated errors can represent the rib, and it is tested for later.
    """
    looks, settings, found_on = 0, _search_options(tactile_map, options), levelled(tactile_map)
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


def best_chance(tactile_map: TactileMap, candidates: Sequence[Candidate], options: SamplerSettings) -> Weighed | None:
    """The most probable lump among rises that cannot be measured; None where none can be assessed.

    Those that the search has weighed count. Where they are fewer than `MOST_LOOKS` the highest others are weighed too,
    from a smaller window where the fit ran away or outgrew its own. A fit to a single cell says nothing of a lump and
    is passed over.
    """
    weighed: list[Weighed] = []
    for candidate in sorted(candidates, key=lambda one: one.detection is None):
        if candidate.detection is None and len(weighed) >= MOST_LOOKS:
            break
        bump, detection = candidate.bump, candidate.detection
        if detection is None:
            bump, detection = _weighed(tactile_map, candidate, options)
        if bump is not None and detection is not None:
            weighed.append(weigh(tactile_map, detection, bump, fault=candidate.fault, candidate=candidate))
    return max(weighed, key=lambda one: (one.probability, one.detection.log_bayes_factor), default=None)


def _weighed(
    tactile_map: TactileMap, candidate: Candidate, options: SamplerSettings
) -> tuple[ModalBump | None, Detection | None]:
    """Bump and odds of a lump at a faulty place; from close by where the first fit moved away or grew too large."""
    fit, settings = candidate.fit, _search_options(tactile_map, options)
    if fit is None or candidate.fault.startswith(OUTGROWN):
        fit, _ = fit_close(levelled(tactile_map), candidate.centre_mm, options=settings)
    if fit is None or min(fit.widths()[:2]) < LEAST_WIDTH_IN_CELLS * fit.cells.cell_mm:
        return None, None
    return fit.modal(), assess(tactile_map, _with_cells_of(tactile_map, fit, settings), options).detection


def _search_options(tactile_map: TactileMap, fit: SamplerSettings) -> SamplerSettings:
    """Options of the least-squares search for a lump.

    Under a noise field it only has to find the place: there the known level holds it better than a free one, which a
    rib at the window's rim can lift.
    """
    known = fit.correlated and tactile_map.background is not None
    return replace(fit, background="fixed") if known else fit
