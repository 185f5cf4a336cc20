"""Size calibrations as JSON: Eq 6 with draws of its coefficients; those over a population are read here too."""

from __future__ import annotations

from dataclasses import asdict
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tactile_bayes.errors import BadDataError
from tactile_bayes.files.atomic import write_text
from tactile_bayes.files.documents import load_json
from tactile_bayes.files.provenance import Provenance
from tactile_bayes.files.schema import check_document, dump_json
from tactile_bayes.files.shipped import SHIPPED, is_shipped
from tactile_bayes.files.size_parts_json import array_of, number
from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.size.eq6 import (
    COEFFICIENTS,
    AxisCalibration,
    LeftOutErrors,
    Recipe,
    SizeCalibration,
)

if TYPE_CHECKING:
    from tactile_bayes.size.calibration import Calibration

SCHEMA = "tactile-bayes/size-calibration/1"
SCHEMA_FILE = "size_calibration.schema.json"


def write_size_calibration(
    path: Path, calibration: SizeCalibration, *, provenance: Provenance, force: bool = False
) -> None:
    """Write a size calibration atomically; numbers keep nine significant digits."""
    document = {
        "schema": SCHEMA,
        "research_use": RESEARCH_USE,
        "form": "eq6",
        "recipe": calibration.recipe.as_dict(),
        "axes": list(calibration.axes),
        "residual_correlation": number(calibration.residual_correlation),
        "x": _axis_document(calibration.x),
        "y": _axis_document(calibration.y),
        **({"cautions": list(calibration.cautions)} if calibration.cautions else {}),
        **_left_out_document(calibration.left_out),
        "provenance": provenance.as_dict(),
    }
    check_document(document, SCHEMA_FILE, path=path)
    write_text(path, dump_json(document), force=force)


def read_size_calibration(path: Path) -> Calibration:
    """Read a size calibration of any form; one that comes with the program is read once in a process.

    Raises
    ------
    BadDataError
        When the file is not one, or a field breaks the schema.
    """
    return _shipped(path) if is_shipped(path) else _read(path)


@lru_cache(maxsize=len(SHIPPED))
def _shipped(path: Path) -> Calibration:
    return _read(path)


def _read(path: Path) -> Calibration:
    document: Any = load_json(path)
    if isinstance(document, dict) and document.get("form") == "site":
        from tactile_bayes.files import size_site_json as site

        _check(document, site.SCHEMA_FILE, path)
        return site.parse_site_calibration(document, parse_size_calibration(document["base"], path=path), path=path)
    return parse_size_calibration(document, path=path)


def parse_size_calibration(document: Any, *, path: Path) -> Calibration:
    """Parse a calibration of any form but a corrected one.

    Raises
    ------
    BadDataError
        When the document is not one, or a field breaks the schema.
    """
    form = document.get("form") if isinstance(document, dict) else None
    if form == "population":
        from tactile_bayes.files import size_population_json as population

        _check(document, population.SCHEMA_FILE, path)
        return population.parse_population(document, path=path)
    _check(document, SCHEMA_FILE, path)
    return _eq6(document, path=path)


def _check(document: Any, schema_file: str, path: Path) -> None:
    """Hold a file of somebody else's against its schema."""
    if not is_shipped(path):
        check_document(document, schema_file, path=path)


def _eq6(document: Any, *, path: Path) -> SizeCalibration:
    try:
        return SizeCalibration(
            x=_axis(document["x"]),
            y=_axis(document["y"]),
            residual_correlation=float(document["residual_correlation"]),
            recipe=Recipe.from_document(document["recipe"]),
            axes=tuple(document["axes"]),
            left_out=_left_out(document.get("left_out")),
            cautions=tuple(document.get("cautions", ())),
        )
    except BadDataError as error:
        raise error.at(path) from None


def _left_out_document(errors: LeftOutErrors | None) -> dict[str, Any]:
    if errors is None:
        return {}
    document = asdict(errors)
    for form in ("eq6", "log_quadratic"):
        document[form] = {widths: number(error) for widths, error in document[form].items()}
    return {"left_out": document}


def _left_out(document: dict[str, Any] | None) -> LeftOutErrors | None:
    return None if document is None else LeftOutErrors(**document)


def _axis_document(axis: AxisCalibration) -> dict[str, Any]:
    covariance = np.cov(axis.draws.T) if len(axis.draws) > 1 else np.zeros((len(COEFFICIENTS),) * 2)
    return {
        "coefficients": list(COEFFICIENTS),
        "reference_amplitude": axis.reference_amplitude,
        "domain": {name: [number(low), number(high)] for name, (low, high) in axis.domain.items()},
        "fit": {name: number(value) for name, value in axis.fit.items()},
        "mean": [number(value) for value in axis.draws.mean(axis=0)],
        "covariance": [[number(value) for value in row] for row in covariance],
        "draws": [[number(value) for value in row] for row in axis.draws],
    }


def _axis(document: dict[str, Any]) -> AxisCalibration:
    return AxisCalibration(
        draws=array_of(document, "draws"),
        reference_amplitude=float(document["reference_amplitude"]),
        domain={name: (float(low), float(high)) for name, (low, high) in document["domain"].items()},
        fit={name: float(value) for name, value in document["fit"].items()},
    )
