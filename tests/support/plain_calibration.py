"""A calibration over bodies in closed form: ln d = 2.5 + 0.3 u + v, by Eq 6 with b 0 and without a depth of fat."""

from __future__ import annotations

import numpy as np

from tactile_bayes.size.bodies import QUADRATIC, BodyCalibration, Centre, Spread
from tactile_bayes.size.eq6 import PLAIN, Eq6Law
from tactile_bayes.size.terms import HiddenTerms, Recipe, RoundLumps

RECIPE = Recipe("mean", "fixed", 20.0, declared=True)
"""As tables are made that do not say how."""
CENTRE = Centre(-1.0, 1.5, 0.0)


def plain_calibration(
    *,
    body_sd: float,
    exam_sd: float = 0.02,
    hidden: HiddenTerms | None = None,
    amplitude_variance: float = 1e-6,
    normalise: str = "mean",
) -> BodyCalibration:
    """Coefficients known to 1e-3; the variance of f, the slope by ln a, may be larger."""
    spread = np.array([np.log(body_sd), *np.zeros(5)])
    return BodyCalibration(
        centre=CENTRE,
        eq6=Eq6Law(PLAIN, np.array([2.5, -0.3, 0.0]), np.diag([1e-6, amplitude_variance, 1e-6]), 0.0),
        spread=Spread(QUADRATIC[:6], spread, np.eye(6) * 1e-6, float(np.log(exam_sd)), 1e-6, 0.0, ""),
        round_lumps=RoundLumps(np.array([0.05, 0.0, 0.0, 0.0, 0.0, 0.0]), 0.02, 0.01, 1.0),
        feature_powers=QUADRATIC[:6],
        information_inverse=np.eye(6) * 1e-2,
        most_leverage=1.0,
        domain={"amplitude": (0.01, 5.0), "sigma_mm": (1.0, 12.0), "d_mm": (5.0, 30.0)},
        recipe=Recipe(normalise, "free", 20.0, False, "field"),
        hidden=hidden,
        hidden_any=None,
        source="",
        bodies={},
        residual=None,
        depth=None,
        fit={},
    )
