r"""Whether exams of two visits are of one mass: by what the scans say, and by where the mass lies in the patient.

Places are in the patient's frame, x and y in mm from the xiphoid (`geometry.patient_from_base`). Between visits one
mass comes out apart by :math:`\delta \sim N(0, S)`, :math:`S = C_1 + C_2 + s^2 I`: C of the maps' centres, s of the
posture and of touching the landmarks. The probability that one mass comes out as far apart or farther is
:math:`\exp(-\tfrac12 \delta^T S^{-1} \delta)`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from tactile_bayes.geometry import FloatArray
from tactile_bayes.presets import REGISTRATION_MM
from tactile_bayes.records import dataclass

LEAST_PROBABILITY: Final = 0.02
"""One mass in fifty is refused though it is the same."""
CODES: Final = {"subject": "patients", "side": "sides", "mass": "masses"}
"""What scans may say that one mass has only one of, and its name for people."""


@dataclass(frozen=True, slots=True, eq=False)
class Place:
    """Place of a mass at one visit.

    Parameters
    ----------
    centre_mm : (2,) array
        x and y in the patient's frame.
    covariance_mm2 : (2, 2) array
        Of the maps' centres; what posture and landmarks add between visits is no part of it.
    """

    centre_mm: FloatArray
    covariance_mm2: FloatArray

    @classmethod
    def mean_of(cls, places: Sequence[Place]) -> Place | None:
        """Mean place of a visit's maps; None for none."""
        if not places:
            return None
        centre = np.mean([one.centre_mm for one in places], axis=0)
        covariance = np.sum([one.covariance_mm2 for one in places], axis=0) / len(places) ** 2
        return cls(centre, covariance)


@dataclass(frozen=True, slots=True)
class Apart:
    """How far apart the masses of two visits lie.

    Parameters
    ----------
    shift_mm
        From the earlier visit's place to the later one's.
    sd_mm
        Of the distance of one mass between visits, in the direction of the shift.
    probability
        That one mass comes out as far apart or farther.
    """

    shift_mm: tuple[float, float]
    sd_mm: float
    probability: float

    @property
    def distance_mm(self) -> float:
        """Length of the shift."""
        return float(np.hypot(*self.shift_mm))

    @property
    def doubtful(self) -> bool:
        """Whether one mass would come out so far apart in less than `LEAST_PROBABILITY`."""
        return self.probability < LEAST_PROBABILITY

    @property
    def words(self) -> str:
        """Distance with its SD, for people."""
        return f"{self.distance_mm:.0f} mm apart (one mass: SD {self.sd_mm:.0f} mm each way)"


def apart(earlier: Place, later: Place, *, registration_mm: float = REGISTRATION_MM) -> Apart:
    """Compare the places of two visits.

    Parameters
    ----------
    registration_mm
        s, the SD each way of one mass's place between two visits.
    """
    shift = later.centre_mm - earlier.centre_mm
    spread = earlier.covariance_mm2 + later.covariance_mm2 + registration_mm**2 * np.eye(2)
    length = float(np.hypot(*shift))
    along = shift / length if length > 0 else np.array([1.0, 0.0])
    probability = float(np.exp(-0.5 * shift @ np.linalg.solve(spread, shift)))
    return Apart((float(shift[0]), float(shift[1])), float(np.sqrt(along @ spread @ along)), probability)


def contradictions(visits: Sequence[Sequence[Mapping[str, str]]]) -> list[str]:
    """What the scans of all visits contradict each other in, in words; empty where they do not.

    Parameters
    ----------
    visits
        Of each visit what its scans say of the exam, see `files.provenance.EXAM_FACTS`.
    """
    found = []
    for key, plural in CODES.items():
        said: dict[str, int] = {}
        for number, scans in enumerate(visits, start=1):
            for scan in scans:
                if scan.get(key):
                    said.setdefault(scan[key], number)
        if len(said) > 1:
            listed = ", ".join(f"{value} (visit {number})" for value, number in said.items())
            found.append(f"the scans name different {plural}: {listed}")
    return found
