"""The masses of a map: other rises, which one is surest."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np
from scipy.special import logit

from tactile_bayes.declarations import as_dict, replace
from tactile_bayes.errors import CANNOT_SHOW, NO_LUMP, NotConvergedError
from tactile_bayes.mapping.map import TactileMap
from tactile_bayes.posterior.bump import (
    SMOOTHING_MM,
    Detection,
    candidate_centres,
    cell_mean_gaussian,
    levelled,
    on_map,
    read_well,
    smoothed_excess,
)
from tactile_bayes.posterior.correlated import LEAST_RISE
from tactile_bayes.posterior.draw import MapPosterior, ModalBump, SamplerSettings
from tactile_bayes.posterior.estimate import best_chance, search
from tactile_bayes.posterior.result import Estimate, Mass, Rise
from tactile_bayes.posterior.verdict import BEYOND_IT, LIKELY, MORE_LINES, MORE_LINES_ON_PAPER, weigh
from tactile_bayes.posterior.white import AT_RIM, Candidate

# --- Other lumps on the map: their places and probabilities.

BESIDE_IN_WIDTHS = 2.0
"""Nearer to the lump than this many of its larger width, what a lump that is no Gaussian leaves looks like a rise."""
CLOSE_IN_WIDTHS, LEAST_RISE_CLOSE = 2.5, 0.1
FAR_IN_WIDTHS, LEAST_RISE_FAR = 4.0, 0.02
"""Nearer or farther than so many widths a rise needs this share of the lump's amplitude."""
LEAST_RISE_AT_RIM = 0.3
"""Share of the lump's amplitude, for a rise that the map covers too poorly: the ends of strokes make small ones."""
MOST_NAMED, MOST_LOOKS = 4, 3
"""Rises that are named, and places that turn out to be none before the search ends: each look costs some 50 ms."""
LEAST_PROBABILITY = 0.95
LEAST_BESIDE = 0.05
"""From this probability on a rise beside a measured lump is listed without a size, if its shape is `LIKELY` a lump's
and it has `LEAST_SHARE` of the lump's amplitude."""
WELL_READ = 0.5  #: Share of the median count from which on a cell is read well.
LEAST_STANDING, STANDING_MM = 0.35, 2.5
"""Share of a rise's amplitude by which the map at its centre, so far about it, must stand above its level: a level that
falls towards the rim on two sides is like a bump's flanks, and no lump."""


def other_rises(
    tactile_map: TactileMap, estimate: Estimate, options: SamplerSettings
) -> tuple[tuple[Rise, ...], tuple[Rise, ...]]:
    """Find rises that are lumps by the evidence once the measured lump is subtracted, and likely ones hardly shown.

    The highest come first, of those hardly shown the surest. A structure that the lump's own scene holds (a second
    lump, a rib) is named there. Where there is no lump the whole map has been searched, unless a place was given: then
    the rest of the map is searched here.
    """
    if estimate.bump is None and options.centre_mm is None:
        return (), ()
    shown: list[Rise] = []
    hardly: list[Rise] = []
    whole, *well_read = _rests(tactile_map, estimate)
    for rest, to_rim in [(whole, False), *((one, far) for far in (False, True) for one in well_read)]:
        misses = 0
        for centre in _places(rest, estimate, to_rim=to_rim):
            if misses == MOST_LOOKS or len(shown) == MOST_NAMED:
                break
            if _named(*centre, shown):
                continue
            rise, proven = _rise_at(centre, rest, whole, estimate, options)
            # a fit may move to another rise, or back to the measured lump
            if rise is not None and (
                _named(rise.x_mm, rise.y_mm, shown)
                or not _clear_of_lump(rise.x_mm, rise.y_mm, rest, estimate)
                or not _stands_out(rise, rest)
            ):
                rise = None
            if rise is not None:
                (shown if proven else hardly).append(rise)
            misses += rise is None or not proven
    named = [*shown]
    for rise in sorted(hardly, key=lambda one: one.probability, reverse=True):
        if len(named) < MOST_NAMED and not _named(rise.x_mm, rise.y_mm, named):
            named.append(rise)
    return tuple(shown), tuple(named[len(shown) :])


