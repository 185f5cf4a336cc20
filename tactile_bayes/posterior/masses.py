"""All masses of a map: rises besides the measured lump, their sizes, and the mass with most evidence."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np
from scipy.special import logit

from tactile_bayes.declarations import as_dict, replace
from tactile_bayes.errors import CANNOT_SHOW, NO_LUMP, Abstention, NotConvergedError
from tactile_bayes.mapping.map import TactileMap
from tactile_bayes.posterior.bump import (
    SMOOTHING_MM,
    Detection,
    candidate_centres,
    cell_mean_gaussian,
    levelled,
    on_map,
    smoothed_excess,
    well_read_cells,
)
from tactile_bayes.posterior.correlated import LEAST_RISE
from tactile_bayes.posterior.draw import MapPosterior, ModalBump, SamplerSettings
from tactile_bayes.posterior.estimate import likeliest_lump, no_estimate, search
from tactile_bayes.posterior.result import Estimate, Mass, Rise
from tactile_bayes.posterior.verdict import BEYOND_IT, LIKELY, MORE_LINES, MORE_LINES_ON_PAPER, weigh
from tactile_bayes.posterior.white import AT_RIM, Candidate

# --- Other lumps on the map: their places and probabilities.

BESIDE_IN_WIDTHS = 2.0
"""Least distance of a rise, in the larger width of the lump: closer, the misfit of its bump looks like a rise."""
CLOSE_IN_WIDTHS, LEAST_RISE_CLOSE = 2.5, 0.1
FAR_IN_WIDTHS, LEAST_RISE_FAR = 4.0, 0.02
"""Share of the lump's amplitude that a rise needs nearer, and farther, than so many widths of the lump."""
LEAST_RISE_AT_RIM = 0.3
"""Share of the lump's amplitude for a rise at the map's rim: the ends of strokes make small ones."""
MOST_NAMED, MOST_LOOKS = 4, 3
"""Most rises listed, and places without one after which the search ends: each costs some 50 ms."""
LEAST_PROBABILITY = 0.95
LEAST_BESIDE = 0.05
"""Least probability of a rise beside a measured lump to be listed without a size, if its shape is `LIKELY` a lump's and
it has `LEAST_SHARE` of the lump's amplitude."""
WELL_READ = 0.5  #: Share of the median count above which a cell is well read.
LEAST_STANDING, STANDING_MM = 0.35, 2.5
"""Share of a rise's amplitude by which the map within this distance of its centre must exceed its level: a level that
falls towards the rim on two sides has the flanks of a bump."""


def other_rises(
    tactile_map: TactileMap, estimate: Estimate, options: SamplerSettings
) -> tuple[tuple[Rise, ...], tuple[Rise, ...]]:
    """Rises with the evidence of a lump on the map less the measured lump, highest first; and faint ones that are
    likely lumps, surest first.

    Structures of the lump's scene (a second lump, a rib) are not among them. Without a measured lump the map is only
    searched where a centre was given, for else it has been.
    """
    if estimate.bump is None and (options.centre_mm is None or not tactile_map.covered.any()):
        return (), ()
    proven_rises: list[Rise] = []
    faint: list[Rise] = []
    whole, *well_read = _maps_without_lump(tactile_map, estimate)
    for rest, to_rim in [(whole, False), *((one, at_rim) for at_rim in (False, True) for one in well_read)]:
        misses = 0
        for centre in _rise_centres(rest, estimate, to_rim=to_rim):
            if misses == MOST_LOOKS or len(proven_rises) == MOST_NAMED:
                break
            if _is_listed(*centre, proven_rises):
                continue
            rise, is_proven = _assessed_rise(centre, rest, whole, estimate, options)
            # a fit may move to another rise, or back to the measured lump
            if rise is not None and (
                _is_listed(rise.x_mm, rise.y_mm, proven_rises)
                or not _clear_of_lump(rise.x_mm, rise.y_mm, rest, estimate)
                or not _stands_out(rise, rest)
            ):
                rise = None
            if rise is not None:
                (proven_rises if is_proven else faint).append(rise)
            misses += rise is None or not is_proven
    listed = [*proven_rises]
    for rise in sorted(faint, key=lambda one: one.probability, reverse=True):
        if len(listed) < MOST_NAMED and not _is_listed(rise.x_mm, rise.y_mm, listed):
            listed.append(rise)
    return tuple(proven_rises), tuple(listed[len(proven_rises) :])


