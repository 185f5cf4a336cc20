"""Estimation of a lump's size from a tactile map, or the reason for giving none."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from types import MappingProxyType
from typing import Any

import numpy as np

from tactile_bayes.declarations import Record, replace
from tactile_bayes.errors import NO_LUMP, Abstention, BadDataError, NotConvergedError
from tactile_bayes.findings import Finding, by_severity, finding
from tactile_bayes.inference.ensemble import convergence
from tactile_bayes.mapping.map import TactileMap
from tactile_bayes.mapping.plausibility import map_findings
from tactile_bayes.posterior import verdict, white
from tactile_bayes.posterior.bump import Detection, levelled, window_cells
from tactile_bayes.posterior.correlated import Correlated
from tactile_bayes.posterior.draw import DETECTED, ROTATION_ODDS, ModalBump, SamplerSettings, check_options
from tactile_bayes.posterior.result import Estimate, prior_sensitivity
from tactile_bayes.posterior.white import BumpFit, Candidate, MapDraws, White
from tactile_bayes.presets import CELL_PER_SIGMA, INTERVAL
from tactile_bayes.progress import Progress
from tactile_bayes.scans import DEFAULT_HEAD, HeadShape
from tactile_bayes.size import terms
from tactile_bayes.size.draws import BUMP, EXTREMES, SIZES
from tactile_bayes.size.pooling import Calibration, draw_sizes

# --- Search for the lump: candidate places, highest first, each fitted and assessed.
#
# Both noise models have the same way: assess a place on a map, then draw from its posterior.

Assessment = White | Correlated


def assess(tactile_map: TactileMap, fit: BumpFit, options: SamplerSettings) -> Assessment:
    """Assess whether there is a lump at a fitted place, under the noise model of the options."""
    if options.correlated:
        return Correlated.of(tactile_map, fit, options)
    return White(tactile_map, fit, white.detect(tactile_map, fit))


MOST_LOOKS = 3  #: Places that are no lump by the evidence before the search ends: each look is a chance to be wrong.


def search(tactile_map: TactileMap, options: SamplerSettings) -> tuple[tuple[Candidate, ...], Assessment | None]:
    """All candidates looked at, and the assessment of the last: the highest bump that is a lump by the evidence, or the
    first where none is; None where none can be a lump."""
    tried: list[Candidate] = []
    first: tuple[Candidate, Assessment] | None = None
    looks, settings = 0, _search_options(tactile_map, options)
    found_on = levelled(tactile_map) if options.correlated else tactile_map
    for place in white.fitted_candidates(found_on, settings):
        candidate = place
        if found_on is not tactile_map and place.fit is not None:
            candidate = replace(place, fit=_with_cells_of(tactile_map, place.fit, settings))
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
        tried[-1] = replace(candidate, fault=f"{verdict.NO_EVIDENCE}{rather}")
    if options.correlated and (close := _close_search(tactile_map, tried, options)) is not None:
        return close
    if first is None:
        return tuple(tried), None
    return (*(one for one in tried if one.centre_mm != first[0].centre_mm), first[0]), first[1]


def _with_cells_of(tactile_map: TactileMap, fit: BumpFit, settings: SamplerSettings) -> BumpFit:
    """The fit with the map's own cells in the whole window: under a noise field least squares is only a start."""
    return replace(fit, cells=window_cells(tactile_map, fit.centre_mm, radius_mm=settings.fit_radius_mm))


def _close_search(
    tactile_map: TactileMap, tried: list[Candidate], options: SamplerSettings
) -> tuple[tuple[Candidate, ...], Assessment] | None:
    """Search again close to the highest places from which the fit moved away, as beside a rib; None without a lump."""
    looks, settings, found_on = 0, _search_options(tactile_map, options), levelled(tactile_map)
    for i, candidate in enumerate(tried):
        if candidate.fit is not None and not candidate.fault.startswith(white.OUTGROWN):
            continue
        fit, fault = white.fit_close(found_on, candidate.centre_mm, options=settings)
        if fit is None or fault:
            continue
        seen = assess(tactile_map, _with_cells_of(tactile_map, fit, settings), options)
        tried[i] = replace(candidate, detection=seen.detection)
        if seen.scene is None or seen.fault:
            continue
        if seen.detection.probability >= DETECTED:
            return (*tried[:i], *tried[i + 1 :], replace(candidate, fit=seen.fit, fault="")), seen
        looks += 1
        if looks == MOST_LOOKS:
            break
    return None


