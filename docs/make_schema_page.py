"""The page of columns and keys, from the schemas in data_schema: called by `make_reference.py`."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

SCHEMAS = Path(__file__).resolve().parent.parent / "data_schema"
SECTIONS = {
    "Trial (CSV)": "trial.table.json",
    "Exams (CSV)": "exams.table.json",
    "Exams done (CSV)": "exams_done.table.json",
    "Failures (CSV)": "failures.table.json",
    "Growth (CSV)": "growth.table.json",
    "Excision (CSV)": "excision.table.json",
    "Size table (CSV)": "size_table.table.json",
    "Phantom maps (CSV)": "phantom_maps.table.json",
    "Study grid (CSV)": "study_grid.table.json",
    "Measured frames (CSV)": "measured_frames.table.json",
    "Population (CSV)": "population.table.json",
    "Head (JSON)": "head.schema.json",
    "Bodies of population (TOML)": "bodies.schema.json",
    "Scene (TOML)": "scene.schema.json",
    "Settings of estimate (TOML)": "settings.schema.json",
    "Session (TOML)": "scan_session.schema.json",
    "Protocol (TOML)": "protocol.schema.json",
    "Worklist (JSON)": "worklist.schema.json",
    "Mapping of columns (TOML)": "column_map.schema.json",
    "Mapping of arrays (TOML)": "array_map.schema.json",
}
"""Heading of each schema of what users write themselves, or read in tables."""
HEAD = """\
# Columns and keys

Generated from the schemas in `data_schema` by `python docs/make_reference.py`; a test holds the two together. What the
files are for is in [formats](formats.md).
"""
_LIMITS = {"minimum": "at least", "exclusiveMinimum": "above", "maximum": "at most", "exclusiveMaximum": "below"}


def render_schemas(generated: Mapping[Path, str]) -> str:
    """The whole page; schemas that are generated from records are given, the others read."""
    texts = {name: generated.get(SCHEMAS / name) for name in SECTIONS.values()}
    texts = {name: text or (SCHEMAS / name).read_text(encoding="utf-8") for name, text in texts.items()}
    return "\n".join([HEAD, *(_section(heading, name, texts[name]) for heading, name in SECTIONS.items())])


def _section(heading: str, name: str, text: str) -> str:
    schema = json.loads(text)
    words = [f"{schema[part].rstrip('.')}." for part in ("title", "description") if part in schema]
    intro = f"## {heading}\n\n{' '.join(words)} Schema: [{name}](../data_schema/{name}).\n"
    if "fields" in schema:
        head, rows = "| column | value | meaning |\n|---|---|---|\n", _columns(schema["fields"])
    else:
        head, rows = "| key | value | default | meaning |\n|---|---|---|---|\n", _keys(schema)
    return f"{intro}\n{head}{''.join(rows)}"


def _columns(fields: list[dict[str, Any]]) -> Iterator[str]:
    for field in fields:
        rules = field.get("constraints", {})
        value = ", ".join(part for part in (_value({"type": field["type"]} | rules), _need(field, rules)) if part)
        yield _row(f"`{field['name']}`", value, field.get("description", ""))


def _need(field: Mapping[str, Any], rules: Mapping[str, Any]) -> str:
    if rules.get("required"):
        return "required"
    return "may be blank" if field.get("column") == "required" else "may be left out"


def _keys(schema: Mapping[str, Any], table: str = "") -> Iterator[str]:
    """Rows of the keys of a table, those of tables below it after them."""
    tables = []
    for key, rule in schema.get("properties", {}).items():
        name = f"{table}.{key}" if table else key
        inner = rule.get("items", rule)
        if "properties" in inner:
            tables.append((name, rule, inner))
            continue
        default = json.dumps(rule["default"]).strip('"') if rule.get("default") is not None else ""
        needed = "required" if key in schema.get("required", []) else default
        yield _row(f"`{name}`", _value(rule), needed, rule.get("description", ""))
    for name, rule, inner in tables:
        brackets = f"`[[{name}]]`" if "items" in rule else f"`[{name}]`"
        kind = "table, repeatable" if "items" in rule else "table"
        yield _row(brackets, kind, "", rule.get("description", ""))
        yield from _keys(inner, name)


def _value(rule: Mapping[str, Any]) -> str:
    """Type and range in words."""
    if "anyOf" in rule:
        return " or ".join(_value(one) for one in rule["anyOf"])
    if "const" in rule:
        return "null" if rule["const"] is None else str(rule["const"])
    if "enum" in rule:
        return " or ".join(str(one) for one in rule["enum"])
    if rule.get("type") == "array":
        return f"list of {_value(rule['items'])}" if rule.get("items") else "list"
    return ", ".join([str(rule.get("type", "text")), *_limits(rule)])


def _limits(rule: Mapping[str, Any]) -> list[str]:
    if "minimum" in rule and "maximum" in rule:
        return [f"{rule['minimum']:,} to {rule['maximum']:,}"]
    return [f"{words} {rule[name]:,}" for name, words in _LIMITS.items() if name in rule]


def _row(*cells: str) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|").replace("\n", " ") for cell in cells) + " |\n"