def _is_listed(x_mm: float, y_mm: float, rises: Sequence[Rise]) -> bool:
    """True for a place at one of the rises."""
    return any(np.hypot(x_mm - rise.x_mm, y_mm - rise.y_mm) < 2 * SMOOTHING_MM for rise in rises)


def _assessed_rise(
    centre_mm: tuple[float, float], rest: TactileMap, whole: TactileMap, estimate: Estimate, options: SamplerSettings
) -> tuple[Rise | None, bool]:
    """Rise at a place with the evidence of a lump, and True; or a likely lump, or None, and False."""
    at_place = replace(options, centre_mm=centre_mm, start_width_mm=None, scene="auto")
    candidates, assessment = search(rest, at_place)
    if assessment is None:
        return _rise_at_rim(rest, whole, candidates, at_place, estimate)
    detection, lump = assessment.detection, estimate.measured
    proven = detection.probability >= LEAST_PROBABILITY
    if detection.probability < LEAST_BESIDE:
        return None, False
    bump = assessment.bump()
    likely = lump is not None and bump.amplitude >= LEAST_SHARE * lump.amplitude
    if not proven and not (likely and weigh(rest, detection, bump).chance >= LIKELY):
        return None, False
    return _rise(bump, detection.probability, lump), proven


def _maps_without_lump(tactile_map: TactileMap, estimate: Estimate) -> Iterator[TactileMap]:
    """The map less the measured lump, and its well-read part: errors of a rim with few frames hide rises."""
    if estimate.map_posterior is None:
        yield tactile_map
        return
    rest = without_lump(tactile_map, estimate.map_posterior)
    yield rest
    well_read = well_read_cells(rest, WELL_READ)
    if well_read.sum() < rest.covered.sum():
        yield replace(rest, count=np.where(well_read, rest.count, 0))


def without_lump(tactile_map: TactileMap, posterior: MapPosterior) -> TactileMap:
    """The map less the bump at the posterior medians."""
    lump, angle = posterior.middle, float(np.median(posterior.angle_rad))
    rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    covariance = rotation @ np.diag([lump.sigma_x_mm**2, lump.sigma_y_mm**2]) @ rotation.T
    u, v = np.meshgrid(tactile_map.x_mm - lump.x_mm, tactile_map.y_mm - lump.y_mm)
    bump = cell_mean_gaussian(u.ravel(), v.ravel(), covariance_mm2=covariance, cell_mm=tactile_map.recipe.cell_mm)
    return replace(tactile_map, mean=tactile_map.mean - lump.amplitude * bump.reshape(u.shape))


def _distance_mm(one: ModalBump | Mass, other: ModalBump | Mass) -> float:
    return float(np.hypot(one.x_mm - other.x_mm, one.y_mm - other.y_mm))


def _rise(bump: ModalBump, probability: float, lump: ModalBump | Mass | None = None) -> Rise:
    """A bump as a rise beside a lump, or beside none."""
    distance_mm = None if lump is None else _distance_mm(bump, lump)
    return Rise(**as_dict(bump) | {"distance_mm": distance_mm, "probability": probability})


def _rise_centres(rest: TactileMap, estimate: Estimate, *, to_rim: bool) -> Iterator[tuple[float, float]]:
    """Centres of rises clear of the lump and above a share of its amplitude, highest first: inside, or at the rim."""
    search_map, lump = levelled(rest), estimate.lump
    height = smoothed_excess(search_map)
    inside = candidate_centres(search_map, rim_limit=0)
    centres = [one for one in candidate_centres(search_map) if one not in inside] if to_rim else inside
    for x, y in centres:
        row, column = (int(np.argmin(np.abs(axis - centre))) for axis, centre in ((rest.y_mm, y), (rest.x_mm, x)))
        least_height = 0.0
        if lump is not None:  # a lower rise may be the misfit of the subtracted lump, which is smaller farther away
            distance_in_widths = np.hypot(x - lump.x_mm, y - lump.y_mm) / max(lump.sigma_x_mm, lump.sigma_y_mm)
            share = LEAST_RISE_CLOSE if distance_in_widths < CLOSE_IN_WIDTHS else LEAST_RISE
            share = LEAST_RISE_FAR if distance_in_widths > FAR_IN_WIDTHS else share
            least_height = (LEAST_RISE_AT_RIM if to_rim else share) * lump.amplitude
        if height[row, column] > least_height and _clear_of_lump(x, y, rest, estimate):
            yield x, y


