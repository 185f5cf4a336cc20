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
"""A value farther than this from what the map leads one to expect is not supposed."""


@dataclass(frozen=True, slots=True)
class Supposition:
    """What the size would be if one more property of the body were known.

    Parameters
    ----------
    name, value
        The property, by the names of `HiddenTerms`, and its value.
    log_shift
        By which the median of ln d moves.
    sds
        Of ln d without and with it.
    """

    name: str
    value: float
    log_shift: float
    sds: tuple[float, float]

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
        return float(median_mm * np.exp(self.log_shift) * (size_mm / median_mm) ** self.sd_ratio)


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
    body_sd = calibration.body_sd(*at, np.zeros(1))
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
    sds = float(np.sqrt(variances[0])), float(np.sqrt(variances[1]))
    return Supposition(name, value, float((left.expected - before.expected)[0]), sds)


@dataclass(frozen=True, slots=True, eq=False)
class BodyLeft:
    """Distribution of B, given what is known of a body.

    Parameters
    ----------
    expected, variance : (n,) arrays
    """

    expected: FloatArray
    variance: FloatArray


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
        return BodyLeft(none, own_sd**2)
    names = () if hidden is None else hidden.names
    for name, value in known.items():
        if name not in names:
            raise UsageError(f"the calibration has no property {name}; {meant(name, names or ('none',))}")
        check_number(f"known {name}", value, 0, open_ends=name != "seat")
    assert hidden is not None
    expected = hidden.expected_body(known, calibration.features(log_amplitude, log_width))
    explained_sd = np.minimum(own_sd, hidden.most_sd)
    left = own_sd**2 - hidden.share(*known) * explained_sd**2
    return BodyLeft(expected * explained_sd, left)
