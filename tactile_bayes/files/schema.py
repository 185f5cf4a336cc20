"""The schemas in data_schema/, from a wheel or a checkout, applied with one-line errors."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any, Final

from tactile_bayes.errors import BadDataError, meant
from tactile_bayes.files.kinds import schema_kind

_PACKAGE = Path(__file__).resolve().parent.parent


@cache
def load_schema(name: str) -> dict[str, Any]:
    """Load the schema ``data_schema/NAME`` (``size_calibration.schema.json``, ``trial.table.json``...)."""
    for folder in (_PACKAGE / "data_schema", _PACKAGE.parent / "data_schema"):
        if (folder / name).is_file():
            document: dict[str, Any] = json.loads((folder / name).read_text(encoding="utf-8"))
            return document
    raise FileNotFoundError(f"schema {name} is not installed with this program")


def check_document(document: object, schema_name: str, *, path: Path) -> None:
    """Check a JSON document against its schema.

    Raises
    ------
    BadDataError
        Naming the file, the field, its value and the rule it breaks.
    """
    import fastjsonschema

    _check_kind(document, schema_name, path=path)
    try:
        _validator(schema_name)(document)
    except fastjsonschema.JsonSchemaValueException as error:
        what, way_out = _in_words(error)
        raise BadDataError(what, way_out=f"{way_out} (see {schema_name})", path=str(path)) from None


_CODE: Final = re.compile(r"\^\[A-Za-z0-9_-\]\{1,(\d+)\}\$")
_KINDS: Final = {
    "string": "a text",
    "number": "a number",
    "integer": "a whole number",
    "object": "a table of keys",
    "array": "a list",
    "boolean": "true or false",
    "null": "null",
}


def _in_words(error: Any) -> tuple[str, str]:
    """What is wrong in a document, and what can be given instead, without the words of schemas."""
    where = ".".join(map(str, error.path[1:])) or "the document"
    what, wanted, definition = f"{where} is {_shown(error.value)}", error.rule_definition, error.definition
    if error.rule == "required":
        missing = next(name for name in wanted if name not in error.value)
        return f"{where} has no {missing}", "add it"
    if error.rule in ("additionalProperties", "propertyNames"):
        return _unknown_key(error, "" if where == "the document" else f"{where}.")
    if error.rule == "enum" and isinstance(error.value, str):
        texts = [str(one) for one in wanted]
        near = meant(error.value, texts)
        return what, f"{near} Give one of {', '.join(texts)}" if near.startswith("did") else _allowed(definition)
    if error.rule == "pattern" and not _CODE.fullmatch(wanted):
        return what, str(definition.get("description", f"the pattern is {wanted}"))
    if error.rule == "type" and wanted == "string":
        return what, "give a text, in quotes"
    if error.rule in ("type", "enum", "const", "pattern", "anyOf", "oneOf") or "imum" in error.rule:
        return what, _allowed(definition)
    if error.rule in ("minLength", "maxLength"):
        return what, f"give a text of {definition.get('minLength', 0)} to {definition.get('maxLength', 2000)} letters"
    rule = error.message.split(" ", 1)[1] if " " in error.message else error.message
    return f"{where} {rule} (found {_shown(error.value)})", "give what it may hold"


def _allowed(definition: Mapping[str, Any]) -> str:
    """What a definition allows, such as "give a number above 0"."""
    for several in ("anyOf", "oneOf"):
        if several in definition:
            return f"give {' or '.join(_allowed(one).removeprefix('give ') for one in definition[several])}"
    if "const" in definition:
        return f"give {definition['const']!r}"
    if "enum" in definition:
        return f"give one of {', '.join('null' if one is None else str(one) for one in definition['enum'])}"
    if found := _CODE.fullmatch(definition.get("pattern", "")):
        return f"give up to {found[1]} letters from A to Z and a to z, digits, _ and -"
    kinds = definition.get("type", ())
    return f"give {' or '.join(_kind(kind, definition) for kind in ([kinds] if isinstance(kinds, str) else kinds))}"


def _kind(kind: str, definition: Mapping[str, Any]) -> str:
    if kind not in ("number", "integer"):
        return _KINDS[kind]
    words = _KINDS[kind]
    if "exclusiveMinimum" in definition:
        words += f" above {definition['exclusiveMinimum']:g}"
    if "minimum" in definition:
        words += f" from {definition['minimum']:g}" + ("" if "maximum" in definition else " on")
    if "maximum" in definition:
        words += f" {'to' if 'minimum' in definition else 'up to'} {definition['maximum']:g}"
    return words + (f" below {definition['exclusiveMaximum']:g}" if "exclusiveMaximum" in definition else "")


def _unknown_key(error: Any, where: str) -> tuple[str, str]:
    """The first key that a table may not have, with the one that was probably meant."""
    known, rule = tuple(error.definition.get("properties", ())), error.rule_definition
    if error.rule == "additionalProperties":
        name = next(one for one in error.value if one not in known)
        return f"{where}{name} is not known", meant(name, known) if known else "leave it out"
    refused, pattern = rule.get("not", {}).get("enum", ()), rule.get("pattern", "")
    name = next(one for one in error.value if one in refused or not re.search(pattern, one))
    if name in refused:
        return f"{where}{name} may not be given", "leave it out: nothing here may identify a person"
    near = meant(name, known) if known else ""
    return f"{where}{_shown(name)} is not known", near if near.startswith(
        "did"
    ) else "keys are of small letters, digits and _"


def _shown(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _check_kind(document: object, schema_name: str, *, path: Path) -> None:
    """Refuse a document of another kind by its name, before checking its fields against the wrong schema."""
    wanted = schema_kind(load_schema(schema_name).get("properties", {}).get("schema", {}).get("const"))
    found = schema_kind(document.get("schema")) if isinstance(document, dict) else ""
    if wanted and found and found != wanted:
        raise BadDataError(f"is {found}, not {wanted}", way_out=f"give {wanted}", path=str(path))


@cache
def _validator(schema_name: str) -> Any:
    import fastjsonschema

    # our ids are names, not addresses: with one in place the compiler would try to fetch what "$ref" points to
    document = {key: value for key, value in load_schema(schema_name).items() if key != "$id"}
    return fastjsonschema.compile(document)


def dump_json(document: object) -> str:
    """Format as JSON with a fixed layout; refuses NaN and infinities, which JSON does not have."""
    return json.dumps(document, indent=2, allow_nan=False, ensure_ascii=False) + "\n"
