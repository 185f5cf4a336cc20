"""Lumps of tissue in a body, as a scene gives them: sizes, depths and stiffness instead of a bump's shape."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from tactile_bayes.errors import BadDataError
from tactile_bayes.forward.body import FAT_KPA, GLAND_RATIO, POISSON, THICKNESS_MM

# Default thickness of the fat in a scene without lumps.
PLAIN_FAT_MM = 15.0
# Fat thicknesses that lumps imply may differ by this before they are called different.
_SAME_MM = 0.01
# The skin over a lump, and the tissue under it, as a share of its half height.
_LEAST_COVER = 0.02


@dataclass(frozen=True, slots=True)
class SceneBody:
    """Fat over gland on a rigid chest wall.

    Parameters
    ----------
    fat_kpa
        Young's modulus of fat.
    gland_ratio
        That of gland over that of fat.
    thickness_mm
        Depth of the chest wall below the skin.
    nu
        Poisson's ratio of everything, lumps included; below 0.5.
    fat_mm
        Depth of the boundary between fat and gland; None lets the lumps' seats decide (15 mm without lumps).
    """

    fat_kpa: float = FAT_KPA
    gland_ratio: float = GLAND_RATIO
    thickness_mm: float = THICKNESS_MM
    nu: float = POISSON
    fat_mm: float | None = None


@dataclass(frozen=True, slots=True)
class SolidLump:
    """A lump of stiff or soft tissue: a ball, or with another height a spheroid about the vertical.

    Parameters
    ----------
    x_mm, y_mm
        Place of its vertical axis in the scene's `plane`.
    d_mm
        Diameter across the vertical.
    height_mm
        Diameter along the vertical; None for `d_mm`.
    depth_ratio
        h/d: depth of its centre over `d_mm`.
    stiffness_ratio
        Its modulus over that of fat.
    seat
        How far it stands out of the gland: the boundary lies at ``h + seat * height / 2``, through the centre at 0
        (centred), under the lowest point at 1, below it from there on. The phantoms' "resting" lumps, a tenth of their
        diameter above the gland, have 1.2. None is 0, or follows from the body's `fat_mm`.
    """

    x_mm: float = 0.0
    y_mm: float = 0.0
    d_mm: float = 15.0
    height_mm: float | None = None
    depth_ratio: float = 1.0
    stiffness_ratio: float = 100.0
    seat: float | None = None

    @property
    def depth_mm(self) -> float:
        """Depth h of the centre."""
        return self.depth_ratio * self.d_mm

    @property
    def vertical_mm(self) -> float:
        """Diameter along the vertical."""
        return self.d_mm if self.height_mm is None else self.height_mm


@dataclass(frozen=True, slots=True)
class Rib:
    """A row of stiff balls along x, across the head: what a rib looks like to a map.

    Parameters
    ----------
    x_mm, y_mm
        Middle of the row in the scene's `plane`.
    d_mm, depth_mm
        Diameter of the balls, and the depth of their centres. The balls have no seat: the boundary of fat and gland is
        the lumps' or the body's.
    spacing_mm
        From ball to ball; they may overlap.
    half_length_mm
        The row's outermost balls lie at most this far from its middle.
    stiffness_ratio
        Their modulus over that of fat.
    """

    x_mm: float = 0.0
    y_mm: float = 26.0
    d_mm: float = 12.0
    depth_mm: float = 12.0
    spacing_mm: float = 8.0
    half_length_mm: float = 40.0
    stiffness_ratio: float = 100.0

    def balls(self) -> tuple[SolidLump, ...]:
        """The row as lumps."""
        each_side = int(self.half_length_mm / self.spacing_mm + 1e-9)
        ratio = self.depth_mm / self.d_mm
        return tuple(
            SolidLump(
                x_mm=self.x_mm + i * self.spacing_mm,
                y_mm=self.y_mm,
                d_mm=self.d_mm,
                depth_ratio=ratio,
                stiffness_ratio=self.stiffness_ratio,
            )
            for i in range(-each_side, each_side + 1)
        )


# Every ball is solved for in every frame.
MOST_BALLS = 60


def fat_thickness(body: SceneBody, lumps: Sequence[SolidLump]) -> float:
    """Depth of the fat-gland boundary in the scene, checked against every lump.

    Raises
    ------
    BadDataError
        Naming the key when lumps imply different boundaries, or one that is not in the body.
    """
    implied = [
        lump.depth_mm + (lump.seat or 0.0) * lump.vertical_mm / 2
        for lump in lumps
        if body.fat_mm is None or lump.seat is not None
    ]
    fat = body.fat_mm if body.fat_mm is not None else implied[0] if implied else PLAIN_FAT_MM
    for i, other in enumerate(implied):
        if abs(other - fat) > _SAME_MM:
            source = "body.fat_mm" if body.fat_mm is not None else "lump[0]"
            raise BadDataError(
                f"lump[{i}] puts the gland {other:g} mm deep, {source} puts it {fat:g} mm deep",
                way_out="one body has one boundary: give body.fat_mm and leave out every seat",
            )
    if not fat < body.thickness_mm:
        key = "body.fat_mm" if body.fat_mm is not None else "lump[0].seat" if implied else "body.thickness_mm"
        raise BadDataError(
            f"{key} puts the gland {fat:g} mm deep, at or below the chest wall",
            way_out=f"it must lie above body.thickness_mm, {body.thickness_mm:g} mm",
        )
    return fat


def check_solid(body: SceneBody, lumps: Sequence[SolidLump], ribs: Sequence[Rib] = ()) -> None:
    """Raise an error for an impossible body, naming the key, its value and the allowed range.

    Raises
    ------
    BadDataError
    """
    for name in ("fat_kpa", "gland_ratio", "thickness_mm", "fat_mm"):
        value = getattr(body, name)
        if value is not None:
            _above_zero(f"body.{name}", value)
    if not 0 <= body.nu < 0.5:
        raise BadDataError(f"body.nu is {body.nu}", way_out="it must be at least 0, below 0.5")
    for i, lump in enumerate(lumps):
        for name in ("d_mm", "height_mm", "depth_ratio", "stiffness_ratio"):
            value = getattr(lump, name)
            if value is not None:
                _above_zero(f"lump[{i}].{name}", value)
        if lump.seat is not None and not lump.seat >= 0:
            raise BadDataError(f"lump[{i}].seat is {lump.seat}", way_out="it must be at least 0")
        _check_depth(i, lump, body)
    for i, rib in enumerate(ribs):
        _check_rib(i, rib, body)
    fat_thickness(body, lumps)


def _check_rib(index: int, rib: Rib, body: SceneBody) -> None:
    for name in ("d_mm", "depth_mm", "spacing_mm", "half_length_mm", "stiffness_ratio"):
        _above_zero(f"rib[{index}].{name}", getattr(rib, name))
    half = (1.0 + _LEAST_COVER) * rib.d_mm / 2
    if not half <= rib.depth_mm <= body.thickness_mm - half:
        where = "stands out of the skin" if rib.depth_mm < half else "reaches into the chest wall"
        raise BadDataError(
            f"rib[{index}].depth_mm is {rib.depth_mm:g}: the rib {where}",
            way_out=f"it must lie in {half:.4g} to {body.thickness_mm - half:.4g} mm for this diameter and body",
        )
    count = 2 * int(rib.half_length_mm / rib.spacing_mm + 1e-9) + 1
    if count > MOST_BALLS:
        raise BadDataError(
            f"rib[{index}] is a row of {count} balls",
            way_out=f"give spacing_mm or half_length_mm for {MOST_BALLS} or fewer",
        )


def _check_depth(index: int, lump: SolidLump, body: SceneBody) -> None:
    half = (1.0 + _LEAST_COVER) * lump.vertical_mm / 2
    least, most = half / lump.d_mm, (body.thickness_mm - half) / lump.d_mm
    if least <= lump.depth_ratio <= most:
        return
    where = "stands out of the skin" if lump.depth_ratio < least else "reaches into the chest wall"
    if least > most:
        raise BadDataError(
            f"lump[{index}] is {lump.vertical_mm:g} mm high", way_out=f"the body has {body.thickness_mm:g} mm of room"
        )
    raise BadDataError(
        f"lump[{index}].depth_ratio is {lump.depth_ratio:g}: the lump {where}",
        way_out=f"it must lie in {least:.4g} to {most:.4g} for this size and body",
    )


def _above_zero(name: str, value: float) -> None:
    if not value > 0:
        raise BadDataError(f"{name} is {value:g}", way_out="it must be above 0")
