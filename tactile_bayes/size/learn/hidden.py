"""Learning of what a body's departure B from a calibration goes with: properties that no map shows."""

from __future__ import annotations

from typing import Final

import numpy as np

from tactile_bayes.geometry import FloatArray
from tactile_bayes.size.hidden import INVERTED, HiddenTerms
from tactile_bayes.size.learn.regression import BodyRegression, PopulationTable

EXPLAINED: Final = 0.75
"""Of the table's bodies, by SD(B), those of which what is known tells as much as it does of all, in that SD."""


def hidden_terms(
    table: PopulationTable,
    data: BodyRegression,
    *,
    body: FloatArray,
    body_sd: FloatArray,
    features: FloatArray,
) -> HiddenTerms | None:
    """Second moments of what was varied, about what the map leads one to expect of it, and with B.

    Parameters
    ----------
    body, body_sd : (groups,) arrays
        B of each body, which took no part in the fit that says so, and SD(B) at its place. Bodies count by their B in
        that SD: faint and deep lumps, of which B is large, would decide alone otherwise.
    features : (n, c) array
        What a map leads one to expect is linear in these.
    """
    if not table.unknowns:
        return None
    design = np.stack([data.mean(column) for column in features.T], axis=1)
    inverted = tuple(name for name in INVERTED if name in table.unknowns)
    entered = [np.exp(-values) if name in inverted else values for name, values in table.unknowns.items()]
    varied = np.stack([data.mean(values) for values in entered], axis=1)
    coefficients = np.linalg.lstsq(design, varied, rcond=None)[0]
    rest = varied - design @ coefficients
    most_sd = float(np.quantile(body_sd, EXPLAINED))
    told = np.minimum(1.0, most_sd / body_sd)
    freedom = max(data.groups - design.shape[1], 1)
    return HiddenTerms(
        names=tuple(table.unknowns),
        expected=np.asarray(coefficients.T),
        covariance=np.asarray(rest.T @ rest / freedom),
        with_body=np.asarray(rest.T @ (told * body / body_sd) / (freedom * np.mean(told**2))),
        body_variance=1.0,
        inverted=inverted,
        most_sd=most_sd,
    )