def best_chance(
    tactile_map: TactileMap, candidates: Sequence[Candidate], options: SamplerSettings
) -> verdict.Weighed | None:
    """The most probable lump among rises that cannot be measured; None where none can be assessed.

    Those that the search has weighed count. Where they are fewer than `MOST_LOOKS` the highest others are weighed too.
    """
    weighed: list[verdict.Weighed] = []
    settings = _search_options(tactile_map, options)
    for candidate in sorted(candidates, key=lambda one: one.detection is None):
        if candidate.detection is None and len(weighed) >= MOST_LOOKS:
            break
        fit, bump, detection = candidate.fit, candidate.bump, candidate.detection
        if detection is None:
            if fit is None or candidate.fault.startswith(white.OUTGROWN):  # the bump close by
                fit, _ = white.fit_close(levelled(tactile_map), candidate.centre_mm, options=settings)
            if fit is None or min(fit.widths()[:2]) < white.LEAST_WIDTH_IN_CELLS * fit.cells.cell_mm:
                continue  # a fit to a single cell says nothing of a lump
            bump = fit.modal()
            detection = assess(tactile_map, _with_cells_of(tactile_map, fit, settings), options).detection
        if bump is not None:
            weighed.append(verdict.weigh(tactile_map, detection, bump, candidate))
    return max(weighed, key=lambda one: (one.probability, one.detection.log_bayes_factor), default=None)


def _search_options(tactile_map: TactileMap, fit: SamplerSettings) -> SamplerSettings:
    """Options of the least-squares search, which under a noise field only finds the place: there the known level holds
    it better than a free one, which a rib at the window's rim can lift."""
    known = fit.correlated and tactile_map.background is not None
    return replace(fit, background="fixed") if known else fit


# --- Posterior draws of a map and its size, refined until the size interval is as exact as requested.

DEFAULT_ACCURACY_SD = {"importance": 0.02, "ensemble": 0.1}
"""Accuracy of interval ends of sizes, where none is given; the methods have the same for the widths."""
MOST_REFINEMENTS, SAFETY, LEAST_ACCURACY_SD = 3, 0.8, 1e-3


class Work(Record, eq=False):
    """What an estimate is made of."""

    tactile_map: TactileMap
    calibration: Calibration | None
    options: SamplerSettings
    rng: np.random.Generator
    progress: Progress | None = None  #: Called with effective draws done and wanted.


def draw_until_accurate(work: Work, seen: Assessment) -> MapDraws:
    """Draw until the size interval is as accurate as requested.

    The method stops when the widths are exact enough, which mostly makes the size so too. Where a method cannot draw
    more finely the last draws stand, with their error.
    """
    sized = draw_with_size(work, seen)
    for _ in range(MOST_REFINEMENTS):
        finer = _finer(sized, work.options)
        if finer is None:
            break
        work = replace(work, options=replace(work.options, accuracy_sd=finer))
        try:
            sized = draw_with_size(work, seen)
        except NotConvergedError:
            break
    return sized


def _finer(sized: MapDraws, options: SamplerSettings) -> float | None:
    """Accuracy in SDs for the next draws; None where the size is accurate enough, or no accuracy is requested."""
    wanted = options.accuracy_sd or DEFAULT_ACCURACY_SD.get(sized.draws.method)
    if sized.size is None or wanted is None:
        return None
    ends = [sized.size.summarise(name, probability=INTERVAL) for name in EXTREMES]
    short = min(wanted * one.sd / one.mc_error for one in ends)
    if options.accuracy_mm is not None:
        short = min(short, *(options.accuracy_mm / one.mc_error for one in ends))
    return None if short >= 1.0 else max(SAFETY * short * wanted, LEAST_ACCURACY_SD)


