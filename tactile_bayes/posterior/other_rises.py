"""Other lumps on the map: their places and probabilities."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from tactile_bayes.forward.gaussian import cell_mean_gaussian
from tactile_bayes.mapping.tactile_map import TactileMap
from tactile_bayes.posterior.assessment import Assessment, bump_of
from tactile_bayes.posterior.correlated.neighbour import LEAST_RISE
from tactile_bayes.posterior.lump.cells import SMOOTHING_MM, candidate_centres, levelled, on_map, smoothed_excess
from tactile_bayes.posterior.lump.posterior import MapPosterior
from tactile_bayes.posterior.lump_probability import LIKELY
from tactile_bayes.posterior.options import EstimateOptions
from tactile_bayes.posterior.result import Estimate, ModalBump, Rise
from tactile_bayes.posterior.search import best_chance, search
from tactile_bayes.posterior.white.fit import AT_RIM, Candidate

BESIDE_IN_WIDTHS = 2.5
"""Nearer to the lump than this many of its larger width, what a lump that is no Gaussian leaves looks like a rise."""
FAR_IN_WIDTHS, LEAST_RISE_FAR = 4.0, 0.02
"""Farther than so many widths a rise needs this share of the lump's amplitude only."""
LEAST_RISE_AT_RIM = 0.5
"""Of the lump's amplitude, for a rise that the map covers too poorly: the ends of strokes make small ones."""
MOST_NAMED, MOST_LOOKS = 4, 3
"""Rises that are named, and places that turn out to be none before the search ends: each look costs some 50 ms."""
LEAST_PROBABILITY = 0.95
LEAST_STANDING, STANDING_MM = 0.35, 2.5
"""Share of a rise's amplitude by which the map at its centre, so far about it, must stand above its level: a level that
falls towards the rim on two sides is like a bump's flanks, and no lump."""


def other_rises(tactile_map: TactileMap, estimate: Estimate, options: EstimateOptions) -> tuple[Rise, ...]:
    """Find rises that are lumps by the evidence once the measured lump is subtracted, the highest first.

    A structure that the lump's own scene holds (a second lump, a rib) is named there. Where there is no lump the whole
    map has been searched, unless a place was given: then the rest of the map is searched here.
    """
    if estimate.bump is None and options.fit.centre_mm is None:
        return ()
    rest = tactile_map if estimate.map_posterior is None else without(tactile_map, estimate.map_posterior)
    rises: list[Rise] = []
    misses = 0
    for centre in _places(rest, estimate):
        given = replace(options, fit=replace(options.fit, centre_mm=centre, start_width_mm=None), scene="auto")
        candidates, seen = search(rest, given)
        if seen is None:
            found = _at_rim(rest, candidates, given, estimate)
        else:
            found = _rise(seen, estimate) if seen.detection.probability >= LEAST_PROBABILITY else None
        if found is None or _is_known(found, rises, rest, estimate) or not _stands_out(found, rest):
            misses += 1
        else:
            rises.append(found)
        if misses == MOST_LOOKS or len(rises) == MOST_NAMED:
            break
    return tuple(rises)


def _median(posterior: MapPosterior, name: str) -> float:
    return float(np.median(getattr(posterior, name)))


def without(tactile_map: TactileMap, posterior: MapPosterior) -> TactileMap:
    """The map less the bump at the posterior medians."""
    x, y, angle = (_median(posterior, name) for name in ("x_mm", "y_mm", "angle_rad"))
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    squares = [_median(posterior, name) ** 2 for name in ("sigma_x_mm", "sigma_y_mm")]
    u, v = np.meshgrid(tactile_map.x_mm - x, tactile_map.y_mm - y)
    bump = cell_mean_gaussian(
        u.ravel(), v.ravel(), covariance_mm2=turn @ np.diag(squares) @ turn.T, cell_mm=tactile_map.recipe.cell_mm
    )
    return replace(tactile_map, mean=tactile_map.mean - _median(posterior, "amplitude") * bump.reshape(u.shape))


def _lump(estimate: Estimate) -> ModalBump | None:
    """The lump that an estimate is about: at the posterior medians where it was drawn."""
    posterior = estimate.map_posterior
    if posterior is None:
        return estimate.bump
    names = ("amplitude", "x_mm", "y_mm", "sigma_x_mm", "sigma_y_mm")
    return ModalBump(*(_median(posterior, name) for name in names))


