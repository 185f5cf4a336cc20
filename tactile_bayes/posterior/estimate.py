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
from tactile_bayes.options import BumpPrior
from tactile_bayes.posterior import verdict, white
from tactile_bayes.posterior.bump import Detection, levelled, window_cells
from tactile_bayes.posterior.correlated import CorrelatedAssessment
from tactile_bayes.posterior.draw import DETECTED, ROTATION_ODDS, ModalBump, SamplerSettings, check_options
from tactile_bayes.posterior.result import Estimate, prior_sensitivity
from tactile_bayes.posterior.white import BumpFit, Candidate, MapDraws, WhiteAssessment
from tactile_bayes.presets import CELL_PER_SIGMA, FIELD_COSINES, INTERVAL
from tactile_bayes.progress import Progress
from tactile_bayes.scans import DEFAULT_HEAD, HeadShape
from tactile_bayes.size import terms
from tactile_bayes.size.draws import BUMP, EXTREMES, SIZES
from tactile_bayes.size.pooling import MOST_INVALID, Calibration, draw_sizes

# --- Search for the lump: candidate places, highest first, each fitted and assessed under either noise model.

Assessment = WhiteAssessment | CorrelatedAssessment


def assess(tactile_map: TactileMap, fit: BumpFit, options: SamplerSettings) -> Assessment:
    """Assess whether there is a lump at a fitted place, under the noise model of the options."""
    if options.correlated:
        return CorrelatedAssessment.of(tactile_map, fit, options)
    return WhiteAssessment(tactile_map, fit, white.detect(tactile_map, fit))


MOST_WITHOUT_EVIDENCE = 3
"""Places without evidence of a lump after which the search ends: each further test may give a false lump."""


def search(tactile_map: TactileMap, options: SamplerSettings) -> tuple[tuple[Candidate, ...], Assessment | None]:
    """All candidates tried, and the assessment of the last: the highest bump with the evidence of a lump, or the first
    assessed where none has it; None where none can be a lump."""
    candidates: list[Candidate] = []
    first: tuple[Candidate, Assessment] | None = None
    n_without_evidence, settings = 0, _search_options(tactile_map, options)
    search_map = levelled(tactile_map) if options.correlated else tactile_map
    for place in white.fitted_candidates(search_map, settings):
        candidate = place
        if search_map is not tactile_map and place.fit is not None:
            candidate = replace(place, fit=_with_window_cells(tactile_map, place.fit, settings))
        candidates.append(candidate)
        if candidate.fault or candidate.fit is None:
            continue
        assessment = assess(tactile_map, candidate.fit, options)
        detection = assessment.detection
        if assessment.fault:
            candidates[-1] = replace(candidate, fault=assessment.fault, detection=detection, assessed=assessment.bump())
            continue
        if detection.probability >= DETECTED:
            return tuple(candidates), assessment
        first, n_without_evidence = first or (candidate, assessment), n_without_evidence + 1
        if n_without_evidence == MOST_WITHOUT_EVIDENCE:
            break
        ridge = f": rather {detection.ridge}" if detection.ridge else ""
        candidates[-1] = replace(candidate, fault=f"{verdict.NO_EVIDENCE}{ridge}")
    if options.correlated and (close := _search_in_small_windows(tactile_map, candidates, options)) is not None:
        return close
    if first is None:
        return tuple(candidates), None
    return (*(one for one in candidates if one.centre_mm != first[0].centre_mm), first[0]), first[1]


def _with_window_cells(tactile_map: TactileMap, fit: BumpFit, settings: SamplerSettings) -> BumpFit:
    """The fit with the cells of its whole window from the map itself, which a noise field needs."""
    return replace(fit, cells=window_cells(tactile_map, fit.centre_mm, radius_mm=settings.fit_radius_mm))


