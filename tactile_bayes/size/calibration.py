"""The two forms of a size calibration, and the step in which they differ: from map draws to sizes.

Both forms have `at_fat`, `fitting`, `outside`, `too_far` and `omissions`; whoever uses a calibration needs no other.
"""

from __future__ import annotations

from dataclasses import replace
from typing import assert_never

import numpy as np

from tactile_bayes.geometry import FloatArray
from tactile_bayes.inference.draws import Labels
from tactile_bayes.size.eq6 import SizeCalibration
from tactile_bayes.size.log_quadratic import LogQuadratic
from tactile_bayes.size.pooling import ShapeDraws, SizePriors, pooled_size
from tactile_bayes.size.posterior import SizePosterior, push_sizes

Calibration = SizeCalibration | LogQuadratic


def draw_sizes(
    amplitude: FloatArray,
    sigma_x_mm: FloatArray,
    sigma_y_mm: FloatArray,
    angle_rad: FloatArray,
    *,
    calibration: Calibration,
    priors: SizePriors,
    replicates: Labels | None,
    rng: np.random.Generator,
) -> SizePosterior:
    """Sizes from the joint draws of one map.

    Parameters
    ----------
    amplitude, sigma_x_mm, sigma_y_mm, angle_rad : (chain, draw) arrays
        Of Eq 7.
    priors
        Spread between maps, shape of the lump, known properties of the body; Eq 6 uses none of them.
    replicates : (chain * draw,) array
        As `ParameterDraws.replicates`.
    """
    match calibration:
        case LogQuadratic():
            one = ShapeDraws.of(amplitude, sigma_x_mm, sigma_y_mm, angle_rad, labels=replicates)
            size = pooled_size([one], calibration=calibration, priors=priors, rng=rng)
            shape = amplitude.shape
            return replace(size, d_x_mm=size.d_x_mm.reshape(shape), d_y_mm=size.d_y_mm.reshape(shape))
        case SizeCalibration():
            return push_sizes(
                amplitude, sigma_x_mm, sigma_y_mm, angle_rad, calibration=calibration, rng=rng, replicates=replicates
            )
    assert_never(calibration)
