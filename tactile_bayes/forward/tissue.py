"""Bodies, their tissues and lumps, of which scenes are made."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

from tactile_bayes.declarations import Meta, Record, check_record, described, set_fields
from tactile_bayes.errors import BadDataError, require
from tactile_bayes.presets import FAT_KPA, GLAND_RATIO, POISSON, THICKNESS_MM

# --- The layered breast model: fat over gland over a rigid chest wall, with a circular lump at or above their boundary.

LEAST_DEPTH_RATIO = 0.52
MOST_SEAT = 2.0
LEAST_MM, MOST_MM = 0.1, 1e4  #: Limits of lumps and layers that a mesh can resolve.
_RESTS = 1e-4  #: Depth in the gland, in radii, below which a lump rests on it: the mesh's nodes would coincide.
_THINNEST_FILM = 0.01  #: Thickness of fat under the lump, in radii, below which there is none: no element is as thin.
SEATS = {"centred": 0.0, "resting": 1.0}  #: The lump's centre lies on the fat-gland boundary, or it only touches it.


class Layers(Record):
    """The layered body without a lump."""

    fat_mm: float  #: Depth of the fat-gland boundary.
    thickness_mm: float = THICKNESS_MM  #: Depth of the rigid chest wall, to which the gland is bonded.
    fat_kpa: float = FAT_KPA
    gland_ratio: float = GLAND_RATIO  #: Young's modulus of gland over that of fat.
    poisson: float = POISSON  #: Of all tissues, at least 0 and below 0.5.

    def __post_init__(self) -> None:
        rule = f"be above 0 and below {self.thickness_mm:g}"
        require(0 < self.fat_mm < self.thickness_mm, "fat_mm", self.fat_mm, rule)
        require(self.thickness_mm < MOST_MM, "thickness_mm", self.thickness_mm, f"be below {MOST_MM:g}")
        require(self.fat_kpa > 0, "fat_kpa", self.fat_kpa, "be above 0")
        require(self.gland_ratio > 0, "gland_ratio", self.gland_ratio, "be above 0")
        require(0 <= self.poisson < 0.5, "poisson", self.poisson, "be at least 0 and below 0.5")


class Body(Record):
    """Three layers with a circular lump, without its stiffness.

    Wellman & Howe (1999) section 2.2: fat of 5 kPa, gland ten times as stiff, a rigid chest wall, plane strain.
    """

    d_mm: float
    depth_ratio: float
    """h/d: depth of the lump's centre below the skin over its diameter, at least 0.52 (at 0.5 it touches the skin)."""
    seat: float = 0.0
    """Height of the lump out of the gland, 0 to 2: the fat-gland boundary lies at depth ``h + seat d/2``, through the
    lump's centre at 0 (centred), under its lowest point at 1 (resting, the lump wholly in the fat). From 1e-4 below 1
    to 0.01 above it, it is 1."""
    thickness_mm: float | None = None
    """Depth of the chest wall; None takes 70 mm, or 2 mm below ``h + 0.6 d`` and below the fat where that is deeper."""
    fat_kpa: float = FAT_KPA
    gland_ratio: float = GLAND_RATIO
    poisson: float = POISSON

    def __post_init__(self) -> None:
        require(LEAST_MM <= self.d_mm < MOST_MM, "d_mm", self.d_mm, f"be at least {LEAST_MM:g} and below {MOST_MM:g}")
        rule = f"be at least {LEAST_DEPTH_RATIO:g}: the skin over the lump is too thin to be resolved, or there is none"
        require(LEAST_DEPTH_RATIO <= self.depth_ratio < 1e4, "depth_ratio", self.depth_ratio, rule)
        rule = f"be between 0 (centred) and {MOST_SEAT:g}; 1 is resting"
        require(0 <= self.seat <= MOST_SEAT, "seat", self.seat, rule)
        if 1.0 - _RESTS < self.seat < 1.0 + _THINNEST_FILM:
            set_fields(self, seat=1.0)
        if self.thickness_mm is None:
            deep = self.centre_mm + max(0.6, 0.5 * self.seat) * self.d_mm + 2.0
            set_fields(self, thickness_mm=max(THICKNESS_MM, deep))
        bottom = self.centre_mm + self.radius_mm
        thickness, rule = self.layers.thickness_mm, f"be above {bottom:g} mm, the depth of the lump's lowest point"
        require(thickness > 1.0001 * bottom, "thickness_mm", thickness, rule)

    @property
    def centre_mm(self) -> float:
        """Depth h of the lump's centre."""
        return self.depth_ratio * self.d_mm

    @property
    def radius_mm(self) -> float:
        """Half the diameter."""
        return 0.5 * self.d_mm

    @property
    def layers(self) -> Layers:
        """The body without the lump."""
        assert self.thickness_mm is not None
        fat = self.centre_mm + self.seat * self.radius_mm
        return Layers(fat, self.thickness_mm, self.fat_kpa, self.gland_ratio, self.poisson)


def parse_seat(text: str) -> float:
    """Seat from ``centred``, ``resting`` or a number from 0 to 2."""
    try:
        seat = SEATS[text] if text in SEATS else float(text)
    except ValueError:
        seat = -1.0
    if not 0 <= seat <= MOST_SEAT:
        raise BadDataError(f"seat is {text!r}", way_out=f"give centred, resting or a number from 0 to {MOST_SEAT:g}")
    return seat


# --- Lumps of tissue in a body, as a scene gives them: sizes, depths and stiffness instead of a bump's shape.

