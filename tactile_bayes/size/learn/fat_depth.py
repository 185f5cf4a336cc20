"""Learning of the fat-depth calibration, see `size.fat_depth`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from tactile_bayes.geometry import FloatArray
from tactile_bayes.size.fat_depth import ROUND, FatCubic, FatDepth, cubic_terms, profile_terms
from tactile_bayes.size.learn.hidden import hidden_terms
from tactile_bayes.size.learn.regression import BodyRegression, PopulationTable, figures, leverages
from tactile_bayes.size.learn.round_lumps import learn_round
from tactile_bayes.size.polynomials import monomials

LEAST_BODIES = 80
"""Four for each term: with fewer a calibration without the fat's depth is all that a table supports."""


@dataclass(frozen=True, slots=True, eq=False)
class FatTable:
    """Maps with a profile of the head, and what it tells.

    Parameters
    ----------
    maps
        The rows of the table that have one.
    depth
        From profile to depth of fat, learned from them.
    log_depth : (n,) array
        ln F by it.
    centre
        alpha_0, p_0 and w_0: rounded means.
    """

    maps: PopulationTable
    depth: FatDepth
    log_depth: FloatArray
    centre: tuple[float, float, float]

    @classmethod
    def of(cls, table: PopulationTable) -> FatTable | None:
        """The rows with a profile; None for too few bodies."""
        if table.profile is None:
            return None
        maps = table.rows(np.isfinite(table.profile.sum(axis=1)))
        if maps.profile is None or maps.log_fat is None or len(np.unique(maps.body)) < LEAST_BODIES:
            return None
        depth = learn_depth(maps.profile, maps.log_fat)
        log_depth = depth.log_depth(maps.profile)
        alpha, p0, w0 = (round(float(one.mean()), 3) for one in (maps.log_amplitude, maps.log_width, log_depth))
        return cls(maps, depth, log_depth, (alpha, p0, w0))

    @property
    def values(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """(n,) u, v and w."""
        (alpha, p0, w0), maps = self.centre, self.maps
        return maps.log_amplitude - alpha, maps.log_width - p0, self.log_depth - w0

    def fields(self, features: FloatArray, *, inside: float = 1.0) -> dict[str, Any]:
        """Fields of `FatTerms` that do not depend on the form.

        Parameters
        ----------
        features : (n, c) array
            By which a map is like or unlike the table's.
        inside
            Share of the table's maps that count as inside it.
        """
        coefficients, spread = learn_round(self.maps, monomials(self.values, ROUND))
        inverse, leverage = leverages(features)
        return {
            "depth": self.depth,
            "centre": self.centre,
            "round_coefficients": coefficients,
            "round_spread": spread,
            "information_inverse": inverse,
            "most_leverage": float(np.quantile(leverage, inside)),
            "fat_mm": (float(np.exp(self.log_depth.min())), float(np.exp(self.log_depth.max()))),
        }


def learn_fat_cubic(table: PopulationTable) -> FatCubic | None:
    """Learn the calibration by amplitude, width and depth of fat from maps with a profile; None for too few bodies.

    Raises
    ------
    NotConvergedError
        When the posterior has no mode.
    """
    found = FatTable.of(table)
    if found is None:
        return None
    (alpha, p0, _), (_, _, w) = found.centre, found.values

    def terms_of(log_amplitude: FloatArray, log_width: FloatArray) -> FloatArray:
        return cubic_terms(log_amplitude - alpha, log_width - p0, w)

    data = BodyRegression.of(found.maps, terms_of)
    mean, covariance = data.posterior()
    return FatCubic(
        **found.fields(data.terms),
        mean=mean,
        covariance=covariance,
        hidden=hidden_terms(found.maps, data, **data.bodies_left_out(mean), features=data.terms),
        fit=figures(found.maps, data, mean),
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
