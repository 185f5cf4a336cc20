"""Priors as TOML: whatever is left out keeps its default, an unknown key is refused."""

from __future__ import annotations

from pathlib import Path

from tactile_bayes.errors import BadDataError
from tactile_bayes.files.documents import load_toml
from tactile_bayes.files.schema import check_document
from tactile_bayes.posterior.lump.bump import BumpPrior

SCHEMA = "prior.schema.json"


def read_prior(path: Path | None) -> BumpPrior:
    """Read priors; the defaults where there is no file.

    Raises
    ------
    BadDataError
        Naming the file, the key, its value and what is allowed.
    """
    if path is None:
        return BumpPrior()
    document = load_toml(path, way_out=f"see {SCHEMA}")
    unknown = sorted(set(document) - set(BumpPrior().as_dict()))
    if unknown:
        known = ", ".join(BumpPrior().as_dict())
        raise BadDataError(f"unknown key {unknown[0]}", way_out=f"the keys are {known}", path=str(path))
    check_document(document, SCHEMA, path=path)
    return BumpPrior(**{name: float(value) for name, value in document.items()})
