"""Posterior draws of a map and its size, refined until the size interval is as exact as requested."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from tactile_bayes.abstention import Abstention
from tactile_bayes.declarations import replace
from tactile_bayes.errors import NotConvergedError
from tactile_bayes.inference.draws import ParameterDraws
from tactile_bayes.mapping.tactile_map import TactileMap
from tactile_bayes.posterior.abstention import shape_fault
from tactile_bayes.posterior.assessment import Assessment, MapDraws
from tactile_bayes.posterior.lump.posterior import MapPosterior
from tactile_bayes.posterior.options import EstimateOptions
from tactile_bayes.presets import INTERVAL
from tactile_bayes.records import dataclass
from tactile_bayes.size.draws import EXTREMES, SizePosterior
from tactile_bayes.size.pooling import Calibration, SizePriors, draw_sizes

DEFAULT_ACCURACY_SD = {"importance": 0.02, "ensemble": 0.1}
"""Of interval ends of sizes, where none is given; the methods have the same for the widths."""
MOST_REFINEMENTS, SAFETY, LEAST_ACCURACY_SD = 3, 0.8, 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class Drawn:
    """Draws of one map with its size by `calibration`; `fault` and `too_far` say why there is none."""

    made: MapDraws
    size: SizePosterior | None
    fault: Abstention | None
    calibration: Calibration | None
    too_far: tuple[str, ...] = ()


def draw_sized(
    tactile_map: TactileMap,
    seen: Assessment,
    calibration: Calibration | None,
    options: EstimateOptions,
    *,
    rng: np.random.Generator,
    progress: Callable[[int, int], None] | None,
) -> Drawn:
    """Draw until the size interval is as accurate as requested.

    The method stops when the widths are exact enough, which mostly makes the size so too. Where a method cannot draw
    more finely the last draws stand, with their error.
    """
    draw = partial(_drawn, tactile_map, seen, calibration, rng=rng, progress=progress)
    found = draw(options)
    for _ in range(MOST_REFINEMENTS):
        finer = _finer(found, options)
        if finer is None:
            break
        options = replace(options, accuracy_sd=finer)
        try:
            found = draw(options)
        except NotConvergedError:
            break
    return found


def _finer(found: Drawn, options: EstimateOptions) -> float | None:
    """Accuracy in SDs for the next draws; None where the size is accurate enough, or no accuracy is requested."""
    wanted = options.accuracy_sd or DEFAULT_ACCURACY_SD.get(found.made.draws.method)
    if found.size is None or wanted is None:
        return None
    ends = [found.size.summarise(name, probability=INTERVAL) for name in EXTREMES]
    short = min(wanted * one.sd / one.mc_error for one in ends)
    if options.accuracy_mm is not None:
        short = min(short, *(options.accuracy_mm / one.mc_error for one in ends))
    return None if short >= 1.0 else max(SAFETY * short * wanted, LEAST_ACCURACY_SD)


def _drawn(
    tactile_map: TactileMap,
    seen: Assessment,
    calibration: Calibration | None,
    options: EstimateOptions,
    *,
    rng: np.random.Generator,
    progress: Callable[[int, int], None] | None,
) -> Drawn:
    made = seen.draw(options, rng=rng, progress=progress)
    posterior = made.posterior
    fault = shape_fault(
        posterior.sigma_x_mm, posterior.sigma_y_mm, cell_mm=tactile_map.recipe.cell_mm, prior=options.prior
    )
    calibration = None if calibration is None else calibration.fitting(*posterior.medians)
    far = () if calibration is None else tuple(calibration.too_far(*posterior.medians))
    size = None if fault or far else _size(posterior, made.draws, calibration, options.size_priors, rng=rng)
    return Drawn(made, size, fault, calibration, far)


def _size(
    posterior: MapPosterior,
    draws: ParameterDraws,
    calibration: Calibration | None,
    priors: SizePriors,
    *,
    rng: np.random.Generator,
) -> SizePosterior | None:
    if calibration is None:
        return None
    return draw_sizes(
        posterior.amplitude,
        posterior.sigma_x_mm,
        posterior.sigma_y_mm,
        posterior.angle_rad,
        calibration=calibration,
        priors=priors,
        replicates=draws.replicates,
        rng=rng,
        oblique=posterior.oblique,
        irregular=posterior.irregular,
    )