def draw_with_size(work: Work, seen: Assessment) -> MapDraws:
    """Draw once, and size the draws where the calibration reaches so far."""
    options, cell_mm = work.options, work.tactile_map.recipe.cell_mm
    made = seen.draw(options, rng=work.rng, progress=work.progress)
    posterior, calibration = made.posterior, work.calibration
    fault = verdict.shape_fault(posterior.sigma_x_mm, posterior.sigma_y_mm, cell_mm=cell_mm, prior=options.prior)
    if calibration is None:
        return replace(made, fault=fault)
    calibration = calibration.at_depth_or_fallback(*posterior.medians)
    if fault is None and (far := calibration.outside(*posterior.medians, far=True)):
        fault = terms.extrapolated(far)
    made = replace(made, calibration=calibration, fault=fault)
    if fault is not None:
        return made
    return replace(made, size=draw_sizes(posterior, calibration=calibration, priors=options.size_priors, rng=work.rng))


# --- The answer for one map: a size, widths, or the reason for neither.

MOST_INVALID = 0.05
LONGER = "give --method ensemble, with a larger max_steps in --settings FILE.toml"
OTHER_METHOD_ON_PAPER = "have the size estimated again by the slower method"
OTHER_HEAD = (
    "learn one for this head: `tactile-bayes population --head HEAD.json -o population.csv`, then `tactile-bayes "
    "calibrate size population.csv --form eq6-residual -o size.json`, and give --size-calibration size.json"
)
"""How to make a calibration for another head."""
_IRREGULAR = finding(
    "irregular",
    "irregular outline, unlike a ball's or an ellipsoid's: two lumps that touch, or an upright, tilted or rough one "
    "look so, and the interval is wider",
)
_NEAR_LEVEL = 0.02  #: An offset of the background of this size and more is mentioned.


def estimate_map(
    tactile_map: TactileMap,
    *,
    calibration: Calibration | None,
    options: SamplerSettings,
    rng: np.random.Generator,
    progress: Progress | None = None,
) -> Estimate:
    """Estimate the lump's size from one map; without a calibration the estimate stops at widths and amplitude.

    `BadDataError` when the map or the fit options differ from the calibration's recipe, `UsageError` when an option
    does not go with another or with the map, `NotConvergedError` when the method does not converge.
    """
    white.check_background(tactile_map, options)
    check_options(options)
    if calibration is not None:
        differs = recipe_differences(tactile_map, calibration, options)
        if differs:
            raise BadDataError(
                f"the size calibration was learned by another recipe: {'; '.join(differs)}",
                way_out=_way_to(calibration.recipe, tactile_map),
            )
        calibration = calibration_for(tactile_map, calibration)
    estimate = _answer(Work(tactile_map, calibration, options, rng, progress))
    if estimate.code in NO_LUMP and options.scene != "none" and (why := verdict.no_verdict(tactile_map)) is not None:
        estimate = _none(why, estimate.candidates)
    of_map = (*map_findings(tactile_map), *tactile_map.findings)
    return replace(estimate, findings=by_severity((*of_map, *estimate.findings)))


def _answer(work: Work) -> Estimate:
    """The lump's size, or why there is none."""
    tactile_map, options = work.tactile_map, work.options
    if not tactile_map.covered.any():
        return _none(Abstention("empty", "the map has no covered cell"))
    where = verdict.searched(tactile_map, options.centre_mm)
    candidates, seen = search(tactile_map, options)
    if not candidates:
        reason = f"no lump found {where}: nothing rises above the background"
        return _none(Abstention("empty", reason, verdict.FEEL_AGAIN, verdict.FEEL_AGAIN_ON_PAPER))
    if seen is None:
        likeliest = best_chance(tactile_map, candidates, options)
        why = verdict.no_bump(tactile_map, candidates, likeliest, where=where)
        if likeliest is None:
            return _none(why, candidates)
        fit, detection = None if likeliest.candidate is None else likeliest.candidate.fit, likeliest.detection
        lump = detection.probability >= DETECTED and why.code not in NO_LUMP
        estimate = _none(why, candidates, detection, fit.modal() if lump and fit is not None else None)
        return replace(estimate, weighed=likeliest)
    # by the bump's mode where it is a lump by the evidence, else by least squares
    bump = seen.bump() if seen.detection.probability >= DETECTED else seen.fit.modal()
    weighed = verdict.weigh(tactile_map, seen.detection, bump)
    if seen.detection.probability < DETECTED or weighed.probability < verdict.LIKELY:
        estimate = _none(verdict.undetected(weighed, where=where), candidates, seen.detection)
    elif options.scene == "none":
        estimate = _none(Abstention("undetected", "no lump was assumed"), candidates, seen.detection)
    else:
        estimate = _measured(work, seen, candidates)
    if estimate.code == "ridge" and not estimate.reason.startswith("no lump found"):
        estimate = replace(estimate, reason=f"no lump found {where}: {estimate.reason}")
    return replace(estimate, weighed=verdict.weigh(tactile_map, estimate.detection or seen.detection, bump))