def _clear_of_lump(x: float, y: float, rest: TactileMap, estimate: Estimate) -> bool:
    """True for a place clear of the lump, and of the second lump of its scene if that lies on the map.

    A second lump off the map stands for a rise at the rim, which is assessed as elsewhere.
    """
    lumps, second = [] if estimate.lump is None else [estimate.lump], _second_lump(estimate)
    if second is not None and on_map(rest, second.x_mm, second.y_mm):
        lumps.append(second)
    return all(
        np.hypot(x - lump.x_mm, y - lump.y_mm) > BESIDE_IN_WIDTHS * max(lump.sigma_x_mm, lump.sigma_y_mm)
        for lump in lumps
    )


def _second_lump(estimate: Estimate) -> ModalBump | None:
    """The second lump of the lump's scene."""
    if estimate.scene is None or estimate.scene.fit.scene.extra != "second lump":
        return None
    x, y, log_width = (float(value) for value in estimate.scene.fit.mode[-3:])
    width = float(np.exp(log_width))
    return ModalBump(0.0, x, y, width, width)


def _rise_at_rim(
    rest: TactileMap, whole: TactileMap, candidates: tuple[Candidate, ...], options: SamplerSettings, estimate: Estimate
) -> tuple[Rise | None, bool]:
    """Rise at the rim with the evidence of a lump, too little covered to measure, and True where it is likely one."""
    if candidates[0].fit is None or not candidates[0].fault.startswith(AT_RIM):
        return None, False
    bump, lump = candidates[0].fit.modal(), estimate.lump
    if bump.amplitude <= (0.0 if lump is None else LEAST_RISE_AT_RIM * lump.amplitude):
        return None, False
    chance = likeliest_lump(rest, candidates, options)
    if chance is None or chance.detection.probability < LEAST_PROBABILITY:
        return None, False
    proven = chance.probability >= LIKELY
    # at the edge of the well-read part, the whole map may cover more of the rise
    if not proven and (rest is whole or weigh(whole, chance.detection, bump).probability < LIKELY):
        return None, False
    return _rise(bump, chance.detection.probability), proven


def _stands_out(rise: Rise, rest: TactileMap) -> bool:
    """True where the map, or the levelled map, is higher at a rise's centre than elsewhere, or has no cells there."""
    y, x = np.meshgrid(rest.y_mm, rest.x_mm, indexing="ij")
    near = rest.covered & (np.hypot(x - rise.x_mm, y - rise.y_mm) < STANDING_MM)
    if not near.any():
        return True
    levels = (one.mean[near].mean() - np.median(one.mean[rest.covered]) for one in (rest, levelled(rest)))
    return bool(max(levels) >= LEAST_STANDING * rise.amplitude)


# --- All masses of a map: each with its place, its probability and its size, or the reason for none.
#
# The lump of the search is estimated first. Each other rise, and a second lump in the first one's window, is then
# estimated as if its centre had been given, with the other lump in its scene where that lies in the window. Where this
# shows no lump, the map less the first lump decides.

LUMP_PROPERTIES = ("seat", "depth_mm", "stiffness_ratio")  #: Known properties of one lump, not of the whole body.
LEAST_SHARE = 0.15
"""Least share of the first lump's amplitude for a size from the map less that lump, whose misfit is some per cent of
it: of two lower lumps beside one 13 times as high, one was sized twice too large."""
APART_IN_WIDTHS = 2.0  #: Two equal Gaussians nearer than this many widths have one maximum.
DOUBTFUL_SHARE = 0.3  #: A mass below this share of the highest mass's amplitude comes after the others.
LINES_OVER_BOTH = "scan again with more lines over both"
Estimator = Callable[[TactileMap, SamplerSettings], Estimate]


