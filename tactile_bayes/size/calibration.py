"""The kinds of size calibration, and the step in which they differ: from map draws to sizes.

One is learned from a study or phantoms (`eq6`), one over a population of bodies (`body_calibration`). Both have
`at_fat`, `fitting`, `outside`, `too_far` and `omissions`; whoever uses a calibration needs no other.
"""

from __future__ import annotations

from typing import assert_never

import numpy as np

from tactile_bayes.geometry import FloatArray
from tactile_bayes.inference.draws import Labels
from tactile_bayes.size.body_calibration import BodyCalibration
from tactile_bayes.size.eq6 import SizeCalibration
from tactile_bayes.size.pooling import SizePriors, pooled_size
from tactile_bayes.size.posterior import SizePosterior, push_sizes
from tactile_bayes.size.shape_draws import ShapeDraws

Calibration = SizeCalibration | BodyCalibration


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
    oblique: tuple[float, float] | None = None,
    irregular: bool = False,
) -> SizePosterior:
    """Draw sizes from the joint draws of one map.

    Parameters
    ----------
    amplitude, sigma_x_mm, sigma_y_mm, angle_rad : (chain, draw) arrays
        Of Eq 7.
    priors
        Spread between maps, shape of the lump, known properties of the body. Eq 6 uses the spread, for the interval
        of another exam, and nothing else.
    replicates : (chain * draw,) array
        As `ParameterDraws.replicates`.
    oblique, irregular
        As `MapPosterior`'s; Eq 6 does not use them.
    """
    match calibration:
        case BodyCalibration():
            one = ShapeDraws.of(
                amplitude,
                sigma_x_mm,
                sigma_y_mm,
                angle_rad,
                labels=replicates,
                oblique=oblique,
                irregular=irregular,
            )
            return pooled_size([one], calibration=calibration, priors=priors, rng=rng).reshaped(amplitude.shape)
        case SizeCalibration():
            return push_sizes(
                amplitude,
                sigma_x_mm,
                sigma_y_mm,
                angle_rad,
                calibration=calibration,
                rng=rng,
                replicates=replicates,
                another_exam=priors.another_exam or priors.between_maps,
            )
    assert_never(calibration)
