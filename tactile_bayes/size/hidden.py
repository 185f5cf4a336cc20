"""Hidden properties in a size calibration: the oval map of a ball, and properties of the body that no map shows."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from tactile_bayes.geometry import FloatArray
from tactile_bayes.records import dataclass

LOGGED = ("depth_mm", "stiffness_ratio", "fat_kpa", "gland_ratio")
"""Properties that enter by their logarithm."""


@dataclass(frozen=True, slots=True, eq=False)
class RoundLumps:
    """Axis ratio of a ball's map, and the scatter of single maps about it.

    Parameters
    ----------
    coefficients : (3,) array
        Of 1, u and v in q0.
    body_sd, exam_sd
        Of the excess q - q0 between bodies, and between exams of one body.
    """

    coefficients: FloatArray
    body_sd: float
    exam_sd: float


@dataclass(frozen=True, slots=True, eq=False)
class HiddenTerms:
    """Components of B: properties of a body that no map shows, jointly normal with it given the map.

    Parameters
    ----------
    names
        Of k properties; those in `LOGGED` enter by their logarithm.
    expected : (k, 6) array
        Coefficients of `QUADRATIC` in what a map leads one to expect of each.
    covariance : (k, k) array
        About that.
    with_body : (k,) array
        Covariance with B.
    body_variance
        Of B in the same table.
    """

    names: tuple[str, ...]
    expected: FloatArray
    covariance: FloatArray
    with_body: FloatArray
    body_variance: float

    def share(self, *names: str) -> float:
        """Share of B's variance removed by knowing these properties."""
        at = [self.names.index(name) for name in names]
        gain = np.linalg.solve(self.covariance[np.ix_(at, at)], self.with_body[at])
        return float(np.clip(gain @ self.with_body[at] / self.body_variance, 0.0, 1.0))

    def expected_body(self, known: Mapping[str, float], terms: FloatArray) -> FloatArray:
        """(...,) mean of B given known properties, for (..., 6) terms of the map."""
        at = [self.names.index(name) for name in known]
        gain = np.linalg.solve(self.covariance[np.ix_(at, at)], self.with_body[at])
        given = np.array([np.log(v) if name in LOGGED else v for name, v in known.items()])
        return np.asarray((given - terms @ self.expected[at].T) @ gain)