def with_masses(tactile_map: TactileMap, first: Estimate, options: SamplerSettings, estimator: Estimator) -> Estimate:
    """Find and size all masses of a map; returns the estimate of the surest (`by_evidence`), with all in `masses`.

    The estimate at a given centre stays the answer, and so does that of the first lump where properties of a lump are
    known, which are its own. `first` is the result of `estimator` for the map: `estimate_map` with a calibration and
    random numbers.
    """
    sized = [] if first.lump is None else [_mass_of_estimate(first, first.lump)]
    # known properties of a lump are those of the first, as is a checkpoint
    body = {name: value for name, value in options.size_priors.known.items() if name not in LUMP_PROPERTIES}
    elsewhere = replace(options, scene="auto", store=None, size_priors=replace(options.size_priors, known=body))
    proven, faint = other_rises(tactile_map, first, options)
    for rise in [*_second_lump_of_scene(tactile_map, first), *proven]:
        mass = _mass_at_rise(tactile_map, rise, first, elsewhere, estimator)
        if mass is None and rise not in proven:
            reason = "the map shows it beside the first lump only, not by itself"
            mass = _mass_without_size(rise, "unresolved", reason, LINES_OVER_BOTH)
        if mass is not None and all(_are_distinct(mass, other) for other in sized):
            sized.append(mass)
    reason = "the map shows too little of it for a size"
    unsized = [_mass_without_size(rise, "prior", reason, MORE_LINES, MORE_LINES_ON_PAPER) for rise in faint]
    unsized = [mass for mass in unsized if all(_are_distinct(mass, other) for other in sized)]
    ordered = by_evidence([*sized, *unsized])
    keeps_first = options.centre_mm is not None or bool(set(LUMP_PROPERTIES) & set(options.size_priors.known))
    reported = first if keeps_first or not ordered else ordered[0].estimate
    masses = tuple(
        replace(one, reported=one.estimate is reported, probability=_calibrated_probability(tactile_map, one))
        for one in ordered
    )
    lump = next((one for one in masses if one.reported and one.estimate.status == "estimate"), None)
    others = [one for one in masses if not one.reported]
    rises = [_rise(replace(one.bump, x_mm=one.x_mm, y_mm=one.y_mm), one.probability, lump) for one in others]
    return replace(reported, candidates=first.candidates, masses=masses, other_rises=tuple(rises))


def by_evidence(masses: Sequence[Mass]) -> list[Mass]:
    """Masses in the order of their numbers: the first is reported where no centre was given.

    First those above `DOUBTFUL_SHARE`, then those with a size, those within the calibration, by evidence and by
    height. Size does not count: a wide shoulder of the level is sized larger than the lump beside it.
    """
    measured = [mass for mass in masses if mass.largest_mm is not None or mass.estimate.code == "extrapolated"]
    highest = max((mass.bump.amplitude for mass in measured), default=0.0)

    def rank(mass: Mass) -> tuple[bool, bool, bool, float, float]:
        estimate, height = mass.estimate, mass.bump.amplitude
        within_calibration = all(mass.kind != "outside_calibration" for mass in estimate.findings)
        evidence = -np.inf if estimate.detection is None else estimate.detection.log_bayes_factor
        return height >= DOUBTFUL_SHARE * highest, mass.largest_mm is not None, within_calibration, evidence, height

    return sorted(masses, key=rank, reverse=True)


def _are_distinct(one: Mass, other: Mass) -> bool:
    """True if two estimates are of two masses, not one; narrow bumps may stand close to each other."""
    widest = max(max(mass.bump.sigma_x_mm, mass.bump.sigma_y_mm) for mass in (one, other))
    return _distance_mm(one, other) > min(2 * SMOOTHING_MM, APART_IN_WIDTHS * widest)


def _mass_of_estimate(estimate: Estimate, lump: ModalBump, probability: float = 0.0) -> Mass:
    """Mass of an estimate at its lump, with the larger of `probability` and that of its odds."""
    by_odds = 0.0 if estimate.detection is None else estimate.detection.probability
    return Mass(lump.x_mm, lump.y_mm, max(probability, by_odds), estimate)