def _search_in_small_windows(
    tactile_map: TactileMap, candidates: list[Candidate], options: SamplerSettings
) -> tuple[tuple[Candidate, ...], Assessment] | None:
    """Search again, in small windows, at the highest places from which a fit moved away, as beside a rib; None without
    a lump."""
    n_without_evidence, settings, search_map = 0, _search_options(tactile_map, options), levelled(tactile_map)
    for i, candidate in enumerate(candidates):
        if candidate.fit is not None and not candidate.fault.startswith(white.OUTGROWN):
            continue
        fit, fault = white.fit_in_small_window(search_map, candidate.centre_mm, options=settings)
        if fit is None or fault:
            continue
        assessment = assess(tactile_map, _with_window_cells(tactile_map, fit, settings), options)
        candidates[i] = replace(candidate, detection=assessment.detection)
        if assessment.scene is None or assessment.fault:
            continue
        if assessment.detection.probability >= DETECTED:
            return (*candidates[:i], *candidates[i + 1 :], replace(candidate, fit=assessment.fit, fault="")), assessment
        n_without_evidence += 1
        if n_without_evidence == MOST_WITHOUT_EVIDENCE:
            break
    return None


def likeliest_lump(
    tactile_map: TactileMap, candidates: Sequence[Candidate], options: SamplerSettings
) -> verdict.WeighedRise | None:
    """The most probable lump among rises that cannot be measured; None where none can be assessed.

    Those that the search has assessed, and up to `MOST_WITHOUT_EVIDENCE` in all the highest others.
    """
    weighed: list[verdict.WeighedRise] = []
    settings = _search_options(tactile_map, options)
    for candidate in sorted(candidates, key=lambda one: one.detection is None):
        if candidate.detection is None and len(weighed) >= MOST_WITHOUT_EVIDENCE:
            break
        fit, bump, detection = candidate.fit, candidate.bump, candidate.detection
        if detection is None:
            if fit is None or candidate.fault.startswith(white.OUTGROWN):  # the bump close by
                fit, _ = white.fit_in_small_window(levelled(tactile_map), candidate.centre_mm, options=settings)
            if fit is None or min(fit.widths()[:2]) < white.LEAST_WIDTH_IN_CELLS * fit.cells.cell_mm:
                continue  # a fit to a single cell says nothing of a lump
            bump = fit.modal()
            detection = assess(tactile_map, _with_window_cells(tactile_map, fit, settings), options).detection
        if bump is not None:
            weighed.append(verdict.weigh(tactile_map, detection, bump, candidate))
    return max(weighed, key=lambda one: (one.probability, one.detection.log_bayes_factor), default=None)


def _search_options(tactile_map: TactileMap, options: SamplerSettings) -> SamplerSettings:
    """Options of the least-squares search. Under a noise field it only finds the place, for which a known level is
    better than a free one: a rib at the window's rim may lift that."""
    known = options.correlated and tactile_map.background is not None
    return replace(options, background="fixed") if known else options


# --- Posterior draws of a map and its size, refined until the size interval is as accurate as requested.

DEFAULT_ACCURACY_SD = {"importance": 0.02, "ensemble": 0.1}
"""Default accuracy of the interval ends of sizes, as the methods have it for the widths."""
MOST_REFINEMENTS, SAFETY, LEAST_ACCURACY_SD = 3, 0.8, 1e-3


class EstimationTask(Record, eq=False):
    """Map, calibration, options and random numbers of one estimate."""

    tactile_map: TactileMap
    calibration: Calibration | None
    options: SamplerSettings
    rng: np.random.Generator
    progress: Progress | None = None  #: Called with the effective draws so far and those required.


def draw_until_accurate(task: EstimationTask, assessment: Assessment) -> MapDraws:
    """Draw until the size interval is as accurate as requested.

    The method stops when the widths are accurate enough, which mostly is enough for the size. Where a method does not
    converge at a finer accuracy the last draws stand.
    """
    result = draw_with_size(task, assessment)
    for _ in range(MOST_REFINEMENTS):
        finer = _next_accuracy(result, task.options)
        if finer is None:
            break
        task = replace(task, options=replace(task.options, accuracy_sd=finer))
        try:
            result = draw_with_size(task, assessment)
        except NotConvergedError:
            break
    return result