def _measured(work: Work, seen: Assessment, candidates: tuple[Candidate, ...]) -> Estimate:
    """Draw a lump that is one by the evidence, and size it; or the reason why not."""
    options, cell_mm = work.options, work.tactile_map.recipe.cell_mm
    detection, bump = seen.detection, seen.bump()
    hopeless = verdict.width_fault(bump.sigma_x_mm, bump.sigma_y_mm, cell_mm=cell_mm, margin=verdict.HOPELESS)
    if hopeless is not None:
        return _none(hopeless, candidates, detection, bump)
    try:
        made = draw_until_accurate(work, seen)
    except NotConvergedError as error:
        why = Abstention("method", f"no method converged: {error}", LONGER, OTHER_METHOD_ON_PAPER)
        if error.advice:
            why = Abstention("method", str(error), error.advice, "have the size estimated again without this neighbour")
        elif options.method == "ensemble" or not options.correlated:
            raise
        return _none(why, candidates, detection, bump)
    detection, posterior, size, fault = made.detection, made.posterior, made.size, made.fault
    diagnostics = _diagnostics(made)
    if size is not None and size.invalid > MOST_INVALID * size.d_x_mm.size:
        reason = f"no positive size in {size.invalid} of {size.d_x_mm.size} draws: outside the calibration"
        advice = "learn a calibration whose table holds such lumps"
        fault = Abstention("extrapolated", reason, advice, terms.UNLIKE_ON_PAPER)
    if fault is not None:
        return _none(fault, candidates, detection, bump, diagnostics if fault.code == "extrapolated" else {})
    drawn = {"sigma_x_mm": posterior.sigma_x_mm, "sigma_y_mm": posterior.sigma_y_mm}
    drawn |= {} if size is None else {"max_size_mm": size.max_size_mm}
    return Estimate(
        "estimate",
        "" if made.calibration is not None else "no size calibration was given: widths only",
        detection=detection,
        fit=made.fit,
        draws=made.draws,
        map_posterior=posterior,
        size=size,
        candidates=candidates,
        diagnostics=diagnostics,
        left_out=_left_out(work.tactile_map, options, made),
        scene=seen.scene,
        sensitivity=prior_sensitivity(posterior.sigma_x_mm, posterior.sigma_y_mm, drawn, options.prior),
        bump=bump,
        findings=tuple(_findings(made, cell_mm=cell_mm)),
    )


def _none(
    why: Abstention,
    candidates: tuple[Candidate, ...] = (),
    detection: Detection | None = None,
    bump: ModalBump | None = None,
    diagnostics: Mapping[str, Any] = MappingProxyType({}),
) -> Estimate:
    told = asdict(why)
    if why.code in NO_LUMP and bump is not None:
        told["about_mm"], bump = (bump.x_mm, bump.y_mm), None
    told |= {"detection": detection, "bump": bump, "candidates": candidates, "diagnostics": diagnostics}
    return Estimate("no_estimate", **told)


def calibration_for(tactile_map: TactileMap, calibration: Calibration) -> Calibration:
    """The calibration at the map's depth of fat, where both have one."""
    return calibration.at_fat([terms.head_profile(tactile_map.quality)])


def recipe_differences(tactile_map: TactileMap, calibration: Calibration, fit: SamplerSettings) -> list[str]:
    """Differences of a map and its fit options from the calibration's recipe, in words; empty without any."""
    ours, made = calibration.recipe, tactile_map.recipe
    theirs = replace(
        ours,
        normalise=made.normalise,
        background=fit.background,
        radius_mm=fit.fit_radius_mm,
        noise=fit.noise,
        flat_field=made.flat_field_known,
        head=tactile_map.head,
    )
    return ours.differences(theirs)


