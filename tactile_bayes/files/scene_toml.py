"""Scenes as TOML: units in the keys, defaults and ranges in one schema, one error line per mistake."""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, Final

from tactile_bayes.errors import BadDataError
from tactile_bayes.files.documents import load_schema, parse_toml
from tactile_bayes.files.reading import TOML_BYTES, read_text
from tactile_bayes.forward.scene import Background, Head, Lump, Noise, Scene, SceneLandmarks, Strokes, Taxels, Tracker
from tactile_bayes.forward.tissue import Rib, SceneBody, SolidLump

_SCHEMA: Final = "scene.schema.json"
# A lump with one of the first is tissue; only a Gaussian one may have the others.
_OF_TISSUE: Final = ("depth_ratio", "stiffness_ratio", "seat", "height_mm")
_OF_BUMPS: Final = ("amplitude", "sigma_x_mm", "sigma_y_mm", "angle_deg")
_TYPES: Final = {
    "number": "a number",
    "integer": "a whole number",
    "boolean": "true or false",
    "array": "a list",
    "object": "a table",
}


def read_scene(path: Path) -> Scene:
    """Read a scene; missing keys take the defaults of ``scene.schema.json``.

    Raises
    ------
    BadDataError
        Naming the file, the key, its value and what is allowed.
    """
    text = read_text(path, most=TOML_BYTES, way_out="give a scene as TOML")
    try:
        return scene_from_toml(text)
    except BadDataError as error:
        raise error.at(path) from None


def scene_from_toml(text: str) -> Scene:
    """Parse a scene from a TOML text; for the errors see `read_scene`."""
    document = parse_toml(text, way_out="see the scene in the documentation")
    _check(document)
    return _scene(document)


def _check(document: dict[str, Any]) -> None:
    import fastjsonschema

    try:
        _validator()(document)
    except fastjsonschema.JsonSchemaValueException as error:
        raise _told(error) from None


@cache
def _validator() -> Any:
    import fastjsonschema

    return fastjsonschema.compile(load_schema(_SCHEMA), use_default=False)


def _told(error: Any) -> BadDataError:
    """Error line for a broken rule of the schema."""
    where, value, rule = _where(error.path[1:]), error.value, error.definition
    if error.rule == "additionalProperties":
        return _unknown_key(where, value, rule)
    if error.rule == "type":
        kind = _TYPES.get(rule["type"], rule["type"])
        return BadDataError(f"{where} is {_short(value)}", way_out=f"it must be {kind}{_range(rule)}")
    if error.rule in ("minItems", "maxItems"):
        low, high = rule.get("minItems", 0), rule.get("maxItems")
        wanted = f"{low}" if low == high else f"{low} to {high}"
        return BadDataError(f"{where} has {len(value)} entries", way_out=f"it must have {wanted}")
    return BadDataError(f"{where} is {_short(value)}", way_out=f"it must be {_TYPES[rule['type']]}{_range(rule)}")


def _where(path: list[Any]) -> str:
    text = ""
    for part in path:
        text += f"[{part}]" if str(part).isdigit() else f".{part}" if text else str(part)
    return text


def _short(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


def _range(rule: Mapping[str, Any]) -> str:
    """Allowed range in words: " above 0, at most 600"."""
    words = []
    for key, word in (
        ("minimum", "at least"),
        ("exclusiveMinimum", "above"),
        ("maximum", "at most"),
        ("exclusiveMaximum", "below"),
    ):
        if key in rule:
            words.append(f"{word} {rule[key]:g}")
    return " " + ", ".join(words) if words else ""


def _unknown_key(where: str, table: Mapping[str, Any], rule: Mapping[str, Any]) -> BadDataError:
    known = list(rule["properties"])
    key = next(name for name in table if name not in known)
    full = f"{where}.{key}" if where else key
    stem = _stem(key)
    other_unit = [name for name in known if _stem(name) == stem]
    if other_unit:
        return BadDataError(f"{full} is not known", way_out=f"give {other_unit[0]}, in the unit it names")
    close = difflib.get_close_matches(key, known, n=1) or [name for name in known if name.startswith(key)][:1]
    hint = f"did you mean {close[0]}?" if close else f"known are {', '.join(known)}"
    return BadDataError(f"{full} is not known", way_out=hint)


def _stem(key: str) -> str:
    """Key without its unit: ``x_cm`` and ``x_mm`` are one quantity."""
    stem, _, unit = key.rpartition("_")
    units = {"mm", "cm", "m", "um", "in", "kpa", "pa", "mpa", "psi", "s", "ms", "us", "min", "hz", "khz", "deg", "rad"}
    return stem if stem and unit.lower() in units else key


def _scene(document: Mapping[str, Any]) -> Scene:
    taxels = document.get("taxels", {})
    bumps, tissue = _lumps(document.get("lump", []))
    return Scene(
        **document.get("scene", {}),
        background=Background(**document.get("background", {})),
        lumps=bumps,
        body=SceneBody(**document["body"]) if "body" in document else None,
        solid_lumps=tissue,
        ribs=tuple(Rib(**table) for table in document.get("rib", [])),
        strokes=Strokes(**document.get("strokes", {})),
        head=Head(**document.get("head", {})),
        noise=Noise(**document.get("noise", {})),
        tracker=Tracker(**_tuples(document.get("tracker", {}))),
        taxels=Taxels(**{kind: tuple((row, column) for row, column in pairs) for kind, pairs in taxels.items()}),
        landmarks=SceneLandmarks(**_tuples(document.get("landmarks", {}))),
    )


def _lumps(tables: Sequence[Mapping[str, Any]]) -> tuple[tuple[Lump, ...], tuple[SolidLump, ...]]:
    """Lumps that are bumps, and lumps that are tissue."""
    bumps, tissue = [], []
    for i, table in enumerate(tables):
        solid = [key for key in _OF_TISSUE if key in table]
        both = [key for key in _OF_BUMPS if key in table]
        if solid and both:
            raise BadDataError(
                f"lump[{i}] gives {both[0]}, of a bump, and {solid[0]}, of tissue",
                way_out=f"leave out {', '.join(both)} or {', '.join(solid)}",
            )
        if not solid:
            bumps.append(Lump(**table))
            continue
        for key in ("d_mm", "depth_ratio"):
            if key not in table:
                raise BadDataError(f"lump[{i}] gives no {key}", way_out=f"a lump of tissue with {solid[0]} needs it")
        tissue.append(SolidLump(**table))
    return tuple(bumps), tuple(tissue)


def _tuples(table: Mapping[str, Any]) -> dict[str, Any]:
    return {key: tuple(value) if isinstance(value, list) else value for key, value in table.items()}