def _next_accuracy(result: MapDraws, options: SamplerSettings) -> float | None:
    """Accuracy in SDs for the next draws; None where the size is accurate enough, or no accuracy is requested."""
    target = options.accuracy_sd or DEFAULT_ACCURACY_SD.get(result.draws.method)
    if result.size is None or target is None:
        return None
    extremes = [result.size.summarise(name, probability=INTERVAL) for name in EXTREMES]
    ratio = min(target * extreme.sd / extreme.mc_error for extreme in extremes)
    if options.accuracy_mm is not None:
        ratio = min(ratio, *(options.accuracy_mm / one.mc_error for one in extremes))
    return None if ratio >= 1.0 else max(SAFETY * ratio * target, LEAST_ACCURACY_SD)


def draw_with_size(task: EstimationTask, assessment: Assessment) -> MapDraws:
    """Draw once, and draw sizes where the bump lies within the calibration's range."""
    options, cell_mm = task.options, task.tactile_map.recipe.cell_mm
    result = assessment.draw(options, rng=task.rng, progress=task.progress)
    posterior, calibration = result.posterior, task.calibration
    fault = verdict.shape_fault(posterior.sigma_x_mm, posterior.sigma_y_mm, cell_mm=cell_mm, prior=options.prior)
    if calibration is None:
        return replace(result, fault=fault)
    calibration = calibration.at_depth_or_fallback(*posterior.medians)
    if fault is None and (reasons := calibration.outside(*posterior.medians, far=True)):
        fault = terms.extrapolated(reasons)
    result = replace(result, calibration=calibration, fault=fault)
    if fault is not None:
        return result
    size = draw_sizes(posterior, calibration=calibration, priors=options.size_priors, rng=task.rng)
    return replace(result, size=size)


# --- The answer for one map: a size, widths, or the reason for neither.

LONGER = "give --method ensemble, with a larger max_steps in --settings FILE.toml"
OTHER_METHOD_ON_PAPER = "have the size estimated again by the slower method"
#: How to make a calibration for another head.
OTHER_HEAD = (
    "learn one for this head: `tactile-bayes population --head HEAD.json -o population.csv`, then `tactile-bayes "
    "calibrate size population.csv --form eq6-residual -o size.json`, and give --size-calibration size.json"
)
_IRREGULAR = finding(
    "irregular",
    "irregular outline, unlike a ball's or an ellipsoid's: two lumps that touch, or an upright, tilted or rough one "
    "look so, and the interval is wider",
)
_MOST_KNOWN_SDS = 5.0
"""What is known moves a size by up to 3.2 SDs, by the true properties of 1,946 bodies; a depth in cm by 20 and more."""
_NEAR_LEVEL = 0.02  #: Offset of the background, as a share, from which it is reported.


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
        differences = recipe_differences(tactile_map, calibration, options)
        if differences:
            raise BadDataError(
                f"the size calibration was learned by another recipe: {'; '.join(differences)}",
                way_out=_remedy_for_recipe(calibration.recipe, tactile_map),
            )
        calibration = calibration_for(tactile_map, calibration)
    estimate = _estimate_of_map(EstimationTask(tactile_map, calibration, options, rng, progress))
    if estimate.code in NO_LUMP and options.scene != "none":
        reason = verdict.no_verdict(tactile_map) or verdict.hiding_settings(options)
        reason = reason or verdict.cut_by_rim(tactile_map, estimate.candidates)
        estimate = estimate if reason is None else no_estimate(reason, estimate.candidates)
    of_map = (*map_findings(tactile_map), *tactile_map.findings)
    return replace(estimate, findings=by_severity((*of_map, *estimate.findings)))


