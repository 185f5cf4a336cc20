"""Priors as TOML: whatever is left out keeps its default, an unknown key is refused."""

from __future__ import annotations

import math
from pathlib import Path

from tactile_bayes.errors import BadDataError
from tactile_bayes.files.atomic import unreadable
from tactile_bayes.files.schema import check_document
from tactile_bayes.posterior.bump import BumpPrior

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
    import tomllib

    try:
        document = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise unreadable(path, error) from None
    except (UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise BadDataError(f"is not TOML ({error})", way_out=f"see {SCHEMA}", path=str(path)) from None
    unknown = sorted(set(document) - set(BumpPrior().as_dict()))
    if unknown:
        known = ", ".join(BumpPrior().as_dict())
        raise BadDataError(f"unknown key {unknown[0]}", way_out=f"the keys are {known}", path=str(path))
    check_document(document, SCHEMA, path=path)
    values = {name: float(value) for name, value in document.items()}
    for name, value in values.items():
        if not math.isfinite(value):
            raise BadDataError(f"{name} is {value}", way_out="give a finite number", path=str(path))
    return BumpPrior(**values)