def _named(x_mm: float, y_mm: float, rises: Sequence[Rise]) -> bool:
    """True for a place that is one of the rises'."""
    return any(np.hypot(x_mm - one.x_mm, y_mm - one.y_mm) < 2 * SMOOTHING_MM for one in rises)


def _rise_at(
    centre_mm: tuple[float, float], rest: TactileMap, whole: TactileMap, estimate: Estimate, options: SamplerSettings
) -> tuple[Rise | None, bool]:
    """A rise of a place that is a lump by the evidence, or is likely one; and whether it is one by the evidence."""
    given = replace(options, centre_mm=centre_mm, start_width_mm=None, scene="auto")
    candidates, seen = search(rest, given)
    if seen is None:
        return _at_rim(rest, whole, candidates, given, estimate)
    detection, lump = seen.detection, estimate.measured
    proven = detection.probability >= LEAST_PROBABILITY
    if not proven and (lump is None or detection.probability < LEAST_BESIDE):
        return None, False
    bump = seen.bump()
    likely = lump is not None and bump.amplitude >= LEAST_SHARE * lump.amplitude
    if not proven and not (likely and weigh(rest, detection, bump).chance >= LIKELY):
        return None, False
    return _rise(bump, detection.probability, lump), proven


def _rests(tactile_map: TactileMap, estimate: Estimate) -> Iterator[TactileMap]:
    """The map less the measured lump, and its part that was read well: errors of a rim that few frames reach hide
    rises."""
    if estimate.map_posterior is None:
        yield tactile_map
        return
    rest = without(tactile_map, estimate.map_posterior)
    yield rest
    well = read_well(rest, WELL_READ)
    if well.sum() < rest.covered.sum():
        yield replace(rest, count=np.where(well, rest.count, 0))


def without(tactile_map: TactileMap, posterior: MapPosterior) -> TactileMap:
    """The map less the bump at the posterior medians."""
    lump, angle = posterior.middle, float(np.median(posterior.angle_rad))
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    covariance = turn @ np.diag([lump.sigma_x_mm**2, lump.sigma_y_mm**2]) @ turn.T
    u, v = np.meshgrid(tactile_map.x_mm - lump.x_mm, tactile_map.y_mm - lump.y_mm)
    bump = cell_mean_gaussian(u.ravel(), v.ravel(), covariance_mm2=covariance, cell_mm=tactile_map.recipe.cell_mm)
    return replace(tactile_map, mean=tactile_map.mean - lump.amplitude * bump.reshape(u.shape))


def _apart_mm(one: ModalBump | Mass, other: ModalBump | Mass) -> float:
    return float(np.hypot(one.x_mm - other.x_mm, one.y_mm - other.y_mm))


def _rise(bump: ModalBump, probability: float, lump: ModalBump | Mass | None = None) -> Rise:
    """A bump as a rise beside a lump, or beside none."""
    away = None if lump is None else _apart_mm(bump, lump)
    return Rise(**as_dict(bump) | {"distance_mm": away, "probability": probability})


def _places(rest: TactileMap, estimate: Estimate, *, to_rim: bool) -> Iterator[tuple[float, float]]:
    """Local maxima clear of the lump, above a share of its amplitude, highest first: inside the map, or at its rim."""
    found_on, lump = levelled(rest), estimate.lump
    height = smoothed_excess(found_on)
    inside = candidate_centres(found_on, rim_limit=0)
    centres = [one for one in candidate_centres(found_on) if one not in inside] if to_rim else inside
    for x, y in centres:
        row, column = (int(np.argmin(np.abs(axis - at))) for axis, at in ((rest.y_mm, y), (rest.x_mm, x)))
        least = 0.0
        if lump is not None:  # a lower rise may be what the subtracted lump left of itself, less of it farther away
            away = np.hypot(x - lump.x_mm, y - lump.y_mm) / max(lump.sigma_x_mm, lump.sigma_y_mm)
            share = LEAST_RISE_CLOSE if away < CLOSE_IN_WIDTHS else LEAST_RISE
            share = LEAST_RISE_FAR if away > FAR_IN_WIDTHS else share
            least = (LEAST_RISE_AT_RIM if to_rim else share) * lump.amplitude
        if height[row, column] > least and _clear_of_lump(x, y, rest, estimate):
            yield x, y


