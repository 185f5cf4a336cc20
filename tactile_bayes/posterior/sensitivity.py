"""Prior sensitivity: the draws reweighted under a width prior twice as wide."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from tactile_bayes.geometry import FloatArray
from tactile_bayes.inference.pareto import smooth_weights
from tactile_bayes.inference.summary import weighted_quantiles_of
from tactile_bayes.posterior.lump.bump import BumpPrior
from tactile_bayes.records import dataclass

WIDER = 2.0
TAIL = 0.025


@dataclass(frozen=True, slots=True)
class Sensitivity:
    """Effect of doubling the width prior's SD, in posterior SDs.

    Parameters
    ----------
    median, ends
        By quantity: shift of the median, and the larger shift of the two ends of the 95 % interval.
    pareto_k
        Shape of the weights; above 0.7 the shifts are not to be trusted.
    """

    median: Mapping[str, float]
    ends: Mapping[str, float]
    pareto_k: float

    def as_dict(self) -> dict[str, object]:
        """Plain data."""
        return {"width_prior_times": WIDER, "median_sd": dict(self.median), "ends_sd": dict(self.ends)}


def prior_sensitivity(
    sigma_x: FloatArray, sigma_y: FloatArray, quantities: Mapping[str, FloatArray], prior: BumpPrior
) -> Sensitivity:
    """Shifts of quantities under a width prior twice as wide, by reweighting without another fit.

    Parameters
    ----------
    sigma_x, sigma_y : (...) arrays
        Draws of the widths.
    quantities
        Draws of whatever is asked about, in the same order; those of another shape are left out, NaN draws count for
        nothing.
    """
    p = 0.5 * np.log(sigma_x * sigma_y).ravel()
    z = (p - np.log(prior.width_median_mm)) / prior.log_width_sd
    weight, shape = smooth_weights(0.5 * z**2 * (1.0 - WIDER**-2))
    medians, ends = {}, {}
    for name, draws in quantities.items():
        values = draws.ravel()
        if values.shape != weight.shape:
            continue
        good = np.isfinite(values)
        sd = float(values[good].std()) or 1.0
        at = np.array([0.5, TAIL, 1.0 - TAIL])
        order = np.argsort(values[good])
        ordered, weighed = values[good][order], weight[good][order]
        plain = weighted_quantiles_of(ordered, np.ones(len(order)), at)
        shift = (weighted_quantiles_of(ordered, weighed, at) - plain) / sd
        medians[name], ends[name] = float(shift[0]), float(shift[1:][np.argmax(np.abs(shift[1:]))])
    return Sensitivity(medians, ends, shape)
