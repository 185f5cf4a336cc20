"""The paper's method: least squares (Eq 7) with its covariance and no prior."""

from __future__ import annotations

import numpy as np

from tactile_bayes.geometry import FloatArray
from tactile_bayes.inference.draws import INDEPENDENT_DRAWS, ParameterDraws, student_draws


def optimise(
    theta: FloatArray,
    covariance: FloatArray,
    *,
    dof: float,
    rng: np.random.Generator,
) -> ParameterDraws:
    """Draw about the least-squares estimate, with its covariance and t tails for the estimated noise.

    Parameters
    ----------
    theta, covariance : (p,), (p, p) arrays
        The estimate and its covariance, correlated errors included.
    dof
        Effective degrees of freedom of the noise estimate.

    Notes
    -----
    Wellman & Howe (1999), section 2.4, minimise the squared error between map and Eq 7; the covariance of that
    estimate is this program's addition.
    """
    flat = student_draws(theta, covariance, dof=dof, number=INDEPENDENT_DRAWS, rng=rng)
    return ParameterDraws(flat[None], "optimise", {"draws": float(INDEPENDENT_DRAWS)})
