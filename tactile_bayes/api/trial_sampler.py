"""Sampler for the next mass's model: importance sampling about the mode, or MCMC where it cannot be trusted."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from tactile_bayes.errors import NotConvergedError
from tactile_bayes.inference.ensemble import ensemble
from tactile_bayes.inference.importance import importance, importance_options
from tactile_bayes.inference.modes import mode_and_covariance

if TYPE_CHECKING:
    from tactile_bayes.geometry import FloatArray
    from tactile_bayes.inference.draws import ParameterDraws
    from tactile_bayes.inference.modes import LogDensity

# Monte-Carlo error of interval ends, in posterior SDs.
_ACCURACY_SD = 0.03


def draw(
    log_density: LogDensity, centre: FloatArray, covariance: FloatArray, *, rng: np.random.Generator
) -> ParameterDraws:
    """Draw from a log density.

    The density takes (m, p) arrays to (m,); `centre` and `covariance` guess the mode and the covariance about it. Where
    MCMC, too, does not reach its criteria, `NotConvergedError` says so.
    """
    try:
        mode, about, _ = mode_and_covariance(log_density, centre, scale=np.sqrt(np.diag(covariance)))
        return importance(log_density, mode, about, rng=rng, options=importance_options(_ACCURACY_SD))
    except NotConvergedError:
        return ensemble(log_density, centre, covariance, rng=rng)