PLAIN_FAT_MM = 15.0  #: Default thickness of the fat in a scene without lumps.
_SAME_MM = 0.01  #: Fat thicknesses that lumps imply may differ by this before they are called different.
_LEAST_COVER = 0.02  #: The skin over a lump, and the tissue under it, as a share of its half height.

Place = Annotated[float, described("Centre in the plane, mm.", ge=-500, le=500)]
Diameter = Annotated[
    float,
    described(
        "Diameter, mm. Of a Gaussian lump the declared truth, from which nothing is computed; of tissue "
        "the diameter across the vertical (15).",
        gt=0,
        le=500,
    ),
]
Height = Annotated[float, described("Tissue: diameter along the vertical, mm; left out for a ball.", gt=0, le=500)]
DepthRatio = Annotated[
    float,
    described(
        "Tissue: h/d, depth of the centre over the diameter; the lump must fit between skin and chest wall.",
        gt=0,
        le=100,
    ),
]
Stiffness = Annotated[float, described("Tissue: modulus of the lump over that of fat (100).", gt=0, le=1_000_000)]
Seat = Annotated[
    float,
    described(
        "Tissue: the fat-gland boundary lies at the centre's depth + seat x half the height: 0 through the "
        "centre (centred), 1 under the lowest point; the phantoms' resting lumps have 1.2.",
        ge=0,
        le=20,
    ),
]


class SceneBody(Record):
    """Fat over gland on a rigid chest wall, for lumps of tissue."""

    fat_kpa: Annotated[float, Meta(gt=0, le=10_000)] = FAT_KPA  #: Young's modulus of fat, kPa.
    gland_ratio: Annotated[float, Meta(gt=0, le=10_000)] = GLAND_RATIO  #: Modulus of gland over that of fat.
    thickness_mm: Annotated[float, Meta(gt=0, le=500)] = THICKNESS_MM  #: Depth of the chest wall below the skin, mm.
    nu: Annotated[float, Meta(ge=0, lt=0.5)] = POISSON  #: Poisson's ratio of everything, lumps included.
    fat_mm: Annotated[float, Meta(gt=0, le=500)] | None = None
    """Depth of the boundary between fat and gland, mm. Left out, the lumps' seats decide; 15 mm without lumps."""


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

    x_mm: Annotated[float, Meta(ge=-500, le=500)] = 0.0  #: Middle of the row in the plane, mm.
    y_mm: Annotated[float, Meta(ge=-500, le=500)] = 26.0  #: Middle of the row in the plane, mm.
    d_mm: Annotated[float, Meta(gt=0, le=100)] = 12.0  #: Diameter of the balls, mm.
    depth_mm: Annotated[float, Meta(gt=0, le=500)] = 12.0  #: Depth of the balls' centres, mm.
    spacing_mm: Annotated[float, Meta(ge=0.5, le=100)] = 8.0  #: From ball to ball, mm; they may overlap.
    half_length_mm: Annotated[float, Meta(gt=0, le=500)] = 40.0
    """The outermost balls lie at most this far from the middle, mm."""
    stiffness_ratio: Annotated[float, Meta(gt=0, le=1_000_000)] = 100.0  #: Modulus of the balls over that of fat.

    def balls(self) -> tuple[SolidLump, ...]:
        """The row's balls as lumps."""
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


MOST_BALLS = 60  #: Every ball is solved for in every frame.


def fat_thickness(body: SceneBody, lumps: Sequence[SolidLump]) -> float:
    """Depth of the fat-gland boundary in the scene, checked against every lump."""
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
    """Raise an error for an impossible body, naming the key, its value and the allowed range."""
    check_record(body, "body")
    for i, lump in enumerate(lumps):
        check_record(lump, f"lump[{i}]")
        half = (1.0 + _LEAST_COVER) * lump.vertical_mm / 2
        least, most = half / lump.d_mm, (body.thickness_mm - half) / lump.d_mm
        if least > most:
            room = f"the body has {body.thickness_mm:g} mm of room"
            raise BadDataError(f"lump[{i}] is {lump.vertical_mm:g} mm high", way_out=room)
        key = f"lump[{i}].depth_ratio"
        _check_room(key, lump.depth_ratio, (least, most), "the lump", " for this size and body")
    for i, rib in enumerate(ribs):
        check_record(rib, f"rib[{i}]")
        half = (1.0 + _LEAST_COVER) * rib.d_mm / 2
        ends = half, body.thickness_mm - half
        _check_room(f"rib[{i}].depth_mm", rib.depth_mm, ends, "the rib", " mm for this diameter and body")
        count = 2 * int(rib.half_length_mm / rib.spacing_mm + 1e-9) + 1
        if count > MOST_BALLS:
            way_out = f"give spacing_mm or half_length_mm for {MOST_BALLS} or fewer"
            raise BadDataError(f"rib[{i}] is a row of {count} balls", way_out=way_out)
    fat_thickness(body, lumps)


def _check_room(key: str, depth: float, ends: tuple[float, float], name: str, rule: str) -> None:
    """Refuse a depth outside its ends, at which the named thing stands out of the body."""
    least, most = ends
    if not least <= depth <= most:
        out = "stands out of the skin" if depth < least else "reaches into the chest wall"
        way_out = f"it must lie in {least:.4g} to {most:.4g}{rule}"
        raise BadDataError(f"{key} is {depth:g}: {name} {out}", way_out=way_out)
