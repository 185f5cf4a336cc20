"""The homogeneous-pressure condition of section 2.1: how evenly a head presses on tissue without layers or lump.

The paper's finite elements find the pressure across its indentor within 7.5 % of the mean, for moduli of 15-25 kPa
under mean pressures of 5-14 kPa, and say neither the radius of the head nor the thickness of the tissue. The model is
linear, so that only the ratio of mean pressure to modulus matters.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tactile_bayes.declarations import Record
from tactile_bayes.errors import BadDataError
from tactile_bayes.forward.body import POISSON, THICKNESS_MM, Layers
from tactile_bayes.forward.contact import Head
from tactile_bayes.forward.line import press_layers
from tactile_bayes.geometry import FloatArray
from tactile_bayes.presets import HEAD_PITCH_MM, HEADS, SHOULDERS_INSIDE

PAPER_MODULI_KPA = (15.0, 25.0)
"""Young's modulus of normal breast tissue, section 2.1."""
PAPER_PRESSURES_KPA = (5.0, 14.0)
"""Anticipated user-applied pressures, section 2.1."""
RADII_MM = (13.0, 16.0, 20.0, 25.0, 30.0, 35.0, 45.0, 60.0, 70.0, 80.0, 100.0, 150.0, 300.0, np.inf)
SHOULDERS_MM = (0.0, 1.0, 2.0, 3.0, 4.0, 6.0, 8.0, 10.0, 12.0, 15.0, 20.0)
# Contact cells: three a taxel. Six change the departure of a head that meets the limit by less than 0.001.
_CELL_MM = 0.5


class HomogeneousTissue(Record):
    """Tissue and pressures over which a head should press evenly.

    Raises
    ------
    BadDataError
        When a range runs backwards or is not above 0.
    """

    young_kpa: tuple[float, float] = PAPER_MODULI_KPA
    mean_kpa: tuple[float, float] = PAPER_PRESSURES_KPA
    """`young_kpa`, `mean_kpa`: Lowest and highest Young's modulus, and lowest and highest mean pressure over the
    sensing width.
    """
    thickness_mm: float = THICKNESS_MM
    """Of the tissue, bonded to a rigid base."""
    poisson: float = POISSON
    """Poisson's ratio."""

    def __post_init__(self) -> None:
        for name in ("young_kpa", "mean_kpa"):
            low, high = getattr(self, name)
            if not 0 < low <= high < np.inf:
                raise BadDataError(
                    f"{name} is {low:g} to {high:g}", way_out="give two numbers above 0, the lower first"
                )

    @property
    def moduli_kpa(self) -> FloatArray:
        """(3,) both ends and the middle."""
        return np.linspace(*self.young_kpa, 3)

    @property
    def pressures_kpa(self) -> FloatArray:
        """(3,) both ends and the middle."""
        return np.linspace(*self.mean_kpa, 3)

    def frames(self, head: Head, *, cell_mm: float = _CELL_MM) -> tuple[FloatArray, FloatArray]:
        """Taxel positions (n,) in mm, and pressure over its mean (3, 3, n) for each modulus and each mean pressure."""
        # Halving the thickness into two equal layers is the homogeneous body.
        layers = Layers(0.5 * self.thickness_mm, self.thickness_mm, 1.0, 1.0, self.poisson)
        strain = self.pressures_kpa[None, :] / self.moduli_kpa[:, None]
        frames = press_layers(layers, head=head, mean_kpa=strain.ravel(), cell_mm=cell_mm).as_taxels(HEAD_PITCH_MM)
        share = frames.pressure_kpa / frames.pressure_kpa.mean(axis=1, keepdims=True)
        return frames.s_mm, share.reshape(3, 3, -1)


class Uniformity(Record, eq=False):
    """How evenly one head presses."""

    head: Head
    """Its section."""
    s_mm: FloatArray
    """(n,) array: Taxel positions across the head."""
    share: FloatArray
    """(3, 3, n) array: Pressure over the frame's mean, for each modulus and each mean pressure."""

    @property
    def largest(self) -> FloatArray:
        """(3, 3) largest departure of a taxel from the mean of its frame, as a share of it."""
        return np.asarray(np.abs(self.share - 1.0).max(axis=-1))

    @property
    def rms(self) -> FloatArray:
        """(3, 3) root mean square departure."""
        return np.asarray(np.sqrt(np.mean((self.share - 1.0) ** 2, axis=-1)))

    @property
    def worst(self) -> float:
        """The largest departure over all moduli and pressures."""
        return float(self.largest.max())

    @property
    def worst_rms(self) -> float:
        """The largest root mean square departure over all moduli and pressures."""
        return float(self.rms.max())

    @property
    def face_mm(self) -> float:
        """Width of the rigid face, shoulders included."""
        return 2 * self.head.half_face_mm


def uniformity(head: Head, tissue: HomogeneousTissue) -> Uniformity:
    """How evenly a head presses on homogeneous tissue."""
    return Uniformity(head, *tissue.frames(head))


def search_heads(
    tissue: HomogeneousTissue,
    *,
    kinds: Sequence[str] = HEADS,
    radii_mm: Sequence[float] = RADII_MM,
    shoulders_mm: Sequence[float] = SHOULDERS_MM,
) -> list[Uniformity]:
    """Uniformity of every head of a grid of radii and shoulders; sections that cannot be are left out.

    Parameters
    ----------
    kinds
        Some of `presets.HEADS`: where the shoulders lie.
    radii_mm, shoulders_mm
        Radii of the arc and of the shoulders.
    """
    found = []
    for kind in kinds:
        for radius in radii_mm:
            widest = Head().half_width_mm if kind == SHOULDERS_INSIDE else radius
            found += [
                uniformity(Head(radius_mm=radius, shoulder_mm=shoulder, shoulders=kind), tissue)
                for shoulder in shoulders_mm
                if shoulder < widest
            ]
    return found


def most_even(found: Sequence[Uniformity]) -> Uniformity:
    """The head with the least of the largest departures."""
    return min(found, key=lambda one: one.worst)


def narrowest(found: Sequence[Uniformity], *, limit: float, by_rms: bool = False) -> Uniformity | None:
    """Of the heads within `limit`, the one with the narrowest face, and of those the most even; None without any.

    Parameters
    ----------
    limit
        Largest allowed departure, as a share of the mean.
    by_rms
        Hold the root mean square departure to it, not the largest: another reading of the paper's "variation".
    """
    departure = {id(one): one.worst_rms if by_rms else one.worst for one in found}
    within = [one for one in found if departure[id(one)] <= limit]
    return min(within, key=lambda one: (round(one.face_mm, 6), departure[id(one)]), default=None)
