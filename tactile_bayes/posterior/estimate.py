"""Estimation of a lump's size from a tactile map, or the reason for giving none."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from tactile_bayes.declarations import replace
from tactile_bayes.errors import NO_LUMP, Abstention, BadDataError, NotConvergedError
from tactile_bayes.findings import Finding, by_weight
from tactile_bayes.inference.ensemble import convergence
from tactile_bayes.mapping.map import TactileMap
from tactile_bayes.mapping.plausibility import map_findings
from tactile_bayes.posterior.abstention import (
    FEEL_AGAIN,
    FEEL_AGAIN_ON_PAPER,
    hopeless_shape,
    no_bump,
    no_verdict,
    searched,
    undetected,
)
from tactile_bayes.posterior.detection import Detection
from tactile_bayes.posterior.draw import (
    DETECTED,
    ROTATION_ODDS,
    Diagnostics,
    ModalBump,
    NoiseFigures,
    SamplerSettings,
    check_options,
)
from tactile_bayes.posterior.lump_probability import LIKELY, weigh
from tactile_bayes.posterior.result import Estimate, prior_sensitivity
from tactile_bayes.posterior.search import Assessment, SizedDraws, best_chance, draw_until_accurate, search
from tactile_bayes.posterior.white import Candidate, check_background
from tactile_bayes.presets import CELL_PER_SIGMA
from tactile_bayes.progress import Progress
from tactile_bayes.scans import DEFAULT_HEAD, HeadShape
from tactile_bayes.size.fat import head_profile
from tactile_bayes.size.pooling import Calibration
from tactile_bayes.size.terms import SPREAD, UNLIKE_LEARNED, UNLIKE_ON_PAPER, Recipe, extrapolated, unknown_head

MOST_INVALID = 0.05
OTHER_METHOD_ON_PAPER = "have the size estimated again by the slower method"
OTHER_HEAD = (
    "learn one for this head: `tactile-bayes population --head HEAD.json -o population.csv`, then `tactile-bayes "
    "calibrate size population.csv --form eq6-residual -o size.json`, and give --size-calibration size.json"
)
"""How to make a calibration for another head."""
_IRREGULAR = Finding(
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
    check_background(tactile_map, options)
    check_options(options)
    if calibration is not None:
        differs = recipe_differences(tactile_map, calibration, options)
        if differs:
            raise BadDataError(
                f"the size calibration was learned by another recipe: {'; '.join(differs)}",
                way_out=_way_to(calibration.recipe, tactile_map),
            )
        calibration = calibration_for(tactile_map, calibration)
    estimate = _answer(tactile_map, calibration, options, rng=rng, progress=progress)
    if estimate.code in NO_LUMP and options.scene != "none" and (why := no_verdict(tactile_map)) is not None:
        estimate = _none(why, estimate.candidates)
    of_map = (*map_findings(tactile_map), *tactile_map.findings)
    return replace(estimate, findings=by_weight((*of_map, *estimate.findings)))


def _answer(
    tactile_map: TactileMap,
    calibration: Calibration | None,
    options: SamplerSettings,
    *,
    rng: np.random.Generator,
    progress: Progress | None,
) -> Estimate:
    """The lump's size, or why there is none."""
    if not tactile_map.covered.any():
        return _none(Abstention("empty", "the map has no covered cell"))
    where = searched(tactile_map, options.centre_mm)
    candidates, seen = search(tactile_map, options)
    if not candidates:
        reason = f"no lump found {where}: nothing rises above the background"
        return _none(Abstention("empty", reason, FEEL_AGAIN, FEEL_AGAIN_ON_PAPER))
    if seen is None:
        likeliest = best_chance(tactile_map, candidates, options)
        why = no_bump(tactile_map, candidates, likeliest, where=where)
        if likeliest is None:
            return _none(why, candidates)
        fit, detection = None if likeliest.candidate is None else likeliest.candidate.fit, likeliest.detection
        lump = detection.probability >= DETECTED and why.code not in NO_LUMP
        estimate = _none(why, candidates, detection, fit.modal() if lump and fit is not None else None)
        return replace(estimate, weighed=likeliest)
    # by the bump's mode where it is a lump by the evidence, else by least squares
    bump = seen.bump() if seen.detection.probability >= DETECTED else seen.fit.modal()
    weighed = weigh(tactile_map, seen.detection, bump)
    if seen.detection.probability < DETECTED or weighed.probability < LIKELY:
        estimate = _none(undetected(weighed, where=where), candidates, seen.detection)
    elif options.scene == "none":
        estimate = _none(Abstention("undetected", "no lump was assumed"), candidates, seen.detection)
    else:
        estimate = _measured(tactile_map, seen, candidates, calibration, options, rng=rng, progress=progress)
    if estimate.code == "ridge" and not estimate.reason.startswith("no lump found"):
        estimate = replace(estimate, reason=f"no lump found {where}: {estimate.reason}")
    return replace(estimate, weighed=weigh(tactile_map, estimate.detection or seen.detection, bump))


