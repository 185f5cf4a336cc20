"""Refusal of keys that a file may not have, with the key that was probably meant."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path

from tactile_bayes.errors import BadDataError, meant


def refuse_unknown(table: Mapping[str, object], known: Collection[str], *, path: Path, where: str = "") -> None:
    """Raise `BadDataError` for the first key of a table that is not known.

    Parameters
    ----------
    where
        Name of the table in the file; empty for the file itself.
    """
    for key in table:
        if key in known:
            continue
        full = f"{where}.{key}" if where else key
        raise BadDataError(f"{full} is not known", way_out=meant(key, known), path=str(path))
