"""The schemas in data_schema/, from a wheel or a checkout, applied with one-line errors."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import Any

from tactile_bayes.errors import BadDataError
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
        where = ".".join(error.path[1:]) or "the document"
        value = repr(error.value)
        value = value if len(value) <= 60 else value[:57] + "..."
        rule = error.message.split(" ", 1)[1] if " " in error.message else error.message
        raise BadDataError(f"{where} {rule} (found {value})", way_out=f"see {schema_name}", path=str(path)) from None


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