def _estimate_of_map(task: EstimationTask) -> Estimate:
    """Estimate of the lump's size, or the reason why there is none."""
    tactile_map, options = task.tactile_map, task.options
    if not tactile_map.covered.any():
        return no_estimate(Abstention("empty", "the map has no covered cell"))
    where = verdict.searched_area(tactile_map, options.centre_mm)
    candidates, assessment = search(tactile_map, options)
    if not candidates:
        reason = f"no lump found {where}: nothing rises above the background"
        return no_estimate(Abstention("empty", reason, verdict.FEEL_AGAIN, verdict.FEEL_AGAIN_ON_PAPER))
    if assessment is None:
        likeliest = likeliest_lump(tactile_map, candidates, options)
        why = verdict.no_bump_reason(tactile_map, candidates, likeliest, where=where)
        if likeliest is None:
            return no_estimate(why, candidates)
        fit, detection = None if likeliest.candidate is None else likeliest.candidate.fit, likeliest.detection
        lump = detection.probability >= DETECTED and why.code not in NO_LUMP
        estimate = no_estimate(why, candidates, detection, fit.modal() if lump and fit is not None else None)
        return replace(estimate, weighed=likeliest)
    # the bump at the mode where the evidence is for a lump, else that of least squares
    bump = assessment.bump() if assessment.detection.probability >= DETECTED else assessment.fit.modal()
    weighed = verdict.weigh(tactile_map, assessment.detection, bump)
    if assessment.detection.probability < DETECTED or weighed.probability < verdict.LIKELY:
        estimate = no_estimate(verdict.undetected_reason(weighed, where=where), candidates, assessment.detection)
    elif options.scene == "none":
        estimate = no_estimate(Abstention("undetected", "no lump was assumed"), candidates, assessment.detection)
    else:
        estimate = _estimate_of_lump(task, assessment, candidates)
        if estimate.code == "ridge":
            estimate = replace(estimate, reason=f"no lump found {where}: {estimate.reason}")
    return replace(estimate, weighed=verdict.weigh(tactile_map, estimate.detection or assessment.detection, bump))


def _estimate_of_lump(task: EstimationTask, assessment: Assessment, candidates: tuple[Candidate, ...]) -> Estimate:
    """Estimate with draws and size of a lump with the evidence for one, or the reason for no size."""
    options, cell_mm = task.options, task.tactile_map.recipe.cell_mm
    detection, bump = assessment.detection, assessment.bump()
    hopeless = verdict.width_fault(bump.sigma_x_mm, bump.sigma_y_mm, cell_mm=cell_mm, margin=verdict.HOPELESS)
    if hopeless is not None:
        return no_estimate(hopeless, candidates, detection, bump)
    try:
        result = draw_until_accurate(task, assessment)
    except NotConvergedError as error:
        why = Abstention("method", f"no method converged: {error}", LONGER, OTHER_METHOD_ON_PAPER)
        if error.advice:
            why = Abstention("method", str(error), error.advice, "have the size estimated again without this neighbour")
        elif options.method == "ensemble" or not options.correlated:
            raise
        return no_estimate(why, candidates, detection, bump)
    detection, posterior, size, fault = result.detection, result.posterior, result.size, result.fault
    diagnostics = _diagnostics(result)
    if size is not None and size.invalid > MOST_INVALID * size.d_x_mm.size:
        reason = f"no positive size in {size.invalid} of {size.d_x_mm.size} draws: outside the calibration"
        advice = "learn a calibration whose table holds such lumps"
        fault = Abstention("extrapolated", reason, advice, terms.UNLIKE_ON_PAPER)
    if fault is not None:
        return no_estimate(fault, candidates, detection, bump, diagnostics if fault.code == "extrapolated" else {})
    quantities = {"sigma_x_mm": posterior.sigma_x_mm, "sigma_y_mm": posterior.sigma_y_mm}
    quantities |= {} if size is None else {"max_size_mm": size.max_size_mm}
    return Estimate(
        "estimate",
        "" if result.calibration is not None else "no size calibration was given: widths only",
        detection=detection,
        fit=result.fit,
        draws=result.draws,
        map_posterior=posterior,
        size=size,
        candidates=candidates,
        diagnostics=diagnostics,
        left_out=_omissions(task.tactile_map, options, result),
        scene=assessment.scene,
        sensitivity=prior_sensitivity(posterior.sigma_x_mm, posterior.sigma_y_mm, quantities, options.prior),
        bump=bump,
        findings=(*_findings(result, cell_mm=cell_mm), *_prior_findings(result, options)),
    )


