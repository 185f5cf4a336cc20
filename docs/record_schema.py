"""JSON schema of a record's files, from its declaration."""

from __future__ import annotations

import inspect
import re
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import msgspec

_DEFINED: Final = "#/definitions/"


def schema_of(
    kind: Any, meanings: Mapping[str, Mapping[str, str]] = {}, *, nulls: bool = True, shared: bool = False
) -> dict[str, Any]:
    """JSON schema (draft 7) of a record's files, from its declaration; the first line of its docstring is the title.

    Files of TOML hold no `nulls`. With `shared` a record that stands in several places is described once, among
    ``definitions``. `meanings`: of keys by the names of their records, where no `Meta` says them.
    """
    reference = msgspec.json.schema(kind, schema_hook=_custom_schema)
    definitions = reference.pop("$defs", {})
    for name, texts in meanings.items():
        keys = definitions.get(name, {}).get("properties", {})
        keys |= {key: {"description": texts[key], **one} for key, one in keys.items() if key in texts}
    several = _repeated([reference, definitions]) if shared else {}
    body = _inlined(reference, {**definitions, **several})
    if several:
        body["definitions"] = {name: _inlined(definitions[name], {**definitions, **several}) for name in several}
    title, _, meaning = body.pop("description", "").partition("\n")
    head = {"$schema": "http://json-schema.org/draft-07/schema#", "title": title.rstrip(".")}
    if meaning.strip():
        head["description"] = " ".join(meaning.split())
    return {**head, **(body if nulls else _without_nulls(body))}


def _without_nulls(schema: Any) -> Any:
    """A schema in which what may be left out may not be null."""
    if isinstance(schema, list):
        return [_without_nulls(one) for one in schema]
    if not isinstance(schema, dict):
        return schema
    kept = {key: _without_nulls(one) for key, one in schema.items() if key != "default" or one is not None}
    if "anyOf" in kept:
        forms = [one for one in kept.pop("anyOf") if one != {"type": "null"}]
        kept = {**(forms[0] if len(forms) == 1 else {"anyOf": forms}), **kept}
    if None in kept.get("enum", ()):
        kept["enum"] = [one for one in kept["enum"] if one is not None]
    return kept


def _repeated(schema: Any) -> dict[str, Any]:
    """References to the definitions that are named in several places, by their names."""
    names = Counter(re.findall(r'"\$ref":"#/\$defs/([^"]+)"', msgspec.json.encode(schema).decode()))
    return {name: {"$ref": f"{_DEFINED}{name}"} for name, times in sorted(names.items()) if times > 1}


def _inlined(schema: Any, definitions: Mapping[str, Any]) -> Any:
    """A schema with its definitions in place, tuples as draft 7 has them, and no names of classes."""
    if isinstance(schema, list):
        return [_inlined(one, definitions) for one in schema]
    if not isinstance(schema, dict):
        return schema
    if str(schema.get("$ref")).startswith(_DEFINED):
        return schema
    if "$ref" in schema:
        named = definitions[schema["$ref"].rsplit("/", 1)[-1]]
        beside = {key: one for key, one in schema.items() if key != "$ref"}
        if "$ref" in named:  # what stands beside a reference is not read
            return {"allOf": [named], **beside} if beside else named
        schema = {**named, **beside}
    inlined = {key: _inlined(one, definitions) for key, one in schema.items()}
    if isinstance(schema.get("description"), str):  # Python 3.13 takes off the indents of docstrings, 3.11 does not
        inlined["description"] = inspect.cleandoc(schema["description"])
    if "properties" in inlined:
        inlined.pop("title", None)
        inlined["properties"] = {key: _inlined(one, definitions) for key, one in schema["properties"].items()}
    if "prefixItems" in inlined:
        parts = inlined.pop("prefixItems")
        if all(part == parts[0] for part in parts):
            inlined["items"] = parts[0]
        elif all("const" in part for part in parts):
            kept = {key: inlined[key] for key in ("title", "description", "default") if key in inlined}
            inlined = {"const": [part["const"] for part in parts], **kept}
        else:
            inlined |= {"items": parts, "additionalItems": False}
    if len(inlined.get("enum", ())) == 1:
        inlined = {"const" if key == "enum" else key: one[0] if key == "enum" else one for key, one in inlined.items()}
    if not inlined.get("required", True):
        del inlined["required"]
    if len(inlined.get("anyOf", ())) == 2 and {"type": "null"} in inlined["anyOf"]:
        for one in inlined["anyOf"]:
            inlined |= {"description": one.pop("description")} if "description" in one else {}
    return inlined


def _custom_schema(kind: Any) -> dict[str, Any]:
    return {"type": "string", "minLength": 1} if kind is Path else {"type": "array"}
