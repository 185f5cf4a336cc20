"""Bodies and exams of a simulated population as TOML: ranges, and an unknown key is refused."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from tactile_bayes.errors import BadDataError
from tactile_bayes.files.documents import load_toml
from tactile_bayes.files.keys import refuse_unknown
from tactile_bayes.files.schema import check_document, load_schema
from tactile_bayes.forward.population import BodyPrior, ExamPrior

SCHEMA_FILE: Final = "bodies.schema.json"


def read_bodies(path: Path) -> tuple[BodyPrior, ExamPrior]:
    """Read the ranges of bodies and exams; missing keys keep the defaults.

    Raises
    ------
    BadDataError
        Naming the file, the key, its value and what is allowed.
    """
    document = load_toml(path, way_out=f"see {SCHEMA_FILE}")
    tables = load_schema(SCHEMA_FILE)["properties"]
    refuse_unknown(document, tables, path=path)
    for name, table in document.items():
        if isinstance(table, dict):
            refuse_unknown(table, tables[name]["properties"], path=path, where=name)
    check_document(document, SCHEMA_FILE, path=path)
    bodies, exams = (_ranges(document.get(name, {}), name, path) for name in ("bodies", "exams"))
    found = BodyPrior(**bodies), ExamPrior(**exams)
    if found[1].drift_kpa[1] >= found[1].mean_kpa[0]:
        what = f"exams.drift_kpa reaches {found[1].drift_kpa[1]:g}, and mean_kpa begins at {found[1].mean_kpa[0]:g}"
        raise BadDataError(what, way_out="keep the drift below the mean pressure", path=str(path))
    return found


def _ranges(table: Mapping[str, Any], where: str, path: Path) -> dict[str, Any]:
    for name, (low, high) in table.items():
        if low > high:
            what = f"{where}.{name} runs backwards, from {low:g} to {high:g}"
            raise BadDataError(what, way_out="give the lower end first", path=str(path))
    return {name: (low, high) for name, (low, high) in table.items()}
