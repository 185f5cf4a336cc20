"""Shape of a head's sensing face in a few numbers, by which a size calibration knows the maps it was made for."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Final

import numpy as np

from tactile_bayes.declarations import Meta, Record, from_plain, to_plain
from tactile_bayes.errors import BadDataError
from tactile_bayes.geometry import FloatArray
from tactile_bayes.presets import HEAD_COLUMNS, HEAD_PITCH_MM, HEAD_RADIUS_MM, HEAD_ROWS

FLAT_RADIUS_MM: Final = 10_000.0
"""An arc of this radius or more counts as flat: over 40 mm it rises by 0.02 mm."""
# How far a head may depart from a calibration's; see docs/decisions/0101 for what such departures do to sizes.
PITCH_SHARE: Final = 0.03
SIDE_SHARE: Final = 0.08
RISE_MM: Final = 0.3
UNEVEN_MM: Final = 0.1


Count = Annotated[int, Meta(ge=1)]


class HeadShape(Record):
    """Grid and curvature of a scan head's taxels."""

    rows: Annotated[Count, Meta(description="Taxels across the head.")]
    columns: Annotated[Count, Meta(description="Taxels along the head.")]
    pitch_mm: Annotated[float, Meta(gt=0, description="Distance between neighbours, mm.")]
    radius_mm: Annotated[
        float | None,
        Meta(description="Radius of the arc across the head, mm; null where it is flat, negative where it is hollow."),
    ]
    radius_along_mm: Annotated[float | None, Meta(description="The same along the head.")] = None
    uneven_mm: Annotated[
        float, Meta(ge=0, description="Root mean square departure of the taxels from these arcs, mm.")
    ] = 0.0
    rim_mm: Annotated[
        Annotated[float, Meta(ge=0)] | None,
        Meta(description="Radius of the edge around the taxels, which presses and senses nothing; null where unknown."),
    ] = None

    def __post_init__(self) -> None:
        for name in ("radius_mm", "radius_along_mm"):
            if getattr(self, name) == 0:
                raise BadDataError(f"{name} is 0", way_out="give another radius; null is flat")

    @classmethod
    def of(cls, surface_mm: FloatArray, pitch_mm: float, *, rim_mm: float | None = None) -> HeadShape:
        r"""Shape of a head from the places of its taxels.

        Parameters
        ----------
        surface_mm : (rows, columns, 3) array
            Centres in `scanhead`: origin at the apex, z into the tissue.
        pitch_mm
            As stated.

        Notes
        -----
        Least squares of :math:`z = c + s_x x + s_y y - (x^2 + z^2)/(2 R_x) - y^2/(2 R_y)`, which holds to the digit for
        a cylinder, a sphere and a plane, tilted or not.
        """
        x, y, z = (surface_mm[..., i].ravel() for i in range(3))
        terms = np.stack([np.ones_like(x), x, y, -(x * x + z * z) / 2, -(y * y) / 2], axis=1)
        found = np.linalg.lstsq(terms, z, rcond=None)[0]
        uneven = float(np.sqrt(np.mean((terms @ found - z) ** 2)))
        return cls(
            surface_mm.shape[0],
            surface_mm.shape[1],
            round(float(pitch_mm), 4),
            _radius(float(found[3])),
            _radius(float(found[4])),
            round(uneven, 3) + 0.0,
            rim_mm,
        )

    def differences(self, other: HeadShape) -> list[str]:
        """In what another head departs from this one by more than a calibration bears, in words; empty without any."""
        pairs = []
        if not _near(self.pitch_mm, other.pitch_mm, PITCH_SHARE):
            pairs.append(("pitch", f"{self.pitch_mm:g} mm", f"{other.pitch_mm:g} mm"))
        sides = zip(self.sides_mm, other.sides_mm, strict=True)
        if not all(_near(ours, theirs, SIDE_SHARE) for ours, theirs in sides):
            pairs.append(("array", self._array(), other._array()))
        for axis, ours, theirs, side in zip(
            ("across", "along"), self._curvatures(), other._curvatures(), self.sides_mm, strict=True
        ):
            if abs(ours - theirs) * side**2 / 8 > RISE_MM:
                pairs.append((f"face {axis} the head", _arc(ours), _arc(theirs)))
        if abs(self.uneven_mm - other.uneven_mm) > UNEVEN_MM:
            pairs.append(("taxels", f"{self.uneven_mm:g} mm off its arcs", f"{other.uneven_mm:g} mm off its arcs"))
        return [f"{name} {theirs} (the calibration: {ours})" for name, ours, theirs in pairs]

    @property
    def sides_mm(self) -> tuple[float, float]:
        """Width across and length along the head of the sensing area."""
        return (self.rows * self.pitch_mm, self.columns * self.pitch_mm)

    def _array(self) -> str:
        width, length = self.sides_mm
        return f"{self.rows} x {self.columns} taxels ({width:g} x {length:g} mm)"

    def _curvatures(self) -> tuple[float, float]:
        """Across and along, 1/mm."""
        across, along = (0.0 if radius is None else 1.0 / radius for radius in (self.radius_mm, self.radius_along_mm))
        return across, along

    def __str__(self) -> str:
        """The head in a few words."""
        parts = [f"{self.rows} x {self.columns} taxels", f"{self.pitch_mm:g} mm apart"]
        across, along = self._curvatures()
        parts.append(_arc(across) if across else "flat")
        parts += [f"{_arc(along)} along it"] if along else []
        parts += [f"{self.uneven_mm:g} mm off its arcs"] if self.uneven_mm >= UNEVEN_MM else []
        parts += [f"rim {self.rim_mm:g} mm"] if self.rim_mm is not None else []
        return ", ".join(parts)

    def as_dict(self) -> dict[str, Any]:
        """Plain data for files."""
        return dict(to_plain(self, digits=17))

    @classmethod
    def from_document(cls, document: Mapping[str, Any]) -> HeadShape:
        """Undo `as_dict`, checking everything.

        Raises
        ------
        BadDataError
            When a value cannot be that of a head.
        """
        try:
            return from_plain(cls, dict(document))
        except BadDataError as error:
            raise BadDataError(f"head.{error.what}", way_out=error.way_out) from None


DEFAULT_HEAD: Final = HeadShape(HEAD_ROWS, HEAD_COLUMNS, HEAD_PITCH_MM, HEAD_RADIUS_MM)
"""That of the paper and of the shipped calibrations."""


def _radius(curvature: float) -> float | None:
    return None if abs(curvature) * FLAT_RADIUS_MM <= 1 else round(1 / curvature, 2)


def _near(ours: float, theirs: float, share: float) -> bool:
    return abs(theirs / ours - 1) <= share + 1e-9


def _arc(curvature: float) -> str:
    return f"on an arc of {1 / curvature:.3g} mm" if curvature else "flat"