def way_to_head(head: HeadShape | None) -> str:
    """Command that gives a calibration for a map's head."""
    shipped = head is not None and not DEFAULT_HEAD.differences(head)
    return f"give --size-calibration solid or eq6, which are for this head; or {OTHER_HEAD}" if shipped else OTHER_HEAD


def _way_to(recipe: terms.Recipe, tactile_map: TactileMap) -> str:
    """Command that makes a map fit a calibration: its map command where the map differs, else the fit's options."""
    if recipe.head_differences(tactile_map.head):
        return way_to_head(tactile_map.head)
    made = (tactile_map.recipe.normalise, tactile_map.recipe.flat_field_known)
    wanted = (recipe.normalise, made[1] if recipe.flat_field is None else recipe.flat_field)
    if made[0] != wanted[0] or (made[1] is not None and made[1] != wanted[1]):
        return (
            f"make the map again with {recipe.map_command}, or give --size-calibration solid or eq6 for a default map"
        )
    return "leave the fit's options to the calibration, or learn a calibration for these"


def _diagnostics(made: MapDraws) -> dict[str, Any]:
    figures = {
        "cells": len(made.fit.cells),
        "covered_share": made.fit.covered_share,
        "fat_mm": None if made.calibration is None else made.calibration.fat_mm,
        **made.draws.diagnostics,
        **made.figures,
        "method": made.draws.method,
    }
    if made.draws.method != "ensemble":
        return figures
    drawn = {name: getattr(made.posterior, name) for name in BUMP[:3]}
    drawn = {name: getattr(made.size, name) for name in SIZES if made.size is not None} | drawn
    return figures | {"convergence": {name: convergence(values) for name, values in drawn.items()}}


def _findings(made: MapDraws, *, cell_mm: float) -> Iterator[Finding]:
    """Findings against the size of a lump, besides those against its map."""
    posterior, calibration = made.posterior, made.calibration
    if calibration is not None:
        beyond = [] if made.size is None else calibration.beyond_lumps(made.size.median_mm)
        for text in (*calibration.outside(*posterior.medians), *beyond):
            yield finding("outside_calibration", f"{terms.UNLIKE_LEARNED}: {text}")
    if posterior.irregular:
        yield _IRREGULAR
    if cell_mm > CELL_PER_SIGMA * min(posterior.medians[1:]):
        text = f"the map's cells of {cell_mm:g} mm are coarse for so small a lump"
        remedy, on_paper = "map again with a smaller --cell-mm", "have the scan mapped again with smaller cells"
        yield finding("coarse_cells", text, remedy, on_paper)
    offset = made.figures.get("level_offset")
    if offset is not None and abs(offset) >= _NEAR_LEVEL:
        text = (
            f"the pressure round the lump is {100 * offset:+.1f} % off that of the rest of the map: something else "
            "bears on the head (a rib, a second mass), or the lump is large for it; the size is less certain than the "
            "interval says"
        )
        yield finding("uneven_level", text)


def _left_out(tactile_map: TactileMap, options: SamplerSettings, made: MapDraws) -> tuple[str, ...]:
    notes, noise, calibration = [], made.figures, made.calibration
    if tactile_map.recipe.source == "scan" and noise.get("places_share") is None:
        notes.append("tracker position error and its blur")
    odds = noise["rotation_odds"]
    if odds is not None and not noise["rotated"] and not options.correlated:
        notes.append(f"rotation of the ellipse (odds {odds:.2g} to 1, used above {ROTATION_ODDS:g})")
    if options.background == "fixed":
        notes.append("a free background (fixed where normalising puts it, as printed in Eq 7)")
    if calibration is None:
        return (*notes, terms.SPREAD)
    stated = options.size_priors.another_exam or options.size_priors.between_maps
    notes += [] if stated is None or stated.sd > 0 else [terms.SPREAD]
    head = calibration.recipe.head
    notes += [] if head is None or tactile_map.head is not None else [terms.unknown_head(head)]
    return (*notes, *calibration.omissions())
