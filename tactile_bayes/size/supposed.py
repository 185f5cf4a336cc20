"""What is known of a body, or supposed of it, and what that says of B, its departure from the calibration.

No map shows how stiff a lump is, and without frames none shows its seat: sizes are drawn to the middle of the
calibration's bodies. How large the lump would be if it were soft or hard tells a reader on which side a size errs, and
by how much.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np

from tactile_bayes.errors import UsageError, check_number, meant
from tactile_bayes.geometry import FloatArray
from tactile_bayes.inference.normal import normal_score, skewed_score
from tactile_bayes.records import dataclass
from tactile_bayes.size.body_calibration import BodyCalibration

SUPPOSED: Final[Mapping[str, tuple[str, float]]] = {
    "soft": ("stiffness_ratio", 11.0),
    "hard": ("stiffness_ratio", 70.0),
    "centred": ("seat", 0.0),
    "resting": ("seat", 1.0),
}
"""A property and its value by name: lumps of 8 to 15 and 50 to 100 times the stiffness of fat, centred on the gland's
surface and resting on it."""
LIKELY_SDS: Final = 2.5
"""A value farther than this from what the map leads one to expect is not supposed: figures by place tell the seat."""


@dataclass(frozen=True, slots=True)
class Supposition:
    """What the size would be if one more property of the body were known.

    Parameters
    ----------
    name, value
        The property, by the names of `HiddenTerms`, and its value.
    log_shift
        By which the median of ln d moves.
    sds, skewness
        Of ln d without and with it.
    """

    name: str
    value: float
    log_shift: float
    sds: tuple[float, float]
    skewness: tuple[float, float]

    @property
    def sd_ratio(self) -> float:
        """SD of ln d with it, over that without."""
        return self.sds[1] / self.sds[0] if self.sds[0] > 0 else 1.0

    @property
    def change(self) -> float:
        """Change of the size, as a share."""
        return float(np.expm1(self.log_shift))

    def moved(self, size_mm: float, *, median_mm: float) -> float:
        """Size where one of a distribution with this median comes to lie: the median itself, or an interval's end."""
        (before, after), (skewed, left) = self.sds, self.skewness
        above = np.log(size_mm / median_mm) / before if before > 0 else 0.0
        score = normal_score(np.array(above + _median_score(skewed)), np.array(skewed))
        moved = after * (skewed_score(score, np.array(left)) - _median_score(left))
        return float(median_mm * np.exp(self.log_shift + moved))


def _median_score(skewness: float) -> float:
    """Median of a skewed distribution with mean 0 and SD 1."""
    return float(skewed_score(np.zeros(()), np.array(skewness)))


def suppositions(
    calibration: BodyCalibration, known: Mapping[str, float], middle: tuple[float, float], *, variance: float
) -> dict[str, Supposition]:
    """Of `SUPPOSED` those that the calibration's bodies hold, that the map leaves open and that nobody knows, by name.

    Parameters
    ----------
    middle
        Mean ln a and p of the maps.
    variance
        Of ln d as it is.
    """
    at = np.array([middle[0]]), np.array([middle[1]])
    body_sd = calibration.body_and_error(calibration.terms(*at), *at, np.zeros(1))[0]
    own_sd = calibration.own_sd(body_sd)
    names, found = () if calibration.hidden is None else calibration.hidden.names, {}
    before = known_body(calibration, known, *at, own_sd)
    features = calibration.features(*at)[0]
    for label, (name, value) in SUPPOSED.items():
        low, high = calibration.bodies.get(name, (value, value))
        if name not in names or name in known or not low <= value <= high:
            continue
        if calibration.hidden is not None and calibration.hidden.score(name, value, features) <= LIKELY_SDS:
            left = known_body(calibration, {**known, name: value}, *at, own_sd)
            found[label] = _supposition(name, value, before, left, variance=variance)
    return found


def _supposition(name: str, value: float, before: BodyLeft, left: BodyLeft, *, variance: float) -> Supposition:
    """What one more known property does to a size whose logarithm has this variance without it."""
    gone = float((before.variance - left.variance)[0])
    variances = variance, float(np.clip(variance - gone, 0.0, variance))
    skewness = [
        float((one.skewness * one.variance**1.5)[0]) / whole**1.5 if whole > 0 else 0.0
        for one, whole in zip((before, left), variances, strict=True)
    ]
    sds = float(np.sqrt(variances[0])), float(np.sqrt(variances[1]))
    shift = float((left.expected - before.expected)[0])
    shift += sds[1] * _median_score(skewness[1]) - sds[0] * _median_score(skewness[0])
    return Supposition(name, value, shift, sds, (skewness[0], skewness[1]))


@dataclass(frozen=True, slots=True, eq=False)
class BodyLeft:
    """Distribution of B, given what is known of a body.

    Parameters
    ----------
    expected, variance, skewness : (n,) arrays
    """

    expected: FloatArray
    variance: FloatArray
    skewness: FloatArray

    @property
    def skewed_variance(self) -> FloatArray:
        """(n,) its variance where it is skewed; 0 where it is a normal, as the rest of ln d is."""
        return np.where(self.skewness > 0.0, self.variance, 0.0)

    def drawn(self, score: FloatArray) -> FloatArray:
        """(n,) B about its mean at (n,) normal scores, where it is skewed."""
        return np.asarray(np.sqrt(self.skewed_variance) * skewed_score(score, self.skewness))


def known_body(
    calibration: BodyCalibration,
    known: Mapping[str, float],
    log_amplitude: FloatArray,
    log_width: FloatArray,
    own_sd: FloatArray,
) -> BodyLeft:
    """B given known properties.

    Parameters
    ----------
    log_amplitude, log_width, own_sd : (n,) arrays
        Of maps: ln a, p, and SD(B) there without `BodyCalibration.other_sd`, of which no property tells anything.

    Raises
    ------
    UsageError
        When the calibration knows nothing of a property.
    """
    hidden, none = calibration.hidden, np.zeros(len(log_width))
    if not known:
        skewness = none if hidden is None else hidden.skewness_left({}, none + 1.0)
        return BodyLeft(none, own_sd**2, skewness)
    names = () if hidden is None else hidden.names
    for name, value in known.items():
        if name not in names:
            raise UsageError(f"the calibration has no property {name}; {meant(name, names or ('none',))}")
        check_number(f"known {name}", value, 0, open_ends=name != "seat")
    assert hidden is not None
    expected = hidden.expected_body(known, calibration.features(log_amplitude, log_width))
    explained_sd = np.minimum(own_sd, hidden.most_sd)
    left = own_sd**2 - hidden.share(*known) * explained_sd**2
    skewness = hidden.skewness_left(known, np.divide(left, own_sd**2, out=none + 1.0, where=own_sd > 0))
    return BodyLeft(expected * explained_sd, left, skewness)
