"""Lumps of tissue in a body, as a scene gives them: sizes, depths and stiffness instead of a bump's shape."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

from tactile_bayes.declarations import Meta, Record, check
from tactile_bayes.errors import BadDataError
from tactile_bayes.forward.body import FAT_KPA, GLAND_RATIO, POISSON, THICKNESS_MM

# Default thickness of the fat in a scene without lumps.
PLAIN_FAT_MM = 15.0
# Fat thicknesses that lumps imply may differ by this before they are called different.
_SAME_MM = 0.01
# The skin over a lump, and the tissue under it, as a share of its half height.
_LEAST_COVER = 0.02

Place = Annotated[float, Meta(ge=-500, le=500, description="Centre in the plane, mm.")]
Diameter = Annotated[
    float,
    Meta(
        gt=0,
        le=500,
        description="Diameter, mm. Of a Gaussian lump the declared truth, from which nothing is computed; of tissue "
        "the diameter across the vertical (15).",
    ),
]
Height = Annotated[
    float, Meta(gt=0, le=500, description="Tissue: diameter along the vertical, mm; left out for a ball.")
]
DepthRatio = Annotated[
    float,
    Meta(
        gt=0,
        le=100,
        description="Tissue: h/d, depth of the centre over the diameter; the lump must fit between skin and chest "
        "wall.",
    ),
]
Stiffness = Annotated[
    float, Meta(gt=0, le=1_000_000, description="Tissue: modulus of the lump over that of fat (100).")
]
Seat = Annotated[
    float,
    Meta(
        ge=0,
        le=20,
        description="Tissue: the fat-gland boundary lies at the centre's depth + seat x half the height: 0 through the "
        "centre (centred), 1 under the lowest point; the phantoms' resting lumps have 1.2.",
    ),
]


class SceneBody(Record):
    """Fat over gland on a rigid chest wall, for lumps of tissue."""

    fat_kpa: Annotated[float, Meta(gt=0, le=10_000, description="Young's modulus of fat, kPa.")] = FAT_KPA
    gland_ratio: Annotated[float, Meta(gt=0, le=10_000, description="Modulus of gland over that of fat.")] = GLAND_RATIO
    thickness_mm: Annotated[float, Meta(gt=0, le=500, description="Depth of the chest wall below the skin, mm.")] = (
        THICKNESS_MM
    )
    nu: Annotated[float, Meta(ge=0, lt=0.5, description="Poisson's ratio of everything, lumps included.")] = POISSON
    fat_mm: (
        Annotated[
            float,
            Meta(
                gt=0,
                le=500,
                description="Depth of the boundary between fat and gland, mm. Left out, the lumps' seats decide; 15 mm "
                "without lumps.",
            ),
        ]
        | None
    ) = None


class SolidLump(Record):
    """A lump of stiff or soft tissue: a ball, or with another height a spheroid about the vertical.

    The seat says how far it stands out of the gland; None is 0, or follows from the body's `fat_mm`.
    """

    x_mm: Place = 0.0
    y_mm: Place = 0.0
    d_mm: Diameter = 15.0
    height_mm: Height | None = None
    depth_ratio: DepthRatio = 1.0
    stiffness_ratio: Stiffness = 100.0
    seat: Seat | None = None

    @property
    def depth_mm(self) -> float:
        """Depth h of the centre."""
        return self.depth_ratio * self.d_mm

    @property
    def vertical_mm(self) -> float:
        """Diameter along the vertical."""
        return self.d_mm if self.height_mm is None else self.height_mm


class Rib(Record):
    """A row of stiff balls along x, across the head: what a rib looks like to a map.

    The balls have no seat: the boundary of fat and gland is the lumps' or the body's.
    """

    x_mm: Annotated[float, Meta(ge=-500, le=500, description="Middle of the row in the plane, mm.")] = 0.0
    y_mm: Annotated[float, Meta(ge=-500, le=500, description="Middle of the row in the plane, mm.")] = 26.0
    d_mm: Annotated[float, Meta(gt=0, le=100, description="Diameter of the balls, mm.")] = 12.0
    depth_mm: Annotated[float, Meta(gt=0, le=500, description="Depth of the balls' centres, mm.")] = 12.0
    spacing_mm: Annotated[float, Meta(ge=0.5, le=100, description="From ball to ball, mm; they may overlap.")] = 8.0
    half_length_mm: Annotated[
        float, Meta(gt=0, le=500, description="The outermost balls lie at most this far from the middle, mm.")
    ] = 40.0
    stiffness_ratio: Annotated[
        float, Meta(gt=0, le=1_000_000, description="Modulus of the balls over that of fat.")
    ] = 100.0

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
    check(body, "body")
    for i, lump in enumerate(lumps):
        check(lump, f"lump[{i}]")
        _check_depth(i, lump, body)
    for i, rib in enumerate(ribs):
        check(rib, f"rib[{i}]")
        _check_rib(i, rib, body)
    fat_thickness(body, lumps)


def _check_rib(index: int, rib: Rib, body: SceneBody) -> None:
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