def _places(rest: TactileMap, estimate: Estimate) -> Iterator[tuple[float, float]]:
    """Local maxima above a share of the lump's amplitude, clear of it and of the map's rim, highest first."""
    found_on = levelled(rest)
    height = smoothed_excess(found_on)
    for x, y in candidate_centres(found_on, rim_limit=0):
        row, column = (int(np.argmin(np.abs(axis - at))) for axis, at in ((rest.y_mm, y), (rest.x_mm, x)))
        if height[row, column] > _least_rise(x, y, estimate) and _beside(x, y, rest, estimate):
            yield x, y


def _least_rise(x: float, y: float, estimate: Estimate) -> float:
    """Height below which a rise may be what the subtracted lump left of itself; less of it is left farther away."""
    lump = _lump(estimate)
    if lump is None:
        return 0.0
    away = np.hypot(x - lump.x_mm, y - lump.y_mm)
    far = away > FAR_IN_WIDTHS * max(lump.sigma_x_mm, lump.sigma_y_mm)
    return (LEAST_RISE_FAR if far else LEAST_RISE) * lump.amplitude


def _beside(x: float, y: float, rest: TactileMap, estimate: Estimate) -> bool:
    """Whether a place is clear of the lump and of its scene's second structure."""
    lump = _lump(estimate)
    if lump is None:
        return True
    away = float(np.hypot(x - lump.x_mm, y - lump.y_mm))
    return away > BESIDE_IN_WIDTHS * max(lump.sigma_x_mm, lump.sigma_y_mm) and not _in_scene(x, y, rest, estimate)


def _in_scene(x: float, y: float, rest: TactileMap, estimate: Estimate) -> bool:
    """Whether a place belongs to the second lump or the rib of the lump's scene.

    A second lump whose centre lies off the map stands for what rises at the rim, which is looked at as elsewhere.
    """
    if estimate.scene is None or not estimate.scene.fit.scene.extra:
        return False
    fit = estimate.scene.fit
    one, two, log_width = (float(value) for value in fit.mode[-3:])
    if fit.scene.extra == "second lump":
        if not on_map(rest, one, two):
            return False
        away = np.hypot(x - one, y - two)
    else:
        middle = fit.target.window.middle
        away = abs((x - middle[0]) * np.cos(one) + (y - middle[1]) * np.sin(one) - two)
    return bool(away < BESIDE_IN_WIDTHS * np.exp(log_width))


def _rise(seen: Assessment, estimate: Estimate) -> Rise:
    """The assessed place as a `Rise`."""
    bump, lump, away = seen.bump(), _lump(estimate), None
    if lump is not None and estimate.map_posterior is not None:
        away = float(np.hypot(bump.x_mm - lump.x_mm, bump.y_mm - lump.y_mm))
    return Rise(
        bump.x_mm, bump.y_mm, away, bump.amplitude, bump.sigma_x_mm, bump.sigma_y_mm, seen.detection.probability
    )


def _at_rim(
    rest: TactileMap, candidates: tuple[Candidate, ...], options: EstimateOptions, estimate: Estimate
) -> Rise | None:
    """A rise that is a lump by the evidence and that the map covers too poorly to measure; None where there is none."""
    if not candidates or candidates[0].fit is None or not candidates[0].fault.startswith(AT_RIM):
        return None
    bump, lump = bump_of(candidates[0].fit), _lump(estimate)
    if bump.amplitude <= (0.0 if lump is None else LEAST_RISE_AT_RIM * lump.amplitude):
        return None
    chance = best_chance(rest, candidates, options)
    if chance is None or chance.detection.probability < LEAST_PROBABILITY or chance.probability < LIKELY:
        return None
    return Rise(
        bump.x_mm, bump.y_mm, None, bump.amplitude, bump.sigma_x_mm, bump.sigma_y_mm, chance.detection.probability
    )


def _stands_out(rise: Rise, rest: TactileMap) -> bool:
    """Whether the map, or the map with wide rises taken off, is higher at a rise's centre than elsewhere.

    A centre beyond the covered cells is not judged.
    """
    y, x = np.meshgrid(rest.y_mm, rest.x_mm, indexing="ij")
    near = rest.covered & (np.hypot(x - rise.x_mm, y - rise.y_mm) < STANDING_MM)
    if not near.any():
        return True
    levels = (one.mean[near].mean() - np.median(one.mean[rest.covered]) for one in (rest, levelled(rest)))
    return bool(max(levels) >= LEAST_STANDING * rise.amplitude)


def _is_known(rise: Rise, rises: list[Rise], rest: TactileMap, estimate: Estimate) -> bool:
    """Whether a fit moved to a place already found, or back to the measured lump."""
    again = any(np.hypot(rise.x_mm - one.x_mm, rise.y_mm - one.y_mm) < 2 * SMOOTHING_MM for one in rises)
    return again or not _beside(rise.x_mm, rise.y_mm, rest, estimate)