def _measured(
    tactile_map: TactileMap,
    seen: Assessment,
    candidates: tuple[Candidate, ...],
    calibration: Calibration | None,
    options: SamplerSettings,
    *,
    rng: np.random.Generator,
    progress: Progress | None,
) -> Estimate:
    """Draw a lump that is one by the evidence, and size it; or the reason why not."""
    detection, bump = seen.detection, seen.bump()
    hopeless = hopeless_shape(*seen.widths_mm(), cell_mm=tactile_map.recipe.cell_mm)
    if hopeless is not None:
        return _none(hopeless, candidates, detection, bump)
    try:
        sized = draw_until_accurate(tactile_map, seen, calibration, options, rng=rng, progress=progress)
    except NotConvergedError as error:
        if options.method == "ensemble" or not options.correlated:
            raise
        advice = "give --method ensemble, with a larger max_steps in --settings FILE.toml"
        why = Abstention("method", f"no method converged: {error}", advice, OTHER_METHOD_ON_PAPER)
        return _none(why, candidates, detection, bump)
    made, size, calibration = sized.made, sized.size, sized.calibration
    detection = made.detection
    if sized.fault is not None:
        return _none(sized.fault, candidates, detection, bump)
    diagnostics, posterior = _diagnostics(sized), made.posterior
    if sized.extrapolation_faults:
        return _none(extrapolated(list(sized.extrapolation_faults)), candidates, detection, bump, diagnostics)
    if size is not None and size.invalid > MOST_INVALID * size.d_x_mm.size:
        reason = f"no positive size in {size.invalid} of {size.d_x_mm.size} draws: outside the calibration"
        outside = Abstention(
            "extrapolated", reason, "learn a calibration whose table holds such lumps", UNLIKE_ON_PAPER
        )
        return _none(outside, candidates, detection, bump, diagnostics)
    drawn = {"sigma_x_mm": posterior.sigma_x_mm, "sigma_y_mm": posterior.sigma_y_mm}
    drawn |= {} if size is None else {"max_size_mm": size.max_size_mm}
    return Estimate(
        "estimate",
        "" if calibration is not None else "no size calibration was given: widths only",
        detection=detection,
        fit=made.fit,
        draws=made.draws,
        map_posterior=posterior,
        size=size,
        candidates=candidates,
        diagnostics=diagnostics,
        left_out=_left_out(tactile_map, options, calibration, made.figures),
        scene=seen.scene,
        sensitivity=prior_sensitivity(posterior.sigma_x_mm, posterior.sigma_y_mm, drawn, options.prior),
        bump=bump,
        findings=tuple(_findings(sized, cell_mm=tactile_map.recipe.cell_mm)),
    )


