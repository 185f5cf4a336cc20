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
    found = msgspec.json.schema(kind, schema_hook=_custom_schema)
    definitions = found.pop("$defs", {})
    for name, told in meanings.items():
        keys = definitions.get(name, {}).get("properties", {})
        keys |= {key: {"description": told[key], **one} for key, one in keys.items() if key in told}
    several = _repeated([found, definitions]) if shared else {}
    body = _inlined(found, {**definitions, **several})
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
    found = {key: _without_nulls(one) for key, one in schema.items() if key != "default" or one is not None}
    if "anyOf" in found:
        forms = [one for one in found.pop("anyOf") if one != {"type": "null"}]
        found = {**(forms[0] if len(forms) == 1 else {"anyOf": forms}), **found}
    if None in found.get("enum", ()):
        found["enum"] = [one for one in found["enum"] if one is not None]
    return found


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
        if "$ref" in named:  # what stands beside a reference is not read
            return {"allOf": [named], **rest} if (rest := {k: v for k, v in schema.items() if k != "$ref"}) else named
        schema = {**definitions[schema["$ref"].rsplit("/", 1)[-1]], **{k: v for k, v in schema.items() if k != "$ref"}}
    found = {key: _inlined(one, definitions) for key, one in schema.items()}
    if isinstance(schema.get("description"), str):  # Python 3.13 takes off the indents of docstrings, 3.11 does not
        found["description"] = inspect.cleandoc(schema["description"])
    if "properties" in found:
        found.pop("title", None)
        found["properties"] = {key: _inlined(one, definitions) for key, one in schema["properties"].items()}
    if "prefixItems" in found:
        parts = found.pop("prefixItems")
        if all(part == parts[0] for part in parts):
            found["items"] = parts[0]
        elif all("const" in part for part in parts):
            kept = ("title", "description", "default")
            found = {"const": [part["const"] for part in parts], **{key: found[key] for key in kept if key in found}}
        else:
            found |= {"items": parts, "additionalItems": False}
    if len(found.get("enum", ())) == 1:
        found = {"const" if key == "enum" else key: one[0] if key == "enum" else one for key, one in found.items()}
    if not found.get("required", True):
        del found["required"]
    if len(found.get("anyOf", ())) == 2 and {"type": "null"} in found["anyOf"]:
        for one in found["anyOf"]:
            found |= {"description": one.pop("description")} if "description" in one else {}
    if "discriminator" in found:
        del found["discriminator"]
    return found


def _custom_schema(kind: Any) -> dict[str, Any]:
    return {"type": "string", "minLength": 1} if kind is Path else {"type": "array"}