def _clear_of_lump(x: float, y: float, rest: TactileMap, estimate: Estimate) -> bool:
    """True for a place clear of the lump, and of the second lump of its scene.

    One whose centre lies off the map stands for what rises at the rim, which is looked at as elsewhere. A rise beside a
    rib is held against a ridge there.
    """
    lumps, second = [] if estimate.lump is None else [estimate.lump], _second_lump(estimate)
    if second is not None and on_map(rest, second.x_mm, second.y_mm):
        lumps.append(second)
    return all(
        np.hypot(x - one.x_mm, y - one.y_mm) > BESIDE_IN_WIDTHS * max(one.sigma_x_mm, one.sigma_y_mm) for one in lumps
    )


def _second_lump(estimate: Estimate) -> ModalBump | None:
    """The second lump of the lump's scene."""
    if estimate.scene is None or estimate.scene.fit.scene.extra != "second lump":
        return None
    x, y, log_width = (float(value) for value in estimate.scene.fit.mode[-3:])
    width = float(np.exp(log_width))
    return ModalBump(0.0, x, y, width, width)


def _at_rim(
    rest: TactileMap, whole: TactileMap, candidates: tuple[Candidate, ...], options: SamplerSettings, estimate: Estimate
) -> tuple[Rise | None, bool]:
    """A rise that is a lump by the evidence and that the map covers too poorly to measure; None where there is none."""
    if not candidates or candidates[0].fit is None or not candidates[0].fault.startswith(AT_RIM):
        return None, False
    bump, lump = candidates[0].fit.modal(), estimate.lump
    if bump.amplitude <= (0.0 if lump is None else LEAST_RISE_AT_RIM * lump.amplitude):
        return None, False
    chance = best_chance(rest, candidates, options)
    if chance is None or chance.detection.probability < LEAST_PROBABILITY:
        return None, False
    proven = chance.probability >= LIKELY
    # at the end of the well-read part the whole map shows how far the rise is covered
    if not proven and (rest is whole or weigh(whole, chance.detection, bump).probability < LIKELY):
        return None, False
    return _rise(bump, chance.detection.probability), proven


def _stands_out(rise: Rise, rest: TactileMap) -> bool:
    """True where the map, or the map with wide rises taken off, is higher at a rise's centre than elsewhere, or has no
    cells there."""
    y, x = np.meshgrid(rest.y_mm, rest.x_mm, indexing="ij")
    near = rest.covered & (np.hypot(x - rise.x_mm, y - rise.y_mm) < STANDING_MM)
    if not near.any():
        return True
    levels = (one.mean[near].mean() - np.median(one.mean[rest.covered]) for one in (rest, levelled(rest)))
    return bool(max(levels) >= LEAST_STANDING * rise.amplitude)


# --- All masses of a map: each with its place, its probability and its size, or the reason for none.
#
# The lump that a search finds is estimated first. What else rises on the map, and a second lump in that lump's
# window, is then estimated as if its place had been given: with the other lump in its scene where it lies in the
# window. Where that finds no lump there, the map less the first lump decides.

OF_A_LUMP = ("seat", "depth_mm", "stiffness_ratio")  #: Known properties that are of one lump, not of the whole body.
LEAST_SHARE = 0.15
"""Share of the first lump's amplitude, for a size from the map less that lump: of two with less, 21 mm from a lump 13
times as high, one came out twice as large as it was, and what a lump leaves of itself is some per cent of it."""
APART_IN_WIDTHS = 2.0  #: Two equal Gaussians nearer than this many widths have one maximum.
DOUBTFUL_SHARE = 0.3
"""Share of the highest mass's amplitude: a lower rise is in doubt, though the calibration may fit it alone."""
BOTH = "scan again with more lines over both"
Estimator = Callable[[TactileMap, SamplerSettings], Estimate]