def _none(
    why: Abstention,
    candidates: tuple[Candidate, ...] = (),
    detection: Detection | None = None,
    bump: ModalBump | None = None,
    diagnostics: Diagnostics | None = None,
) -> Estimate:
    is_lump = why.code not in NO_LUMP
    return Estimate(
        "no_estimate",
        why.reason,
        detection=detection,
        bump=bump if is_lump else None,
        candidates=candidates,
        diagnostics=diagnostics,
        code=why.code,
        advice=why.advice,
        on_paper=why.on_paper,
        about_mm=why.about_mm if bump is None or is_lump else (bump.x_mm, bump.y_mm),
    )


def calibration_for(tactile_map: TactileMap, calibration: Calibration) -> Calibration:
    """The calibration at the map's depth of fat, where both have one."""
    return calibration.at_fat([head_profile(tactile_map.quality)])


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


def _way_to(recipe: Recipe, tactile_map: TactileMap) -> str:
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


_SIZES = ("max_size_mm", "min_size_mm", "d_x_mm", "d_y_mm")
_BUMP = ("amplitude", "sigma_x_mm", "sigma_y_mm")


def _diagnostics(sized: SizedDraws) -> Diagnostics:
    made, calibration = sized.made, sized.calibration
    return Diagnostics(
        cells=len(made.fit.cells),
        covered_share=made.fit.covered_share,
        fat_mm=None if calibration is None else calibration.fat_mm,
        method=made.draws.method,
        sampler=made.draws.diagnostics,
        noise=made.figures,
        convergence={
            name: convergence(getattr(source, name))
            for source, names in ((sized.size, _SIZES), (made.posterior, _BUMP))
            if source is not None and made.draws.method == "ensemble"
            for name in names
        },
    )


def _findings(sized: SizedDraws, *, cell_mm: float) -> Iterator[Finding]:
    """Findings against the size of a lump, besides those against its map."""
    posterior, calibration = sized.made.posterior, sized.calibration
    if calibration is not None:
        beyond = [] if sized.size is None else calibration.beyond_lumps(sized.size.median_mm)
        for text in (*calibration.outside(*posterior.medians), *beyond):
            yield Finding("outside_calibration", f"{UNLIKE_LEARNED}: {text}")
    if posterior.irregular:
        yield _IRREGULAR
    if cell_mm > CELL_PER_SIGMA * min(posterior.medians[1:]):
        text = f"the map's cells of {cell_mm:g} mm are coarse for so small a lump"
        remedy, on_paper = "map again with a smaller --cell-mm", "have the scan mapped again with smaller cells"
        yield Finding("coarse_cells", text, remedy, on_paper)
    offset = sized.made.figures.level_offset
    if offset is not None and abs(offset) >= _NEAR_LEVEL:
        text = (
            f"the pressure round the lump is {100 * offset:+.1f} % off that of the rest of the map: something else "
            "bears on the head (a rib, a second mass), or the lump is large for it; the size is less certain than the "
            "interval says"
        )
        yield Finding("uneven_level", text)


def _left_out(
    tactile_map: TactileMap, options: SamplerSettings, calibration: Calibration | None, noise: NoiseFigures
) -> tuple[str, ...]:
    notes = []
    if tactile_map.recipe.source == "scan" and noise.places_share is None:
        notes.append("tracker position error and its blur")
    odds = noise.rotation_odds
    if odds is not None and not noise.rotated and not options.correlated:
        notes.append(f"rotation of the ellipse (odds {odds:.2g} to 1, used above {ROTATION_ODDS:g})")
    if options.background == "fixed":
        notes.append("a free background (fixed where normalising puts it, as printed in Eq 7)")
    if calibration is None:
        return (*notes, SPREAD)
    stated = options.size_priors.another_exam or options.size_priors.between_maps
    notes += [] if stated is None or stated.sd > 0 else [SPREAD]
    head = calibration.recipe.head
    notes += [] if head is None or tactile_map.head is not None else [unknown_head(head)]
    return (*notes, *calibration.omissions())
