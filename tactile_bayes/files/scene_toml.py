"""Scenes as TOML."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Final

from tactile_bayes.declarations import Meta, Record, as_dict, field, from_plain, names_of, says
from tactile_bayes.errors import BadDataError, in_file
from tactile_bayes.files.documents import parse_toml
from tactile_bayes.files.reading import TOML_BYTES, read_text
from tactile_bayes.forward.scene import (
    Background,
    Head,
    Lump,
    Noise,
    Scene,
    SceneLandmarks,
    Strokes,
    Taxels,
    Timing,
    Tracker,
)
from tactile_bayes.forward.tissue import DepthRatio, Height, Rib, SceneBody, Seat, SolidLump, Stiffness

# A lump with one of the first is tissue; only a Gaussian one may have the others.
_OF_TISSUE: Final = ("depth_ratio", "stiffness_ratio", "seat", "height_mm")
_OF_BUMPS: Final = ("amplitude", "sigma_x_mm", "sigma_y_mm", "angle_deg")


class LumpTable(Lump):
    """One lump."""

    height_mm: Height | None = None
    depth_ratio: DepthRatio | None = None
    stiffness_ratio: Stiffness | None = None
    seat: Seat | None = None


class SceneFile(Record):
    """Scene of a simulated scan.

    The TOML document `simulate` reads. Everything may be left out. Units are in the keys; lumps and landmarks lie in
    the scene's plane: origin at the centre of the strokes, x along them (across the head), y along the head, z into the
    tissue.
    """

    scene: Timing = field(default_factory=Timing)  #: Length and rates.
    background: Background = field(default_factory=Background)
    """Mean pressure away from lumps, against time."""
    body: SceneBody | None = None
    lump: Annotated[tuple[LumpTable, ...], Meta(max_length=100)] = ()
    """Lumps: either Gaussian rises of the normalised pressure (amplitude, sigma), or tissue (d_mm, depth_ratio)."""
    rib: Annotated[
        tuple[Annotated[Rib, says("One rib.")], ...],
        says("Ribs for the solid model: rows of stiff balls along x, across the head.", max_length=10),
    ] = ()
    strokes: Strokes = field(default_factory=Strokes)
    """Back and forth across the head, line after line along it."""
    head: Head = field(default_factory=Head)  #: A section of a circular cylinder.
    noise: Noise = field(default_factory=Noise)  #: Standard deviations of everything random.
    tracker: Tracker = field(default_factory=Tracker)
    """Where the tracker's base stands and how its sensor sits in the handle."""
    taxels: Taxels = field(default_factory=Taxels)  #: Faulty elements as [row, column] from 0.
    landmarks: SceneLandmarks = field(default_factory=SceneLandmarks)
    """Points touched before the scan, in the plane."""


def read_scene(path: Path) -> Scene:
    """Read a scene; missing keys take their defaults."""
    text = read_text(path, most=TOML_BYTES, way_out="give a scene as TOML")
    with in_file(path):
        return scene_from_toml(text)


def scene_from_toml(text: str) -> Scene:
    """Parse a scene from a TOML text; for the errors see `read_scene`."""
    return scene_of(parse_toml(text, way_out="see the scene in the documentation"))


def scene_of(document: Mapping[str, Any]) -> Scene:
    """A scene from plain data as its TOML holds; for the errors see `read_scene`."""
    file = from_plain(SceneFile, document)
    given = {name: getattr(file, name) for name in names_of(file)}
    bumps, tissue = _lumps(given.pop("lump"), document.get("lump", ()))
    return Scene(**as_dict(given.pop("scene")), lumps=bumps, solid_lumps=tissue, ribs=given.pop("rib"), **given)


def _lumps(
    tables: Sequence[LumpTable], given: Sequence[Mapping[str, Any]]
) -> tuple[tuple[Lump, ...], tuple[SolidLump, ...]]:
    """Lumps that are bumps, and lumps that are tissue, by the keys that the file gives."""
    bumps, tissue = [], []
    for i, (table, keys) in enumerate(zip(tables, given, strict=True)):
        values = {key: getattr(table, key) for key in keys}
        solid = [key for key in _OF_TISSUE if key in keys]
        both = [key for key in _OF_BUMPS if key in keys]
        if solid and both:
            what = f"lump[{i}] gives {both[0]}, of a bump, and {solid[0]}, of tissue"
            raise BadDataError(what, way_out=f"leave out {', '.join(both)} or {', '.join(solid)}")
        if not solid:
            bumps.append(Lump(**values))
            continue
        for key in ("d_mm", "depth_ratio"):
            if key not in keys:
                raise BadDataError(f"lump[{i}] gives no {key}", way_out=f"a lump of tissue with {solid[0]} needs it")
        tissue.append(SolidLump(**values))
    return tuple(bumps), tuple(tissue)
