r"""Learning of how balls' maps look: their half log axis ratio q, and how far single maps are from it.

.. math:: q_i \sim N(q_0(x_i), s^2 + \kappa V_i)

:math:`q_0` is linear in given terms, V the variance of a map's posterior. Deep and faint lumps have a V a hundred times
that of clear ones, so least squares without it fit :math:`q_0` to the faintest maps and take their noise for all.
"""

from __future__ import annotations

import numpy as np

from tactile_bayes.geometry import FloatArray
from tactile_bayes.size.hidden import RoundSpread
from tactile_bayes.size.learn.regression import PopulationTable

_START = (np.log(0.01), np.log(2.0))
"""ln s and ln kappa where the search begins."""
_PRIOR_SD = 1.5
"""Of either about these: with a dozen bodies they stay near."""


def learn_round(table: PopulationTable, terms: FloatArray) -> tuple[FloatArray, RoundSpread]:
    """Fit the (c,) coefficients of q0 in (n, c) terms, and the spread about it, by maximum likelihood."""
    from scipy.optimize import minimize

    q, variance = table.half_log_ratio, table.covariance[:, 2, 2]

    def spread_at(values: FloatArray) -> RoundSpread:
        return RoundSpread(float(np.exp(values[0])), exam_sd=0.0, map_factor=float(np.exp(values[1])))

    def misfit(values: FloatArray) -> float:
        whole = spread_at(values).variance(variance)
        left = q - terms @ _weighted(terms, q, whole)
        prior = np.sum(((values - _START) / _PRIOR_SD) ** 2)
        return float(0.5 * (np.sum(left**2 / whole + np.log(whole)) + prior))

    found = spread_at(np.asarray(minimize(misfit, _START, method="Nelder-Mead").x))
    return _weighted(terms, q, found.variance(variance)), found


def _weighted(terms: FloatArray, values: FloatArray, variance: FloatArray) -> FloatArray:
    """(c,) coefficients by weighted least squares."""
    root = 1.0 / np.sqrt(variance)
    return np.asarray(np.linalg.lstsq(terms * root[:, None], values * root, rcond=None)[0])