def with_masses(tactile_map: TactileMap, first: Estimate, options: SamplerSettings, estimator: Estimator) -> Estimate:
    """Find and size all masses of a map; returns the estimate of the surest (`by_evidence`), with all in `masses`.

    The estimate of a place that was given is kept as the answer, and that of the first lump where properties of a lump
    are known: they are of that lump. `first` is `estimator`'s result for the map, `estimator` being `estimate_map` with
    its calibration and random numbers.
    """
    sized = [] if first.lump is None else [_mass_of(first, first.lump)]
    # what is known of a lump is of the first, and so is a checkpoint
    known = {name: value for name, value in options.size_priors.known.items() if name not in OF_A_LUMP}
    others = replace(options, scene="auto", store=None, size_priors=replace(options.size_priors, known=known))
    shown, hardly = other_rises(tactile_map, first, options)
    for rise in [*_second_lump_of_scene(tactile_map, first), *shown]:
        mass = _sized_at(tactile_map, rise, first, others, estimator)
        if mass is None and rise not in shown:
            mass = _unsized(rise, "unresolved", "the map shows it beside the first lump only, not by itself", BOTH)
        if mass is not None and all(_apart(mass, one) for one in sized):
            sized.append(mass)
    why = "the map shows too little of it for a size"
    unsized = [_unsized(rise, "prior", why, MORE_LINES, MORE_LINES_ON_PAPER) for rise in hardly]
    sized = by_evidence([*sized, *(mass for mass in unsized if all(_apart(mass, one) for one in sized))])
    kept = options.centre_mm is not None or bool(set(OF_A_LUMP) & set(options.size_priors.known))
    reported = first if kept or not sized else sized[0].estimate
    masses = tuple(
        replace(one, reported=one.estimate is reported, probability=_calibrated(tactile_map, one)) for one in sized
    )
    here = next((one for one in masses if one.reported and one.estimate.status == "estimate"), None)
    beside = [
        _rise(replace(one.bump, x_mm=one.x_mm, y_mm=one.y_mm), one.probability, here)
        for one in masses
        if not one.reported
    ]
    return replace(reported, candidates=first.candidates, masses=masses, other_rises=tuple(beside))


def by_evidence(masses: Sequence[Mass]) -> list[Mass]:
    """Masses in the order in which they are numbered: the first is reported where no place was given.

    First come those that stand out (`DOUBTFUL_SHARE`), then those with a size, those that the calibration holds, those
    with more evidence of a lump, and the higher ones. Size has no part in it: a wide shoulder of the level is sized
    larger than the lump beside it.
    """
    measured = [one for one in masses if one.largest_mm is not None or one.estimate.code == "extrapolated"]
    highest = max((one.bump.amplitude for one in measured), default=0.0)

    def rank(mass: Mass) -> tuple[bool, bool, bool, float, float]:
        estimate, height = mass.estimate, mass.bump.amplitude
        held = all(one.kind != "outside_calibration" for one in estimate.findings)
        evidence = -np.inf if estimate.detection is None else estimate.detection.log_bayes_factor
        return height >= DOUBTFUL_SHARE * highest, mass.largest_mm is not None, held, evidence, height

    return sorted(masses, key=rank, reverse=True)


def _apart(one: Mass, other: Mass) -> bool:
    """True for two masses, not one measured twice: two narrow bumps may stand close to each other."""
    widest = max(max(mass.bump.sigma_x_mm, mass.bump.sigma_y_mm) for mass in (one, other))
    return _apart_mm(one, other) > min(2 * SMOOTHING_MM, APART_IN_WIDTHS * widest)


def _mass_of(estimate: Estimate, lump: ModalBump, probability: float = 0.0) -> Mass:
    """The mass of an estimate, where its lump is; no less probable than was known before."""
    by_odds = 0.0 if estimate.detection is None else estimate.detection.probability
    return Mass(lump.x_mm, lump.y_mm, max(probability, by_odds), estimate)


