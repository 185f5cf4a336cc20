"""Settings of `estimate` as TOML: priors and rarely used options; an unknown key is refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

from tactile_bayes.errors import BadDataError, meant
from tactile_bayes.files.documents import load_toml
from tactile_bayes.files.schema import check_document, load_schema

SCHEMA: Final = "settings.schema.json"
PRIORS: Final = ("amplitude_sd", "width_median_mm", "log_width_sd", "log_ratio_sd", "tilt_sd")
_NUMBERS: Final = ("fit_radius_mm", "between_map_sd", "accuracy_mm")


def read_settings(path: Path) -> dict[str, Any]:
    """Read settings by the names of `pipeline.settings.Settings`, the priors together under ``prior``.

    Raises
    ------
    BadDataError
        Naming the file, the key, its value and what is allowed.
    """
    document = load_toml(path, way_out=f"see {SCHEMA}")
    known = load_schema(SCHEMA)["properties"]
    unknown = sorted(set(document) - set(known))
    if unknown:
        raise BadDataError(f"unknown key {unknown[0]}", way_out=meant(unknown[0], known), path=str(path))
    check_document(dict(document), SCHEMA, path=path)  # it fills in defaults
    prior = {name: float(document.pop(name)) for name in PRIORS if name in document}
    found: dict[str, Any] = {name: float(value) if name in _NUMBERS else value for name, value in document.items()}
    if "checkpoint" in found:
        found["checkpoint"] = path.parent / found["checkpoint"]
    if found.get("field_cosines") == "auto":
        found["field_cosines"] = None
    return found | {"prior": prior or None, "settings_file": path}
