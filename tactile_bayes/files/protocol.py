"""A pre-specified analysis in TOML: settings fixed before the data were seen, and other text."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tactile_bayes.files.documents import load_toml
from tactile_bayes.files.schema import check_document


@dataclass(frozen=True, slots=True)
class Protocol:
    """The settings that a protocol fixes, and its title where it has one."""

    analysis: dict[str, Any]
    title: str | None = None


def read_protocol(path: Path) -> Protocol:
    """Read the title and the settings under ``[analysis]``; the rest counts only through the file's hash.

    Raises
    ------
    BadDataError
        When the file is not TOML or fixes something that is no setting.
    """
    document = load_toml(path, way_out="give the analysis as TOML")
    check_document(document, "protocol.schema.json", path=path)
    return Protocol(document.get("analysis", {}), document.get("title"))
