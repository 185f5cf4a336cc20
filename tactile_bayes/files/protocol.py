"""A pre-specified analysis in TOML: the settings fixed before the data were seen, and whatever else was promised."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from tactile_bayes.files.documents import load_toml
from tactile_bayes.files.schema import check_document


def read_protocol(path: Path) -> dict[str, Any]:
    """The settings under ``[analysis]``; other tables are for people and count only through the file's hash.

    Raises
    ------
    BadDataError
        When the file is not TOML or fixes something that is no setting.
    """
    document = load_toml(path, way_out="give the analysis as TOML")
    check_document(document, "protocol.schema.json", path=path)
    analysis: dict[str, Any] = document.get("analysis", {})
    return analysis
