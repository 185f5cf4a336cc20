"""The schemas in data_schema/ of files whose records declare them: written by `make_reference.py` (`make schemas`)."""

from __future__ import annotations

import ast
import inspect
import json
import re
from pathlib import Path
from typing import Any, get_args

import msgspec
from record_schema import schema_of

from tactile_bayes.api.settings import SettingsFile
from tactile_bayes.declarations import Record, meaning_of
from tactile_bayes.files.arrays_layout import ArrayMap
from tactile_bayes.files.column_map import ColumnMap
from tactile_bayes.files.documents import OF_A_PERSON, Fact, FactName, Protocol, Session
from tactile_bayes.files.instrument import HeadFile, SceneFile
from tactile_bayes.files.reports import EstimateReport, Figures, Origin, PooledFigures, PooledReport, Shares
from tactile_bayes.files.size_json import Eq6File, PopulationFile, RepeatabilityFile, SiteFile
from tactile_bayes.options import IdentityOptions
from tactile_bayes.report.compare import CompareReport
from tactile_bayes.report.tradeoff import TradeoffFile
from tactile_bayes.studies.population import BodiesFile
from tactile_bayes.trial.planning import PlanReport
from tactile_bayes.trial.summary import TrialReport

OPEN_TABLES: dict[str, dict[str, type[Record]]] = {
    "estimate.schema.json": {"diagnostics": Figures, "provenance": Origin, "variance_share": Shares},
    "pooled.schema.json": {"figures": PooledFigures},
}
"""Of tables with any keys those that readers use, which `__post_init__` of the report checks."""
SCHEMAS = Path(__file__).resolve().parent.parent / "data_schema"
OF_JSON: dict[str, type[Record]] = {
    "compare.schema.json": CompareReport,
    "estimate.schema.json": EstimateReport,
    "head.schema.json": HeadFile,
    "plan.schema.json": PlanReport,
    "pooled.schema.json": PooledReport,
    "repeatability.schema.json": RepeatabilityFile,
    "size_calibration.schema.json": Eq6File,
    "size_population.schema.json": PopulationFile,
    "size_site.schema.json": SiteFile,
    "tradeoff.schema.json": TradeoffFile,
    "validate.schema.json": TrialReport,
    "worklist.schema.json": IdentityOptions,
}
OF_TOML: dict[str, type[Record]] = {
    "bodies.schema.json": BodiesFile,
    "array_map.schema.json": ArrayMap,
    "column_map.schema.json": ColumnMap,
    "protocol.schema.json": Protocol,
    "scene.schema.json": SceneFile,
    "settings.schema.json": SettingsFile,
}


def schemas() -> dict[Path, str]:
    """What each generated schema has to hold."""
    by_file = {name: schema_of(kind, meanings(kind), shared=True) for name, kind in OF_JSON.items()}
    by_file |= {name: schema_of(kind, meanings(kind), nulls=False) for name, kind in OF_TOML.items()}
    by_file["scan_session.schema.json"] = _session()
    for name, tables in OPEN_TABLES.items():
        for key, kind in tables.items():
            _add_known(by_file[name]["properties"][key], schema_of(kind, meanings(kind)))
    return {SCHEMAS / name: json.dumps(one, indent=2, ensure_ascii=False) + "\n" for name, one in by_file.items()}


def meanings(kind: Any) -> dict[str, dict[str, str]]:
    """What the sources of all records in a declaration say of their fields, by the records' names and the keys."""
    by_record: dict[str, dict[str, str]] = {}

    def collect(one: Any) -> None:
        if isinstance(one, type) and issubclass(one, Record) and one.__name__ not in by_record:
            fields = msgspec.structs.fields(one)
            texts = {name: text for base in reversed(one.__mro__) for name, text in _comments(base).items()}
            texts |= {field.name: text for field in fields if (text := meaning_of(field.type))}
            by_record[one.__name__] = {field.encode_name: texts[field.name] for field in fields if field.name in texts}
            for field in fields:
                collect(field.type)
        for argument in get_args(one):
            collect(argument)

    collect(kind)
    return by_record


_NAMES = re.compile(r"((?:`\w+`(?:, | and )?)+): (.*)")


def _comments(record: type) -> dict[str, str]:
    """Meanings of a class's own fields: ``#: Text`` behind one, or a text below, which may name several."""
    try:
        source = inspect.getsource(record)
    except (OSError, TypeError):  # made of another's fields
        return {}
    texts: dict[str, str] = {}
    lines, field = source.splitlines(), ""
    for node in ast.parse(source).body[0].body:  # type: ignore[attr-defined]
        if isinstance(node, ast.AnnAssign):
            field = ast.unparse(node.target)
            _, sign, text = lines[(node.end_lineno or 1) - 1].partition("#: ")
            texts |= {field: text} if sign else {}
        elif isinstance(node, ast.Expr) and field:
            text = " ".join(ast.literal_eval(node.value).split())
            several = _NAMES.fullmatch(text)
            texts |= dict.fromkeys(re.findall(r"\w+", several[1]), several[2]) if several else {field: text}
        else:
            field = ""
    return texts


def _add_known(table: dict[str, Any], known: dict[str, Any]) -> None:
    """Say of a table with any keys what some of them hold."""
    for form in table.get("anyOf", [table]):
        if form.get("type") == "object":
            form |= {name: known[name] for name in ("properties", "required") if name in known}


def _session() -> dict[str, Any]:
    """Schema of a session: known facts, and others by their names."""
    others = schema_of(dict[FactName, Fact])
    names = others["propertyNames"] | {"not": {"enum": list(OF_A_PERSON)}}
    return schema_of(Session, meanings(Session), nulls=False) | {
        "propertyNames": names,
        "additionalProperties": others["additionalProperties"],
    }