def no_estimate(
    reason: Abstention,
    candidates: tuple[Candidate, ...] = (),
    detection: Detection | None = None,
    bump: ModalBump | None = None,
    diagnostics: Mapping[str, Any] = MappingProxyType({}),
) -> Estimate:
    """Answer without an estimate; the centre of a bump that is no lump becomes `about_mm`."""
    answer = asdict(reason)
    if reason.code in NO_LUMP and bump is not None:
        answer["about_mm"], bump = (bump.x_mm, bump.y_mm), None
    answer |= {"detection": detection, "bump": bump, "candidates": candidates, "diagnostics": diagnostics}
    return Estimate("no_estimate", **answer)


def calibration_for(tactile_map: TactileMap, calibration: Calibration) -> Calibration:
    """The calibration at the map's depth of fat, where both have one."""
    return calibration.at_fat([terms.head_profile(tactile_map.quality)])


def recipe_differences(tactile_map: TactileMap, calibration: Calibration, options: SamplerSettings) -> list[str]:
    """Differences of a map and its fit options from the calibration's recipe, in words; empty without any."""
    ours, made = calibration.recipe, tactile_map.recipe
    theirs = replace(
        ours,
        normalise=made.normalise,
        background=options.background,
        radius_mm=options.fit_radius_mm,
        noise=options.noise,
        flat_field=made.flat_field_known,
        head=tactile_map.head,
    )
    return ours.differences(theirs)


def way_to_head(head: HeadShape | None) -> str:
    """Command that gives a calibration for a map's head."""
    shipped = head is not None and not DEFAULT_HEAD.differences(head)
    return f"give --size-calibration solid or eq6, which are for this head; or {OTHER_HEAD}" if shipped else OTHER_HEAD


def _remedy_for_recipe(recipe: terms.Recipe, tactile_map: TactileMap) -> str:
    """Command that makes a map fit a calibration: its map command where the map differs, else the fit's options."""
    if recipe.head_differences(tactile_map.head):
        return way_to_head(tactile_map.head)
    map_recipe = (tactile_map.recipe.normalise, tactile_map.recipe.flat_field_known)
    required = (recipe.normalise, map_recipe[1] if recipe.flat_field is None else recipe.flat_field)
    if map_recipe[0] != required[0] or (map_recipe[1] is not None and map_recipe[1] != required[1]):
        again = f"make the map again with {recipe.map_command}"
        return f"{again}, or give --size-calibration solid or eq6 for a default map"
    return "leave the fit's options to the calibration, or learn a calibration for these"


def _diagnostics(result: MapDraws) -> dict[str, Any]:
    """Figures of fit, noise and method; of chains also the convergence of each quantity."""
    figures = {
        "cells": len(result.fit.cells),
        "covered_share": result.fit.covered_share,
        "fat_mm": None if result.calibration is None else result.calibration.fat_mm,
        **result.draws.diagnostics,
        **result.figures,
        "method": result.draws.method,
    }
    if result.draws.method != "ensemble":
        return figures
    quantities = {name: getattr(result.posterior, name) for name in BUMP[:3]}
    quantities = {name: getattr(result.size, name) for name in SIZES if result.size is not None} | quantities
    return figures | {"convergence": {name: convergence(values) for name, values in quantities.items()}}