def _second_lump_of_scene(tactile_map: TactileMap, first: Estimate) -> list[Rise]:
    """Second lump in the scene of the first, where the evidence supports it and it lies on the map; else empty."""
    lump, choice = _second_lump(first), first.scene
    if choice is None or lump is None or not on_map(tactile_map, lump.x_mm, lump.y_mm):
        return []
    (asked,) = (structure for structure in choice.structures if structure.name == "second lump")
    return [_rise(lump, asked.odds / (1.0 + asked.odds))] if asked.supported else []


def _mass_at_rise(
    tactile_map: TactileMap, rise: Rise, first: Estimate, options: SamplerSettings, estimator: Estimator
) -> Mass | None:
    """Mass at a rise, from the map or the map less the first lump; None where neither shows a lump there."""
    if not on_map(tactile_map, rise.x_mm, rise.y_mm):
        return _mass_without_size(rise, "window", "its centre lies off the map", BEYOND_IT)
    at_rise = replace(options, centre_mm=(rise.x_mm, rise.y_mm), start_width_mm=None)
    estimate = _estimate_or_reason(tactile_map, at_rise, estimator)
    if first.map_posterior is not None and not _same_lump(estimate, rise, first):
        estimates: list[Estimate] = []
        for rest in _maps_without_lump(tactile_map, first):
            estimates.append(_estimate_or_reason(rest, at_rise, estimator))
            if _same_lump(estimates[-1], rise, first):
                break
        # a part of the map that hides a lump does not outvote the whole that shows one
        estimate = max(estimates, key=lambda one: (_same_lump(one, rise, first), one.code not in NO_LUMP))
        low, high = estimate.bump, first.bump
        if estimate.size is not None and low and high and low.amplitude < LEAST_SHARE * high.amplitude:
            lump = f"a lump more than {1 / LEAST_SHARE:.0f} times as high"
            estimate = _unresolved(estimate, f"it stands in the flank of {lump}, which hides its shape")
    if estimate.code in (*NO_LUMP, CANNOT_SHOW):
        return None
    if estimate.measured is not None and _same_lump(estimate, rise, first):
        return _mass_of_estimate(estimate, estimate.measured, rise.probability)
    if estimate.status == "estimate":
        estimate = _unresolved(estimate, "its fit moves to the lump beside it: the map does not tell them apart")
    return Mass(rise.x_mm, rise.y_mm, rise.probability, replace(estimate, bump=rise))


def _mass_without_size(rise: Rise, code: str, why: str, advice: str, on_paper: str = "") -> Mass:
    """Mass at a rise that is likely a lump, with the reason for no size."""
    estimate = no_estimate(Abstention(code, why, advice, on_paper or advice), bump=rise)
    return _mass_of_estimate(estimate, rise, rise.probability)


def _unresolved(estimate: Estimate, why: str) -> Estimate:
    return no_estimate(Abstention("unresolved", why, LINES_OVER_BOTH, LINES_OVER_BOTH), detection=estimate.detection)


def _estimate_or_reason(tactile_map: TactileMap, options: SamplerSettings, estimator: Estimator) -> Estimate:
    """Estimate, or the reason for none where the method does not converge: the first lump's estimate stands."""
    try:
        return estimator(tactile_map, options)
    except NotConvergedError as error:
        return no_estimate(Abstention("method", f"no method converged: {error}"))


def _same_lump(estimate: Estimate, rise: Rise, first: Estimate) -> bool:
    """True where an estimate's lump is at the rise, and not moved towards the first lump."""
    lump, other = estimate.measured, first.lump
    return lump is not None and (other is None or _distance_mm(lump, rise) < _distance_mm(other, rise) / 2.0)


def _calibrated_probability(tactile_map: TactileMap, mass: Mass) -> float:
    """Probability that a mass is a lump, from its estimate, or else from the odds and the bump of its rise."""
    if mass.estimate.probability is not None:
        return mass.estimate.probability
    odds = Detection(float(logit(min(mass.probability, 1.0 - 1e-16))))
    return weigh(tactile_map, odds, mass.bump).chance
