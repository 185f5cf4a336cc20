"""A pre-specified analysis in TOML: the settings fixed before the data were seen, and whatever else was promised."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tactile_bayes.errors import BadDataError
from tactile_bayes.files.documents import load_toml
from tactile_bayes.files.schema import check_document


@dataclass(frozen=True, slots=True)
class Protocol:
    """The settings that a protocol fixes, and its title where it has one."""

    analysis: dict[str, Any]
    title: str | None = None


def read_protocol(path: Path) -> Protocol:
    """The title and the settings under ``[analysis]``; the rest is for people and counts only through the file's hash.

    Raises
    ------
    BadDataError
        When the file is not TOML or fixes something that is no setting.
    """
    document = load_toml(path, way_out="give the analysis as TOML")
    check_document(document, "protocol.schema.json", path=path)
    analysis: dict[str, Any] = document.get("analysis", {})
    for name, value in analysis.items():
        if isinstance(value, float) and not math.isfinite(value):
            raise BadDataError(f"analysis.{name} is {value}", way_out="give a finite number", path=str(path))
    return Protocol(analysis, document.get("title"))
