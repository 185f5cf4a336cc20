"""Eq 6 over a population of bodies as JSON: posterior mean and covariance, what a ball's map looks like, domain."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from tactile_bayes.errors import BadDataError
from tactile_bayes.files.atomic import write_text
from tactile_bayes.files.provenance import Provenance
from tactile_bayes.files.schema import check_document, dump_json
from tactile_bayes.files.size_bodies_json import bodies_document, parse_bodies
from tactile_bayes.files.size_fat_json import fat_document, parse_fat
from tactile_bayes.files.size_parts_json import number
from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.size.population_eq6 import FAT_COEFFICIENTS, PARAMETERS, FatEq6, PopulationEq6

SCHEMA = "tactile-bayes/size-calibration/3"
SCHEMA_FILE = "size_population_eq6.schema.json"
FORM = "eq6-population"


def write_population_eq6(
    path: Path, calibration: PopulationEq6, *, provenance: Provenance, force: bool = False
) -> None:
    """Write a calibration atomically; numbers keep nine significant digits."""
    document = {
        "schema": SCHEMA,
        "research_use": RESEARCH_USE,
        "form": FORM,
        "parameters": list(PARAMETERS),
        "log_amplitude_one_deep": number(calibration.log_amplitude_one_deep),
        "constants": {name: number(value) for name, value in calibration.constants().items()},
        **bodies_document(calibration),
        **({} if calibration.with_fat is None else {"fat_eq6": fat_document(calibration.with_fat, FAT_COEFFICIENTS)}),
        "provenance": provenance.as_dict(),
    }
    check_document(document, SCHEMA_FILE, path=path)
    write_text(path, dump_json(document), force=force)


def parse_population_eq6(document: dict[str, Any], *, path: Path) -> PopulationEq6:
    """A calibration from a document that keeps the schema.

    Raises
    ------
    BadDataError
        When its numbers cannot be those of a calibration.
    """
    try:
        fat = parse_fat(document["fat_eq6"], FatEq6) if "fat_eq6" in document else None
        deep = float(document["log_amplitude_one_deep"])
        return PopulationEq6(**parse_bodies(document), with_fat=fat, log_amplitude_one_deep=deep)
    except BadDataError as error:
        raise error.at(path) from None
