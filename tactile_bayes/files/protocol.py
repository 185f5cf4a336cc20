"""A pre-specified analysis in TOML: the settings fixed before the data were seen, and whatever else was promised."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

from tactile_bayes.errors import BadDataError
from tactile_bayes.files.atomic import unreadable
from tactile_bayes.files.schema import check_document


def read_protocol(path: Path) -> dict[str, Any]:
    """The settings under ``[analysis]``; other tables are for people and count only through the file's hash.

    Raises
    ------
    BadDataError
        When the file is not TOML or fixes something that is no setting.
    """
    try:
        document = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise unreadable(path, error) from None
    except (UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise BadDataError(f"is not TOML ({error})", way_out="give the analysis as TOML", path=str(path)) from None
    check_document(document, "protocol.schema.json", path=path)
    analysis: dict[str, Any] = document.get("analysis", {})
    return analysis
