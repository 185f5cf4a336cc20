"""The schemas in data_schema/ of files whose records declare them: written by `make_reference.py` (`make schemas`)."""

from __future__ import annotations

import json
from pathlib import Path

from tactile_bayes.declarations import Record, schema_of
from tactile_bayes.files.size_json import Eq6File, PopulationFile, SiteFile

SCHEMAS = Path(__file__).resolve().parent.parent / "data_schema"
RECORDS: dict[str, type[Record]] = {
    "size_calibration.schema.json": Eq6File,
    "size_population.schema.json": PopulationFile,
    "size_site.schema.json": SiteFile,
}


def schemas() -> dict[Path, str]:
    """What each generated schema has to hold."""
    texts = {name: json.dumps(schema_of(kind), indent=2, ensure_ascii=False) + "\n" for name, kind in RECORDS.items()}
    return {SCHEMAS / name: text for name, text in texts.items()}
