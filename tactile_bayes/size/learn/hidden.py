"""Learning of what a body's departure B from a calibration goes with: properties that no map shows."""

from __future__ import annotations

import numpy as np

from tactile_bayes.geometry import FloatArray
from tactile_bayes.size.hidden import INVERTED, HiddenTerms
from tactile_bayes.size.learn.regression import BodyRegression, PopulationTable


def hidden_terms(
    table: PopulationTable,
    data: BodyRegression,
    *,
    body: FloatArray,
    features: FloatArray,
    by_place: FloatArray | None = None,
) -> HiddenTerms | None:
    """Second moments of what was varied, about what the map leads one to expect of it, and with B.

    Parameters
    ----------
    body : (groups,) array
        B of each body, which took no part in the fit that says so, in SDs of B at its place: faint and deep lumps,
        of which B is large, would decide alone otherwise.
    features : (n, c) array
        What a map leads one to expect is linear in these.
    by_place : (n, 6) array
        And in these, where they are given: standardised `presets.BY_PLACE`.
    """
    if not table.unknowns:
        return None
    c = features.shape[1]
    whole = features if by_place is None else np.column_stack([features, by_place])
    design = np.stack([data.mean(column) for column in whole.T], axis=1)
    inverted = tuple(name for name in INVERTED if name in table.unknowns)
    entered = [np.exp(-values) if name in inverted else values for name, values in table.unknowns.items()]
    varied = np.stack([data.mean(values) for values in entered], axis=1)
    coefficients = np.linalg.lstsq(design, varied, rcond=None)[0]
    rest = varied - design @ coefficients
    freedom = max(data.groups - design.shape[1], 1)
    return HiddenTerms(
        names=tuple(table.unknowns),
        expected=np.asarray(coefficients[:c].T),
        covariance=np.asarray(rest.T @ rest / freedom),
        with_body=np.asarray(rest.T @ body / freedom),
        body_variance=1.0,
        by_place=None if by_place is None else np.asarray(coefficients[c:].T),
        inverted=inverted,
    )
