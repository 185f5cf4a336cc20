"""Learning of what a body's departure B from a calibration goes with: properties that no map shows."""

from __future__ import annotations

from typing import Final

import numpy as np

from tactile_bayes.geometry import FloatArray
from tactile_bayes.size.hidden import INVERTED, MOST_SKEWNESS, SKEWED_BY, HiddenTerms
from tactile_bayes.size.learn.regression import BodyRegression, PopulationTable

EXPLAINED: Final = 0.75
"""Of the table's bodies, by SD(B), those of which what is known tells as much as it does of all, in that SD."""


def hidden_terms(
    table: PopulationTable,
    data: BodyRegression,
    *,
    body: FloatArray,
    body_sd: FloatArray,
    variance: FloatArray,
    features: FloatArray,
    by_place: FloatArray | None = None,
) -> HiddenTerms | None:
    """Second moments of what was varied, about what the map leads one to expect of it, and with B.

    Parameters
    ----------
    body, body_sd : (groups,) arrays
        B of each body, which took no part in the fit that says so, and SD(B) at its place. Bodies count by their B in
        that SD: faint and deep lumps, of which B is large, would decide alone otherwise.
    variance : (groups,) array
        Of each `body`, with the errors of its exams and of the coefficients.
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
    most_sd = float(np.quantile(body_sd, EXPLAINED))
    told = np.minimum(1.0, most_sd / body_sd)
    freedom = max(data.groups - design.shape[1], 1)
    return HiddenTerms(
        names=tuple(table.unknowns),
        expected=np.asarray(coefficients[:c].T),
        covariance=np.asarray(rest.T @ rest / freedom),
        with_body=np.asarray(rest.T @ (told * body / body_sd) / (freedom * np.mean(told**2))),
        body_variance=1.0,
        by_place=None if by_place is None else np.asarray(coefficients[c:].T),
        inverted=inverted,
        most_sd=most_sd,
        skewness=third_moment(body, body_sd, variance) if SKEWED_BY in table.unknowns else 0.0,
    )


def third_moment(body: FloatArray, body_sd: FloatArray, variance: FloatArray) -> float:
    """Third central moment of B over the cube of SD(B), 0 to `MOST_SKEWNESS`, from (groups,) bodies left out.

    Their other errors are symmetric and add nothing to it. The moment of z, B over its whole SD, is the share of SD(B)
    in that, cubed, times the one sought; this is its least-squares fit.
    """
    standard, share = body / np.sqrt(variance), (body_sd / np.sqrt(variance)) ** 3
    third = share @ (standard - standard.mean()) ** 3 / (share @ share)
    return float(np.clip(third, 0.0, MOST_SKEWNESS))