def _findings(result: MapDraws, *, cell_mm: float) -> Iterator[Finding]:
    """Cautions and checks on the size of a lump, besides those on its map."""
    posterior, calibration = result.posterior, result.calibration
    if calibration is not None:
        outside = calibration.outside(*posterior.medians)
        outside += [] if result.size is None else calibration.beyond_lumps(result.size)
        if outside:
            yield finding("outside_calibration", f"{terms.UNLIKE_LEARNED}: {' and '.join(outside)}")
        if (cosines := result.figures.get("field_cosines", FIELD_COSINES)) < FIELD_COSINES:
            text = f"the errors of the map were resolved by {cosines} basis functions along each axis, and sizes were "
            text += f"learned with {FIELD_COSINES} or more"
            remedy, on_paper = "leave field_cosines out of the settings", "have the size estimated anew without that"
            yield finding("own_settings", text, remedy, on_paper)
    if result.size is not None and result.size.known_sds > _MOST_KNOWN_SDS:
        text = f"what was stated of the body moves the size by {result.size.known_sds:.0f} times its error: the map "
        text += "contradicts it"
        remedy = "check the values of --known and their units: mm, and E2/E1 for stiffness_ratio"
        yield finding("own_settings", text, remedy, "have the statement checked, and its unit")
    if posterior.irregular:
        yield _IRREGULAR
    if cell_mm > CELL_PER_SIGMA * min(posterior.medians[1:]):
        text = f"the map's cells of {cell_mm:g} mm are coarse for so small a lump"
        remedy, on_paper = "map again with a smaller --cell-mm", "have the scan mapped again with smaller cells"
        yield finding("coarse_cells", text, remedy, on_paper)
    offset = result.figures.get("level_offset")
    if offset is not None and abs(offset) >= _NEAR_LEVEL:
        text = (
            f"the pressure round the lump is {100 * offset:+.1f} % off that of the rest of the map: something else "
            "bears on the head (a rib, a second mass), or the lump is large for it; the size is less certain than the "
            "interval says"
        )
        yield finding("uneven_level", text)


def _prior_findings(result: MapDraws, prior: BumpPrior) -> Iterator[Finding]:
    """Cautions where priors of one's own set the bump as much as the map does.

    They do where the posterior keeps half of the prior's SD, or lies half of its own SD from where it would without it;
    least squares use none.
    """
    bump, own = result.posterior, verdict.own_priors(prior)
    if not own or result.draws.method == "optimise":
        return
    amplitude = bump.amplitude / result.fit.bump.scale
    width = 0.5 * np.log(bump.sigma_x_mm * bump.sigma_y_mm)
    ratio = 0.5 * np.log(bump.sigma_x_mm / bump.sigma_y_mm)
    for names, draws, mean, sd in (
        (("amplitude_sd",), amplitude, 0.0, prior.amplitude_sd),
        (("width_median_mm", "log_width_sd"), width, np.log(prior.width_median_mm), prior.log_width_sd),
        (("log_ratio_sd",), ratio, 0.0, prior.log_ratio_sd),
    ):
        named, kept = [name for name in names if name in own], float(draws.std()) / sd
        if named and max(kept, kept * abs(float(draws.mean()) - mean) / sd) > verdict.MOST_PRIOR_SHARE:
            given = ", ".join(f"{name} = {getattr(prior, name):g}" for name in named)
            text = "the size follows the priors it was estimated with as much as the map"
            remedy = f"{given}: leave {' and '.join(named)} out of the settings"
            yield finding("own_settings", text, remedy, "have it estimated anew without them")


def _omissions(tactile_map: TactileMap, options: SamplerSettings, result: MapDraws) -> tuple[str, ...]:
    """Sources of error that the estimate does not contain, in words."""
    notes, noise, calibration = [], result.figures, result.calibration
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
