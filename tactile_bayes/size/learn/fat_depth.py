"""Learning of the fat-depth calibration, see `size.fat_depth`."""

from __future__ import annotations

import numpy as np

from tactile_bayes.geometry import FloatArray
from tactile_bayes.size.fat_depth import POWERS, ROUND, FatCubic, FatDepth, cubic_terms, profile_terms
from tactile_bayes.size.learn.regression import BodyRegression, PopulationTable, figures, hidden_terms

LEAST_BODIES = 80
"""Four for each term: with fewer a calibration without the fat's depth is all that a table supports."""
_ROUND = [POWERS.index(one) for one in ROUND]


def table_with_depths(table: PopulationTable) -> tuple[PopulationTable, FatDepth, FloatArray] | None:
    """Rows with a profile, what their profiles tell of the fat, and (n,) ln F by it; None for too few bodies."""
    if table.profile is None:
        return None
    table = table.rows(np.isfinite(table.profile.sum(axis=1)))
    if table.profile is None or table.log_fat is None or len(np.unique(table.body)) < LEAST_BODIES:
        return None
    depth = learn_depth(table.profile, table.log_fat)
    return table, depth, depth.log_depth(table.profile)


def learn_fat_cubic(table: PopulationTable) -> FatCubic | None:
    """Learn the calibration by amplitude, width and depth of fat from maps with a profile; None for too few bodies.

    Raises
    ------
    NotConvergedError
        When the posterior has no mode.
    """
    found = table_with_depths(table)
    if found is None:
        return None
    table, depth, log_depth = found
    alpha, p0, w0 = (round(float(one.mean()), 3) for one in (table.log_amplitude, table.log_width, log_depth))

    def terms_of(log_amplitude: FloatArray, log_width: FloatArray) -> FloatArray:
        return cubic_terms(log_amplitude - alpha, log_width - p0, log_depth - w0)

    data = BodyRegression.of(table, terms_of)
    mean, covariance = data.posterior()
    inverse, most_leverage = data.leverage()
    coefficients, between, within = data.oval(table, data.terms[:, _ROUND])
    return FatCubic(
        depth=depth,
        centre=(alpha, p0, w0),
        mean=mean,
        covariance=covariance,
        round_coefficients=coefficients,
        round_sd=(between, within),
        information_inverse=inverse,
        most_leverage=most_leverage,
        fat_mm=(float(np.exp(log_depth.min())), float(np.exp(log_depth.max()))),
        hidden=hidden_terms(table, data, mean),
        fit=figures(table, data, mean),
    )


def learn_depth(profile: FloatArray, log_fat: FloatArray) -> FatDepth:
    """Fit ln F by least squares on the full quadratic of (n, 3) profiles."""
    centre, scale = profile.mean(axis=0), profile.std(axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    x = profile_terms((profile - centre) / scale)
    inverse = np.asarray(np.linalg.pinv(x.T @ x), dtype=np.float64)
    coefficients = inverse @ (x.T @ log_fat)
    rest = log_fat - x @ coefficients
    return FatDepth(
        centre,
        scale,
        np.asarray(coefficients),
        inverse,
        float(np.einsum("ni,ij,nj->n", x, inverse, x).max()),
        float(np.sqrt(np.sum(rest**2) / max(len(rest) - x.shape[1], 1))),
    )