def _second_lump_of_scene(tactile_map: TactileMap, first: Estimate) -> list[Rise]:
    """The second lump of the first one's scene, if the evidence put it there; off the map `other_rises` judges it."""
    lump, choice = _second_lump(first), first.scene
    if choice is None or lump is None or not on_map(tactile_map, lump.x_mm, lump.y_mm):
        return []
    (asked,) = (one for one in choice.structures if one.name == "second lump")
    return [_rise(lump, asked.odds / (1.0 + asked.odds))] if asked.supported else []


def _sized_at(
    tactile_map: TactileMap, rise: Rise, first: Estimate, options: SamplerSettings, estimator: Estimator
) -> Mass | None:
    """The mass at a rise, by the whole map or by the map less the first lump; None where neither shows a lump there."""
    if not on_map(tactile_map, rise.x_mm, rise.y_mm):
        return _unsized(rise, "window", "its centre lies off the map", BEYOND_IT)
    given = replace(options, centre_mm=(rise.x_mm, rise.y_mm), start_width_mm=None)
    estimate = _estimated(tactile_map, given, estimator)
    if first.map_posterior is not None and not _same_lump(estimate, rise, first):
        on_rests: list[Estimate] = []
        for rest in _rests(tactile_map, first):
            on_rests.append(_estimated(rest, given, estimator))
            if _same_lump(on_rests[-1], rise, first):
                break
        # a part of the map that hides a lump does not outvote the whole that shows one
        estimate = max(on_rests, key=lambda one: (_same_lump(one, rise, first), one.code not in NO_LUMP))
        low, high = estimate.bump, first.bump
        if estimate.size is not None and low and high and low.amplitude < LEAST_SHARE * high.amplitude:
            lump = f"a lump more than {1 / LEAST_SHARE:.0f} times as high"
            estimate = _not_told_apart(estimate, f"it stands in the flank of {lump}, which hides its shape")
    if estimate.code in (*NO_LUMP, CANNOT_SHOW):
        return None
    if estimate.measured is not None and _same_lump(estimate, rise, first):
        return _mass_of(estimate, estimate.measured, rise.probability)
    if estimate.status == "estimate":
        estimate = _not_told_apart(estimate, "its fit moves to the lump beside it: the map does not tell them apart")
    return Mass(rise.x_mm, rise.y_mm, rise.probability, replace(estimate, bump=rise))


def _unsized(rise: Rise, code: str, why: str, advice: str, on_paper: str = "") -> Mass:
    """The mass at a rise that is likely a lump, and why it has no size."""
    estimate = Estimate("no_estimate", why, code=code, advice=advice, on_paper=on_paper or advice, bump=rise)
    return _mass_of(estimate, rise, rise.probability)


def _not_told_apart(estimate: Estimate, why: str) -> Estimate:
    return Estimate("no_estimate", why, detection=estimate.detection, code="unresolved", advice=BOTH, on_paper=BOTH)


def _estimated(tactile_map: TactileMap, options: SamplerSettings, estimator: Estimator) -> Estimate:
    """An estimate; where the method asked for does not converge the reason for none, for the first lump has its own."""
    try:
        return estimator(tactile_map, options)
    except NotConvergedError as error:
        return Estimate("no_estimate", f"no method converged: {error}", code="method")


def _same_lump(estimate: Estimate, rise: Rise, first: Estimate) -> bool:
    """True where an estimate is of the lump at a rise, and did not move towards the first lump."""
    lump, other = estimate.measured, first.lump
    return lump is not None and (other is None or _apart_mm(lump, rise) < _apart_mm(other, rise) / 2.0)


def _calibrated(tactile_map: TactileMap, mass: Mass) -> float:
    """Probability that a mass is a lump, by its own estimate, or by the odds and the bump of its rise."""
    if mass.estimate.probability is not None:
        return mass.estimate.probability
    odds = Detection(float(logit(min(mass.probability, 1.0 - 1e-16))))
    return weigh(tactile_map, odds, mass.bump).chance
