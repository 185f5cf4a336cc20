"""Hidden properties in a size calibration: the oval map of a ball, and properties of the body that no map shows."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from tactile_bayes.geometry import FloatArray
from tactile_bayes.records import dataclass

LOGGED = ("depth_mm", "stiffness_ratio", "fat_kpa", "gland_ratio")
"""Properties that vary and enter by their logarithm, but for those that enter by their inverse."""
INVERTED = ("stiffness_ratio",)
"""Properties by whose inverse a size goes: 50 times as stiff as fat and 100 times are both nearly rigid."""
MOST_SHARE = 0.9
"""Share of B's variance that all properties together tell at most.

In the second moments it comes out above 1, because SD(B) is learned apart from them. They explain 95 % of held-out
bodies' departures without and 76 % with the depth of fat, with the exams' own errors in the rest (record 0118).
"""


@dataclass(frozen=True, slots=True)
class RoundSpread:
    """How far maps of balls are from the axis ratio that is usual for them.

    Parameters
    ----------
    body_sd, exam_sd
        Of the excess q - q0 between bodies, and between exams of one body.
    map_factor
        Variance of q about q0 over that of a map's posterior: a deep and faint lump's map is off by more than it says.
    """

    body_sd: float
    exam_sd: float
    map_factor: float = 1.0

    def variance(self, of_maps: FloatArray, *, maps: int = 1) -> FloatArray:
        """Variance of the mean excess over some maps of a mass, whose posteriors give its mean this variance."""
        own = self.body_sd**2 + self.exam_sd**2 / maps
        return np.asarray(own + self.map_factor * of_maps)


@dataclass(frozen=True, slots=True, eq=False)
class RoundLumps:
    """Axis ratio of a ball's map, and the scatter of single maps about it.

    Parameters
    ----------
    coefficients : (c,) array
        Of a calibration's features in q0.
    spread
        About q0.
    """

    coefficients: FloatArray
    spread: RoundSpread


@dataclass(frozen=True, slots=True, eq=False)
class HiddenTerms:
    """Components of B: properties of a body that no map shows, jointly normal with it given the map.

    Parameters
    ----------
    names
        Of k properties.
    expected : (k, c) array
        Coefficients of a calibration's c `features` in what a map leads one to expect of each.
    covariance : (k, k) array
        About that.
    with_body : (k,) array
        Covariance with B.
    body_variance
        Of B, in the units that `with_body` has it in: 1 where these are the SD(B) of each body's place.
    inverted
        Those that enter by their inverse.
    most_sd
        SD(B) beyond which these properties explain no more of B: of faint and deep lumps it is the map that is unlike.
    """

    names: tuple[str, ...]
    expected: FloatArray
    covariance: FloatArray
    with_body: FloatArray
    body_variance: float
    inverted: tuple[str, ...] = ()
    most_sd: float = float("inf")

    def share(self, *names: str) -> float:
        """Share of B's variance removed by knowing these properties, at most `MOST_SHARE`."""
        at = [self.names.index(name) for name in names]
        gain = np.linalg.solve(self.covariance[np.ix_(at, at)], self.with_body[at])
        return float(np.clip(gain @ self.with_body[at] / self.body_variance, 0.0, MOST_SHARE))

    def expected_body(self, known: Mapping[str, float], features: FloatArray) -> FloatArray:
        """(...,) mean of B over its SD, given known properties, for (..., c) features of the map."""
        at = [self.names.index(name) for name in known]
        gain = np.linalg.solve(self.covariance[np.ix_(at, at)], self.with_body[at]) / np.sqrt(self.body_variance)
        given = np.array([self._entered(name, value) for name, value in known.items()])
        return np.asarray((given - features @ self.expected[at].T) @ gain)

    def score(self, name: str, value: float, features: FloatArray) -> float:
        """How far a value is from what a map's (c,) features lead one to expect of a property, in SDs."""
        at = self.names.index(name)
        off = self._entered(name, value) - features @ self.expected[at]
        return float(abs(off) / np.sqrt(self.covariance[at, at]))

    def _entered(self, name: str, value: float) -> float:
        if name in self.inverted:
            return 1.0 / value
        return float(np.log(value)) if name in LOGGED else value
